"""The liquid: spheres that slide and do not roll; how they are laid into a vessel, counted, and led through a spout.

Each particle is a body at the world's origin on three slide joints, so its joint positions are its world position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from .vessel_geometry import Box, Cavity

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

# Random loose packing of frictionless spheres as they settle here.
PACKING = 0.58
MIN_RADIUS_M, MAX_RADIUS_M = 0.0025, 0.005
GRAVITY_M_S2 = 9.81
# Points that stand for the hollow when the liquid's level is sought: 1 mm in 10 cm or better.
LEVEL_SAMPLES = 2000
SOLVERS = ("engine", "fast")
_RANGES = {
    "density_kg_m3": (50.0, 20000.0),
    "friction": (0.0, 2.0),
    "drag_1_s": (0.0, 20.0),
    "spout_fill": (0.0, 0.9),
}


@dataclass(frozen=True)
class Liquid:
    """What the particles are like.

    radius_m: particle radius; None chooses 2.5 to 5 mm so that the particles take up a fair part of the vessel but
        not more than half of the receptacle: ten millilitres at the bottom of a kettle would never reach its spout.
    density_kg_m3: of a particle, which weighs as much as a ball of it.
    friction: Coulomb's coefficient at every contact of a particle; 0 lets them slide freely.
    drag_1_s: resistance of the air: the part of its speed that a particle loses in a second, so that what was spilled
        comes to rest at last.
    spout_fill: share of a spouted vessel's hollow that the particles stand for while its level is sought; their own
        volume where that is more. A few particles in a kettle behave as the kettle filled so far would.
    solver: "engine": the particles are bodies of the simulated scene; "fast": `fast_liquid.FastLiquid` moves them.
    """

    radius_m: float | None = None
    density_kg_m3: float = 1000.0
    friction: float = 0.0
    drag_1_s: float = 0.2
    spout_fill: float = 0.25
    solver: str = "engine"

    def __post_init__(self) -> None:
        if self.radius_m is not None and not 0.002 <= self.radius_m <= 0.01:
            raise UserError(f"liquid radius_m is {self.radius_m}; choose 0.002 to 0.01 m, or None for a fitting one")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UserError(f"liquid {name} is {value}; choose {low:g} to {high:g}")
        if self.solver not in SOLVERS:
            raise UserError(f"liquid solver is {self.solver!r}; choose {', '.join(SOLVERS)}")

    def particle_mass_kg(self, radius_m: float) -> float:
        """Mass of one particle of this radius."""
        return self.density_kg_m3 * 4 / 3 * math.pi * radius_m**3

    def radius_for(self, count: int, vessel_m3: float, receptacle_m3: float, throat_m: float) -> float:
        """The radius in m that `count` particles take in a vessel and a receptacle of these volumes.

        throat_m: radius of the narrowest place on the way out, where particles must not jam.
        """
        if self.radius_m is not None:
            return self.radius_m
        share_m3 = min(0.25 * vessel_m3, 0.5 * receptacle_m3) * PACKING / max(count, 1)
        radius_m = min((share_m3 / (4 / 3 * math.pi)) ** (1 / 3), 0.22 * throat_m)
        return float(np.clip(radius_m, MIN_RADIUS_M, MAX_RADIUS_M))


def level_share(liquid: Liquid, cavity: Cavity, count: int, radius_m: float) -> float:
    """Share of the hollow's volume that one of `count` particles stands for."""
    return max(4 / 3 * math.pi * radius_m**3 / PACKING / cavity.volume_m3, liquid.spout_fill / count)


