"""Retargeting as optimal control: joint torques that carry the object along a reference (FreePose, Eq. 4).

    min over tau of  sum_t  w_d |log(T_t^-1 T~_t)|^2 + w_dq |dq_t|^2 + w_tau |tau_t - g(q_t)|^2

solved by Crocoddyl's feasibility-driven dynamic programming on Pinocchio's rigid-body dynamics of the arm, the vessel
and its contents. Unlike inverse kinematics it sees the whole motion at once: it begins early what it could not do in
time, and what the tracker trembles costs it torque. How much a frame pulls, w_d, follows from how far it may be off:
by what the track trembles, which the track itself shows, and by what the tracker was unsure of the frame.

Limits of position, speed, acceleration and torque are soft barriers here. Jerk is no quantity of this problem: the
weights on torque and acceleration keep it at a few percent of its limit. Whoever uses the motion checks all of them
(`limits`, `check_trajectory`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..envs.kinematics import HAND_BODY
from ..envs.panda import (
    ARMATURE_KG_M2,
    DDQ_MAX_RAD_S2,
    DQ_MAX_RAD_S,
    FINGER_JOINTS,
    Q_MAX_RAD,
    Q_MIN_RAD,
    TAU_MAX_NM,
    urdf_path,
)
from ..extract.errors import UserError
from ..extract.geometry import Array

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from .dynamics import Payload

# What the hand weighs does not hang on where its fingers are; about where they hold a handle.
_FINGERS_M = 0.01
_N = 7
# Standard deviation of the fourth differences of numbers that scatter by 1, and what turns a median into it.
_FOURTH, _NORMAL = np.sqrt(70.0), 1.4826


@dataclass(frozen=True)
class TorqueWeights:
    """Weights of the cost, per second of motion. The paper gives none; `bench/retarget.py` shows what each trades.

    position_1_m2, rotation_1_rad2: w_d for the two halves of the logarithm where the track is exact and sure; a radian
        counts as 0.2 m.
    patience, unsure_m, unsure_rad: a frame that may be off by s pulls with 1 / (1 / w_d + patience s^2). s^2 is the
        square of the track's tremble plus that of `unsure_*` times what the frame's confidence lacks of 1.
    speed: w_dq in s^2/rad^2. torque: w_tau in 1/(N m)^2. acceleration: in s^4/rad^2, beyond the paper: torque alone
        lets the light wrist tremble, because that costs next to none. posture: in 1/rad^2, draws the redundancy to the
        warm start, whose collisions were looked at.
    end_ease: by how much speed, torque and posture count more where the arm starts and stops, faded over a quarter of
        a second.
    barrier: on what goes beyond `*_part` of the joints' limits, in the limits' own units.
    """

    position_1_m2: float = 2e6
    rotation_1_rad2: float = 8e4
    patience: float = 500.0
    unsure_m: float = 6e-4
    unsure_rad: float = 3e-3
    speed: float = 1e-2
    torque: float = 1e-3
    acceleration: float = 1e-3
    posture: float = 1.0
    end_ease: float = 100.0
    barrier: float = 1e3
    position_margin_rad: float = 0.015
    speed_part: float = 0.95
    acceleration_part: float = 0.9
    torque_part: float = 0.95
    iterations: int = 30

    def softened(self) -> TorqueWeights:
        """For a track that asks for more than the limits allow: it is followed less closely and ends less gently."""
        return replace(
            self,
            position_1_m2=self.position_1_m2 / 30.0,
            rotation_1_rad2=self.rotation_1_rad2 / 30.0,
            posture=self.posture / 10.0,
            end_ease=self.end_ease / 10.0,
        )


@dataclass(frozen=True)
class Optimized:
    """q_rad: (N, 7). tau_nm: (N - 1, 7) controls between the knots. cost; iterations; converged within them."""

    q_rad: Array
    tau_nm: Array
    cost: float
    iterations: int
    converged: bool


def is_available() -> bool:
    """Whether the extra `torque` is installed."""
    from importlib.util import find_spec

    return find_spec("crocoddyl") is not None and find_spec("pinocchio") is not None


def _libraries() -> tuple[Any, Any]:
    try:
        import crocoddyl
        import pinocchio
    except ImportError as error:
        raise UserError(
            "solving for torques needs Crocoddyl and Pinocchio, which are not installed; run "
            "`pip install 'vid2demo[torque]'` or retarget with --solver mink"
        ) from error
    return crocoddyl, pinocchio


def pinocchio_arm(payload: Payload, T_hand_object: Array, R_object_frame: Array | None = None) -> tuple[Any, int]:
    """Pinocchio's model of the arm with a payload, fingers fixed, and the number of the object's frame in it.

    It is made of the simulator's own description, with the rotors' inertia that the simulator gives the joints.
    R_object_frame: (3, 3) how that frame is turned from the object's own.
    """
    _, pinocchio = _libraries()
    model = pinocchio.buildModelFromUrdf(str(urdf_path()))
    q = pinocchio.neutral(model)
    q[_N:] = _FINGERS_M
    model = pinocchio.buildReducedModel(model, [model.getJointId(name) for name in FINGER_JOINTS], q)
    hand = model.frames[model.getFrameId(HAND_BODY)]
    placement = hand.placement * pinocchio.SE3(np.asarray(T_hand_object, float))
    body = pinocchio.Inertia(payload.mass_kg, payload.center_m, np.diag(payload.inertia_kg_m2))
    model.appendBodyToJoint(hand.parentJoint, body, placement)
    model.armature = np.full(_N, ARMATURE_KG_M2)
    turned = placement if R_object_frame is None else placement * pinocchio.SE3(R_object_frame, np.zeros(3))
    frame = pinocchio.Frame("object", hand.parentJoint, turned, pinocchio.FrameType.OP_FRAME)
    return model, int(model.addFrame(frame))


def optimize(
    reference: Reference, q_warm_rad: Array, payload: Payload, weights: TorqueWeights | None = None
) -> Optimized:
    """The motion of least cost that begins, at rest, where the warm start (N, 7) does.

    Frames pull as `pull_of` says. The turn about an axis of continuous symmetry, which nobody
    sees, is left to the optimizer. Limits are barriers here; whoever uses the motion must check them. Raises UserError
    when the extra `torque` is not installed.
    """
    crocoddyl, pinocchio = _libraries()
    weights = weights or TorqueWeights()
    # The logarithm's last component is to be the turn about the symmetry axis.
    R, _ = Rotation.align_vectors([reference.symmetry.axis], [(0.0, 0.0, 1.0)])
    R_object_frame = R.as_matrix()
    model, frame = pinocchio_arm(payload, reference.T_hand_object, R_object_frame)
    count, step_s = len(reference), 1.0 / reference.control_hz
    speed = np.diff(q_warm_rad, axis=0, prepend=q_warm_rad[:1]) / step_s
    turn = pinocchio.SE3(R_object_frame, np.zeros(3))
    targets = [pinocchio.SE3(T) * turn for T in reference.T_world_object]
    problem = _Problem(crocoddyl, model, frame, targets, reference, weights)
    stages = [problem.stage(k, q_warm_rad[k]) for k in range(count)]
    states = [np.concatenate(pair) for pair in zip(q_warm_rad, speed, strict=True)]
    bend = np.diff(speed, axis=0) / step_s
    data = model.createData()
    controls = [pinocchio.rnea(model, data, q_warm_rad[k], speed[k], bend[k]) for k in range(count - 1)]
    solver = crocoddyl.SolverFDDP(crocoddyl.ShootingProblem(states[0], stages[:-1], stages[-1]))
    solver.th_stop = 1e-6
    converged = solver.solve(states, controls, weights.iterations, False)
    q_rad = np.array(solver.xs)[:, :_N]
    return Optimized(q_rad, np.array(solver.us), float(solver.cost), int(solver.iter), bool(converged))


def tremble_of(reference: Reference) -> tuple[float, float]:
    """By how much the poses scatter about a smooth motion, from knot to knot and along each axis: m and rad.

    Fourth differences of what a hand does are next to nothing, those of white noise are large. Their median tells it
    without being misled by a few hasty moments.
    """
    T = reference.T_world_object
    turn_rad = Rotation.from_matrix(T[1:, :3, :3] @ np.swapaxes(T[:-1, :3, :3], 1, 2)).as_rotvec()
    bends = np.diff(T[:, :3, 3], n=4, axis=0), np.diff(turn_rad, n=3, axis=0)
    m, rad = (_NORMAL / _FOURTH * float(np.median(np.abs(bend))) if len(bend) else 0.0 for bend in bends)
    return m, rad


def pull_of(reference: Reference, weights: TorqueWeights) -> Array:
    """(N, 2) w_d of each knot for position in 1/m^2 and rotation in 1/rad^2."""
    lacking = 1.0 - np.clip(reference.confidence, 0.0, 1.0)
    columns = []
    for most, tremble, unsure in zip(
        (weights.position_1_m2, weights.rotation_1_rad2),
        tremble_of(reference),
        (weights.unsure_m, weights.unsure_rad),
        strict=True,
    ):
        variance = tremble**2 + (unsure * lacking) ** 2
        columns.append(1.0 / (1.0 / most + weights.patience * variance))
    return np.column_stack(columns)


class _Problem:
    """The cost models of all knots; what does not change from knot to knot is shared among them."""

    def __init__(
        self, crocoddyl: Any, model: Any, frame: int, targets: list[Any], reference: Reference, weights: TorqueWeights
    ) -> None:
        self._c, self._frame, self._targets, self._weights = crocoddyl, frame, targets, weights
        self._state = crocoddyl.StateMultibody(model)
        self._actuation = crocoddyl.ActuationModelFull(self._state)
        self._step_s, self._last = 1.0 / reference.control_hz, len(reference) - 1
        self._pull = np.repeat(pull_of(reference, weights), 3, axis=1)
        if reference.symmetry.order == 0:
            self._pull[:, 5] = 0.0
        self._posture = crocoddyl.ActivationModelWeightedQuad(
            np.concatenate([np.full(_N, weights.posture), np.full(_N, weights.speed)])
        )
        self._effort = self._cost(crocoddyl.ResidualModelControlGrav(self._state, _N))
        self._bend = self._cost(crocoddyl.ResidualModelJointAcceleration(self._state, _N))
        self._barriers = self._make_barriers()

    def stage(self, knot: int, q_warm_rad: Array) -> Any:
        """The action model of one knot."""
        c, weights, costs = self._c, self._weights, self._c.CostModelSum(self._state, _N)
        to_end_s = min(knot, self._last - knot) * self._step_s
        ease = 1.0 + weights.end_ease * max(0.0, 1.0 - to_end_s / 0.25) ** 2
        pose = c.ResidualModelFramePlacement(self._state, self._frame, self._targets[knot], _N)
        still = c.ResidualModelState(self._state, np.concatenate([q_warm_rad, np.zeros(_N)]), _N)
        costs.addCost("pose", self._cost(pose, c.ActivationModelWeightedQuad(self._pull[knot])), 1.0)
        costs.addCost("posture", self._cost(still, self._posture), ease)
        state_barrier, *control_barriers = self._barriers
        costs.addCost("state limits", state_barrier, weights.barrier * 100.0)
        if knot < self._last:
            costs.addCost("effort", self._effort, weights.torque * ease)
            costs.addCost("bend", self._bend, weights.acceleration * ease)
            for number, barrier in enumerate(control_barriers):
                costs.addCost(f"limits {number}", barrier, weights.barrier)
        dynamics = c.DifferentialActionModelFreeFwdDynamics(self._state, self._actuation, costs)
        return c.IntegratedActionModelEuler(dynamics, self._step_s if knot < self._last else 0.0)

    def _cost(self, residual: Any, activation: Any | None = None) -> Any:
        arguments = (residual,) if activation is None else (activation, residual)
        return self._c.CostModelResidual(self._state, *arguments)

    def _make_barriers(self) -> list[Any]:
        """On position and speed, acceleration, torque."""
        c, weights = self._c, self._weights
        margin = np.full(_N, weights.position_margin_rad)
        low = np.concatenate([Q_MIN_RAD + margin, -weights.speed_part * DQ_MAX_RAD_S])
        high = np.concatenate([Q_MAX_RAD - margin, weights.speed_part * DQ_MAX_RAD_S])

        def barrier(low: Array, high: Array, residual: Any) -> Any:
            return self._cost(residual, c.ActivationModelQuadraticBarrier(c.ActivationBounds(low, high)))

        most = weights.acceleration_part * DDQ_MAX_RAD_S2
        strongest = weights.torque_part * TAU_MAX_NM
        return [
            barrier(low, high, c.ResidualModelState(self._state, np.zeros(2 * _N), _N)),
            barrier(-most, most, c.ResidualModelJointAcceleration(self._state, _N)),
            barrier(-strongest, strongest, c.ResidualModelControl(self._state, _N)),
        ]
