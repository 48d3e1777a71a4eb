"""Smoothing takes its width from the poses: wide over noise, narrow over quick motion, never late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import make_pose, rotation_angle_rad
from vid2demo.extract.smoothing import best_bandwidth_s, smooth_poses
from vid2demo.extract.track import ObjectTrack

TIME_S = np.arange(90) / 30
SURE = np.ones(len(TIME_S))


def swinging(rate_hz: float) -> np.ndarray:
    """A pose that swings by 0.4 rad and 5 cm."""
    phase = 2 * np.pi * rate_hz * TIME_S
    turns = Rotation.from_rotvec(0.4 * np.sin(phase)[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
    places = np.stack([0.05 * np.cos(phase), 0 * phase, 0.6 + 0 * phase], axis=1)
    return np.stack([make_pose(R, t) for R, t in zip(turns, places, strict=True)])


def noisy(T: np.ndarray, rad: float, m: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = T.copy()
    out[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, rad, (len(T), 3))).as_matrix()
    out[:, :3, 3] += rng.normal(0, m, (len(T), 3))
    return out


def errors(T: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    turn = rotation_angle_rad(T[:, :3, :3], exact[:, :3, :3])
    return float(turn.mean()), float(np.linalg.norm(T[:, :3, 3] - exact[:, :3, 3], axis=1).mean())


def test_noise_asks_for_a_wide_window_and_quick_motion_for_a_narrow_one() -> None:
    still = best_bandwidth_s(noisy(swinging(0.05), 0.01, 0.002), TIME_S, SURE)
    quick = best_bandwidth_s(noisy(swinging(3.0), 0.002, 0.0004), TIME_S, SURE)
    assert min(still) > 3 * max(quick)


def test_the_chosen_width_halves_the_noise_of_slow_motion() -> None:
    exact = swinging(0.3)
    shaky = noisy(exact, 0.01, 0.002)
    before, after = errors(shaky, exact), errors(smooth_poses(shaky, TIME_S, SURE), exact)
    assert after[0] < 0.6 * before[0]
    assert after[1] < 0.6 * before[1]


def test_quick_motion_without_noise_is_neither_late_nor_flattened() -> None:
    exact = swinging(2.0)
    turn_rad, place_m = errors(smooth_poses(exact, TIME_S, SURE), exact)
    assert turn_rad < 0.01
    assert place_m < 0.002


def test_frames_in_which_the_object_was_lost_do_not_decide_the_width() -> None:
    exact = swinging(0.3)
    lost = noisy(exact, 0.01, 0.002)
    weight = SURE.copy()
    lost[40:44, :3, 3] += 1.0
    weight[40:44] = 0.0
    turn_rad, place_m = errors(smooth_poses(lost, TIME_S, weight), exact)
    assert turn_rad < 0.01
    assert place_m < 0.004


def test_three_frames_are_left_as_they_are() -> None:
    few = noisy(swinging(0.3), 0.01, 0.002)[:3]
    assert np.array_equal(smooth_poses(few, TIME_S[:3], SURE[:3]), few)


def test_a_track_keeps_its_poses_from_before_smoothing_and_may_lack_them(tmp_path: Path) -> None:
    raw = noisy(swinging(0.3), 0.01, 0.002)
    smooth = smooth_poses(raw, TIME_S, SURE)
    for kept in (raw, None):
        track = ObjectTrack(smooth, TIME_S, np.eye(3), SURE, SURE > 0, T_camera_object_raw=kept)
        track.save(tmp_path / "a.track.npz")
        again = ObjectTrack.load(tmp_path / "a.track.npz").T_camera_object_raw
        assert again is None if kept is None else np.array_equal(again, kept)
