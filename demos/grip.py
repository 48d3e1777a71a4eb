"""Could the fingers hold the vessel by friction alone, all along a motion? What they must bear, over what they can.

Two pads press from both sides. Friction carries what pulls along them and what turns the vessel about the line between
them; together these fill the ellipse of a limit surface (Howe and Cutkosky, 1996). It is that turn which tips a heavy
vessel out of a hold: its weight acts at an arm's length from the pads, and the pads are small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.holding import RUBBER
from ..envs.kinematics import panda_chain
from ..envs.panda import FINGER_MAX_N, PAD_M
from ..envs.reference import twist_of
from ..extract.geometry import Array
from .dynamics import Payload

if TYPE_CHECKING:
    from .joints import JointTrajectory

GRAVITY_M_S2 = np.array([0.0, 0.0, -9.81])
# Mean distance of a square patch's points from its middle, over its side: what its friction turns at.
_SQUARE = 0.3826
PAD_RADIUS_M = 2.0 * _SQUARE * float(PAD_M[1][0])


@dataclass(frozen=True)
class Grip:
    """Where the hold is nearest to giving way: part of what it can bear, when, and what it bears there.

    force_n: along the pads. moment_nm: about the line between them.
    """

    part: float
    time_s: float
    force_n: float
    moment_nm: float

    def sentence(self) -> str:
        """What that means, for a person."""
        told = (
            f"{self.force_n:.0f} N along the pads and {self.moment_nm:.2f} N m about them at {self.time_s:.1f} s, "
            f"{100 * self.part:.0f}% of what {FINGER_MAX_N:.0f} N a finger hold"
        )
        if self.part <= 1.0:
            return f"Friction alone should hold the vessel: {told}."
        return f"Friction alone may let the vessel slip or turn in the fingers: {told}."

    def told(self) -> dict[str, Any]:
        """The figures (JSON-like)."""
        return {"part": self.part, "at_s": self.time_s, "force_n": self.force_n, "moment_nm": self.moment_nm}


def grip_of(joints: JointTrajectory, T_hand_object: Array, payload: Payload) -> Grip:
    """The hardest moment for the fingers of a joint motion with a payload at `T_hand_object` (4, 4)."""
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
    along_n, about_nm = np.hypot(force[:, 0], force[:, 2]), np.abs(moment[:, 1])
    both_n = 2.0 * FINGER_MAX_N * RUBBER[0]
    part = np.hypot(along_n / both_n, about_nm / (both_n * PAD_RADIUS_M))
    worst = int(np.argmax(part))
    return Grip(float(part[worst]), float(joints.time_s[worst]), float(along_n[worst]), float(about_nm[worst]))
