"""`--scale auto`: which size of the path, place of the receptacle and tilt pours most and spills least.

FreePose scales trajectories by hand and suggests what Zorina et al. do: let the simulator decide. The faithful motion
is tried first and kept if it pours well. What spills is met by moving the receptacle along and across the pour, then by
a grid of smaller paths about the greatest tilt and the same places; what stays in the vessel, as grains do where water
would run, by tipping it further about its outlet. What one of these asks is poured at once in a vector environment,
with the fast liquid; at most 24 pours, and the same ones whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
from .rollout import DEFAULT_ENV_ID

# Poured minus spilled fraction with which nothing more is asked for, and spilled fraction that calls for a remedy.
ENOUGH, SPILLS = 0.95, 0.02
# A change of the motion must be worth more than the luck of single particles.
WORTH = 0.05
OFFSETS_M = ((0.02, 0.0), (-0.02, 0.0), (0.04, 0.0), (-0.04, 0.0), (0.0, 0.02), (0.0, -0.02))
FACTORS = (0.85, 0.7)
TIPS_DEG = (10.0, 20.0, 30.0)
MOST_TRIES = 1 + len(OFFSETS_M) + len(FACTORS) * (1 + len(OFFSETS_M)) + len(TIPS_DEG)
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
    faithful: Reference,
    at_scale: Callable[[float], Reference],
    progress: Progress | None = None,
    *,
    num_threads: int | None = None,
) -> Reference:
    """The reference that pours best among the tries; the faithful one unless another is better by 5 points.

    at_scale: builds the reference at another scale, and may raise UserError where that does not fit. num_threads: how
    many pours are simulated at a time; None takes one per processor. All tries stand in the header's `scale_search` in
    their order, and a note says what was changed for what.
    """
    if not faithful.header.get("vessel") or not faithful.has_receptacle:
        return faithful
    motions = _Motions(faithful, at_scale)
    tries: list[Try] = []
    # Every question looks at the best so far, so what helps one ill is kept while the next is met.
    for changes in _questions(tries, faithful.scale):
        tries += _attempts(motions, changes, num_threads)
        if progress is not None:
            progress(len(tries), MOST_TRIES, "pours tried")
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


def _questions(tries: list[Try], scale: float) -> Iterator[list[Change]]:
    """What to try next, side by side, given what has been tried meanwhile."""
    yield [Change(scale)]

    def spills() -> bool:
        return _best(tries).score < ENOUGH and _best(tries).spilled > SPILLS

    if spills():
        yield [Change(scale, *offset_m) for offset_m in OFFSETS_M]
    if spills():
        yield [Change(factor * scale, *offset_m) for factor in FACTORS for offset_m in ((0.0, 0.0), *OFFSETS_M)]
    best = _best(tries)
    if best.score < ENOUGH and best.poured + best.spilled < ENOUGH:
        yield [replace(best.change, tip_deg=tip_deg) for tip_deg in TIPS_DEG]


class _Motions:
    """The motions of a search, each solved when first asked for: where the receptacle stands changes none of them."""

    def __init__(self, faithful: Reference, at_scale: Callable[[float], Reference]) -> None:
        self.faithful, self._at_scale = faithful, at_scale
        self._references: dict[float, Reference | None] = {faithful.scale: faithful}
        self._joints: dict[tuple[float, float], JointTrajectory | None] = {}

    def changed(self, change: Change) -> Reference | None:
        """The changed reference, or None where no such motion could be placed."""
        if change.scale not in self._references:
            self._references[change.scale] = _or_none(lambda: self._at_scale(change.scale))
        reference = self._references[change.scale]
        if reference is None:
            return None
        return with_receptacle_moved(tipped_further(reference, change.tip_deg), change.along_m, change.across_m)

    def joints(self, change: Change, changed: Reference) -> JointTrajectory | None:
        """Its joint motion, or None where the arm cannot follow it."""
        key = (change.scale, change.tip_deg)
        if key not in self._joints:
            self._joints[key] = _or_none(lambda: retarget(changed))
        return self._joints[key]


def _or_none[T](make: Callable[[], T]) -> T | None:
    try:
        return make()
    except UserError:
        return None


def _attempts(motions: _Motions, changes: list[Change], num_threads: int | None) -> list[Try]:
    """What came of the changes whose motion could be placed."""
    placed = [(change, changed) for change in changes if (changed := motions.changed(change)) is not None]
    played: dict[Change, tuple[Reference, JointTrajectory]] = {}
    for change, changed in placed:
        joints = motions.joints(change, changed)
        # A changed motion must be one that the arm can do; whether the faithful one is, the report says.
        if joints is not None and (changed is motions.faithful or _is_feasible(changed, joints)):
            played[change] = (changed, joints)
    fractions = dict(zip(played, pours(list(played.values()), num_threads), strict=True))
    return [Try(change, changed, *_scored(fractions.get(change))) for change, changed in placed]


def _is_feasible(reference: Reference, joints: JointTrajectory) -> bool:
    return bool(check(commands_of(joints))["ok"]) and not collisions_of(reference, joints.q_rad)


def _scored(fractions: tuple[float, float] | None) -> tuple[float, float, float]:
    return (0.0, 0.0, -1.0) if fractions is None else (*fractions, fractions[0] - fractions[1])


def pours(
    motions: Sequence[tuple[Reference, JointTrajectory]], num_threads: int | None = None
) -> list[tuple[float, float] | None]:
    """Poured and spilled fraction of each motion, simulated side by side; None where the arm ran into something."""
    if not motions:
        return []
    try:
        return _poured_together(motions, num_threads)
    except PhysicsError:
        # One that diverges leaves the others out of step.
        return [None] if len(motions) == 1 else [pours([motion], num_threads)[0] for motion in motions]


def _poured_together(
    motions: Sequence[tuple[Reference, JointTrajectory]], num_threads: int | None
) -> list[tuple[float, float] | None]:
    import gymnasium

    envs = gymnasium.make_vec(
        DEFAULT_ENV_ID,
        len(motions),
        "vector_entry_point",
        reference=[reference for reference, _ in motions],
        num_threads=num_threads,
        num_particles=PARTICLES,
        control_hz=motions[0][0].control_hz,
        control_mode="joint_position",
        liquid={"solver": "fast"},
    )
    try:
        observations, infos = envs.reset(seed=0)
        players = [ImpedancePlayer(joints) for _, joints in motions]
        for player, env in zip(players, envs.unwrapped.envs, strict=True):  # type: ignore[attr-defined]
            player.reset(env, {}, {})
        running = np.ones(len(motions), bool)
        furthest_m, poured, spilled = (np.zeros(len(motions)) for _ in range(3))
        while running.any():
            actions = np.stack(
                [player.act({"agent_pos": q}) for player, q in zip(players, observations["agent_pos"], strict=True)]
            )
            observations, _, terminated, truncated, infos = envs.step(actions)
            # Those that have ended begin again beside the longer ones; that tells nothing.
            furthest_m[running] = np.maximum(furthest_m, infos["position_error_m"])[running]
            poured[running], spilled[running] = (infos[f"{what}_fraction"][running] for what in ("poured", "spilled"))
            running &= ~(terminated | truncated)
    finally:
        envs.close()
    return [
        (float(into), float(beside)) if off_m <= _LOST_M else None
        for into, beside, off_m in zip(poured, spilled, furthest_m, strict=True)
    ]


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
    size = float(np.linalg.norm(lean))
    along = lean / size if size > 1e-6 else np.array([1.0, 0.0])
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
