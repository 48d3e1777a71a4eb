"""Attempts at a clip: its objects found in one frame and followed from there; and others where that is not sure.

What is found in one frame may be wrong, and only the whole clip tells: it is then followed less surely, or covers only
part of the object. So attempts are made from other frames, from other boxes and, of what has neither handle nor spout,
turned otherwise, as far as they are needed, and the best is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from .background import COVERED, Background
from .both_ways import Clip, Watched, follow_both_ways, look_again, settle_rivals
from .candidates import Model, ObjectRequest, with_stoutest
from .depth_size import sized
from .depth_video import DepthVideo
from .detect import find_places, motion_since
from .errors import UserError
from .focal import focal_of_clip, scaled_focal
from .follow import Followed
from .geometry import Array, projected_box, scaled_camera
from .masks import read_mask
from .progress import Progress
from .segment import Box, box_iou, check_box, mask_box
from .starting import (
    APART_DEG,
    STARTING_SIDE_PX,
    WORKING_SIDE_PX,
    NotFoundError,
    Start,
    resized,
    scaled,
    sharpened,
    start_object,
)
from .video import Image, VideoInfo, iterate_frames

TRUSTED_CONFIDENCE = 0.6  # mean over the clip, of an object that nobody pointed at
LESS_SURE = 0.05  # of confidence, that a focal length told by the clip may cost: noise, if it is right
SURELY_FOLLOWED = 0.65  # mean confidence over the clip, below which it is tried from another frame as well
AWAY_FRAMES, FOLLOWED_THERE, ELSEWHERE_MARGIN = 12, 0.4, 0.15  # least distance, confidence and gain of that
SURELY_BEGUN, OTHER_MARGIN = 0.92, 0.05  # mean confidence below which other attempts are made, and their least gain
SPILLED = 0.03  # share of its colours beyond it, above which the object may be more than what is followed,
TOLD_BY_PRINT = 0.3  # unless such a share of what is printed on it moves as the poses say
WIDER = 1.1  # times as large as the box it was found in
SAME_PLACE_IOU = 0.5  # of boxes in the start frame, least
OTHER_FRAMES = (45,)  # looked at when what was found in the first cannot be followed surely


@dataclass(frozen=True)
class Scene:
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
class Attempt:
    """The objects as they were found in one frame, `sharp`, and followed from there."""

    scene: Scene
    sharp: Image
    index: int
    starts: list[Start]
    followed: list[Followed]
    watched: Watched

    @property
    def sure(self) -> float:
        """Mean confidence of the handled object."""
        return float(np.mean([e.confidence for e in self.followed[0].estimates]))

    @cached_property
    def spilled(self) -> float:
        """How much of the handled object's colours goes on beyond its silhouette, as a share of that."""
        return self.followed[0].spilled

    @property
    def in_part(self) -> bool:
        """Whether only part of a body of revolution seems to be explained, and nothing printed on it says otherwise.

        What has a handle or a spout shows which way up it is.
        """
        vessel = self.followed[0].vessel
        if vessel is None or vessel.symmetry.order != 0:
            return False
        return self.spilled > SPILLED and self.followed[0].flow_share < TOLD_BY_PRINT

    @cached_property
    def worth(self) -> float:
        """What attempts are chosen by: outlines fit wrong leans as well, what is printed on a vessel does not."""
        return self.sure + self.followed[0].flow_share - self.spilled


def best_attempt(
    scene: Scene,
    requests: Sequence[ObjectRequest],
    models: Sequence[list[Model]],
    start_frame: int | None,
    report: Progress,
    *,
    watch_camera: bool,
) -> Attempt:
    """The objects found and followed as surely as can be. models: for each request what it may be.

    Raises UserError when an object is not found in any frame that is looked at.
    """
    name, count = requests[0].name, scene.info.frame_count
    attempts: list[Attempt] = []
    for index, sharp, starts in _found(scene, requests, models, start_frame):
        attempts.append(_attempt(scene, index, sharp, starts, report, watch_camera))
        if starts[0].box_source != "found" or attempts[-1].sure >= TRUSTED_CONFIDENCE:
            break
        report(0, count, f"looking again for {name}, in another frame")
    first = max(attempts, key=lambda attempt: attempt.sure)
    best = _mended(first, requests, models, report, watch_camera)
    if requests[0].mask is None:
        if best.sure < SURELY_BEGUN and (places := first.starts[0].other_places):
            report(0, count, f"looking again for {name}, in another place")
            best = _better(best, _from_box(first, requests[0], models[0], places[0], "found", report))
        if best.sure < SURELY_BEGUN:
            report(0, count, f"looking again for {name}, in a wider box")
            best = _better(best, _from_box(best, requests[0], models[0], _wider_box(best), "widened", report))
        if best.in_part:
            report(0, count, f"looking again for {name}, turned otherwise")
            best = _better(best, _turned_otherwise(best, requests[0], models[0], report))
    return best


def with_told_focal(
    first: Attempt,
    requests: Sequence[ObjectRequest],
    models: Sequence[list[Model]],
    report: Progress,
    watch_camera: bool,
) -> tuple[Attempt, dict[str, Any]]:
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
    scene: Scene, requests: Sequence[ObjectRequest], models: Sequence[list[Model]], start_frame: int | None
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
    scene: Scene,
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


