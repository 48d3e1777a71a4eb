"""The first pose of an object: silhouettes of the mesh over many rotations against a mask, the best ones refined.

The object is assumed to stand upright more often than not (people film things on tables), so that rotations with the
object's +z axis up in the image are tried on a finer grid and win ties; every other rotation is tried as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import cv2
import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .candidates import Model
from .colours import mask_evidence
from .first_search import place_in_box, silhouettes_agree
from .geometry import Array, Symmetry, make_pose, super_fibonacci_rotations
from .meshes import THINNING
from .raster import DepthWindow
from .region import Outline, TrackingMesh, draw_outline, draw_window, edge_strength, refine, trace_outline
from .segment import Box, Mask, box_iou, mask_box
from .video import Image

ELEVATIONS_DEG = (0.0, 8.0, 16.0, 26.0, 38.0, 52.0)
UPRIGHT_BONUS = 0.3  # an outline alone often fits leaning toward and away from the camera as well
EDGE_WEIGHT = 0.7
BOX_WEIGHT = 1.2
NO_TRUST = 0.1  # of a mask, below which the edges there are not asked for
SEARCH_SIDE_PX = 72
SEARCH_PAD = 0.25  # of the longer side, around the box
SEARCH_FACES = 1000
OTHER_DEG = 15.0  # from one pose to another kind
ROUNDS: tuple[tuple[int, tuple[float, ...]], ...] = ((40, (4.0, 2.0)), (14, (3.0, 2.0, 1.0)), (5, (1.0, 1.0)))
"""How many poses are refined in every round, and the steps in px along the outline's lines there."""


@dataclass(frozen=True)
class PoseCandidate:
    """One explanation of a mask.

    iou: intersection over union of its silhouette with the mask.  box_iou: of its bounding box with the given box,
    which counts thin parts that masks lose.  edge: share of its outline that runs along image edges, which tells
    poses apart where the mask is wrong.  stands: whether an upright pose is likelier than others, which can only be
    said of objects whose +z is known to point up.  outline: as it was drawn to judge the pose, if it was.
    """

    T_camera_object: Array
    iou: float
    box_iou: float
    edge: float = 0.0
    stands: bool = True
    outline: Outline | None = field(default=None, repr=False, compare=False)

    @cached_property
    def merit(self) -> float:
        """What candidates are ranked by."""
        return (
            self.iou
            + BOX_WEIGHT * self.box_iou
            + EDGE_WEIGHT * self.edge
            + UPRIGHT_BONUS * (self.stands and is_upright(self.T_camera_object))
        )


def upright_rotation(elevation_deg: float, yaw_deg: float, roll_deg: float = 0.0) -> Array:
    """(3, 3) R_camera_object of an upright object seen by a camera that looks down by `elevation_deg`.

    yaw_deg turns the object about its own +z; roll_deg tilts it in the image, clockwise as seen.
    """
    rotation = Rotation.from_euler("z", roll_deg, degrees=True) * Rotation.from_euler(
        "x", 90 + elevation_deg, degrees=True
    )
    return np.asarray((rotation * Rotation.from_euler("z", yaw_deg, degrees=True)).as_matrix())


def is_upright(T_camera_object: Array) -> bool:
    """Whether the object stands upright within 30 degrees in the image and is seen from above, as on a table."""
    up, towards = T_camera_object[:3, 2], T_camera_object[:3, 3] / np.linalg.norm(T_camera_object[:3, 3])
    lean_rad = np.arctan2(abs(up[0]), -up[1])
    return bool(lean_rad < np.deg2rad(30) and up @ towards < np.sin(np.deg2rad(3)))


def find_first_pose(
    model: Model,
    rgb: Image,
    mask: Mask,
    camera_matrix: Array,
    *,
    box_xywh_px: Box | None = None,
    trust: NDArray[np.float32] | None = None,
    standing: bool = True,
) -> list[PoseCandidate]:
    """Poses that explain a mask, best first.

    Every rotation is drawn small with few faces; the best and the best of other kinds are refined a little, and the
    best of these to the end.

    box_xywh_px: box around the whole object; the mask's own when not given.
    trust: (H, W) in [0, 1] how far the mask is to be believed there; everywhere when not given.
    standing: whether an upright pose of a vessel is likelier than others.
    """
    box = box_xywh_px or mask_box(mask)
    trust = np.ones(mask.shape, np.float32) if trust is None else trust
    stands = standing and model.vessel is not None
    found = _searched(model, mask, camera_matrix, box, trust, stands)
    bins, colours = mask_evidence(mask, trust)
    edges = edge_strength(rgb)
    for count, steps_px in ROUNDS:
        first = count // 5
        chosen = found[:first] + distinct(found[first:], OTHER_DEG, count - first, np.inf, model.symmetry)
        found = []
        for candidate in chosen:
            result = refine(
                model.mesh, candidate.T_camera_object, camera_matrix, bins, colours, steps_px=steps_px,
                prior_rotation_rad=0.12, prior_translation=0.05, prior_depth=0.1, outline=candidate.outline,
            )  # fmt: skip
            found.append(judge(model.mesh, result.T_camera_object, camera_matrix, edges, mask, box, stands, trust))
        found.sort(key=lambda c: c.merit, reverse=True)
    return found


