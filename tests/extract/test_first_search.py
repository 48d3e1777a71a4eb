"""The compiled search for a first pose against the slow way to draw, place and compare; and between statures."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.extract.candidates import vessel_model
from vid2demo.extract.first_pose import find_first_pose, silhouette_ious, upright_rotation
from vid2demo.extract.first_search import search_rotations
from vid2demo.extract.geometry import (
    focal_prior_camera_matrix,
    make_pose,
    projected_box,
    rotation_angle_rad,
    super_fibonacci_rotations,
)
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh
from vid2demo.extract.segment import mask_box
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.vessels import make_vessel

WIDTH, HEIGHT = 108, 90
K = focal_prior_camera_matrix(WIDTH, HEIGHT)


def searched(mesh: TrackingMesh, rotations: np.ndarray, box, mask: np.ndarray, trust: np.ndarray):
    centres_m, ious = np.empty((len(rotations), 3)), np.empty((len(rotations), 2))
    search_rotations(
        mesh.vertices_m, mesh.faces, mesh.radius_m, rotations, K, np.array(box, float), mask, trust, centres_m, ious
    )
    return [make_pose(R, t) for R, t in zip(rotations, centres_m, strict=True)], ious


@pytest.mark.parametrize("category", ["mug", "gooseneck_kettle", "carton"])
def test_search_draws_and_compares_as_the_renderer_does(category: str) -> None:
    rng = np.random.default_rng(2)
    mesh, box = tracking_mesh(make_vessel(category), 1200), (20.0, 15.0, 60.0, 55.0)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[18:66, 25:75] = True
    trust = rng.choice(np.array([0.25, 1.0], np.float32), mask.shape)
    poses, ious = searched(mesh, super_fibonacci_rotations(40), box, mask, trust)
    for T, (iou, box_iou) in zip(poses, ious, strict=True):
        slow = silhouette_ious(mesh, T, K, mask, box, trust)
        assert (iou, box_iou) == pytest.approx(slow, abs=1e-5)


def test_every_rotation_is_placed_so_that_it_fills_the_box() -> None:
    mesh, box = tracking_mesh(make_vessel("teapot"), 1200), (30.0, 20.0, 40.0, 44.0)
    empty = np.zeros((HEIGHT, WIDTH), bool)
    poses, ious = searched(mesh, super_fibonacci_rotations(40), box, empty, np.ones(empty.shape, np.float32))
    assert np.all(ious[:, 0] == 0.0)
    for T in poses:
        seen = projected_box(K, T, mesh.vertices_m)
        assert seen is not None
        x, y, w, h = seen
        assert (x + w / 2, y + h / 2) == pytest.approx((50.0, 42.0), abs=0.5)
        assert w * h == pytest.approx(40.0 * 44.0, rel=0.03)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_of_several_statures_the_one_that_is_seen_is_found(which: int) -> None:
    camera = focal_prior_camera_matrix(320, 240)
    models = [vessel_model(make_vessel("pitcher", height_m=height_m)) for height_m in (0.17, 0.22, 0.27)]
    mesh, T = models[which].mesh, make_pose(upright_rotation(22.0, 20.0), (0.02, 0.01, 0.7))
    window = render_depth(mesh.vertices_m, mesh.faces, T, camera)
    assert window is not None
    mask = window.mask_in_image(320, 240)
    rgb = np.where(mask[..., None], np.uint8([170, 60, 50]), np.uint8([90, 120, 150]))
    (best, model), *others = find_first_pose(models, rgb, mask, camera, box_xywh_px=mask_box(mask))
    assert model is models[which]
    assert np.rad2deg(rotation_angle_rad(best.T_camera_object[:3, :3], T[:3, :3])) < 6
    assert all(best.merit >= pose.merit for pose, _ in others)
