"""Go through a clip from the start frame to its end and back to its beginning, with every object, twice.

The first pass chains frame to frame, away from the start frame on either side. The second begins from what was settled
over the whole clip (follow.py) and reads the clip in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import takewhile

import numpy as np

from .background import Background
from .camera_motion import CameraWatch
from .crew import side_by_side
from .cuts import CutWatch
from .depth_video import DepthVideo, DepthView
from .follow import Followed
from .geometry import Array, projected_box
from .progress import Progress
from .segment import Box
from .starting import WORKING_SIDE_PX, Start, resized
from .video import Frame, Image, VideoInfo, iterate_backward, iterate_frames

TRIAL_FRAMES = 15  # either way, that rivals for the first pose are followed before one of them is taken
MORE_LOOKS = 2  # most
SURE_ENOUGH, SURER = 0.9, 0.01  # mean confidence from which on none is taken; by how much one must raise it
TRIAL_MARGIN = 0.1  # of mean confidence by the outline, by which the one that looked worse at first must be better


@dataclass(frozen=True)
class Clip:
    """A video and where in it to start. rgb: the start frame at working size, that of camera_matrix and background.

    depth: of its frames, where a depth camera filmed as well.
    """

    info: VideoInfo
    start_index: int
    rgb: Image
    camera_matrix: Array
    background: Background | None = None
    depth: DepthVideo | None = None

    def depth_of(self, index: int) -> DepthView | None:
        """What the depth camera saw in a frame, if there is one."""
        size_px = self.rgb.shape[1], self.rgb.shape[0]
        return None if self.depth is None else self.depth.view(index, self.camera_matrix, size_px)


@dataclass
class Watched:
    """What was seen beside the objects: times of the frames by index in s, cuts, and the camera's motion, if asked."""

    times: dict[int, float] = field(default_factory=dict)
    cuts: CutWatch = field(default_factory=CutWatch)
    camera: CameraWatch | None = None


def settle_rivals(clip: Clip, starts: Sequence[Start]) -> list[Start]:
    """The starts, with those hypotheses put first that are followed best through some frames.

    Only what is turned far from the best and explains the start frame nearly as well is tried.
    """
    if all(len(start.hypotheses) == 1 for start in starts):
        return list(starts)
    rivals = [
        (n, k) for n, start in enumerate(starts) if len(start.hypotheses) > 1 for k in range(len(start.hypotheses))
    ]
    sure: dict[tuple[int, int], list[float]] = {rival: [] for rival in rivals}
    before: list[float] = []

    def tried(frames: Iterable[Frame]) -> None:
        near = takewhile(lambda frame: abs(frame.index - clip.start_index) <= TRIAL_FRAMES, frames)
        seen = [(frame.rgb, clip.depth_of(frame.index)) for frame in near]

        def followed(rival: tuple[int, int]) -> list[float]:
            tracker, confidence = _begun(clip, starts[rival[0]], rival[1]).tracker, []
            for rgb, depth in seen:
                tracker.step(rgb, None, depth)
                # Texture holds on to any shape: only the outline tells whether it is the right one.
                confidence.append(replace(tracker.signs, rigid=0.0).confidence)
            return confidence

        for rival, confidence in zip(rivals, side_by_side(followed, rivals), strict=True):
            sure[rival] += confidence

    def ahead() -> Iterator[Frame]:
        for frame in iterate_frames(clip.info.path, WORKING_SIDE_PX, clip.info):
            if frame.index <= clip.start_index:
                before.append(frame.time_s)
            if frame.index >= clip.start_index:
                yield frame

    tried(ahead())
    if clip.start_index > 0:
        tried(iterate_backward(clip.info.path, before, WORKING_SIDE_PX))
    means = {rival: float(np.mean(confidence or 0.0)) for rival, confidence in sure.items()}
    return [
        start.preferring(_surest([means.get((n, k), 0.0) for k in range(len(start.hypotheses))]))
        for n, start in enumerate(starts)
    ]


def follow_both_ways(
    clip: Clip, starts: Sequence[Start], progress: Progress, *, watch_camera: bool = False
) -> tuple[list[Followed], Watched]:
    """Every object through the whole clip, twice; and what was seen beside them.

    Estimates of the result are by frame of the clip.
    """
    watched = Watched(camera=CameraWatch(clip.camera_matrix) if watch_camera else None)
    chained = _pass(clip, [partial(_begun, clip, start) for start in starts], watched, progress, "following", True)
    progress(0, clip.info.frame_count, "fitting shapes to the whole clip")
    settled = [followed.second_pass(clip.rgb) for followed in chained]

    words = "following again, with the whole clip in mind"
    done = _pass(
        clip,
        [partial(known.again, clip.rgb, clip.start_index) for known in settled],
        watched,
        progress,
        words,
        False,
    )
    # What the first pass saw serves further looks as well.
    done = [replace(known, glimpses=first.glimpses) for known, first in zip(done, chained, strict=True)]
    return done, watched