def judge(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    edges: NDArray[np.float32],
    mask: Mask,
    box: Box,
    stands: bool = True,
    trust: NDArray[np.float32] | None = None,
) -> PoseCandidate:
    """How well a pose explains the edges of an image, the mask cut from it and the box around the object."""
    window = draw_window(mesh, T_camera_object, camera_matrix)
    if window is None:
        return PoseCandidate(T_camera_object, 0.0, 0.0, 0.0, stands)
    outline = trace_outline(window, mesh, T_camera_object, camera_matrix)
    edge = _share_explained(outline, T_camera_object, camera_matrix, edges, trust)
    return PoseCandidate(T_camera_object, *_ious(window, mask, box, trust), edge, stands, outline)


def distinct(
    candidates: Sequence[PoseCandidate], apart_deg: float, count: int, within: float, symmetry: Symmetry
) -> list[PoseCandidate]:
    """The best candidates at least `apart_deg` from each other, none worse than the best by more than `within`."""
    if not candidates:
        return []
    rotations = np.stack([candidate.T_camera_object[:3, :3] for candidate in candidates])
    kept: list[PoseCandidate] = []
    far = np.array([candidate.merit > candidates[0].merit - within for candidate in candidates])
    while far.any() and len(kept) < count:
        k = int(np.argmax(far))  # the first, and so the best, that is far from all taken
        kept.append(candidates[k])
        far &= np.rad2deg(symmetry.error_rad(rotations, rotations[k])) > apart_deg
        far[: k + 1] = False
    return kept


def silhouette_ious(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    mask: Mask,
    box_xywh_px: Box,
    trust: NDArray[np.float32] | None = None,
) -> tuple[float, float]:
    """Intersection over union of the silhouette, cut to the image, with a mask, and of its bounding box with a box.

    Pixels count as far as the mask is to be trusted there.
    """
    window = mesh.drawn(T_camera_object, camera_matrix)
    return (0.0, 0.0) if window is None else _ious(window, mask, box_xywh_px, trust)


def _ious(window: DepthWindow, mask: Mask, box_xywh_px: Box, trust: NDArray[np.float32] | None) -> tuple[float, float]:
    silhouette, place = window.part_in_image(mask.shape[1], mask.shape[0])
    if not silhouette.any():
        return 0.0, 0.0

    def amount(pixels: NDArray[np.bool_], where: tuple[slice, slice]) -> float:
        return float(np.count_nonzero(pixels) if trust is None else trust[where][pixels].sum())

    here = mask[place]
    shared = amount(silhouette & here, place)
    either = amount(mask, np.s_[:, :]) + amount(silhouette & ~here, place)
    x, y, width, height = mask_box(silhouette)
    box = (x + place[1].start, y + place[0].start, width, height)
    return shared / max(either, 1.0), box_iou(box, box_xywh_px)


def edge_score(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    strength: NDArray[np.float32],
    trust: NDArray[np.float32] | None = None,
) -> float:
    """Share of outline and jumps within it, in [0, 1], along which the image has an edge of the same direction.

    Within 2 px, and not counting where the mask is not to be trusted at all: the edges there are those of a hand.
    Bends of a surface need not show.
    """
    outline = draw_outline(mesh, T_camera_object, camera_matrix)
    return _share_explained(outline, T_camera_object, camera_matrix, strength, trust)


