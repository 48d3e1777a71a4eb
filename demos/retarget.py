"""From a `Reference` to joint motion: differential inverse kinematics with mink, inside joint and speed limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mink
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..envs.kinematics import HAND_BODY, limit_margin_rad, panda_chain, pose_error
from ..envs.panda import DQ_MAX_RAD_S, FINGER_JOINTS, FINGER_MAX_M, Q_MAX_RAD, Q_MIN_RAD, panda_spec
from ..extract.errors import UserError
from ..extract.geometry import Array
from .joints import JointTrajectory

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from ..extract.vessels import Vessel

__all__ = ["JointTrajectory", "retarget", "tracking_errors"]

HELD_BODY = "held_vessel"
LOST_M, LOST_RAD = 0.03, np.deg2rad(10.0)
LIMIT_DISTANCE_RAD = 0.01
# The redundancy stays near the start posture; so weak that it costs less than 0.01 mm of tracking.
_POSTURE_COST = 1e-3
_ITERATIONS = 3


def retarget(reference: Reference, *, contents_kg: float = 0.0, strict: bool = True) -> JointTrajectory:
    """Joint motion that carries the held object along the reference, knot by knot on its clock.

    contents_kg: mass of what is in the vessel, at its origin, for the torques. strict: raise UserError where the object
    would be further than 3 cm or 10 degrees from the reference, instead of returning the nearest motion.
    Speeds never exceed the joints' limits: where the reference is too fast for them the motion lags behind it, and the
    errors in the header say by how much (`build_reference` slows such motions down beforehand).
    """
    model = _model_with_vessel(reference, contents_kg)
    q_rad = _follow_with_mink(model, reference)
    time_s = reference.time_s - reference.time_s[0]
    dq_rad_s = np.gradient(q_rad, time_s, axis=0)
    position_m, rotation_rad = tracking_errors(reference, q_rad)
    if strict:
        _check_followed(reference, position_m, rotation_rad)
    width_m = float(reference.header.get("grasp", {}).get("width_m", 0.0))
    header = {
        "control_hz": reference.control_hz,
        "position_error_m": {"mean": float(position_m.mean()), "max": float(position_m.max())},
        "rotation_error_rad": {"mean": float(rotation_rad.mean()), "max": float(rotation_rad.max())},
        "limit_margin_rad": limit_margin_rad(q_rad).min(axis=0).tolist(),
        "speed_part": (np.abs(dq_rad_s).max(axis=0) / DQ_MAX_RAD_S).tolist(),
        "payload_kg": float(model.body_mass[model.body(HELD_BODY).id]),
    }
    tau_nm = inverse_dynamics(model, q_rad, dq_rad_s, np.gradient(dq_rad_s, time_s, axis=0))
    gripper_m = np.full(len(time_s), min(0.5 * width_m, FINGER_MAX_M))
    return JointTrajectory(time_s, q_rad, dq_rad_s, tau_nm, gripper_m, header)


def tracking_errors(reference: Reference, q_rad: Array) -> tuple[Array, Array]:
    """Distance (N,) in m and angle (N,) in rad between the held object at q (N, 7) and the reference."""
    T = panda_chain().hand(q_rad) @ reference.T_hand_object
    error = pose_error(T, reference.T_world_object)
    return np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)


def inverse_dynamics(model: Any, q_rad: Array, dq_rad_s: Array, ddq_rad_s2: Array) -> Array:
    """(N, 7) joint torques in N m for a motion (N, 7) without contacts."""
    data = mujoco.MjData(model)
    tau_nm = np.empty_like(q_rad)
    for k in range(len(q_rad)):
        data.qpos[:7], data.qvel[:7], data.qacc[:7] = q_rad[k], dq_rad_s[k], ddq_rad_s2[k]
        mujoco.mj_inverse(model, data)
        tau_nm[k] = data.qfrc_inverse[:7]
    return tau_nm


def _check_followed(reference: Reference, position_m: Array, rotation_rad: Array) -> None:
    lost = (position_m > LOST_M) | (rotation_rad > LOST_RAD)
    if lost.any():
        times = reference.time_s[lost]
        raise UserError(
            f"the arm cannot follow the reference from {times.min():.1f} s to {times.max():.1f} s: it misses by up to "
            f"{position_m.max():.2f} m and {np.rad2deg(rotation_rad.max()):.0f} degrees; place it anew or choose a "
            "smaller --scale"
        )


def _model_with_vessel(reference: Reference, contents_kg: float) -> Any:
    """The arm with the vessel's mass in its hand; no contacts, no gravity compensation: torques are the motors'."""
    spec = panda_spec(visuals=False)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for body in spec.bodies:
        body.gravcomp = 0.0
    T = reference.T_hand_object
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    held = spec.body(HAND_BODY).add_body(name=HELD_BODY, pos=T[:3, 3], quat=[w, x, y, z])
    held.explicitinertial = True
    vessel = reference.vessel() if reference.header.get("vessel") else None
    held.mass, held.ipos, held.inertia = _inertia(vessel, contents_kg)
    return spec.compile()


def _inertia(vessel: Vessel | None, contents_kg: float) -> tuple[float, Array, Array]:
    """Mass, centre and principal inertia. A box's inertia stands for the vessel's, a small part of the arm's."""
    if vessel is None:
        return max(contents_kg, 1e-3), np.zeros(3), np.full(3, 1e-6)
    mass = float(vessel.mass_kg) + contents_kg
    center = np.asarray(vessel.mesh.center_mass) * float(vessel.mass_kg) / mass
    a, b, c = (float(e) for e in vessel.extents_m)
    return mass, center, mass / 8.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])