def _attempt(
    scene: Scene, index: int, sharp: Image, starts: list[Start], report: Progress, watch_camera: bool
) -> Attempt:
    clip = _clip(scene, index, sharp)
    near = clip.depth_of(index)
    starts = settle_rivals(clip, [sized(start, near) for start in starts])
    starts = [sized(sharpened(start, sharp, scene.camera(scene.start_scale)), near) for start in starts]
    followed, watched = follow_both_ways(clip, starts, report, watch_camera=watch_camera)
    starts = [replace(start, frame=index) for start in starts]
    return Attempt(scene, sharp, index, starts, followed, watched)


def _mended(
    attempt: Attempt, requests: Sequence[ObjectRequest], models: Sequence[list[Model]], report: Progress, watch: bool
) -> Attempt:
    """The same, or one from another frame if that is much surer; followed once more where that makes it surer."""
    if attempt.sure < SURELY_FOLLOWED:
        words = f"looking again for {requests[0].name}, in a frame that shows it better"
        report(0, attempt.scene.info.frame_count, words)
        again = _from_elsewhere(attempt, requests, models, report, watch)
        surer = again is not None and again.sure > attempt.sure + ELSEWHERE_MARGIN
        # What was lost may have been taken for something else, which is then followed surely.
        if again is not None and surer and (not requests[0].pointed_at or _begins_as(attempt, again)):
            attempt = again
    clip = _clip(attempt.scene, attempt.index, attempt.sharp)
    return replace(attempt, followed=look_again(clip, attempt.followed, attempt.watched, report))


def _begins_as(first: Attempt, other: Attempt) -> bool:
    """Whether the handled object of another attempt stands where the first one's was found, in that frame."""
    known, scene = other.followed[0], first.scene
    box = projected_box(known.camera_matrix, known.estimates[first.index].T_camera_object, known.mesh.vertices_m)
    begun = first.starts[0].best.box
    return box is not None and box_iou(scaled(box, scene.start_scale / scene.scale), begun) > SAME_PLACE_IOU


def _from_elsewhere(
    first: Attempt, requests: Sequence[ObjectRequest], models: Sequence[list[Model]], report: Progress, watch: bool
) -> Attempt | None:
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


def _from_box(
    first: Attempt, request: ObjectRequest, candidates: list[Model], box: Box, source: str, report: Progress
) -> Attempt | None:
    """The handled object looked for once more in the same frame, in another box.

    What is cut out of another box is cut a little otherwise, and so is what is fitted to it: where two explanations of
    the start frame are nearly as good, the whole clip tells which is better.
    """
    scene, labels = first.scene, first.starts[0].labels
    camera = scene.camera(scene.start_scale)
    try:
        start = start_object(request, candidates, first.sharp, [box], source, camera, None, labels)
    except NotFoundError:
        return None
    begun = _attempt(scene, first.index, first.sharp, [start], report, False)
    other = _mended(begun, [request], [candidates], report, False)
    return _beside(first, other) if _begins_as(begun, other) else None


def _turned_otherwise(
    first: Attempt, request: ObjectRequest, candidates: list[Model], report: Progress
) -> Attempt | None:
    """The best of what the handled object may be in the same box if it stands otherwise: what is held may be tipped."""
    scene, known = first.scene, first.starts[0]
    camera = scene.camera(scene.start_scale)
    try:
        start = start_object(
            request, with_stoutest(candidates), first.sharp, [known.box], known.box_source, camera, None, known.labels,
            standing=False,
        )  # fmt: skip
    except NotFoundError:
        return None
    R, symmetry = known.best.pose.T_camera_object[:3, :3], known.best.model.symmetry
    best: Attempt | None = None
    for turned in start.hypotheses:
        if np.rad2deg(symmetry.error_rad(R, turned.pose.T_camera_object[:3, :3])) <= APART_DEG:
            continue
        attempt = _attempt(scene, first.index, first.sharp, [replace(start, hypotheses=(turned,))], report, False)
        if _begins_as(attempt, attempt) and (best is None or attempt.worth > best.worth):
            others = [other for other in start.hypotheses if other is not turned]  # for the track's header
            told = replace(attempt.starts[0], hypotheses=(attempt.starts[0].best, *others))
            best = _beside(first, replace(attempt, starts=[told]))
    return best


def _beside(first: Attempt, other: Attempt) -> Attempt:
    """Another attempt at the handled object, with the other objects of the first."""
    starts, followed = [other.starts[0], *first.starts[1:]], [other.followed[0], *first.followed[1:]]
    return replace(other, starts=starts, followed=followed, watched=first.watched)


def _wider_box(attempt: Attempt) -> Box:
    """Somewhat larger than the one that the handled object was found in, as far as the picture reaches."""
    (height, width), (x, y, w, h) = attempt.sharp.shape[:2], attempt.starts[0].box
    return check_box((x - (WIDER - 1) / 2 * w, y - (WIDER - 1) / 2 * h, WIDER * w, WIDER * h), width, height)


def _better(best: Attempt, other: Attempt | None) -> Attempt:
    return best if other is None or other.worth <= best.worth + OTHER_MARGIN else other


def _clip(scene: Scene, index: int, sharp: Image) -> Clip:
    return Clip(scene.info, index, _small(sharp, scene), scene.camera(scene.scale), scene.background, scene.depth)


def _small(sharp: Image, scene: Scene) -> Image:
    """The start frame at working size."""
    size = tuple(round(side * scene.scale) for side in (scene.info.width_px, scene.info.height_px))
    return np.asarray(cv2.resize(sharp, size, interpolation=cv2.INTER_AREA), np.uint8)
