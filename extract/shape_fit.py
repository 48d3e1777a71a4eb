"""Fit the shape of a library vessel to the object seen, together with its pose in one or several frames.

The outline's correspondence lines (region.py) say how far it should move; how it moves with a shape parameter is
found by drawing the vessel with that parameter changed a little. One regularised Gauss-Newton problem over all
frames: the poses are each frame's own, the shape is shared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .colours import ColourModel
from .geometry import Array, extent, pose_change, project, transform_points
from .meshes import THINNING
from .raster import render_depth
from .region import Lines, TrackingMesh, measure
from .segment import Box
from .vessels import Vessel, make_vessel, outline_mesh, parameter_space

FIXED = ("wall_m", "red", "green", "blue")  # not seen in a silhouette
PRIOR_SHARE = 0.15  # standard deviation of a shape parameter around its start, as a share of its range
PRIOR_TURN_RAD, PRIOR_SHIFT = 0.1, 0.03  # standard deviation of a pose around its start; of the distance
TRACKING_FACES = 8000
BOX_STD_PX = 4.0  # how exactly people draw boxes


@dataclass(frozen=True)
class View:
    """One frame that the shape must explain.

    bins: (H, W) colour bins.  colours: the colours learned there.  T_camera_object: the pose so far.
    box_xywh_px: box around the whole object, if a person gave one.  edges: (H, W, 2) from `edge_strength`.
    """

    bins: NDArray[np.int32]
    colours: ColourModel
    T_camera_object: Array
    box_xywh_px: Box | None = None
    edges: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) in m and faces (F, 3): all that drawing a silhouette needs."""

    vertices_m: Array
    faces: NDArray[np.int32]


def tracking_mesh(vessel: Vessel, faces: int = TRACKING_FACES) -> TrackingMesh:
    """The vessel's mesh, light enough to be drawn several times a frame."""
    mesh = vessel.mesh
    if len(mesh.faces) > faces:
        with THINNING:
            mesh = mesh.simplify_quadric_decimation(face_count=faces)
    # Made lighter still, thin walls pass through each other.
    closed = faces >= TRACKING_FACES
    return TrackingMesh.build(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32), closed)


def fit_shape(
    vessel: Vessel,
    views: Sequence[View],
    camera_matrix: Array,
    steps_px: Sequence[float] = (3.0, 1.5, 1.0),
) -> tuple[Vessel, list[Array]]:
    """The vessel and its poses T_camera_object that explain the views best, close to what they were.

    Only parameters whose change moves the outline are touched; each stays inside its range.
    """
    space = parameter_space(vessel.category)
    names = [name for name in space if name not in FIXED]
    low = np.array([space[n].low for n in names])
    high = np.array([space[n].high for n in names])
    start = np.array([vessel.params[n] for n in names])
    prior_std = PRIOR_SHARE * (high - low)
    values, poses = start.copy(), [view.T_camera_object for view in views]
    for step_px in steps_px:
        surface = _surface(vessel.category, {**vessel.params})
        mesh = TrackingMesh.build(surface.vertices_m, surface.faces, closed=True)
        measured = [
            measure(mesh, T, camera_matrix, view.bins, view.colours, step_px, view.edges)
            for T, view in zip(poses, views, strict=True)
        ]
        used = [k for k, lines in enumerate(measured) if lines is not None]
        if not used:
            break
        nudges = 0.04 * (high - low)
        nudges = np.where(values + nudges > high, -nudges, nudges)
        variants = [
            _surface(vessel.category, {**vessel.params, n: float(v + d)})
            for n, v, d in zip(names, values, nudges, strict=True)
        ]
        size = 6 * len(used) + len(names)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        for slot, k in enumerate(used):
            lines, T = measured[k], poses[k]
            assert lines is not None
            offset_px, J_pose = lines.residuals(T, camera_matrix)
            J_shape = _shape_jacobian(mesh, variants, nudges, lines, T, camera_matrix)
            weight = lines.weights(offset_px)
            if (box := views[k].box_xywh_px) is not None:
                box_offset, box_pose, box_shape = _box_rows(mesh, variants, nudges, T, camera_matrix, box)
                offset_px, J_pose = np.concatenate([offset_px, box_offset]), np.vstack([J_pose, box_pose])
                J_shape = np.vstack([J_shape, box_shape])
                # A side of the box counts as much as a stretch of outline does.
                weight = np.concatenate([weight, np.full(4, 0.04 * len(weight) / BOX_STD_PX**2)])
            rows = np.zeros((len(offset_px), size))
            rows[:, 6 * slot : 6 * slot + 6] = J_pose
            rows[:, 6 * len(used) :] = J_shape
            normal += rows.T @ (weight[:, None] * rows)
            gradient += rows.T @ (weight * offset_px)
            pose_prior = np.array([1 / PRIOR_TURN_RAD**2] * 3 + [1 / (PRIOR_SHIFT * T[2, 3]) ** 2] * 3)
            own = slice(6 * slot, 6 * slot + 6)
            normal[own, own] += np.diag(pose_prior)
            gradient[own] -= pose_prior * pose_change(views[k].T_camera_object, T)
        tail = slice(6 * len(used), size)
        normal[tail, tail] += np.diag(1 / prior_std**2)
        gradient[tail] -= (values - start) / prior_std**2
        delta: Array = np.asarray(np.linalg.solve(normal, gradient), float)
        for slot, k in enumerate(used):
            poses[k] = _moved(poses[k], delta[6 * slot : 6 * slot + 6])
        values = np.clip(values + delta[tail], low, high)
        vessel = replace(vessel, params={**vessel.params, **dict(zip(names, map(float, values), strict=True))})
    return _with(vessel, {}), poses


