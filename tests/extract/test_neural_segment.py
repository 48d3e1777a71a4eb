from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.neural_segment import (
    FOR_IMAGES,
    FOR_VIDEOS,
    NeuralSegmenter,
    Thresholds,
    as_prompt,
    large_enough,
)
from vid2demo.extract.protocols import Segmenter

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may

HEIGHT, WIDTH = 120, 160
EVERYTHING = Thresholds(box=0.0, text=0.0, area_px=1, side_px=1)
Picture = np.ndarray[Any, np.dtype[np.uint8]]


def picture(seed: int = 0) -> Picture:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def rectangle(x: int, y: int, width: int, height: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y : y + height, x : x + width] = True
    return mask


def build(folder: Path, **settings: Any) -> NeuralSegmenter:
    return NeuralSegmenter("grounding-dino-tiny", "sam2-small", models_dir=folder, device="cpu", **settings)


@pytest.fixture(scope="module")
def segmenter(tiny_models: Path) -> NeuralSegmenter:
    return build(tiny_models, thresholds=EVERYTHING)


def test_proposals_have_boxes_masks_scores_and_labels(segmenter: NeuralSegmenter) -> None:
    assert isinstance(segmenter, Segmenter)
    proposals = segmenter.propose(picture(), "Mug, kettle")
    assert proposals
    scores = [p.score for p in proposals]
    assert scores == sorted(scores, reverse=True)
    for proposal in proposals:
        x, y, width, height = proposal.box_xywh_px
        assert x >= 0
        assert y >= 0
        assert 1 <= width <= WIDTH - x
        assert 1 <= height <= HEIGHT - y
        assert proposal.mask.shape == (HEIGHT, WIDTH)
        assert proposal.mask.dtype == bool
    again = segmenter.propose(picture(), "Mug, kettle")
    assert [p.box_xywh_px for p in again] == [p.box_xywh_px for p in proposals]


def test_higher_threshold_keeps_fewer_boxes(tiny_models: Path, segmenter: NeuralSegmenter) -> None:
    found = segmenter.detect(picture(), "objects.")
    middle = float(np.median([score for _, score, _ in found]))
    strict = build(tiny_models, thresholds=Thresholds(middle, 0.0, 1, 1)).detect(picture(), "objects.")
    assert strict == [entry for entry in found if entry[1] > middle]
    assert 0 < len(strict) < len(found)


def test_boxes_without_a_label_are_dropped_in_videos_only(tiny_models: Path) -> None:
    """No word of the prompt reaches a text threshold of 1, so no box has a label."""
    named = Thresholds(0.0, 1.0, 1, 1)
    assert {label for _, _, label in build(tiny_models, thresholds=named).detect(picture())} == {""}
    assert build(tiny_models, thresholds=Thresholds(0.0, 1.0, 1, 1, labelled=True)).detect(picture()) == []


def test_the_papers_thresholds() -> None:
    assert (FOR_IMAGES.box, FOR_IMAGES.text, FOR_IMAGES.area_px, FOR_IMAGES.side_px) == (0.3, 0.5, 100, 5)
    assert (FOR_VIDEOS.box, FOR_VIDEOS.text, FOR_VIDEOS.area_px, FOR_VIDEOS.side_px) == (0.2, 0.2, 100, 10)


@pytest.mark.parametrize(
    ("mask", "image", "video"),
    [
        (rectangle(0, 0, 10, 10), True, True),
        (rectangle(0, 0, 9, 11), False, False),  # 99 px
        (rectangle(150, 20, 9, 12), True, False),  # 9 px wide
        (rectangle(3, 3, 4, 60), False, False),
        (rectangle(0, 0, WIDTH, HEIGHT), True, True),
        (rectangle(0, 0, 0, 0), False, False),
    ],
)
def test_small_masks_are_rejected(mask: Any, image: bool, video: bool) -> None:
    assert large_enough(mask, FOR_IMAGES) == image
    assert large_enough(mask, FOR_VIDEOS) == video


def test_masks_of_many_boxes_are_those_of_single_boxes(segmenter: NeuralSegmenter) -> None:
    boxes = [(float(x), 10.0, 30.0, 40.0) for x in range(0, 120, 3)]  # more than are cut at once
    together = segmenter.segment(picture(), boxes)
    assert len(together) == len(boxes)
    for k in (0, 31, 32, 39):
        (alone,) = segmenter.segment(picture(), [boxes[k]])
        assert np.mean(alone != together[k]) < 1e-3
    assert segmenter.segment(picture(), []) == []


