"""What a depth picture says of a pose: points of the mesh's visible surface should lie on the surface measured.

Point to plane with projective association, as in ICG and M3T (Stoiber et al., CVPR 2022, section 3.3), joined with what
outline and texture said as one Gauss-Newton on SE(3). The points are drawn once for every side the object shows, not in
every iteration; what lies before or behind the surface by more than a limit is something else and says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .depth_video import DepthView
from .geometry import Array, invert_pose, make_pose, pose_change, project, shows_same_side, transform_points
from .region import TrackingMesh

DRAWN_SIDE_PX = 40.0  # of the object, where its surface is sampled
LEAST_COSINE = 0.25  # between surface and line of sight: flatter ones are seen badly by any sensor
SAME_SIDE_RAD, SAME_SIZE = float(np.deg2rad(4.0)), 0.1  # of poses that one drawing serves
LIMITS_M = (0.06, 0.03, 0.02, 0.012, 0.012, 0.012)  # beyond which a reading is not the object's, coarse to fine
FLOOR_M, GROWTH_PER_M = 0.003, 0.0019  # standard deviation of a reading, near by and with distance squared
INDEPENDENT = 100  # readings that all together tell as much as: a sensor's errors are alike side by side
LIKENESS = 0.05  # of its radius, by which the surface of a mesh that is only like the object's is beside it
INDEPENDENT_PARTS = 10  # of such a mesh: where one point of it is off, the next is so too
FEWEST = 30  # readings, with fewer of which nothing is said
OUTLINE_DEPTH = 0.02  # of the distance: no better does an outline know it, which may run a pixel beside the object's
BEFORE_M = 0.02  # and BEFORE times the standard deviation before the surface something else is seen
BEFORE, BESIDE = 4.0, 2.0  # standard deviations: before the surface, where a hand is; beside it
SIZE_SPREAD = 0.5  # of the distance: nearer and farther ones do not count when sizes are told


@dataclass(frozen=True)
class Surface:
    """Points (N, 3) in m of the side that a mesh shows at a pose, and unit normals (N, 3), in the mesh's frame."""

    point_object_m: Array
    normal_object: Array
    T_drawn: Array

    def serves(self, T_camera_object: Array) -> bool:
        """Whether the object shows nearly the same side and size at a pose as where the surface was drawn."""
        return shows_same_side(T_camera_object, self.T_drawn, SAME_SIDE_RAD, SAME_SIZE)


def draw_surface(mesh: TrackingMesh, T_camera_object: Array, camera_matrix: Array) -> Surface | None:
    """The surface that a mesh shows at a pose; None when it cannot be drawn."""
    size_px = 2 * mesh.radius_m * float(camera_matrix[0, 0]) / max(float(T_camera_object[2, 3]), 1e-3)
    camera = np.diag([DRAWN_SIDE_PX / size_px, DRAWN_SIDE_PX / size_px, 1.0]) @ camera_matrix
    window = mesh.drawn(T_camera_object, camera)
    if window is None:
        return None
    z = window.depth_m.astype(float)
    y, x = np.mgrid[: z.shape[0], : z.shape[1]]
    rays = np.stack([x + window.x0_px - camera[0, 2], y + window.y0_px - camera[1, 2], np.ones_like(z)], axis=-1)
    points = rays / np.array([camera[0, 0], camera[1, 1], 1.0]) * z[..., None]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    whole = (z[1:-1, 2:] > 0) & (z[1:-1, :-2] > 0) & (z[2:, 1:-1] > 0) & (z[:-2, 1:-1] > 0) & (z[1:-1, 1:-1] > 0)
    point, normal = points[1:-1, 1:-1][whole], np.cross(down, across)[whole]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    cosine = np.abs(np.sum(normal * point, axis=1)) / np.linalg.norm(point, axis=1)
    faced = cosine > LEAST_COSINE
    if faced.sum() < FEWEST:
        return None
    there = transform_points(invert_pose(T_camera_object), point[faced])
    return Surface(there, normal[faced] @ T_camera_object[:3, :3], T_camera_object.copy())


