"""Could the fingers hold the vessel by friction alone, all along a motion? What they must bear, over what they can.

The measure is the force that the hand keeps up by its datasheet, 70 N a finger. The simulator presses harder where the
weight asks for it, up to the 140 N that the hand has at most. For how long a real one may do so is not stated: a pour
that needs it is said to, and what comes of it in the simulator is the best case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.diverged import PhysicsError
from ..envs.grip import GRAVITY_M_S2, part_of_grip
from ..envs.kinematics import panda_chain
from ..envs.panda import FINGER_JOINTS, FINGER_MAX_N, FINGER_PEAK_N
from ..envs.reference import twist_of
from ..extract.errors import UserError
from ..extract.geometry import Array
from .dynamics import Payload
from .impedance import ImpedancePlayer
from .rollout import DEFAULT_ENV_ID, make_env, roll_out

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from .joints import JointTrajectory

PARTICLES = 60


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


@dataclass(frozen=True)
class Slip:
    """How far a vessel held by friction moved in the fingers on its way, and what each of them pressed with."""

    distance_m: float
    angle_rad: float
    pressing_n: float

    def sentence(self) -> str:
        """What came of it, for a person."""
        kept = "which the hand keeps up" if self.pressing_n <= FINGER_MAX_N else "more than the hand keeps up"
        return (
            f"In a friction grasp of {self.pressing_n:.0f} N a finger, {kept}, it slips by about "
            f"{1000 * self.distance_m:.1f} mm and turns by {np.rad2deg(self.angle_rad):.0f} degrees in the simulator."
        )

    def told(self) -> dict[str, Any]:
        """The figures (JSON-like)."""
        return {"slip_m": self.distance_m, "slip_rad": self.angle_rad, "pressing_n": self.pressing_n}


def slip_of(reference: Reference, joints: JointTrajectory) -> Slip | None:
    """The motion carried out once with the vessel held by friction; None where the fingers cannot close on it."""
    try:
        env = make_env(
            DEFAULT_ENV_ID,
            reference,
            num_particles=PARTICLES,
            grasp="friction",
            control_mode="joint_position",
            control_hz=reference.control_hz,
        )
    except UserError:
        return None
    found: list[tuple[float, float]] = []

    def note(step: int, action: Any, observation: Any, reward: float, info: Any) -> None:
        found.append((info["slip_m"], info["slip_rad"]))

    try:
        roll_out(env, ImpedancePlayer(joints), seed=0, on_step=note)
        pressing_n = float(env.unwrapped.simulation.model.actuator(FINGER_JOINTS[0]).forcerange[1])
    except PhysicsError:
        return None
    finally:
        env.close()
    distance_m, angle_rad = np.max(found, axis=0)
    return Slip(float(distance_m), float(angle_rad), pressing_n)


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
