"""Go through a clip from the start frame to its end and back to its beginning, with every object, twice.

The first pass chains frame to frame, away from the start frame on either side. The second begins from what was settled
over the whole clip (follow.py) and reads the clip in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .follow import Followed
from .geometry import Array
from .progress import Progress
from .starting import WORKING_SIDE_PX, Start, resized
from .video import Image, VideoInfo, iterate_backward, iterate_frames

TRIAL_FRAMES = 15  # that rivals for the first pose are followed before one of them is taken
TRIAL_MARGIN = 0.02  # of mean confidence, by which the one that looked worse at first must be better


@dataclass(frozen=True)
class Clip:
    """A video and where in it to start. rgb: the start frame at working size; camera_matrix belongs to that size."""

    info: VideoInfo
    start_index: int
    rgb: Image
    camera_matrix: Array


def settle_rivals(clip: Clip, starts: Sequence[Start]) -> list[Start]:
    """The starts, with those hypotheses put first that are followed best through some frames.

    Only what is turned far from the best and explains the start frame nearly as well is tried.
    """
    trials = [[_begun(clip, start, k) for k in range(len(start.hypotheses))] for start in starts]
    if all(len(trial) == 1 for trial in trials):
        return list(starts)
    for frame in iterate_frames(clip.info.path, WORKING_SIDE_PX, clip.info):
        if frame.index < clip.start_index:
            continue
        if frame.index > clip.start_index + TRIAL_FRAMES:
            break
        for trial in trials:
            for follower in trial if len(trial) > 1 else ():
                follower.step(frame.rgb, frame.index - clip.start_index, TRIAL_FRAMES)
    return [start.preferring(_surest(trial)) for start, trial in zip(starts, trials, strict=True)]


def follow_both_ways(clip: Clip, starts: Sequence[Start], progress: Progress) -> tuple[list[Followed], Array]:
    """Every object through the whole clip, twice; and the times of the frames (N,) in s.

    Estimates of the result are by frame of the clip.
    """
    times: dict[int, float] = {}
    chained = _pass(clip, [lambda s=start: _begun(clip, s) for start in starts], times, progress, "following", True)
    progress(0, clip.info.frame_count, "fitting shapes to the whole clip")
    settled = [followed.second_pass(clip.rgb) for followed in chained]

    def again(known: Followed) -> Followed:
        assert known.guesses is not None
        T = known.guesses[clip.start_index]
        return Followed.start(
            known.mesh, known.vessel, clip.camera_matrix, clip.rgb, known.first_mask, T, known.guesses
        )

    words = "following again, with the whole clip in mind"
    done = _pass(clip, [lambda k=known: again(k) for known in settled], times, progress, words, False)
    return done, np.array([times[k] for k in sorted(times)])


def _pass(
    clip: Clip,
    begin: Sequence[Callable[[], Followed]],
    times: dict[int, float],
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
        times[frame.index] = frame.time_s
        if frame.index >= start:
            for follower in forward:
                follower.step(frame.rgb, frame.index - (start if chained else 0), count)
            progress(frame.index + 1 - start, count, words)
    if start == 0:
        return forward
    backward = [make() for make in begin]
    before = [times[k] for k in range(start + 1)]
    for frame in iterate_backward(clip.info.path, before, WORKING_SIDE_PX):
        for follower in backward:
            follower.step(frame.rgb, start - frame.index if chained else frame.index, count)
        progress(count - frame.index, count, words)
    return [_joined(b, f, start) for b, f in zip(backward, forward, strict=True)]


def _joined(backward: Followed, forward: Followed, start: int) -> Followed:
    """One object over the whole clip; both halves hold the start frame."""
    glimpses = [replace(g, index=start - g.index) for g in reversed(backward.glimpses) if g.index > 0]
    glimpses += [replace(g, index=start + g.index) for g in forward.glimpses]
    estimates = [*reversed(backward.estimates[1:]), *forward.estimates]
    return replace(forward, estimates=estimates, glimpses=glimpses)


def _begun(clip: Clip, start: Start, hypothesis: int = 0) -> Followed:
    chosen = start.hypotheses[hypothesis]
    mask, T = resized(chosen.mask, clip.rgb), chosen.pose.T_camera_object
    return Followed.start(chosen.model.mesh, chosen.model.vessel, clip.camera_matrix, clip.rgb, mask, T)


def _surest(trial: Sequence[Followed]) -> int:
    """Which of the followers is to be kept: the first, unless another is surer by a margin."""
    sure = [float(np.mean([e.confidence for e in f.estimates])) if f.estimates else 0.0 for f in trial]
    best = int(np.argmax(sure))
    return best if sure[best] > sure[0] + TRIAL_MARGIN else 0
