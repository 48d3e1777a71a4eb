"""Search for where in the robot's workspace a motion is to happen and how the vessel is held.

A motion is rigid: it may be moved over the table and turned about gravity, nothing else. Cheap tests throw out most
combinations of place, yaw and grasp; batched inverse kinematics along a dozen knots ranks the rest; the best few are
followed through every knot and checked for collisions.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..extract.geometry import Array, rotation_angle_rad
from .collision import Collision, CollisionChecker
from .grasps import Grasp, held_grasps
from .jet import filling_kg, tilt_rad
from .kinematics import arm_seeds, limit_margin_rad, manipulability, panda_chain, solve_ik
from .panda import DQ_MAX_RAD_S, Q_HOME_RAD, Q_MAX_RAD, Q_MIN_RAD

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 1e-3, np.deg2rad(0.5)
# Frame 7's origin lies 0.2104 m behind the tcp; from the shoulder it can be at most so far, whatever the joints do.
_TCP_TO_WRIST_M, _WRIST_REACH_M, _WRIST_NEAR_M = 0.2104, 0.79, 0.2
_SHOULDER = np.array([0.0, 0.0, 0.333])
_TABLE_CLEARANCE_M = 0.01
# Height of the wrist joints' origins under which their housings come near the table.
_WRIST_CLEARANCE_M = 0.13
# Where people look for the pour, and cameras are aimed: straight in front, within easy reach.
_CENTRE_M = np.array([0.5, 0.0])
_KNOTS, _SCREENED, _CHAINED = 12, 3000, 1200
_HAND_CORNERS = np.array(list(itertools.product((-0.032, 0.032), (-0.102, 0.102), (-0.14, -0.045))))


@dataclass(frozen=True)
class Stage:
    """A motion over the table, not yet placed: poses with z up and table at z = 0, horizontal place and yaw free.

    T_object: (N, 4, 4); time_s: (N,); T_receptacle: (4, 4) or None.
    """

    T_object: Array
    time_s: Array
    vessel: Vessel
    receptacle: Vessel | None
    T_receptacle: Array | None


@dataclass(frozen=True)
class Placement:
    """T_world_stage: (4, 4) rotation about z and horizontal shift. q_rad: (N, 7) along the whole motion.

    cost: the smaller the better. collisions: those that could not be avoided.
    """

    T_world_stage: Array
    grasp: Grasp
    q_rad: Array
    cost: float
    collisions: list[Collision] = field(default_factory=list)


@dataclass(frozen=True)
class Shortfall:
    """Why nothing fits: the part of the motion (s) that stays out of reach at the best place, and by how far (m)."""

    from_s: float
    to_s: float
    missing_m: float


@dataclass(frozen=True)
class _Batch:
    """M combinations: yaw_rad (M,), xy_m (M, 2), grasp index (M,)."""

    yaw_rad: Array
    xy_m: Array
    grasp: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.yaw_rad)

    def take(self, index: NDArray[np.int64]) -> _Batch:
        return _Batch(self.yaw_rad[index], self.xy_m[index], self.grasp[index])

    def transforms(self) -> Array:
        T = np.tile(np.eye(4), (len(self), 1, 1))
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 3] = self.xy_m
        return T


def search_placement(
    stage: Stage, rng: np.random.Generator, *, thorough: bool = True, grasps: list[Grasp] | None = None
) -> Placement | Shortfall:
    """The best place, yaw and grasp for a motion, or how far the nearest one misses.

    thorough: False stops at the first ranking (is it possible at all?), without refinement and collision checks.
    grasps: to choose among; `held_grasps` of the vessel if None.
    """
    if grasps is None:
        grasps = held_grasps(stage.vessel, filling_kg(stage.vessel, stage.receptacle), stage.T_object)
    knots = _spread_knots(stage.T_object)
    T_object = stage.T_object[knots]
    pour = int(np.argmin(np.abs(knots - int(np.argmax(tilt_rad(stage.T_object))))))
    T_hand = np.einsum("kij,gjl->gkil", T_object, np.stack([g.T_object_hand for g in grasps]))
    batch, shortfall = _screen(stage, T_hand, grasps, knots, rng)
    if len(batch) == 0:
        return shortfall
    index, q = _solve_first(batch, T_hand, pour)
    batch = batch.take(index)
    batch, q, missing = _chain(batch, q, T_hand, pour)
    if len(batch) == 0:
        bad = missing > POSITION_TOLERANCE_M
        times = stage.time_s[knots][bad] if bad.any() else stage.time_s[knots][[pour]]
        return Shortfall(float(times.min()), float(times.max()), float(missing.max()))
    cost = _costs(stage, batch, q, grasps, stage.time_s[knots])
    if thorough:
        batch, q, cost = _refine(stage, batch, q, cost, T_hand, grasps, knots, pour, rng)
    return _best_in_full(stage, batch, q, cost, grasps, tries=24 if thorough else 4, thorough=thorough)


def _spread_knots(T: Array) -> NDArray[np.int64]:
    """Knots evenly spread over the path (1 rad counts as 0.2 m), both ends and the greatest tilt included."""
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) + 0.2 * rotation_angle_rad(
        T[1:, :3, :3], T[:-1, :3, :3]
    )
    length = np.concatenate([[0.0], np.cumsum(step + 1e-9)])
    even = np.searchsorted(length, np.linspace(0.0, length[-1], _KNOTS)).clip(0, len(T) - 1)
    knots = np.unique(np.concatenate([even, [0, len(T) - 1, int(np.argmax(tilt_rad(T)))]]))
    return np.asarray(knots, np.int64)


def _screen(
    stage: Stage, T_hand: Array, grasps: list[Grasp], knots: NDArray[np.int64], rng: np.random.Generator
) -> tuple[_Batch, Shortfall]:
    """Combinations that pass the tests of distance and table, best guesses first; and the nearest miss."""
    yaws = np.arange(16) * (2 * np.pi / 16)
    yaws = np.where(yaws > np.pi, yaws - 2 * np.pi, yaws)
    xs, ys = np.arange(0.3, 0.72, 0.07), np.arange(-0.36, 0.37, 0.09)
    place = np.array(list(itertools.product(xs, ys)))
    corners = T_hand[..., None, :3, :3] @ _HAND_CORNERS[:, :, None] + T_hand[..., None, :3, 3:]
    above = corners[..., 2, 0].min(axis=(1, 2)) > _TABLE_CLEARANCE_M
    usable = np.flatnonzero(above) if above.any() else np.arange(len(grasps))
    wrist = T_hand[usable, :, :3, 3] - _TCP_TO_WRIST_M * T_hand[usable, :, :3, 2]
    anchor = 0.5 * (stage.T_object[:, :2, 3].min(axis=0) + stage.T_object[:, :2, 3].max(axis=0))
    # The path's middle is what stands on the grid, so that yaw turns the motion on the spot.
    c, s = np.cos(yaws), np.sin(yaws)
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
    flat = np.einsum("yij,gkj->ygki", turn, wrist[..., :2] - anchor)
    height2 = (wrist[..., 2] - _SHOULDER[2]) ** 2
    reach = np.empty((len(yaws), len(place), len(usable), wrist.shape[1]))
    for p, xy in enumerate(place):
        reach[:, p] = np.sqrt(((flat + xy) ** 2).sum(-1) + height2)
    path = np.einsum("yij,kj->yki", turn, stage.T_object[knots][:, :2, 3] - anchor)
    near = np.linalg.norm(path[:, None] + place[None, :, None], axis=-1).min(axis=2) < _WRIST_NEAR_M
    far, close = reach.max(axis=3), reach.min(axis=3)
    fits = (far < _WRIST_REACH_M) & (close > _WRIST_NEAR_M) & ~near[:, :, None]
    nearest = np.unravel_index(int(np.argmin(far + 10.0 * near[:, :, None])), far.shape)
    excess = reach[nearest] - _WRIST_REACH_M
    bad = stage.time_s[knots][excess > 0]
    shortfall = Shortfall(
        float(bad.min()) if len(bad) else float(stage.time_s[0]),
        float(bad.max()) if len(bad) else float(stage.time_s[-1]),
        float(max(excess.max(), 0.01)),
    )
    turned, placed, held = np.nonzero(fits)
    liking = np.array([grasps[i].cost for i in usable])[held] + 0.15 * np.abs(yaws[turned]) / np.pi
    xy = place[placed] - np.einsum("mij,j->mi", turn[turned], anchor)
    batch = _Batch(np.asarray(yaws[turned], float), xy, usable[held].astype(np.int64))
    liking += np.abs(far[fits] - 0.6) + 0.3 * rng.random(len(turned))
    liking += np.linalg.norm(_pour_xy_m(stage, batch) - _CENTRE_M, axis=1)
    return batch.take(np.argsort(liking)[:_SCREENED].astype(np.int64)), shortfall


def _targets(batch: _Batch, T_hand: Array, knot: int) -> Array:
    return np.asarray(batch.transforms() @ T_hand[batch.grasp, knot])


def _reached(error: Array, slack: float = 1.0) -> NDArray[np.bool_]:
    return np.asarray(
        (np.linalg.norm(error[:, :3], axis=1) < slack * POSITION_TOLERANCE_M)
        & (np.linalg.norm(error[:, 3:], axis=1) < slack * ROTATION_TOLERANCE_RAD)
    )


def _solve_first(batch: _Batch, T_hand: Array, knot: int) -> tuple[NDArray[np.int64], Array]:
    """Inverse kinematics at one knot from several starts: the most comfortable ones, (index (C,), q (C, 7))."""
    target = _targets(batch, T_hand, knot)
    indices, solutions = [], []
    for seed in arm_seeds(target)[:3]:
        q, error = solve_ik(target, seed, iterations=25, q_rest_rad=Q_HOME_RAD)
        ok = np.flatnonzero(_reached(error, 10.0))
        indices.append(ok)
        solutions.append(q[ok])
    index, q = np.concatenate(indices), np.concatenate(solutions)
    order = np.argsort(-limit_margin_rad(q).min(axis=1))[:_CHAINED]
    return index[order].astype(np.int64), q[order]


def _chain(batch: _Batch, q_pour: Array, T_hand: Array, pour: int) -> tuple[_Batch, Array, Array]:
    """Follow the motion from the pour to both ends: survivors, their q (C, K, 7), the best case's misses (K,) in m."""
    count = T_hand.shape[1]
    q = np.zeros((len(batch), count, 7))
    miss = np.zeros((len(batch), count))
    alive = np.ones(len(batch), bool)
    previous = q_pour
    for knot in [*range(pour, -1, -1), *range(pour + 1, count)]:
        if knot == pour + 1:
            previous = q[:, pour]
        solved, error = solve_ik(_targets(batch, T_hand, knot), previous, iterations=12, q_rest_rad=Q_HOME_RAD)
        q[:, knot] = solved
        miss[:, knot] = np.linalg.norm(error[:, :3], axis=1) + 0.2 * np.linalg.norm(error[:, 3:], axis=1)
        alive &= _reached(error)
        previous = solved
    index = np.flatnonzero(alive)
    best = miss[int(np.argmin(miss.max(axis=1)))] if len(batch) else np.full(count, 0.01)
    return batch.take(index.astype(np.int64)), q[index], best