def coloured(vessel: Vessel, rgb: NDArray[np.uint8], mask: NDArray[np.bool_]) -> Vessel:
    """The vessel in the median colour of the masked pixels."""
    red, green, blue = np.median(rgb[mask], axis=0) / 255.0
    return _with(vessel, {"red": red, "green": green, "blue": blue})


def _surface(category: str, params: dict[str, float]) -> Surface:
    return Surface(*outline_mesh(category, params))


def _with(vessel: Vessel, changes: dict[str, float]) -> Vessel:
    return make_vessel(vessel.category, None, **{**vessel.params, **{k: float(v) for k, v in changes.items()}})


def _moved(T: Array, delta: Array) -> Array:
    moved = T.copy()
    moved[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
    moved[:3, 3] += delta[3:]
    return moved


def _shape_jacobian(
    mesh: TrackingMesh,
    variants: Sequence[Surface],
    nudges: Array,
    lines: Lines,
    T: Array,
    camera_matrix: Array,
) -> Array:
    """(N, P) outward motion of the outline in px per unit of each parameter, from signed distances."""
    before = _signed_distance(mesh, T, camera_matrix, lines.outline.pixel)
    columns = [
        (before - _signed_distance(variant, T, camera_matrix, lines.outline.pixel)) / nudge
        for variant, nudge in zip(variants, nudges, strict=True)
    ]
    return np.stack(columns, axis=1)


def _box_rows(
    mesh: TrackingMesh,
    variants: Sequence[Surface],
    nudges: Array,
    T: Array,
    camera_matrix: Array,
    box: Box,
) -> tuple[Array, Array, Array]:
    """Offsets in px of the four sides of the projection from the box, and their Jacobians by pose and by shape."""
    target = np.array([box[0], box[1], box[0] + box[2], box[1] + box[3]])
    here = _projected_sides(mesh, T, camera_matrix)
    steps = np.array([1e-3] * 3 + [1e-3 * T[2, 3]] * 3)
    pose = [(_projected_sides(mesh, _moved(T, d), camera_matrix) - here) / d.sum() for d in np.diag(steps)]
    shape = [(_projected_sides(v, T, camera_matrix) - here) / d for v, d in zip(variants, nudges, strict=True)]
    return target - here, np.stack(pose, axis=1), np.stack(shape, axis=1)


def _projected_sides(mesh: Surface | TrackingMesh, T: Array, camera_matrix: Array) -> Array:
    return np.concatenate(extent(project(camera_matrix, transform_points(T, mesh.vertices_m))))


def _signed_distance(mesh: Surface | TrackingMesh, T: Array, camera_matrix: Array, pixel: Array) -> Array:
    """Distance of pixels (N, 2) from the silhouette's outline in px, positive outside, limited to +-20."""
    window = render_depth(mesh.vertices_m, mesh.faces, T, camera_matrix, margin_px=24, closed=True)
    if window is None:
        return np.zeros(len(pixel))
    filled = window.mask.astype(np.uint8)
    signed = cv2.distanceTransform(1 - filled, cv2.DIST_L2, 5) - cv2.distanceTransform(filled, cv2.DIST_L2, 5)
    at = (pixel - [window.x0_px, window.y0_px]).astype(np.float32)
    sampled = cv2.remap(signed.astype(np.float32), at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR, borderValue=20.0)
    return np.clip(sampled[:, 0].astype(float), -20, 20)