class KnotSpeedLimit(mink.Limit):
    """Keeps the iterations of one knot together within what the joints can travel since the knot before.

    mink's own VelocityLimit bounds each iteration alone: divided among them it would bind the first, large one far
    below the true limit and push the redundancy about.
    """

    def __init__(self, travel_rad: Array, dof_count: int) -> None:
        """travel_rad: (7,) largest travel of each joint between two knots."""
        self.travel_rad = travel_rad
        self.q_before_rad: Array = np.zeros(7)
        self._select = np.eye(dof_count)[:7]

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        moved = configuration.q[:7] - self.q_before_rad
        bound = np.maximum(np.hstack([self.travel_rad - moved, self.travel_rad + moved]), 0.0)
        return mink.Constraint(G=np.vstack([self._select, -self._select]), h=bound)


def _follow_with_mink(model: Any, reference: Reference) -> Array:
    # The fingers play no part; half open they are as far from their own limits as they can be.
    q = np.full(model.nq, 0.5 * FINGER_MAX_M)
    q[:7] = np.clip(reference.q_start_rad, Q_MIN_RAD + LIMIT_DISTANCE_RAD, Q_MAX_RAD - LIMIT_DISTANCE_RAD)
    configuration = mink.Configuration(model, q=q)
    task = mink.FrameTask(HELD_BODY, "body", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-6)
    posture = mink.PostureTask(model, cost=_POSTURE_COST)
    posture.set_target(q)
    fingers = mink.DofFreezingTask(model, [int(model.joint(name).dofadr[0]) for name in FINGER_JOINTS])
    joint_limit = mink.ConfigurationLimit(model, gain=0.95, min_distance_from_limits=LIMIT_DISTANCE_RAD)
    speed_limit = KnotSpeedLimit(DQ_MAX_RAD_S / reference.control_hz, model.nv)

    def approach(T: Array, iterations: int, limits: list[Any]) -> None:
        task.set_target(mink.SE3.from_matrix(T))
        for _ in range(iterations):
            v = mink.solve_ik(configuration, [task, posture], 1.0, "daqp", limits=limits, constraints=[fingers])
            configuration.integrate_inplace(v, 1.0)

    out = np.empty((len(reference), 7))
    # Before the motion there is no clock: the arm is simply put where the object starts.
    approach(reference.T_world_object[0], 20, [joint_limit])
    posture.set_target(configuration.q)
    for k, T in enumerate(reference.T_world_object):
        speed_limit.q_before_rad = configuration.q[:7].copy()
        approach(T, _ITERATIONS, [joint_limit, speed_limit])
        out[k] = configuration.q[:7]
    return out
