from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.bop import ImageKey, open_dataset
from vid2demo.extract.bop_write import Frame, Instance, write_scene
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose
from vid2demo.extract.proposal_metrics import (
    OVERLAPS,
    ProposedMask,
    Table,
    average_precision,
    judge_proposals,
    matched,
    overlaps,
    read_proposals,
    recall_of_surest,
    write_proposals,
)


def square(x: int, y: int, side: int = 10) -> np.ndarray:
    mask = np.zeros((48, 64), bool)
    mask[y : y + side, x : x + side] = True
    return mask


def random_table(rng: np.random.Generator) -> Table:
    proposed, true = int(rng.integers(0, 15)), int(rng.integers(0, 6))
    iou = np.where(rng.random((proposed, true)) < 0.6, rng.random((proposed, true)), 0.0)
    return np.sort(rng.random(proposed))[::-1], iou, rng.random(true) < 0.2


def slow_average_precision(tables: list[Table], overlap: float) -> float:
    """By the definition: for every score as the threshold, precision and recall of what is at least that sure."""
    objects = sum(int((~ignored).sum()) for _, _, ignored in tables)
    if objects == 0:
        return 0.0
    listed = []
    for table in tables:
        listed += list(zip(table[0], matched(table, overlap), strict=True))
    points = []
    for threshold, _ in listed:
        kept = [kind for score, kind in listed if score >= threshold and kind >= 0]
        if kept:
            points.append((kept.count(1) / objects, kept.count(1) / len(kept)))
    best = [max((p for r, p in points if r >= recall - 1e-12), default=0.0) for recall in np.linspace(0, 1, 101)]
    return float(np.mean(best))


@pytest.mark.parametrize("seed", range(10))
def test_average_precision_is_that_of_its_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tables = [random_table(rng) for _ in range(6)]
    for overlap in OVERLAPS[::3]:
        assert average_precision(tables, overlap) == pytest.approx(slow_average_precision(tables, overlap))


def test_average_precision_computed_by_hand() -> None:
    """Right, wrong, right of two objects: precision 1 up to recall 0.5 (51 of 101 recalls), then 2 / 3."""
    iou = np.array([[0.9, 0.0], [0.2, 0.0], [0.0, 0.8]])
    table = (np.array([0.9, 0.8, 0.7]), iou, np.zeros(2, bool))
    assert average_precision([table], 0.5) == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert average_precision([table], 0.85) == pytest.approx(51 / 101)
    assert recall_of_surest([table], 0.5, 2) == 0.5
    assert recall_of_surest([table], 0.5, 10) == 1.0


def test_an_object_is_found_once_and_the_surest_proposal_finds_it() -> None:
    table = (np.array([0.9, 0.8]), np.array([[0.6], [0.9]]), np.zeros(1, bool))
    assert list(matched(table, 0.5)) == [1, 0]


def test_an_object_that_does_not_count_is_neither_needed_nor_wrong() -> None:
    table = (np.array([0.9, 0.8]), np.array([[0.9, 0.6], [0.8, 0.0]]), np.array([True, False]))
    # The first prefers the object that counts; the second falls to the one that does not.
    assert list(matched(table, 0.5)) == [1, -1]
    assert average_precision([table], 0.5) == pytest.approx(1.0)


def test_overlaps_are_those_of_the_masks() -> None:
    found = overlaps([square(0, 0), square(5, 0)], [square(0, 0), square(30, 30)])
    assert found == pytest.approx(np.array([[1.0, 0.0], [50 / 150, 0.0]]))
    assert overlaps([], [square(0, 0)]).shape == (0, 1)


def data_set(folder: Path) -> None:
    instances = tuple(
        Instance(k + 1, make_pose(t=(0, 0, 1)), m, m)
        for k, m in enumerate([square(2, 2), square(20, 20), square(45, 5)])
    )
    rgb = np.zeros((48, 64, 3), np.uint8)
    write_scene(folder, "test", 0, [Frame(0, rgb, np.ones((48, 64), np.float32), np.eye(3), instances)])


def test_proposals_are_judged_from_a_file(tmp_path: Path) -> None:
    data_set(tmp_path)
    image, dataset = ImageKey(0, 0), open_dataset(tmp_path)
    good = {image: [ProposedMask(square(x, y), 0.5) for x, y in ((2, 2), (20, 20), (45, 5))]}
    write_proposals(tmp_path / "good.json", good)
    scores = judge_proposals(dataset, read_proposals(tmp_path / "good.json"))
    assert (scores.ap, scores.ar_at_10, scores.per_image, scores.objects) == (
        *(pytest.approx(100.0), pytest.approx(100.0), 3.0, 3),
    )
    # One of three found with an IoU of 80 / 120: four of ten overlaps (0.50 to 0.65) admit it.
    one = judge_proposals(dataset, {image: [ProposedMask(square(4, 2), 0.9)]})
    assert one.ar_at_10 == pytest.approx(100 * 0.4 / 3)
    assert one.ap == pytest.approx(100 * 0.4 * 34 / 101)
    assert judge_proposals(dataset, {}).ap == 0.0


def test_bad_proposals_are_named(tmp_path: Path) -> None:
    data_set(tmp_path)
    with pytest.raises(UserError, match="a mask of"):
        judge_proposals(open_dataset(tmp_path), {ImageKey(0, 0): [ProposedMask(np.ones((4, 4), bool), 1.0)]})
    path = tmp_path / "bad.json"
    for text, message in (("{}", "not a list"), ('[{"scene_id": 0}]', "entry 0 lacks"), ("[", "valid JSON")):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            read_proposals(path)
