"""The tracker's compiled loops against slow and obvious ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from vid2demo.extract.raster import DepthWindow
from vid2demo.extract.region_kernels import count_bins, smooth_histogram


@pytest.mark.parametrize("taken", [0, 1, 5, 400])
def test_a_histogram_is_spread_over_its_neighbours_wherever_it_is_taken(taken: int) -> None:
    rng = np.random.default_rng(taken)
    cube = np.zeros((8, 8, 8), np.float32)
    places = rng.integers(0, 8, (taken, 3))
    cube[tuple(places.T)] = rng.uniform(1, 5, taken)
    if taken == 1:
        cube = np.roll(cube, tuple(-places[0]), (0, 1, 2))  # into a corner, beyond which there is nothing
    expected = np.pad(cube, 1)
    for axis in range(3):
        expected = 0.5 * expected + 0.25 * (np.roll(expected, 1, axis) + np.roll(expected, -1, axis))
    expected = expected[1:-1, 1:-1, 1:-1] / max(float(expected[1:-1, 1:-1, 1:-1].sum()), 1e-12)
    histogram = cube.ravel().copy()
    smooth_histogram(histogram, 8)
    np.testing.assert_allclose(histogram, expected.ravel(), atol=1e-6)


def test_colour_bins_are_fine_near_grey_and_never_outside_the_histogram() -> None:
    lab = np.random.default_rng(0).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    bins = np.empty(lab.shape[:2], np.int32)
    count_bins(lab, 4, 4, bins)
    light, a, b = lab[..., 0] // 16, *(np.clip((lab[..., c].astype(int) - 128) // 4 + 8, 0, 15) for c in (1, 2))
    np.testing.assert_array_equal(bins, (light.astype(int) * 16 + a) * 16 + b)


@pytest.mark.parametrize(("x0", "y0"), [(3, 2), (-4, -3), (12, 9), (-30, 4), (25, 40)])
def test_the_part_of_a_window_in_the_image_is_where_the_whole_mask_has_it(x0: int, y0: int) -> None:
    depth = np.zeros((9, 11), np.float32)
    cv2.circle(depth, (5, 4), 4, 1.0, -1)
    window = DepthWindow(depth, x0, y0)
    part, place = window.part_in_image(20, 16)
    whole = np.zeros((16, 20), bool)
    whole[place] = part
    np.testing.assert_array_equal(whole, window.mask_in_image(20, 16))
    rows, columns = np.nonzero(depth)
    seen = (rows + y0 >= 0) & (rows + y0 < 16) & (columns + x0 >= 0) & (columns + x0 < 20)
    assert np.argwhere(whole).tolist() == np.column_stack([rows + y0, columns + x0])[seen].tolist()
