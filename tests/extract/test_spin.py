"""The spin about the vessel's own axis: chosen over all frames at once, and turned about the body's axis line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.extract.first_pose import upright_rotation
from vid2demo.extract.geometry import make_pose, rotation_angle_rad, transform_points
from vid2demo.extract.raster import render_depth
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.spin import SPINS, best_turns, mirrored, spun, turn_scores, turned
from vid2demo.extract.vessels import make_vessel

STEP_RAD = 2 * np.pi / SPINS
CAMERA = np.array([[200.0, 0.0, 80.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]])


def table(path: list[int | None]) -> np.ndarray:
    """Scores of frames that each speak for one spin of the pose as it is; None for a frame that says nothing."""
    scores = np.zeros((len(path), 2, SPINS))
    for frame, spin in enumerate(path):
        if spin is not None:
            scores[frame, 0, spin % SPINS] = 1.0
    return scores


def spins(scores: np.ndarray) -> np.ndarray:
    """The spins chosen for an upright object that leans by 40 degrees, so that mirroring it would show."""
    T = np.tile(make_pose(upright_rotation(40.0, 0.0), (0.0, 0.0, 0.5)), (len(scores), 1, 1))
    vectors = Rotation.from_matrix(best_turns(T, scores)).as_rotvec()
    assert vectors[:, :2] == pytest.approx(0.0, abs=1e-9)
    return np.unwrap(vectors[:, 2])


def test_spin_stays_where_it_is_through_frames_that_say_nothing() -> None:
    angles = spins(table([None] * 4 + [10] * 4 + [None] * 6 + [10] * 4 + [None] * 3))
    assert angles == pytest.approx(np.full(21, 10 * STEP_RAD))


def test_a_turn_is_followed_past_a_full_circle_without_a_jump() -> None:
    for direction in (1, -1):
        angles = spins(table([30 + direction * 2 * k for k in range(30)]))
        assert np.diff(angles) == pytest.approx(direction * 2 * STEP_RAD)
        assert abs(angles[-1] - angles[0]) > 2 * np.pi


def test_one_misleading_frame_is_outvoted() -> None:
    scores = table([5] * 9)
    scores[4] = 0.0
    scores[4, 0, 5 + 9] = 1.0
    assert spins(scores) == pytest.approx(np.full(9, 5 * STEP_RAD))


def test_a_lean_that_all_frames_see_mirrored_is_turned_round() -> None:
    T = np.tile(make_pose(upright_rotation(40.0, 30.0), (0.03, -0.02, 0.5)), (6, 1, 1))
    scores = np.zeros((6, 2, SPINS))
    scores[:, 1, 0] = 1.0
    corrected = turned(T, np.arange(6), best_turns(T, scores))
    assert corrected[:, :3, :3] == pytest.approx(np.tile(mirrored(T[0])[:3, :3], (6, 1, 1)))


def test_a_pose_and_its_mirror_image_look_alike_from_afar() -> None:
    mug = make_vessel("mug")
    mesh = tracking_mesh(mug, 3000)
    far = np.array([[6000.0, 0.0, 80.0], [0.0, 6000.0, 60.0], [0.0, 0.0, 1.0]])
    T = make_pose(upright_rotation(25, 60), (0.0, 0.0, 9.0))
    masks = []
    for pose in (T, mirrored(T)):
        window = render_depth(mesh.vertices_m, mesh.faces, pose, far)
        assert window is not None
        masks.append(window.mask_in_image(160, 120))
    assert np.linalg.det(mirrored(T)[:3, :3]) == pytest.approx(1.0)
    assert rotation_angle_rad(mirrored(T)[:3, :3], T[:3, :3]) > np.deg2rad(40)
    assert np.count_nonzero(masks[0] & masks[1]) > 0.97 * np.count_nonzero(masks[0] | masks[1])


def test_turns_are_carried_on_between_the_frames_that_know_them() -> None:
    T = np.tile(make_pose(upright_rotation(20, 0), (0.0, 0.0, 0.5)), (5, 1, 1))
    ends = Rotation.from_rotvec([[0.0, 0.0, 0.2], [0.0, 0.0, 0.6]]).as_matrix()
    relative = np.swapaxes(T[:, :3, :3], 1, 2) @ turned(T, np.array([1, 3]), ends)[:, :3, :3]
    assert Rotation.from_matrix(relative).as_rotvec()[:, 2] == pytest.approx([0.2, 0.2, 0.4, 0.6, 0.6])


def test_spinning_leaves_the_points_of_the_body_axis_where_they_are() -> None:
    axis = (0.031, -0.012)
    T = make_pose(upright_rotation(25, 70, 10), (0.05, -0.02, 0.6))
    on_axis = np.array([[*axis, z] for z in (-0.1, 0.0, 0.07)])
    beside = np.array([[0.1, 0.05, 0.02]])
    there = spun(T, 0.9, axis)
    assert transform_points(there, on_axis) == pytest.approx(transform_points(T, on_axis), abs=1e-12)
    assert rotation_angle_rad(there[:3, :3], T[:3, :3]) == pytest.approx(0.9)
    # What stands beside the line moves along its circle: a chord of 2 r sin(angle / 2).
    radius_m = np.hypot(0.1 - axis[0], 0.05 - axis[1])
    moved_m = np.linalg.norm(transform_points(there, beside) - transform_points(T, beside))
    assert moved_m == pytest.approx(2 * radius_m * np.sin(0.45))
    assert spun(there, -0.9, axis) == pytest.approx(T)


def test_scores_are_highest_at_the_spin_that_is_seen() -> None:
    mug = make_vessel("mug")
    mesh, axis = tracking_mesh(mug, 3000), mug.interior.axis_xy_m
    T = make_pose(upright_rotation(30, 40), (0.0, 0.0, 0.4))
    window = render_depth(mesh.vertices_m, mesh.faces, spun(T, 9 * STEP_RAD, axis), CAMERA)
    assert window is not None
    evidence = np.where(window.mask_in_image(160, 120), 1.0, -1.0).astype(np.float32)
    scores = turn_scores(mesh, T, CAMERA, evidence, axis_xy_m=axis)
    assert abs(int(np.argmax(scores[0])) - 9) <= 1
    assert scores[0].max() > scores[1].max()  # near the camera, perspective tells the mirror image apart


def test_what_is_told_outvotes_frames_that_seem_to_show_a_jump() -> None:
    T = np.tile(make_pose(np.eye(3), (0.0, 0.0, 0.5)), (12, 1, 1))
    scores = np.zeros((12, 2, SPINS))
    scores[:6, 0, 0], scores[6:, 0, 9] = 1.5, 1.0
    for told, jumps in ((False, True), (True, False)):
        turns = best_turns(T, scores, np.full(12, told))
        assert (np.abs(turns[0] - turns[-1]).max() > 0.1) == jumps
