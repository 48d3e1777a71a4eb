"""Poses through a video refined by point tracks (FreePose, section 3.3): points on the mesh, followed, solved by PnP.

At a key frame the visible surface of the posed mesh gives the object's points their place on it. They are followed
through some frames, and in each of these the pose is what PnP with RANSAC makes of them. The last frame is the next key
frame, so that what turns into view is followed too. The first key frame is the one whose own pose is surest; from there
it goes both ways.

PnP's poses are steady, but what they have lost at one key frame they lose for good, above all distances, which the
points of a small object hardly tell. So they are taken as they are, or with the translations of single frames, as the
paper's authors do, or freed from what they drift by against single frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from .geometry import Array, Symmetry, invert_pose, make_pose, project, transform_points
from .protocols import Image, Mask, PointTracker
from .region import TrackingMesh

Translation = Literal["coarse", "pnp", "fused"]
INTERVAL = 30  # frames from one key frame to the next, most: the longer, the less is chained
MOST_POINTS, LEAST_POINTS = 200, 8
SPACING = 0.03  # of the object's size in the picture, between points
INSET = 0.04  # likewise, from its outline: points there are the background's
RANSAC_PX, RANSAC_TRIES, RANSAC_SURE = 2.0, 300, 0.9999
SLOW = 10.0  # jitter of single frames over a step of the drift that they are taken to show
ROUNDS = 15


@dataclass(frozen=True)
class Seen:
    """One frame: its picture (H, W, 3) and where the object shows in it, (H, W)."""

    rgb: Image
    mask: Mask


Frames = Callable[[int], Iterable[Seen]]
"""From an index: the frames from there to the end (index >= 0), or, of ~index, from there back to the first."""


@dataclass(frozen=True)
class Refined:
    """T_camera_object: (N, 4, 4), by PnP.  share: (N,) of the points that agree, 0 where the pose is not PnP's."""

    T_camera_object: Array
    share: Array


def refine(
    frames: Frames,
    coarse: Array,
    key: int,
    mesh: TrackingMesh,
    camera_matrix: Array,
    tracker: PointTracker,
    interval: int = INTERVAL,
) -> Refined:
    """Poses by PnP of points followed from a key frame to both ends of a clip.

    coarse: (N, 4, 4) poses of single frames; that of the key frame is believed.  camera_matrix: of the frames.
    Where too few points can be followed, the pose moves on as the coarse ones do.
    """
    T, share = np.array(coarse, float), np.zeros(len(coarse))
    share[key] = 1.0
    for step in (1, -1):
        at = key
        for piece in _pieces(frames(key if step > 0 else ~key), interval):
            poses, shares = _followed(piece, T[at], coarse[at::step][: len(piece)], mesh, camera_matrix, tracker)
            reached = slice(at + step, at + step * len(piece) if at + step * len(piece) >= 0 else None, step)
            T[reached], share[reached] = poses[1:], shares[1:]
            at += step * (len(piece) - 1)
    return Refined(T, share)


def _pieces(frames: Iterable[Seen], interval: int) -> Iterator[list[Seen]]:
    """Pieces of `interval` steps; each begins with the last frame of the one before."""
    piece: list[Seen] = []
    for frame in frames:
        piece.append(frame)
        if len(piece) > interval:
            yield piece
            piece = piece[-1:]
    if len(piece) > 1:
        yield piece


def _followed(
    piece: list[Seen], T_key: Array, coarse: Array, mesh: TrackingMesh, camera_matrix: Array, tracker: PointTracker
) -> tuple[Array, Array]:
    """(K, 4, 4) poses of a piece from that of its first frame, and (K,) shares of points that agree."""
    pixels, points = lifted_points(piece[0], T_key, mesh, camera_matrix)
    poses, share = [T_key], np.zeros(len(piece))
    tracks = tracker.track(
        np.stack([seen.rgb for seen in piece]), np.zeros(len(pixels), np.int64), pixels.astype(np.float32)
    )
    for k in range(1, len(piece)):
        shown = tracks.visible[k] & _on(piece[k].mask, tracks.pixels_px[k])
        found = solve_pose(points[shown], tracks.pixels_px[k][shown], camera_matrix, poses[-1])
        if found is None:
            moved = coarse[k] @ invert_pose(coarse[k - 1]) @ poses[-1]
            # Turns as single frames have them, at the place they say: small steps of theirs are mostly noise.
            poses.append(make_pose(moved[:3, :3], coarse[k][:3, 3]))
            continue
        poses.append(found[0])
        share[k] = found[1] / len(points)
    return np.stack(poses), share


