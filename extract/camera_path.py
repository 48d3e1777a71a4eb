"""Where a moving camera went, up to scale: structure from motion of the still background.

From where the corners of `CameraWatch` were seen: two views with much parallax give a first guess, by the essential
matrix and, since a flat background leaves that open, by the homography as well; what explains further views best is
taken. The other views join one after another, with bundle adjustments in between (Schoenberger and Frahm,
Structure-from-Motion Revisited, CVPR 2016, section 4.2). The frames between the views are then placed one by one.

pycolmap, given the same corners, came no nearer to the truth in more time; it is 134 MB large, this needs nothing more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from .bundle import Bundle, Index, Sightings, adjusted, in_cameras, misses, pose_adjusted
from .camera_motion import INLIER_PX, Sighting, fitted_rotation
from .geometry import Array, invert_pose, make_pose

NOISE_PX = 0.5  # of a followed corner
WRONG_PX = 3.0  # off, a sighting is of something else, or was lost
FEWEST_POINTS = 20  # that two views must share, and a view must see of what is known
MOST_VIEWS = 150  # of a longer path every second, third ... view is used
LEAST_ANGLE_RAD = float(np.deg2rad(1.0))  # between the rays to a point, for its place to be told
LEAST_PARALLAX_PX = 3.0  # of the first two views, beyond what a rotation explains
ENOUGH_PARALLAX_PX, ENOUGH_SHARED = 30.0, 80  # more do not make two views better to begin with
TRIED_VIEWS = 5  # that rivals for the first guess are grown to
PLACED_SHARE = 0.5  # of what a frame sees of the known points, that must agree on where it is
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraPath:
    """T_first_camera (N, 4, 4), translations in units of the background's median distance from the first camera.

    quality: (N,) share of the known corners in a frame that agree with it, 0 where it was put between its neighbours.
    error_px: median distance of corners from where they should be seen, in px of the frames worked on.
    parallax_deg: median angle between the rays to a point.  points, views: how many there are.
    """

    T_first_camera: Array
    quality: Array
    error_px: float
    parallax_deg: float
    points: int
    views: int


def camera_path(sightings: Sequence[Sighting | None], camera_matrix: Array) -> CameraPath | None:
    """The path of the camera through the frames, None where corners do not tell it: too few of them, or no parallax.

    camera_matrix: (3, 3) of the pixels in the sightings.
    """
    views = _views(sightings)
    if len(views) < 2:
        return None
    scene = _Scene(sightings, views, camera_matrix)
    for a, b in _pairs(scene):
        rivals = [scene.begun(a, b, R, t) for R, t in _guesses(scene, a, b)]
        rivals = [rival.grown(TRIED_VIEWS) for rival in rivals if rival.known.sum() >= FEWEST_POINTS]
        rivals = [rival for rival in rivals if rival.placed.sum() >= min(TRIED_VIEWS, len(views))]
        if rivals:
            best = max(rivals, key=lambda rival: int(rival.used().sum())).grown(len(views))
            return best.through_all(sightings)
    return None


def _views(sightings: Sequence[Sighting | None]) -> list[int]:
    """Frames that show something new, the first of those that share a sighting."""
    found: list[int] = []
    for index, sighting in enumerate(sightings):
        if sighting is not None and sighting.view and not (found and sightings[found[-1]] is sighting):
            found.append(index)
    return found[:: max(1, -(-len(found) // MOST_VIEWS))]


class _Scene:
    """Views and points as far as they are known.

    placed: (V,) whether a view's pose is known.  known: (P,) whether a point's place is.  right: (M,) sightings that
    agree with both, as far as is known.
    """

    def __init__(self, sightings: Sequence[Sighting | None], frames: Sequence[int], camera_matrix: Array) -> None:
        shown = [sighting for k in frames if (sighting := sightings[k]) is not None]
        self.frames, self.camera_matrix = list(frames), camera_matrix
        self.px = 1.0 / float(camera_matrix[0, 0])
        self.seen = Sightings(
            np.repeat(np.arange(len(shown)), [len(s.ids) for s in shown]),
            np.concatenate([s.ids for s in shown]).astype(np.int64),
            _normalised(np.concatenate([s.pixels for s in shown]), camera_matrix),
        )
        views, points = len(shown), int(self.seen.point.max(initial=-1)) + 1
        self.bundle = Bundle(np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3)), np.zeros((points, 3)))
        self.placed, self.known = np.zeros(views, bool), np.zeros(points, bool)
        self.right = np.ones(len(self.seen.at), bool)

    def _copy(self) -> Self:
        twin = object.__new__(type(self))
        twin.__dict__ = {**self.__dict__, "placed": self.placed.copy(), "known": self.known.copy()}
        twin.bundle = Bundle(self.bundle.R.copy(), self.bundle.t.copy(), self.bundle.points.copy())
        return twin

    def shared(self, a: int, b: int) -> tuple[Array, Array]:
        """(M, 2) normalised places, in two views, of what both see."""
        rows = [np.flatnonzero(self.seen.view == view) for view in (a, b)]
        a_points, b_points = (self.seen.point[r] for r in rows)
        _, first, second = np.intersect1d(a_points, b_points, return_indices=True)
        return self.seen.at[rows[0][first]], self.seen.at[rows[1][second]]

    def begun(self, a: int, b: int, R_b_a: Array, t: Array) -> Self:
        """With two views placed, and the points that both see."""
        scene = self._copy()
        scene.bundle.R[b], scene.bundle.t[b] = R_b_a, t / np.linalg.norm(t)
        scene.placed[[a, b]] = True
        scene._find_points()
        return scene

    def used(self) -> Bool:
        """(M,) sightings of known points in placed views that are right."""
        return np.asarray(self.right & self.placed[self.seen.view] & self.known[self.seen.point])

    def grown(self, count: int) -> Self:
        """With so many views placed, if that can be, the best connected first."""
        scene = self._copy()
        refused, adjust_at = np.zeros(len(scene.placed), bool), 0.0
        while scene.known.any():
            if scene.placed.sum() >= adjust_at:
                scene._adjust()
                adjust_at = 1.25 * scene.placed.sum() + 0.5
                refused[:] = False
            sees = np.bincount(scene.seen.view, scene.known[scene.seen.point], len(scene.placed))
            sees[scene.placed | refused] = 0
            view = int(np.argmax(sees))
            if sees[view] < FEWEST_POINTS or scene.placed.sum() >= count:
                break
            if scene._place(view):
                scene._find_points()
            else:
                refused[view] = True
        for _ in range(2):
            scene._adjust()
            scene._find_points()
        return scene

    def _place(self, view: int) -> bool:
        """Whether the view's pose could be found, from that of its neighbour in time."""
        rows = np.flatnonzero((self.seen.view == view) & self.known[self.seen.point])
        near = self._nearest(self.frames[view])
        points, at = self.bundle.points[self.seen.point[rows]], self.seen.at[rows]
        R, t = pose_adjusted(points, at, self.bundle.R[near], self.bundle.t[near], NOISE_PX * self.px)
        if _share(points @ R.T + t, at, WRONG_PX * self.px) < PLACED_SHARE:
            return False
        self.bundle.R[view], self.bundle.t[view], self.placed[view] = R, t, True
        return True

    def _nearest(self, frame: int) -> int:
        """The placed view nearest in time."""
        away = np.where(self.placed, np.abs(np.array(self.frames) - frame), np.inf)
        return int(np.argmin(away))

    def _rays(self) -> tuple[Index, Array, Array]:
        """Sightings in placed views: which, and the rays' origins and unit directions in the world (M, 3)."""
        rows = np.flatnonzero(self.placed[self.seen.view])
        R_t = np.swapaxes(self.bundle.R, 1, 2)[self.seen.view[rows]]
        toward = np.einsum("mij,mj->mi", R_t, np.column_stack([self.seen.at[rows], np.ones(len(rows))]))
        origin = -np.einsum("mij,mj->mi", R_t, self.bundle.t[self.seen.view[rows]])
        return rows, origin, toward / np.linalg.norm(toward, axis=1, keepdims=True)

    def _angles(self) -> Array:
        """(P,) twice the largest angle in rad between a point's rays and their mean."""
        rows, _, toward = self._rays()
        point = self.seen.point[rows]
        mean = np.zeros_like(self.bundle.points)
        np.add.at(mean, point, toward)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        widest = np.zeros(len(mean))
        np.maximum.at(widest, point, np.linalg.norm(np.cross(toward, mean[point]), axis=1))
        return np.asarray(2 * np.arcsin(np.minimum(widest, 1.0)))

    def _find_points(self) -> None:
        """Place the points that two or more placed views see from different sides: nearest to all their rays."""
        rows, origin, toward = self._rays()
        new = ~self.known & (self._angles() > LEAST_ANGLE_RAD)
        keep = new[self.seen.point[rows]]
        rows, origin, toward = rows[keep], origin[keep], toward[keep]
        across = np.eye(3) - toward[:, :, None] * toward[:, None, :]
        names, point = np.unique(self.seen.point[rows], return_inverse=True)
        left, right = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
        np.add.at(left, point, across)
        np.add.at(right, point, np.einsum("mij,mj->mi", across, origin))
        left += 1e-9 * np.eye(3)
        self.bundle.points[names] = np.linalg.solve(left, right[..., None])[..., 0]
        seen = Sightings(self.seen.view[rows], self.seen.point[rows], self.seen.at[rows])
        off = np.linalg.norm(misses(in_cameras(self.bundle, seen), seen.at), axis=1)
        worst = np.zeros(len(names))
        np.maximum.at(worst, point, off)
        good = worst < 2 * WRONG_PX * self.px
        self.known[names[good]] = True
        self.right[rows] |= good[point]

    def _adjust(self) -> None:
        """Adjust what is known together; what stays wrong is not used any more."""
        self.right = np.ones_like(self.right)
        used = np.flatnonzero(self.used())
        off = self._off(used)
        used = used[off < 4 * WRONG_PX * self.px]
        if len(used) < 2 * FEWEST_POINTS:
            self.known[:] = False
            return
        views, view = np.unique(self.seen.view[used], return_inverse=True)
        points, point = np.unique(self.seen.point[used], return_inverse=True)
        start = Bundle(self.bundle.R[views], self.bundle.t[views], self.bundle.points[points])
        done = adjusted(start, Sightings(view, point, self.seen.at[used]), NOISE_PX * self.px)
        self.bundle.R[views], self.bundle.t[views], self.bundle.points[points] = done.R, done.t, done.points
        rows = np.flatnonzero(self.used())
        self.right[rows] = self._off(rows) < WRONG_PX * self.px
        agree = np.bincount(self.seen.point[self.used()], minlength=len(self.known))
        self.known &= (agree >= 2) & (self._angles() > LEAST_ANGLE_RAD)
        enough = np.bincount(self.seen.view[self.used()], minlength=len(self.placed)) >= FEWEST_POINTS // 2
        self.placed &= enough

    def _off(self, rows: Index) -> Array:
        seen = Sightings(self.seen.view[rows], self.seen.point[rows], self.seen.at[rows])
        return np.asarray(np.linalg.norm(misses(in_cameras(self.bundle, seen), seen.at), axis=1))

    def through_all(self, sightings: Sequence[Sighting | None]) -> CameraPath | None:
        """The path through every frame, those that are no views included."""
        used = self.used()
        quality, T_camera_world = np.zeros(len(sightings)), np.tile(np.eye(4), (len(sightings), 1, 1))
        for frame, sighting in enumerate(sightings):
            if sighting is None:
                continue
            inside = sighting.ids < len(self.known)
            inside[inside] = self.known[sighting.ids[inside]]
            if inside.sum() < FEWEST_POINTS // 2:
                continue
            points, near = self.bundle.points[sighting.ids[inside]], self._nearest(frame)
            at = _normalised(sighting.pixels[inside], self.camera_matrix)
            R, t = self.bundle.R[near], self.bundle.t[near]
            if self.frames[near] != frame:
                R, t = pose_adjusted(points, at, R, t, NOISE_PX * self.px)
            share = _share(points @ R.T + t, at, INLIER_PX * self.px)
            if share >= PLACED_SHARE:
                quality[frame], T_camera_world[frame] = share, make_pose(R, t)
        good = np.flatnonzero(quality > 0)
        if len(good) < 2:
            return None
        T_world_camera = _between(invert_pose(T_camera_world[good]), good, len(sightings))
        far = np.linalg.norm(self.bundle.points[self.known] - T_world_camera[0, :3, 3], axis=1)
        T = invert_pose(T_world_camera[0]) @ T_world_camera
        T[:, :3, 3] /= np.median(far)
        return CameraPath(
            T,
            quality,
            float(np.median(self._off(np.flatnonzero(used)))) / self.px,
            float(np.rad2deg(np.median(self._angles()[self.known]))),
            int(self.known.sum()),
            int(self.placed.sum()),
        )


