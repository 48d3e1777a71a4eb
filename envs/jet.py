"""What leaves a vessel along a motion: when, from where, how fast, and where it lands.

Quasi-static: a liquid level at the outlet, whatever stands above it leaves. The constants are fitted to the grains of
the simulator, in which a jet from a mug's lip flies 5 cm further for every 10 cm of fall than one that only drips.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..extract.geometry import Array, angle_between_rad
from .vessel_geometry import cavity_of

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

GRAVITY_M_S2 = 9.81
WATER_KG_M3 = 1000.0
# Out of a spout by its channel's friction; over a lip as slowly as a shallow stream, faster once the wall slopes down.
SPOUT_SPEED_M_S, LIP_SPEED_M_S = 0.65, 0.25
_SLIDE_PART = 0.85
# Grains tip over the rim about their own radius further out.
_LIP_REACH_M = 0.012
# Grains gather speed slowly: a lip lets them go so much later than a liquid; a spout lets at most so much through.
_DRAIN_S, _SLIDE_S, _SPOUT_RATE_M3_S = 0.15, 0.3, 60e-6
_SAMPLES = 2000
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Jet:
    """The liquid that leaves at each knot.

    share: (N,) part of the whole outflow, sums to 1. start_m: (N, 3) and velocity_m_s: (N, 3) at the outlet, world.
    poured: part of the filling that leaves in all; when next to nothing does, `share` lies on the greatest tilt.
    """

    share: Array
    start_m: Array
    velocity_m_s: Array
    poured: float

    def landing_m(self, height_m: float) -> Array:
        """(N, 2) where what leaves at each knot falls through the plane z = `height_m`."""
        drop = np.maximum(self.start_m[:, 2] - height_m, 0.0)
        rise = self.velocity_m_s[:, 2]
        fall_s = (rise + np.sqrt(rise**2 + 2 * GRAVITY_M_S2 * drop)) / GRAVITY_M_S2
        return np.asarray(self.start_m[:, :2] + self.velocity_m_s[:, :2] * fall_s[:, None])


def tilt_rad(T: Array) -> Array:
    """(N,) angle of the object's +z axis to the vertical, for poses (N, 4, 4)."""
    return angle_between_rad(T[..., :3, 2], _UP)


def filling_m3(vessel: Vessel, receptacle: Vessel) -> float:
    """What the simulator's grains take up by default: a quarter of the vessel, or half of the receptacle."""
    return min(0.25 * vessel.interior_volume_m3, 0.5 * receptacle.interior_volume_m3)


def filling_kg(vessel: Vessel, receptacle: Vessel | None) -> float:
    """The same as mass of water; nothing without a receptacle."""
    return 0.0 if receptacle is None else WATER_KG_M3 * filling_m3(vessel, receptacle)


def jet_of(T: Array, vessel: Vessel, filled_m3: float, control_hz: float) -> Jet:
    """The jet along poses T (N, 4, 4) of a vessel that holds `filled_m3` at first."""
    share, poured = _outflow(T, vessel, filled_m3, control_hz)
    outlet = vessel.outlet
    start = T[:, :3, :3] @ outlet.point_m + T[:, :3, 3]
    own = np.gradient(start, 1.0 / control_hz, axis=0)
    if outlet.kind == "spout":
        leaving = SPOUT_SPEED_M_S * (T[:, :3, :3] @ outlet.direction)
    else:
        wall = _wall_direction(vessel)
        along = T[:, :3, :3] @ wall
        # Down a wall that slopes by the time it pours; over the rim of one that does not yet.
        depth_m = float(vessel.interior.z_m[-1] - vessel.interior.z_m[0])
        slide = _SLIDE_PART * np.sqrt(2 * GRAVITY_M_S2 * depth_m * np.maximum(-along[:, 2], 0.0))
        along[:, 2] = np.minimum(along[:, 2], 0.0)
        leaving = np.maximum(slide, LIP_SPEED_M_S)[:, None] * along
        start = start + _LIP_REACH_M * along
    return Jet(share, start, own + leaving, poured)


def _outflow(T: Array, vessel: Vessel, filled_m3: float, control_hz: float) -> tuple[Array, float]:
    cavity = cavity_of(vessel)
    points = cavity.sample(_SAMPLES)
    cell_m3 = cavity.volume_m3 / len(points)
    above = (T[:, 2, :3] @ (points - vessel.outlet.point_m).T) > 0.0
    capacity_m3 = cell_m3 * np.sum(~above, axis=1)
    spout = vessel.outlet.kind == "spout"
    dt = 1.0 / control_hz
    held = filled_m3
    out: Array = np.zeros(len(T))
    for k, capacity in enumerate(capacity_m3):
        leaving = max(held - float(capacity), 0.0) * (1.0 - np.exp(-dt / _DRAIN_S))
        out[k] = min(leaving, _SPOUT_RATE_M3_S * dt) if spout else leaving
        held -= out[k]
    if not spout:
        late = np.minimum(np.arange(len(T)) + round(_SLIDE_S * control_hz), len(T) - 1)
        out = np.asarray(np.bincount(late, out, minlength=len(T)), float)
    poured = float(out.sum() / filled_m3)
    if poured < 0.02:
        tilt = tilt_rad(T)
        out = np.where(tilt >= 0.9 * tilt.max(), 1.0, 0.0)
    return out / out.sum(), poured


def _wall_direction(vessel: Vessel) -> Array:
    """(3,) along the inner wall on the lip's side, from the widest low part up to the rim, in the object frame."""
    profile, outlet = vessel.interior, vessel.outlet.point_m
    side = outlet[:2] - np.asarray(profile.axis_xy_m)
    side = side / max(float(np.linalg.norm(side)), 1e-9)
    # Half the depth: what pours last slides over the upper wall, and a rounded floor says nothing about it.
    z = 0.5 * float(profile.z_m[0] + profile.z_m[-1])
    low = np.array([*(np.asarray(profile.axis_xy_m) + side * profile.radius_at(z)), z])
    rim = np.array([*(np.asarray(profile.axis_xy_m) + side * profile.radius_m[-1]), profile.z_m[-1]])
    return np.asarray((rim - low) / np.linalg.norm(rim - low))
