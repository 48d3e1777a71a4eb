"""What two pressing fingers bear by friction alone: the limit surface of a hold, and how much of it a weight takes.

Two pads press from both sides. What pulls along them, and what turns the vessel about the line between them, is borne
by friction; together these fill the ellipse of a limit surface (Howe and Cutkosky, 1996). That line is the weak one:
the pads are small. What turns the vessel about any other line meets the pads as a pair, the vessel's width apart; where
they lie flat on a wall, the pressure moves to their edges as well. Handles are round, and touch them along a line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..extract.geometry import Array, invert_pose
from .panda import FINGER_MAX_N, FINGER_PEAK_N, PAD_M

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

GRAVITY_M_S2 = np.array([0.0, 0.0, -9.81])
# Sliding friction of rubber, and its resistance to turning on the spot in m: two thirds of the radius of a patch as
# wide as a pad. Rolling is resisted by the several points at which pads touch.
RUBBER = [1.0, 0.006, 0.0]
# Part of the grip that a weight may take at rest; the rest is for haste.
HOLDS = 0.95
# Mean distance of a square patch's points from its middle, over its side: what its friction turns at.
_SQUARE = 0.3826
_PAD_HALF_M = float(PAD_M[1][0])
PAD_RADIUS_M = 2.0 * _SQUARE * _PAD_HALF_M
BOTH_N = 2.0 * FINGER_MAX_N * RUBBER[0]


def part_of_grip(force_n: Array, moment_nm: Array, width_m: float, flat: bool) -> Array:
    """(N,) part of what the fingers can bear that forces and moments (N, 3) on the vessel take; above 1 it slips.

    Both are seen from the hand, at its tcp; the fingers press with `FINGER_MAX_N` and close along y. width_m: between
    the pads. flat: whether they lie on a wall, and not on a handle.
    """
    along_n = np.hypot(force_n[:, 0], force_n[:, 2])
    lever_m = width_m + (2.0 * _PAD_HALF_M / RUBBER[0] if flat else 0.0)
    pair_n = 2.0 * np.hypot(moment_nm[:, 0], moment_nm[:, 2]) / max(lever_m, PAD_RADIUS_M)
    return np.asarray(np.hypot(along_n + pair_n, moment_nm[:, 1] / PAD_RADIUS_M) / BOTH_N)


def center_of_mass_m(vessel: Vessel, contents_kg: float) -> Array:
    """(3,) of a vessel with contents at its origin, in its own frame."""
    return np.asarray(vessel.mesh.center_mass) * float(vessel.mass_kg) / (float(vessel.mass_kg) + contents_kg)


def weight_part(
    vessel: Vessel, contents_kg: float, T_object: Array, T_hand_object: Array, width_m: float, flat: bool
) -> float:
    """The greatest part of the grip that the vessel's weight takes in attitudes (N, 4, 4), z up, held at rest."""
    R_object_hand = invert_pose(T_hand_object)[:3, :3]
    weight_n = (float(vessel.mass_kg) + contents_kg) * GRAVITY_M_S2
    force_n = np.einsum("nji,j->ni", T_object[:, :3, :3] @ R_object_hand, weight_n)
    center_m = T_hand_object[:3, :3] @ center_of_mass_m(vessel, contents_kg) + T_hand_object[:3, 3]
    return float(part_of_grip(force_n, np.cross(center_m, force_n), width_m, flat).max())


def pressing_n(part: float) -> float:
    """What each finger presses with for a weight that takes this part of the grip: more than usual only if it must.

    The usual is the force that the datasheet calls continuous. Up to the maximum force is lent to simulated pours by
    heavy vessels, though nobody states how long a real hand may keep that up: reports say which pours need it.
    """
    return float(np.clip(FINGER_MAX_N * part / HOLDS, FINGER_MAX_N, FINGER_PEAK_N))