def _share_explained(
    outline: Outline | None,
    T_camera_object: Array,
    camera_matrix: Array,
    strength: NDArray[np.float32],
    trust: NDArray[np.float32] | None,
) -> float:
    outline = None if outline is None else outline.inside((strength.shape[0], strength.shape[1]))
    if outline is None:
        return 0.0
    pixel, normal = outline.pixel, outline.normal
    if outline.creases is not None:
        inner, across = outline.creases.seen(T_camera_object, camera_matrix)
        jump = outline.creases.jump
        pixel, normal = np.concatenate([pixel, inner[jump]]), np.concatenate([normal, across[jump]])
    if trust is not None:
        x, y = np.clip(np.round(pixel), 0, [trust.shape[1] - 1, trust.shape[0] - 1]).astype(int).T
        told = trust[y, x] > NO_TRUST
        pixel, normal = pixel[told], normal[told]
    return _share_on_edges(pixel, normal, strength)


def share_on_edges(outline: Outline, strength: NDArray[np.float32]) -> float:
    """Share of an outline drawn before, without its inner contours, that runs along image edges; see `edge_score`."""
    return _share_on_edges(outline.pixel, outline.normal, strength)


def _share_on_edges(pixel: Array, normal: Array, strength: NDArray[np.float32]) -> float:
    if len(pixel) == 0:
        return 0.0
    best = np.zeros(len(pixel))
    for offset in range(-2, 3):
        x, y = np.round(pixel + offset * normal).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < strength.shape[1]) & (y < strength.shape[0])
        along = np.abs(np.sum(strength[y * inside, x * inside] * normal, axis=1))
        best = np.maximum(best, np.where(inside, along, 0.0))
    return float(np.mean(np.minimum(best, 1.0)))


def _searched(
    model: Model, mask: Mask, camera_matrix: Array, box: Box, trust: NDArray[np.float32], stands: bool
) -> list[PoseCandidate]:
    """The model in many rotations where it fills the box, by how well it agrees with the mask there, best first."""
    scale, pad_px = SEARCH_SIDE_PX / max(box[2], box[3]), SEARCH_PAD * SEARCH_SIDE_PX
    soft_mask, small_camera = _shrunk(mask, camera_matrix, box, scale)
    small_trust = _shrunk(trust, camera_matrix, box, scale)[0]
    small_box = (pad_px, pad_px, box[2] * scale, box[3] * scale)
    (vertices_m, faces), rotations = _with_few_faces(model.mesh), _rotations(model.symmetry)
    origins_m = place_in_box(vertices_m, rotations, small_camera, small_box)
    ious = silhouettes_agree(
        vertices_m, faces, rotations, origins_m, small_camera, soft_mask > 0.5, small_trust, small_box
    )
    found = [
        PoseCandidate(make_pose(R, t), iou, box_iou, stands=stands)
        for R, t, (iou, box_iou) in zip(rotations, origins_m, ious.tolist(), strict=True)
    ]
    return sorted(found, key=lambda c: c.merit, reverse=True)


def _with_few_faces(mesh: TrackingMesh) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) and faces (F, 3) of the mesh with SEARCH_FACES at most."""
    if len(mesh.faces) <= SEARCH_FACES:
        return mesh.vertices_m, mesh.faces
    with THINNING:
        vertices, faces = fast_simplification.simplify(mesh.vertices_m, mesh.faces, target_count=SEARCH_FACES)[:2]
    return np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int32)


@lru_cache
def _rotations(symmetry: Symmetry) -> Array:
    """(N, 3, 3) to try for a mesh that looks the same after some turns."""
    turns = symmetry.order if abs(symmetry.axis[2]) > 0.99 else 1
    yaws_deg = np.arange(0.0, 360.0 / turns, 10.0) if turns else (0.0,)
    upright = [upright_rotation(elevation, float(yaw)) for elevation in ELEVATIONS_DEG for yaw in yaws_deg]
    return np.concatenate([upright, super_fibonacci_rotations(600)])


def _shrunk(image: NDArray[Any], camera_matrix: Array, box: Box, scale: float) -> tuple[NDArray[np.float32], Array]:
    """A mask or a map of trust around the box at a small size, and the camera that sees it so."""
    pad = SEARCH_PAD * max(box[2], box[3])
    x0, y0 = box[0] - pad, box[1] - pad
    size = (round((box[2] + 2 * pad) * scale), round((box[3] + 2 * pad) * scale))
    warp = np.array([[scale, 0.0, -x0 * scale], [0.0, scale, -y0 * scale]])
    small = cv2.warpAffine(image.astype(np.float32), warp, size, flags=cv2.INTER_AREA)
    return np.asarray(small, np.float32), np.vstack([warp, [0.0, 0.0, 1.0]]) @ camera_matrix
