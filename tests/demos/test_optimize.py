from __future__ import annotations

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.demos.dynamics import arm_with, contents_of, inverse_dynamics, payload_of
from vid2demo.demos.limits import commanded, extremes
from vid2demo.demos.motion import JointCurve
from vid2demo.demos.optimize import TorqueWeights, optimize, pinocchio_arm
from vid2demo.demos.retarget import retarget, tracking_errors
from vid2demo.envs.builtin import builtin_reference
from vid2demo.envs.kinematics import panda_chain
from vid2demo.envs.panda import Q_HOME_RAD, Q_MAX_RAD, Q_MIN_RAD
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array, make_pose, rotation_angle_rad
from vid2demo.extract.vessels import make_vessel

T_HAND_OBJECT = make_pose(Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix(), (0.01, -0.02, 0.05))


def arm_motion(knots: int = 76, size: float = 1.0) -> Array:
    phase = minimum_jerk(np.linspace(-0.1, 1.1, knots))[:, None]
    return np.asarray(Q_HOME_RAD + size * phase * np.array([0.4, 0.3, -0.2, 0.35, 0.3, 0.4, -0.5]))


def reference_of(q_rad: Array, vessel: str = "mug") -> Reference:
    """What an object in the hand does when the arm moves so."""
    made = make_vessel(vessel)
    header = {
        "vessel": vessel_to_header(made),
        "symmetry": made.symmetry.to_json(),
        "T_hand_object": T_HAND_OBJECT.tolist(),
        "q_start_rad": q_rad[0].tolist(),
    }
    return Reference.from_poses(panda_chain().hand(q_rad) @ T_HAND_OBJECT, np.arange(len(q_rad)) / 25.0, header)


def trembling(reference: Reference, seed: int = 0, part: slice = slice(1, None)) -> Reference:
    """The same seen by a tracker whose poses are off by 0.5 mm and 0.2 degrees, frame by frame."""
    rng, T = np.random.default_rng(seed), reference.T_world_object.copy()
    T[part, :3, 3] += rng.normal(0.0, 5e-4, T[part, :3, 3].shape)
    turn = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(0.2), T[part, :3, 3].shape))
    T[part, :3, :3] = T[part, :3, :3] @ turn.as_matrix()
    return Reference.from_poses(T, reference.time_s, reference.header)


def peaks(reference: Reference, q_rad: Array) -> tuple[float, float]:
    """Largest torque beyond gravity and largest jerk on the way, both as part of what the joints can."""
    arm, curve = arm_with(payload_of(reference), reference.T_hand_object), JointCurve(reference.time_s, q_rad)
    fine = curve.clock(200.0)
    motion = [curve.at(fine, order) for order in range(3)]
    still = np.zeros_like(motion[0])
    torque = inverse_dynamics(arm, *motion) - inverse_dynamics(arm, motion[0], still, still)
    jerk = [e.part for e in extremes(commanded(curve.at(curve.clock(1000.0)), torque)) if e.quantity == "jerk"]
    return float(np.abs(torque).max()), max(jerk)


def test_pinocchio_and_the_simulator_are_one_arm() -> None:
    """Poses of the held object, gravity torques and the torques of a motion agree between both engines' models."""
    import pinocchio

    reference = reference_of(arm_motion())
    payload = payload_of(reference, 0.3)
    model, frame = pinocchio_arm(payload, T_HAND_OBJECT)
    arm = arm_with(payload, T_HAND_OBJECT)
    # Friction in the joints is the simulator's alone, and the controls of Eq. 4 know none.
    arm.dof_damping[:] = 0.0
    data = model.createData()
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(Q_MIN_RAD, Q_MAX_RAD)
        dq, ddq = rng.normal(0.0, 1.0, (2, 7))
        pinocchio.framesForwardKinematics(model, data, q)
        T = panda_chain().hand(q)[0] @ T_HAND_OBJECT
        np.testing.assert_allclose(data.oMf[frame].homogeneous, T, atol=1e-6)
        gravity = inverse_dynamics(arm, q[None], np.zeros((1, 7)), np.zeros((1, 7)))[0]
        np.testing.assert_allclose(pinocchio.computeGeneralizedGravity(model, data, q), gravity, atol=0.02)
        np.testing.assert_allclose(
            pinocchio.rnea(model, data, q, dq, ddq), inverse_dynamics(arm, q[None], dq[None], ddq[None])[0], atol=0.1
        )


def test_a_track_that_the_arm_made_itself_is_recovered() -> None:
    reference = reference_of(arm_motion())
    position_m, rotation_rad = tracking_errors(reference, retarget(reference, solver="torque").q_rad)
    assert position_m.max() < 1e-4
    assert rotation_rad.max() < 1e-3


def test_no_motion_gives_a_still_arm_with_gravity_torques() -> None:
    q = np.tile(Q_HOME_RAD, (40, 1))
    joints = retarget(reference_of(q), solver="torque")
    np.testing.assert_allclose(joints.q_rad, q, atol=1e-6)
    np.testing.assert_allclose(joints.dq_rad_s, 0.0, atol=1e-6)
    arm = arm_with(payload_of(reference_of(q)), T_HAND_OBJECT)
    data = mujoco.MjData(arm)
    data.qpos[:7] = Q_HOME_RAD
    mujoco.mj_forward(arm, data)
    np.testing.assert_allclose(joints.tau_nm, np.tile(data.qfrc_bias[:7], (40, 1)), atol=1e-3)


