"""What a still camera sees behind moving things, and what is held at the end of an arm that comes in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from vid2demo.extract.background import BACKGROUND, FOREGROUND, SHADOW, learn_background, mask_trust
from vid2demo.extract.handled import find_handled, reach_from_border

HEIGHT, WIDTH, COUNT = 120, 160, 24
TABLE, CUP, SLEEVE, SKIN = (170, 160, 130), (40, 90, 190), (70, 140, 80), (205, 150, 125)


def scene(rng: np.random.Generator) -> np.ndarray:
    """A table with things on it that never move: the texture by which a still camera is known."""
    image = np.full((HEIGHT, WIDTH, 3), TABLE, np.uint8)
    for _ in range(12):
        x, y = int(rng.integers(0, WIDTH)), int(rng.integers(0, 30))
        cv2.rectangle(image, (x, y), (x + 9, y + 12), tuple(int(v) for v in rng.integers(0, 255, 3)), -1)
    return image


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + rng.normal(0, 2.5, image.shape), 0, 255).astype(np.uint8)


def clip(rng: np.random.Generator, brightening: float = 0.0) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Frames of a cup that an arm carries from left to right, the empty scene, and the cup's mask in the first."""
    empty = scene(rng)
    frames = []
    for k in range(COUNT):
        x = 40 + round(70 * min(1.0, max(0.0, (k - 6) / 6)))
        image = empty.copy()
        cv2.rectangle(image, (x - 12, 84), (x + 12, 92), tuple(int(0.6 * v) for v in TABLE), -1)  # its shadow
        cv2.line(image, (x - 25, 0), (x - 9, 30), SLEEVE, 9)
        cv2.line(image, (x - 9, 34), (x, 50), SKIN, 9)
        cv2.rectangle(image, (x - 10, 54), (x + 10, 83), CUP, -1)
        frames.append(noisy(image * (1 + brightening * k / COUNT), rng))
    first = np.zeros((HEIGHT, WIDTH), bool)
    first[54:84, 30:51] = True
    return frames, empty, first


def test_a_thing_that_is_carried_off_is_no_background() -> None:
    frames, empty, cup = clip(np.random.default_rng(0))
    background = learn_background(frames)
    assert background is not None
    off = np.abs(background.rgb.astype(int) - empty).max(axis=-1)
    place = np.s_[50:90, 95:125]  # where the cup stands from the middle of the clip to its end
    assert np.mean(off[cup] < 20) > 0.95
    assert np.mean(off[place] < 20) > 0.9


def test_labels_tell_thing_shadow_and_background() -> None:
    frames, _, cup = clip(np.random.default_rng(1))
    background = learn_background(frames)
    assert background is not None
    labels = background.labels(frames[0])
    assert np.mean(labels[cup] == FOREGROUND) > 0.95
    assert np.mean(labels[86:91, 30:50] == SHADOW) > 0.8
    assert np.mean(labels[100:, 60:] == BACKGROUND) > 0.97


def test_what_is_covered_for_sure_ends_where_the_thing_does() -> None:
    """Labels are those of a blurred picture and reach beyond a thing: outlines would be led outward by them."""
    frames, _, cup = clip(np.random.default_rng(3))
    background = learn_background(frames)
    assert background is not None
    beside = np.zeros_like(cup)
    beside[58:80, 51:60] = True  # where there is neither shadow nor arm
    assert np.any((background.labels(frames[0]) == FOREGROUND) & beside)
    covered = background.covered(frames[0])
    assert not np.any(covered & beside)
    assert np.mean(covered[cup]) > 0.65


def test_a_mask_is_not_believed_where_a_shadow_in_it_goes_on_outside() -> None:
    labels = np.full((40, 60), BACKGROUND, np.uint8)
    mask = np.zeros(labels.shape, bool)
    mask[10:30, 20:40] = True
    labels[mask] = FOREGROUND
    labels[22:30, 5:25] = SHADOW  # of a hand, taken in by the mask
    labels[12:16, 34:41] = SHADOW  # the thing itself, grey
    labels[5:10, 40:50] = FOREGROUND  # a hand
    trust = mask_trust(mask, labels)
    assert trust[25, 22] < 0.1 < 0.4 < trust[14, 36] < 0.6
    assert trust[25, 10] == trust[20, 30] == trust[2, 2] == 1
    assert trust[7, 45] < 0.1


def test_a_slow_change_of_light_moves_nothing() -> None:
    frames, _, _ = clip(np.random.default_rng(2), brightening=0.25)
    background = learn_background(frames)
    assert background is not None
    assert np.mean(background.labels(frames[-1])[100:, :20] == FOREGROUND) < 0.05


def test_a_camera_that_moves_has_no_background() -> None:
    rng = np.random.default_rng(3)
    wide = np.clip(rng.normal(128, 60, (HEIGHT, 3 * WIDTH, 3)), 0, 255).astype(np.uint8)
    wide = cv2.GaussianBlur(wide, (0, 0), 2.0)
    wide = np.clip((wide.astype(float) - 128) * 4 + 128, 0, 255).astype(np.uint8)
    assert learn_background([wide[:, 9 * k : 9 * k + WIDTH] for k in range(COUNT)]) is None


def test_too_few_frames_have_no_background() -> None:
    assert learn_background([scene(np.random.default_rng(4))] * 3) is None


def test_what_is_held_is_what_is_neither_sleeve_nor_hand() -> None:
    frames, _, cup = clip(np.random.default_rng(5))
    background = learn_background(frames)
    assert background is not None
    found = find_handled(frames[0], background.labels(frames[0]))
    assert found is not None
    shared = np.count_nonzero(found.thing & cup) / np.count_nonzero(found.thing | cup)
    assert shared > 0.75
    assert found.arm[10, 20]


def test_nothing_is_held_where_nothing_moves() -> None:
    image = scene(np.random.default_rng(6))
    assert find_handled(image, np.full((HEIGHT, WIDTH), BACKGROUND, np.uint8)) is None


def test_reach_counts_the_way_from_the_border_and_puts_loose_things_last() -> None:
    moving = np.zeros((20, 30), bool)
    moving[10, :15] = True
    moving[3:5, 20:22] = True
    reach = reach_from_border(moving)
    assert reach[10, 1] == 1
    assert np.all(np.diff(reach[10, 1:15]) == 1)
    assert reach[3, 20] > reach[10, 14]
    assert reach[~moving] == pytest.approx(0)