def size_told(surface: Surface, T_camera_object: Array, view: DepthView) -> float | None:
    """How many times farther away what is seen is than the mesh at a pose: as many times larger is the object.

    Half of the readings may be of a hand before it. None where there are too few.
    """
    _, z, measured, _ = _read(surface, T_camera_object, view)
    ratio = measured / z
    ratio = ratio[(measured > 0) & (np.abs(np.log(np.maximum(ratio, 1e-3))) < SIZE_SPREAD)]
    return float(np.median(ratio)) if len(ratio) >= FEWEST else None


def settle(
    surface: Surface, T_camera_object: Array, view: DepthView, information: Array, mesh_error_m: float = 0.0
) -> Array | None:
    """The pose (4, 4) that explains both what was known of it and the depth seen; None when too little was seen.

    information: (6, 6) of the pose given, rotation about the object first, in the units of its least squares.
    mesh_error_m: standard deviation of the mesh's surface from the object's; 0 for the object's own.
    """
    T = T_camera_object.copy()
    information = _less_sure_of_distance(information, T[:3, 3])
    floor_m = float(np.hypot(FLOOR_M, mesh_error_m))
    independent = INDEPENDENT_PARTS if mesh_error_m > 0 else INDEPENDENT
    for limit_m in np.maximum(LIMITS_M, 3 * mesh_error_m):
        point, z, measured, normal = _read(surface, T, view)
        slope = np.sum(normal * point, axis=1) / z
        offset_m = np.where(measured > 0, slope * (measured - z), np.inf)
        near = np.abs(offset_m) < limit_m
        if near.sum() < FEWEST:
            return None
        point, normal, slope, offset_m = point[near], normal[near], slope[near], offset_m[near]
        variance = floor_m**2 + (slope * GROWTH_PER_M * z[near] ** 2) ** 2
        weight = (1 - (offset_m / limit_m) ** 2) ** 2 / variance * min(1.0, independent / near.sum())
        rows = np.concatenate([np.cross(point - T[:3, 3], normal), normal], axis=1)
        weighted = rows * weight[:, None]
        gone = information @ pose_change(T_camera_object, T)
        step = np.linalg.solve(weighted.T @ rows + information, weighted.T @ offset_m - gone)
        T = make_pose(Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3], T[:3, 3] + step[3:])
    return T


def share_on_surface(
    surface: Surface, T_camera_object: Array, view: DepthView, mesh_error_m: float = 0.0
) -> float | None:
    """Share of the readings, but those of what stands before the mesh, that lie on its surface.

    0 where all are before it, None where there are too few.

    A pose that leans the wrong way, which an outline often cannot tell, has a third of them beside it.
    """
    point, z, measured, normal = _read(surface, T_camera_object, view)
    sigma_m = float(np.hypot(FLOOR_M, mesh_error_m))
    behind_m = (measured - z) * np.abs(np.sum(normal * point, axis=1)) / z
    told = (measured > 0) & (behind_m > -max(BEFORE_M, BEFORE * sigma_m))
    if np.count_nonzero(measured) < FEWEST:
        return None
    return float(np.mean(np.abs(behind_m[told]) < BESIDE * sigma_m)) if told.sum() >= FEWEST else 0.0


def _less_sure_of_distance(information: Array, position_m: Array) -> Array:
    """Information (6, 6) with an error of OUTLINE_DEPTH along the line of sight, common to all lines, added.

    Lines count as independent, which makes hundreds of them sure of a distance that a blurred edge or a focal length a
    little wrong changes for all alike.
    """
    told = information[:, 3:] @ (OUTLINE_DEPTH * position_m)
    return np.asarray(information - np.outer(told, told) / (1 + OUTLINE_DEPTH * position_m @ told[3:]))


def _read(surface: Surface, T: Array, view: DepthView) -> tuple[Array, Array, Array, Array]:
    """Points (N, 3) in the camera's frame, their z (N,), the depth seen there (N,) in m or 0, and normals (N, 3)."""
    point = transform_points(T, surface.point_object_m)
    z = np.maximum(point[:, 2], 1e-3)
    return (
        point,
        z,
        view.at(project(view.camera_matrix, np.column_stack([point[:, :2], z]))),
        (surface.normal_object @ T[:3, :3].T),
    )
