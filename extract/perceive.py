"""From a video and the names of its objects to their tracks: the whole of extraction, in the order it happens.

Find every object in the first frame, fit its mesh and pose there, follow it through the clip, smooth, write.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .detect import find_object, motion_since
from .errors import UserError
from .files import atomic_path
from .first_pose import PoseCandidate, distinct, find_first_pose, judge
from .follow import Followed
from .geometry import Array, Symmetry, focal_prior_camera_matrix
from .meshes import load_mesh, mesh_sha256
from .overlay import OverlayItem, write_overlay
from .progress import Progress
from .raster import render_depth
from .region import TrackingMesh, edge_strength, mask_evidence
from .segment import Box, Mask, check_box, mask_box, mask_from_box, mask_from_silhouette
from .shape_fit import View, coloured, fit_shape, tracking_mesh
from .smoothing import smooth_poses
from .track import ObjectTrack
from .vessels import Vessel, make_vessel, resolve_category
from .video import Image, VideoInfo, iterate_frames, read_video_info

WORKING_SIDE_PX = 640  # tracking
STARTING_SIDE_PX = 1280  # the first frame, where thin parts such as spouts must be seen to be fitted
SMOOTHING_BANDWIDTH_S = 0.06
TRUSTED_CONFIDENCE = 0.5  # mean over the clip, of an object that nobody pointed at
FOUND_IOU = 0.45  # below this no pose of the mesh explains what was cut out of the first frame
HYPOTHESES = 4  # first poses, far from each other, that a shape is fitted to
HYPOTHESES_WITHIN = 0.5  # of the best one's merit
FIT_ROUNDS = 3  # of cutting the mask near the silhouette and fitting the shape to it
RECUT_BAND = 0.03  # of the object's size in the image


@dataclass(frozen=True)
class ObjectRequest:
    """An object to follow.

    name: a category of the vessel library or a word for one ("kettle"), or any name when `mesh` is given.
    box_xywh_px: box in the first frame, in pixels of the video; found automatically when None.
    mesh: the object's own mesh file; mesh_unit: "m", "mm", "cm", "in" or "auto".
    """

    name: str
    box_xywh_px: Box | None = None
    mesh: Path | None = None
    mesh_unit: str = "auto"


@dataclass(frozen=True)
class _Model:
    """A mesh to look for, and what the track's header says of it."""

    mesh: TrackingMesh
    symmetry: Symmetry
    header: Mapping[str, Any] = field(default_factory=dict)
    vessel: Vessel | None = None


@dataclass(frozen=True)
class _Start:
    """An object as found in the first frame, at the starting resolution."""

    model: _Model
    mask: Mask
    pose: PoseCandidate
    box: Box
    box_source: str


