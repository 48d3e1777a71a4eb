"""How a vessel is turned about its own axis and leans in depth, found from the whole clip at once.

A vessel's body hardly shows its spin; only handle, spout or lip do, and a hand often hides those. And whether a body
leans toward the camera or away from it changes its outline by perspective alone: the pose mirrored in depth looks
nearly the same. Frame by frame both are a guess that drifts. Here every spin of the pose and of its mirror image is
scored in many frames by how well its silhouette covers what is object-coloured and by the image edges along its
outline and its inner contours, and dynamic programming picks the turns that explain all frames while changing little
between them (Viterbi, 1967).
"""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from .colours import ColourModel
from .geometry import Array
from .region import TrackingMesh
from .region_kernels import look_up

SPINS = 36
STEP_RAD = 2 * np.pi / SPINS
EVIDENCE_RANGE = (-1.0, 2.0)  # log-odds; skin over a handle must not outvote the frames that show the handle
SURELY_OURS = 2.0  # times as likely the object's colours as those of a hand: what stands there is not the hand
HIDDEN_EVIDENCE = 0.3  # where something hides what is there: hands hold vessels by what sticks out
SPIN_RAD = 2 * np.pi * np.minimum(np.arange(SPINS), SPINS - np.arange(SPINS)) / SPINS  # from none
TURN_COST = 0.035  # of a change by one step between neighbouring samples, in mean log-odds over the object's area
MOST_STEPS = 6  # a change by more costs no more: hands may be quick
SPIN_COST, MOST_SPIN_STEPS = 0.07, 9  # of a spin by one step about the own axis between them: hands seldom do that
TOLD_COST = 0.5  # of a change by one step, however large, where the spin between two samples was told
OUTER_WEIGHT, INNER_WEIGHT = 0.3, 0.15  # of edges along the outline and inside it, against the colours
EXPECTED = 0.5  # edge along a right inner contour, least: less speaks against it
JUMP = 0.08  # of the mesh's radius, in depth, that makes an inner contour


def object_evidence(bins: NDArray[np.int32], colours: ColourModel) -> NDArray[np.float32]:
    """(H, W) log-odds, by colour alone, that a pixel shows the object."""
    odds = np.log((colours.foreground[-1] + 1e-5) / (colours.background[-1] + 1e-5))
    evidence = np.empty(bins.shape, np.float32)
    look_up(np.clip(odds, *EVIDENCE_RANGE), bins, evidence)
    return evidence


def turn_scores(
    mesh: TrackingMesh,
    T: Array,
    camera_matrix: Array,
    evidence: NDArray[np.float32],
    edges: NDArray[np.float32] | None = None,
    axis_xy_m: tuple[float, float] = (0.0, 0.0),
    within_rad: float = np.pi,
) -> Array:
    """(2, SPINS) how well every spin of a pose, and of its mirror image in depth, explains a picture.

    evidence: (H, W) from `object_evidence`.  edges: (H, W) strength of image edges near each pixel, in [0, 1],
    negative where something hides what is there.
    All are divided by one area, so that covering more of the object's colours counts.
    within_rad: no spin is farther than this from none, and nothing is mirrored when it is less than half a turn: what
    is left out is -inf.
    """
    strength = np.zeros((0, 0), np.float32) if edges is None else edges
    sums = np.zeros((2, SPINS, 6))
    asked = np.broadcast_to(within_rad + 1e-9 >= SPIN_RAD, (2, SPINS)).copy()
    asked[1] &= within_rad >= np.pi
    for m, pose in enumerate((T, mirrored(T))):
        for k in np.flatnonzero(asked[m]):
            at = spun(pose, 2 * np.pi * k / SPINS, axis_xy_m)
            window = mesh.drawn(at, camera_matrix)
            if window is not None:
                jump_m = JUMP * mesh.radius_m
                _sum_up(window.depth_m, window.x0_px, window.y0_px, evidence, strength, jump_m, sums[m, k])
    covered, area, outer, rim, inner, contour = np.moveaxis(sums, -1, 0)
    rim = np.maximum(rim, 1.0)
    edge = OUTER_WEIGHT * outer / rim + INNER_WEIGHT * (inner - EXPECTED * contour) / rim
    scores = covered / max(float(area[asked].mean()), 1.0) + (0.0 if edges is None else edge)
    return np.where(asked, scores, -np.inf)