def lifted_points(seen: Seen, T: Array, mesh: TrackingMesh, camera_matrix: Array) -> tuple[Array, Array]:
    """Corners of the picture on the posed mesh: (P, 2) pixels, and (P, 3) where on the mesh they are, object frame."""
    height, width = seen.mask.shape
    window = mesh.drawn(T, camera_matrix)
    nothing = np.zeros((0, 2)), np.zeros((0, 3))
    if window is None:
        return nothing
    depth = window.depth_in_image(width, height)
    size_px = float(np.sqrt(max(np.count_nonzero(depth), 1)))
    reach = 1 + 2 * max(1, round(INSET * size_px))
    inside = cv2.erode(((depth > 0) & seen.mask).astype(np.uint8), np.ones((reach, reach), np.uint8))
    grey = cv2.cvtColor(seen.rgb, cv2.COLOR_RGB2GRAY)
    spacing_px = max(2.0, SPACING * size_px)
    corners: Any = cv2.goodFeaturesToTrack(grey, MOST_POINTS, 1e-3, spacing_px, mask=inside, blockSize=5)
    if corners is None:
        return nothing
    pixels = np.round(corners[:, 0]).astype(int)
    z = depth[pixels[:, 1], pixels[:, 0]].astype(float)
    rays = np.linalg.solve(camera_matrix, np.column_stack([pixels, np.ones(len(pixels))]).T).T
    return pixels.astype(float), transform_points(invert_pose(T), rays * z[:, None])


def solve_pose(points_m: Array, pixels: Array, camera_matrix: Array, guess: Array) -> tuple[Array, int] | None:
    """(4, 4) pose of points (P, 3) seen at pixels (P, 2), by RANSAC and refined on those that agree, and their count.

    None when too few agree. guess: a pose near it, which wins where the points leave two, as flat ones do.
    """
    if len(points_m) < LEAST_POINTS:
        return None
    points, seen = np.ascontiguousarray(points_m, float), np.ascontiguousarray(pixels, float)
    best: tuple[float, Array, NDArray[np.bool_]] | None = None
    for T in (guess, _by_ransac(points, seen, camera_matrix)):
        if T is None:
            continue
        T = _polished(points, seen, camera_matrix, T)
        cost, agree = _cost(points, seen, camera_matrix, T)
        if best is None or cost < 0.9 * best[0]:
            best = cost, T, agree
    if best is None or np.count_nonzero(best[2]) < LEAST_POINTS:
        return None
    return best[1], int(np.count_nonzero(best[2]))


def _by_ransac(points: Array, seen: Array, camera_matrix: Array) -> Array | None:
    good, turn, t, _ = cv2.solvePnPRansac(
        points, seen, camera_matrix, None, iterationsCount=RANSAC_TRIES, reprojectionError=RANSAC_PX,
        confidence=RANSAC_SURE, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    return _pose(turn, t) if good and t[2, 0] > 0 else None


def _polished(points: Array, seen: Array, camera_matrix: Array, T: Array) -> Array:
    """Least squares over the points that agree, twice, since others agree after the first time."""
    for _ in range(2):
        _, agree = _cost(points, seen, camera_matrix, T)
        if np.count_nonzero(agree) < LEAST_POINTS:
            break
        turn, t = Rotation.from_matrix(T[:3, :3]).as_rotvec()[:, None], T[:3, 3:].copy()
        T = _pose(*cv2.solvePnPRefineLM(points[agree], seen[agree], camera_matrix, None, turn, t))
    return T


def _cost(points: Array, seen: Array, camera_matrix: Array, T: Array) -> tuple[float, NDArray[np.bool_]]:
    """Sum of square errors, each at most what RANSAC bears, and the points (P,) within that."""
    placed = transform_points(T, points)
    if placed[:, 2].min() < 1e-6:
        return np.inf, np.zeros(len(points), bool)
    off = np.linalg.norm(project(camera_matrix, placed) - seen, axis=1)
    return float(np.sum(np.minimum(off, RANSAC_PX) ** 2)), off < RANSAC_PX


def _pose(turn: Any, t: Any) -> Array:
    return make_pose(Rotation.from_rotvec(np.ravel(turn)).as_matrix(), np.ravel(t))


def _on(mask: Mask, pixels: Array) -> NDArray[np.bool_]:
    """Which of pixels (P, 2) lie on a mask."""
    height, width = mask.shape
    x, y = np.round(pixels).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(inside & mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])