def extract(
    video: Path,
    requests: Sequence[ObjectRequest],
    *,
    out: Path,
    camera: tuple[float, float, float, float] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, ObjectTrack]:
    """Track objects through a video; write `NAME.track.npz`, `NAME.mask.png` (first frame) and `overlay.mp4`.

    camera: fx, fy, cx, cy in px; the focal prior f = sqrt(w^2 + h^2) when None.  The first request is the handled
    object, the others are receptacles.  progress: called with (done, total, what).
    Raises UserError for a bad video, box, name or mesh, and when an object cannot be found.
    """
    report = progress or (lambda done, total, what: None)
    info = read_video_info(video)
    if len({request.name for request in requests}) < len(requests):
        raise UserError("two objects have the same name; give each its own")
    camera_matrix, camera_source = _camera_matrix(info, camera)
    scale = min(1.0, WORKING_SIDE_PX / max(info.width_px, info.height_px))
    start_scale = min(1.0, STARTING_SIDE_PX / max(info.width_px, info.height_px))
    working_camera, start_camera = (np.diag([s, s, 1.0]) @ camera_matrix for s in (scale, start_scale))
    models = [_candidate_models(request) for request in requests]

    report(0, info.frame_count, "looking for " + " and ".join(request.name for request in requests))
    sharp = next(iterate_frames(info.path, STARTING_SIDE_PX)).rgb
    first = next(iterate_frames(info.path, WORKING_SIDE_PX))
    starts: list[_Start] = []
    moved: Array | None = None
    for request, candidates in zip(requests, models, strict=True):
        if request.box_xywh_px is not None:
            given = check_box(request.box_xywh_px, info.width_px, info.height_px)
            box, source = given, "given"
        else:
            if moved is None:
                moved = motion_since(first.rgb, (f.rgb for f in iterate_frames(info.path, WORKING_SIDE_PX)))
            found_box = find_object(
                first.rgb, moved, [m.mesh for m in candidates], working_camera,
                handled=len(starts) == 0, taken=[_resized(s.mask, first.rgb) for s in starts],
            )  # fmt: skip
            if found_box is None:
                raise _not_found(request, info, "nothing in the first frame looks like it")
            box, source = _scaled(found_box, 1 / scale), "found"
        start_box = _scaled(box, start_scale)
        starts.append(_start(request, info, candidates, sharp, start_box, source, start_camera))

    def follow(again: list[Followed] | None, words: str) -> list[Followed]:
        frames = iterate_frames(info.path, WORKING_SIDE_PX)
        masks = [_resized(start.mask, first.rgb) for start in starts]
        followers = again or [
            Followed.start(s.model.mesh, s.model.vessel, working_camera, first.rgb, m, s.pose.T_camera_object)
            for s, m in zip(starts, masks, strict=True)
        ]
        for frame in frames:
            for follower in followers:
                follower.step(frame.rgb, frame.index, info.frame_count)
            report(frame.index + 1, info.frame_count, words)
            times[frame.index] = frame.time_s
        return followers

    times: dict[int, float] = {}
    passed = follow(None, "following")
    report(0, info.frame_count, "fitting shapes to the whole clip")
    followed = follow([f.second_pass(first.rgb) for f in passed], "following again, with the whole clip in mind")

    tracks: dict[str, ObjectTrack] = {}
    for request, start, result in zip(requests, starts, followed, strict=True):
        found = result.estimates
        visible = np.array([e.visible for e in found])
        if visible.mean() < 0.1:
            raise _not_found(request, info, f"it was lost after {int(visible.sum())} of {len(visible)} frames")
        confidence = np.array([e.confidence for e in found])
        if start is starts[0] and start.box_source == "found" and confidence.mean() < TRUSTED_CONFIDENCE:
            what = f"what looked most like it was followed with a confidence of {confidence.mean():.0%} only"
            raise _not_found(request, info, what)
        raw = np.stack([e.T_camera_object for e in found])
        time_s = np.array([times[k] for k in range(len(found))])
        model = start.model if result.vessel is None else _vessel_model(result.vessel)
        header = {
            "object": request.name,
            "mesh": {**model.header, "symmetry": model.symmetry.to_json(), "up_axis": [0.0, 0.0, 1.0]},
            "image_size_px": [info.width_px, info.height_px],
            "video": {"file": info.path.name, "sha256": info.sha256},
            "camera": {"source": camera_source},
            "settings": {
                "tracker": "region",
                "box_xywh_px": [round(v / start_scale, 1) for v in start.box],
                "box_source": start.box_source,
                "working_side_px": WORKING_SIDE_PX,
                "smoothing_bandwidth_s": SMOOTHING_BANDWIDTH_S,
                "first_frame": {
                    "iou": round(start.pose.iou, 4),
                    "edge": round(start.pose.edge, 4),
                },
                "seed": seed,
            },
        }
        smooth = smooth_poses(raw, time_s, confidence * visible, SMOOTHING_BANDWIDTH_S)
        tracks[request.name] = ObjectTrack(smooth, time_s, camera_matrix, confidence, visible, header)

    out.mkdir(parents=True, exist_ok=True)
    for start, (name, track) in zip(starts, tracks.items(), strict=True):
        track.save(out / f"{name}.track.npz")
        with atomic_path(out / f"{name}.mask.png") as temporary:
            cv2.imwrite(str(temporary), start.mask.astype(np.uint8) * 255)
    report(info.frame_count, info.frame_count, "drawing the overlay")
    items = [OverlayItem(track, f.mesh) for track, f in zip(tracks.values(), followed, strict=True)]
    write_overlay(info.path, items, out / "overlay.mp4")
    return tracks


def _camera_matrix(info: VideoInfo, camera: tuple[float, float, float, float] | None) -> tuple[Array, str]:
    if camera is None:
        return focal_prior_camera_matrix(info.width_px, info.height_px), "prior"
    fx, fy, cx, cy = camera
    if not (0.1 * info.width_px < min(fx, fy) and max(fx, fy) < 50 * info.width_px):
        raise UserError(
            f"--camera {fx:g} {fy:g} {cx:g} {cy:g}: focal lengths must be pixels between {0.1 * info.width_px:g} and "
            f"{50 * info.width_px:g} for a {info.width_px} px wide video"
        )
    if not (0 <= cx <= info.width_px and 0 <= cy <= info.height_px):
        raise UserError(f"--camera: the principal point {cx:g}, {cy:g} lies outside the video")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), "given"


def _candidate_models(request: ObjectRequest) -> list[_Model]:
    """The user's mesh, or the nominal vessel of every category that the name may mean."""
    if request.mesh is not None:
        mesh = load_mesh(request.mesh, request.mesh_unit)
        header: dict[str, Any] = {"name": request.mesh.name, "file": str(request.mesh), "unit": request.mesh_unit}
        header |= {"sha256": mesh_sha256(mesh), "extents_m": [float(v) for v in mesh.extents]}
        light = mesh if len(mesh.faces) <= 4000 else mesh.simplify_quadric_decimation(face_count=4000)
        return [_Model(TrackingMesh.build(np.asarray(light.vertices), np.asarray(light.faces)), Symmetry(), header)]
    return [_vessel_model(make_vessel(category)) for category in resolve_category(request.name)]


def _vessel_model(vessel: Vessel) -> _Model:
    header = {
        "name": vessel.category,
        "sha256": mesh_sha256(vessel.mesh),
        "extents_m": [float(v) for v in vessel.mesh.extents],
        "library": {"category": vessel.category, "params": dict(vessel.params)},
    }
    return _Model(tracking_mesh(vessel), vessel.symmetry, header, vessel)


