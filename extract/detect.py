"""Find a named object in the first frame when no box is given: outlines of its mesh against oriented image edges.

Templates of the mesh over sizes, elevations and yaws slide over maps of edge strength per direction (in the spirit of
LINE-MOD, Hinterstoisser et al., 2012); the best places are judged again by how the region differs in colour from its
surroundings, by how much of it moved in the clip, and by how well a mask cut there agrees with the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .colours import mask_evidence
from .crew import side_by_side
from .first_pose import edge_score, silhouette_ious, upright_rotation
from .geometry import Array, make_pose, projected_box, scaled_camera
from .handled import Handled, find_handled, reach_from_border
from .region import TrackingMesh, draw_outline, edge_strength, refine
from .segment import Box, Mask, box_iou, mask_box, mask_from_box
from .video import Image

SEARCH_WIDTH_PX = 240
DIRECTIONS = 8
OUTLINE_POINTS = 64
SIZES = tuple(0.1 * 1.22**k for k in range(11))  # longest side of the object over the longest side of the image
ELEVATIONS_DEG = (5.0, 18.0, 35.0)
YAW_STEP_DEG = 15.0
MOVED_LAB = 14.0  # colour change, in Lab units, that counts as motion
LEAST_MERIT = 1.2
MOVED_SHARE = 0.4  # of what is handled, least, where more than SOMETHING_MOVED of the picture moves
SOMETHING_MOVED = 0.005
EXPLAINED_WEIGHT, REACHED_WEIGHT = 2.0, 1.0
HAND_REACH = 0.65  # of the way from the picture's border to the farthest that moves: no sleeve goes so far
REFINED, CUT_ROUNDS = 8, 2
PLACES, PLACES_WITHIN, REACHED_WITHIN = 3, 0.3, 0.1
SAME_PLACE = 0.8  # of two boxes, intersection over union from which on one is as good as the other


@dataclass(frozen=True)
class _Match:
    score: float
    mesh: int
    T_camera_object: Array


@dataclass(frozen=True)
class _Arm:
    """What comes into the picture and what it holds, at searching size: how far it reaches, the thing and the arm."""

    reach: NDArray[np.int32]
    thing: Mask | None
    arm: Mask | None

    @staticmethod
    def of(moving: Mask, held: Handled | None) -> _Arm:
        reach, size = reach_from_border(moving), (moving.shape[1], moving.shape[0])
        if held is None:
            return _Arm(reach, None, None)
        small = [
            cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5 for m in (held.thing, held.arm)
        ]
        return _Arm(reach, *small)

    def reached(self, silhouette: Mask) -> float:
        """How far out along the arm a silhouette is, in [0, 1]: hands hold things, sleeves do not."""
        here = self.reach[silhouette & (self.reach > 0)]
        return min(1.0, float(np.median(here)) / (HAND_REACH * float(self.reach.max()))) if len(here) else 0.0

    def explained(self, silhouette: Mask) -> float:
        """Share, in [0, 1], that a silhouette explains of what is farther out than it begins, and of the thing."""
        here = self.reach[silhouette & (self.reach > 0)]
        beyond = self.reach >= np.percentile(here, 10) if len(here) else silhouette
        share = np.count_nonzero(silhouette & beyond) / max(np.count_nonzero(silhouette | beyond), 1)
        if self.thing is None or self.arm is None:
            return float(share)
        shown = silhouette & ~self.arm  # of what the hand hides nothing can be said
        both = np.count_nonzero(shown & self.thing) / max(np.count_nonzero(shown | self.thing), 1)
        return float(share + 2 * both) / 3


def motion_since(first: Image, others: Sequence[Image]) -> Array:
    """(H, W) share of other frames, in [0, 1], whose colour at a pixel differs from the first one's."""
    reference = _soft_lab(first)
    changed = np.zeros(first.shape[:2])
    for rgb in others:
        changed += np.linalg.norm(_soft_lab(rgb) - reference, axis=-1) > MOVED_LAB
    return changed / max(len(others), 1)


