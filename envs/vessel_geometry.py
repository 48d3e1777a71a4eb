"""From a vessel to what the simulator needs: the hollow as a stack of polygons, and its walls as boxes.

Everything is in the vessel's frame (+z up, m). A cross-section is a convex polygon whose edge normals point in `n`
equally spaced directions, the same at every level; so the wall between two levels is a ring of planar strips, and
each strip becomes one box. Boxes only ever reach outward from the strips, hence the hollow stays free, and they
overlap at every seam, hence nothing leaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..extract.geometry import Array
from ..extract.vessel_types import polygon_areas, support_polygons

if TYPE_CHECKING:
    from ..extract.vessels import Profile, Vessel

MAX_FRUSTA = 4
PROFILE_TOLERANCE_M = 0.0004
# A particle that has sunk past the middle of a box is pushed out on the wrong side. A vessel that is swung needs
# thicker walls than one that stands; in a band below the rim they are thin so that the contents leave where the drawn
# wall ends. Floors and lids carry the whole load in a shake and may be thicker unseen.
SWUNG_WALL_M, STANDING_WALL_M, RIM_WALL_M, PLATE_M = 0.016, 0.01, 0.006, 0.02
RIM_BAND_M = 0.015
# How far neighbouring boxes run on beyond their seam, and how far that may reach into the hollow at a waist.
OVERLAP_M, INTRUSION_M = 0.006, 0.0001
# Strips shorter than a particle would only add edges for it to be squeezed between.
MIN_STRIP_M = 0.01
WIDE_RADIUS_M = 0.045
# What a finger needs between two walls.
FINGER_ROOM_M = 0.015
# Share of edges between faces of different colours; parts of one colour each stay below 0.05, textures above 0.1.
SPECKLED_SHARE = 0.07
_IDENTITY = np.eye(4)


@dataclass(frozen=True)
class Box:
    """A box in the vessel's frame: centre (3,), rotation (3, 3), half extents (3,); a cylinder if `round` (axis z)."""

    center_m: Array
    R: Array
    half_m: Array
    round: bool = False

    def distance_m(self, points_m: Array) -> Array:
        """(N,) distance of points (N, 3) from the surface, 0 inside."""
        local = (points_m - self.center_m) @ self.R
        if self.round:
            radial = np.hypot(local[:, 0], local[:, 1]) - self.half_m[0]
            gap = np.stack([radial, np.abs(local[:, 2]) - self.half_m[2]], axis=1)
        else:
            gap = np.abs(local) - self.half_m
        return np.asarray(np.linalg.norm(np.maximum(gap, 0.0), axis=1))


