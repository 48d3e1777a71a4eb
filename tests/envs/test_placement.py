from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.builtin import arm_trajectory
from vid2demo.envs.clearance import overlaps_m
from vid2demo.envs.collision import CollisionChecker
from vid2demo.envs.jet import filling_m3, jet_of
from vid2demo.envs.kinematics import limit_margin_rad, panda_chain
from vid2demo.envs.placement import build_reference, camera_elevation_deg, camera_rotation, without_spin
from vid2demo.envs.receptacle import mouth_radius_m, mouth_xy_m, surface_points
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.envs.resampling import resample_track
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import (
    Array,
    angle_between_rad,
    focal_prior_camera_matrix,
    invert_pose,
    look_at,
    make_pose,
)
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import Vessel, make_vessel

KETTLE = make_vessel("gooseneck_kettle")
RECEPTACLE_XY_M = (0.44, 0.05)


def camera_pose(elevation_deg: float) -> Array:
    e = np.deg2rad(elevation_deg)
    eye = np.array([0.1, -0.8 * np.cos(e), 0.15 + 0.8 * np.sin(e)])
    return look_at(eye, np.array([0.1, 0.0, 0.15]), np.array([0.0, 0.0, 1.0]))


def track_of(vessel: Vessel, T_table_object: Array, time_s: Array, elevation_deg: float, name: str) -> ObjectTrack:
    mesh = {
        "name": vessel.category,
        "extents_m": list(vessel.extents_m),
        "symmetry": vessel.symmetry.to_json(),
        **vessel_to_header(vessel),
    }
    n = len(time_s)
    T = invert_pose(camera_pose(elevation_deg)) @ T_table_object
    K = focal_prior_camera_matrix(1280, 720)
    return ObjectTrack(T, time_s, K, np.ones(n), np.ones(n, bool), {"object": name, "mesh": mesh})


