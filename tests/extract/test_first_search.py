"""The compiled search for a first pose against the slow way to draw, place and compare; and between statures."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.extract.candidates import vessel_model
from vid2demo.extract.first_pose import find_first_pose, silhouette_ious, upright_rotation
from vid2demo.extract.first_search import place_in_box, silhouettes_agree
from vid2demo.extract.geometry import (
    focal_prior_camera_matrix,
    make_pose,
    projected_box,
    rotation_angle_rad,
    super_fibonacci_rotations,
)
from vid2demo.extract.raster import render_depth
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.vessels import make_vessel

WIDTH, HEIGHT = 108, 90
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
ROTATIONS = super_fibonacci_rotations(70)


@pytest.mark.parametrize("category", ["mug", "gooseneck_kettle", "carton"])
def test_search_draws_and_compares_as_the_renderer_does(category: str) -> None:
    rng = np.random.default_rng(2)
    mesh, box = tracking_mesh(make_vessel(category), 1200), (20.0, 15.0, 60.0, 55.0)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[18:66, 25:75] = True
    trust = rng.choice(np.array([0.25, 1.0], np.float32), mask.shape)
    origins_m = place_in_box(mesh.vertices_m, ROTATIONS, K, box)
    origins_m[:5] += [0.6 * origins_m[0, 2], 0.0, 0.0]  # partly out of the picture, and wholly
    origins_m[5] += [3 * origins_m[5, 2], 0.0, 0.0]
    ious = silhouettes_agree(mesh.vertices_m, mesh.faces, ROTATIONS, origins_m, K, mask, trust, box)
    assert tuple(ious[5]) == (0.0, 0.0)
    assert ious[6:].min() > 0.1
    for R, t, found in zip(ROTATIONS, origins_m, ious, strict=True):
        slow = silhouette_ious(mesh, make_pose(R, t), K, mask, box, trust)
        assert tuple(found) == pytest.approx(slow, abs=1e-5)


def test_every_rotation_is_placed_so_that_it_fills_the_box() -> None:
    mesh = tracking_mesh(make_vessel("teapot"), 1200)
    for R, t in zip(ROTATIONS, place_in_box(mesh.vertices_m, ROTATIONS, K, (30.0, 20.0, 40.0, 44.0)), strict=True):
        seen = projected_box(K, make_pose(R, t), mesh.vertices_m)
        assert seen is not None
        x, y, w, h = seen
        assert (x + w / 2, y + h / 2) == pytest.approx((50.0, 42.0), abs=0.5)
        assert w * h == pytest.approx(40.0 * 44.0, rel=0.03)


def test_a_box_as_large_as_the_camera_sees_keeps_the_mesh_before_it() -> None:
    mesh = tracking_mesh(make_vessel("mug"), 1200)
    origins_m = place_in_box(mesh.vertices_m, ROTATIONS, K, (-500.0, -500.0, 1000.0, 1000.0))
    points = np.einsum("nij,vj->nvi", ROTATIONS, mesh.vertices_m) + origins_m[:, None]
    assert points[..., 2].min() > 0.0


@pytest.mark.parametrize("which", [0, 2])
def test_of_several_statures_the_one_that_is_seen_is_found(which: int) -> None:
    camera = focal_prior_camera_matrix(320, 240)
    models = [vessel_model(make_vessel("pitcher", height_m=height_m)) for height_m in (0.17, 0.22, 0.27)]
    mesh, T = models[which].mesh, make_pose(upright_rotation(22.0, 20.0), (0.02, 0.01, 0.7))
    window = render_depth(mesh.vertices_m, mesh.faces, T, camera)
    assert window is not None
    mask = window.mask_in_image(320, 240)
    rgb = np.where(mask[..., None], np.uint8([170, 60, 50]), np.uint8([90, 120, 150]))
    found = [find_first_pose(model, rgb, mask, camera) for model in models]
    assert int(np.argmax([own[0].merit for own in found])) == which
    assert np.rad2deg(rotation_angle_rad(found[which][0].T_camera_object[:3, :3], T[:3, :3])) < 6
    assert all(np.all(np.diff([pose.merit for pose in own]) <= 0) for own in found)
