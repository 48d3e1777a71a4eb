"""Shapes that vessels are put together from: lofted walls, bent tubes, domes; and the planar curves they follow.

Shapes become `manifold3d.Manifold`, so that unions and differences stay watertight, when they are asked for. Curves
in the symmetry plane are (K, 2) points (x, z); profiles of walls are (K, 2) points (z, r) with ascending z.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, wraps
from typing import Any, TypeAlias

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from .geometry import Array
from .vessel_types import section_outlines

# A plain alias, since a `type` statement would hide the class's methods.
Solid: TypeAlias = manifold3d.Manifold  # noqa: UP040

SEGMENTS = 64
TUBE_SEGMENTS = 24
KEPT = 128  # latest results of every function that is `remembered`


def remembered[**P, R](make: Callable[P, R]) -> Callable[P, R]:
    """A function that keeps its latest results by its arguments, arrays by what is in them.

    A fit changes one parameter of a vessel at a time, which leaves most of its parts as they were. Results are
    shared: none may be written to.
    """

    @lru_cache(KEPT)
    def kept(arguments: _Arguments) -> R:
        return make(*arguments.positional, **arguments.named)

    @wraps(make)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        return kept(_Arguments(args, kwargs))

    return wrapper


class _Arguments:
    """Arguments of a call, equal to others of the same values."""

    def __init__(self, positional: tuple[Any, ...], named: dict[str, Any]) -> None:
        self.positional, self.named = positional, named
        self._values = _hashable((positional, tuple(named.items())))

    def __hash__(self) -> int:
        return hash(self._values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Arguments) and self._values == other._values


def _hashable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    return tuple(map(_hashable, value)) if isinstance(value, (tuple, list)) else value


@dataclass(frozen=True)
class Shape:
    """A closed solid, made watertight by booleans only when `solid` is asked for: outlines do without.

    surfaces: vertices (V, 3) in m and faces (F, 3) of closed surfaces that together have its silhouette.
    """

    surfaces: tuple[tuple[Array, NDArray[np.int32]], ...]
    make: Callable[[], Solid] = field(repr=False)

    @cached_property
    def solid(self) -> Solid:
        return self.make()

    def __add__(self, other: Shape) -> Shape:
        return Shape(self.surfaces + other.surfaces, lambda: self.solid + other.solid)

    def __sub__(self, other: Shape) -> Shape:
        """Less a hole that does not show from outside."""
        return Shape(self.surfaces, lambda: self.solid - other.solid)


@dataclass(frozen=True)
class Lip:
    """A pouring lip: the rim pulled outward toward +x.

    reach_m: how far; depth_m: how far below the rim it begins; half_angle_rad: half its width around the axis.
    """

    reach_m: float
    depth_m: float
    half_angle_rad: float

    def rise(self, z_m: Array, rim_m: float) -> Array:
        """Share of the reach at height z: 0 below the lip, 1 at the rim and above."""
        s = np.clip((z_m - rim_m) / self.depth_m + 1.0, 0.0, 1.0)
        return np.asarray(s * s)

    def volume_m3(self, z_m: Array, radius_m: Array, rim_m: float) -> float:
        """Volume that the lip adds to a round interior, by integration over the height."""
        z: Array = np.linspace(rim_m - self.depth_m, min(rim_m, float(z_m[-1])), 400, dtype=np.float64)
        pull = self.reach_m * self.rise(z, rim_m)
        # The angular shape is cos^2, whose integral is a and that of its square 3a/4 over [-a, a].
        area = self.half_angle_rad * (np.interp(z, z_m, radius_m) * pull + 0.375 * pull**2)
        return float(np.trapezoid(area, z))


@remembered
def rounded_path(points: Array, fillet_m: float | Sequence[float], steps: int = 8) -> Array:
    """A polyline (K, D) with its inner corners replaced by circular arcs of radius `fillet_m` (one or K-2 values).

    An arc that would not fit between its neighbours is made smaller.
    """
    points = np.asarray(points, float)
    fillets = np.broadcast_to(np.asarray(fillet_m, float), (len(points) - 2,))
    path = [points[0]]
    for i, radius in enumerate(fillets, start=1):
        before, corner, after = points[i - 1 : i + 2]
        to_before, to_after = before - corner, after - corner
        length_before, length_after = np.linalg.norm(to_before), np.linalg.norm(to_after)
        u, v = to_before / length_before, to_after / length_after
        cos_half = math.sqrt(max(0.0, 0.5 * (1 + float(u @ v))))
        sin_half = math.sqrt(max(0.0, 1 - cos_half**2))
        if cos_half < 1e-6 or radius <= 0:
            path.append(corner)
            continue
        # A side shared with another corner may be used up to its middle only.
        share_before, share_after = 0.95 if i == 1 else 0.49, 0.95 if i == len(points) - 2 else 0.49
        tangent = min(radius * cos_half / sin_half, share_before * length_before, share_after * length_after)
        radius = tangent * sin_half / cos_half
        center = corner + (u + v) / np.linalg.norm(u + v) * (radius / sin_half)
        start, end = corner + u * tangent - center, corner + v * tangent - center
        sweep = math.acos(float(np.clip(start @ end / radius**2, -1, 1)))
        t = np.linspace(0, 1, steps + 1)[:, None]
        path.extend(center + (np.sin((1 - t) * sweep) * start + np.sin(t * sweep) * end) / math.sin(sweep))
    path.append(points[-1])
    kept = [path[0]]
    for point in path[1:]:
        if math.dist(point, kept[-1]) > 1e-7:
            kept.append(point)
    return np.asarray(kept)


@remembered
def smooth_profile(knots: Sequence[tuple[float, float]], count: int = 80) -> Array:
    """(count, 2) monotone-per-piece smooth curve (z, r) through knots with ascending z."""
    z, r = np.asarray(knots, float).T
    fine = np.linspace(z[0], z[-1], count)
    return np.column_stack([fine, PchipInterpolator(z, r)(fine)])


def resampled(profile: Array, spacing_m: float) -> Array:
    """Profile (z, r) with points added so that no two neighbours are farther apart than `spacing_m`."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    wanted = np.linspace(0, length[-1], max(2, math.ceil(length[-1] / spacing_m) + 1))
    fine = np.union1d(wanted, length)
    return np.column_stack([np.interp(fine, length, profile[:, 0]), np.interp(fine, length, profile[:, 1])])