def test_equal_input_equal_result() -> None:
    reference = trembling(reference_of(arm_motion()))
    first, second = retarget(reference), retarget(reference)
    for name in ("q_rad", "dq_rad_s", "tau_nm"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert first.header == second.header


def test_a_trembling_track_costs_less_torque_and_jerk_and_comes_nearer_to_the_truth() -> None:
    truth = reference_of(arm_motion())
    seen = trembling(truth)
    plain, best = (retarget(seen, solver=solver, strict=False).q_rad for solver in ("mink", "torque"))
    plain_m, best_m = (tracking_errors(truth, q)[0].mean() for q in (plain, best))
    assert best_m < 0.9 * plain_m
    (plain_nm, plain_jerk), (best_nm, best_jerk) = peaks(truth, plain), peaks(truth, best)
    assert best_nm < 0.6 * plain_nm
    assert best_jerk < 0.5 * plain_jerk


def test_frames_of_low_confidence_pull_less() -> None:
    truth = reference_of(arm_motion())
    part = slice(30, 45)
    seen = trembling(truth, part=part)
    unsure = np.ones(len(truth))
    unsure[part] = 0.0
    off = [
        float(tracking_errors(truth, retarget(r, solver="torque").q_rad)[0][part].mean())
        for r in (seen, replace(seen, confidence=unsure))
    ]
    assert off[1] < 0.75 * off[0]


def test_a_turn_that_nobody_sees_is_free_and_one_that_a_spout_fixes_is_not() -> None:
    """A tumbler that twists to and fro about its own axis in the track need not twist in the hand; a mug must."""
    still = arm_motion()
    twisted = {}
    for vessel in ("tumbler", "mug"):
        reference = reference_of(still, vessel)
        T = reference.T_world_object.copy()
        wave = (
            0.5
            * np.sin(np.linspace(0.0, 4.0 * np.pi, len(T)))
            * minimum_jerk(np.minimum(np.arange(76), 75 - np.arange(76)) / 20)
        )
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_euler("z", wave[:, None]).as_matrix()
        reference = Reference.from_poses(T, reference.time_s, reference.header)
        joints = retarget(reference, solver="torque", weights=TorqueWeights(posture=0.0))
        assert tracking_errors(reference, joints.q_rad)[1].max() < np.deg2rad(0.5)
        R = panda_chain().hand(joints.q_rad)[:, :3, :3] @ T_HAND_OBJECT[:3, :3]
        twisted[vessel] = float(rotation_angle_rad(R, T[:, :3, :3]).max())
    assert twisted["tumbler"] > np.deg2rad(10.0)
    assert twisted["mug"] < np.deg2rad(0.5)


def test_a_motion_too_fast_for_the_arm_stays_within_the_limits_that_inverse_kinematics_breaks() -> None:
    reference = reference_of(arm_motion(knots=20, size=1.8))

    def worst(solver: str) -> float:
        q = retarget(reference, solver=solver, strict=False).q_rad  # type: ignore[arg-type]
        curve = JointCurve(reference.time_s, q)
        found = extremes(commanded(curve.at(curve.clock(1000.0)), np.zeros((2, 7))))
        return max(e.part for e in found)

    assert worst("mink") > 1.5
    assert worst("torque") < 1.1


def test_heavier_weights_on_torque_take_torque_for_error() -> None:
    reference = trembling(reference_of(arm_motion()))
    warm = retarget(reference, solver="mink").q_rad
    payload = payload_of(reference)
    light, heavy = (optimize(reference, warm, payload, TorqueWeights(torque=weight)).q_rad for weight in (1e-3, 1e-1))
    assert peaks(reference, heavy)[0] < peaks(reference, light)[0]
    assert tracking_errors(reference, heavy)[0].mean() > tracking_errors(reference, light)[0].mean()


def test_contents_run_out_and_the_torques_know_it() -> None:
    reference = builtin_reference()
    filled_kg, left = contents_of(reference)
    assert 0.05 < filled_kg < 0.5
    assert left[0] == pytest.approx(1.0)
    assert left[-1] < 0.3
    assert np.all(np.diff(left) <= 1e-12)
    poured, kept = retarget(reference), retarget(reference, contents_kg=filled_kg)
    np.testing.assert_allclose(poured.tau_nm[0], kept.tau_nm[0], atol=1e-3)
    assert np.abs(poured.tau_nm[-1] - kept.tau_nm[-1]).max() > 0.2


def test_without_the_libraries_the_install_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "crocoddyl", None)
    with pytest.raises(UserError, match=r"pip install 'vid2demo\[torque\]'"):
        retarget(reference_of(arm_motion(30)), solver="torque")


def test_without_the_libraries_inverse_kinematics_is_used_and_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vid2demo.demos.optimize.is_available", lambda: False)
    joints = retarget(reference_of(arm_motion(30)))
    assert joints.header["solver"]["name"] == "mink"
    assert "inverse kinematics alone" in joints.header["solver"]["note"]