def fill_positions(cavity: Cavity, boxes: list[Box], count: int, radius_m: float, name: str) -> Array:
    """(count, 3) centres of a dense lattice from the floor upward, in the vessel's frame, clear of every wall.

    Raises UserError with the number that fits when `count` is too many; `name` is the vessel's name for the message.
    """
    if count == 0:
        return np.zeros((0, 3))
    spacing = 2.02 * radius_m
    reach = cavity.reach_m
    low, high = cavity.z_m[0] + 1.01 * radius_m, cavity.rim_m - radius_m
    layers = np.arange(low, high + 1e-9, spacing * math.sqrt(2 / 3))
    side = np.arange(-math.ceil(reach / spacing) - 1, math.ceil(reach / spacing) + 2)
    i, j = (grid.ravel() for grid in np.meshgrid(side, side))
    flat = spacing * np.column_stack([i + 0.5 * (j % 2), j * math.sqrt(3) / 2])
    points = []
    for number, z in enumerate(layers):
        # Alternate layers sit in the hollows of the layer below.
        shift = (number % 2) * spacing * np.array([0.5, math.sqrt(3) / 6])
        layer = np.column_stack([flat + shift + cavity.axis_xy_m, np.full(len(flat), z)])
        layer = layer[cavity.contains(layer)]
        layer = layer[np.argsort(np.linalg.norm(layer[:, :2] - cavity.axis_xy_m, axis=1), kind="stable")]
        points.append(layer)
    candidates = np.concatenate(points) if points else np.zeros((0, 3))
    free = np.full(len(candidates), True)
    for box in boxes:
        free &= box.distance_m(candidates) >= radius_m
    candidates = candidates[free]
    if len(candidates) < count:
        raise UserError(
            f"the {name} holds at most {len(candidates)} particles of {1000 * radius_m:.1f} mm radius, but "
            f"num_particles is {count}; choose fewer or smaller ones"
        )
    return np.asarray(candidates[:count])


@dataclass(frozen=True)
class Count:
    """Where the particles are: masks (N,) in the held vessel, in the receptacle, and lost for both."""

    held: NDArray[np.bool_]
    poured: NDArray[np.bool_]
    spilled: NDArray[np.bool_]

    @property
    def poured_fraction(self) -> float:
        return float(np.mean(self.poured)) if len(self.poured) else 0.0

    @property
    def spilled_fraction(self) -> float:
        return float(np.mean(self.spilled)) if len(self.spilled) else 0.0

    @property
    def held_fraction(self) -> float:
        return float(np.mean(self.held)) if len(self.held) else 0.0


def count_particles(
    points_m: Array, vessel: Cavity, T_world_vessel: Array, receptacle: Cavity, T_world_receptacle: Array
) -> Count:
    """Sort particles at (N, 3) in the world.

    Held: inside the vessel's hollow. Poured: otherwise, inside the receptacle's. Spilled: in neither and below the
    receptacle's rim, from where nothing finds back. The rest is in flight.
    """
    held = vessel.contains(points_m, T_world_vessel)
    poured, spilled = np.zeros_like(held), np.zeros_like(held)
    out = np.flatnonzero(~held)
    if len(out) == 0:
        return Count(held, poured, spilled)
    poured[out] = receptacle.contains(points_m[out], T_world_receptacle)
    rim = np.array([*receptacle.axis_xy_m, receptacle.rim_m])
    rim_z = float((T_world_receptacle[:3, :3] @ rim + T_world_receptacle[:3, 3])[2])
    spilled[out] = ~poured[out] & (points_m[out, 2] < rim_z)
    return Count(held, poured, spilled)


