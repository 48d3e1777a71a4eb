"""`--scale auto`: which size of the path, place of the receptacle and tilt pours most and spills least.

FreePose scales trajectories by hand and suggests what Zorina et al. do: let the simulator decide. The faithful motion
is tried first and kept if it pours well. What spills is met by moving the receptacle along and across the pour, then by
a smaller path about its greatest tilt; what stays in the vessel, as grains do where water would run, by tipping it
further about its outlet. A search along coordinates of bounded length, each try a whole pour with the fast liquid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..envs.diverged import PhysicsError
from ..envs.reference import Reference
from ..extract.errors import UserError
from ..extract.geometry import Array
from ..extract.progress import Progress
from .check_trajectory import check
from .collisions import collisions_of
from .export import commands_of
from .impedance import ImpedancePlayer
from .joints import JointTrajectory
from .retarget import retarget
from .rollout import DEFAULT_ENV_ID, make_env, roll_out

# Poured minus spilled fraction with which nothing more is asked for, and spilled fraction that calls for a remedy.
ENOUGH, SPILLS = 0.95, 0.02
# A change of the motion must be worth more than the luck of single particles.
WORTH = 0.05
OFFSETS_M = ((0.02, 0.0), (-0.02, 0.0), (0.04, 0.0), (-0.04, 0.0), (0.0, 0.02), (0.0, -0.02))
FACTORS = (0.85, 0.7)
TIPS_DEG = (10.0, 20.0, 30.0)
PARTICLES = 60
_LOST_M = 0.03


@dataclass(frozen=True)
class Change:
    """scale: of the path. along_m, across_m: of the receptacle, seen along the pour. tip_deg: at the greatest tilt."""

    scale: float = 1.0
    along_m: float = 0.0
    across_m: float = 0.0
    tip_deg: float = 0.0


@dataclass(frozen=True)
class Try:
    """A change of the faithful motion and what came of it: fractions, and poured minus spilled, -1 if it cannot be."""

    change: Change
    reference: Reference
    poured: float
    spilled: float
    score: float


def search_scale(
    faithful: Reference, at_scale: Callable[[float], Reference], progress: Progress | None = None
) -> Reference:
    """The reference that pours best among the tries; the faithful one unless another is better by 5 points.

    at_scale: builds the reference at another scale, and may raise UserError where that does not fit. All tries stand in
    the header's `scale_search` in their order, and a note says what was changed for what.
    """
    if not faithful.header.get("vessel") or not faithful.has_receptacle:
        return faithful
    references = {faithful.scale: faithful}
    tries: list[Try] = []
    # Every question looks at the best so far, so what helps one ill is kept while the next is met.
    for change in _changes(tries, faithful.scale):
        try:
            if change.scale not in references:
                references[change.scale] = at_scale(change.scale)
        except UserError:
            continue
        tries.append(_attempt(references[change.scale], change, faithful=not tries))
        if progress is not None:
            progress(len(tries), 1 + len(OFFSETS_M) + len(FACTORS) + len(TIPS_DEG), "pours tried")
    first, chosen = tries[0], _best(tries)
    if chosen.score < first.score + WORTH:
        chosen = first
    notes = list(chosen.reference.notes)
    if chosen is not first:
        notes.append(_sentence(first, chosen, len(tries)))
    told = [
        asdict(t.change) | {"poured": t.poured, "spilled": t.spilled, "score": t.score, "chosen": t is chosen}
        for t in tries
    ]
    return chosen.reference.with_header(notes=notes, scale_search=told)


def _best(tries: list[Try]) -> Try:
    return max(tries, key=lambda made: made.score)


def _changes(tries: list[Try], scale: float) -> Iterator[Change]:
    """What to try next, given what has been tried meanwhile."""
    yield Change(scale)

    def spills() -> bool:
        return _best(tries).score < ENOUGH and _best(tries).spilled > SPILLS

    for along_m, across_m in OFFSETS_M:
        if spills():
            yield Change(scale, along_m, across_m)
    for factor in FACTORS:
        if spills():
            yield replace(_best(tries).change, scale=factor * scale)
    for tip_deg in TIPS_DEG:
        best = _best(tries)
        if best.score < ENOUGH and best.poured + best.spilled < ENOUGH:
            yield replace(best.change, tip_deg=tip_deg)
            if tries[-1].score < best.score:  # where nothing flows yet, more may be needed
                break


def _attempt(reference: Reference, change: Change, *, faithful: bool) -> Try:
    changed = with_receptacle_moved(tipped_further(reference, change.tip_deg), change.along_m, change.across_m)
    try:
        joints = retarget(changed)
        if faithful or (check(commands_of(joints))["ok"] and not collisions_of(changed, joints.q_rad)):
            poured, spilled = pour(changed, joints)
            return Try(change, changed, poured, spilled, poured - spilled)
    except (UserError, PhysicsError):
        pass
    return Try(change, changed, 0.0, 0.0, -1.0)


def pour(reference: Reference, joints: JointTrajectory) -> tuple[float, float]:
    """Poured and spilled fraction of a simulated pour. Raises UserError when the arm ran into something on the way."""
    env = make_env(
        DEFAULT_ENV_ID,
        reference,
        num_particles=PARTICLES,
        control_hz=reference.control_hz,
        control_mode="joint_position",
        liquid={"solver": "fast"},
    )
    try:
        told = roll_out(env, ImpedancePlayer(joints), seed=0).summary
    finally:
        env.close()
    if told["position_error_max_m"] > _LOST_M:
        raise UserError(f"the arm is held up by {100 * told['position_error_max_m']:.0f} cm")
    return float(told["poured_fraction"]), float(told["spilled_fraction"])


def tipped_further(reference: Reference, tip_deg: float) -> Reference:
    """The vessel tilted further at every moment, by `tip_deg` at its greatest tilt; its outlet stays where it was."""
    if tip_deg == 0.0:
        return reference
    T, tilt_rad = np.array(reference.T_world_object), reference.tilt_rad
    outlet_m = np.asarray(reference.vessel().outlet.point_m)
    where_m = T[:, :3, :3] @ outlet_m + T[:, :3, 3]
    # About the level axis about which it already leans; proportional to the tilt, so that it begins and ends smoothly.
    lean = np.column_stack([-T[:, 1, 2], T[:, 0, 2], np.zeros(len(T))])
    axis = lean / np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
    turn = Rotation.from_rotvec(axis * (np.deg2rad(tip_deg) * tilt_rad / tilt_rad.max())[:, None])
    T[:, :3, :3] = turn.as_matrix() @ T[:, :3, :3]
    T[:, :3, 3] = where_m - T[:, :3, :3] @ outlet_m
    return Reference.from_poses(T, reference.time_s, reference.header, reference.confidence, reference.video_time_s)


def with_receptacle_moved(reference: Reference, along_m: float, across_m: float) -> Reference:
    """The receptacle elsewhere, in the direction in which the vessel leans when it pours, and to the left of that."""
    if along_m == across_m == 0.0:
        return reference
    lean: Array = reference.T_world_object[reference.pour_index, :2, 2]
    along = lean / max(float(np.linalg.norm(lean)), 1e-9)
    T = reference.T_world_receptacle.copy()
    T[:2, 3] += along_m * along + across_m * np.array([-along[1], along[0]])
    return reference.with_header(receptacle={**reference.header["receptacle"], "T_world_receptacle": T.tolist()})


def _sentence(first: Try, chosen: Try, count: int) -> str:
    changes, made = [], chosen.change
    if made.scale != first.change.scale:
        changes.append(f"the path scaled by {made.scale:.2f}")
    if made.along_m or made.across_m:
        changes.append(f"the receptacle moved by {100 * float(np.hypot(made.along_m, made.across_m)):.0f} cm")
    if made.tip_deg:
        changes.append(f"the vessel tipped {made.tip_deg:.0f} degrees further")
    return (
        f"In the simulator the faithful motion pours {100 * first.poured:.0f}% and spills {100 * first.spilled:.0f}%; "
        f"of {count} tries the best is with {' and '.join(changes)}: {100 * chosen.poured:.0f}% and "
        f"{100 * chosen.spilled:.0f}%."
    )
