"""Candidate grasps of a vessel by the Panda's two fingers.

Hand frame = `panda_hand_tcp`: z is the approach direction, the fingers close along y, the palm lies at negative z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, invert_pose, make_pose, transform_points
from .grip import HOLDS, weight_part
from .panda import FINGER_MAX_M, PAD_M
from .receptacle import surface_points

if TYPE_CHECKING:
    from ..extract.vessels import GraspRegion, Vessel

# What the fingers span at most, less a little room on both sides.
MAX_WIDTH_M = 2 * FINGER_MAX_M - 0.002
# From which part of the grip on a weight makes a grasp less liked, and by how much.
_EASY, _HOLD_COST = 0.8, 2.0
# From where handles are approached: about where they point to, and across, with a finger between handle and body.
_USUAL_DEG, _ACROSS_DEG = (0.0, -25.0, 25.0), (-75.0, -50.0, 50.0, 75.0)
# The tips reach so far below a rim whose wall they hold.
RIM_GRASP_M = 0.022
# Boxes of the hand in its own frame, m: (low, high). The pads end 1 cm beyond the tcp; the palm begins 45 mm behind.
_PALM = (np.array([-0.032, -0.102, -0.14]), np.array([0.032, 0.102, -0.04]))
_FINGER_X_M, _FINGER_Z_M, _FINGER_THICK_M = 0.011, (-0.045, 0.011), 0.018


@dataclass(frozen=True)
class Grasp:
    """T_object_hand: (4, 4) pose of the hand in the object's frame.

    kind: "handle" or "body". width_m: what the fingers span. cost: how little this grasp is liked, 0 is best.
    """

    T_object_hand: Array
    kind: str
    width_m: float
    cost: float

    @property
    def T_hand_object(self) -> Array:
        return invert_pose(self.T_object_hand)

    @property
    def is_flat(self) -> bool:
        """Whether the pads lie on a wall."""
        return self.kind == "body"

    @property
    def fits_hand(self) -> bool:
        return self.width_m <= MAX_WIDTH_M

    def told(self) -> dict[str, Any]:
        """What a reference's header says of it (JSON-like)."""
        return {"kind": self.kind, "width_m": self.width_m, "fits": self.fits_hand}


def grasp_candidates(vessel: Vessel) -> list[Grasp]:
    """Usual grasps of a vessel's regions: slid along the region, turned about it, pitched, with either palm side up.

    Grasps whose palm or fingers would cut into the vessel are left out. What is wider than the fingers open is held by
    the wall at its rim; regions that are too wide are used only when it has no rim either.
    """
    regions = [region for region in vessel.grasps if region.width_m <= MAX_WIDTH_M]
    return _clear(regions or rim_regions(vessel) or list(vessel.grasps), vessel)


def held_grasps(vessel: Vessel, contents_kg: float, T_object: Array) -> list[Grasp]:
    """Grasps for carrying a filled vessel through attitudes (N, 4, 4), z up, each liked less the harder it is to hold.

    What friction can hold in no usual way, a heavy kettle by its handle, may be held across as well: fingers that close
    along the lever of the weight are not turned by it.
    """

    def weighed(grasps: list[Grasp]) -> list[tuple[float, Grasp]]:
        parts = [weight_part(vessel, contents_kg, T_object, g.T_hand_object, g.width_m, g.is_flat) for g in grasps]
        return [
            (part, replace(g, cost=g.cost + _HOLD_COST * max(part - _EASY, 0.0)))
            for part, g in zip(parts, grasps, strict=True)
        ]

    found = weighed(grasp_candidates(vessel))
    if min(part for part, _ in found) > HOLDS:
        handles = [r for r in vessel.grasps if r.kind == "handle" and r.width_m <= MAX_WIDTH_M]
        points = surface_points(vessel)
        across = [grasp for region in handles for grasp in _of_region(region, vessel, _ACROSS_DEG)]
        found += weighed([grasp for grasp in across if not _cuts(grasp, points)])
    return [grasp for _, grasp in found]


def wide_grasps(vessel: Vessel) -> list[Grasp]:
    """Grasps around what is wider than the fingers open, which can be held in simulation only."""
    return _clear([region for region in vessel.grasps if region.width_m > MAX_WIDTH_M], vessel)


def _clear(regions: list[GraspRegion], vessel: Vessel) -> list[Grasp]:
    """All grasps of some regions but those that cut into the vessel."""
    points = surface_points(vessel)
    grasps = [grasp for region in regions for grasp in _of_region(region, vessel)]
    free = [grasp for grasp in grasps if not _cuts(grasp, points)]
    # A vessel that no hand can hold cleanly is still shown to the user, who reads of it in the notes.
    return free or grasps


