"""What is fixed to the walls of a mesh: handles, spouts, lips; where they let the contents out and can be held.

Works on points of the upright mesh's surface (+z up, m) and its `Hollow`: whatever lies well outside of the outer wall
is a part, and the parts are told apart by where the wall or the surface is open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .geometry import Array
from .mesh_columns import Columns, Faces
from .mesh_profile import RAYS, Hollow, ray_toward, ring_angles, ring_supports
from .mesh_rays import first_hit_m
from .vessel_types import GraspRegion, Outlet

# Nearer to the wall than this belongs to it; points closer together than the link are one part.
OUTSIDE_M, OUTSIDE_SHARE, LINK_M = 0.004, 0.05, 0.007
# Smaller ones are knobs, valves and labels.
PART_M, HANDLE_REACH_M, BAIL_M = 0.022, 0.014, 0.04
# A rim that stands out on one side only, by so much, over so small an angle at half its reach, is a pouring lip if the
# wall deeper down does not. All of it lies within the larger angle.
LIP_M, LIP_SHARE, LIP_HALF_RAD, LIP_ANGLE_RAD = 0.002, 0.03, math.radians(28), math.radians(70)
LIP_DEPTH, LIP_LEFT = 0.3, 0.2
# A hole in the lid over a beak is at least so large.
BEAK_M2 = 8e-6
# Holes and pits belong to the part in about the same direction; one can look so far into the end of an open tube.
SAME_WAY_RAD, OPEN_M, MAX_LOOK_M = 0.35, 0.005, 0.04
# What the fingers of a parallel hand span; a stretch of wall that is narrower can be held.
HAND_M, GRIP_M = 0.078, 0.02


@dataclass(frozen=True)
class Part:
    """Something fixed to the wall: surface points (N, 3), its direction from the axis, how far it reaches beyond."""

    kind: Literal["side", "over"]
    points: Array
    angle_rad: float
    reach_m: float


@dataclass(frozen=True)
class Features:
    """heading_rad: direction of the outlet, or where +x is to be when there is none. outlet: in the mesh's frame.

    lip_rad: direction of a pulled-out lip, None without one. has_mouth: False when nothing lets the contents out.
    """

    outlet: Outlet
    heading_rad: float
    lip_rad: float | None
    handles: tuple[Part, ...]
    spout: Part | None
    has_mouth: bool


def find_features(points: Array, vertices: Array, faces: Faces, hollow: Hollow, *, cut: bool) -> Features:
    """Handle, spout and lip of an upright mesh from (N, 3) points spread over its surface.

    cut: the rim is where the mesh was cut open, so that its shape means nothing.
    """
    parts = _parts(points, hollow)
    sides = [part for part in parts if part.kind == "side"]
    pits = [pit for pit in Columns(vertices, faces).pits() if _is_outlet_pit(pit.center_xy_m, pit.area_m2, hollow)]
    if hollow.is_open:
        pits = []
    spout = _spout(sides, vertices, faces, hollow, [_angle(pit.center_xy_m - hollow.axis_xy_m) for pit in pits])
    handles = tuple(sorted((p for p in parts if p is not spout and _is_handle(p)), key=lambda p: -p.reach_m))
    if spout is not None:
        outlet, _ = _spout_outlet(spout, hollow, vertices, faces)
        return Features(outlet, spout.angle_rad, None, handles, spout, True)
    if hollow.two_sided and pits:
        # A beak: a hole through the lid over a pulled-out lip.
        pit = max(pits, key=lambda pit: pit.depth_m)
        angle = _angle(pit.center_xy_m - hollow.axis_xy_m)
        radius = math.sqrt(pit.area_m2 / math.pi)
        entry = np.array([*pit.center_xy_m, min(pit.spill_m, float(hollow.z_m[-1]))])
        tip = np.array([*pit.center_xy_m, pit.spill_m])
        direction = np.array([0.8 * math.cos(angle), 0.8 * math.sin(angle), 0.6])
        return Features(Outlet("spout", tip, direction, entry, radius, radius), angle, None, handles, None, True)
    lip_rad = _lip(hollow) if hollow.is_open and not cut else None
    behind = next((part for part in handles if part.kind == "side"), None)
    heading = _long_axis_rad(hollow)
    if lip_rad is not None:
        heading = lip_rad
    elif behind is not None:
        heading = behind.angle_rad + math.pi
    return Features(_lip_outlet(hollow, heading), heading, lip_rad, handles, None, hollow.is_open)


def _angle(xy: Array) -> float:
    return math.atan2(float(xy[1]), float(xy[0]))


def _apart(a: float, b: float) -> float:
    return abs(math.remainder(a - b, 2 * math.pi))


def _outer_at(hollow: Hollow, z: Array, angle: Array) -> Array:
    """(N,) distance of the outer wall from the axis, held constant above and below it."""
    above = np.clip(np.searchsorted(hollow.outer_z_m, z), 0, len(hollow.outer_z_m) - 1)
    ray = ray_toward(angle)
    # Of the rows above and below the wider one: a foot's step is no part.
    return np.asarray(np.maximum(hollow.outer_m[above, ray], hollow.outer_m[np.maximum(above - 1, 0), ray]))


def _parts(points: Array, hollow: Hollow) -> list[Part]:
    """Connected groups of points outside of the wall, the small ones left out."""
    flat = points[:, :2] - hollow.axis_xy_m
    radius, angle = np.hypot(flat[:, 0], flat[:, 1]), np.arctan2(flat[:, 1], flat[:, 0])
    wall = _outer_at(hollow, points[:, 2], angle)
    beyond, over = radius - wall, points[:, 2] - float(hollow.outer_z_m[-1])
    chosen = (beyond > OUTSIDE_M + OUTSIDE_SHARE * wall) | (over > OUTSIDE_M)
    found = []
    groups = _linked(points, np.flatnonzero(chosen))
    while groups:
        mine = groups.pop()
        if len(mine) < 20 or np.ptp(points[mine], axis=0).max() < PART_M:
            continue
        aside = flat[mine]
        # A handle over the top has its middle near the axis, or bridges it.
        centred = float(np.linalg.norm(aside.mean(axis=0))) < 0.5 * float(hollow.outer_m.max())
        if centred and over[mine].max() > PART_M:
            if np.ptp(aside, axis=0).max() > BAIL_M:
                found.append(Part("over", points[mine], 0.0, float(over[mine].max())))
            continue
        if _spread_rad(aside) > math.pi:
            # A flared rim, perhaps with a handle under it: what stands out farther is looked at by itself.
            if beyond[mine].min() < HANDLE_REACH_M:
                groups += _linked(points, mine[beyond[mine] > HANDLE_REACH_M])
            continue
        reach = float(beyond[mine].max())
        far = aside[beyond[mine] >= 0.5 * reach]
        found.append(Part("side", points[mine], _angle(far.mean(axis=0)), reach))
    return found


def _linked(points: Array, index: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The chosen points (indices) in groups that hang together."""
    if len(index) == 0:
        return []
    pairs = cKDTree(points[index]).query_pairs(LINK_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(index),) * 2)
    count, labels = connected_components(graph, directed=False)
    return [index[labels == number] for number in range(count)]