@dataclass(frozen=True)
class Cavity:
    """The hollow of a vessel between its floor and its rim.

    z_m: (L,) ascending levels; support_m: (L, n) distance of each polygon edge from the axis; normals: (n, 2) unit
    normals of the edges at angles 2 pi k / n; axis_xy_m: (2,) where the axis stands.
    """

    z_m: Array
    support_m: Array
    normals: Array
    axis_xy_m: Array

    def clearance_m(self, points_m: Array) -> Array:
        """(N,) signed horizontal or vertical distance from the nearest wall, floor or rim plane; positive inside."""
        z = points_m[:, 2]
        level = np.clip(np.searchsorted(self.z_m, z) - 1, 0, len(self.z_m) - 2)
        share = ((z - self.z_m[level]) / (self.z_m[level + 1] - self.z_m[level]))[:, None]
        support = self.support_m[level] * (1 - share) + self.support_m[level + 1] * share
        side = np.min(support - (points_m[:, :2] - self.axis_xy_m) @ self.normals.T, axis=1)
        return np.asarray(np.minimum(side, np.minimum(z - self.z_m[0], self.z_m[-1] - z)))

    def contains(self, points_m: Array, T: Array = _IDENTITY) -> NDArray[np.bool_]:
        """(N,) whether points (N, 3) lie in the hollow of a vessel at pose T (4, 4) in the points' frame."""
        normals, offsets = self._planes
        R, t = T[:3, :3], T[:3, 3]
        # The planes go to the points, not the points to the planes: there are fewer of them to turn.
        turned = R @ normals
        frusta = len(self.z_m) - 1
        beyond = (
            (points_m @ turned - (offsets + t @ turned)).reshape(len(points_m), frusta, len(self.normals)).max(axis=2)
        )
        z = (points_m - t) @ R[:, 2]
        level = np.searchsorted(self.z_m, z) - 1
        within = (level >= 0) & (level < frusta)
        return np.asarray(within & (beyond[np.arange(len(z)), np.where(within, level, 0)] <= 0.0))

    @cached_property
    def _planes(self) -> tuple[Array, Array]:
        """Normals (3, F n) and offsets (F n) of the wall's planes: a point is inside where normal . point <= offset."""
        slope = np.diff(self.support_m, axis=0) / np.diff(self.z_m)[:, None]
        flat = np.broadcast_to(self.normals, (*slope.shape, 2))
        normals = np.concatenate([flat, -slope[..., None]], axis=2)
        offsets = self.support_m[:-1] - slope * self.z_m[:-1, None] + self.normals @ self.axis_xy_m
        return np.ascontiguousarray(normals.reshape(-1, 3).T), offsets.ravel()

    @cached_property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Levels, supports, normals and axis, laid out for `kernels.sort_particles`."""
        parts = (self.z_m, self.support_m, self.normals, self.axis_xy_m)
        z, support, normals, axis = (np.ascontiguousarray(part, np.float64) for part in parts)
        return z, support, normals, axis

    @property
    def rim_m(self) -> float:
        """Height of the rim, or of the underside of the lid."""
        return float(self.z_m[-1])

    @property
    def reach_m(self) -> float:
        """Greatest distance of a wall from the axis."""
        return float(self.support_m.max())

    @property
    def throat_m(self) -> float:
        """Half width of the narrowest section between the widest one and the rim."""
        widths = self.support_m.min(axis=1)
        return float(widths[int(np.argmax(widths)) :].min())

    @property
    def volume_m3(self) -> float:
        """Volume of the stack of polygonal frusta."""
        step = 2 * math.pi / len(self.normals)
        left, right = self._edge_ends(step)
        lengths = right - left

        def mixed_area(a: int, b: int) -> float:
            return 0.5 * float(self.support_m[a] @ lengths[b])

        total = 0.0
        for low in range(len(self.z_m) - 1):
            # The area of a section linear in z is quadratic in z: Simpson's rule is exact.
            areas = mixed_area(low, low) + mixed_area(low + 1, low + 1)
            middle = 0.5 * areas / 2 + 0.25 * (mixed_area(low, low + 1) + mixed_area(low + 1, low))
            total += (self.z_m[low + 1] - self.z_m[low]) * (areas + 4 * middle) / 6
        return float(total)

    def sample(self, count: int) -> Array:
        """(count, 3) points spread evenly over the hollow, the same at every call (a Kronecker sequence)."""
        steps = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])
        low = np.array([*(self.axis_xy_m - self.reach_m * 1.1), self.z_m[0]])
        high = np.array([*(self.axis_xy_m + self.reach_m * 1.1), self.z_m[-1]])
        share = self.volume_m3 / float(np.prod(high - low))
        grid = np.arange(1, int(1.3 * count / share) + 200)[:, None] * steps % 1.0
        points = low + grid * (high - low)
        return np.asarray(points[self.contains(points)][:count])

    def walls(self, wall_m: float, rim_wall_m: float) -> list[Box]:
        """One box for each polygon edge between each two levels, `wall_m` thick, `rim_wall_m` between the top two."""
        step = 2 * math.pi / len(self.normals)
        left, right = self._edge_ends(step)
        frusta = len(self.z_m) - 1
        boxes = []
        for k, normal in enumerate(self.normals):
            tangent = np.array([-normal[1], normal[0], 0.0])
            outward = np.array([normal[0], normal[1], 0.0])
            run, rise = np.diff(self.support_m[:, k]), np.diff(self.z_m)
            slope = np.arctan2(run, rise)  # from the vertical, positive where the wall leans outward
            for i in range(frusta):
                depth_m = rim_wall_m if i == frusta - 1 else wall_m
                along = np.array([*(outward[:2] * math.sin(slope[i])), math.cos(slope[i])])
                normal_3d = np.array([*(outward[:2] * math.cos(slope[i])), -math.sin(slope[i])])
                # A hard hit sinks in and is pushed out through the nearest face: boxes overlap amply, so that this is
                # the inner face and no end or side. Where the wall bulges that also fills the wedge between two boxes.
                bend_below = slope[i - 1] - slope[i] if i else 0.0
                bend_above = slope[i] - slope[i + 1] if i < frusta - 1 else 0.0
                below = PLATE_M if i == 0 else _overlap_m(bend_below, wall_m)
                above = 0.0 if i == frusta - 1 else _overlap_m(bend_above, wall_m)
                spread = depth_m * math.tan(step / 2) + OVERLAP_M
                start = min(left[i, k], left[i + 1, k]) - spread
                end = max(right[i, k], right[i + 1, k]) + spread
                length = math.hypot(run[i], rise[i])
                foot = outward * self.support_m[i, k] + np.array([*self.axis_xy_m, self.z_m[i]])
                center = (
                    foot
                    + along * ((length + above - below) / 2)
                    + tangent * ((start + end) / 2)
                    + normal_3d * (depth_m / 2)
                )
                half = np.array([(end - start) / 2, (length + above + below) / 2, depth_m / 2])
                boxes.append(Box(center, np.column_stack([tangent, along, normal_3d]), half))
        return boxes

    def plate(self, level: int, *, above: bool) -> Box:
        """Floor (level 0, not `above`) or lid (level -1, `above`): a disc, or a box if the section is not round."""
        support = self.support_m[level]
        round_ = bool(np.ptp(support) < 0.05 * support.max())
        n = len(support)
        half_x, half_y = (max(support[k], support[k + n // 2]) + STANDING_WALL_M for k in (0, n // 4))
        z = self.z_m[level] + (PLATE_M if above else -PLATE_M) / 2
        return Box(np.array([*self.axis_xy_m, z]), np.eye(3), np.array([half_x, half_y, PLATE_M / 2]), round_)

    def _edge_ends(self, step: float) -> tuple[Array, Array]:
        """(L, n) tangential coordinates of both ends of each edge: where neighbouring edges cross."""
        h = self.support_m
        right = (np.roll(h, -1, axis=1) - h * math.cos(step)) / math.sin(step)
        left = -(np.roll(h, 1, axis=1) - h * math.cos(step)) / math.sin(step)
        return left, right


def cavity_of(vessel: Vessel) -> Cavity:
    """The hollow of a vessel, with few frusta of 12 (16 if wide) sides and the true section areas."""
    profile = vessel.interior
    mean_m = _mean_radii(profile)
    z = profile.z_m[_levels(np.column_stack([profile.z_m, mean_m]))]
    if z[-1] - z[-2] > 2 * RIM_BAND_M:
        z = np.insert(z, -1, z[-1] - RIM_BAND_M)
    r = _fitted(profile.z_m, mean_m, mean_m[:, None], z)[:, 0]
    n = 16 if r.max() > WIDE_RADIUS_M else 12
    angle = 2 * np.pi * np.arange(n) / n
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    normals[np.abs(normals) < 1e-12] = 0.0
    if profile.support_m is not None:
        return Cavity(z, _any_supports(profile, mean_m, z, n), normals, np.asarray(profile.axis_xy_m, float))
    corner = np.interp(z, profile.z_m, profile.corner)
    half = r[:, None] * np.array([1.0, profile.aspect])
    rho = corner * r * min(1.0, profile.aspect)
    # Corner arcs become polygon edges at the distance that keeps the area of the arc's disc.
    equal_area = math.sqrt(math.pi / (n * math.tan(math.pi / n)))
    support = (half - rho[:, None]) @ np.abs(normals).T + equal_area * rho[:, None]
    return Cavity(np.asarray(z, float), support, normals, np.asarray(profile.axis_xy_m, float))


def _mean_radii(profile: Profile) -> Array:
    """(K,) one radius for each section: its half extent, or that of the circle of its area if it has any shape."""
    if profile.support_m is None:
        return np.asarray(profile.radius_m)
    return np.asarray(np.sqrt(polygon_areas(support_polygons(profile.support_m)) / math.pi))


def _any_supports(profile: Profile, mean_m: Array, z: Array, n: int) -> Array:
    """(L, n) supports at levels `z` of sections of any shape, from the finer ones of a profile."""
    assert profile.support_m is not None
    fine = profile.support_m
    which = 2 * np.pi * np.arange(n) / n
    known = 2 * np.pi * np.arange(fine.shape[1] + 1) / fine.shape[1]
    coarse = np.stack([np.interp(which, known, np.append(row, row[0])) for row in fine])
    # Fewer edges stand around a larger polygon: all are drawn in alike until the areas agree.
    around = polygon_areas(support_polygons(coarse)) / (math.pi * mean_m**2)
    support = _fitted(profile.z_m, mean_m, coarse / np.sqrt(around)[:, None], z)
    for _ in range(3):
        # An edge that stands beyond where its neighbours meet would have less than no length.
        limit = (np.roll(support, 1, axis=1) + np.roll(support, -1, axis=1)) / (2 * math.cos(2 * math.pi / n))
        support = np.minimum(support, limit)
    return support


def _levels(profile: Array) -> NDArray[np.int64]:
    """Indices of at most `MAX_FRUSTA` + 1 profile points, always the worst-fitting one added next."""
    keep = [0, len(profile) - 1]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    while len(keep) <= MAX_FRUSTA:
        chord_r = np.interp(profile[:, 0], profile[keep, 0], profile[keep, 1])
        chord_slope = np.gradient(chord_r, profile[:, 0])
        error = np.abs(profile[:, 1] - chord_r) / np.sqrt(1 + chord_slope**2)
        error[np.abs(length[:, None] - length[keep]).min(axis=1) < MIN_STRIP_M] = 0.0
        worst = int(np.argmax(error))
        if error[worst] < PROFILE_TOLERANCE_M:
            break
        keep = sorted({*keep, worst})
    return np.array(keep)


def _overlap_m(bend_rad: float, wall_m: float) -> float:
    """How far a wall's box runs on past a bend, positive where the wall bulges.

    Past a bulge the box only gets farther from the hollow; past a waist it would stick into it, so it stops at once.
    """
    if bend_rad >= 0.0:
        return OVERLAP_M + wall_m * math.tan(min(bend_rad, 1.5) / 2)
    return min(OVERLAP_M, INTRUSION_M / math.sin(min(-bend_rad, 1.5)))


def _fitted(z: Array, weight_m: Array, values: Array, levels: Array) -> Array:
    """(L, C) values at `levels` whose straight joins come nearest to `values` (K, C) at z, as areas count."""
    fine = np.linspace(z[0], z[-1], 400)
    hats = np.stack([np.interp(fine, levels, row) for row in np.eye(len(levels))], axis=1)
    wanted = np.stack([np.interp(fine, z, column) for column in values.T], axis=1)
    weight = np.sqrt(np.interp(fine, z, weight_m))[:, None]
    fitted = np.linalg.lstsq(hats * weight, wanted * weight, rcond=None)[0]
    # Narrow floors (a bowl's) must not be fitted away.
    floor = np.stack([np.interp(levels, z, column) for column in values.T], axis=1)
    return np.asarray(np.maximum(fitted, 0.25 * floor))


def collision_boxes(vessel: Vessel, cavity: Cavity, wall_m: float = SWUNG_WALL_M) -> list[Box]:
    """Walls, floor and, for a closed vessel, the lid."""
    rim_wall_m = RIM_WALL_M if vessel.is_open else STANDING_WALL_M
    boxes = [*cavity.walls(wall_m, rim_wall_m), cavity.plate(0, above=False)]
    if not vessel.is_open:
        boxes.append(cavity.plate(-1, above=True))
    return boxes


@dataclass(frozen=True)
class _Mesh:
    """A trimesh told from others by its contents: each vessel brings a copy of its mesh, and most are seen again."""

    contents: tuple[int, ...]
    mesh: Any = field(compare=False)

    @staticmethod
    def of(mesh: Any) -> _Mesh:
        return _Mesh((hash(mesh), hash(mesh.visual.face_colors.tobytes())), mesh)


def visual_parts(mesh: Any, max_faces: int = 3000) -> tuple[tuple[tuple[float, ...], Array, NDArray[np.int64]], ...]:
    """(rgba, vertices (V, 3), faces (F, 3)) for each colour of a trimesh, decimated to about `max_faces` in all."""
    return _visual_parts(_Mesh.of(mesh), max_faces)


@lru_cache(maxsize=32)
def _visual_parts(of: _Mesh, max_faces: int) -> tuple[tuple[tuple[float, ...], Array, NDArray[np.int64]], ...]:
    mesh = of.mesh
    if len(mesh.faces) > max_faces and _is_speckled(mesh):
        mesh = _decimated_whole(mesh, max_faces)
    colors = np.ascontiguousarray(mesh.visual.face_colors, np.uint8)
    # Four bytes as one number: sorting rows takes ten times as long.
    packed = colors.view(np.uint32)[:, 0]
    parts = []
    for value in np.unique(packed):
        color = np.array([value]).view(np.uint8)
        part = mesh.submesh([np.flatnonzero(packed == value)], append=True, repair=False)
        keep = math.ceil(max_faces * len(part.faces) / len(mesh.faces))
        if keep < len(part.faces) and keep > 50:
            part = part.simplify_quadric_decimation(face_count=keep)
        rgba = tuple(float(v) / 255 for v in color)
        parts.append((rgba, np.asarray(part.vertices, float), np.asarray(part.faces, np.int64)))
    return tuple(parts)


@lru_cache(maxsize=32)
def _surface(of: _Mesh) -> Array:
    """(N, 3) points spread over a mesh."""
    import trimesh

    return np.asarray(trimesh.sample.sample_surface(of.mesh, 20000, seed=0)[0])


def convex_hull(mesh: Any) -> Any:
    """The hull of a trimesh as one; not to be changed."""
    return _convex_hull(_Mesh.of(mesh))


@lru_cache(maxsize=32)
def _convex_hull(of: _Mesh) -> Any:
    return of.mesh.convex_hull


def _is_speckled(mesh: Any) -> bool:
    """Whether colours change so often, as those from a texture do, that patches of one colour are next to nothing."""
    pairs = np.asarray(mesh.visual.face_colors)[mesh.face_adjacency]
    return bool(np.mean(np.any(pairs[:, 0] != pairs[:, 1], axis=1)) > SPECKLED_SHARE)


def _decimated_whole(mesh: Any, max_faces: int) -> Any:
    """A mesh with fewer faces, each in the colour of the nearest old one: patches by themselves would tear apart."""
    import trimesh
    from scipy.spatial import cKDTree

    fewer = mesh.simplify_quadric_decimation(face_count=max_faces)
    _, nearest = cKDTree(mesh.triangles_center).query(fewer.triangles_center)
    colors = np.asarray(mesh.visual.face_colors)[nearest]
    return trimesh.Trimesh(fewer.vertices, fewer.faces, process=False, face_colors=colors)


def gripper_half_width_m(vessel: Vessel, T_hand_object: Array, pad_m: float = 0.009, limit_m: float = 0.04) -> float:
    """How far each finger stands from the hand's middle when both touch the vessel between the pads, in m."""
    in_hand = _surface(_Mesh.of(vessel.mesh)) @ T_hand_object[:3, :3].T + T_hand_object[:3, 3]
    between = (
        (np.abs(in_hand[:, 0]) < pad_m) & (np.abs(in_hand[:, 2]) < pad_m) & (np.abs(in_hand[:, 1]) < 1.2 * limit_m)
    )
    if not np.any(between):
        return 0.0
    away = np.sort(np.abs(in_hand[between, 1]))
    # Held by its wall at the rim, a vessel has its far side beyond a finger.
    beyond = np.flatnonzero(np.diff(away) > FINGER_ROOM_M)
    return float(min(away[beyond[0]] if len(beyond) else away[-1], limit_m))
