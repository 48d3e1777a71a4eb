"""Where the receptacle stands and how high the vessel must be, so that what leaves the outlet lands in its mouth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, make_pose
from ..extract.track import ObjectTrack
from .jet import filling_m3, jet_of, tilt_rad

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

CLEARANCE_M = 0.01


@dataclass(frozen=True)
class ReceptaclePlacement:
    """T_receptacle: (4, 4) upright on the table. lift_m: how far the whole vessel motion must rise to clear the rim.

    caught: part of the jet that should land in the mouth. notes: plain sentences.
    """

    T_receptacle: Array
    lift_m: float
    caught: float
    notes: list[str]


def mouth_radius_m(receptacle: Vessel) -> float:
    """Radius of the largest circle in the opening."""
    return float(receptacle.interior.radius_m[-1]) * min(1.0, receptacle.interior.aspect)


def mouth_xy_m(receptacle: Vessel, T: Array) -> Array:
    """(2,) where the middle of the opening is for an upright pose (4, 4).

    It is not the origin, the middle of the bounding box, of what has a handle.
    """
    return np.asarray(T[:2, 3] + T[:2, :2] @ np.asarray(receptacle.interior.axis_xy_m))


def bottom_m(vessel: Vessel) -> float:
    """Height of the origin above the underside (the origin is the centre of the bounding box)."""
    return 0.5 * float(vessel.extents_m[2])


def surface_points(vessel: Vessel, count: int = 1500) -> Array:
    """(M, 3) points on the vessel's surface: its hull's corners and evenly sampled points, the same every time."""
    import trimesh

    samples, _ = trimesh.sample.sample_surface(vessel.mesh, count, seed=0)
    hull = np.asarray(vessel.mesh.convex_hull.vertices)
    return np.vstack([hull[:: max(1, len(hull) // 400)], np.asarray(samples), vessel.outlet.point_m[None]])


def place_receptacle(
    T: Array, vessel: Vessel, receptacle: Vessel, tracked: Array | None, control_hz: float
) -> ReceptaclePlacement:
    """Stand the receptacle on z = 0 under the jet.

    T: (N, 4, 4) poses of the vessel, z up, never below the table. tracked: (4, 4) where the receptacle was seen in the
    same frame, or None; it is then moved as little as serves.
    """
    notes: list[str] = []
    rim_m = float(receptacle.extents_m[2])
    mouth = mouth_radius_m(receptacle)
    outer = float(receptacle.exterior.radius_m.max()) * max(1.0, receptacle.exterior.aspect) + 0.005
    jet = jet_of(T, vessel, filling_m3(vessel, receptacle), control_hz)
    low_xyz = _low_points(T, surface_points(vessel), rim_m)
    # Found is where the mouth is to be; body and handle stand about it as they are turned.
    R = _yaw_matrix(_facing_yaw_rad(T, tracked))
    seen_xy_m = None if tracked is None else mouth_xy_m(receptacle, make_pose(R, tracked[:3, 3]))
    lift_m, caught = 0.0, 0.0
    centre: Array = np.zeros(2)
    # The landing point depends on the height of fall, that on where the receptacle stands: three rounds settle it.
    for _ in range(3):
        landing = jet.landing_m(rim_m - lift_m)
        centre = _best_centre(landing, jet.share, mouth, low_xyz, outer)
        if seen_xy_m is not None:
            centre = _least_move(seen_xy_m, centre, landing, jet.share, mouth, low_xyz, outer)
        caught = float(jet.share @ (np.linalg.norm(landing - centre, axis=1) <= 0.9 * mouth))
        needed = float(_needed_lift_m(low_xyz, centre[None], outer)[0])
        if abs(needed - lift_m) < 1e-4:
            break
        lift_m = needed
    x, y = centre - mouth_xy_m(receptacle, make_pose(R))
    T_receptacle = make_pose(R, (float(x), float(y), bottom_m(receptacle)))
    if caught < 0.7:
        notes.append(
            f"The jet wanders while pouring: the receptacle can catch about {100 * caught:.0f}% of it where it stands."
        )
    if jet.poured < 0.5:
        notes.append(
            f"Its greatest tilt of {np.rad2deg(tilt_rad(T).max()):.0f} degrees empties the vessel only in part: about "
            f"{100 * jet.poured:.0f}% leave of a filling that takes up a quarter of it or half of the receptacle."
        )
    return ReceptaclePlacement(T_receptacle, lift_m, caught, notes)


def receptacle_pose_at_pour(track: ObjectTrack, video_time_s: Array) -> Array:
    """(4, 4) median pose in the camera frame of the receptacle's track at the given video times.

    Frames in which it is not visible are left out; if none is left, all its visible frames count.
    """
    inside = (track.time_s >= video_time_s.min() - 0.05) & (track.time_s <= video_time_s.max() + 0.05)
    chosen = inside & track.visible
    if not chosen.any():
        chosen = track.visible if track.visible.any() else np.ones(len(track), bool)
    T = track.T_camera_object[chosen]
    median = np.median(T[:, :3, 3], axis=0)
    return make_pose(Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix(), median)


def _best_centre(landing: Array, share: Array, mouth_m: float, low_xyz: Array, outer_m: float) -> Array:
    """The place (2,) that catches most: tightly first, then at all; without making the vessel rise; near the middle."""
    flowing = landing[share > 1e-4]
    middle = share @ landing
    angle = np.arange(12) * np.pi / 6
    ring = np.concatenate([part * np.column_stack([np.cos(angle), np.sin(angle)]) for part in (0.15, 0.3, 0.6)])
    candidates = np.vstack([middle, flowing[:: max(1, len(flowing) // 40)], middle + mouth_m * ring])
    away = np.linalg.norm(landing[None] - candidates[:, None], axis=2)
    tight, wide = ((away <= part * mouth_m) @ share for part in (0.5, 0.9))
    worth = tight + wide - 0.3 * np.linalg.norm(candidates - middle, axis=1) / mouth_m
    # Half of what is caught tightly is given up for a vessel that stands on the table rather than 10 cm above it.
    worth -= 5.0 * np.minimum(_needed_lift_m(low_xyz, candidates, outer_m), 0.2)
    return np.asarray(candidates[np.argmax(worth)])


def _least_move(
    seen: Array, best: Array, landing: Array, share: Array, mouth_m: float, low_xyz: Array, outer_m: float
) -> Array:
    """The place (2,) near `seen` that catches nearly as well as `best` does, with a margin, and changes least.

    What counts is how far the receptacle moves from where it was seen and how much the vessel must rise over it.
    """
    angle = np.arange(12) * np.pi / 6
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    steps = np.linspace(0.0, 1.0, 101)[:, None]
    near = np.concatenate([part * mouth_m * ring for part in (0.2, 0.4, 0.6, 0.8, 1.0)])
    candidates = np.vstack([seen + steps * (best - seen), seen + near, best])
    caught = (np.linalg.norm(landing[None] - candidates[:, None], axis=2) <= 0.6 * mouth_m) @ share
    changed_m = np.linalg.norm(candidates - seen, axis=1) + _needed_lift_m(low_xyz, candidates, outer_m)
    return np.asarray(candidates[np.argmin(np.where(caught >= caught[-1] - 0.02, changed_m, np.inf))])


def _low_points(T: Array, points: Array, rim_m: float) -> Array:
    """(L, 3) the vessel's surface points over all knots that are not clear of the rim: place, and rise they need."""
    world = (np.einsum("nij,mj->nmi", T[::2, :3, :3], points) + T[::2, None, :3, 3]).reshape(-1, 3)
    low = world[world[:, 2] < rim_m + CLEARANCE_M]
    # On a grid of 4 mm only the lowest point of each cell matters; there are thousands a cell.
    cell = np.round(low[:, :2] / 0.004).astype(np.int64)
    order = np.argsort(low[:, 2], kind="stable")
    _, first = np.unique(cell[order], axis=0, return_index=True)
    kept = low[order][first]
    return np.column_stack([kept[:, :2], rim_m + CLEARANCE_M - kept[:, 2]])


