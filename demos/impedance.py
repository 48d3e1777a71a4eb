"""Playing a joint motion in an environment so that the object, not just the arm, goes where the reference says.

Joint impedance with feed-forward torques, closed over the object's pose. The environment's servos pull with stiffness K
and damping D toward a target moving as the commands do; a target ahead of the motion by K^-1 tau makes them exert the
torques tau that the motion asks for, so that the stiffness only has to answer what was not foreseen. Once a control
period the object's remaining error, seen through its Jacobian, moves the target a little further.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..envs.kinematics import hand_jacobian, panda_chain, pose_error
from ..envs.panda import STIFFNESS_NM_RAD
from ..envs.reference import Reference
from ..envs.scene import VESSEL_BODY
from ..extract.geometry import Array
from .dynamics import Payload, arm_with, inverse_dynamics, payload_of
from .joints import JointTrajectory
from .rollout import Info, Observation

# Part of the error that a period's correction takes away; the arm answers within one or two.
GAIN = 0.3
# A correction is no motion of its own: at most so much a period, and none for an object that has been dropped.
MOST_RAD, DROPPED_M = 0.02, 0.1
_DAMPING = 0.01


class ImpedancePlayer:
    """Plays joint motions of an episode's reference, closed over the object's pose.

    For environments controlled by absolute joint positions.
    """

    def __init__(self, joints: JointTrajectory | None = None, *, gain: float = GAIN) -> None:
        """joints: the motion to play; retargeted from the reference of each episode if None. gain: 0 is open loop."""
        self._given, self._gain = joints, gain

    def reset(self, env: Any, observation: Observation, info: Info) -> None:
        """Raises UserError when the arm cannot follow this episode's reference."""
        from .retarget import retarget

        self._env, self._space = env.unwrapped, env.action_space
        self._reference: Reference = self._env.reference
        joints = self._given or retarget(self._reference)
        self._targets = joints.q_rad + self._unanswered_nm(joints) / STIFFNESS_NM_RAD
        self._correction_rad: Array = np.zeros(7)
        self._step = 0

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """Joint targets (7,) for the end of the period."""
        last = len(self._reference) - 1
        self._correct(min(self._step, last), np.asarray(observation["agent_pos"][:7], float))
        self._step += 1
        target = self._targets[min(self._step, len(self._targets) - 1)] + self._correction_rad
        inside: NDArray[np.float32] = np.clip(target, self._space.low, self._space.high).astype(np.float32)
        return inside

    def _correct(self, knot: int, q_rad: Array) -> None:
        T, wanted = self._env.T_world_object, self._reference.T_world_object[knot]
        error = pose_error(T[None], wanted[None])[0]
        symmetry = self._reference.symmetry
        if symmetry.order == 0:
            # The smallest turn that brings the axes together: about the axis itself there is nothing to mend.
            error[3:] = np.cross(T[:3, :3] @ symmetry.axis, wanted[:3, :3] @ symmetry.axis)
        if np.linalg.norm(error[:3]) > DROPPED_M:
            return
        frames = panda_chain().frames(q_rad)
        J = hand_jacobian(frames)[0]
        # Of the object's origin, which the hand may not hold where it was to.
        J[:3] += np.cross(J[3:].T, T[:3, 3] - frames[0, 7, :3, 3]).T
        step = self._gain * np.linalg.solve(J.T @ J + _DAMPING**2 * np.eye(7), J.T @ error)
        self._correction_rad += step * min(1.0, MOST_RAD / max(float(np.abs(step).max()), 1e-12))

    def _unanswered_nm(self, joints: JointTrajectory) -> Array:
        """(N, 7) torques of the motion that the environment's compensation of gravity does not bring by itself."""
        model = self._env.model
        compensated = float(model.body_gravcomp[model.body(VESSEL_BODY).id]) > 0.0
        nothing = Payload(1e-6, np.zeros(3), np.full(3, 1e-9))
        arm = arm_with(payload_of(self._reference) if compensated else nothing, self._reference.T_hand_object)
        still = np.zeros_like(joints.q_rad)
        return joints.tau_nm - inverse_dynamics(arm, joints.q_rad, still, still)
