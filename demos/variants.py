"""What the arm could do in place of a motion that it cannot: the same higher, slower, with less in it, or smaller.

Where a touch of table or receptacle is all that is wrong, a path a little higher or a receptacle a little aside mends
it. `freed_of` names what is given way to, `Variant.taken` is the reference with what was done to it on record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.kinematics import configuration_near
from ..envs.panda import PAYLOAD_MAX_KG
from ..extract.errors import UserError
from .scale_search import with_receptacle_moved

if TYPE_CHECKING:
    from ..envs.reference import Reference

# By how much a motion may be raised, or its receptacle moved, without asking.
SMALL_M = (0.01, 0.02, 0.03, 0.04, 0.05)
SLOWER = (1.0, 1.4, 2.0)
RISES_M = (0.02, 0.05, 0.1)
FACTORS = (0.85, 0.7, 0.5)
# Ways in which a receptacle may give way, seen along the pour.
_SIDES = (("further", 1.0, 0.0), ("nearer", -1.0, 0.0), ("to the left", 0.0, 1.0), ("to the right", 0.0, -1.0))


@dataclass(frozen=True)
class Variant:
    """A changed motion, the mass of what is in the vessel (None: as usual), and in words what was changed.

    raised_m: the whole path. receptacle_moved_m: the receptacle alone, in the direction that `words` names.
    """

    reference: Reference
    contents_kg: float | None
    words: str
    raised_m: float = 0.0
    receptacle_moved_m: float = 0.0

    @property
    def is_small(self) -> bool:
        """Whether it frees the motion of a touch by so little that it may be taken without asking."""
        return 0.0 < self.raised_m + self.receptacle_moved_m <= SMALL_M[-1]

    def told(self, reference: Reference) -> dict[str, Any]:
        """How far it is from the motion (JSON-like)."""
        made, off_m = self.reference, np.zeros(1)
        if len(made) == len(reference):
            off_m = np.linalg.norm(made.T_world_object[:, :3, 3] - reference.T_world_object[:, :3, 3], axis=1)
        return {
            "words": self.words,
            "time_stretch": made.duration_s / reference.duration_s,
            "extra_s": made.duration_s - reference.duration_s,
            "contents_kg": self.contents_kg,
            "distance_m": {"mean": float(off_m.mean()), "max": float(off_m.max())},
            "receptacle_moved_m": self.receptacle_moved_m,
        }

    def taken(self, collisions: list[dict[str, Any]]) -> Reference:
        """The changed motion with a note of what was changed, by how much, and which collisions it is free of now."""
        touches = " and ".join(
            f"the {c['first']} would touch the {c['second']} ({1000 * c['depth_m']:.0f} mm deep at {c['time_s']:.1f} s)"
            for c in collisions
        )
        what = f"the whole motion was raised by {100 * self.raised_m:.0f} cm"
        if self.receptacle_moved_m:
            what = f"the receptacle was moved by {100 * self.receptacle_moved_m:.0f} cm"
        note = f"As seen, {touches}; {what}, which frees it. A number for --scale leaves it as seen."
        changed = {
            **self.reference.header.get("changed", {}),
            "contact": {
                "raised_m": self.raised_m,
                "receptacle_moved_m": self.receptacle_moved_m,
                "freed_of": collisions,
            },
        }
        return self.reference.with_header(changed=changed, notes=[*self.reference.notes, note])


def freed_of(collisions: list[dict[str, Any]]) -> set[str]:
    """Which of table and receptacle are touched, if nothing else is; empty otherwise."""
    standing = {"table", "receptacle"}
    met = [standing & {c["first"], c["second"]} for c in collisions]
    return set().union(*met) if all(met) else set()


def nearest_variant(
    reference: Reference,
    contents_kg: float | None,
    payload_kg: float,
    slower: float,
    touched: set[str],
    works: Callable[[Reference, float | None], bool],
) -> Variant | None:
    """The first variant that works, nearest kinds first; None if there is none.

    payload_kg: mass of vessel and contents. slower: how many times slower the motion must be at least. touched:
    `freed_of` the motion's collisions, if they are all that is wrong with it.
    """
    every = _freed(reference, contents_kg, touched) if touched else _slower(reference, contents_kg, slower)
    if payload_kg > PAYLOAD_MAX_KG:
        every = _lighter(reference, contents_kg, payload_kg)
    return next((variant for variant in every if works(variant.reference, variant.contents_kg)), None)


def _lighter(reference: Reference, contents_kg: float | None, payload_kg: float) -> Iterator[Variant]:
    """Less in the vessel: no remedy for anything else, and nothing else for it."""
    left_kg = PAYLOAD_MAX_KG - (payload_kg - (contents_kg or 0.0))
    if contents_kg and left_kg > 0.0:
        light_kg = 0.98 * left_kg
        yield Variant(reference, light_kg, f"With at most {light_kg:.2f} kg in the vessel it can.")


def _freed(reference: Reference, contents_kg: float | None, touched: set[str]) -> Iterator[Variant]:
    """Farther from what is touched, the nearest first, and at last smaller."""
    for far_m in SMALL_M:
        yield from _higher(reference, contents_kg, far_m)
        for name, along, across in _SIDES if "receptacle" in touched else ():
            made = with_receptacle_moved(reference, far_m * along, far_m * across)
            words = f"With the receptacle {100 * far_m:.0f} cm {name}, it can."
            yield Variant(made, contents_kg, words, receptacle_moved_m=far_m)
    yield from _higher(reference, contents_kg, RISES_M[-1])
    yield from _smaller(reference, contents_kg)


def _slower(reference: Reference, contents_kg: float | None, slower: float) -> Iterator[Variant]:
    """Slower, then higher, then smaller."""
    for more in SLOWER:
        slow = reference.stretched(1.03 * slower * more)
        factor = slow.duration_s / reference.duration_s
        words = (
            f"Played {factor:.2f} times slower (--speed {1.0 / factor:.2f}), {slow.duration_s:.1f} s in place of "
            f"{reference.duration_s:.1f} s, it can."
        )
        yield Variant(slow, contents_kg, words)
    for rise_m in RISES_M:
        yield from _higher(reference, contents_kg, rise_m)
    yield from _smaller(reference, contents_kg)


def _higher(reference: Reference, contents_kg: float | None, rise_m: float) -> Iterator[Variant]:
    if (made := _moved(reference, 1.0, rise_m)) is not None:
        yield Variant(made, contents_kg, f"Carried {100 * rise_m:.0f} cm higher, it can.", raised_m=rise_m)


def _smaller(reference: Reference, contents_kg: float | None) -> Iterator[Variant]:
    for factor in FACTORS:
        if (made := _moved(reference, factor, 0.0)) is not None:
            words = f"With the path scaled by {factor:g} about the moment of greatest tilt (--scale), it can."
            yield Variant(made, contents_kg, words)


def _moved(reference: Reference, factor: float, rise_m: float) -> Reference | None:
    """The path scaled about the greatest tilt and lifted, its camera as well; None if the arm cannot begin so."""
    T = reference.T_world_object.copy()
    pour_m, rise = T[reference.pour_index, :3, 3].copy(), np.array([0.0, 0.0, rise_m])
    T[:, :3, 3] = pour_m + factor * (T[:, :3, 3] - pour_m) + rise
    try:
        q_rad = configuration_near(T[0], reference.T_hand_object, reference.q_start_rad)
    except UserError:
        return None
    header = {**reference.header, "q_start_rad": q_rad.tolist()}
    if "T_world_camera" in header:
        T_world_camera = np.array(header["T_world_camera"], float)
        T_world_camera[:3, 3] += rise
        header["T_world_camera"] = T_world_camera.tolist()
    return type(reference).from_poses(T, reference.time_s, header, reference.confidence, reference.video_time_s)
