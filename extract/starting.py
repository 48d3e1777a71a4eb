"""Where an object is and how it is turned in the frame that its track starts from, with what else it might be.

Candidate meshes are compared by the first poses they allow, the best few are carried on with the vessel's shape fitted
to the picture. What explains the picture nearly as well but is turned otherwise is kept beside the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .background import mask_trust
from .candidates import Model, ObjectRequest, vessel_model
from .colours import mask_evidence
from .crew import side_by_side
from .errors import UserError
from .first_pose import PoseCandidate, distinct, find_first_pose, judge
from .geometry import Array, scaled_camera
from .region import TrackingMesh, edge_strength
from .segment import Box, Mask, mask_box, mask_from_box, mask_from_silhouette
from .shape_fit import View, coloured, fit_shape
from .video import Image

WORKING_SIDE_PX = 640  # tracking
STARTING_SIDE_PX = 1280  # the first frame, where thin parts such as spouts must be seen to be fitted
FOUND_IOU = 0.45  # below this no pose of the mesh explains what was cut out of the first frame
HYPOTHESES = 3  # first poses, far from each other, that a shape is fitted to
HYPOTHESES_WITHIN = 0.5  # of the best one's merit
KINDS = 4  # of pose, where it need not stand: either end up, leaning toward the camera or away
APART_DEG = 40.0
RIVAL_WITHIN = 0.2  # of the best one's merit: nearly as good
FLAT_GREY_LEVELS = 2.0  # standard deviation in the box, below which there is nothing to see
FIT_ROUNDS = 2  # of cutting the mask near the silhouette and fitting the shape to it, at full sharpness
COARSE_STEPS_PX = (3.0, 1.5)
RECUT_BAND = 0.03  # of the object's size in the image


class NotFoundError(UserError):
    """The object is not where it was looked for."""


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of the start frame, at the starting resolution.

    mask, box: of the object as it is explained.  evidence: the mask that it was fitted to.
    """

    model: Model
    pose: PoseCandidate
    mask: Mask
    box: Box
    evidence: Mask


@dataclass(frozen=True)
class Start:
    """An object in the start frame, at the starting resolution: its explanations, best first.

    box_source: "given", "mask", "found", "followed" or "widened".  box: where it was looked for.  labels: of the
    background, if it is known.  frame: index of the start frame in the clip.  other_places: boxes where it might be as
    well, the likeliest first.
    """

    hypotheses: tuple[Hypothesis, ...]
    box_source: str
    box: Box
    labels: NDArray[np.uint8] | None = None
    frame: int = 0
    other_places: tuple[Box, ...] = ()

    @property
    def best(self) -> Hypothesis:
        return self.hypotheses[0]

    def described(self) -> dict[str, Any]:
        """For the track's header: how well the best explains the picture, and what else was nearly as good."""
        best, *others = self.hypotheses
        symmetry, R = best.model.symmetry, best.pose.T_camera_object[:3, :3]
        return {
            "iou": round(best.pose.iou, 4),
            "edge": round(best.pose.edge, 4),
            "merit": round(best.pose.merit, 4),
            "alternatives": [
                {
                    "mesh": other.model.header["name"],
                    "merit": round(other.pose.merit, 4),
                    "apart_deg": round(float(np.rad2deg(symmetry.error_rad(R, other.pose.T_camera_object[:3, :3]))), 1),
                    "T_camera_object": np.round(other.pose.T_camera_object, 6).tolist(),
                }
                for other in others
            ],
        }

    def preferring(self, index: int) -> Start:
        """The same with another hypothesis put first."""
        chosen = self.hypotheses[index]
        return replace(self, hypotheses=(chosen, *(h for h in self.hypotheses if h is not chosen)))


