from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.reference import Reference, interpolate_poses, minimum_jerk, twist_of, vessel_to_header
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Symmetry, make_pose
from vid2demo.extract.vessel_output import export_vessel
from vid2demo.extract.vessels import make_vessel


def arc(knots: int = 76, hz: float = 25.0) -> Reference:
    """A vessel that moves on an arc and tilts by 70 degrees, then comes half back."""
    time_s = np.arange(knots) / hz
    phase = np.sin(np.pi * np.minimum(time_s / time_s[-1] * 1.2, 1.0) * 0.75)
    T = np.tile(np.eye(4), (knots, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(np.deg2rad(70) * phase, [0.0, 1.0, 0.0])).as_matrix()
    T[:, :3, 3] = np.column_stack([0.5 + 0.1 * time_s, -0.1 + 0.05 * time_s**2, 0.1 + 0.1 * phase])
    mug = make_vessel("mug", 3)
    header = {
        "symmetry": Symmetry((0.0, 0.0, 1.0), 1).to_json(),
        "vessel": vessel_to_header(mug),
        "receptacle": {**vessel_to_header(mug), "T_world_receptacle": make_pose(None, (0.6, 0.1, 0.05)).tolist()},
        "T_hand_object": make_pose(None, (0.0, 0.0, 0.05)).tolist(),
        "scale": 0.8,
        "notes": ["first", "second"],
    }
    return Reference.from_poses(T, time_s, header, np.linspace(0.5, 1.0, knots), time_s + 2.0)


def test_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    reference = arc()
    reference.save(tmp_path / "mug.reference.npz")
    back = Reference.load(tmp_path / "mug.reference.npz")
    for name in ("T_world_object", "time_s", "twist_world", "confidence", "video_time_s"):
        np.testing.assert_array_equal(getattr(back, name), getattr(reference, name))
    assert back.scale == 0.8
    assert back.notes == ["first", "second"]
    assert back.header["units"]["length"] == "m"
    np.testing.assert_array_equal(back.T_world_receptacle, reference.T_world_receptacle)
    assert [path.name for path in tmp_path.iterdir()] == ["mug.reference.npz"]


def test_vessels_are_rebuilt_exactly(tmp_path: Path) -> None:
    arc().save(tmp_path / "a.reference.npz")
    original, back = make_vessel("mug", 3), Reference.load(tmp_path / "a.reference.npz").vessel()
    assert dict(back.params) == dict(original.params)
    np.testing.assert_array_equal(back.mesh.vertices, original.mesh.vertices)


def test_a_mesh_file_as_vessel_is_read_again_and_missed_when_it_is_gone(tmp_path: Path) -> None:
    jug = make_vessel("milk_jug")
    export_vessel(jug, tmp_path / "jug.obj")
    track_entry = {"name": "jug.obj", "file": str(tmp_path / "jug.obj"), "unit": "auto"}
    vessel = arc().with_header(vessel=track_entry).vessel()
    arc().with_header(vessel=vessel_to_header(vessel)).save(tmp_path / "pour.reference.npz")
    again = Reference.load(tmp_path / "pour.reference.npz").vessel()
    assert again.source is not None
    assert again.source.up == "+z"
    np.testing.assert_array_equal(again.mesh.vertices, vessel.mesh.vertices)
    assert again.interior_volume_m3 == pytest.approx(jug.interior_volume_m3, rel=0.02)
    export_vessel(make_vessel("milk_jug", 1), tmp_path / "jug.obj")
    with pytest.raises(UserError, match=r"jug\.obj.*has changed"):
        Reference.load(tmp_path / "pour.reference.npz").vessel()
    (tmp_path / "jug.obj").unlink()
    with pytest.raises(UserError, match=r"held vessel is the mesh file .*jug\.obj, which does not exist"):
        Reference.load(tmp_path / "pour.reference.npz").vessel()


def test_what_is_missing_is_named() -> None:
    bare = Reference.from_poses(arc().T_world_object, arc().time_s, {})
    assert not bare.has_receptacle
    for ask in (lambda: bare.q_start_rad, lambda: bare.T_hand_object, bare.receptacle, bare.vessel):
        with pytest.raises(UserError, match="vid2demo retarget"):
            ask()
    with pytest.raises(UserError, match="q_start_rad must hold"):
        _ = bare.with_header(q_start_rad=[0.0, 1.0]).q_start_rad


@pytest.mark.parametrize("fault", ["missing", "text", "cut", "other schema", "newer", "lacks", "nan", "shape"])
def test_bad_files_are_one_clear_error(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "x.reference.npz"
    reference = arc()
    if fault != "missing":
        reference.save(path)
    if fault == "text":
        path.write_text("hello")
    if fault == "cut":
        path.write_bytes(path.read_bytes()[:400])
    if fault in ("other schema", "newer", "lacks", "nan", "shape"):
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays["header"]))
        if fault == "other schema":
            header["schema"] = "vid2demo/object-track"
        if fault == "newer":
            header["version"] = 99
        if fault == "lacks":
            del arrays["twist_world"]
        if fault == "nan":
            arrays["T_world_object"][3, 0, 3] = np.nan
        if fault == "shape":
            arrays["time_s"] = arrays["time_s"][:-1]
        np.savez(path, **(arrays | {"header": np.array(json.dumps(header))}))
    with pytest.raises(UserError, match=r"x\.reference\.npz"):
        Reference.load(path)