def best_turns(T: Array, scores: Array, told: NDArray[np.bool_] | None = None) -> Array:
    """(M, 3, 3) turns to apply to M poses, in each one's object frame, that maximise the scores less the changing.

    T: (M, 4, 4).  scores: (M, 2, SPINS) from `turn_scores`.  told: (M,) whether the poses are known to turn rightly
    from each one's predecessor to it.
    """
    spins = Rotation.from_rotvec([[0.0, 0.0, 2 * np.pi * k / SPINS] for k in range(SPINS)]).as_matrix()
    plain = np.broadcast_to(spins, (len(T), SPINS, 3, 3))
    flips = np.stack([pose[:3, :3].T @ mirrored(pose)[:3, :3] for pose in T])
    turns = np.concatenate([plain, np.einsum("mij,kjl->mkil", flips, spins)], axis=1)
    scores = scores.reshape(len(T), -1)
    stand = T[:, None, :3, :3] @ turns
    total, back = scores[0].copy(), np.zeros(scores.shape, int)
    for m in range(1, len(scores)):
        steps = _angles_rad(turns[m], turns[m - 1]) / STEP_RAD
        if told is not None and told[m]:
            cost = TOLD_COST * steps**2
        else:
            leant_rad = np.arccos(np.clip(stand[m][:, :, 2] @ stand[m - 1][:, :, 2].T, -1, 1))
            spin_rad = np.sqrt(np.maximum(_angles_rad(stand[m], stand[m - 1]) ** 2 - leant_rad**2, 0.0))
            cost = TURN_COST * np.minimum(steps, MOST_STEPS) ** 2
            cost += SPIN_COST * np.minimum(spin_rad / STEP_RAD, MOST_SPIN_STEPS) ** 2
        options = total[None, :] - cost
        back[m] = np.argmax(options, axis=1)
        total = scores[m] + np.max(options, axis=1)
    path = [int(np.argmax(total))]
    for m in range(len(scores) - 1, 0, -1):
        path.append(int(back[m][path[-1]]))
    return np.asarray(turns[np.arange(len(T)), path[::-1]])


def _angles_rad(one: Array, other: Array) -> Array:
    """(I, J) angles between rotations (I, 3, 3) and (J, 3, 3)."""
    return np.asarray(np.arccos(np.clip((np.einsum("iab,jab->ij", one, other) - 1) / 2, -1, 1)))


def turned(T: Array, at: NDArray[np.int_], turns: Array, axis_xy_m: tuple[float, float] = (0.0, 0.0)) -> Array:
    """The poses (N, 4, 4) with turns (M, 3, 3), known at frames `at` (M,), applied where they are and in between."""
    frames = np.clip(np.arange(len(T)), at[0], at[-1])
    every = Rotation.from_matrix(turns)[np.zeros(len(T), int)] if len(at) < 2 else Slerp(
        at, Rotation.from_matrix(turns)
    )(frames)  # fmt: skip
    out = T.copy()
    out[:, :3, :3] = T[:, :3, :3] @ every.as_matrix()
    # The body stays where it is: a vessel's body stands on its axis, not on the centre of its bounding box, which
    # handle and spout shift.
    out[:, :3, 3] += (T[:, :3, :3] - out[:, :3, :3]) @ np.array([*axis_xy_m, 0.0])
    return out


def mirrored(T: Array) -> Array:
    """The pose that looks the same but for perspective: mirrored in depth, of an object that is its own mirror in y."""
    ray = T[:3, 3] / np.linalg.norm(T[:3, 3])
    out = T.copy()
    out[:3, :3] = (np.eye(3) - 2 * np.outer(ray, ray)) @ T[:3, :3] @ np.diag([1.0, -1.0, 1.0])
    return out


def spun(T: Array, angle_rad: float, axis_xy_m: tuple[float, float] = (0.0, 0.0)) -> Array:
    """The pose with the object turned about the line through `axis_xy_m` along its own +z."""
    out = T.copy()
    out[:3, :3] = T[:3, :3] @ _spin(angle_rad)
    out[:3, 3] += (T[:3, :3] - out[:3, :3]) @ np.array([*axis_xy_m, 0.0])
    return out


@lru_cache(maxsize=2 * SPINS)
def _spin(angle_rad: float) -> Array:
    return np.asarray(Rotation.from_rotvec([0.0, 0.0, angle_rad]).as_matrix())


@numba.njit(cache=True)
def _sum_up(
    depth: NDArray[np.float32], x0: int, y0: int, evidence: NDArray[np.float32], edges: NDArray[np.float32],
    jump_m: float, sums: Array,
) -> None:  # fmt: skip
    """Into sums (6,): evidence and area of a silhouette, edge and length of its outline, and of the jumps inside it."""
    h, w = depth.shape
    with_edges = edges.shape[0] > 0
    covered, area, outer, rim, inner, contour = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for y in range(max(1, -y0), min(h - 1, evidence.shape[0] - y0)):
        for x in range(max(1, -x0), min(w - 1, evidence.shape[1] - x0)):
            d = depth[y, x]
            if d == 0.0:
                continue
            v, u = y + y0, x + x0
            covered += evidence[v, u]
            area += 1.0
            if not with_edges or edges[v, u] < 0.0:
                continue
            north, south, west, east = depth[y - 1, x], depth[y + 1, x], depth[y, x - 1], depth[y, x + 1]
            if min(min(north, south), min(west, east)) == 0.0:
                outer += edges[v, u]
                rim += 1.0
            elif max(max(north, south), max(west, east)) > d + jump_m:
                inner += edges[v, u]
                contour += 1.0
    sums[:] = covered, area, outer, rim, inner, contour
