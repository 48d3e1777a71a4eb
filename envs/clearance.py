"""Does the held vessel run into the receptacle? By the walls' true shapes: hulls would fill spouts' and rims' gaps."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..extract.geometry import Array, invert_pose, transform_points
from .receptacle import surface_points
from .vessel_geometry import cavity_of

if TYPE_CHECKING:
    from ..extract.vessels import Vessel


class _Wall:
    """What a vessel's body is made of: all inside its outer surface that is not its hollow."""

    def __init__(self, vessel: Vessel) -> None:
        self._hollow = cavity_of(vessel)
        self._solid = cavity_of(replace(vessel, interior=vessel.exterior))
        self.points_m = surface_points(vessel)
        self.reach_m = float(np.linalg.norm(self.points_m, axis=1).max())

    def depth_m(self, points_m: Array) -> float:
        """How deep the deepest of points (N, 3), in the vessel's frame, stands in the wall, seen from outside."""
        low, high = self._solid.z_m[0], self._solid.z_m[-1]
        near = points_m[(points_m[:, 2] > low) & (points_m[:, 2] < high)]
        if len(near) == 0:
            return 0.0
        depth_m = self._solid.clearance_m(near)
        depth_m[self._hollow.clearance_m(near) >= 0.0] = 0.0
        return max(float(depth_m.max()), 0.0)


def overlaps_m(held: Vessel, receptacle: Vessel, T_world_held: Array, T_world_receptacle: Array) -> Array:
    """(N,) how deep held vessel and receptacle (4, 4) stand in each other's walls, for poses (N, 4, 4) of the first.

    Looked at are 1500 points of either surface, so what is thinner than half a centimetre may be missed by as much.
    """
    walls = _Wall(held), _Wall(receptacle)
    T_receptacle_held = invert_pose(T_world_receptacle) @ T_world_held
    out = np.zeros(len(T_world_held))
    within_m = walls[0].reach_m + walls[1].reach_m
    for k in np.flatnonzero(np.linalg.norm(T_receptacle_held[:, :3, 3], axis=1) < within_m):
        T = T_receptacle_held[k]
        out[k] = max(
            walls[1].depth_m(transform_points(T, walls[0].points_m)),
            walls[0].depth_m(transform_points(invert_pose(T), walls[1].points_m)),
        )
    return out