def _spread_rad(xy: Array) -> float:
    """The angle that points (N, 2) take up around the origin."""
    angle = np.sort(np.arctan2(xy[:, 1], xy[:, 0]))
    return 2 * math.pi - float(np.max(np.diff(np.append(angle, angle[0] + 2 * np.pi))))


def _is_outlet_pit(center_xy: Array, area_m2: float, hollow: Hollow) -> bool:
    """Whether a pit is a mouth out on one side, as a spout's or a beak's is."""
    away = float(np.linalg.norm(center_xy - hollow.axis_xy_m))
    return away > 0.5 * float(np.median(hollow.inner_m)) and area_m2 > BEAK_M2


def _is_handle(part: Part) -> bool:
    return part.reach_m > HANDLE_REACH_M


def _spout(sides: list[Part], vertices: Array, faces: Faces, hollow: Hollow, pit_angles: list[float]) -> Part | None:
    """The part into which the hollow opens and which is open at its end, or which rain can enter."""
    deep = []
    for part in sides:
        depth = _spout_outlet(part, hollow, vertices, faces)[1]
        ways = [_apart(part.angle_rad, _angle(hole.center_m[:2] - hollow.axis_xy_m)) for hole in hollow.holes]
        # Through a wall of one surface one looks into every handle, so a hole in it tells nothing.
        opens_in = hollow.two_sided and (not hollow.is_open or min(ways, default=math.pi) < SAME_WAY_RAD)
        if depth > 2 * OPEN_M and opens_in:
            deep.append((depth, part))
    if deep:
        return max(deep, key=lambda found: found[0])[1]
    for angle in pit_angles:
        near = [part for part in sides if _apart(part.angle_rad, angle) < SAME_WAY_RAD]
        if near:
            return max(near, key=lambda part: part.reach_m)
    return None


def _look_in_m(point: Array, direction: Array, radius_m: float, vertices: Array, faces: Faces) -> float:
    """How far one can look into an open end against its direction, from a little before its mouth."""
    aside = min(0.3 * radius_m, 0.001) * np.cross(direction, [0.0, 0.0, 1.0])
    start = point + OPEN_M * direction
    return float(
        np.median([first_hit_m(vertices, faces, start + look, -direction) for look in (0.0 * aside, aside, -aside)])
    )


