"""The same motion with another vessel in the hand, or another receptacle to pour into."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..extract.geometry import Array
from .jet import filling_kg
from .reference import Reference, vessel_to_header

if TYPE_CHECKING:
    from ..extract.vessels import Vessel


def with_receptacle(reference: Reference, receptacle: Vessel) -> Reference:
    """Another receptacle on the same spot; the pour is raised or lowered by what its rim is higher or lower."""
    old, T = reference.receptacle(), reference.T_world_receptacle.copy()
    rise_m = float(receptacle.extents_m[2] - old.extents_m[2])
    rim_m = rise_m / 2 + float(receptacle.interior.z_m[-1] - old.interior.z_m[-1])
    T[2, 3] += rise_m / 2
    moved = _moved(reference, np.zeros(3), np.array([0.0, 0.0, rim_m]))
    return moved.with_header(receptacle={**vessel_to_header(receptacle), "T_world_receptacle": T.tolist()})


def with_vessel(reference: Reference, vessel: Vessel) -> Reference:
    """Another vessel in the hand: it begins on the same ground, and its outlet pours from the same place.

    A new grasp is chosen. Raises UserError when no grasp carries it along the motion.
    """
    from .builtin import reachable_grasp

    old = reference.vessel()
    lift_m = np.array([0.0, 0.0, float(vessel.extents_m[2] - old.extents_m[2]) / 2])
    R_pour = reference.T_world_object[reference.pour_index, :3, :3]
    shift_m = R_pour @ (np.asarray(old.outlet.point_m, float) - np.asarray(vessel.outlet.point_m, float))
    moved = _moved(reference, lift_m, shift_m)
    contents_kg = filling_kg(vessel, reference.receptacle() if reference.has_receptacle else None)
    grasp, q_start_rad = reachable_grasp(vessel, moved.T_world_object, contents_kg)
    return moved.with_header(
        vessel=vessel_to_header(vessel),
        symmetry=vessel.symmetry.to_json(),
        T_hand_object=grasp.T_hand_object.tolist(),
        grasp=grasp.told(),
        q_start_rad=q_start_rad.tolist(),
    )


def _moved(reference: Reference, start_m: Array, pour_m: Array) -> Reference:
    """The path moved by `start_m` at its start, fading into `pour_m` at the greatest tilt, all else as it was."""
    header = {name: value for name, value in reference.header.items() if name != "receptacle"}
    without = reference.with_header(receptacle=None) if "receptacle" in reference.header else reference
    moved = without.warped(tuple(start_m), tuple(pour_m))
    if "receptacle" in reference.header:
        header = {**moved.header, "receptacle": reference.header["receptacle"]}
        return moved.with_header(**header)
    return moved
