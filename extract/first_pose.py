"""The first pose of an object: silhouettes of the mesh over many rotations against a mask, the best ones refined.

The object is assumed to stand upright more often than not (people film things on tables), so that rotations with the
object's +z axis up in the image are tried on a finer grid and win ties; every other rotation is tried as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .candidates import Model
from .colours import mask_evidence
from .first_search import search_rotations
from .geometry import Array, Symmetry, make_pose, super_fibonacci_rotations
from .raster import render_depth
from .region import Outline, TrackingMesh, edge_strength, extract_outline, refine
from .segment import Box, Mask, box_iou, mask_box
from .video import Image

ELEVATIONS_DEG = (0.0, 8.0, 16.0, 26.0, 38.0, 52.0)
UPRIGHT_BONUS = 0.3  # an outline alone often fits leaning toward and away from the camera as well
LEAN_LIMIT, BELOW_LIMIT = np.tan(np.deg2rad(30)), np.sin(np.deg2rad(3))  # of what is upright: in the image, from below
EDGE_WEIGHT = 0.7
BOX_WEIGHT = 1.2
NO_TRUST = 0.1  # of a mask, below which the edges there are not asked for
SEARCH_SIDE_PX = 72
SEARCH_PAD = 0.25  # of the longer side, around the box
SEARCH_FACES = 1000
CLIMBED, CLIMB_DEG = 100, (8.0, 8.0, 4.0, 4.0)  # how many poses of the coarse search are turned, and in what steps
ROUNDS: tuple[tuple[int, tuple[float, ...]], ...] = ((40, (3.0, 2.0, 1.0)), (10, (1.0, 1.0)))
"""How many poses are refined in every round, and the steps in px along the outline's lines there."""


@dataclass(frozen=True)
class PoseCandidate:
    """One explanation of a mask.

    iou: intersection over union of its silhouette with the mask.  box_iou: of its bounding box with the given box,
    which counts thin parts that masks lose.  edge: share of its outline that runs along image edges, which tells
    poses apart where the mask is wrong.  stands: whether an upright pose is likelier than others, which can only be
    said of objects whose +z is known to point up.
    """

    T_camera_object: Array
    iou: float
    box_iou: float
    edge: float = 0.0
    stands: bool = True

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
    up, centre = T_camera_object[:3, 2], T_camera_object[:3, 3]
    return bool(abs(up[0]) < -LEAN_LIMIT * up[1] and up @ centre < BELOW_LIMIT * np.linalg.norm(centre))


def find_first_pose(
    models: Sequence[Model],
    rgb: Image,
    mask: Mask,
    camera_matrix: Array,
    *,
    box_xywh_px: Box | None = None,
    trust: NDArray[np.float32] | None = None,
) -> list[tuple[PoseCandidate, Model]]:
    """Poses of any of the models that explain a mask, best first.

    Every model is drawn small with few faces in many rotations. The best of all models and of all kinds are turned to
    where they agree best with the small mask, the best of these refined in the picture, and the best of those again.

    box_xywh_px: box around the whole object; the mask's own when not given.
    trust: (H, W) in [0, 1] how far the mask is to be believed there; everywhere when not given.
    """
    box = box_xywh_px or mask_box(mask)
    trust = np.ones(mask.shape, np.float32) if trust is None else trust
    searches = [_Search.of(model, mask, camera_matrix, box, trust) for model in models]
    found = [search.judged(_rotations(search.turns)) for search in searches]
    found = [s.climbed(own) for s, own in zip(searches, _best_of_all(found, models, CLIMBED), strict=True)]
    bins, colours = mask_evidence(mask, trust)
    edges = edge_strength(rgb)
    for count, steps_px in ROUNDS:
        chosen, found = _best_of_all(found, models, count), []
        for model, own in zip(models, chosen, strict=True):
            refined = []
            for candidate in own:
                result = refine(
                    model.mesh, candidate.T_camera_object, camera_matrix, bins, colours, steps_px=steps_px,
                    prior_rotation_rad=0.12, prior_translation=0.05, prior_depth=0.1,
                )  # fmt: skip
                refined.append(
                    judge(model.mesh, result.T_camera_object, camera_matrix, edges, mask, box, candidate.stands, trust)
                )
            found.append(refined)
    ranked = [(c, model) for own, model in zip(found, models, strict=True) for c in own]
    return sorted(ranked, key=lambda entry: entry[0].merit, reverse=True)


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
    ious = silhouette_ious(mesh, T_camera_object, camera_matrix, mask, box, trust)
    edge = edge_score(mesh, T_camera_object, camera_matrix, edges, trust)
    return PoseCandidate(T_camera_object, *ious, edge, stands)


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
    window = render_depth(mesh.vertices_m, mesh.faces, T_camera_object, camera_matrix)
    if window is None:
        return 0.0, 0.0
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
    outline = extract_outline(mesh, T_camera_object, camera_matrix, (strength.shape[0], strength.shape[1]))
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


