"""The spin about the vessel's own axis: chosen over all frames at once, and turned about the body's axis line."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.extract.first_pose import upright_rotation
from vid2demo.extract.geometry import make_pose, rotation_angle_rad, transform_points
from vid2demo.extract.raster import render_depth
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.spin import SPINS, best_spins, spin_scores, spun
from vid2demo.extract.vessels import make_vessel

STEP_RAD = 2 * np.pi / SPINS


def table(path: list[int | None]) -> np.ndarray:
    """Scores of frames that each speak for one spin; None for a frame that says nothing."""
    scores = np.zeros((len(path), SPINS))
    for frame, spin in enumerate(path):
        if spin is not None:
            scores[frame, spin % SPINS] = 1.0
    return scores


def test_spin_stays_where_it_is_through_frames_that_say_nothing() -> None:
    angles = best_spins(table([None] * 4 + [10] * 4 + [None] * 6 + [10] * 4 + [None] * 3))
    assert angles == pytest.approx(np.full(21, 10 * STEP_RAD))


def test_a_turn_is_followed_past_a_full_circle_without_a_jump() -> None:
    for direction in (1, -1):
        angles = best_spins(table([40 + direction * 2 * k for k in range(40)]))
        assert np.diff(angles) == pytest.approx(direction * 2 * STEP_RAD)
        assert abs(angles[-1] - angles[0]) > 2 * np.pi


def test_one_misleading_frame_is_outvoted() -> None:
    scores = table([20] * 9)
    scores[4] = 0.0
    scores[4, 20 + 12] = 1.0
    assert best_spins(scores) == pytest.approx(np.full(9, 20 * STEP_RAD))


def test_spinning_leaves_the_points_of_the_body_axis_where_they_are() -> None:
    axis = (0.031, -0.012)
    T = make_pose(upright_rotation(25, 70, 10), (0.05, -0.02, 0.6))
    on_axis = np.array([[*axis, z] for z in (-0.1, 0.0, 0.07)])
    beside = np.array([[0.1, 0.05, 0.02]])
    turned = spun(T, 0.9, axis)
    assert transform_points(turned, on_axis) == pytest.approx(transform_points(T, on_axis), abs=1e-12)
    assert rotation_angle_rad(turned[:3, :3], T[:3, :3]) == pytest.approx(0.9)
    # What stands beside the line moves along its circle: a chord of 2 r sin(angle / 2).
    radius_m = np.hypot(0.1 - axis[0], 0.05 - axis[1])
    moved_m = np.linalg.norm(transform_points(turned, beside) - transform_points(T, beside))
    assert moved_m == pytest.approx(2 * radius_m * np.sin(0.45))
    assert spun(turned, -0.9, axis) == pytest.approx(T)


def test_scores_are_highest_at_the_spin_that_is_seen() -> None:
    mug = make_vessel("mug")
    mesh, axis = tracking_mesh(mug, 3000), mug.interior.axis_xy_m
    camera = np.array([[200.0, 0.0, 80.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]])
    T = make_pose(upright_rotation(30, 40), (0.0, 0.0, 0.4))
    window = render_depth(mesh.vertices_m, mesh.faces, spun(T, 9 * STEP_RAD, axis), camera)
    assert window is not None
    evidence = np.where(window.mask_in_image(160, 120), 1.0, -1.0).astype(np.float32)
    assert abs(int(np.argmax(spin_scores(mesh, T, camera, evidence, axis))) - 9) <= 1
