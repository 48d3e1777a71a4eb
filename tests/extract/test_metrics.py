from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.compare import compare_tracks, load_truth, matched_frames
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Symmetry, make_pose
from vid2demo.extract.metrics import (
    PROTOCOLS,
    aligned_origins,
    aligned_rotation_rad,
    area_under_recall,
    frame_distances,
    longest_run,
    point_distances,
    pose_errors,
    velocity_errors,
)
from vid2demo.extract.track import ObjectTrack

CAMERA = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
SHARED: dict[str, Any] = {"camera_estimate": CAMERA, "camera_truth": CAMERA, "image_size_px": (640, 480)}
SCALES = {"scale_estimate_m": 0.2, "scale_truth_m": 0.2}
MUSTARD = Path(__file__).parents[2].parent / "shared" / "data"


def wandering(seed: int = 0, count: int = 40) -> np.ndarray:
    """(N, 4, 4) smooth motion half a metre before the camera."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = (turns * Rotation.random(rng=rng)).as_matrix()
    T[:, :3, 3] = np.cumsum(rng.normal(0, 0.005, (count, 3)), axis=0)
    T[:, 2, 3] += 0.6
    return T


def spinning(total_deg: float, count: int) -> np.ndarray:
    """A turn about the viewing axis in equal steps."""
    T = np.tile(make_pose(None, (0.0, 0.0, 0.6)), (count, 1, 1))
    angle = np.deg2rad(np.linspace(0, total_deg, count))
    T[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    return T


@pytest.mark.parametrize("protocol", ["paper", "geodesic"])
@pytest.mark.parametrize("symmetry", [Symmetry(), Symmetry(order=4), Symmetry(order=0)], ids=lambda s: str(s.order))
def test_equal_tracks_have_no_error(protocol: Any, symmetry: Symmetry) -> None:
    T = wandering()
    errors = velocity_errors(T, T, protocol=protocol, symmetry=symmetry, **SHARED, **SCALES)
    np.testing.assert_allclose([errors.e_rot, errors.e_proj, errors.e_depth], 0.0, atol=1e-9)
    pose = pose_errors(T, T, symmetry=symmetry, **SHARED, points_m=np.random.default_rng(0).normal(0, 0.05, (200, 3)))
    np.testing.assert_allclose([pose.rotation_deg, pose.aligned_rotation_deg], 0.0, atol=1e-6)
    assert pose.adds_auc_percent == pytest.approx(100.0)
    assert pose.worst_stretch == 0


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_another_object_frame_changes_no_velocity(protocol: Any) -> None:
    truth, estimate = wandering(0), wandering(1)
    offset = make_pose(Rotation.random(rng=np.random.default_rng(5)).as_matrix(), (0.01, -0.02, 0.015))
    plain = velocity_errors(estimate, truth, protocol=protocol, **SHARED, **SCALES)
    moved = velocity_errors(estimate @ offset, truth, protocol=protocol, **SHARED, **SCALES)
    assert moved.e_rot == pytest.approx(plain.e_rot, rel=1e-9)
    # The whole truth seen in another object frame is a perfect track of the motion.
    same = velocity_errors(truth @ offset, truth, protocol=protocol, **SHARED, **SCALES)
    assert same.e_rot == pytest.approx(0.0, abs=1e-5)
    # The way to the other origin is estimated along rays: nearly right when the origin has moved, exact when not.
    assert same.e_proj < 0.12
    turned = make_pose(offset[:3, :3])
    same = velocity_errors(truth @ turned, truth, protocol=protocol, **SHARED, **SCALES)
    assert same.e_proj == pytest.approx(0.0, abs=1e-9)
    assert np.rad2deg(aligned_rotation_rad(truth @ offset, truth).max()) < 1e-5


def test_turns_on_both_sides_of_half_a_turn_are_two_degrees_apart_not_a_whole_turn() -> None:
    estimate, truth = spinning(179.0, 5)[[0, 0, 4, 4]], spinning(181.0, 5)[[0, 0, 4, 4]]
    paper, official, geodesic = (
        velocity_errors(estimate, truth, protocol=name, **SHARED, **SCALES).e_rot
        for name in ("paper", "official", "geodesic")
    )
    # Gamma of four frames is {1, 2}: pairs (1, 2) of three at distance 1, both pairs at distance 2.
    assert paper == pytest.approx((358 / 3 + 358 / 2) / 2)
    # The official list is 1 eight times over and 2: linspace(1, 2, 10) truncated.
    assert official == pytest.approx((9 * 358 / 3 + 358 / 2) / 10)
    assert geodesic == pytest.approx((2 / 3 + 2 / 2) / 2)


def test_a_hand_computed_case_of_all_three_errors() -> None:
    truth = np.tile(make_pose(None, (0.0, 0.0, 0.6)), (4, 1, 1))
    estimate = truth.copy()
    estimate[:, :3, 3] += np.arange(4)[:, None] * [0.006, 0.0, 0.0]
    # A symmetric walk about the middle: the mean offset of origins vanishes but for the ray's length.
    origin = aligned_origins(estimate, truth, 0.2)
    np.testing.assert_allclose(
        origin - estimate[:, :3, 3], np.tile((truth - estimate)[:, :3, 3].mean(0), (4, 1)), atol=2e-4
    )
    errors = velocity_errors(estimate, truth, **SHARED, **SCALES)
    assert errors.e_rot == pytest.approx(0.0, abs=1e-9)
    # 6 mm a frame at 0.6 m and f = 600 px are 6 px a frame of a diagonal of 800 px.
    assert errors.e_proj == pytest.approx(100 * 6 / 800, rel=1e-3)
    closer = truth.copy()
    closer[:, 2, 3] -= 0.01 * np.arange(4)
    assert velocity_errors(closer, truth, **SHARED, **SCALES).e_depth == pytest.approx(0.01 / 0.2, rel=1e-6)


def test_a_size_of_half_the_truth_is_seen_in_depth_only_through_the_scale() -> None:
    truth = wandering(2)
    small = truth.copy()
    small[:, :3, 3] *= 0.5
    scales = {"scale_estimate_m": 0.1, "scale_truth_m": 0.2}
    errors = velocity_errors(small, truth, **SHARED, **scales)
    np.testing.assert_allclose([errors.e_rot, errors.e_proj, errors.e_depth], 0.0, atol=1e-9)


def test_the_origin_moves_by_half_the_object_at_most() -> None:
    truth = wandering(0)
    far = truth @ make_pose(None, (0.5, 0.0, 0.0))
    moved = np.linalg.norm(aligned_origins(far, truth, 0.2) - far[:, :3, 3], axis=1)
    np.testing.assert_allclose(moved, 0.1)
    near_dropped = np.linalg.norm(aligned_origins(far, truth, 0.2, drop_far=True) - far[:, :3, 3], axis=1)
    np.testing.assert_allclose(near_dropped, 0.0)


@pytest.mark.parametrize("order", [0, 2, 5])
def test_what_symmetry_hides_is_no_error(order: int) -> None:
    symmetry, truth, rng = Symmetry(order=order), wandering(3), np.random.default_rng(0)
    angles = (
        rng.uniform(0, 2 * np.pi, len(truth)) if order == 0 else 2 * np.pi * rng.integers(0, order, len(truth)) / order
    )
    estimate = truth.copy()
    estimate[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    pose = pose_errors(estimate, truth, symmetry=symmetry, **SHARED)
    assert pose.rotation_deg == pytest.approx(0.0, abs=1e-5)
    assert pose.aligned_rotation_deg == pytest.approx(0.0, abs=1e-4)
    errors = velocity_errors(estimate, truth, protocol="geodesic", symmetry=symmetry, **SHARED, **SCALES)
    # A continuous symmetry is sampled in 3.6 degrees.
    assert errors.e_rot < (1e-5 if order else 1.8)
    assert pose_errors(estimate, truth, **SHARED).rotation_deg > 20


def test_aligned_rotation_finds_the_offset_under_noise_and_symmetry() -> None:
    rng = np.random.default_rng(0)
    truth, offset = wandering(4, 200), Rotation.random(rng=np.random.default_rng(1))
    noise = Rotation.from_rotvec(rng.normal(0, np.deg2rad(2.0), (200, 3)))
    for symmetry in (Symmetry(), Symmetry(order=4)):
        estimate = truth.copy()
        group = symmetry.rotations()[rng.integers(0, symmetry.order, 200)]
        estimate[:, :3, :3] = truth[:, :3, :3] @ group @ noise.as_matrix() @ offset.inv().as_matrix()
        angles = np.rad2deg(aligned_rotation_rad(estimate, truth, symmetry))
        assert angles.mean() == pytest.approx(np.rad2deg(noise.magnitude()).mean(), rel=0.05)


def test_add_and_its_area_by_hand() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (3000, 3))
    truth = np.tile(make_pose(None, (0.0, 0.0, 0.6)), (2, 1, 1))
    estimate = truth.copy()
    estimate[1, 0, 3] += 0.04
    add, adds = point_distances(estimate, truth, points)
    np.testing.assert_allclose(add, [0.0, 0.04], atol=1e-12)
    assert adds[0] == pytest.approx(0.0, abs=1e-12)
    assert 0.0 < adds[1] < 0.04
    assert area_under_recall(add) == pytest.approx(100 * (1.0 + 0.6) / 2)
    assert area_under_recall(np.array([0.0, 0.2])) == 50.0
    assert longest_run(np.array([True, False, True, True, False, True])) == 2
    assert longest_run(np.zeros(3, bool)) == 0


def test_frame_distances_are_ten_and_for_short_videos_fewer() -> None:
    assert frame_distances(330) == [1, 19, 37, 56, 74, 92, 110, 129, 147, 165]
    assert frame_distances(12) == [1, 2, 3, 4, 5, 6]
    assert frame_distances(12, official=True) == [1, 1, 2, 2, 3, 3, 4, 4, 5, 6]


def track(T: np.ndarray, time_s: np.ndarray, **mesh: Any) -> ObjectTrack:
    header = {"image_size_px": [640, 480], "mesh": {"extents_m": [0.05, 0.05, 0.2], **mesh}}
    return ObjectTrack(T, time_s, CAMERA, np.ones(len(T)), np.ones(len(T), bool), header)


def test_files_are_matched_by_frame_or_by_time_and_reported_in_json(tmp_path: Path) -> None:
    T, time_s = wandering(0, 60), np.arange(60) / 30
    np.savez(tmp_path / "truth.npz", T_camera_object=T, camera_matrix=CAMERA, time_s=time_s)
    truth = load_truth(tmp_path / "truth.npz")
    every_other = track(T[::2], time_s[::2] + 0.004)
    comparison = compare_tracks(every_other, truth)
    assert comparison.frames == 30
    assert comparison.pose.aligned_rotation_deg == pytest.approx(0.0, abs=1e-6)
    json.dumps(comparison.to_json())
    assert "geodesic" in comparison.table()
    # As many frames are the same frames, whatever rate a file claims.
    assert compare_tracks(track(T, time_s * 2.0), truth).frames == 60
    saved = tmp_path / "a.track.npz"
    every_other.save(saved)
    assert load_truth(saved).extent_m == 0.2
    with pytest.raises(UserError, match="no frame of the estimate"):
        matched_frames(np.arange(5) + 100.0, time_s)


def test_add_is_left_out_when_the_meshes_differ() -> None:
    T, time_s = wandering(), np.arange(40) / 30
    model = trimesh.creation.box((0.05, 0.05, 0.2))
    plain = load_truth_from(T, time_s)
    assert compare_tracks(track(T, time_s), plain, model=model).pose.add_m == pytest.approx(0.0)
    library = track(T, time_s, library={"category": "bottle", "params": {}})
    assert compare_tracks(library, plain, model=model).pose.add_m is None


def load_truth_from(T: np.ndarray, time_s: np.ndarray) -> Any:
    from vid2demo.extract.compare import Truth

    return Truth(T, CAMERA, time_s)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"T_camera_object": np.eye(4)[None]}, "lacks camera_matrix, time_s"),
        ({"T_camera_object": np.eye(4)[None], "camera_matrix": CAMERA, "time_s": np.arange(3.0)}, "do not fit"),
        ({"T_camera_object": np.full((1, 4, 4), np.nan), "camera_matrix": CAMERA, "time_s": np.zeros(1)}, "not finite"),
    ],
)
def test_truths_that_make_no_sense_are_refused(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "truth.npz", **content)
    with pytest.raises(UserError, match=message):
        load_truth(tmp_path / "truth.npz")
    with pytest.raises(UserError, match="does not exist"):
        load_truth(tmp_path / "nowhere.npz")
    (tmp_path / "text.npz").write_text("no")
    with pytest.raises(UserError, match="no npz; give a track") as refused:
        load_truth(tmp_path / "text.npz")
    assert "pickle" not in str(refused.value)


@pytest.mark.skipif(not (MUSTARD / "tracking").is_dir(), reason="needs ../shared/data/tracking")
def test_a_track_that_never_moves_scores_on_a_real_recording_what_others_found() -> None:
    truth = load_truth(MUSTARD / "tracking" / "mustard_a" / "truth.npz")
    still = track(np.repeat(truth.T_camera_object[:1], len(truth.time_s), 0), truth.time_s)
    found = compare_tracks(still, truth, model=trimesh.load(MUSTARD / "meshes" / "mustard_bottle.obj", force="mesh"))
    assert found.pose.aligned_rotation_deg == pytest.approx(13.0, abs=0.1)
    assert found.velocity["paper"].e_proj == pytest.approx(0.061, abs=0.001)
    assert found.pose.adds_auc_percent == pytest.approx(2.2, abs=0.5)