class SpoutConduit:
    """Leads particles from a spout's inner mouth to its tip, as communicating vessels would.

    Real spouts are as narrow as a particle, which would jam in them. So the body is closed, and while the liquid's
    level stands above both the channel's entry and the tip, the particle nearest the entry reappears at the tip,
    moving along the outlet. The level is that of the liquid that the held particles stand for (`Liquid.spout_fill`) in
    the vessel as it is tilted now. A particle leaves only when its place at the tip is clear: that limits the rate,
    keeps particles apart, and makes the conduit a function of the physics state alone, so that replays and restored
    states agree bit by bit.
    """

    def __init__(self, vessel: Vessel, cavity: Cavity, boxes: list[Box], radius_m: float, share: float) -> None:
        """boxes: the vessel's collision shapes; share: of the hollow's volume that one particle stands for."""
        outlet = vessel.outlet
        if outlet.entry_m is None:
            raise UserError(f"the {vessel.category}'s spout names no entry; rebuild the vessel with its channel")
        self._cavity, self._radius_m = cavity, radius_m
        self._entry_m, self._tip_m = np.asarray(outlet.entry_m, float), np.asarray(outlet.point_m, float)
        self._direction = np.asarray(outlet.direction, float)
        self._slots_m = self._clear_of(boxes, self._tip_m + self._slots(float(outlet.tip_radius_m or 0.0)))
        self._samples_m = cavity.sample(LEVEL_SAMPLES)
        self._share = share

    def _slots(self, tip_radius_m: float) -> Array:
        """(S, 3) places side by side in the tip's mouth: one, or seven when it is wide enough."""
        ring_m = 2.1 * self._radius_m
        if tip_radius_m < ring_m + 0.5 * self._radius_m:
            return np.zeros((1, 3))
        helper = np.array([0.0, 1.0, 0.0]) if abs(self._direction[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        u = np.cross(self._direction, helper)
        u /= np.linalg.norm(u)
        v = np.cross(self._direction, u)
        angle = np.arange(6)[:, None] * (math.pi / 3)
        return np.vstack([np.zeros((1, 3)), ring_m * (np.cos(angle) * u + np.sin(angle) * v)])

    def _clear_of(self, boxes: list[Box], slots_m: Array) -> Array:
        """Slots moved out along the outlet by a radius, and on until they clear walls close to the spout."""
        for out_m in self._radius_m + np.linspace(0.0, 0.03, 31):
            moved = slots_m + out_m * self._direction
            if min(box.distance_m(moved).min() for box in boxes) >= self._radius_m:
                break
        return np.asarray(moved)

    def level_m(self, T_world_vessel: Array, held: int) -> float:
        """Height in the world of the surface of the liquid that `held` particles stand for; -inf when there is none."""
        if held == 0:
            return -math.inf
        heights = self._samples_m @ T_world_vessel[2, :3]
        rank = min(len(heights) - 1, int(held * self._share * len(heights)))
        return float(np.partition(heights, rank)[rank] + T_world_vessel[2, 3])

    def may_flow(self, T_world_vessel: Array, points_m: Array) -> bool:
        """A cheap necessary condition: the tip lies below some particle."""
        tip_z = float(T_world_vessel[2, :3] @ self._tip_m + T_world_vessel[2, 3])
        return tip_z < float(points_m[:, 2].max()) + 2.0 * self._radius_m

    def move(self, points_m: Array, velocity_m_s: Array, T_world_vessel: Array, twist: Array) -> bool:
        """Move at most one particle, in place, in `points_m` and `velocity_m_s` (N, 3); True if one was moved.

        twist: (6,) linear [m/s] and angular [rad/s] velocity of the vessel's origin, world axes.
        """
        R, p = T_world_vessel[:3, :3], T_world_vessel[:3, 3]
        slots = self._slots_m @ R.T + p
        gap = np.linalg.norm(points_m[:, None] - slots, axis=2).min(axis=0)
        clear = np.flatnonzero(gap > 2.0 * self._radius_m)
        if len(clear) == 0:
            return False
        local = (points_m - p) @ R
        held = np.flatnonzero(self._cavity.contains(local))
        level_m = self.level_m(T_world_vessel, len(held))
        tip_z, entry_z = (float(R[2] @ point + p[2]) for point in (self._tip_m, self._entry_m))
        if level_m <= max(tip_z, entry_z):
            return False
        chosen = held[int(np.argmin(np.linalg.norm(local[held] - self._entry_m, axis=1)))]
        place = slots[clear[0]]
        # Torricelli's speed, held within what drips and what the channel's friction leaves.
        speed = min(max(math.sqrt(2 * GRAVITY_M_S2 * (level_m - tip_z)), 0.35), 0.8)
        points_m[chosen] = place
        velocity_m_s[chosen] = twist[:3] + np.cross(twist[3:], place - p) + speed * (R @ self._direction)
        return True


def add_particles(
    spec: mujoco.MjSpec, count: int, radius_m: float, liquid: Liquid, contact: dict[str, object], rgba: list[float]
) -> None:
    """Add `count` particles to a spec: bodies `particle_I` with slide joints `particle_I_x|y|z`."""
    axes = (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1]))
    mass_kg = liquid.particle_mass_kg(radius_m)
    for i in range(count):
        body = spec.worldbody.add_body(name=f"particle_{i}")
        body.mass, body.inertia = mass_kg, [1e-8, 1e-8, 1e-8]
        body.explicitinertial = True
        for name, axis in axes:
            joint = body.add_joint(name=f"particle_{i}_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
            joint.damping = np.array([liquid.drag_1_s * mass_kg, 0.0, 0.0])
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius_m, 0, 0], rgba=rgba, **contact)
        geom.group = 1
