"""Cuts: found to the frame where shots are joined, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from vid2demo.extract.cuts import Cut, CutWatch
from vid2demo.extract.video import iterate_frames

DATA = Path(__file__).parents[2].parent / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
WIDTH, HEIGHT, FPS = 320, 240, 25.0


def shot(seed: int, count: int, *, speed_px: float = 3.0) -> list[np.ndarray]:
    """Colours and shapes of their own, panned over, with noise and a thing that moves quickly."""
    rng = np.random.default_rng(seed)
    ground = rng.normal(rng.uniform(60, 190, 3), 45, (24, 40, 3))
    wide = cv2.resize(ground, (4 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    frames = []
    for k in range(count):
        left = int(speed_px * k) % (3 * WIDTH)
        image = wide[:, left : left + WIDTH] + rng.normal(0, 5, (HEIGHT, WIDTH, 3))
        x = (37 * k) % (WIDTH - 60)
        image[90:160, x : x + 60] = rng.uniform(0, 255, 3) if k == 0 else image[100, x]
        frames.append(np.clip(image, 0, 255).astype(np.uint8))
    return frames


def cuts_of(frames: list[np.ndarray]) -> list[Cut]:
    watch = CutWatch()
    for k, frame in enumerate(frames):
        watch.step(frame, k / FPS)
    return watch.cuts


@pytest.mark.parametrize("lengths", [(30, 30), (3, 20), (12, 1, 30), (20, 15, 25, 10)])
def test_joints_are_found_to_the_frame(lengths: tuple[int, ...]) -> None:
    frames = [frame for seed, count in enumerate(lengths) for frame in shot(seed, count)]
    joints = np.cumsum(lengths)[:-1]
    found = cuts_of(frames)
    assert [cut.index for cut in found] == joints.tolist()
    assert [cut.time_s for cut in found] == pytest.approx(joints / FPS)


def test_the_frame_after_the_cut_confirms_it() -> None:
    watch = CutWatch()
    frames = [*shot(0, 10), *shot(1, 5)]
    answers = [watch.step(frame, float(k)) for k, frame in enumerate(frames)]
    assert [k for k, cut in enumerate(answers) if cut is not None] == [11]
    assert answers[11] == watch.cuts[0]
    assert 0.3 < watch.cuts[0].change <= 1.0


@pytest.mark.parametrize("speed_px", [0.0, 4.0, 10.0])
def test_pans_and_quick_things_are_no_cuts(speed_px: float) -> None:
    assert cuts_of(shot(3, 50, speed_px=speed_px)) == []


@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_frame_is_no_cut(level: int) -> None:
    frames = shot(4, 30)
    frames[12] = np.full_like(frames[12], level)
    assert cuts_of(frames) == []


def test_light_that_changes_is_no_cut() -> None:
    frames = [np.clip(frame * (1 - 0.5 * k / 40), 0, 255).astype(np.uint8) for k, frame in enumerate(shot(5, 40))]
    assert cuts_of(frames) == []


def test_black_clips_single_frames_and_other_sizes_are_taken() -> None:
    assert cuts_of([np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 5) == []
    assert cuts_of(shot(0, 1)) == []
    assert cuts_of([cv2.resize(frame, (90, 700)) for frame in shot(0, 6)]) == []


@needs_data
@pytest.mark.parametrize("name", ["videos/coffee_pour.mp4", "videos/box_turn.mp4", "tracking/mustard_a/video.mp4"])
def test_no_false_alarm_in_real_clips_and_their_joints_are_found(name: str) -> None:
    frames = [frame.rgb for frame in iterate_frames(DATA / name, 320) if frame.index % 3 == 0]
    assert cuts_of(frames) == []
    other = [cv2.resize(f, (frames[0].shape[1], frames[0].shape[0])) for f in shot(6, 10)]
    assert [cut.index for cut in cuts_of([*frames[:40], *other])] == [40]