def with_translation(
    kind: Translation, coarse: Array, refined: Refined, seen: NDArray[np.bool_], symmetry: Symmetry
) -> Array:
    """(N, 4, 4) PnP's poses, with the translations of single frames ("coarse") or with what PnP drifts by taken away.

    coarse: (N, 4, 4).  seen: (N,) frames whose coarse pose says something.  symmetry: of the mesh, about whose axis
    single frames say nothing.
    """
    T = refined.T_camera_object.copy()
    if kind == "coarse":
        T[:, :3, 3] = coarse[:, :3, 3]
    elif kind == "fused":
        joined = (refined.share[1:] > 0) & (refined.share[:-1] > 0)
        # Bearing and logarithm of depth: in these, errors are alike near and far.
        places, own = _bearing(coarse[:, :3, 3]), _bearing(T[:, :3, 3])
        x, y, log_z = (own + drift(places - own, seen, joined)).T
        T[:, :3, 3] = np.stack([x, y, np.ones_like(x)], axis=1) * np.exp(log_z)[:, None]
        turns = _alike(T[:, :3, :3], coarse[:, :3, :3], symmetry)
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(drift(turns, seen, joined)).as_matrix()
    return T


def drift(gap: Array, known: NDArray[np.bool_], joined: NDArray[np.bool_]) -> Array:
    """(N, D) what chained measurements drift by, from their gaps (N, D) to single ones, which scatter but do not drift.

    The least of sum rho((d_k - gap_k) / s) + sum ((d_k+1 - d_k) / (s / SLOW))^2 with Cauchy's rho, where s is what the
    gaps jitter by from frame to frame.  known: (N,) single measurements that count.  joined: (N - 1,) frames that the
    chain joins; where it is broken the drift may leap.
    """
    out = np.array(gap, float)
    if len(gap) < 3 or np.count_nonzero(known) < 3:
        return out
    jumps = np.diff(gap, axis=0)[known[1:] & known[:-1] & joined]
    scale = max(1.4826 * float(np.median(np.linalg.norm(jumps, axis=1))), 1e-9) if len(jumps) else 1.0
    single, chain = known / scale**2 + 1e-9, np.where(joined, (SLOW / scale) ** 2, (0.1 / scale) ** 2)
    weight = single
    for _ in range(ROUNDS):
        diagonal = weight.copy()
        diagonal[:-1] += chain
        diagonal[1:] += chain
        out = solveh_banded(np.stack([np.concatenate([[0.0], -chain]), diagonal]), weight[:, None] * gap)
        weight = single / (1 + np.sum((out - gap) ** 2, axis=1) / scale**2)
    return np.asarray(out)


def _alike(R: Array, others: Array, symmetry: Symmetry) -> Array:
    """(N, 3) rotation vectors that bring R (N, 3, 3) to those of `others` that look the same and are nearest."""
    same = Rotation.from_matrix(symmetry.rotations())
    turns = np.stack([(Rotation.from_matrix(R).inv() * Rotation.from_matrix(others) * S).as_rotvec() for S in same])
    return np.asarray(turns[np.linalg.norm(turns, axis=2).argmin(axis=0), np.arange(len(R))])


def _bearing(t: Array) -> Array:
    return np.stack([t[:, 0] / t[:, 2], t[:, 1] / t[:, 2], np.log(t[:, 2])], axis=1)