def find_places(
    rgb: Image,
    moved: Array,
    meshes: Sequence[TrackingMesh],
    camera_matrix: Array,
    *,
    handled: bool,
    taken: Sequence[Mask] = (),
    labels: NDArray[np.uint8] | None = None,
) -> list[Box]:
    """Boxes of the places that look most like one of the meshes, best first; empty when nothing does.

    All that look about as much like it as the best and lie elsewhere, PLACES at most.
    moved: from `motion_since`.  handled: the object is the one that is handled, so that it must have moved.
    taken: masks of objects found before, which cannot be found again.  labels: of a `Background`, if there is one.
    """
    scale = SEARCH_WIDTH_PX / max(rgb.shape[:2])
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small_camera = scaled_camera(camera_matrix, scale)
    edges = _edge_maps(np.asarray(small, np.uint8))
    size = (small.shape[1], small.shape[0])
    small_moved = np.asarray(cv2.resize(moved.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    places = np.ones(small.shape[:2], bool)
    if handled and small_moved.mean() > SOMETHING_MOVED:
        # What stands still is clutter: its edges are no part of what is handled.
        edges = edges * (cv2.dilate(small_moved, np.ones((5, 5), np.uint8)) > MOVED_SHARE)
        places = small_moved > MOVED_SHARE
    held = find_handled(rgb, labels) if handled and labels is not None else None
    arm = _Arm.of(small_moved > MOVED_SHARE, held) if handled else None
    slide = partial(_slide, meshes, edges, small_camera, places)
    matches = list(chain.from_iterable(side_by_side(slide, range(len(meshes)))))
    matches.sort(key=lambda m: m.score, reverse=True)

    small_taken = [cv2.resize(mask.astype(np.uint8), size) > 0 for mask in taken]
    lab = _soft_lab(np.asarray(small, np.uint8))
    judged: list[tuple[float, _Match]] = []
    for match in matches[:400]:
        merit = _judge(match, meshes[match.mesh], small_camera, lab, small_moved, small_taken, arm)
        judged.append((merit, match))
    judged.sort(key=lambda entry: entry[0], reverse=True)

    strength = edge_strength(rgb)
    found: list[tuple[float, float, Box]] = []
    for merit, match in _spread(judged, meshes, small_camera, REFINED):
        mesh, T = meshes[match.mesh], match.T_camera_object
        window = mesh.drawn(T, camera_matrix)
        if window is None or not (silhouette := window.mask_in_image(rgb.shape[1], rgb.shape[0])).any():
            continue
        mask = mask_from_box(rgb, _grown(mask_box(silhouette), 0.06, rgb), CUT_ROUNDS)
        T = refine(
            mesh, T, camera_matrix, *mask_evidence(mask), steps_px=(5, 3, 2, 1),
            prior_rotation_rad=0.12, prior_translation=0.05, prior_depth=0.1,
        ).T_camera_object  # fmt: skip
        window = mesh.drawn(T, camera_matrix)
        if window is None or not (silhouette := window.mask_in_image(rgb.shape[1], rgb.shape[0])).any():
            continue
        box = mask_box(silhouette)
        iou, _ = silhouette_ious(mesh, T, camera_matrix, mask, box)
        size_share = np.sqrt(np.hypot(box[2], box[3]) / max(rgb.shape[:2]))
        total = merit + size_share * (iou + edge_score(mesh, T, camera_matrix, strength))
        reached = 1.0 if arm is None else arm.reached(cv2.resize(silhouette.astype(np.uint8), size) > 0)
        if total > LEAST_MERIT:
            found.append((float(total), reached, _grown(box, 0.03, rgb)))
    found.sort(key=lambda entry: entry[0], reverse=True)
    boxes: list[Box] = []
    for total, reached, box in found:
        near_best = total > found[0][0] - PLACES_WITHIN and reached > found[0][1] - REACHED_WITHIN
        if near_best and len(boxes) < PLACES and all(box_iou(box, other) < SAME_PLACE for other in boxes):
            boxes.append(box)
    return boxes


def _soft_lab(rgb: Image) -> NDArray[np.float32]:
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    return np.asarray(cv2.GaussianBlur(lab, (0, 0), 1.5), np.float32)


def _edge_maps(rgb: Image) -> NDArray[np.float32]:
    """(DIRECTIONS, H, W) edge strength by direction of the gradient modulo 180 degrees, less the mean over directions.

    Taking off the mean makes clutter, which has edges of every direction, worth nothing.
    """
    gradient = edge_strength(rgb)
    magnitude = np.minimum(np.linalg.norm(gradient, axis=-1), 1.0)
    angle = np.arctan2(gradient[..., 1], gradient[..., 0]) % np.pi * DIRECTIONS / np.pi
    maps = []
    for k in range(DIRECTIONS):
        gap = np.abs((angle - k + DIRECTIONS / 2) % DIRECTIONS - DIRECTIONS / 2)
        response = (magnitude * np.clip(1.5 - gap, 0.0, 1.0)).astype(np.float32)
        maps.append(cv2.dilate(response, np.ones((3, 3), np.uint8)))
    stack = np.stack(maps)
    return np.asarray(stack - stack.mean(axis=0), np.float32)


def _slide(
    meshes: Sequence[TrackingMesh],
    edges: NDArray[np.float32],
    camera_matrix: Array,
    places: NDArray[np.bool_],
    index: int,
) -> list[_Match]:
    """Best places of every template of one of the meshes, its centre where `places` (H, W) allow it."""
    mesh, (height, width) = meshes[index], places.shape
    longest = max(height, width)
    centre = np.array([width / 2, height / 2])
    inverse = np.linalg.inv(camera_matrix)
    pad = int(0.5 * max(SIZES) * longest) + 4
    padded = np.pad(edges, [(0, 0), (pad, pad), (pad, pad)])
    matches = []
    for elevation in ELEVATIONS_DEG:
        for yaw in np.arange(0.0, 360.0, YAW_STEP_DEG):
            R = upright_rotation(elevation, float(yaw))
            extent = float(np.ptp(mesh.vertices_m @ R.T, axis=0)[:2].max())
            depths = [extent * camera_matrix[0, 0] / (size * longest) for size in SIZES]
            poses = [make_pose(R, inverse @ np.array([*centre, 1.0]) * depth) for depth in depths]
            # Drawn once, at a middling size: nearer or farther the outline runs along the same points.
            drawn = draw_outline(mesh, poses[len(SIZES) // 2], camera_matrix, OUTLINE_POINTS, with_creases=False)
            for T, depth in zip(poses, depths, strict=True):
                if drawn is None or depth < 2.0 * mesh.radius_m:
                    continue
                outline = drawn.moved(T, camera_matrix).inside((height, width))
                if outline is None or len(outline) < OUTLINE_POINTS // 2:
                    continue
                angle = np.arctan2(outline.normal[:, 1], outline.normal[:, 0]) % np.pi
                bins = np.round(angle * DIRECTIONS / np.pi).astype(int) % DIRECTIONS
                offset = np.round(outline.pixel - centre).astype(int)
                total = np.full((height, width), -np.inf, np.float32)
                _add_up(padded, bins, offset, places, total)
                # A long outline that fits is better evidence than a short one: noise averages out with its root.
                steps = np.linalg.norm(np.diff(outline.pixel, axis=0), axis=1)
                evidence = float(np.sqrt(np.minimum(steps, 12.0).sum() / longest)) / len(outline)
                for _ in range(2):
                    y, x = np.unravel_index(int(np.argmax(total)), total.shape)
                    placed = make_pose(R, inverse @ np.array([x, y, 1.0]) * depth)
                    matches.append(_Match(float(total[y, x]) * evidence, index, placed))
                    total[max(y - 8, 0) : y + 9, max(x - 8, 0) : x + 9] = -np.inf
    return matches


@numba.njit(cache=True, nogil=True)
def _add_up(
    edges: NDArray[np.float32], bins: NDArray[np.int_], offset: NDArray[np.int_], places: NDArray[np.bool_],
    total: NDArray[np.float32],
) -> None:  # fmt: skip
    """Into `total` (H, W) what edge maps (D, H + 2 pad, W + 2 pad) hold along an outline, wherever `places` allow it.

    bins: (N,) which map each point of the outline asks.  offset: (N, 2) x, y of the points from the place.
    """
    pad = (edges.shape[1] - len(places)) // 2
    for y in range(len(places)):
        allowed = np.flatnonzero(places[y])
        if len(allowed) == 0:
            continue
        first, last = allowed[0], allowed[-1] + 1
        row = np.zeros(last - first, np.float32)
        for i in range(len(bins)):
            dx, dy = offset[i]
            if abs(dx) <= pad and abs(dy) <= pad:
                row += edges[bins[i], pad + dy + y, pad + dx + first : pad + dx + last]
        for x in allowed:
            total[y, x] = row[x - first]


def _judge(
    match: _Match,
    mesh: TrackingMesh,
    camera_matrix: Array,
    lab: NDArray[np.float32],
    moved: NDArray[np.float32],
    taken: Sequence[Mask],
    arm: _Arm | None,
) -> float:
    """Edge score, plus how far the region's colours differ from the ring around it; and for what is handled, more.

    arm: for what is handled: it must have moved, and is all there is at the end of an arm.
    """
    height, width = moved.shape
    window = mesh.drawn(match.T_camera_object, camera_matrix)
    if window is None:
        return -np.inf
    silhouette = window.mask_in_image(width, height)
    area = np.count_nonzero(silhouette)
    if area < 0.6 * np.count_nonzero(window.mask) or area < 30:
        return -np.inf
    if any(np.count_nonzero(silhouette & other) > 0.3 * area for other in taken):
        return -np.inf
    ring = cv2.dilate(silhouette.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
    ring &= ~silhouette
    cells = (lab * (8 / 256)).astype(int)
    code = cells[..., 0] * 64 + cells[..., 1] * 8 + cells[..., 2]
    inside = np.bincount(code[silhouette], minlength=512) / area
    outside = np.bincount(code[ring], minlength=512) / max(np.count_nonzero(ring), 1)
    contrast = 1.0 - float(np.sqrt(inside * outside).sum())
    motion = float(moved[silhouette].mean())
    if arm is None:
        return 1.5 * match.score + 0.5 * contrast
    if moved.mean() <= SOMETHING_MOVED:
        return 1.5 * match.score + 0.5 * contrast + 0.6 * motion
    if motion < MOVED_SHARE:
        return -np.inf
    held = EXPLAINED_WEIGHT * arm.explained(silhouette) - REACHED_WEIGHT * (1.0 - arm.reached(silhouette))
    return 1.5 * match.score + 0.5 * contrast + 0.6 * motion + held


def _spread(
    judged: Sequence[tuple[float, _Match]], meshes: Sequence[TrackingMesh], camera_matrix: Array, count: int
) -> list[tuple[float, _Match]]:
    """The best matches that do not fill the same part of the picture as better ones."""
    kept: list[tuple[float, _Match]] = []
    boxes: list[Box] = []
    for merit, match in judged:
        if not np.isfinite(merit):
            break
        box = projected_box(camera_matrix, match.T_camera_object, meshes[match.mesh].vertices_m)
        if box is not None and all(box_iou(box, other) < SAME_PLACE for other in boxes):
            kept.append((merit, match))
            boxes.append(box)
        if len(kept) == count:
            break
    return kept


def _grown(box: Box, share: float, rgb: Image) -> Box:
    x, y, w, h = box
    x_a, y_a = max(x - share * w, 0.0), max(y - share * h, 0.0)
    x_b, y_b = min(x + (1 + share) * w, float(rgb.shape[1])), min(y + (1 + share) * h, float(rgb.shape[0]))
    return x_a, y_a, x_b - x_a, y_b - y_a