def _costs(stage: Stage, batch: _Batch, q: Array, grasps: list[Grasp], time_s: Array) -> Array:
    """(C,) how little each solution is liked: limits, singularities and speed first, then looks."""
    count = q.shape[1]
    margin = limit_margin_rad(q).min(axis=(1, 2))
    skill = manipulability(q.reshape(-1, 7)).reshape(-1, count).min(axis=1)
    wrist_m = panda_chain().frames(q.reshape(-1, 7))[:, 4:7, 2, 3].reshape(len(q), -1).min(axis=1)
    speed = (np.abs(np.diff(q, axis=1)) / np.diff(time_s)[:, None] / DQ_MAX_RAD_S).max(axis=(1, 2))
    away = np.mean(((q - Q_HOME_RAD) / (Q_MAX_RAD - Q_MIN_RAD)) ** 2, axis=(1, 2))
    return np.asarray(
        2.0 * np.clip(0.35 - margin, 0, None) / 0.35
        + 1.5 * np.clip(0.06 - skill, 0, None) / 0.06
        + 1.5 * np.clip(_WRIST_CLEARANCE_M - wrist_m, 0, None) / _WRIST_CLEARANCE_M
        + np.clip(speed - 0.5, 0, None)
        + 3.0 * away
        + np.array([grasps[i].cost for i in batch.grasp])
        + 0.15 * np.abs(batch.yaw_rad) / np.pi
        + np.linalg.norm(_pour_xy_m(stage, batch) - _CENTRE_M, axis=1)
    )


