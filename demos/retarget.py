"""From a `Reference` to joint motion: inverse kinematics with mink, then torques that carry the object (Eq. 4)."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal

import mink
import numpy as np

from ..envs.kinematics import limit_margin_rad, panda_chain
from ..envs.panda import DQ_MAX_RAD_S, FINGER_JOINTS, FINGER_MAX_M, Q_MAX_RAD, Q_MIN_RAD
from ..extract.errors import UserError
from ..extract.geometry import Array
from . import optimize
from .dynamics import HELD_BODY, arm_with, contents_of, inverse_dynamics, payload_of
from .joints import JointTrajectory
from .limits import commanded, extremes
from .motion import JointCurve

if TYPE_CHECKING:
    from ..envs.reference import Reference

__all__ = ["JointTrajectory", "retarget", "tracking_errors"]

Solver = Literal["auto", "torque", "mink"]
LOST_M, LOST_RAD = 0.03, np.deg2rad(10.0)
LIMIT_DISTANCE_RAD = 0.01
# The redundancy stays near the start posture; so weak that it costs less than 0.01 mm of tracking.
_POSTURE_COST = 1e-3
_ITERATIONS = 3


def retarget(
    reference: Reference,
    *,
    contents_kg: float | None = None,
    strict: bool = True,
    solver: Solver = "auto",
    weights: optimize.TorqueWeights | None = None,
) -> JointTrajectory:
    """Joint motion that carries the held object along the reference, knot by knot on its clock.

    contents_kg: mass of what is in the vessel, at its origin, throughout. None: what the environments fill in, and as
        much of it as has not yet run out.
    strict: raise UserError where the object would be further than 3 cm or 10 degrees from the reference, instead of
        returning the nearest motion.
    solver: "mink" follows by inverse kinematics alone; "torque" solves Eq. 4 from there, and raises UserError when the
        extra `torque` is not installed; "auto" does so where it is, and says in the header which of the two it was.
    Speeds never exceed the joints' limits: where the reference is too fast for them the motion lags behind it, and the
    errors in the header say by how much (`build_reference` slows such motions down beforehand).
    """
    filled_kg, left = contents_of(reference) if contents_kg is None else (contents_kg, np.ones(len(reference)))
    full = payload_of(reference, filled_kg)
    empty_arm, full_arm = (arm_with(p, reference.T_hand_object) for p in (payload_of(reference), full))
    q_rad = _follow_with_mink(full_arm, reference)
    header: dict[str, Any] = {"solver": {"name": "mink"}}
    if solver == "torque" or (solver == "auto" and optimize.is_available()):
        q_rad, header["solver"] = _improved(reference, q_rad, full, weights or optimize.TorqueWeights())
    elif solver == "auto":
        header["solver"]["note"] = (
            "Crocoddyl and Pinocchio are not installed, so the motion was found by inverse kinematics alone and its "
            "torques are not optimized; `pip install 'vid2demo[torque]'` adds that."
        )
    time_s = reference.time_s - reference.time_s[0]
    curve = JointCurve(time_s, q_rad)
    motion = [curve.at(time_s, order) for order in range(3)]
    # Torque is linear in the contents' mass, so every fill level lies between the empty and the full vessel.
    tau_empty, tau_full = (inverse_dynamics(arm, *motion) for arm in (empty_arm, full_arm))
    tau_nm = tau_empty + left[:, None] * (tau_full - tau_empty)
    position_m, rotation_rad = tracking_errors(reference, q_rad)
    if strict:
        _check_followed(reference, position_m, rotation_rad)
    width_m = float(reference.header.get("grasp", {}).get("width_m", 0.0))
    header |= {
        "control_hz": reference.control_hz,
        "position_error_m": {"mean": float(position_m.mean()), "max": float(position_m.max())},
        "rotation_error_rad": {"mean": float(rotation_rad.mean()), "max": float(rotation_rad.max())},
        "limit_margin_rad": limit_margin_rad(q_rad).min(axis=0).tolist(),
        "speed_part": (np.abs(motion[1]).max(axis=0) / DQ_MAX_RAD_S).tolist(),
        "payload_kg": full.mass_kg,
        "contents_kg": filled_kg,
    }
    gripper_m = np.full(len(time_s), min(0.5 * width_m, FINGER_MAX_M))
    return JointTrajectory(time_s, q_rad, motion[1], tau_nm, gripper_m, header)


def tracking_errors(reference: Reference, q_rad: Array) -> tuple[Array, Array]:
    """Distance (N,) in m and angle (N,) in rad between the held object at q (N, 7) and the reference.

    A turn that the object's symmetry hides is no error.
    """
    T = panda_chain().hand(q_rad) @ reference.T_hand_object
    position_m = np.linalg.norm(T[:, :3, 3] - reference.T_world_object[:, :3, 3], axis=1)
    return position_m, reference.symmetry.error_rad(T[:, :3, :3], reference.T_world_object[:, :3, :3])


def _improved(
    reference: Reference, q_warm_rad: Array, payload: Any, weights: optimize.TorqueWeights
) -> tuple[Array, dict[str, Any]]:
    """The motion of least cost near a warm start (N, 7), or the warm start where that is the better one."""
    best = q_warm_rad
    told: dict[str, Any] = {"name": "mink"}
    least = _faults(reference, q_warm_rad)
    # What is followed closely through its limits breaks them between the knots.
    for tried in (weights, weights.softened()):
        solved = optimize.optimize(reference, q_warm_rad, payload, tried)
        faults = _faults(reference, solved.q_rad)
        if faults < least or (faults == least and told["name"] == "mink"):
            best, least = solved.q_rad, faults
            told = {
                "name": "crocoddyl",
                "iterations": solved.iterations,
                "converged": solved.converged,
                "weights": asdict(tried),
            }
        if not any(faults):
            break
    if told["name"] == "mink":
        told["note"] = "The optimizer found no motion as good as inverse kinematics, which was kept."
    return best, told


def _faults(reference: Reference, q_rad: Array) -> tuple[bool, float]:
    """What makes a motion worse than another: the object is lost; by how much joints go beyond their limits."""
    position_m, rotation_rad = tracking_errors(reference, q_rad)
    lost = bool((position_m > LOST_M).any() or (rotation_rad > LOST_RAD).any())
    curve = JointCurve(reference.time_s - reference.time_s[0], q_rad)
    path = commanded(curve.at(curve.clock(1000.0)), np.zeros((2, 7)))
    return lost, sum(extreme.part - 1.0 for extreme in extremes(path) if extreme.broken)


def _check_followed(reference: Reference, position_m: Array, rotation_rad: Array) -> None:
    lost = (position_m > LOST_M) | (rotation_rad > LOST_RAD)
    if lost.any():
        times = reference.time_s[lost]
        raise UserError(
            f"the arm cannot follow the reference from {times.min():.1f} s to {times.max():.1f} s: it misses by up to "
            f"{position_m.max():.2f} m and {np.rad2deg(rotation_rad.max()):.0f} degrees; place it anew or choose a "
            "smaller --scale"
        )


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