def look_again(clip: Clip, done: Sequence[Followed], watched: Watched, progress: Progress) -> list[Followed]:
    """What `follow_both_ways` came to, those vessels fitted and followed once more that it is not sure of.

    Better poses tell the shape better, and a better shape the poses: as long as that makes them surer.
    """
    best = list(done)
    unsure = list(range(len(best)))
    for _ in range(MORE_LOOKS):
        unsure = [k for k in unsure if best[k].vessel is not None and best[k].sure < SURE_ENOUGH]
        if not unsure:
            break
        settled = [best[k].second_pass(clip.rgb) for k in unsure]
        begin = [partial(known.again, clip.rgb, clip.start_index) for known in settled]
        words = "following once more what is not followed surely"
        more = _pass(clip, begin, Watched(watched.times), progress, words, False)
        surer = {k: new for k, new in zip(unsure, more, strict=True) if new.sure > best[k].sure + SURER}
        for k, new in surer.items():
            best[k] = replace(new, glimpses=best[k].glimpses)
        unsure = list(surer)  # the others would come out as they did
    return best


def _pass(
    clip: Clip,
    begin: Sequence[Callable[[], Followed]],
    watched: Watched,
    progress: Progress,
    words: str,
    chained: bool,
) -> list[Followed]:
    """One pass over the clip with objects that `begin` puts at the start frame.

    chained: frames are told by their distance from the start frame, and their glimpses renamed afterwards.
    """
    start, count = clip.start_index, clip.info.frame_count
    forward = [make() for make in begin]
    for frame in iterate_frames(clip.info.path, WORKING_SIDE_PX, clip.info):
        if chained:
            watched.times[frame.index] = frame.time_s
            watched.cuts.step(frame.rgb, frame.time_s)
        elif watched.camera is not None:
            watched.camera.step(frame.rgb, boxes=[b for f in forward if (b := _box(f, frame.index)) is not None])
        if frame.index >= start:
            depth = clip.depth_of(frame.index)
            for follower in forward:
                follower.step(frame.rgb, frame.index - (start if chained else 0), count, depth)
            progress(frame.index + 1 - start, count, words)
    if start == 0:
        return forward
    backward = [make() for make in begin]
    before = [watched.times[k] for k in range(start + 1)]
    for frame in iterate_backward(clip.info.path, before, WORKING_SIDE_PX):
        depth = clip.depth_of(frame.index)
        for follower in backward:
            follower.step(frame.rgb, start - frame.index if chained else frame.index, count, depth)
        progress(count - frame.index, count, words)
    return [_joined(b, f, start) for b, f in zip(backward, forward, strict=True)]


def _box(known: Followed, index: int) -> Box | None:
    """Box around an object where the first pass saw it in a frame."""
    if known.guesses is None or index >= len(known.guesses):
        return None
    return projected_box(known.camera_matrix, known.guesses[index], known.mesh.vertices_m)


def _joined(backward: Followed, forward: Followed, start: int) -> Followed:
    """One object over the whole clip; both halves hold the start frame."""
    glimpses = [g.reversed(start) for g in reversed(backward.glimpses) if g.index > 0]
    glimpses += [replace(g, index=start + g.index) for g in forward.glimpses]
    estimates = [*reversed(backward.estimates[1:]), *forward.estimates]
    return replace(forward, estimates=estimates, glimpses=glimpses)


def _begun(clip: Clip, start: Start, hypothesis: int = 0) -> Followed:
    chosen = start.hypotheses[hypothesis]
    mask, T = resized(chosen.mask, clip.rgb), chosen.pose.T_camera_object
    model = chosen.model
    return Followed.start(
        model.mesh, model.vessel, clip.camera_matrix, clip.rgb, mask, T,
        symmetry=model.symmetry, background=clip.background,
    )  # fmt: skip


def _surest(sure: Sequence[float]) -> int:
    """Which of the rivals is to be kept: the first, unless another is surer by a margin."""
    best = int(np.argmax(sure))
    return best if sure[best] > sure[0] + TRIAL_MARGIN else 0