def _pour_xy_m(stage: Stage, batch: _Batch) -> Array:
    """(M, 2) where the receptacle, or else the vessel at its greatest tilt, comes to stand."""
    T = stage.T_receptacle
    point = stage.T_object[int(np.argmax(tilt_rad(stage.T_object))), :, 3] if T is None else T[:, 3]
    return np.asarray((batch.transforms() @ point)[:, :2])


def _refine(
    stage: Stage,
    batch: _Batch,
    q: Array,
    cost: Array,
    T_hand: Array,
    grasps: list[Grasp],
    knots: NDArray[np.int64],
    pour: int,
    rng: np.random.Generator,
) -> tuple[_Batch, Array, Array]:
    """Shift and turn the best a little in many ways, twice, and keep all that is reachable."""
    for spread in (1.0, 0.4):
        best = np.argsort(cost)[:12]
        parent = np.repeat(best, 30)
        tried = _Batch(
            batch.yaw_rad[parent] + spread * rng.normal(0, 0.15, len(parent)),
            batch.xy_m[parent] + spread * rng.normal(0, 0.04, (len(parent), 2)),
            batch.grasp[parent],
        )
        tried, q_tried, _ = _chain(tried, q[parent, pour], T_hand, pour)
        cost = np.concatenate([cost, _costs(stage, tried, q_tried, grasps, stage.time_s[knots])])
        q = np.concatenate([q, q_tried])
        batch = _Batch(
            np.concatenate([batch.yaw_rad, tried.yaw_rad]),
            np.concatenate([batch.xy_m, tried.xy_m]),
            np.concatenate([batch.grasp, tried.grasp]),
        )
    return batch, q, cost


