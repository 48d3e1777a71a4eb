"""Poses of views and places of points that explain together where the points were seen: bundle adjustment.

Levenberg-Marquardt with the points eliminated (Triggs et al., Bundle Adjustment - A Modern Synthesis, section 6.1), and
Huber's weights. Pixels are normalised: in a camera matrix that is the identity. The unit of length is free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from .geometry import Array

HUBER = 1.5  # in units of the noise, beyond which a sighting counts less
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Bundle:
    """R (V, 3, 3) and t (V, 3): the world in each view's camera; points (P, 3) in the world."""

    R: Array
    t: Array
    points: Array


@dataclass(frozen=True)
class Sightings:
    """In which view (M,) which point (M,) was seen where, (M, 2) normalised; each point at most once in a view."""

    view: Index
    point: Index
    at: Array


def in_cameras(bundle: Bundle, seen: Sightings) -> Array:
    """(M, 3) each seen point in the camera that saw it."""
    rotated = np.einsum("mij,mj->mi", bundle.R[seen.view], bundle.points[seen.point])
    return np.asarray(rotated + bundle.t[seen.view])


def misses(in_camera: Array, at: Array) -> Array:
    """(M, 2) how far points (M, 3) project from where they were seen; 1 for those that are not before the camera."""
    z = in_camera[:, 2:]
    return np.asarray(np.where(z > 1e-6, in_camera[:, :2] / np.maximum(z, 1e-6) - at, 1.0))


def adjusted(bundle: Bundle, seen: Sightings, noise: float, rounds: int = 15) -> Bundle:
    """The bundle that explains the sightings best; the first view stays where it is.

    noise: standard deviation of a normalised coordinate.
    """
    cost, damping = _cost(bundle, seen, noise), 1e-3
    for _ in range(rounds):
        step = _Step.at(bundle, seen, noise)
        for _ in range(6):
            tried = step.taken(bundle, damping)
            new = _cost(tried, seen, noise)
            if new < cost:
                break
            damping *= 8
        else:
            return bundle
        settled = cost - new < 1e-4 * cost
        bundle, cost, damping = tried, new, damping / 5
        if settled:
            break
    return bundle


def pose_adjusted(points: Array, at: Array, R: Array, t: Array, noise: float, rounds: int = 12) -> tuple[Array, Array]:
    """R and t of one view that sees known points (M, 3) at (M, 2), from a guess; wrong sightings are left out softly.

    The bound between right and wrong comes down from what the guess explains to 3 times the noise.
    """
    for k in range(rounds):
        rotated = points @ R.T
        off = misses(rotated + t, at)
        size = np.linalg.norm(off, axis=1)
        bound = max(3 * noise, float(np.median(size)) * (3.0 if k < rounds // 2 else 1.5))
        weight = 1.0 / (1.0 + (size / bound) ** 2) ** 2
        _, of_pose = _slopes(rotated, rotated + t)
        A = np.einsum("mki,m,mkj->ij", of_pose, weight, of_pose)
        change = -np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(6), np.einsum("mki,m,mk->i", of_pose, weight, off))
        R, t = Rotation.from_rotvec(change[:3]).as_matrix() @ R, t + change[3:]
        if np.abs(change).max() < 1e-7:
            break
    return R, t


def _slopes(rotated: Array, in_camera: Array) -> tuple[Array, Array]:
    """Of projections (M, 2): by the place in the camera (M, 2, 3), by the pose (M, 2, 6), turned on the left."""
    x, y, z = in_camera[:, 0], in_camera[:, 1], np.maximum(in_camera[:, 2], 1e-6)
    none = np.zeros_like(z)
    by_place = np.stack([np.stack([1 / z, none, -x / z**2], -1), np.stack([none, 1 / z, -y / z**2], -1)], 1)
    by_turn = np.cross(rotated[:, None, :], by_place)  # g . (w x p) = w . (p x g)
    return by_place, np.concatenate([by_turn, by_place], axis=2)


def _weights(off: Array, noise: float) -> Array:
    return np.asarray(np.minimum(1.0, HUBER * noise / np.maximum(np.linalg.norm(off, axis=1), 1e-12)) / noise**2)


def _cost(bundle: Bundle, seen: Sightings, noise: float) -> float:
    size = np.linalg.norm(misses(in_cameras(bundle, seen), seen.at), axis=1) / noise
    return float(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).sum())


@dataclass(frozen=True)
class _Step:
    """Normal equations: by pose (V, 6, 6), by point (P, 3, 3), across (6V, 3P), and both gradients."""

    poses: Array
    points: Array
    across: Any
    pose_slope: Array
    point_slope: Array

    @staticmethod
    def at(bundle: Bundle, seen: Sightings, noise: float) -> _Step:
        views, count, m = len(bundle.R), len(bundle.points), len(seen.at)
        in_camera = in_cameras(bundle, seen)
        off = misses(in_camera, seen.at)
        weight = np.where(in_camera[:, 2] > 1e-6, _weights(off, noise), 0.0)
        by_place, by_pose = _slopes(in_camera - bundle.t[seen.view], in_camera)
        by_point = by_place @ bundle.R[seen.view]
        by_pose[seen.view == 0] = 0.0
        one, rows = np.ones(m), np.arange(m)
        of_view = sparse.csr_array((one, (seen.view, rows)), shape=(views, m))
        of_point = sparse.csr_array((one, (seen.point, rows)), shape=(count, m))

        def summed(of: Any, a: Array, b: Array) -> Array:
            return np.asarray(of @ np.einsum("mki,m,mkj->mij", a, weight, b).reshape(m, -1))

        order = np.lexsort([seen.point, seen.view])
        blocks = np.einsum("mki,m,mkj->mij", by_pose, weight, by_point)[order]
        ends = np.concatenate([[0], np.cumsum(np.bincount(seen.view, minlength=views))])
        across = sparse.bsr_array((blocks, seen.point[order], ends), shape=(6 * views, 3 * count))
        return _Step(
            summed(of_view, by_pose, by_pose).reshape(views, 6, 6),
            summed(of_point, by_point, by_point).reshape(count, 3, 3),
            across.tocsr(),
            summed(of_view, by_pose, off[..., None]),
            summed(of_point, by_point, off[..., None]),
        )

    def taken(self, bundle: Bundle, damping: float) -> Bundle:
        """The bundle after the damped step."""
        views, count = len(self.poses), len(self.points)
        poses, points = (_damped(blocks, damping) for blocks in (self.poses, self.points))
        inverse = np.linalg.inv(points)
        between = sparse.bsr_array((inverse, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count))
        reduced = self.across @ between.tocsr()
        left = -np.asarray((reduced @ self.across.T).todense())
        for k in range(views):
            left[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += poses[k]
        right = -(self.pose_slope.ravel() - reduced @ self.point_slope.ravel())
        change = np.linalg.solve(left, right)
        moved = -np.einsum("pij,pj->pi", inverse, self.point_slope + (self.across.T @ change).reshape(count, 3))
        turn, shift = change.reshape(views, 6)[:, :3], change.reshape(views, 6)[:, 3:]
        R = Rotation.from_rotvec(turn).as_matrix() @ bundle.R
        return replace(bundle, R=R, t=bundle.t + shift, points=bundle.points + moved)


def _damped(blocks: Array, damping: float) -> Array:
    """Blocks (K, n, n) with their diagonals raised."""
    diagonal = np.diagonal(blocks, axis1=1, axis2=2)
    floor = 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-12)
    return blocks + (damping * diagonal + floor)[:, :, None] * np.eye(blocks.shape[1])
