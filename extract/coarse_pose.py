"""Pose of a mesh in one picture from its views (FreePose, section 3.1, equations 1 and 2, and the authors' fine stage).

Equation 1 takes the view whose patch features agree best with the picture's; equation 2 the distance at which that
view's visible surface fills the object's box. A view is rendered on the camera's axis, so its rotation is turned with
the ray to the object before it is used. The fine stage draws the mesh where it is thought to be, in rotations close by,
and crops picture and drawing equally.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from .features import object_cells, unit
from .files import atomic_path
from .geometry import Array, make_pose, project, rotation_angle_rad, super_fibonacci_rotations
from .mesh_store import MeshStore
from .protocols import Box, Floats, PatchFeatures
from .retrieval import Look
from .templates import ColoredMesh, View, box_of_points, template_view, view_crop

Over = Literal["foreground", "union", "all"]
FINE_ROTATIONS, FINE_RAD = 20_000, float(np.deg2rad(15))
BATCH = 60


@dataclass(frozen=True)
class PoseGuess:
    """A pose and how well it explains the picture.

    T_camera_object: (4, 4), of the mesh with its largest extent brought to `size_m`, origin at its bounding box's
    centre.  score: mean cosine of equation 1, in [-1, 1].
    """

    T_camera_object: Array
    score: float


def stored_patches(store: MeshStore, key: str, features: PatchFeatures) -> NDArray[np.float16]:
    """(M, G, G, D) unit features of all views, zero off the object; computed at the first call, then mapped."""
    path = store.patches(key)
    if not path.exists():
        mesh, settings = store.mesh(key).mesh, store.settings
        shape = (settings.count, features.grid, features.grid, features.patch_size)
        found = np.empty(shape, np.float16)
        for first in range(0, settings.count, BATCH):
            rows = range(first, min(first + BATCH, settings.count))
            found[first : rows.stop] = _object_patches(
                features, [template_view(mesh, settings, index, features.crop_px) for index in rows]
            )
        with atomic_path(path) as temporary:
            np.save(temporary, found, allow_pickle=False)
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


@functools.lru_cache(maxsize=256)
def _covered_in(path: Path) -> NDArray[np.bool_]:
    return covered_cells(np.load(path, mmap_mode="r", allow_pickle=False))


def covered_cells(patches: NDArray[np.float16]) -> NDArray[np.bool_]:
    """(M, G G) the cells in which views (M, G, G, D) show their object."""
    return np.asarray(np.any(patches.reshape(len(patches), -1, patches.shape[-1]) != 0, axis=-1))


def view_scores(
    query: Floats,
    patches: NDArray[np.float16],
    cells: NDArray[np.bool_],
    over: Over,
    covered: NDArray[np.bool_] | None = None,
) -> Floats:
    """(M, T) equation 1: the mean over patches of the cosine between queries (T, G, G, D) and views (M, G, G, D).

    over: "foreground": a query's cells (T, G, G); "union": cells that either covers, so that what sticks out counts
    against a view; "all": every cell, as the authors' code does.  covered: of the views, when known (`covered_cells`).
    """
    turns, size = len(query), query.shape[-1]
    counted = cells.reshape(turns, -1) if over != "all" else np.ones((turns, cells[0].size), bool)
    at = np.flatnonzero(counted.any(axis=0))
    wanted = unit(query).reshape(turns, -1, size) * counted[..., None]
    wanted = np.ascontiguousarray(wanted[:, at].reshape(turns, -1).T)
    flat = patches.reshape(len(patches), -1, size)
    total = np.empty((len(patches), turns), np.float32)
    for first in range(0, len(patches), BATCH):
        part = flat[first : first + BATCH, at]
        total[first : first + BATCH] = part.reshape(len(part), -1).astype(np.float32) @ wanted
    if over != "union":
        return np.asarray(total / counted.sum(axis=1))
    covered = covered_cells(patches) if covered is None else covered
    either = covered.sum(axis=1)[:, None] + (~covered).astype(np.float32) @ counted.T.astype(np.float32)
    return np.asarray(total / np.maximum(either, 1.0))


def ray_rotation(camera_matrix: Array, pixel: Array) -> Array:
    """(3, 3) the smallest turn that brings the camera's axis onto the ray through a pixel (2,)."""
    ray = np.linalg.solve(camera_matrix, np.array([pixel[0], pixel[1], 1.0]))
    ray /= np.linalg.norm(ray)
    axis = np.array([-ray[1], ray[0], 0.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, ray[2])).as_matrix())


def translation_from_box(
    visible_m: Array, box_xywh_px: Box, camera_matrix: Array, size_px: Array | None = None
) -> Array:
    """(3,) FreePose's equation 2: where a surface of visible width and height (2,) fills a box.

    size_px: (2,) width and height to fill when they are not the box's, as in a turned picture.
    """
    x, y, w, h = box_xywh_px
    width, height = (w, h) if size_px is None else size_px
    fx, fy = camera_matrix[0, 0], camera_matrix[1, 1]
    z = 0.5 * (fx * visible_m[0] / width + fy * visible_m[1] / height)
    # A box counts whole pixels; their centres are at integers.
    centre = np.array([x + w / 2 - 0.5, y + h / 2 - 0.5])
    return np.array([(centre[0] - camera_matrix[0, 2]) / fx * z, (centre[1] - camera_matrix[1, 2]) / fy * z, z])