def _with_few_faces(mesh: TrackingMesh) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) and faces (F, 3) of the mesh with SEARCH_FACES at most."""
    if len(mesh.faces) <= SEARCH_FACES:
        return mesh.vertices_m, mesh.faces
    vertices, faces = fast_simplification.simplify(mesh.vertices_m, mesh.faces, target_count=SEARCH_FACES)[:2]
    return np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int32)


@dataclass(frozen=True)
class _Search:
    """A model with few faces, and the mask around the box at a small size that it is compared with."""

    model: Model
    vertices_m: Array
    faces: NDArray[np.int32]
    camera_matrix: Array
    box: Array
    mask: Mask
    trust: NDArray[np.float32]

    @staticmethod
    def of(model: Model, mask: Mask, camera_matrix: Array, box: Box, trust: NDArray[np.float32]) -> _Search:
        scale, pad_px = SEARCH_SIDE_PX / max(box[2], box[3]), SEARCH_PAD * SEARCH_SIDE_PX
        soft_mask, small_camera = _shrunk(mask, camera_matrix, box, scale)
        small_trust = _shrunk(trust, camera_matrix, box, scale)[0]
        small_box = np.array([pad_px, pad_px, box[2] * scale, box[3] * scale])
        return _Search(model, *_with_few_faces(model.mesh), small_camera, small_box, soft_mask > 0.5, small_trust)

    @property
    def turns(self) -> int:
        """After what share of a turn about +z the model is the same; 0 is any."""
        symmetry = self.model.symmetry
        return symmetry.order if abs(symmetry.axis[2]) > 0.99 else 1

    def judged(self, rotations: Array) -> list[PoseCandidate]:
        """The poses with rotations (N, 3, 3) whose projection has the box's size and centre."""
        centres_m, ious = np.empty((len(rotations), 3)), np.empty((len(rotations), 2))
        search_rotations(
            self.vertices_m, self.faces, self.model.mesh.radius_m, rotations, self.camera_matrix, self.box,
            self.mask, self.trust, centres_m, ious,
        )  # fmt: skip
        stands = self.model.vessel is not None
        return [
            PoseCandidate(make_pose(R, t), iou, box_iou, stands=stands)
            for R, t, (iou, box_iou) in zip(rotations, centres_m, ious.tolist(), strict=True)
        ]

    def climbed(self, found: Sequence[PoseCandidate]) -> list[PoseCandidate]:
        """The poses turned a little, again and again, to where they agree best with the mask."""
        better = list(found)
        for step_deg in CLIMB_DEG:
            turns = Rotation.from_rotvec(step_deg * np.vstack([np.eye(3), -np.eye(3)]), degrees=True).as_matrix()
            near = [self.judged(turns @ c.T_camera_object[:3, :3]) for c in better]
            better = [max([c, *around], key=lambda c: c.merit) for c, around in zip(better, near, strict=True)]
        return better


@lru_cache
def _rotations(turns: int) -> Array:
    """(N, 3, 3) to try for a mesh that is the same after a `turns`-th of a turn about +z, any turn if it is 0."""
    yaws_deg = np.arange(0.0, 360.0 / turns, 10.0) if turns else (0.0,)
    upright = [upright_rotation(elevation, float(yaw)) for elevation in ELEVATIONS_DEG for yaw in yaws_deg]
    return np.concatenate([upright, super_fibonacci_rotations(600)])


def _best_of_all(
    found: Sequence[Sequence[PoseCandidate]], models: Sequence[Model], count: int
) -> list[list[PoseCandidate]]:
    """The `count` best poses of all models, and of each model only its best few and the best of other kinds."""
    pool: list[tuple[PoseCandidate, int]] = []
    first = count // 5
    for k, (own, model) in enumerate(zip(found, models, strict=True)):
        ranked = sorted(own, key=lambda c: c.merit, reverse=True)
        others = distinct(ranked[first:], 15, count - first, np.inf, model.symmetry)
        pool += [(candidate, k) for candidate in [*ranked[:first], *others]]
    pool.sort(key=lambda entry: entry[0].merit, reverse=True)
    return [[c for c, of in pool[:count] if of == k] for k in range(len(models))]


def _shrunk(image: NDArray[Any], camera_matrix: Array, box: Box, scale: float) -> tuple[NDArray[np.float32], Array]:
    """A mask or a map of trust around the box at a small size, and the camera that sees it so."""
    pad = SEARCH_PAD * max(box[2], box[3])
    x0, y0 = box[0] - pad, box[1] - pad
    size = (round((box[2] + 2 * pad) * scale), round((box[3] + 2 * pad) * scale))
    warp = np.array([[scale, 0.0, -x0 * scale], [0.0, scale, -y0 * scale]])
    small = cv2.warpAffine(image.astype(np.float32), warp, size, flags=cv2.INTER_AREA)
    return np.asarray(small, np.float32), np.vstack([warp, [0.0, 0.0, 1.0]]) @ camera_matrix
