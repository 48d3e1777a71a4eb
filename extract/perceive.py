"""From a video and the names of its objects to their tracks: the whole of extraction, in the order it happens.

Find every object in the start frame, fit its mesh and pose there, follow it through the clip both ways, smooth, write.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from .attempts import TRUSTED_CONFIDENCE, Scene, best_attempt, with_told_focal
from .background import SAMPLES, learn_background
from .camera_of_tracks import with_camera
from .candidates import Model, vessel_model
from .candidates import ObjectRequest as ObjectRequest
from .candidates import candidate_models as candidate_models
from .depth_video import DepthVideo
from .errors import UserError
from .files import atomic_path
from .follow import Followed
from .geometry import Array, focal_prior_camera_matrix
from .masks import write_masks
from .overlay import OverlayItem, write_overlay
from .progress import Progress
from .rerun_log import load_rerun, write_rerun
from .segment import Mask, check_box
from .smoothing import smooth_poses
from .starting import STARTING_SIDE_PX, WORKING_SIDE_PX, Start
from .track import ObjectTrack
from .video import VideoInfo, read_video_info, sample_frames

SEEN_SHARE = 0.1  # of the clip, least


def extract(
    video: Path,
    requests: Sequence[ObjectRequest],
    *,
    out: Path,
    camera: tuple[float, float, float, float] | None = None,
    start_frame: int | None = None,
    camera_motion: Literal["auto", "static", "moving"] = "auto",
    depth: Path | None = None,
    depth_scale_mm: float = 1.0,
    rerun: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, ObjectTrack]:
    """Track objects through a video.

    Writes `NAME.track.npz`, `NAME.masks.npz`, `NAME.mask.png` (start frame) and `overlay.mp4`; and `extract.rrd` when
    `rerun` is true.
    camera: fx, fy, cx, cy in px; when None the focal prior f = sqrt(w^2 + h^2), or what a mesh of the handled
    object's own tells (focal.py) where that is sure.  The first request is the handled
    object, the others are receptacles.  start_frame: what boxes and masks belong to; when None the first, or another
    that shows the objects better where nobody pointed at them.  camera_motion: "static" does not look whether the
    camera moves; "moving" takes it to turn where no path can be told, however little of what is seen that explains.
    depth: folder or array of depth pictures aligned to the frames, a step of which is depth_scale_mm (depth_video.py);
    sizes of vessels and distances are then measured instead of guessed.
    progress: called with (done, total, what).
    Raises UserError for a bad video, box, mask, name, mesh or depth, and when an object cannot be found.
    """
    report = progress or (lambda done, total, what: None)
    if rerun:
        load_rerun()
    info = video_of_requests(video, requests, start_frame)
    camera_matrix, camera_source = camera_of_video(info, camera)
    longest = max(info.width_px, info.height_px)
    start_scale, scale = (min(1.0, side / longest) for side in (STARTING_SIDE_PX, WORKING_SIDE_PX))
    for request in requests:
        if request.box_xywh_px is not None:
            check_box(request.box_xywh_px, info.width_px, info.height_px)
    models = [candidate_models(request) for request in requests]

    report(0, info.frame_count, "looking for " + " and ".join(request.name for request in requests))
    samples = [frame.rgb for frame in sample_frames(info, SAMPLES, WORKING_SIDE_PX)]
    background = None if camera_motion == "moving" else learn_background(samples)
    filmed = None if depth is None else DepthVideo.open(depth, info, depth_scale_mm)
    scene = Scene(info, camera_matrix, start_scale, scale, samples, background, filmed)
    watch_camera = camera_motion != "static"
    best = best_attempt(scene, requests, models, start_frame, report, watch_camera=watch_camera)
    camera_told: dict[str, Any] = {"source": camera_source}
    if camera is None and requests[0].mesh is not None:
        best, camera_told = with_told_focal(best, requests, models, report, watch_camera)
    scene, starts, followed, watched = best.scene, best.starts, best.followed, best.watched
    time_s = np.array([watched.times[k] for k in sorted(watched.times)])

    tracks: dict[str, ObjectTrack] = {}
    for request, start, result in zip(requests, starts, followed, strict=True):
        _check_followed(request, start, result, handled=start is starts[0], info=info)
        visible = np.array([e.visible for e in result.estimates])
        confidence = np.array([e.confidence for e in result.estimates])
        raw = np.stack([e.T_camera_object for e in result.estimates])
        model = start.best.model if result.vessel is None else vessel_model(result.vessel)
        smooth = smooth_poses(raw, time_s, confidence * visible)
        header = _header(request, scene, start, model)
        header["camera"] = camera_told
        header["video"]["cuts"] = [{"frame": c.index, "time_s": round(c.time_s, 4)} for c in watched.cuts.cuts]
        header["settings"] |= {"spin_source": result.spin_source, "seed": seed}
        tracks[request.name] = ObjectTrack(
            smooth, time_s, scene.camera_matrix, confidence, visible, header, T_camera_object_raw=raw
        )
    tracks = with_camera(tracks, watched.camera, camera_motion)

    items = [OverlayItem(track, f.mesh) for track, f in zip(tracks.values(), followed, strict=True)]
    write_tracks(info, items, [start.best.mask for start in starts], out, rerun=rerun, progress=report)
    return tracks


def video_of_requests(video: Path, requests: Sequence[ObjectRequest], start_frame: int | None) -> VideoInfo:
    """The video that is asked for. Raises UserError where it is none, or names or frame cannot be."""
    info = read_video_info(video)
    if len({request.name for request in requests}) < len(requests):
        raise UserError("two objects have the same name; give each its own")
    if start_frame is not None and not 0 <= start_frame < info.frame_count:
        raise UserError(f"--start-frame {start_frame}: {info.path} has the frames 0 to {info.frame_count - 1}")
    return info


def write_tracks(
    info: VideoInfo, items: Sequence[OverlayItem], masks: Sequence[Mask], out: Path, *, rerun: bool, progress: Progress
) -> None:
    """Write what `extract` writes. masks: (H, W) of each object in the start frame."""
    out.mkdir(parents=True, exist_ok=True)
    for mask, item in zip(masks, items, strict=True):
        name = item.track.name
        item.track.save(out / f"{name}.track.npz")
        write_masks(out / f"{name}.masks.npz", item.track, item.mesh)
        with atomic_path(out / f"{name}.mask.png") as temporary:
            cv2.imwrite(str(temporary), mask.astype(np.uint8) * 255)
    progress(info.frame_count, info.frame_count, "drawing the overlay")
    write_overlay(info.path, items, out / "overlay.mp4")
    if rerun:
        write_rerun(info.path, items, out / "extract.rrd")


def _check_followed(request: ObjectRequest, start: Start, result: Followed, handled: bool, info: VideoInfo) -> None:
    """Raise UserError when what was followed cannot be the object."""
    visible = [e.visible for e in result.estimates]
    mend = "give its box with --box X Y WIDTH HEIGHT in a frame that shows it well, and that frame with --start-frame"
    if np.mean(visible) < SEEN_SHARE:
        seen = f"it was lost after {sum(visible)} of {len(visible)} frames"
        raise UserError(f"object {request.name!r} was not found in {info.path}: {seen}; {mend}")
    sure = float(np.mean([e.confidence for e in result.estimates]))
    if handled and not request.pointed_at and sure < TRUSTED_CONFIDENCE:
        what = f"what looked most like it was followed with a confidence of {sure:.0%} only"
        raise UserError(f"object {request.name!r} was not found in {info.path}: {what}; {mend}")


def _header(request: ObjectRequest, scene: Scene, start: Start, model: Model) -> dict[str, Any]:
    box = [round(v / scene.start_scale, 1) for v in start.best.box]
    chosen = {
        "given": "the box that was given",
        "mask": "the mask that was given",
        "widened": "in a box somewhat larger than that which was given or found: it is followed more surely so",
        "followed": "where it was followed to from another frame, most surely",
        "found": f"found: what looks most like a {model.header['name']}, differs from its surroundings and moves",
    }[start.box_source]
    return {
        "object": request.name,
        "mesh": {**model.header, "symmetry": model.symmetry.to_json(), "up_axis": [0.0, 0.0, 1.0]},
        "image_size_px": [scene.info.width_px, scene.info.height_px],
        "video": {"file": scene.info.path.name, "sha256": scene.info.sha256},
        "settings": {
            "tracker": "region",
            "box_xywh_px": box,
            "box_source": start.box_source,
            "choice": chosen,
            "start_frame": start.frame,
            "working_side_px": WORKING_SIDE_PX,
            "first_frame": start.described(),
            **({} if scene.depth is None else {"depth": scene.depth.described(model.vessel is not None)}),
        },
    }


def camera_of_video(info: VideoInfo, camera: tuple[float, float, float, float] | None) -> tuple[Array, str]:
    """(3, 3) intrinsics in px and where they are from. Raises UserError for ones that no such video has."""
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
