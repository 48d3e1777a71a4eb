"""What the arm could do in place of a motion that it cannot: the same slower, with less in it, higher, or smaller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.kinematics import configuration_near
from ..envs.panda import PAYLOAD_MAX_KG
from ..extract.errors import UserError

if TYPE_CHECKING:
    from ..envs.reference import Reference

SLOWER = (1.0, 1.4, 2.0)
RISES_M = (0.02, 0.05, 0.1)
FACTORS = (0.85, 0.7, 0.5)


@dataclass(frozen=True)
class Variant:
    """A changed motion, the mass of what is in the vessel (None: as usual), and in words what was changed."""

    reference: Reference
    contents_kg: float | None
    words: str


def nearest_variant(
    reference: Reference,
    contents_kg: float | None,
    payload_kg: float,
    slower: float,
    works: Callable[[Reference, float | None], bool],
) -> dict[str, Any] | None:
    """The first variant that works, nearest kinds first, and how far it is from the motion; None if there is none.

    payload_kg: mass of vessel and contents. slower: how many times slower the motion must be at least.
    """
    for variant in _variants(reference, contents_kg, payload_kg, slower):
        made = variant.reference
        if not works(made, variant.contents_kg):
            continue
        off_m = np.zeros(1)
        if len(made) == len(reference):
            off_m = np.linalg.norm(made.T_world_object[:, :3, 3] - reference.T_world_object[:, :3, 3], axis=1)
        return {
            "words": variant.words,
            "time_stretch": made.duration_s / reference.duration_s,
            "extra_s": made.duration_s - reference.duration_s,
            "contents_kg": variant.contents_kg,
            "distance_m": {"mean": float(off_m.mean()), "max": float(off_m.max())},
        }
    return None


def _variants(reference: Reference, contents_kg: float | None, payload_kg: float, slower: float) -> Iterator[Variant]:
    if payload_kg > PAYLOAD_MAX_KG:
        # Less is no remedy for anything else, and nothing else for it.
        left_kg = PAYLOAD_MAX_KG - (payload_kg - (contents_kg or 0.0))
        if contents_kg and left_kg > 0.0:
            light_kg = 0.98 * left_kg
            yield Variant(reference, light_kg, f"With at most {light_kg:.2f} kg in the vessel it can.")
        return
    for more in SLOWER:
        slow = reference.stretched(1.03 * slower * more)
        factor = slow.duration_s / reference.duration_s
        words = (
            f"Played {factor:.2f} times slower (--speed {1.0 / factor:.2f}), {slow.duration_s:.1f} s in place of "
            f"{reference.duration_s:.1f} s, it can."
        )
        yield Variant(slow, contents_kg, words)
    for rise_m in RISES_M:
        words = f"Carried {100 * rise_m:.0f} cm higher, it can."
        yield from _moved(reference, 1.0, rise_m, contents_kg, words)
    for factor in FACTORS:
        words = f"With the path scaled by {factor:g} about the moment of greatest tilt (--scale), it can."
        yield from _moved(reference, factor, 0.0, contents_kg, words)


def _moved(
    reference: Reference, factor: float, rise_m: float, contents_kg: float | None, words: str
) -> Iterator[Variant]:
    """The path scaled about the moment of greatest tilt and lifted, if the arm can begin so."""
    T = reference.T_world_object.copy()
    pour_m = T[reference.pour_index, :3, 3].copy()
    T[:, :3, 3] = pour_m + factor * (T[:, :3, 3] - pour_m) + np.array([0.0, 0.0, rise_m])
    try:
        q_rad = configuration_near(T[0], reference.T_hand_object, reference.q_start_rad)
    except UserError:
        return
    header = {**reference.header, "q_start_rad": q_rad.tolist()}
    made = type(reference).from_poses(T, reference.time_s, header, reference.confidence, reference.video_time_s)
    yield Variant(made, contents_kg, words)
