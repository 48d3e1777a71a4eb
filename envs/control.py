"""Control modes: the action space of each, and how an action becomes the commands of one control period.

Targets of the joints move no faster than the joints may and stay inside their limits, whatever is asked for; a period's
commands go straight from the last target to the new one, ahead by what the servos lag.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from .kernels import ramp
from .kinematics import panda_chain, solve_ik
from .observations import Entry
from .panda import ARM_JOINTS, DQ_MAX_RAD_S, Q_MAX_RAD, Q_MIN_RAD, SERVO_LEAD_S, TAU_MAX_NM

CONTROL_MODES = ("joint_position", "joint_delta", "ee_delta", "torque")
# Speed limits of the hand in the robot's datasheet, in every direction: an action of 1 period asks for no more.
HAND_MAX_M_S, HAND_MAX_RAD_S = 1.7, 2.5
_AXES = ("x", "y", "z")


def action_entries(mode: str, control_hz: float) -> tuple[Entry, ...]:
    """Name, unit, frame and range of every entry of a mode's actions."""
    if mode == "joint_position":
        return tuple(
            Entry(name, "rad", "joint", float(low), float(high), "joint target at the end of the step")
            for name, low, high in zip(ARM_JOINTS, Q_MIN_RAD, Q_MAX_RAD, strict=True)
        )
    if mode == "joint_delta":
        return tuple(
            Entry(f"{name}_delta", "rad", "joint", -float(most), float(most), "change of the joint target")
            for name, most in zip(ARM_JOINTS, DQ_MAX_RAD_S / control_hz, strict=True)
        )
    if mode == "ee_delta":
        far_m, turn_rad = HAND_MAX_M_S / control_hz, HAND_MAX_RAD_S / control_hz
        return (
            *(Entry(f"hand_{a}", "m", "world", -far_m, far_m, "shift of the hand's target") for a in _AXES),
            *(Entry(f"hand_turn_{a}", "rad", "world", -turn_rad, turn_rad, "its rotation vector") for a in _AXES),
        )
    return tuple(
        Entry(f"{name}_torque", "Nm", "joint", -float(most), float(most), "torque besides gravity's compensation")
        for name, most in zip(ARM_JOINTS, TAU_MAX_NM, strict=True)
    )


@dataclass(frozen=True)
class ControlState:
    """target: (7,) joint targets in rad, or torques in Nm; rate: (7,) their last change per second."""

    target: Array
    rate: Array


class Control:
    """One control mode; its state is the last target and how fast it moved."""

    def __init__(self, mode: str, control_hz: float, substeps: int) -> None:
        self.mode, self._hz = mode, control_hz
        self.entries = action_entries(mode, control_hz)
        low, high = (np.array([getattr(entry, side) for entry in self.entries]) for side in ("low", "high"))
        self.space = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self._low, self._high = low, high
        self._delta_rad = DQ_MAX_RAD_S / control_hz
        self._lead = SERVO_LEAD_S * control_hz
        self._commands = np.empty((substeps, 7))
        self.state = ControlState(np.zeros(7), np.zeros(7))

    @property
    def actuation(self) -> Literal["servo", "torque"]:
        """What the scene's motors must be: "servo" or "torque"."""
        return "torque" if self.mode == "torque" else "servo"

    def reset(self, q_rad: Array, rate_rad_s: Array) -> None:
        """Begin with joint targets (7,) and their velocity; with no torque in torque mode."""
        if self.mode == "torque":
            self.state = ControlState(np.zeros(7), np.zeros(7))
        else:
            self.state = ControlState(np.array(q_rad, np.float64), np.array(rate_rad_s, np.float64))

    def advance(self, action: NDArray[Any]) -> tuple[Array, float]:
        """Commands (substeps, 7) of the next period, valid until the next call, and the action's jerkiness.

        Jerkiness is the mean square change of the target's rate since the last step, over twice the limits of
        speed; for torques, of the torque over twice the limits. Raises UserError for a malformed action.
        """
        action = np.asarray(action, np.float64)
        if action.shape != self._low.shape or not np.isfinite(action).all():
            names = ", ".join(entry.name for entry in self.entries)
            raise UserError(f"the action must be {len(self._low)} finite numbers ({names}), got {action!r}")
        last = self.state
        if self.mode == "torque":
            target = np.minimum(np.maximum(action, self._low), self._high)
            change = (target - last.target) / (2 * TAU_MAX_NM)
            self.state = ControlState(target, change)
            self._commands[:] = target
            return self._commands, float(change @ change) / 7
        target, rate = last.target.copy(), last.rate.copy()
        wanted = self._wanted(action)
        jerk = ramp(target, rate, wanted, self._delta_rad, Q_MIN_RAD, Q_MAX_RAD, self._hz, self._lead, self._commands)
        self.state = ControlState(target, rate)
        return self._commands, jerk

    def _wanted(self, action: Array) -> Array:
        target = self.state.target
        if self.mode == "joint_position":
            return action
        action = np.minimum(np.maximum(action, self._low), self._high)
        return target + action if self.mode == "joint_delta" else self._moved_hand(action)

    def _moved_hand(self, action: Array) -> Array:
        """Joint targets whose hand is shifted and turned by an action; as near as limits and singularities allow."""
        from scipy.spatial.transform import Rotation

        T = panda_chain().hand(self.state.target[None])[0]
        T[:3, :3] = Rotation.from_rotvec(action[3:]).as_matrix() @ T[:3, :3]
        T[:3, 3] += action[:3]
        q, _ = solve_ik(T[None], self.state.target[None], iterations=3, rest_gain=0.0, damping=0.01, margin_rad=0.0)
        way = q[0] - self.state.target
        # Slower as a whole, not joint by joint: the hand keeps its direction.
        return np.asarray(self.state.target + way / max(1.0, float(np.max(np.abs(way) / self._delta_rad))))