def _best_in_full(
    stage: Stage,
    batch: _Batch,
    q: Array,
    cost: Array,
    grasps: list[Grasp],
    *,
    tries: int,
    thorough: bool,
) -> Placement | Shortfall:
    """Follow the best few through every knot; the first without collisions wins, else the least colliding."""
    chosen_index = _diverse(batch, cost, tries)
    chosen = batch.take(chosen_index)
    T_stage, T_object_hand = chosen.transforms(), np.stack([grasps[g].T_object_hand for g in chosen.grasp])
    # From the start on as `retarget` will go: near the start posture.
    stride = 1 if thorough else 4
    time_s, T_object = stage.time_s[::stride], stage.T_object[::stride]
    q_start, _ = solve_ik(T_stage @ T_object[0] @ T_object_hand, q[chosen_index, 0], iterations=10, damping=0.005)
    q_full, miss = follow(T_stage, T_object, T_object_hand, q_start)
    full_cost = _costs(stage, chosen, q_full, grasps, time_s)
    reached = miss.max(axis=1) < POSITION_TOLERANCE_M + 0.2 * ROTATION_TOLERANCE_RAD
    fallback: Placement | None = None
    for rank in [int(i) for i in np.argsort(full_cost) if reached[i]]:
        grasp, T = grasps[chosen.grasp[rank]], T_stage[rank]
        collisions: list[Collision] = []
        if thorough:
            T_receptacle = None if stage.T_receptacle is None else T @ stage.T_receptacle
            checker = CollisionChecker(stage.vessel, grasp.T_hand_object, grasp.width_m, stage.receptacle, T_receptacle)
            collisions = checker.check(q_full[rank], every=max(1, len(stage.time_s) // 40))
        found = Placement(T, grasp, q_full[rank], float(full_cost[rank]), collisions)
        if not collisions:
            return found
        if fallback is None or _depth(found) < _depth(fallback):
            fallback = found
    if fallback is not None:
        return fallback
    worst = miss[int(np.argmin(miss.max(axis=1)))]
    bad = time_s[worst > POSITION_TOLERANCE_M]
    return Shortfall(float(bad.min()), float(bad.max()), float(worst.max()))


def _depth(placement: Placement) -> float:
    return sum(c.depth_m for c in placement.collisions)


def _diverse(batch: _Batch, cost: Array, count: int) -> NDArray[np.int64]:
    """The cheapest, at most three of one grasp: near twins would all collide alike."""
    kept: list[int] = []
    of_grasp: dict[int, int] = {}
    for i in np.argsort(cost):
        grasp = int(batch.grasp[i])
        if of_grasp.get(grasp, 0) < 3:
            of_grasp[grasp] = of_grasp.get(grasp, 0) + 1
            kept.append(int(i))
        if len(kept) == count:
            break
    return np.array(kept, np.int64)


def follow(T_world_stage: Array, T_object: Array, T_object_hand: Array, q_start_rad: Array) -> tuple[Array, Array]:
    """Joint motions (C, N, 7) of C placements through every knot, from q (C, 7), the redundancy drawing back there.

    T_world_stage, T_object_hand: (C, 4, 4); T_object: (N, 4, 4). Also returns the misses (C, N) in m, 1 rad of rotation
    counting as 0.2 m.
    """
    q = np.zeros((len(q_start_rad), len(T_object), 7))
    miss = np.zeros(q.shape[:2])
    previous = q_start_rad
    for k, T in enumerate(T_object):
        previous, error = solve_ik(
            T_world_stage @ T @ T_object_hand,
            previous,
            iterations=3,
            q_rest_rad=q_start_rad,
            rest_gain=1.0,
            damping=0.01,
        )
        q[:, k] = previous
        miss[:, k] = np.linalg.norm(error[:, :3], axis=1) + 0.2 * np.linalg.norm(error[:, 3:], axis=1)
    return q, miss