def _start(
    request: ObjectRequest,
    info: VideoInfo,
    candidates: Sequence[_Model],
    rgb: Image,
    box: Box,
    source: str,
    camera_matrix: Array,
) -> _Start:
    """Choose among the candidate meshes, then fit pose and shape to the first frame."""
    # Coarse first: at full sharpness highlights and texture tear the mask apart.
    shrink = min(1.0, WORKING_SIDE_PX / max(rgb.shape[:2]))
    small = np.asarray(cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
    small_box, small_camera = _scaled(box, shrink), np.diag([shrink, shrink, 1.0]) @ camera_matrix
    small_mask = mask_from_box(small, small_box)
    ranked: list[tuple[PoseCandidate, _Model]] = []
    for model in candidates:
        poses = find_first_pose(
            model.mesh, small, small_mask, small_camera, box_xywh_px=small_box,
            symmetry=model.symmetry, stands=model.vessel is not None,
        )  # fmt: skip
        ranked += [(pose, model) for pose in distinct(poses, 40, HYPOTHESES, HYPOTHESES_WITHIN, model.symmetry)]
    ranked.sort(key=lambda entry: entry[0].merit, reverse=True)
    if ranked[0][0].iou < FOUND_IOU:
        raise _not_found(request, info, f"the best silhouette covers only {ranked[0][0].iou:.0%} of what was found")
    edges = edge_strength(rgb)
    band_px = max(3, round(RECUT_BAND * max(box[2], box[3])))
    mask = _resized(small_mask, rgb)
    fits = [
        _fitted(model, pose, rgb, edges, box, source, camera_matrix, band_px, mask)
        for pose, model in ranked[:HYPOTHESES]
    ]
    model, pose, evidence = max(fits, key=lambda fit: fit[1].merit)
    T = pose.T_camera_object
    silhouette = _silhouette(model.mesh, T, camera_matrix, rgb.shape)
    mask = _evidence(model.mesh, rgb, T, camera_matrix, evidence, band_px) & silhouette
    if model.vessel is not None:
        model = _vessel_model(coloured(model.vessel, rgb, mask))
    return _Start(model, mask if mask.any() else silhouette, pose, mask_box(silhouette), source)


def _fitted(
    model: _Model,
    pose: PoseCandidate,
    rgb: Image,
    edges: NDArray[np.float32],
    box: Box,
    source: str,
    camera_matrix: Array,
    band_px: int,
    mask: Mask,
) -> tuple[_Model, PoseCandidate, Mask]:
    """One hypothesis carried on: the vessel's shape and pose fitted to the mask re-cut near its silhouette."""
    T = pose.T_camera_object
    evidence = _evidence(model.mesh, rgb, T, camera_matrix, mask, band_px)
    pose = judge(model.mesh, T, camera_matrix, rgb, evidence, box, model.vessel is not None)
    for _ in range(FIT_ROUNDS if model.vessel is not None else 0):
        assert model.vessel is not None
        view = View(*mask_evidence(evidence), T, box if source == "given" else None, edges)
        vessel, (T_fitted,) = fit_shape(model.vessel, [view], camera_matrix)
        fitted = _vessel_model(vessel)
        before = judge(model.mesh, T, camera_matrix, rgb, evidence, box)
        after = judge(fitted.mesh, T_fitted, camera_matrix, rgb, evidence, box)
        if after.merit <= before.merit + 0.002:
            break  # a mask that lost a thin part misled the fit: edges and box tell
        model, T, pose = fitted, T_fitted, after
        evidence = _evidence(model.mesh, rgb, T, camera_matrix, evidence, band_px)
    return model, pose, evidence


def _scaled(box: Box, scale: float) -> Box:
    x, y, w, h = (v * scale for v in box)
    return x, y, w, h


def _resized(mask: Mask, like: Image) -> Mask:
    size = (like.shape[1], like.shape[0])
    return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127)


def _silhouette(mesh: TrackingMesh, T: Array, camera_matrix: Array, shape: tuple[int, ...]) -> Mask:
    window = render_depth(mesh.vertices_m, mesh.faces, T, camera_matrix)
    if window is None:
        return np.zeros((shape[0], shape[1]), bool)
    return window.mask_in_image(shape[1], shape[0])


def _evidence(mesh: TrackingMesh, rgb: Image, T: Array, camera_matrix: Array, mask: Mask, band_px: int) -> Mask:
    """The mask re-cut near the silhouette, with what the mask had there: re-cutting loses thin parts."""
    silhouette = _silhouette(mesh, T, camera_matrix, mask.shape)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band_px + 1, 2 * band_px + 1))
    near = cv2.dilate(silhouette.astype(np.uint8), kernel) > 0
    return mask_from_silhouette(rgb, silhouette, band_px) | (mask & near)


def _not_found(request: ObjectRequest, info: VideoInfo, why: str) -> UserError:
    return UserError(
        f"object {request.name!r} was not found in {info.path}: {why}; "
        f"give its box in the first frame with --box X Y WIDTH HEIGHT"
    )
