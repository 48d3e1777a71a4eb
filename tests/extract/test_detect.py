"""Where an object is looked for when nobody says where."""

from __future__ import annotations

import cv2
import numpy as np
from vid2demo.extract.detect import find_places
from vid2demo.extract.first_pose import upright_rotation
from vid2demo.extract.geometry import focal_prior_camera_matrix, make_pose
from vid2demo.extract.raster import render_depth
from vid2demo.extract.segment import Box, box_iou, mask_box
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.vessels import make_vessel

WIDTH, HEIGHT = 320, 240
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
MUG = tracking_mesh(make_vessel("mug"))


def scene(*mugs_xyz_m: tuple[float, float, float]) -> tuple[np.ndarray, list[Box]]:
    """A picture of dark mugs before a light wall, and their boxes."""
    rng = np.random.default_rng(0)
    rgb = rng.normal((190, 185, 175), 3, (HEIGHT, WIDTH, 3))
    boxes = []
    for place in mugs_xyz_m:
        window = render_depth(MUG.vertices_m, MUG.faces, make_pose(upright_rotation(18.0, 30.0), place), K)
        assert window is not None
        mask = window.mask_in_image(WIDTH, HEIGHT)
        rgb[mask] = rng.normal((60, 70, 110), 3, (int(mask.sum()), 3))
        boxes.append(mask_box(mask))
    return np.asarray(cv2.GaussianBlur(np.clip(rgb, 0, 255).astype(np.uint8), (0, 0), 0.7), np.uint8), boxes


def test_two_alike_are_two_places() -> None:
    rgb, boxes = scene((-0.09, 0.0, 0.5), (0.1, 0.02, 0.5))
    still = np.zeros(rgb.shape[:2])
    places = find_places(rgb, still, [MUG], K, handled=False)
    assert all(max(box_iou(place, box) for place in places) > 0.6 for box in boxes)
    apart = [box_iou(a, b) for k, a in enumerate(places) for b in places[:k]]
    assert max(apart) < 0.8


def test_of_two_alike_the_one_that_moved_is_handled() -> None:
    rgb, boxes = scene((-0.09, 0.0, 0.5), (0.1, 0.02, 0.5))
    x, y, _, h = (round(v) for v in boxes[1])
    moved = np.zeros(rgb.shape[:2])
    moved[y : y + h, x:] = 1.0  # and an arm that comes in from the right
    places = find_places(rgb, moved, [MUG], K, handled=True)
    assert box_iou(places[0], boxes[1]) > 0.5
    assert all(box_iou(place, boxes[0]) == 0 for place in places)


def test_nothing_is_found_on_an_empty_wall() -> None:
    rgb, _ = scene()
    assert find_places(rgb, np.zeros(rgb.shape[:2]), [MUG], K, handled=False) == []