def rim_regions(vessel: Vessel) -> list[GraspRegion]:
    """Places at the rim of an open vessel, on the sides and behind, where one finger goes inside and one outside."""
    from ..extract.vessels import GraspRegion

    profile = vessel.interior
    if not vessel.is_open or vessel.wall_m > MAX_WIDTH_M:
        return []
    rings = profile.outlines(72)
    z_m = float(profile.z_m[-1]) - RIM_GRASP_M
    below = int(np.clip(np.searchsorted(profile.z_m, z_m) - 1, 0, len(rings) - 2))
    share = (z_m - profile.z_m[below]) / (profile.z_m[below + 1] - profile.z_m[below])
    top, deep = rings[-1], rings[below] + max(share, 0.0) * (rings[below + 1] - rings[below])
    middle = np.array([*profile.axis_xy_m, 0.0])
    regions = []
    for angle_rad in np.deg2rad([90.0, 135.0, 180.0, 225.0, 270.0]):
        outward = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
        tangent = np.cross([0.0, 0.0, 1.0], outward)
        k = int(np.argmax((top - middle) @ outward / np.linalg.norm((top - middle)[:, :2], axis=1)))
        # Fingers go in along the wall, which may lean.
        up = top[k] - deep[k]
        up -= (up @ tangent) * tangent
        up /= np.linalg.norm(up)
        # The inner finger is as wide as the pads and touches a curved wall with its edges.
        radius_m = float(np.linalg.norm((top[k] - middle)[:2]))
        bow_m = radius_m - float(np.sqrt(max(radius_m**2 - PAD_M[1][0] ** 2, 0.0)))
        center = top[k] - RIM_GRASP_M / 2 * up + (vessel.wall_m - bow_m) / 2 * np.cross(tangent, up)
        regions.append(GraspRegion("body", center, tangent, 0.008, vessel.wall_m + bow_m, -up))
    return regions


def _of_region(region: GraspRegion, vessel: Vessel, turns_deg: tuple[float, ...] = _USUAL_DEG) -> list[Grasp]:
    axis = region.axis / np.linalg.norm(region.axis)
    approach = region.approach - (region.approach @ axis) * axis
    approach /= np.linalg.norm(approach)
    upright = abs(axis[2]) > 0.9
    lying = abs(axis[2]) < 0.5
    around = (region.kind == "body" and upright and vessel.section.kind == "round") or (
        region.kind == "handle" and lying
    )
    # A round body and a lying handle can be approached from anywhere, other handles from about where they point to.
    turns_rad = np.arange(12) * np.pi / 6 if around else np.deg2rad(turns_deg)
    if region.kind == "body" and not around:
        turns_rad = np.array([0.0, np.pi])
    grasps = []
    for turn_rad in turns_rad:
        z_turned = Rotation.from_rotvec(turn_rad * axis).apply(approach)
        for pitch_deg in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0):
            closing = np.cross(axis, z_turned)
            z = Rotation.from_rotvec(np.deg2rad(pitch_deg) * closing).apply(z_turned)
            for slide in (-0.3, 0.0, 0.3):
                center = region.center_m + slide * region.length_m * axis
                cost = 0.3 * (pitch_deg / 60.0) ** 2 + 0.1 * abs(slide) + (0.1 if region.kind == "body" else 0.0)
                if lying:
                    cost += 0.1 * (1.0 + float(z[2]))  # from above is how one takes it
                elif not around:
                    cost += 0.2 * abs(turn_rad) / np.pi
                if region.width_m > MAX_WIDTH_M:
                    cost += 1.0
                for side in (1.0, -1.0):
                    R = np.column_stack([np.cross(side * closing, z), side * closing, z])
                    grasps.append(Grasp(make_pose(R, center), region.kind, region.width_m, cost))
    return grasps


def _cuts(grasp: Grasp, points: Array) -> bool:
    """Whether palm or fingers would stand inside the vessel's surface."""
    local = transform_points(grasp.T_hand_object, points)
    inside = np.all((local > _PALM[0]) & (local < _PALM[1]), axis=1)
    half_m = 0.5 * min(grasp.width_m, MAX_WIDTH_M)
    beside = np.abs(local[:, 1])
    # 2 mm of the surface beside the fingers is what they press on.
    finger = (
        (np.abs(local[:, 0]) < _FINGER_X_M)
        & (local[:, 2] > _FINGER_Z_M[0])
        & (local[:, 2] < _FINGER_Z_M[1])
        & (beside > half_m + 0.002)
        & (beside < half_m + _FINGER_THICK_M)
    )
    if not grasp.fits_hand:
        finger[:] = False
    return bool(inside.sum() + finger.sum() > 2)