def _pairs(scene: _Scene) -> Iterator[tuple[int, int]]:
    """The pairs of views that are best to begin with, the best first: much parallax, many common corners."""
    views, found = len(scene.placed), []
    gaps = np.unique(np.round(1.6 ** np.arange(12)).astype(int))
    for a in np.unique(np.linspace(0, views - 2, 8).astype(int)):
        for b in a + gaps[a + gaps < views]:
            first, second = scene.shared(int(a), int(b))
            if len(first) < FEWEST_POINTS:
                break
            _, off = fitted_rotation(first, second, np.eye(3), np.ones(len(first), bool), INLIER_PX * scene.px)
            parallax_px = float(np.median(off)) / scene.px
            if parallax_px >= LEAST_PARALLAX_PX:
                shared = min(len(first) / ENOUGH_SHARED, 1.0)
                found.append((min(parallax_px, ENOUGH_PARALLAX_PX) * shared, int(a), int(b)))
    yield from ((a, b) for _, a, b in sorted(found, reverse=True)[:3])


def _guesses(scene: _Scene, a: int, b: int) -> Iterator[tuple[Array, Array]]:
    """R_b_a and t (up to scale) that may be those of the second view against the first."""
    first, second = scene.shared(a, b)
    bound = INLIER_PX * scene.px
    E, inlier = cv2.findEssentialMat(first, second, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=bound)
    if E is not None and len(E) >= 3:
        _, R, t, _ = cv2.recoverPose(E[:3], first, second, np.eye(3), mask=inlier)
        yield np.asarray(R, float), np.asarray(t, float)[:, 0]
    H, _ = cv2.findHomography(first, second, cv2.RANSAC, 2 * bound, maxIters=2000)
    if H is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        for R, t in zip(turns, shifts, strict=True):
            if np.linalg.norm(t) > 1e-3:
                yield np.asarray(R, float), np.asarray(t, float)[:, 0]


def _normalised(pixels: NDArray[np.float32], camera_matrix: Array) -> Array:
    return np.asarray((pixels.astype(float) - camera_matrix[:2, 2]) / np.diag(camera_matrix)[:2])


def _share(in_camera: Array, at: Array, bound: float) -> float:
    return float(np.mean(np.linalg.norm(misses(in_camera, at), axis=1) < bound))


def _between(T: Array, frames: Index, count: int) -> Array:
    """(count, 4, 4) poses from those of some frames: between them evenly, beyond the ends as at the end."""
    every = np.clip(np.arange(count), frames[0], frames[-1])
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Slerp(frames, Rotation.from_matrix(T[:, :3, :3]))(every).as_matrix()
    out[:, :3, 3] = np.column_stack([np.interp(every, frames, T[:, k, 3]) for k in range(3)])
    return out
