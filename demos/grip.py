"""Could the fingers hold the vessel by friction alone, all along a motion? What they must bear, over what they can."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.grip import GRAVITY_M_S2, part_of_grip
from ..envs.kinematics import panda_chain
from ..envs.panda import FINGER_MAX_N, FINGER_PEAK_N
from ..envs.reference import twist_of
from ..extract.geometry import Array
from .dynamics import Payload

if TYPE_CHECKING:
    from .joints import JointTrajectory


@dataclass(frozen=True)
class Grip:
    """Where the hold is nearest to giving way: part of what it can bear, when, and what it bears there.

    force_n: along the pads. moment_nm: about the line between them. other_nm: about any other line.
    """

    part: float
    time_s: float
    force_n: float
    moment_nm: float
    other_nm: float

    def sentence(self) -> str:
        """What that means, for a person."""
        told = (
            f"{self.force_n:.0f} N along the pads, {self.moment_nm:.2f} N m about the line between them and "
            f"{self.other_nm:.2f} N m across it at {self.time_s:.1f} s, {100 * self.part:.0f}% of what "
            f"{FINGER_MAX_N:.0f} N a finger hold"
        )
        if self.part <= 1.0:
            return f"Friction alone should hold the vessel: {told}."
        needed_n = FINGER_MAX_N * self.part
        if needed_n <= FINGER_PEAK_N:
            told += f"; it takes {needed_n:.0f} N, which the hand can press with, but not keep up"
        return f"Friction alone may let the vessel slip or turn in the fingers: {told}."

    def told(self) -> dict[str, Any]:
        """The figures (JSON-like)."""
        return {
            "part": self.part,
            "at_s": self.time_s,
            "force_n": self.force_n,
            "moment_nm": self.moment_nm,
            "other_nm": self.other_nm,
        }


def grip_of(joints: JointTrajectory, T_hand_object: Array, payload: Payload, width_m: float, flat: bool) -> Grip:
    """The hardest moment for the fingers of a joint motion with a payload at `T_hand_object` (4, 4).

    width_m: of what is between the fingers. flat: whether their pads lie on a wall, and not on a handle.
    """
    T_hand = panda_chain().hand(joints.q_rad)
    R = T_hand[:, :3, :3]
    center_m = T_hand_object[:3, :3] @ payload.center_m + T_hand_object[:3, 3]
    twist = twist_of(T_hand, joints.time_s)
    turning = np.gradient(twist[:, 3:], joints.time_s, axis=0)
    path_m = T_hand[:, :3, 3] + R @ center_m
    bend = np.gradient(np.gradient(path_m, joints.time_s, axis=0), joints.time_s, axis=0)
    force = payload.mass_kg * (bend - GRAVITY_M_S2)
    R_object = R @ T_hand_object[:3, :3]
    inertia = R_object @ np.diag(payload.inertia_kg_m2) @ np.swapaxes(R_object, 1, 2)
    spin = np.einsum("nij,nj->ni", inertia, twist[:, 3:])
    moment = np.einsum("nij,nj->ni", inertia, turning) + np.cross(twist[:, 3:], spin) + np.cross(R @ center_m, force)
    # In the hand's frame, whose fingers close along y.
    force, moment = (np.einsum("nji,nj->ni", R, value) for value in (force, moment))
    part = part_of_grip(force, moment, width_m, flat)
    worst = int(np.argmax(part))
    x, y, z = np.abs(moment[worst])
    along_n = np.hypot(force[worst, 0], force[worst, 2])
    return Grip(float(part[worst]), float(joints.time_s[worst]), float(along_n), float(y), float(np.hypot(x, z)))