def start_object(
    request: ObjectRequest,
    candidates: Sequence[Model],
    rgb: Image,
    boxes: Sequence[Box],
    source: str,
    camera_matrix: Array,
    mask: Mask | None = None,
    labels: NDArray[np.uint8] | None = None,
    standing: bool = True,
) -> Start:
    """What the object may be and how it may stand in the start frame, fitted coarsely, best first.

    In that one of the boxes, places where it may be, of which most is explained.
    rgb, boxes, camera_matrix and mask (cut from the box when None) are at the starting resolution.
    labels: (H, W) of the background, at any resolution, where it is known.
    standing: whether it stands upright more likely than not; otherwise what it may be is of several kinds.
    Raises NotFoundError when no pose of any candidate explains what is there.
    """
    # Coarse first: at full sharpness highlights and texture tear the mask apart.
    shrink = min(1.0, WORKING_SIDE_PX / max(rgb.shape[:2]))
    small = np.asarray(cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
    camera, small_mask = scaled_camera(camera_matrix, shrink), None if mask is None else resized(mask, small)
    found: list[tuple[Box, list[_Fit]]] = []
    refusal = NotFoundError(f"object {request.name!r} was not found: nothing looks like it")
    for box in boxes:
        try:
            x, y, w, h = (round(v) for v in box)
            if rgb[y : y + h, x : x + w].std(axis=(0, 1)).max() < FLAT_GREY_LEVELS:
                raise NotFoundError(f"object {request.name!r} was not found: the frame is of one colour there")
            there = scaled(box, shrink)
            fits = _fits_in(there, request, candidates, small, source, camera, small_mask, labels, standing)
            found.append((box, fits))
        except NotFoundError as error:
            refusal = error
    if not found:
        raise refusal
    found.sort(key=lambda entry: entry[1][0].pose.merit, reverse=True)
    box, fits = found[0]
    within = RIVAL_WITHIN if standing else HYPOTHESES_WITHIN
    kept = distinct([fit.pose for fit in fits], APART_DEG, len(fits), within, fits[0].model.symmetry)
    explained = [
        _hypothesis(fit, resized(fit.evidence(small, camera), rgb) if mask is None else mask, rgb, camera_matrix)
        for fit in fits
        if any(fit.pose is k for k in kept)
    ]
    return Start(tuple(explained), source, box, labels, other_places=tuple(place for place, _ in found[1:]))


@dataclass(frozen=True)
class _Fit:
    """A first pose carried on, and the mask it was fitted to, to be cut again so near its silhouette if it moved."""

    model: Model
    pose: PoseCandidate
    mask: Mask
    recut_px: int = 0

    def evidence(self, rgb: Image, camera_matrix: Array) -> Mask:
        """The mask that is to be believed."""
        if not self.recut_px:
            return self.mask
        return _evidence(self.model.mesh, rgb, self.pose.T_camera_object, camera_matrix, self.mask, self.recut_px)


def _fits_in(
    box: Box,
    request: ObjectRequest,
    candidates: Sequence[Model],
    rgb: Image,
    source: str,
    camera_matrix: Array,
    mask: Mask | None,
    labels: NDArray[np.uint8] | None,
    standing: bool,
) -> list[_Fit]:
    """The best first poses of any model in a box, the vessel's shape fitted coarsely to each; the best of these first.

    Raises NotFoundError where none explains what is cut out there.
    """
    cut = mask_from_box(rgb, box) if mask is None else mask
    trust = _trust(cut, labels)

    count = HYPOTHESES if standing else KINDS

    def first_poses(model: Model) -> list[tuple[PoseCandidate, Model]]:
        poses = find_first_pose(model, rgb, cut, camera_matrix, box_xywh_px=box, trust=trust, standing=standing)
        return [(pose, model) for pose in distinct(poses, APART_DEG, count, HYPOTHESES_WITHIN, model.symmetry)]

    ranked = list(chain.from_iterable(side_by_side(first_poses, candidates)))
    ranked.sort(key=lambda entry: entry[0].merit, reverse=True)
    if ranked[0][0].iou < FOUND_IOU:
        raise NotFoundError(
            f"object {request.name!r} was not found: the best silhouette covers only {ranked[0][0].iou:.0%} of what "
            "was cut out of the frame"
        )
    if not standing:
        # Other kinds of pose are asked for then, not the same of several models.
        kinds = distinct([pose for pose, _ in ranked], APART_DEG, count, HYPOTHESES_WITHIN, ranked[0][1].symmetry)
        ranked = [entry for entry in ranked if any(entry[0] is kind for kind in kinds)]

    def fitted(entry: tuple[PoseCandidate, Model]) -> _Fit:
        pose, model = entry
        return _fitted(model, pose, rgb, cut, box, source, camera_matrix, labels, 1, COARSE_STEPS_PX)

    fits = side_by_side(fitted, ranked[:count])
    return sorted(fits, key=lambda fit: fit.pose.merit, reverse=True)


def sharpened(start: Start, rgb: Image, camera_matrix: Array) -> Start:
    """The start with its best hypothesis fitted to the frame at full sharpness, as it was given to `start_object`."""
    best, *others = start.hypotheses
    given = start.box, start.box_source
    fit = _fitted(best.model, best.pose, rgb, best.evidence, *given, camera_matrix, start.labels, FIT_ROUNDS)
    return replace(start, hypotheses=(_hypothesis(fit, fit.evidence(rgb, camera_matrix), rgb, camera_matrix), *others))


def _hypothesis(fit: _Fit, evidence: Mask, rgb: Image, camera_matrix: Array) -> Hypothesis:
    model, pose, T = fit.model, fit.pose, fit.pose.T_camera_object
    silhouette = _silhouette(model.mesh, T, camera_matrix, rgb.shape)
    mask = evidence & silhouette
    if model.vessel is not None:
        model = vessel_model(coloured(model.vessel, rgb, mask))
    return Hypothesis(model, pose, mask if mask.any() else silhouette, mask_box(silhouette), evidence)


def _fitted(
    model: Model,
    pose: PoseCandidate,
    rgb: Image,
    mask: Mask,
    box: Box,
    source: str,
    camera_matrix: Array,
    labels: NDArray[np.uint8] | None,
    rounds: int,
    steps_px: tuple[float, ...] = (3.0, 1.5, 1.0),
) -> _Fit:
    """One hypothesis carried on: the vessel's shape and pose fitted to the mask re-cut near its silhouette."""
    edges, band_px = edge_strength(rgb), max(3, round(RECUT_BAND * max(box[2], box[3])))
    T = pose.T_camera_object
    evidence = _evidence(model.mesh, rgb, T, camera_matrix, mask, band_px)
    trust = _trust(evidence, labels)
    pose = before = judge(model.mesh, T, camera_matrix, edges, evidence, box, pose.stands, trust)
    for number in range(rounds):
        if model.vessel is None:
            break
        if number > 0:  # after the last one only what is kept needs a mask
            evidence = _evidence(model.mesh, rgb, T, camera_matrix, evidence, band_px)
            trust = _trust(evidence, labels)
            before = judge(model.mesh, T, camera_matrix, edges, evidence, box, pose.stands, trust)
        view = View(*mask_evidence(evidence, trust), T, box if source == "given" else None, edges)
        vessel, (T_fitted,) = fit_shape(model.vessel, [view], camera_matrix, steps_px)
        fitted = vessel_model(vessel)
        after = judge(fitted.mesh, T_fitted, camera_matrix, edges, evidence, box, pose.stands, trust)
        if after.merit <= before.merit + 0.002:
            break  # a mask that lost a thin part misled the fit: edges and box tell
        model, T, pose = fitted, T_fitted, after
    else:
        return _Fit(model, pose, evidence, band_px)
    return _Fit(model, pose, evidence)


def _trust(mask: Mask, labels: NDArray[np.uint8] | None) -> NDArray[np.float32] | None:
    """How far a mask is to be believed, by the background's labels."""
    if labels is None:
        return None
    size = (mask.shape[1], mask.shape[0])
    return mask_trust(mask, np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), np.uint8))


def scaled(box: Box, scale: float) -> Box:
    """A box in an image `scale` times as large."""
    x, y, w, h = (v * scale for v in box)
    return x, y, w, h


def resized(mask: Mask, like: Image) -> Mask:
    """A mask brought to the size of an image (H, W, 3)."""
    size = (like.shape[1], like.shape[0])
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127)


def _silhouette(mesh: TrackingMesh, T: Array, camera_matrix: Array, shape: tuple[int, ...]) -> Mask:
    window = mesh.drawn(T, camera_matrix)
    if window is None:
        return np.zeros((shape[0], shape[1]), bool)
    return window.mask_in_image(shape[1], shape[0])


def _evidence(mesh: TrackingMesh, rgb: Image, T: Array, camera_matrix: Array, mask: Mask, band_px: int) -> Mask:
    """The mask re-cut near the silhouette, with what the mask had there: re-cutting loses thin parts."""
    silhouette = _silhouette(mesh, T, camera_matrix, mask.shape)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band_px + 1, 2 * band_px + 1))
    near = cv2.dilate(silhouette.astype(np.uint8), kernel) > 0
    return mask_from_silhouette(rgb, silhouette, band_px) | (mask & near)
