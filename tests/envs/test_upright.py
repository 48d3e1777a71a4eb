"""Which way is up, how fast, and what a track's relative poses become."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.placement import build_reference
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array, focal_prior_camera_matrix, invert_pose, look_at, make_pose
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import Vessel, make_vessel

FRAMES, FPS = 150, 25.0
UP = np.array([0.0, 0.0, 1.0])
EYE = look_at(np.array([0.1, -0.75, 0.4]), np.array([0.1, 0.0, 0.15]), UP)
HEAD_DOWN = EYE @ make_pose(np.diag([-1.0, -1.0, 1.0]))


def seen(vessel: Vessel, T_table_object: Array, T_table_camera: Array, name: str) -> ObjectTrack:
    n = len(T_table_object)
    mesh = {"name": name, "symmetry": vessel.symmetry.to_json(), **vessel_to_header(vessel)}
    header = {"object": name, "mesh": mesh}
    K = focal_prior_camera_matrix(1280, 720)
    T = invert_pose(T_table_camera) @ T_table_object
    return ObjectTrack(T, np.arange(n) / FPS, K, np.ones(n), np.ones(n, bool), header)


def tracks(T_table_camera: Array = EYE, lean_deg: float = 0.0) -> tuple[ObjectTrack, ObjectTrack]:
    """A kettle that is lifted, carried and tilted, and the mug beside it."""
    kettle, mug = make_vessel("gooseneck_kettle"), make_vessel("mug")
    phase = np.arange(FRAMES) / FRAMES
    move, tilt = minimum_jerk((phase - 0.15) / 0.35), minimum_jerk((phase - 0.35) / 0.4)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    angle = np.deg2rad(lean_deg) + np.deg2rad(60.0 - lean_deg) * tilt
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0.0, 1.0, 0.0])).as_matrix()
    T[:, 0, 3], T[:, 2, 3] = 0.2 * move, 0.5 * kettle.extents_m[2] + 0.2 * move
    stand = np.tile(make_pose(None, (0.44, 0.05, 0.5 * mug.extents_m[2])), (FRAMES, 1, 1))
    return seen(kettle, T, T_table_camera, "kettle"), seen(mug, stand, T_table_camera, "mug")


@pytest.fixture(scope="module")
def plain() -> Reference:
    return build_reference(*tracks())


def relative(T: Array) -> Array:
    return np.asarray(invert_pose(T[0]) @ T)


def test_an_upside_down_camera_gives_the_same_motion_where_the_receptacle_tells(plain: Reference) -> None:
    turned = build_reference(*tracks(HEAD_DOWN))
    np.testing.assert_allclose(relative(turned.T_world_object), relative(plain.T_world_object), atol=1e-6)
    assert turned.T_world_object[0, 2, 2] == pytest.approx(1.0, abs=1e-6)
    assert any("upside down" in note for note in turned.notes)


def test_an_upside_down_vessel_alone_is_refused_with_both_reasons() -> None:
    with pytest.raises(UserError, match="turn the video by 180 degrees; if not, the tracker took top for bottom"):
        build_reference(tracks(HEAD_DOWN)[0])
    # The camera stands, so it was the tracker.
    with pytest.raises(UserError, match="stands on its head"):
        build_reference(tracks(HEAD_DOWN)[0], tracks()[1])


def test_a_receptacle_tells_what_is_upright_when_the_vessel_leans() -> None:
    reference = build_reference(*tracks(lean_deg=50.0))
    assert np.rad2deg(reference.tilt_rad[0]) == pytest.approx(50.0, abs=0.1)
    assert any("the receptacle stands upright" in note for note in reference.notes)


@pytest.mark.parametrize("speed", [0.8])
def test_speed_changes_the_clock_and_nothing_of_the_path(plain: Reference, speed: float) -> None:
    played = build_reference(*tracks(), speed=speed)
    assert played.duration_s == pytest.approx(plain.duration_s / speed, abs=0.05)
    assert played.header["time_stretch"] == pytest.approx(1.0 / speed, rel=0.01)
    # The same video moments show the same poses.
    at = [int(np.abs(played.video_time_s - t).argmin()) for t in plain.video_time_s[20:-20:10]]
    there = relative(played.T_world_object)[at, :3, 3]
    np.testing.assert_allclose(there, relative(plain.T_world_object)[20:-20:10, :3, 3], atol=0.01)
    assert any("as asked" in note for note in played.notes)


def test_more_speed_than_the_arm_has_is_given_back() -> None:
    hurried = build_reference(*tracks(), speed=5.0)
    assert hurried.header["time_stretch"] > 1.3 / 5.0
    assert any("was slowed down by a factor" in note for note in hurried.notes)


@pytest.mark.parametrize("speed", [0.0, -1.0, 9.0, float("nan")])
def test_a_speed_that_makes_no_sense_is_named(speed: float) -> None:
    with pytest.raises(UserError, match="the speed is"):
        build_reference(*tracks(), speed=speed)


@pytest.mark.parametrize("scale", [0.6])
def test_scaling_commutes_with_the_relative_pose(plain: Reference, scale: float) -> None:
    """T(0)^-1 T(t) of the scaled motion is that of the motion with its translation scaled, wherever it is placed."""
    scaled = relative(build_reference(*tracks(), scale=scale).T_world_object)
    whole = relative(plain.T_world_object)
    np.testing.assert_allclose(scaled[:, :3, :3], whole[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(scaled[:, :3, 3], scale * whole[:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("factor", [0.5, 1.7, 3.0])
def test_time_stretching_commutes_with_the_relative_pose(plain: Reference, factor: float) -> None:
    first = Reference.from_poses(relative(plain.T_world_object), plain.time_s, {}).stretched(factor)
    then = plain.stretched(factor)
    np.testing.assert_allclose(first.T_world_object, relative(then.T_world_object), atol=1e-9)
    np.testing.assert_array_equal(first.time_s, then.time_s)


@pytest.mark.parametrize("fault", ["nan", "infinite", "metres"])
def test_broken_numbers_are_one_clear_error(tmp_path: Path, fault: str) -> None:
    track, mug = tracks()
    T = track.T_camera_object.copy()
    if fault == "metres":
        T[:, :3, 3] *= 300.0 / np.ptp(T[:, :3, 3], axis=0).max()
        with pytest.raises(UserError, match=r"moves over .* m, which no arm can follow"):
            build_reference(dataclasses.replace(track, T_camera_object=T), mug)
        return
    track.save(tmp_path / "kettle.track.npz")
    with np.load(tmp_path / "kettle.track.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays["T_camera_object"][7, 0, 3] = np.nan if fault == "nan" else np.inf
    np.savez(tmp_path / "kettle.track.npz", **arrays)
    told = r"kettle\.track\.npz is not a valid track: .* not finite \(first in frame 7, 1 in all\); write such frames"
    with pytest.raises(UserError, match=told):
        ObjectTrack.load(tmp_path / "kettle.track.npz")
