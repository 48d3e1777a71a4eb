"""`FastLiquid`: the particles as position-based dynamics, several times faster than as bodies of the engine.

Spheres of one mass, moved by gravity and drag, kept apart and behind the walls by projecting their positions onto what
does not overlap; velocities follow from the positions (PBD: Müller et al. 2007, "Position Based Dynamics"; contacts and
friction as in Macklin et al. 2014, "Unified Particle Physics for Real-Time Applications"; substeps with one sweep each:
Macklin et al. 2019, "Small Steps in Physics Simulation"). Overlaps that are left over are undone slowly, so that no
energy comes from them: blows are inelastic, as the engine's are.

Walls are the boxes and cylinders that the engine has as geoms. They are looked up in a grid in the frame of the vessel
that they belong to, where they do not move.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..extract.errors import UserError
from ..extract.geometry import Array
from . import fast_liquid_kernels as kernels
from .fast_liquid_walls import walls_of
from .liquid import Liquid
from .vessel_geometry import Box

# Substeps of a step: the deeper the pile, the more sweeps carry its weight. With fewer, the lowest of 500 particles in
# a beaker are squeezed into each other.
MIN_SUBSTEPS, PARTICLES_PER_SUBSTEP = 3, 50
# The vessel feels the particles' push through a filter of this time constant: a step's blows are not smooth.
FILTER_S = 0.01


class FastLiquid:
    """Particles in a held vessel, a receptacle and a surrounding that stands still.

    positions_m, velocities_m_s: (N, 3) in the world, may be written to between steps. wrench: (6,) what the particles
    put on the held vessel, filtered: force in N, torque about its origin in N m, world axes.
    poses: (3, 2, 4, 4) of vessel, receptacle and surrounding, before and after a step. arguments: of `kernels.advance`.
    """

    def __init__(
        self,
        vessel_boxes: list[Box],
        receptacle_boxes: list[Box],
        static_shapes: list[Box],
        count: int,
        radius_m: float,
        liquid: Liquid,
        timestep_s: float,
    ) -> None:
        """Boxes in the frames of their vessels, static shapes in the world. A step lasts `timestep_s`."""
        if count < 1:
            raise UserError(f"a liquid of {count} particles cannot be simulated; give 1 or more")
        self.radius_m, self.timestep_s = radius_m, timestep_s
        self.positions_m: Array = np.zeros((count, 3))
        self.velocities_m_s: Array = np.zeros((count, 3))
        self.wrench: Array = np.zeros(6)
        mass_kg = liquid.particle_mass_kg(radius_m)
        taken = -math.expm1(-timestep_s / FILTER_S)
        substeps = max(MIN_SUBSTEPS, 1 + count // PARTICLES_PER_SUBSTEP)
        self._numbers = (radius_m, timestep_s, mass_kg, liquid.friction, liquid.drag_1_s, taken, substeps)
        self._walls = walls_of([vessel_boxes, receptacle_boxes, static_shapes], radius_m)
        self.poses: Array = np.tile(np.eye(4), (3, 2, 1, 1))
        buckets = 1 << max(6, (2 * count - 1).bit_length())
        self._room = (np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.int32))
        self._pairs = np.zeros((kernels.MAX_PAIRS * count, 2), np.int32)
        self._grid = (np.zeros((count, 4), np.int32), np.zeros(buckets + 1, np.int32), np.zeros(count, np.int32))
        most = kernels.MAX_CONTACTS * count
        self._contacts = (np.zeros((most, 2), np.int32), np.zeros((most, kernels.CONTACT_WIDTH)))
        self.arguments: Any = (
            self.positions_m,
            self.velocities_m_s,
            self._room,
            self.poses,
            self._walls,
            self._pairs,
            self._grid,
            self._contacts,
            self.wrench,
            self._numbers,
        )

    def place(self, positions_m: Array) -> None:
        """Put the particles at (N, 3) in the world, at rest."""
        self.positions_m[:] = positions_m
        self.velocities_m_s[:] = 0.0
        self.wrench[:] = 0.0

    def step(self, T_world_vessel_before: Array, T_world_vessel_after: Array, T_world_receptacle: Array) -> Array:
        """Advance by one step in which the vessel goes from one pose (4, 4) to the other; `wrench`."""
        poses = self.poses
        poses[0, 0], poses[0, 1], poses[1] = T_world_vessel_before, T_world_vessel_after, T_world_receptacle
        kernels.advance(*self.arguments)
        return self.wrench

    def settle(self, T_world_vessel: Array, T_world_receptacle: Array, duration_s: float) -> None:
        """Let the particles come to rest while nothing else moves."""
        for _ in range(round(duration_s / self.timestep_s)):
            self.step(T_world_vessel, T_world_vessel, T_world_receptacle)

    def get_state(self) -> Array:
        """(6 N + 6,) everything that the next steps depend on."""
        return np.concatenate([self.positions_m.ravel(), self.velocities_m_s.ravel(), self.wrench])

    def set_state(self, state: Array) -> None:
        """Continue exactly where `get_state()` was called."""
        size = self.positions_m.size
        if state.shape != (2 * size + 6,):
            raise UserError(
                f"the state of the liquid holds {state.size} values, {2 * size + 6} are needed for "
                f"{len(self.positions_m)} particles; it was taken with another number of them"
            )
        self.positions_m[:] = state[:size].reshape(-1, 3)
        self.velocities_m_s[:] = state[size : 2 * size].reshape(-1, 3)
        self.wrench[:] = state[2 * size :]
