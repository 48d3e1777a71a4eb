"""From a video and the names of its objects to their tracks: the whole of extraction, in the order it happens.

Find every object in the start frame, fit its mesh and pose there, follow it through the clip both ways, smooth, write.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from .background import COVERED, SAMPLES, Background, learn_background
from .both_ways import Clip, Watched, follow_both_ways, look_again, settle_rivals
from .camera_of_tracks import with_camera
from .candidates import Model, vessel_model
from .candidates import ObjectRequest as ObjectRequest
from .candidates import candidate_models as candidate_models
from .depth_size import sized
from .depth_video import DepthVideo
from .detect import find_places, motion_since
from .errors import UserError
from .files import atomic_path
from .focal import focal_of_clip, scaled_focal
from .follow import Followed
from .geometry import Array, focal_prior_camera_matrix, projected_box, scaled_camera
from .masks import read_mask, write_masks
from .overlay import OverlayItem, write_overlay
from .progress import Progress
from .rerun_log import load_rerun, write_rerun
from .segment import Box, Mask, check_box, mask_box
from .smoothing import smooth_poses
from .starting import STARTING_SIDE_PX, WORKING_SIDE_PX, NotFoundError, Start, resized, scaled, sharpened, start_object
from .track import ObjectTrack
from .video import Image, VideoInfo, iterate_frames, read_video_info, sample_frames

TRUSTED_CONFIDENCE = 0.6  # mean over the clip, of an object that nobody pointed at
LESS_SURE = 0.05  # of confidence, that a focal length told by the clip may cost: noise, if it is right
SURELY_FOLLOWED = 0.65  # mean confidence over the clip, below which it is tried from another frame as well
AWAY_FRAMES, FOLLOWED_THERE, ELSEWHERE_MARGIN = 12, 0.4, 0.15  # least distance, confidence and gain of that
SEEN_SHARE = 0.1  # of the clip, least
OTHER_FRAMES = (45,)  # looked at when what was found in the first cannot be followed surely


@dataclass(frozen=True)
class _Scene:
    """The video with its camera at full, starting and working size; frames spread over it, and their background.

    depth: of its frames, where a depth camera filmed as well.
    """

    info: VideoInfo
    camera_matrix: Array
    start_scale: float
    scale: float
    samples: Sequence[Image]
    background: Background | None
    depth: DepthVideo | None = None

    def camera(self, scale: float) -> Array:
        return scaled_camera(self.camera_matrix, scale)


@dataclass(frozen=True)
class _Attempt:
    """The objects as they were found in one frame, `sharp`, and followed from there."""

    scene: _Scene
    sharp: Image
    index: int
    starts: list[Start]
    followed: list[Followed]
    watched: Watched

    @property
    def sure(self) -> float:
        """Mean confidence of the handled object."""
        return float(np.mean([e.confidence for e in self.followed[0].estimates]))


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
    scene = _Scene(info, camera_matrix, start_scale, scale, samples, background, filmed)
    attempts: list[_Attempt] = []
    for index, sharp, starts in _found(scene, requests, models, start_frame):
        attempts.append(_attempt(scene, index, sharp, starts, report, camera_motion != "static"))
        if starts[0].box_source != "found" or attempts[-1].sure >= TRUSTED_CONFIDENCE:
            break
        report(0, info.frame_count, f"looking again for {requests[0].name}, in another frame")
    best = max(attempts, key=lambda attempt: attempt.sure)
    if best.sure < SURELY_FOLLOWED:
        report(0, info.frame_count, f"looking again for {requests[0].name}, in a frame that shows it better")
        again = _from_elsewhere(best, requests, models, report, camera_motion != "static")
        if again is not None and again.sure > best.sure + ELSEWHERE_MARGIN:
            best = again
    clip = _clip(scene, best.index, best.sharp)
    best = replace(best, followed=look_again(clip, best.followed, best.watched, report))
    camera_told: dict[str, Any] = {"source": camera_source}
    if camera is None and requests[0].mesh is not None:
        best, camera_told = _with_told_focal(best, requests, models, report, camera_motion != "static")
    scene, index, starts, followed, watched = best.scene, best.index, best.starts, best.followed, best.watched
    time_s = np.array([watched.times[k] for k in sorted(watched.times)])

    tracks: dict[str, ObjectTrack] = {}
    for request, start, result in zip(requests, starts, followed, strict=True):
        _check_followed(request, start, result, handled=start is starts[0], info=info)
        visible = np.array([e.visible for e in result.estimates])
        confidence = np.array([e.confidence for e in result.estimates])
        raw = np.stack([e.T_camera_object for e in result.estimates])
        model = start.best.model if result.vessel is None else vessel_model(result.vessel)
        smooth = smooth_poses(raw, time_s, confidence * visible)
        header = _header(request, scene, start, model, index)
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


def _attempt(
    scene: _Scene, index: int, sharp: Image, starts: list[Start], report: Progress, watch_camera: bool
) -> _Attempt:
    clip = _clip(scene, index, sharp)
    near = clip.depth_of(index)
    starts = settle_rivals(clip, [sized(start, near) for start in starts])
    starts = [sized(sharpened(start, sharp, scene.camera(scene.start_scale)), near) for start in starts]
    followed, watched = follow_both_ways(clip, starts, report, watch_camera=watch_camera)
    return _Attempt(scene, sharp, index, starts, followed, watched)


def _clip(scene: _Scene, index: int, sharp: Image) -> Clip:
    return Clip(scene.info, index, _small(sharp, scene), scene.camera(scene.scale), scene.background, scene.depth)


def _from_elsewhere(
    first: _Attempt, requests: Sequence[ObjectRequest], models: Sequence[list[Model]], report: Progress, watch: bool
) -> _Attempt | None:
    """The objects looked for again where they were followed most surely, away from where they were found.

    A thing that was lifted has left its shadow, and a hand that moves hides other parts of it.
    """
    scene = first.scene
    sure = np.array([e.confidence * e.visible for e in first.followed[0].estimates])
    sure[max(0, first.index - AWAY_FRAMES) : first.index + AWAY_FRAMES + 1] = 0.0
    index = int(np.argmax(sure))
    boxes = [
        projected_box(f.camera_matrix, f.estimates[index].T_camera_object, f.mesh.vertices_m) for f in first.followed
    ]
    if sure[index] < FOLLOWED_THERE or any(box is None for box in boxes):
        return None
    frames = iterate_frames(scene.info.path, STARTING_SIDE_PX, scene.info)
    sharp = next((frame.rgb for frame in frames if frame.index == index), None)
    if sharp is None:
        return None
    try:
        starts = _find_in(sharp, scene, requests, models, [scaled(b, 1 / scene.scale) for b in boxes if b is not None])
    except UserError:
        return None
    return _attempt(scene, index, sharp, starts, report, watch)


def _with_told_focal(
    first: _Attempt,
    requests: Sequence[ObjectRequest],
    models: Sequence[list[Model]],
    report: Progress,
    watch_camera: bool,
) -> tuple[_Attempt, dict[str, Any]]:
    """The objects followed again with the focal length that the handled one tells, and what the header says of it.

    As they were, with the prior, where it tells none, is unsure or in favour of the prior, or says something else when
    asked a second time.
    """
    scene, prior_px = first.scene, float(first.scene.camera_matrix[0, 0])
    told = focal_of_clip(scene.info, first.followed[0], WORKING_SIDE_PX)
    if told is None:
        return first, {"source": "prior"}
    said = {"told_focal_px": round(prior_px * told.factor, 1), "told_std_px": round(prior_px * told.std, 1)}
    refused = first, {"source": "prior", **said}
    if not (told.trusted(told.factor) and told.contradicts):
        return refused
    report(0, scene.info.frame_count, "following again, with the focal length that the clip tells")
    scene = replace(scene, camera_matrix=scaled_focal(scene.camera_matrix, told.factor))
    elsewhere = first.starts[0].box_source == "followed"
    there = [scaled(start.best.box, 1 / scene.start_scale) for start in first.starts]
    try:
        starts = _find_in(first.sharp, scene, requests, models, there if elsewhere else None)
    except NotFoundError:
        return refused
    second = _attempt(scene, first.index, first.sharp, starts, report, watch_camera)
    again = focal_of_clip(scene.info, second.followed[0], WORKING_SIDE_PX, told.factor)
    if again is None or not told.agree(again) or second.sure < first.sure - LESS_SURE:
        return refused
    focal_px = float(scene.camera_matrix[0, 0])
    # What it would still change is as uncertain as what it is sure of.
    std_px = focal_px * float(np.hypot(again.log_std, np.log(again.factor)))
    return second, {"source": "estimated", "focal_px": round(focal_px, 1), "std_px": round(std_px, 1)}


def _found(
    scene: _Scene, requests: Sequence[ObjectRequest], models: Sequence[list[Model]], start_frame: int | None
) -> Iterator[tuple[int, Image, list[Start]]]:
    """The start frame, its picture at starting size and the objects in it; then others that may show them better.

    Others only where nobody said which frame. Raises UserError when the objects are in none of them.
    """
    first, found = start_frame or 0, False
    refusal: NotFoundError | None = None
    wanted = [first]
    if start_frame is None and not any(request.pointed_at for request in requests):
        wanted += [k for k in OTHER_FRAMES if k < scene.info.frame_count]
    for index in wanted:
        frames = iterate_frames(scene.info.path, STARTING_SIDE_PX, scene.info)
        frame = next((frame for frame in frames if frame.index == index), None)
        if frame is None:  # damaged
            continue
        try:
            starts = _find_in(frame.rgb, scene, requests, models)
        except NotFoundError as error:
            refusal = refusal or error
            continue
        found = True
        yield frame.index, frame.rgb, starts
    if not found:
        where = f"in frame {first} of {scene.info.path}"
        raise UserError(f"{refusal} {where}; give its box there with --box X Y WIDTH HEIGHT, or another --start-frame")


def _find_in(
    sharp: Image,
    scene: _Scene,
    requests: Sequence[ObjectRequest],
    models: Sequence[list[Model]],
    followed_to: Sequence[Box] | None = None,
) -> list[Start]:
    """The objects in a frame. followed_to: boxes in px of the video around where they were followed to, if so."""
    info, small = scene.info, _small(sharp, scene)
    labels = None if scene.background is None else scene.background.labels(small)
    # What moved at any time, or, better, what covers something that was seen at another time.
    moved = motion_since(small, scene.samples) if labels is None else np.array(COVERED)[labels]
    starts: list[Start] = []
    camera = scene.camera(scene.start_scale)
    for number, (request, candidates) in enumerate(zip(requests, models, strict=True)):
        mask = None
        if followed_to is not None:
            seen = check_box(followed_to[number], info.width_px, info.height_px)
            boxes, source = [scaled(seen, scene.start_scale)], "followed"
        elif request.mask is not None:
            mask = resized(read_mask(request.mask, info.width_px, info.height_px), sharp)
            boxes, source = [mask_box(mask)], "mask"
        elif request.box_xywh_px is not None:
            given = check_box(request.box_xywh_px, info.width_px, info.height_px)
            boxes, source = [scaled(given, scene.start_scale)], "given"
        else:
            places = find_places(
                small, moved, [m.mesh for m in candidates], scene.camera(scene.scale), labels=labels,
                handled=len(starts) == 0, taken=[resized(s.best.mask, small) for s in starts],
            )  # fmt: skip
            boxes, source = [scaled(place, scene.start_scale / scene.scale) for place in places], "found"
        starts.append(start_object(request, candidates, sharp, boxes, source, camera, mask, labels))
    return starts


def _small(sharp: Image, scene: _Scene) -> Image:
    """The start frame at working size."""
    size = tuple(round(side * scene.scale) for side in (scene.info.width_px, scene.info.height_px))
    return np.asarray(cv2.resize(sharp, size, interpolation=cv2.INTER_AREA), np.uint8)


def _check_followed(request: ObjectRequest, start: Start, result: Followed, handled: bool, info: VideoInfo) -> None:
    """Raise UserError when what was followed cannot be the object."""
    visible = [e.visible for e in result.estimates]
    mend = "give its box with --box X Y WIDTH HEIGHT in a frame that shows it well, and that frame with --start-frame"
    if np.mean(visible) < SEEN_SHARE:
        seen = f"it was lost after {sum(visible)} of {len(visible)} frames"
        raise UserError(f"object {request.name!r} was not found in {info.path}: {seen}; {mend}")
    sure = float(np.mean([e.confidence for e in result.estimates]))
    if handled and start.box_source == "found" and sure < TRUSTED_CONFIDENCE:
        what = f"what looked most like it was followed with a confidence of {sure:.0%} only"
        raise UserError(f"object {request.name!r} was not found in {info.path}: {what}; {mend}")


def _header(request: ObjectRequest, scene: _Scene, start: Start, model: Model, index: int) -> dict[str, Any]:
    box = [round(v / scene.start_scale, 1) for v in start.best.box]
    chosen = {
        "given": "the box that was given",
        "mask": "the mask that was given",
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
            "start_frame": index,
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