def _needed_lift_m(low_xyz: Array, centres: Array, outer_m: float) -> Array:
    """(C,) rise that brings every point of the vessel that passes over the receptacle above its rim."""
    if len(low_xyz) == 0:
        return np.zeros(len(centres))
    over = np.linalg.norm(low_xyz[None, :, :2] - centres[:, None], axis=2) <= outer_m
    return np.asarray(np.where(over, low_xyz[None, :, 2], 0.0).max(axis=1))


def _facing_yaw_rad(T: Array, tracked: Array | None) -> float:
    """As seen when it was tracked; else its handle (-x) away from the vessel."""
    if tracked is not None and math.hypot(tracked[0, 0], tracked[1, 0]) > 0.2:
        return math.atan2(tracked[1, 0], tracked[0, 0])
    x, y = T[int(np.argmax(tilt_rad(T))), :2, 2]
    return math.atan2(-y, -x) if math.hypot(x, y) > 1e-3 else 0.0


def _yaw_matrix(yaw_rad: float) -> Array:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def shift_sentence(shift: Array, ray: Array) -> str:
    """How far (2,) the receptacle was moved, along and across the horizontal part of the camera's line of sight."""
    total_cm = 100 * float(np.linalg.norm(shift))
    if total_cm < 0.75:
        return "The receptacle stands where it was seen."
    if np.linalg.norm(ray[:2]) < 1e-6:
        return f"The receptacle was moved by {total_cm:.0f} cm so that the jet lands in it."
    sight = ray[:2] / np.linalg.norm(ray[:2])
    along_cm = 100 * float(shift @ sight)
    aside_cm = 100 * float(np.linalg.norm(shift - (shift @ sight) * sight))
    word = "away from" if along_cm > 0 else "toward"
    moves = []
    if abs(along_cm) >= 0.5:
        moves.append(f"{abs(along_cm):.0f} cm {word} the camera (a single camera measures depth badly)")
    if aside_cm >= 0.5:
        moves.append(f"{aside_cm:.0f} cm sideways")
    return f"The receptacle was moved by {' and by '.join(moves)}, so that the jet lands in it."