def simplified(profile: Array, tolerance_m: float) -> Array:
    """Profile with the points left out that lie within `tolerance_m` of the chord (Douglas-Peucker)."""
    keep = np.zeros(len(profile), bool)
    keep[[0, -1]] = True
    stack = [(0, len(profile) - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        chord = profile[b] - profile[a]
        offset = profile[a + 1 : b] - profile[a]
        distance = np.abs(chord[0] * offset[:, 1] - chord[1] * offset[:, 0]) / max(float(np.linalg.norm(chord)), 1e-12)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance_m:
            keep[a + 1 + worst] = True
            stack += [(a, a + 1 + worst), (a + 1 + worst, b)]
    return np.asarray(profile[keep])


def eroded(outer: Array, wall_m: float, floor_z_m: float, top_z_m: float) -> Array:
    """Inner profile (z, r) everywhere `wall_m` from the outer one, from the floor to the top.

    Morphological erosion by a disc: it follows shoulders and flares at their true normal distance and closes
    gracefully where the vessel narrows.
    """
    fine = resampled(outer, max(wall_m / 3, float(np.ptp(outer[:, 0])) / 1200))
    z = np.unique(np.concatenate([[floor_z_m, top_z_m], fine[(fine[:, 0] > floor_z_m) & (fine[:, 0] < top_z_m), 0]]))
    # Only samples within the disc of each height are looked at, as many for every height.
    first = np.searchsorted(fine[:, 0], z - wall_m)
    most = int((np.searchsorted(fine[:, 0], z + wall_m, side="right") - first).max()) + 1
    near = fine[np.minimum(first[:, None] - 1 + np.arange(most + 1), len(fine) - 1).clip(0)]
    gap = np.abs(z[:, None] - near[..., 0])
    with np.errstate(invalid="ignore"):
        reach = near[..., 1] - np.sqrt(np.where(gap <= wall_m, wall_m**2 - gap**2, np.nan))
    # Exactly at each z the wall is as thick as the disc even where the samples miss it.
    r = np.fmin(np.nanmin(reach, axis=1), np.interp(z, outer[:, 0], outer[:, 1]) - wall_m)
    return np.column_stack([z, r])


def round_off(profile: Array, bottom_m: float, top_m: float, *, top_outward: bool = False) -> Array:
    """Profile with its bottom edge rounded inward by `bottom_m` and its top edge by `top_m`.

    top_outward: widen instead of narrow at the top, as the inner edge of a rim does.
    """
    z, r = profile[:, 0], profile[:, 1]
    low, high = z[0], z[-1]
    steps = 1 - np.cos(np.linspace(0, 0.5 * np.pi, 7))
    fine = np.unique(np.concatenate([z, low + bottom_m * steps, high - top_m * steps]).round(7))
    fine = np.unique(np.clip(fine, low, high))
    radius = np.interp(fine, z, r)
    if bottom_m > 0:
        depth = np.clip(low + bottom_m - fine, 0, bottom_m)
        radius = radius - (bottom_m - np.sqrt(np.maximum(bottom_m**2 - depth**2, 0.0)))
    if top_m > 0:
        depth = np.clip(fine - (high - top_m), 0, top_m)
        change = top_m - np.sqrt(np.maximum(top_m**2 - depth**2, 0.0))
        radius = radius + change if top_outward else radius - change
    return np.column_stack([fine, radius])


def _solid(vertices: Array, faces: NDArray[np.int32]) -> Solid:
    mesh = manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(vertices, np.float64),
        tri_verts=np.ascontiguousarray(faces, np.uint64),
    )
    solid = Solid(mesh)
    if solid.is_empty():
        raise ValueError(f"the loft is not a closed surface ({solid.status()})")
    return solid


def stacked_rings(rings: Array) -> Shape:
    """Shape between K stacked polygons (K, n, 3), each counter-clockwise seen from ahead, with flat end caps."""
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    faces = _stacked_faces(*rings.shape[:2])
    return Shape(((vertices, faces),), lambda: _solid(vertices, faces))


@lru_cache(maxsize=256)
def _stacked_faces(levels: int, n: int) -> NDArray[np.int32]:
    """(F, 3) faces between stacked rings of n vertices, whose caps have their middles after them."""
    ring = np.arange(n)
    following = np.roll(ring, -1)
    a = n * np.arange(levels - 1)[:, None]
    b = a + n
    lower = np.stack([a + ring, a + following, b + following], axis=-1)
    upper = np.stack([a + ring, b + following, b + ring], axis=-1)
    sides = np.concatenate([lower, upper], axis=1).reshape(-1, 3)
    top = (levels - 1) * n
    low_cap = np.column_stack([np.full(n, levels * n), following, ring])
    high_cap = np.column_stack([np.full(n, levels * n + 1), top + ring, top + following])
    faces: NDArray[np.int32] = np.concatenate([sides, low_cap, high_cap]).astype(np.int32)
    faces.setflags(write=False)  # shared
    return faces


@remembered
def lofted(
    profile: Array,
    corner: Array | None = None,
    aspect: float = 1.0,
    lip: Lip | None = None,
    rim_m: float = 0.0,
    sides: int = 0,
) -> Shape:
    """Shape whose horizontal cross-sections follow profile (z, r), closed by flat discs below and above.

    sides: 0 for the cross-section of corner and aspect, else a regular polygon around the circle of radius r.
    """
    z, r = profile[:, 0], profile[:, 1]
    if sides:
        turn = 2 * np.pi * (np.arange(SEGMENTS) / SEGMENTS + 0.5 / sides)
        off_middle = (turn + np.pi / sides) % (2 * np.pi / sides) - np.pi / sides
        unit = np.stack([np.cos(turn), np.sin(turn)], axis=-1) / np.cos(off_middle)[:, None]
        xy = r[:, None, None] * unit
    else:
        xy = section_outlines(r, np.ones_like(r) if corner is None else corner, aspect, SEGMENTS)
    if lip is not None:
        angle = np.arctan2(xy[..., 1], xy[..., 0])
        shape = np.where(np.abs(angle) < lip.half_angle_rad, np.cos(0.5 * np.pi * angle / lip.half_angle_rad) ** 2, 0.0)
        pull = lip.reach_m * lip.rise(z, rim_m)[:, None] * shape
        xy = xy * (1 + pull / np.linalg.norm(xy, axis=-1))[..., None]
    return stacked_rings(np.concatenate([xy, np.broadcast_to(z[:, None, None], (*xy.shape[:2], 1))], axis=-1))


@remembered
def tube(path: Array, half_m: Array | float, half_y_m: Array | float | None = None, *, dome: float = 0.0) -> Shape:
    """Tube along a path (K, 2) of (x, z) in the symmetry plane, of elliptic cross-section.

    half_m: half thickness within the plane, one value or (K,); half_y_m: across it, equal to half_m if None.
    dome: height of the domes that close the ends over half_m; 0 closes them by flat discs.
    """
    path = np.asarray(path, float)
    a = np.array(np.broadcast_to(np.asarray(half_m, float), (len(path),)))
    b = a if half_y_m is None else np.array(np.broadcast_to(np.asarray(half_y_m, float), (len(path),)))
    edges = np.diff(path, axis=0)
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    tangent = np.vstack([edges[:1], edges[:-1] + edges[1:], edges[-1:]])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    if dome > 0:
        turn = np.linspace(0, 0.5 * np.pi, 6)[1:-1]
        turn = np.append(turn, np.deg2rad(86.0))
        start = path[0] - tangent[0] * (dome * a[0] * np.sin(turn))[::-1, None]
        end = path[-1] + tangent[-1] * (dome * a[-1] * np.sin(turn))[:, None]
        path = np.vstack([start, path, end])
        tangent = np.vstack([np.tile(tangent[0], (5, 1)), tangent, np.tile(tangent[-1], (5, 1))])
        shrink = np.concatenate([np.cos(turn)[::-1], np.ones(len(a)), np.cos(turn)])
        a, b = np.pad(a, 5, "edge") * shrink, np.pad(b, 5, "edge") * shrink
    angle = 2 * np.pi * (np.arange(TUBE_SEGMENTS) + 0.5) / TUBE_SEGMENTS
    # (normal, y, tangent) must be right-handed for the rings to run counter-clockwise seen from ahead.
    normal = np.column_stack([tangent[:, 1], np.zeros(len(path)), -tangent[:, 0]])
    center = np.column_stack([path[:, 0], np.zeros(len(path)), path[:, 1]])
    rings = center[:, None] + (a[:, None] * np.cos(angle))[..., None] * normal[:, None]
    rings = rings + (b[:, None] * np.sin(angle))[..., None] * np.array([0.0, 1.0, 0.0])
    return stacked_rings(rings)


def cumulative_share(path: Array) -> Array:
    """(K,) share of the path's length at each point, from 0 to 1."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.asarray(length / length[-1])