def test_propagation_begins_with_the_given_masks_and_keeps_every_object(segmenter: NeuralSegmenter) -> None:
    """Random weights lose the objects at once: they stay, with empty masks, and frames are taken one by one."""
    masks = [rectangle(30, 20, 60, 40), rectangle(30, 70, 30, 30), rectangle(100, 20, 40, 80)]
    taken = []

    def frames() -> Iterator[Picture]:
        for k in range(25):
            taken.append(k)
            yield picture(k)

    stream = segmenter.propagate(frames(), masks)
    first = next(stream)
    assert taken == [0]
    for mask, found in zip(masks, first, strict=True):
        assert np.sum(mask & found) / np.sum(mask | found) > 0.9
    rest = list(stream)
    assert len(rest) == 24
    assert all(frame.shape == (3, HEIGHT, WIDTH) and frame.dtype == bool for frame in rest)
    assert any(not frame.any() for frame in rest)


def test_forgetting_the_past_changes_nothing(tiny_models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same frames with nothing forgotten give the same masks: only what is not looked at is dropped."""
    masks = [rectangle(30, 20, 60, 40)]
    frames = [picture(k % 3) for k in range(30)]
    lean = [m.copy() for m in build(tiny_models).propagate(frames, masks)]
    monkeypatch.setattr("vid2demo.extract.neural_segment._forget", lambda session, before: None)
    full = [m.copy() for m in build(tiny_models).propagate(frames, masks)]
    assert all(np.array_equal(a, b) for a, b in zip(lean, full, strict=True))


def test_one_object_alone_is_followed_as_among_others(segmenter: NeuralSegmenter) -> None:
    masks = [rectangle(30, 20, 60, 40), rectangle(100, 20, 40, 80)]
    frames = [picture(k) for k in range(4)]
    together = list(segmenter.propagate(frames, masks))
    alone = list(segmenter.propagate(frames, masks[1:]))
    for both, one in zip(together, alone, strict=True):
        np.testing.assert_array_equal(both[1], one[0])


def test_videos_without_frames_or_objects(segmenter: NeuralSegmenter) -> None:
    assert list(segmenter.propagate([], [rectangle(0, 0, 9, 9)])) == []
    assert [m.shape for m in segmenter.propagate([picture()] * 2, [])] == [(0, HEIGHT, WIDTH)] * 2


def test_masks_of_another_size_are_refused(segmenter: NeuralSegmenter) -> None:
    with pytest.raises(UserError, match=r"masks of \(5, 5\) px for frames of \(120, 160\) px"):
        next(segmenter.propagate([picture()], [np.ones((5, 5), bool)]))


def test_half_precision_runs_and_says_so(tiny_models: Path, segmenter: NeuralSegmenter) -> None:
    half = build(tiny_models, precision="half", thresholds=EVERYTHING)
    assert "bfloat16" in half.name
    assert half.name != segmenter.name
    assert len(half.propose(picture())) == len(segmenter.propose(picture()))
    (found,) = next(half.propagate([picture()], [rectangle(30, 20, 60, 40)]))
    assert np.sum(found & rectangle(30, 20, 60, 40)) / np.sum(found | rectangle(30, 20, 60, 40)) > 0.9


@pytest.mark.parametrize(
    ("words", "prompt"),
    [("objects.", "objects."), ("Mug, Kettle", "mug. kettle."), (" a red cup . bowl ", "a red cup. bowl.")],
)
def test_prompts_are_brought_into_the_detectors_form(words: str, prompt: str) -> None:
    assert as_prompt(words) == prompt


def test_empty_prompts_are_refused() -> None:
    with pytest.raises(UserError, match="the prompt is empty"):
        as_prompt(" . ")


def test_missing_and_wrong_weights_are_named(tiny_models: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="vid2demo models pull grounding-dino-tiny"):
        build(tmp_path)
    shutil.copytree(tiny_models / "grounding-dino-tiny", tmp_path / "grounding-dino-tiny")
    with pytest.raises(UserError, match="vid2demo models pull sam2-small"):
        build(tmp_path)
    with pytest.raises(UserError, match="model sam2-small is for masks, not for detector"):
        NeuralSegmenter("sam2-small", "sam2-small", models_dir=tiny_models)


def test_pictures_are_scaled_as_the_model_cards_say() -> None:
    """GroundingDINO: shorter side 800, longer at most 1333; SAM 2: 1024 x 1024; both with ImageNet's mean."""
    from transformers import GroundingDinoImageProcessor, Sam2ImageProcessor

    wide = np.full((300, 600, 3), 124, np.uint8)
    detector = GroundingDinoImageProcessor()(images=wide, return_tensors="np").pixel_values
    assert detector.shape[2:] == (666, 1333) or detector.shape[2:] == (667, 1333)
    masks = Sam2ImageProcessor()(images=wide, return_tensors="np").pixel_values
    assert masks.shape == (1, 3, 1024, 1024)
    for pixels in (detector, masks):
        np.testing.assert_allclose(pixels[0, 0].mean(), (124 / 255 - 0.485) / 0.229, atol=1e-3)
