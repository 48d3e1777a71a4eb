"""Where the receptacle stands and how high the vessel must be, so that what leaves the outlet lands in its mouth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, angle_between_rad, make_pose
from ..extract.track import ObjectTrack

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

GRAVITY_M_S2 = 9.81
# Grains roll out of a tilted vessel at about this speed; a jet as slow as this falls nearly straight.
JET_SPEED_M_S = 0.3
CLEARANCE_M = 0.01
# The liquid leaves while the tilt is above this part of its greatest value.
POURING_PART = 0.8
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class ReceptaclePlacement:
    """T_receptacle: (4, 4) upright on the table. lift_m: how far the whole vessel motion must rise to clear the rim.

    caught: part of the pouring time in which the jet lands in the mouth. notes: plain sentences.
    """

    T_receptacle: Array
    lift_m: float
    caught: float
    notes: list[str]


def tilt_rad(T: Array) -> Array:
    """(N,) angle of the object's +z axis to the vertical."""
    return angle_between_rad(T[..., :3, 2], _UP)


def pouring_knots(T: Array) -> NDArray[np.int64]:
    """Indices of the knots at which the vessel is tilted enough to pour."""
    tilt = tilt_rad(T)
    return np.flatnonzero(tilt >= POURING_PART * tilt.max()).astype(np.int64)


def jet_landing_m(T: Array, vessel: Vessel, height_m: float, speed_m_s: float = JET_SPEED_M_S) -> Array:
    """(N, 2) where liquid that leaves the outlet in poses T (N, 4, 4) falls through the plane z = `height_m`."""
    start = T[:, :3, :3] @ vessel.outlet.point_m + T[:, :3, 3]
    velocity = speed_m_s * (T[:, :3, :3] @ vessel.outlet.direction)
    drop = np.maximum(start[:, 2] - height_m, 0.0)
    fall_s = (velocity[:, 2] + np.sqrt(velocity[:, 2] ** 2 + 2 * GRAVITY_M_S2 * drop)) / GRAVITY_M_S2
    return np.asarray(start[:, :2] + velocity[:, :2] * fall_s[:, None])


def mouth_radius_m(receptacle: Vessel) -> float:
    """Radius of the largest circle in the opening."""
    return float(receptacle.interior.radius_m[-1]) * min(1.0, receptacle.interior.aspect)


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
    T: Array, vessel: Vessel, receptacle: Vessel, tracked: Array | None, ray: Array | None
) -> ReceptaclePlacement:
    """Stand the receptacle on z = 0 under the jet.

    T: (N, 4, 4) poses of the vessel, z up, never below the table. tracked: (4, 4) where the receptacle was seen in the
    same frame, or None; it is then moved as little as serves, and its shift along the horizontal part of `ray` (the
    camera's line of sight) is told apart from the rest.
    """
    notes: list[str] = []
    pouring = pouring_knots(T)
    rim_m = float(receptacle.extents_m[2])
    mouth = mouth_radius_m(receptacle)
    outer = float(receptacle.exterior.radius_m.max()) * max(1.0, receptacle.exterior.aspect) + 0.005
    points = surface_points(vessel)
    yaw_rad = _facing_yaw_rad(T, tracked)
    low_xyz = _low_points(T, points, rim_m)
    lift_m, caught = 0.0, 0.0
    centre: Array = np.zeros(2)
    # The landing point depends on the height of fall, the height on where the receptacle stands: two rounds settle it.
    for _ in range(3):
        raised = T.copy()
        raised[:, 2, 3] += lift_m
        landing = jet_landing_m(raised, vessel, rim_m)
        deepest = int(np.argmax(tilt_rad(T)))
        centre = _best_centre(landing[pouring], landing[deepest], mouth, low_xyz, outer)
        if tracked is not None:
            centre = _least_move(tracked[:2, 3], centre, landing[pouring], landing[deepest], mouth)
        caught = float(np.mean(np.linalg.norm(landing[pouring] - centre, axis=1) <= 0.9 * mouth))
        needed = float(_needed_lift_m(low_xyz, centre[None], outer)[0])
        if abs(needed - lift_m) < 1e-4:
            break
        lift_m = needed
    T_receptacle = make_pose(_yaw_matrix(yaw_rad), (float(centre[0]), float(centre[1]), bottom_m(receptacle)))
    if tracked is not None:
        notes.append(_shift_sentence(centre - tracked[:2, 3], ray))
    if caught < 0.7:
        notes.append(
            f"The outlet wanders while pouring: the receptacle can stay under it for "
            f"{100 * caught:.0f}% of that time only."
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


def _best_centre(landing: Array, deepest: Array, mouth_m: float, low_xyz: Array, outer_m: float) -> Array:
    """The place (2,) that catches most: tightly first, then at all; without making the vessel rise; near the jet."""
    angle = np.arange(12) * np.pi / 6
    ring = np.concatenate([part * np.column_stack([np.cos(angle), np.sin(angle)]) for part in (0.3, 0.6)]) * mouth_m
    spread = landing[:: max(1, len(landing) // 30)]
    candidates = np.vstack([deepest, landing.mean(axis=0), spread, deepest + ring, landing.mean(axis=0) + ring])
    away = np.linalg.norm(landing[None] - candidates[:, None], axis=2)
    tight, wide = (np.mean(away <= part * mouth_m, axis=1) for part in (0.5, 0.9))
    worth = tight + wide - 0.1 * np.linalg.norm(candidates - deepest, axis=1) / mouth_m
    # Half of what is caught tightly is given up for a vessel that stands on the table rather than 10 cm above it.
    worth -= 5.0 * np.minimum(_needed_lift_m(low_xyz, candidates, outer_m), 0.2)
    return np.asarray(candidates[np.argmax(worth)])


def _least_move(seen: Array, best: Array, landing: Array, deepest: Array, mouth_m: float) -> Array:
    """The point nearest to `seen` on the way to `best` that catches as well as `best` does, with a margin."""

    def quality(centre: Array) -> tuple[float, bool]:
        away = np.linalg.norm(landing - centre, axis=1)
        return float(np.mean(away <= 0.6 * mouth_m)), bool(np.linalg.norm(deepest - centre) <= 0.6 * mouth_m)

    goal, goal_hit = quality(best)
    for part in np.linspace(0.0, 1.0, 101):
        centre = seen + part * (best - seen)
        caught, hit = quality(centre)
        if caught >= goal - 0.02 and (hit or not goal_hit):
            return np.asarray(centre)
    return best


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


def _shift_sentence(shift: Array, ray: Array | None) -> str:
    total_cm = 100 * float(np.linalg.norm(shift))
    if total_cm < 0.75:
        return "The receptacle stands where it was seen."
    if ray is None or np.linalg.norm(ray[:2]) < 1e-6:
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
