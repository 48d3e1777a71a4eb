"""Geometry against exact oracles."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import (
    Symmetry,
    extent,
    focal_prior_camera_matrix,
    invert_pose,
    look_at,
    make_pose,
    project,
    rotation_angle_rad,
    scaled_camera,
    super_fibonacci_rotations,
    transform_points,
    unproject,
)

angles = st.floats(-np.pi, np.pi)


@given(angles, angles, angles)
def test_rotation_angle_is_the_geodesic_one(x: float, y: float, z: float) -> None:
    R = Rotation.from_euler("xyz", [x, y, z])
    assert rotation_angle_rad(np.eye(3), R.as_matrix()) == pytest.approx(R.magnitude(), abs=1e-6)


def test_tiny_angles_keep_their_accuracy() -> None:
    R = Rotation.from_rotvec([0, 0, 1e-9]).as_matrix()
    assert rotation_angle_rad(np.eye(3), R) == pytest.approx(1e-9, rel=1e-3)


@given(angles, angles, angles, angles)
def test_spin_about_a_continuous_axis_is_no_error(x: float, y: float, z: float, spin: float) -> None:
    R = Rotation.from_euler("xyz", [x, y, z]).as_matrix()
    spun = R @ Rotation.from_rotvec([0, 0, spin]).as_matrix()
    assert Symmetry(order=0).error_rad(R, spun) == pytest.approx(0.0, abs=1e-7)


def test_discrete_symmetry_takes_the_nearest_of_its_turns() -> None:
    R = Rotation.from_rotvec([0, 0, np.deg2rad(100)]).as_matrix()
    assert Symmetry(order=4).error_rad(np.eye(3), R) == pytest.approx(np.deg2rad(10))
    assert Symmetry(order=1).error_rad(np.eye(3), R) == pytest.approx(np.deg2rad(100))


def test_continuous_error_is_the_limit_of_many_turns() -> None:
    rng = np.random.default_rng(0)
    Ra, Rb = Rotation.random(2, rng=rng).as_matrix()
    assert Symmetry(order=0).error_rad(Ra, Rb) == pytest.approx(Symmetry(order=2000).error_rad(Ra, Rb), abs=2e-3)


@pytest.mark.parametrize("bad", [{"order": -1}, {"axis": (0.0, 0.0, 2.0)}])
def test_impossible_symmetries_are_refused(bad: dict) -> None:
    with pytest.raises(ValueError, match="symmetry"):
        Symmetry(**bad)


def test_inverse_and_points() -> None:
    rng = np.random.default_rng(1)
    T = make_pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    points = rng.normal(size=(5, 3))
    assert transform_points(invert_pose(T), transform_points(T, points)) == pytest.approx(points)
    assert invert_pose(np.stack([T, T]))[1] == pytest.approx(np.linalg.inv(T))


def test_look_at_puts_the_target_on_the_optical_axis_with_up_upward() -> None:
    T = look_at(np.array([1.0, 2.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    K = focal_prior_camera_matrix(640, 480)
    target, above = project(K, transform_points(invert_pose(T), np.array([[0.0, 0, 0], [0, 0, 0.1]])))
    assert target == pytest.approx([320, 240])
    assert above[1] < target[1]
    assert above[0] == pytest.approx(target[0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_super_fibonacci_covers_rotations_evenly() -> None:
    # Known figures for 600 rotations: nearest neighbours 25.5 degrees apart, no rotation farther than 24 from one.
    grid = super_fibonacci_rotations(600)
    random = Rotation.random(300, rng=np.random.default_rng(0)).as_matrix()
    cosine = (np.einsum("aij,bij->ab", random, grid).max(axis=1) - 1) / 2
    nearest_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    assert nearest_deg.mean() == pytest.approx(14.1, abs=0.7)
    assert nearest_deg.max() < 25


@pytest.mark.parametrize("scale", [0.25, 0.5, 2.0])
def test_a_point_is_seen_where_a_picture_made_smaller_or_larger_shows_it(scale: float) -> None:
    camera = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
    point = np.array([[0.11, -0.07, 0.5]])
    y, x = np.mgrid[0:120, 0:160]
    (u, v) = project(camera, point)[0]
    spot = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(spot, None, fx=scale, fy=scale, interpolation=how)
    rows, columns = np.indices(resized.shape)
    centre = np.array([(columns * resized).sum(), (rows * resized).sum()]) / resized.sum()
    np.testing.assert_allclose(project(scaled_camera(camera, scale), point)[0], centre, atol=0.03)


def test_the_extent_of_points_is_the_box_around_them() -> None:
    points = np.random.default_rng(2).normal(size=(40, 3))
    low, high = extent(points)
    assert np.array_equal(low, points.min(axis=0))
    assert np.array_equal(high, points.max(axis=0))


def test_a_pixel_at_a_depth_is_the_point_that_projects_there() -> None:
    camera = np.array([[500.0, 0.0, 310.0], [0.0, 520.0, 250.0], [0.0, 0.0, 1.0]])
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.4], [0.3, 0.2, 2.0], (20, 3))
    np.testing.assert_allclose(unproject(camera, project(camera, points), points[:, 2]), points, atol=1e-12)