def _spout_outlet(spout: Part, hollow: Hollow, vertices: Array, faces: Faces) -> tuple[Outlet, float]:
    """Mouth, channel and entry of a spout; and how far one can look into its mouth, in m."""
    outward = np.array([math.cos(spout.angle_rad), math.sin(spout.angle_rad), 0.0])
    side = np.array([-outward[1], outward[0], 0.0])
    axis = np.array([*hollow.axis_xy_m, 0.0])
    local = (spout.points - axis) @ np.column_stack([outward, side, [0.0, 0.0, 1.0]])
    around = spout.points.min(axis=0) - 0.01, spout.points.max(axis=0) + 0.01
    close = np.all((vertices > around[0]) & (vertices < around[1]), axis=1)
    faces = faces[close[faces].any(axis=1)]
    tried: list[tuple[float, Array, Array, float]] = []
    # The mouth faces some way up or down along the spout: the middle of the ways one can look far into it.
    low, height = float(local[:, 2].min()), float(np.ptp(local[:, 2]))
    for elevation in np.deg2rad(np.arange(-51.0, 91.0, 3.0)):
        run = np.array([math.cos(elevation), 0.0, math.sin(elevation)])
        forward = local @ run
        mouth = local[forward > forward.max() - 0.0025]
        middle = 0.5 * (mouth.min(axis=0) + mouth.max(axis=0))
        middle[1] = 0.0
        if middle[2] < low + 0.6 * height and elevation < 1.5:
            continue  # a bend
        middle += (forward.max() - middle @ run) * run
        radius = max(0.5 * float(np.ptp(mouth[:, 1])) - hollow.wall_m, 0.001)
        tip = axis + middle[0] * outward + np.array([0.0, 0.0, middle[2]])
        direction = run[0] * outward + np.array([0.0, 0.0, run[2]])
        depth = min(_look_in_m(tip, direction, radius, vertices, faces), MAX_LOOK_M)
        tried.append((depth, tip, direction, radius))
    deepest = max(look[0] for look in tried)
    good = [look for look in tried if look[0] > 0.8 * deepest]
    depth, tip, direction, tip_radius = good[len(good) // 2]
    # A rose is wide, its hole is not.
    tip_radius = min(tip_radius, first_hit_m(vertices, faces, tip - OPEN_M * direction, side))
    near = [
        h for h in hollow.holes if _apart(_angle(h.center_m[:2] - hollow.axis_xy_m), spout.angle_rad) < SAME_WAY_RAD
    ]
    if near:
        entry, entry_radius = near[0].center_m, near[0].radius_m
    else:
        # A wall of one surface hides where the channel begins: where the spout leaves it, then.
        root = local[local[:, 0] < local[:, 0].min() + 0.01, 2]
        z = float(np.clip(root.mean(), hollow.z_m[0], hollow.z_m[-1]))
        ring = hollow.inner_m[int(np.argmin(np.abs(hollow.z_m - z)))]
        entry = axis + ring[ray_toward(spout.angle_rad)] * outward + np.array([0.0, 0.0, z])
        entry_radius = max(0.5 * float(np.ptp(root)) - hollow.wall_m, tip_radius)
    return Outlet("spout", tip, direction, np.asarray(entry, float), float(entry_radius), tip_radius), depth


def _lip(hollow: Hollow) -> float | None:
    """Direction in which the rim alone stands out, compared with the rim across."""
    rim = hollow.inner_m[-1]
    excess = rim - np.roll(rim, RAYS // 2)
    peak = float(excess.max())
    if peak < LIP_M + LIP_SHARE * float(np.median(rim)):
        return None
    high = excess > 0.5 * peak
    deep = hollow.inner_m[round((1 - LIP_DEPTH) * len(hollow.inner_m))]
    left = (deep - np.roll(deep, RAYS // 2))[int(np.argmax(excess))]
    if high.mean() * np.pi > LIP_HALF_RAD or abs(left) > LIP_LEFT * peak:
        return None
    angle = ring_angles()
    return float(np.angle(np.sum(np.where(high, excess, 0.0) * np.exp(1j * angle))))


def without_lip(hollow: Hollow, lip_rad: float) -> Array:
    """(L, RAYS) inner rings whose lip is replaced by what stands across."""
    within = np.abs(np.angle(np.exp(1j * (ring_angles() - lip_rad)))) < LIP_ANGLE_RAD
    opposite = np.roll(hollow.inner_m, RAYS // 2, axis=1)
    return np.asarray(np.where(within, np.minimum(hollow.inner_m, opposite), hollow.inner_m))


def _long_axis_rad(hollow: Hollow) -> float:
    """Direction of the widest section's longer side, nearest to +x; 0 when none is much longer."""
    ring = hollow.outer_m[int(np.argmax(hollow.outer_m.mean(axis=1)))]
    angle = ring_angles()
    second = np.mean(ring**4 * np.exp(2j * angle)) / np.mean(ring**4)
    return 0.5 * float(np.angle(second)) if abs(second) > 0.08 else 0.0


def _lip_outlet(hollow: Hollow, heading_rad: float) -> Outlet:
    rim = hollow.inner_m[-1]
    radius = float(rim[ray_toward(heading_rad)])
    outward = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    point = np.array([*(hollow.axis_xy_m + (radius + 0.5 * hollow.wall_m) * outward), hollow.z_m[-1]])
    return Outlet("lip", point, np.array([*outward, 0.0]))


def grasp_regions(handles: tuple[Part, ...], hollow: Hollow) -> tuple[GraspRegion, ...]:
    """Handles, the farthest-reaching first, then the stretches of the body that a hand can close on."""
    grasps = [region for part in handles if (region := _handle_region(part, hollow)) is not None]
    return (*grasps, *_body_regions(hollow, sideways=bool(handles)))


def _handle_region(part: Part, hollow: Hollow) -> GraspRegion | None:
    """The stretch of a handle farthest from the body; along most of it if it is a stick."""
    outward = np.array([math.cos(part.angle_rad), math.sin(part.angle_rad), 0.0])
    if part.kind == "over":
        outward = np.array([0.0, 0.0, 1.0])
    along = part.points @ outward
    reach, height = float(np.ptp(along)), float(np.ptp(part.points[:, 2]))
    stick = part.kind == "side" and reach > 1.6 * height
    share = (along - along.min()) / reach
    grip = part.points[(share > 0.3) & (share < 0.95) if stick else share > 0.75]
    middle = grip.mean(axis=0)
    axis = np.linalg.svd(grip - middle, full_matrices=False)[2][0]
    across = np.cross(np.array([0.0, 0.0, 1.0]), outward)
    if part.kind == "side":
        # Handles lie in the plane through the axis; scans are a little off.
        axis = axis - (axis @ across) * across
    else:
        axis[2] = 0.0
    if np.linalg.norm(axis) < 0.3:
        return None
    axis = axis / np.linalg.norm(axis) * (1.0 if axis[2] >= 0 else -1.0)
    approach = np.array([0.0, 0.0, -1.0]) if stick else -outward
    approach = approach - (approach @ axis) * axis
    if np.linalg.norm(approach) < 0.3:
        return None
    approach /= np.linalg.norm(approach)
    closing = np.cross(axis, approach)
    local = (grip - middle) @ np.column_stack([axis, closing, approach])
    near = np.abs(local[:, 0]) < 0.25 * float(np.ptp(local[:, 0]))
    width = float(np.ptp(np.percentile(local[near, 1], [1, 99])))
    shift = 0.5 * (local[near].min(axis=0) + local[near].max(axis=0))
    shift[0] = 0.5 * (local[:, 0].min() + local[:, 0].max())
    center = middle + np.column_stack([axis, closing, approach]) @ shift
    length = float(np.ptp(local[:, 0]))
    if part.kind == "over" and length < 1.5 * width:
        return None  # a knob
    return GraspRegion("handle", center, axis, length, max(width, 0.002), approach)


def _body_regions(hollow: Hollow, *, sideways: bool) -> tuple[GraspRegion, ...]:
    """Stretches of the outside between foot and rim that are narrow enough, the longest two; else its middle."""
    z = hollow.outer_z_m
    support = ring_supports(hollow.outer_m, 36)
    # Fingers close across the approach: along x when the hand comes from the side.
    near, far = (0, 18) if sideways else (9, 27)
    width = support[:, near] + support[:, far]
    approach = np.array([0.0, -1.0, 0.0]) if sideways else np.array([1.0, 0.0, 0.0])
    steep = np.abs(np.gradient(width, z)) < 0.8
    fits = (width < HAND_M) & steep & (z > z[0] + 0.01) & (z < hollow.z_m[-1] - 0.004)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fits.astype(np.int64), [0]])))
    runs = [(a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if z[b - 1] - z[a] > GRIP_M]
    runs = sorted(runs, key=lambda run: float(z[run[0]] - z[run[1]]))[:2]
    if not runs:
        height = float(hollow.z_m[-1] - z[0])
        a, b = (int(np.searchsorted(z, z[0] + part * height)) for part in (0.3, 0.9))
        runs = [(a, min(b, len(z) - 1))]
    regions = []
    for a, b in runs:
        rows = slice(a, b + 1)
        shift = 0.5 * (support[rows, near] - support[rows, far]).mean()
        x, y = (shift, 0.0) if sideways else (0.0, shift)
        center = np.array([hollow.axis_xy_m[0] + x, hollow.axis_xy_m[1] + y, 0.5 * (z[a] + z[b])])
        up = np.array([0.0, 0.0, 1.0])
        regions.append(GraspRegion("body", center, up, float(z[b] - z[a]), float(width[rows].max()), approach))
    return tuple(regions)
