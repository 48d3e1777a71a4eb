"""Regions that may be objects: what is background, how regions are joined, and which are taken for things."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from vid2demo.extract.region_tree import Superpixels, likely_regions, region_tree, superpixels, unlike_background

SIZE = (320, 240)
TABLE, SHADE = (150, 110, 70), 0.6


def table(rng: np.random.Generator) -> NDArray[np.float64]:
    """A brown table with stripes, lit from the left, in front of a grey wall."""
    picture = np.empty((SIZE[1], SIZE[0], 3))
    picture[:] = TABLE
    picture[:, (np.arange(SIZE[0]) // 12) % 2 == 0] *= 0.9
    picture *= np.linspace(1.1, 0.9, SIZE[0])[:, None]
    picture[:50] = 120
    return picture + rng.normal(0, 2, picture.shape)


def disc(centre: tuple[int, int], radius: int) -> NDArray[np.bool_]:
    drawn = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    return np.asarray(cv2.circle(drawn, centre, radius, 1, -1) > 0)


def shown(picture: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.clip(picture, 0, 255).astype(np.uint8)


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float(np.count_nonzero(a & b) / np.count_nonzero(a | b))


def test_shadows_are_background_and_other_hues_are_not() -> None:
    picture = table(np.random.default_rng(0))
    shadow, thing = disc((100, 150), 25), disc((220, 150), 25)
    picture[shadow] *= SHADE
    picture[thing] = (40, 90, 160)
    unlike = unlike_background(shown(picture))
    assert np.median(unlike[thing]) > 0.95
    assert np.median(unlike[shadow]) < 0.6
    assert np.median(unlike[60:]) < 0.6


def test_things_that_touch_come_out_one_by_one() -> None:
    picture = table(np.random.default_rng(1))
    things = [disc((130, 140), 30), disc((180, 150), 25), disc((240, 190), 14)]
    picture[disc((150, 165), 30)] *= SHADE
    for thing, colour in zip(things, ((40, 90, 160), (190, 40, 40), (60, 160, 60)), strict=True):
        picture[thing] = colour
    visible = [things[0] & ~things[1], things[1], things[2]]
    found = likely_regions(shown(picture), 10)
    assert [region.score for region in found] == sorted((region.score for region in found), reverse=True)
    for thing in visible:
        assert max(iou(region.mask, thing) for region in found[:5]) > 0.85
    assert len(likely_regions(shown(picture), 2)) == 2


def test_a_thing_of_the_table_s_colour_is_found_by_its_edge() -> None:
    picture = table(np.random.default_rng(2))
    thing = disc((160, 150), 30)
    edge = thing ^ disc((160, 150), 27)
    picture[thing] = TABLE
    picture[edge] *= 0.3
    assert max(iou(region.mask, thing) for region in likely_regions(shown(picture), 10)) > 0.7


def test_a_bare_table_and_a_tiny_picture_show_nothing() -> None:
    bare = likely_regions(shown(table(np.random.default_rng(3))), 10)
    picture = table(np.random.default_rng(3))
    picture[disc((160, 150), 25)] = (40, 90, 160)
    assert max((region.score for region in bare), default=0.0) < 0.5 * likely_regions(shown(picture), 1)[0].score
    assert likely_regions(np.full((90, 120, 3), 90, np.uint8), 10) == []
    assert likely_regions(np.full((6, 6, 3), 90, np.uint8), 10) == []


def test_every_pixel_belongs_to_a_superpixel() -> None:
    for seed in (79, 92, 187, 281):  # in these noises watershed lines cut off a corner
        rgb = np.random.default_rng(seed).integers(0, 256, (27, 27, 3), np.uint8)
        pixels = superpixels(rgb, np.zeros((27, 27), np.float32))
        assert pixels.labels.min() >= 0
        assert pixels.area_px.sum() == 27 * 27


@pytest.mark.parametrize("seed", range(5))
def test_the_weakest_mean_edge_is_joined_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 9
    pairs = np.array([(i, j) for i in range(count) for j in range(i + 1, count) if rng.random() < 0.5])
    length = rng.integers(1, 9, len(pairs)).astype(float)
    strength = length * rng.random(len(pairs))
    chosen = rng.random(count) < 0.8
    pixels = Superpixels(np.zeros((1, 1), np.int32), np.ones(count), np.ones(count), pairs, length, strength)
    tree = region_tree(pixels, chosen)
    found = {
        frozenset(tree.order[a:b].tolist()): height
        for a, b, height in zip(tree.first, tree.last, tree.height, strict=True)
        if b > a
    }
    # As slow as can be: after every join each mean edge is summed anew over the pairs.
    groups = {frozenset([k]): 0.0 for k in np.flatnonzero(chosen).tolist()}
    expected = dict(groups)
    while True:
        means = {}
        for one in groups:
            for other in groups:
                between = [(one & {i} and other & {j}) or (one & {j} and other & {i}) for i, j in pairs.tolist()]
                if one != other and any(between):
                    at = np.flatnonzero([bool(b) for b in between])
                    means[frozenset([one, other])] = strength[at].sum() / length[at].sum()
        if not means:
            break
        one, other = min(means, key=lambda pair: means[pair])
        height = max(means[frozenset([one, other])], groups.pop(one), groups.pop(other))
        groups[one | other] = expected[one | other] = height
    assert found.keys() == expected.keys()
    for region, height in expected.items():
        assert found[region] == pytest.approx(height)