def coarse_poses(
    store: MeshStore,
    key: str,
    features: PatchFeatures,
    look: Look,
    box_xywh_px: Box,
    camera_matrix: Array,
    size_m: float,
    *,
    top: int = 3,
    over: Over = "foreground",
) -> list[PoseGuess]:
    """The best `top` views of a stored mesh as poses, best first.

    look: one frame of the object.  size_m: its largest extent.
    """
    patches, visible = stored_patches(store, key, features), store.views(key)["visible"]
    covered = _covered_in(store.patches(key)) if over == "union" else None
    scores = view_scores(look.patches[0], patches, look.cells[0], over, covered)
    x, y, w, h = box_xywh_px
    ray = ray_rotation(camera_matrix, np.array([x + w / 2 - 0.5, y + h / 2 - 0.5]))
    back = Rotation.from_euler("z", -look.turns_rad[:, None]).as_matrix()
    turn = np.argmax(scores, axis=1)
    guesses = []
    for view in np.argsort(-scores.max(axis=1), kind="stable")[:top]:
        k = turn[view]
        t = translation_from_box(visible[view] * (size_m / 2), box_xywh_px, camera_matrix, look.boxes_px[0, k])
        R = ray @ back[k] @ store.settings.rotations[view]
        guesses.append(PoseGuess(make_pose(R, t), float(scores[view, k])))
    return guesses


def outermost(points: Array) -> Array:
    """(K, 3) the corners of the convex hull of points (N, 3): they alone decide the box around a projection."""
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # flat, or next to it
        return points


def fit_box(points_m: Array, R: Array, t: Array, box_xywh_px: Box, camera_matrix: Array, rounds: int = 3) -> Array:
    """(3,) the translation near t at which the projection of points (N, 3) has the box's centre and mean size."""
    x, y, w, h = box_xywh_px
    target = np.array([x + w / 2, y + h / 2])
    turned = points_m @ R.T
    nearest = -float(turned[:, 2].min()) + 1e-3
    t = np.array(t, float)
    for _ in range(rounds):
        t[2] = max(t[2], nearest + 0.05 * abs(nearest))
        left, top, width, height = box_of_points(project(camera_matrix, turned + t))
        ratio = 0.5 * (width / w + height / h)
        shift = target - np.array([left + width / 2, top + height / 2])
        t[:2] += shift / np.array([camera_matrix[0, 0], camera_matrix[1, 1]]) * t[2]
        t *= ratio
    return t


@functools.lru_cache(maxsize=2)
def _fine_rotations(count: int) -> Array:
    return super_fibonacci_rotations(count)


def rotations_near(R: Array, count: int = FINE_ROTATIONS, within_rad: float = FINE_RAD) -> Array:
    """(K, 3, 3) those of `count` rotations spread over SO(3) that lie within an angle of R; R itself comes first."""
    grid = _fine_rotations(count)
    near = grid[rotation_angle_rad(grid, R) <= within_rad]
    return np.concatenate([R[None], near])


def fine_poses(
    mesh_m: ColoredMesh,
    features: PatchFeatures,
    look: Look,
    box_xywh_px: Box,
    camera_matrix: Array,
    guesses: Sequence[PoseGuess],
    extend: float,
    *,
    over: Over = "foreground",
    top: int = 1,
    within_rad: float = FINE_RAD,
) -> list[PoseGuess]:
    """Rotations near each guess drawn in the picture's own camera and compared by equation 1; the best `top` of all.

    mesh_m: in metres.  extend: of the crops of the picture; those of the drawings are equal.
    """
    tried: list[PoseGuess] = []
    corners = outermost(mesh_m.vertices)
    for guess in guesses:
        R, t = guess.T_camera_object[:3, :3], guess.T_camera_object[:3, 3]
        poses = []
        for candidate in rotations_near(R, within_rad=within_rad):
            poses.append(make_pose(candidate, fit_box(corners, candidate, t, box_xywh_px, camera_matrix)))
        views = [view_crop(mesh_m, pose, camera_matrix, extend, features.crop_px) for pose in poses]
        scores = view_scores(look.patches[0, :1], _object_patches(features, views), look.cells[0, :1], over)[:, 0]
        tried += [PoseGuess(pose, float(score)) for pose, score in zip(poses, scores, strict=True)]
    return sorted(tried, key=lambda guess: -guess.score)[:top]


def _object_patches(features: PatchFeatures, views: Sequence[View]) -> NDArray[np.float16]:
    """(B, G, G, D) unit features of views, zero off the object."""
    masks = np.stack([view.mask for view in views])
    patches = unit(features.encode(np.stack([view.rgb for view in views]), masks).patches)
    return np.asarray(patches * object_cells(masks, features.grid)[..., None], np.float16)