def test_poses_that_are_no_rotations_or_unequal_steps_are_refused() -> None:
    reference = arc()
    mirrored = reference.T_world_object.copy()
    mirrored[:, 0, 0] *= -1
    with pytest.raises(ValueError, match="not rotations"):
        Reference(mirrored, reference.time_s, reference.twist_world)
    with pytest.raises(ValueError, match="equal steps"):
        Reference.from_poses(reference.T_world_object, reference.time_s**1.1, {})


def test_twist_of_a_steady_screw_is_exact() -> None:
    omega, v = np.array([0.3, -0.5, 0.9]), np.array([0.1, 0.2, -0.3])
    time_s = np.arange(40) / 25.0
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(time_s, omega)).as_matrix()
    T[:, :3, 3] = np.outer(time_s, v)
    np.testing.assert_allclose(twist_of(T, time_s), np.tile(np.concatenate([v, omega]), (40, 1)), atol=1e-12)


def test_warping_moves_start_and_receptacle_and_nothing_else() -> None:
    reference = arc()
    start, receptacle = np.array([0.03, -0.02, 0.01]), np.array([-0.05, 0.04, 0.0])
    warped = reference.warped(start, receptacle)
    shift = warped.T_world_object[:, :3, 3] - reference.T_world_object[:, :3, 3]
    np.testing.assert_allclose(shift[0], start, atol=1e-12)
    np.testing.assert_allclose(
        shift[reference.pour_index :], np.tile(receptacle, (len(shift) - reference.pour_index, 1))
    )
    np.testing.assert_array_equal(warped.T_world_object[:, :3, :3], reference.T_world_object[:, :3, :3])
    np.testing.assert_allclose(warped.T_world_receptacle[:3, 3], reference.T_world_receptacle[:3, 3] + receptacle)
    np.testing.assert_array_equal(warped.time_s, reference.time_s)
    np.testing.assert_allclose(warped.twist_world, twist_of(warped.T_world_object, warped.time_s))
    # The blend starts and ends without a kick.
    assert np.abs(np.diff(shift, axis=0)).max() < 0.12 * np.abs(receptacle - start).max()
    np.testing.assert_array_equal(reference.T_world_receptacle[:3, 3], [0.6, 0.1, 0.05])


def test_warping_by_nothing_changes_nothing_and_equal_offsets_shift_all() -> None:
    reference = arc()
    assert reference.warped() is reference
    offset = np.array([0.02, 0.01, 0.0])
    moved = reference.warped(offset, offset)
    np.testing.assert_allclose(moved.T_world_object[:, :3, 3], reference.T_world_object[:, :3, 3] + offset, atol=1e-12)
    with pytest.raises(ValueError, match="shape"):
        reference.warped(np.zeros(2))


def test_warping_the_start_solves_the_start_configuration_anew() -> None:
    from vid2demo.envs.builtin import builtin_reference
    from vid2demo.envs.kinematics import panda_chain

    warped = builtin_reference().warped((0.03, -0.03, 0.0))
    held = panda_chain().hand(warped.q_start_rad)[0] @ warped.T_hand_object
    np.testing.assert_allclose(held, warped.T_world_object[0], atol=1e-3)
    with pytest.raises(UserError, match="out of the arm's reach"):
        builtin_reference().warped((0.8, 0.0, 0.0))


def test_stretching_keeps_the_path_and_slows_the_clock() -> None:
    reference = arc()
    slow = reference.stretched(2.0)
    assert slow.duration_s == pytest.approx(2 * reference.duration_s)
    assert slow.control_hz == pytest.approx(reference.control_hz)
    np.testing.assert_allclose(slow.T_world_object[::2], reference.T_world_object, atol=1e-9)
    np.testing.assert_allclose(slow.video_time_s[::2], reference.video_time_s)
    np.testing.assert_allclose(slow.twist_world[10:100:2], 0.5 * reference.twist_world[5:50], atol=2e-3)
    assert slow.header["time_stretch"] == pytest.approx(2.0)
    assert slow.stretched(1.5).header["time_stretch"] == pytest.approx(3.0)
    with pytest.raises(ValueError, match="positive"):
        reference.stretched(0.0)


def test_the_pour_is_the_middle_of_the_greatest_tilt() -> None:
    time_s = np.arange(11) / 25.0
    tilt = np.deg2rad([0, 10, 40, 80, 80, 80, 80, 80, 20, 10, 0])
    T = np.tile(np.eye(4), (11, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(tilt, [0.6, 0.8, 0.0])).as_matrix()
    reference = Reference.from_poses(T, time_s, {})
    np.testing.assert_allclose(reference.tilt_rad, tilt, atol=1e-9)
    assert reference.pour_index == 5


def test_minimum_jerk_and_interpolation_keep_their_ends() -> None:
    np.testing.assert_allclose(minimum_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0.0, 0.0, 0.5, 1.0, 1.0])
    reference = arc()
    np.testing.assert_allclose(
        interpolate_poses(reference.T_world_object, reference.time_s, reference.time_s),
        reference.T_world_object,
        atol=1e-12,
    )
