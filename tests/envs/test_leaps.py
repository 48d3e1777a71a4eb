"""A tracker's leap that does not come back is taken out: the motion on both sides of it stays what it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.leaps import without_leaps
from vid2demo.envs.reference import minimum_jerk
from vid2demo.envs.resampling import resample_track
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array, make_pose
from vid2demo.extract.track import ObjectTrack

HZ, COUNT = 30.0, 120
TIME_S = np.arange(COUNT) / HZ


def motion(speed: float = 1.0) -> Array:
    """(N, 4, 4) a pour: moved over 30 cm and turned by 80 degrees, in a camera's frame."""
    phase = minimum_jerk(speed * TIME_S / TIME_S[-1])[:, None]
    T = np.tile(make_pose(Rotation.from_euler("xyz", [2.0, 0.3, -0.2]).as_matrix(), (0.1, 0.05, 0.9)), (COUNT, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(phase * np.array([[0.3, -0.2, 1.35]])).as_matrix() @ T[:, :3, :3]
    T[:, :3, 3] += phase * np.array([[0.25, -0.15, 0.1]])
    return np.asarray(T)


def leapt(T: Array, part: slice, shift_m: tuple[float, float, float], turn_rad: tuple[float, float, float]) -> Array:
    """The object seen turned about its own axes and shifted in the camera's for a part of the time."""
    out = T.copy()
    out[part, :3, :3] = out[part, :3, :3] @ Rotation.from_rotvec(turn_rad).as_matrix()
    out[part, :3, 3] += shift_m
    return out


def track_of(T: Array) -> ObjectTrack:
    return ObjectTrack(T, TIME_S, np.diag([500.0, 500.0, 1.0]), np.ones(COUNT), np.ones(COUNT, bool), {"object": "mug"})


LEAPS = [
    ((0.12, 0.0, 0.05), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (0.0, 0.0, np.pi)),
    ((0.0, 0.07, -0.2), (0.4, 0.5, 1.0)),
    ((3.0, 0.0, 0.0), (0.0, 2.0, 0.0)),
]


@pytest.mark.parametrize(("shift_m", "turn_rad"), LEAPS)
@pytest.mark.parametrize("at", [20, 55, 95])
def test_what_follows_a_leap_goes_on_from_where_the_motion_was(
    shift_m: tuple[float, float, float], turn_rad: tuple[float, float, float], at: int
) -> None:
    truth = motion()
    confidence = np.where(np.arange(COUNT) < at, 1.0, 0.3 * at / COUNT)
    found, keep, (leap,) = without_leaps(leapt(truth, slice(at, None), shift_m, turn_rad), TIME_S, confidence)
    assert keep.all()
    np.testing.assert_allclose(found, truth, atol=1.5e-3)
    assert leap.time_s == TIME_S[at]
    assert leap.distance_m == pytest.approx(np.linalg.norm(shift_m), abs=1e-3)
    assert leap.angle_rad == pytest.approx(np.linalg.norm(turn_rad), abs=5e-3)
    assert leap.moved == "after"


def test_the_side_that_the_tracker_was_less_sure_of_is_moved() -> None:
    """Lost at first, found later: the poses that it found stay."""
    truth, at = motion(), 50
    confidence = np.where(np.arange(COUNT) < at, 0.3, 0.9)
    found, _, (leap,) = without_leaps(leapt(truth, slice(0, at), *LEAPS[2]), TIME_S, confidence)
    np.testing.assert_allclose(found, truth, atol=1.5e-3)
    assert leap.moved == "before"


def test_several_leaps_are_all_taken_out_and_steps_stay_as_tracked() -> None:
    truth = motion()
    seen = leapt(
        leapt(leapt(truth, slice(30, None), *LEAPS[0]), slice(60, None), *LEAPS[1]), slice(90, None), *LEAPS[2]
    )
    found, keep, leaps = without_leaps(seen, TIME_S, np.ones(COUNT))
    assert keep.all()
    assert [leap.time_s for leap in leaps] == [TIME_S[k] for k in (30, 60, 90)]
    np.testing.assert_allclose(np.diff(found[:, :3, 3], axis=0), np.diff(truth[:, :3, 3], axis=0), atol=1e-3)
    steps, true_steps = (R[1:, :3, :3] @ np.swapaxes(R[:-1, :3, :3], 1, 2) for R in (found, truth))
    np.testing.assert_allclose(steps, true_steps, atol=2e-3)


def test_an_excursion_is_left_out_and_moves_nothing() -> None:
    truth = motion()
    found, keep, leaps = without_leaps(leapt(truth, slice(40, 44), *LEAPS[2]), TIME_S, np.ones(COUNT))
    assert np.flatnonzero(~keep).tolist() == [40, 41, 42, 43]
    assert leaps == []
    np.testing.assert_array_equal(found[keep], truth[keep])


def test_haste_and_tremble_are_no_leaps() -> None:
    rng = np.random.default_rng(0)
    hasty = motion(speed=6.0)  # 30 cm and 80 degrees within 0.7 s
    trembling = motion()
    trembling[:, :3, 3] += rng.normal(0.0, 0.015, (COUNT, 3))
    for T in (hasty, trembling):
        found, keep, leaps = without_leaps(T, TIME_S, np.ones(COUNT))
        assert keep.all()
        assert leaps == []
        np.testing.assert_array_equal(found, T)


def test_a_leap_is_told_with_time_and_size() -> None:
    cleaned = resample_track(track_of(leapt(motion(), slice(70, None), *LEAPS[0])), 25.0)
    (leap,) = cleaned.leaps
    assert leap.distance_m == pytest.approx(0.13, abs=1e-3)
    (note,) = (note for note in cleaned.notes if "does not come back" in note)
    assert "At 2.33 s the track leaps by 0.13 m and 0 degrees" in note
    assert "bridged" in note
    step_m = np.linalg.norm(np.diff(cleaned.T_camera_object[:, :3, 3], axis=0), axis=1)
    assert step_m.max() < 0.01


def test_a_track_of_nothing_but_leaps_is_refused() -> None:
    T = motion()
    T[:, :3, 3] += np.random.default_rng(0).normal(0.0, 0.4, (COUNT, 3))
    with pytest.raises(UserError, match=r"leaps to and fro in \d+ of its 120 frames"):
        resample_track(track_of(T), 25.0)


def test_nan_and_gaps_do_not_reach_here() -> None:
    """Frames in which the object is not seen may hold anything; they are neither leaps nor poses."""
    T, track = motion(), track_of(motion())
    visible = track.visible.copy()
    visible[50:60] = False
    T[50:60, :3, 3] = 5.0
    cleaned = resample_track(replace(track, T_camera_object=T, visible=visible), 25.0)
    assert cleaned.leaps == []
    assert any("10 frames were bridged" in note for note in cleaned.notes)
