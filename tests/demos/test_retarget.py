from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.retarget import retarget, tracking_errors
from vid2demo.envs.kinematics import limit_margin_rad, panda_chain
from vid2demo.envs.panda import DQ_MAX_RAD_S, Q_HOME_RAD, panda_spec
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array, make_pose
from vid2demo.extract.vessels import make_vessel

T_HAND_OBJECT = make_pose(None, (0.0, 0.0, 0.05))


def arm_motion(speed: float = 1.0, knots: int = 76) -> Array:
    """(N, 7) a smooth joint motion that uses all joints."""
    phase = minimum_jerk(np.linspace(0.0, 1.0, knots))[:, None]
    return np.asarray(Q_HOME_RAD + speed * phase * np.array([0.4, 0.3, -0.2, 0.35, 0.3, 0.4, -0.5]))


def reference_of(q_rad: Array) -> Reference:
    """What an object in the hand does when the arm moves so."""
    header = {
        "vessel": vessel_to_header(make_vessel("mug")),
        "T_hand_object": T_HAND_OBJECT.tolist(),
        "q_start_rad": q_rad[0].tolist(),
        "grasp": {"kind": "handle", "width_m": 0.013, "fits": True},
    }
    return Reference.from_poses(panda_chain().hand(q_rad) @ T_HAND_OBJECT, np.arange(len(q_rad)) / 25.0, header)


def test_a_motion_made_by_the_arm_itself_is_recovered() -> None:
    reference = reference_of(arm_motion())
    joints = retarget(reference)
    position_m, rotation_rad = tracking_errors(reference, joints.q_rad)
    assert position_m.max() < 1e-4
    assert rotation_rad.max() < 1e-3
    assert joints.header["position_error_m"]["max"] == pytest.approx(position_m.max())
    np.testing.assert_array_equal(joints.time_s, reference.time_s)
    np.testing.assert_allclose(joints.gripper_m, 0.0065)


def test_no_motion_gives_a_still_arm_with_gravity_torques() -> None:
    joints = retarget(reference_of(np.tile(Q_HOME_RAD, (30, 1))))
    np.testing.assert_allclose(joints.q_rad, np.tile(Q_HOME_RAD, (30, 1)), atol=1e-6)
    assert np.abs(joints.dq_rad_s).max() < 1e-6
    # An independent account: the arm's own gravity torque, and the mug's weight through the Jacobian of its centre.
    spec = panda_spec(visuals=False)
    for body in spec.bodies:
        body.gravcomp = 0.0
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = Q_HOME_RAD
    mujoco.mj_forward(model, data)
    mug = make_vessel("mug")
    body = model.body("panda_hand_tcp").id
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ (T_HAND_OBJECT[:3, 3] + np.asarray(mug.mesh.center_mass))
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    expected = data.qfrc_bias[:7] + jacobian[2, :7] * mug.mass_kg * 9.81
    np.testing.assert_allclose(joints.tau_nm, np.tile(expected, (30, 1)), atol=1e-3)


def test_contents_weigh_on_the_joints() -> None:
    reference = reference_of(np.tile(Q_HOME_RAD, (5, 1)))
    empty, full = retarget(reference), retarget(reference, contents_kg=0.5)
    assert full.header["payload_kg"] == pytest.approx(empty.header["payload_kg"] + 0.5)
    assert abs(full.tau_nm[0, 1]) > abs(empty.tau_nm[0, 1]) + 1.0


def test_limits_hold_even_when_the_reference_is_too_fast() -> None:
    reference = reference_of(arm_motion(speed=2.0, knots=14))
    joints = retarget(reference, strict=False)
    step = np.abs(np.diff(joints.q_rad, axis=0)) * 25.0
    assert np.all(step <= DQ_MAX_RAD_S * (1 + 1e-6))
    assert step.max() > 0.99 * DQ_MAX_RAD_S.min()
    assert limit_margin_rad(joints.q_rad).min() > 0.0
    assert joints.header["position_error_m"]["max"] > 0.01


def test_out_of_reach_says_which_part_and_by_how_much() -> None:
    reference = reference_of(arm_motion())
    T = reference.T_world_object.copy()
    T[40:, 0, 3] += 0.6 * minimum_jerk(np.arange(36) / 20.0)
    far = Reference.from_poses(T, reference.time_s, reference.header)
    with pytest.raises(UserError, match=r"from \d\.\d s to 3\.0 s: it misses by up to 0\.\d\d m"):
        retarget(far)
    nearest = retarget(far, strict=False)
    assert limit_margin_rad(nearest.q_rad).min() > 0.0


def test_equal_input_equal_result() -> None:
    reference = reference_of(arm_motion())
    np.testing.assert_array_equal(retarget(reference).q_rad, retarget(reference).q_rad)


def test_the_redundancy_returns_with_the_object() -> None:
    there = arm_motion(knots=50)
    joints = retarget(reference_of(np.concatenate([there, there[::-1]])))
    np.testing.assert_allclose(joints.q_rad[-1], joints.q_rad[0], atol=1e-3)


def test_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    joints = retarget(reference_of(arm_motion()))
    joints.save(tmp_path / "mug.joints.npz")
    back = JointTrajectory.load(tmp_path / "mug.joints.npz")
    for name in ("time_s", "q_rad", "dq_rad_s", "tau_nm", "gripper_m"):
        np.testing.assert_array_equal(getattr(back, name), getattr(joints, name))
    assert back.header["payload_kg"] == joints.header["payload_kg"]
    assert back.header["joints"][0] == "panda_joint1"


@pytest.mark.parametrize("fault", ["missing", "cut", "other schema", "lacks", "nan"])
def test_bad_files_are_one_clear_error(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "x.joints.npz"
    if fault != "missing":
        n = np.arange(3) / 25.0
        JointTrajectory(n, np.zeros((3, 7)), np.zeros((3, 7)), np.zeros((3, 7)), np.zeros(3)).save(path)
    if fault == "cut":
        path.write_bytes(path.read_bytes()[:300])
    if fault in ("other schema", "lacks", "nan"):
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays["header"]))
        if fault == "other schema":
            header["schema"] = "something"
        if fault == "lacks":
            del arrays["tau_nm"]
        if fault == "nan":
            arrays["q_rad"][1, 2] = np.nan
        np.savez(path, **(arrays | {"header": np.array(json.dumps(header))}))
    with pytest.raises(UserError, match=r"x\.joints\.npz"):
        JointTrajectory.load(path)