def pour_track(
    vessel: Vessel = KETTLE,
    *,
    tilt_deg: float = 60.0,
    lift_m: float = 0.2,
    side_m: float = 0.2,
    fps: float = 25.0,
    duration_s: float = 6.0,
    elevation_deg: float = 20.0,
) -> ObjectTrack:
    """The vessel stands, is lifted and moved along +x, is tilted toward +x and stays so: every pose known."""
    time_s = np.arange(round(duration_s * fps)) / fps
    move = minimum_jerk((time_s - 0.15 * duration_s) / (0.35 * duration_s))
    tilt = np.deg2rad(tilt_deg) * minimum_jerk((time_s - 0.35 * duration_s) / (0.4 * duration_s))
    T = np.tile(np.eye(4), (len(time_s), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(tilt, [0.0, 1.0, 0.0])).as_matrix()
    T[:, 0, 3], T[:, 2, 3] = side_m * move, 0.5 * vessel.extents_m[2] + lift_m * move
    return track_of(vessel, T, time_s, elevation_deg, "kettle")


def mug_track(track: ObjectTrack, xy_m: Sequence[float] = RECEPTACLE_XY_M, elevation_deg: float = 20.0) -> ObjectTrack:
    """A mug that stands on the same table."""
    mug = make_vessel("mug")
    T = np.tile(make_pose(None, (xy_m[0], xy_m[1], 0.5 * mug.extents_m[2])), (len(track), 1, 1))
    return track_of(mug, T, track.time_s, elevation_deg, "mug")


def changed(track: ObjectTrack, **changes: Any) -> ObjectTrack:
    return dataclasses.replace(track, **changes)


@pytest.fixture(scope="module")
def placed() -> tuple[ObjectTrack, Reference]:
    track = pour_track()
    return track, build_reference(track, mug_track(track))


def test_the_motion_is_the_track_s_own(placed: tuple[ObjectTrack, Reference]) -> None:
    """T_WO(0)^-1 T_WO(t) = T_CO(0)^-1 T_CO(t): at the track's frame rate nothing but the holds is added."""
    track, reference = placed
    assert reference.scale == 1.0
    hold = round(0.2 * reference.control_hz)
    T = reference.T_world_object[hold : hold + len(track)]
    np.testing.assert_allclose(
        invert_pose(T[0]) @ T, invert_pose(track.T_camera_object[0]) @ track.T_camera_object, atol=1e-6
    )
    np.testing.assert_allclose(reference.video_time_s[hold : hold + len(track)], track.time_s, atol=1e-9)
    for still in (reference.T_world_object[:hold], reference.T_world_object[hold + len(track) :]):
        np.testing.assert_allclose(still, np.tile(still[0], (len(still), 1, 1)), atol=1e-9)


def test_the_world_camera_sees_what_the_video_shows(placed: tuple[ObjectTrack, Reference]) -> None:
    track, reference = placed
    T_world_camera = np.asarray(reference.header["T_world_camera"])
    seen = invert_pose(T_world_camera) @ reference.T_world_object
    np.testing.assert_allclose(seen[5 : 5 + len(track)], track.T_camera_object, atol=1e-6)
    assert camera_elevation_deg(T_world_camera[:3, :3]) == pytest.approx(20.0, abs=1e-6)


def test_it_starts_upright_on_the_table_and_never_goes_below(placed: tuple[ObjectTrack, Reference]) -> None:
    _, reference = placed
    assert reference.tilt_rad[0] < 1e-6
    points = surface_points(KETTLE)
    heights = reference.T_world_object[:, 2, :3] @ points.T + reference.T_world_object[:, 2, 3:]
    assert heights.min() >= -1e-4
    assert heights[0].min() < 0.005


def test_what_is_poured_lands_in_the_receptacle_and_its_rim_stays_clear(placed: tuple[ObjectTrack, Reference]) -> None:
    _, reference = placed
    mug, T_mug = reference.receptacle(), reference.T_world_receptacle
    assert mug.category == "mug"
    np.testing.assert_allclose(T_mug[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
    assert T_mug[2, 3] == pytest.approx(0.5 * mug.extents_m[2])
    rim_m = float(mug.extents_m[2])
    jet = jet_of(reference.T_world_object, KETTLE, filling_m3(KETTLE, mug), reference.control_hz)
    middle = mouth_xy_m(mug, T_mug)
    away = np.linalg.norm(jet.landing_m(rim_m) - middle, axis=1)
    assert jet.poured > 0.5
    assert jet.share @ (away < 0.9 * mouth_radius_m(mug)) > 0.95
    points = surface_points(KETTLE)
    for T in reference.T_world_object:
        world = points @ T[:3, :3].T + T[:3, 3]
        over = np.linalg.norm(world[:, :2] - middle, axis=1) < float(mug.exterior.radius_m.max())
        assert not over.any() or world[over, 2].min() > rim_m + 0.009


def test_the_mouth_of_what_has_a_handle_is_in_the_middle_of_its_rim() -> None:
    mug = make_vessel("mug")
    T = make_pose(Rotation.from_euler("z", 1.0).as_matrix(), (0.4, 0.1, 0.5 * mug.extents_m[2]))
    world = np.asarray(mug.mesh.vertices) @ T[:3, :3].T + T[:3, 3]
    rim = world[world[:, 2] > world[:, 2].max() - 1e-4, :2]
    middle = mouth_xy_m(mug, T)
    np.testing.assert_allclose(middle, 0.5 * (rim.min(axis=0) + rim.max(axis=0)), atol=1e-3)
    assert np.linalg.norm(middle - T[:2, 3]) > 0.01


def test_start_configuration_and_grasp_belong_together(placed: tuple[ObjectTrack, Reference]) -> None:
    _, reference = placed
    held = panda_chain().hand(reference.q_start_rad)[0] @ reference.T_hand_object
    np.testing.assert_allclose(held, reference.T_world_object[0], atol=1e-3)
    assert limit_margin_rad(reference.q_start_rad).min() > 0.1
    assert reference.header["grasp"]["fits"]
    vessel, receptacle, T_receptacle = reference.vessel(), reference.receptacle(), reference.T_world_receptacle
    checker = CollisionChecker(vessel, reference.T_hand_object, 0.02, receptacle, T_receptacle)
    assert checker.check(arm_trajectory(reference)) == []
    assert overlaps_m(vessel, receptacle, reference.T_world_object, T_receptacle).max() == 0.0


def test_equal_seeds_give_equal_references(placed: tuple[ObjectTrack, Reference]) -> None:
    track, reference = placed
    again = build_reference(track, mug_track(track))
    np.testing.assert_array_equal(again.T_world_object, reference.T_world_object)
    assert again.header == reference.header


def test_without_a_receptacle_track_one_is_put_under_the_outlet() -> None:
    reference = build_reference(pour_track(), receptacle=make_vessel("mug"))
    T_mug = reference.T_world_receptacle
    jet = jet_of(reference.T_world_object, KETTLE, filling_m3(KETTLE, make_vessel("mug")), reference.control_hz)
    landing = jet.share @ jet.landing_m(2 * T_mug[2, 3])
    assert np.linalg.norm(landing - T_mug[:2, 3]) < 0.5 * mouth_radius_m(reference.receptacle())


def test_a_receptacle_seen_at_the_wrong_depth_is_moved_along_the_line_of_sight_and_said_so() -> None:
    track = pour_track()
    true = mug_track(track)
    far = changed(true, T_camera_object=_farther(true.T_camera_object, 1.15))
    reference = build_reference(track, far)
    moved_m = reference.header["changed"]["receptacle_moved_to_jet_m"]
    assert 0.1 < moved_m < 0.25
    assert any("cm toward the camera (a single camera measures depth badly)" in note for note in reference.notes)
    assert reference.header["feasibility"]["caught_part_of_jet"] > 0.9


def _farther(T: Array, factor: float) -> Array:
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def test_a_low_lift_is_raised_over_the_rim_and_said_so() -> None:
    track = pour_track(lift_m=0.05, side_m=0.1)
    reference = build_reference(track, mug_track(track, (0.34, 0.05)))
    assert any("must be" in note and "higher to pass over the receptacle's rim" in note for note in reference.notes)


@pytest.mark.parametrize("elevation_deg", [0.0, 45.0])
def test_an_upright_start_corrects_the_camera_s_assumed_elevation(elevation_deg: float) -> None:
    reference = build_reference(pour_track(elevation_deg=elevation_deg), receptacle=make_vessel("mug"))
    assert reference.tilt_rad[0] < 1e-6
    assert np.rad2deg(reference.tilt_rad.max()) == pytest.approx(60.0, abs=1e-3)
    camera = np.asarray(reference.header["T_world_camera"])[:3, :3]
    assert camera_elevation_deg(camera) == pytest.approx(elevation_deg, abs=1e-6)


def test_a_leaning_start_is_kept_and_said_so() -> None:
    reference = build_reference(pour_track(), receptacle=make_vessel("mug"), gravity_tolerance_deg=5.0)
    assert np.rad2deg(reference.tilt_rad[0]) == pytest.approx(10.0, abs=1e-3)
    assert any("lean by 10 degrees" in note for note in reference.notes)


@pytest.mark.slow
def test_too_long_a_path_is_scaled_about_the_pour_and_rotations_are_not() -> None:
    track = pour_track(lift_m=0.8, side_m=1.2)
    reference = build_reference(track, receptacle=make_vessel("mug"))
    assert 0.3 <= reference.scale < 1.0
    assert any("scaled by" in note for note in reference.notes)
    # Compare by the video's clock, as time may be stretched as well.
    index = np.searchsorted(track.time_s, [0.5, 2.5, 5.5])
    knots = [int(np.argmin(np.abs(reference.video_time_s - track.time_s[i]))) for i in index]
    far = np.linalg.norm(np.diff(track.T_camera_object[index, :3, 3], axis=0), axis=1)
    near = np.linalg.norm(np.diff(reference.T_world_object[knots, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(near, reference.scale * far, atol=0.02)
    assert np.rad2deg(reference.tilt_rad.max()) == pytest.approx(60.0, abs=0.1)


@pytest.mark.slow
def test_a_scale_that_does_not_fit_says_which_part_by_how_much_and_what_would() -> None:
    track = pour_track(lift_m=0.8, side_m=1.2)
    with pytest.raises(
        UserError, match=r"from \d\.\d s to \d\.\d s is out of .* by \d\.\d+ m .*scale 0\.\d+ would fit"
    ):
        build_reference(track, receptacle=make_vessel("mug"), scale=1.0)


def test_a_path_beyond_every_scale_is_refused() -> None:
    with pytest.raises(UserError, match=r"at every scale down to 0\.3"):
        build_reference(pour_track(lift_m=2.5, side_m=3.5, duration_s=10.0), receptacle=make_vessel("mug"))


def test_a_given_scale_is_kept() -> None:
    reference = build_reference(pour_track(), receptacle=make_vessel("mug"), scale=0.5)
    assert reference.scale == 0.5
    assert np.ptp(reference.T_world_object[:, 2, 3]) == pytest.approx(0.1, abs=1e-6)


def test_a_hasty_human_is_slowed_down_and_said_so() -> None:
    track = pour_track()
    reference = build_reference(changed(track, time_s=track.time_s / 5), receptacle=make_vessel("mug"))
    assert reference.header["time_stretch"] > 1.2
    assert any("was slowed down by a factor" in note for note in reference.notes)


def test_unseen_spin_is_left_out_and_plus_x_pours() -> None:
    tilt = np.deg2rad(np.linspace(0, 70, 40))
    spin = Rotation.from_euler("z", np.linspace(0, 200, 40)[:, None], degrees=True)
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = (Rotation.from_rotvec(np.outer(tilt, [0.6, 0.8, 0.0])) * spin).as_matrix()
    clean = without_spin(T)
    np.testing.assert_allclose(clean[:, :3, 2], T[:, :3, 2], atol=1e-12)
    turned = (Rotation.from_matrix(clean[1:, :3, :3]) * Rotation.from_matrix(clean[:-1, :3, :3]).inv()).as_rotvec()
    assert np.abs(np.sum(turned * clean[:-1, :3, 2], axis=1)).max() < 1e-9
    # At the greatest tilt +x points down as steeply as any direction of the rim can.
    assert clean[-1, 2, 0] == pytest.approx(-np.sin(tilt[-1]))


def test_the_camera_looks_at_the_robot_from_the_front() -> None:
    R = camera_rotation(30.0)
    np.testing.assert_allclose(R @ [0.0, 0.0, 1.0], [-np.cos(np.pi / 6), 0.0, -0.5], atol=1e-12)
    assert (R @ [0.0, -1.0, 0.0])[2] > 0.8
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert camera_elevation_deg(R) == pytest.approx(30.0)


def test_uneven_frame_times_are_resampled_on_the_path() -> None:
    track = pour_track(fps=60.0)
    keep = np.unique(np.r_[0, np.sort(np.random.default_rng(0).choice(len(track), 200, replace=False)), len(track) - 1])
    uneven = changed(
        track,
        T_camera_object=track.T_camera_object[keep],
        time_s=track.time_s[keep],
        confidence=track.confidence[keep],
        visible=track.visible[keep],
    )
    even, again = resample_track(track, 25.0), resample_track(uneven, 25.0)
    np.testing.assert_allclose(again.T_camera_object, even.T_camera_object, atol=2e-3)
    assert np.all(np.diff(even.video_time_s) >= 0)


def test_gaps_are_bridged_and_named() -> None:
    track = pour_track()
    visible = track.visible.copy()
    visible[60:75] = False
    T = track.T_camera_object.copy()
    T[60:75, :3, 3] = 9.0
    bridged = resample_track(changed(track, visible=visible, T_camera_object=T), 25.0)
    assert any("15 frames were bridged" in note for note in bridged.notes)
    assert (
        np.linalg.norm(bridged.T_camera_object[65:80, :3, 3] - track.T_camera_object[60:75, :3, 3], axis=1).max() < 0.03
    )
    assert bridged.confidence[70] == 0.0


def test_leaps_of_the_tracker_are_cut_out() -> None:
    track = pour_track()
    T = track.T_camera_object.copy()
    T[80:83] = T[80:83] @ make_pose(Rotation.from_rotvec([0.0, 0.0, 2.5]).as_matrix(), (0.3, 0.0, 0.0))
    cleaned = resample_track(changed(track, T_camera_object=T), 25.0)
    assert any("3 frames in which the tracker leapt" in note for note in cleaned.notes)
    assert np.abs(cleaned.T_camera_object[5 : 5 + len(track)] - track.T_camera_object).max() < 0.02


def test_unseen_ends_are_left_out() -> None:
    track = pour_track()
    visible = track.visible.copy()
    visible[:20] = visible[-10:] = False
    trimmed = resample_track(changed(track, visible=visible), 25.0)
    assert trimmed.video_time_s[0] == pytest.approx(track.time_s[20])
    assert trimmed.video_time_s[-1] == pytest.approx(track.time_s[-11])
    assert any("is used from 0.80 s" in note for note in trimmed.notes)


def test_a_track_that_begins_in_motion_is_eased_into() -> None:
    track = pour_track()
    late = changed(
        track,
        T_camera_object=track.T_camera_object[50:],
        time_s=track.time_s[50:],
        confidence=track.confidence[50:],
        visible=track.visible[50:],
    )
    eased = resample_track(late, 25.0)
    assert any("eases" in note for note in eased.notes)
    step_m = np.linalg.norm(np.diff(eased.T_camera_object[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(step_m[:20])).max() < 0.3 * step_m.max()


def test_two_frames_are_too_few() -> None:
    track = pour_track()
    two = ObjectTrack(
        track.T_camera_object[:2], track.time_s[:2], track.camera_matrix, np.ones(2), np.ones(2, bool), track.header
    )
    with pytest.raises(UserError, match=r"'kettle' has 2 usable frames"):
        build_reference(two)


def test_an_object_never_seen_is_refused() -> None:
    track = pour_track()
    with pytest.raises(UserError, match="visible in no frame"):
        build_reference(changed(track, visible=np.zeros(len(track), bool)))


def test_millimetres_given_as_metres_are_recognised() -> None:
    track = pour_track()
    with pytest.raises(UserError, match=r"moves over 283 m.*millimetres: divide them by 1000"):
        build_reference(changed(track, T_camera_object=_farther(track.T_camera_object, 1000.0)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scale": -1.0}, "scale is -1.0"),
        ({"scale": float("nan")}, "scale is nan"),
        ({"elevation_deg": 120.0}, "elevation is 120.0 degrees"),
        ({"control_hz": 0.0}, "control rate is 0.0 Hz"),
    ],
)
def test_bad_options_are_named(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        build_reference(pour_track(), **arguments)


def test_jitter_is_smoothed_and_said_so_but_haste_is_kept() -> None:
    track = pour_track()
    noise = np.random.default_rng(0).normal(0.0, 0.004, (len(track), 3))
    T = track.T_camera_object.copy()
    T[:, :3, 3] += noise
    calm = resample_track(changed(track, T_camera_object=T), 25.0)
    assert any("position jitters" in note for note in calm.notes)
    assert not any("rotation jitters" in note for note in calm.notes)
    left = calm.T_camera_object[5 : 5 + len(track), :3, 3] - track.T_camera_object[:, :3, 3]
    np.testing.assert_allclose(calm.video_time_s[5 : 5 + len(track)], track.time_s, atol=1e-9)
    assert np.sqrt(np.mean(left**2)) < 0.7 * np.sqrt(np.mean(noise**2))
    hasty = changed(pour_track(fps=100.0), time_s=np.arange(600) / 400.0)
    assert not any("jitters" in note for note in resample_track(hasty, 25.0).notes)


def test_low_confidence_everywhere_is_used_but_said() -> None:
    track = pour_track()
    unsure = resample_track(changed(track, confidence=np.full(len(track), 0.1)), 25.0)
    assert any("confidence is below" in note for note in unsure.notes)


def test_a_still_track_gives_a_still_reference() -> None:
    track = pour_track(tilt_deg=0.0, lift_m=0.0, side_m=0.0)
    reference = build_reference(track, receptacle=make_vessel("mug"))
    assert np.abs(reference.twist_world).max() < 1e-9
    assert any("empties the vessel only in part" in note for note in reference.notes)
    assert angle_between_rad(reference.T_world_object[0, :3, 2], np.array([0.0, 0.0, 1.0])) < 1e-6
