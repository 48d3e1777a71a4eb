"""The hollow inside an upright mesh: how far its walls stand from an axis within, at every height and all round.

Works on vertices (V, 3) in m and faces (F, 3) of any mesh, watertight or not, with walls of one surface or two. A
hollow is described by rays: from a vertical axis to the first surface, at many heights and in many directions.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .errors import UserError
from .geometry import Array
from .mesh_columns import MIN_DEPTH, MIN_DEPTH_M, Columns, Faces, Pit
from .mesh_rays import radial_hits

RAYS, LEVELS, MOST_HITS = 180, 80, 8
# Two surfaces so close to one another are the two sides of a wall; a single one is taken as so thick.
MAX_WALL_M, MAX_WALL_SHARE, SINGLE_WALL_M = 0.016, 0.4, 0.0015
# A ring of distances jumps where a spout's channel opens in the wall or something stands in the way; no wall does.
JUMP_M, JUMP_SHARE, MAX_GAP_RAD = 0.003, 0.15, math.radians(100)


@dataclass(frozen=True)
class Hole:
    """An opening in the wall: middle (3,) on the inner surface, radius of a circle of the same area."""

    center_m: Array
    radius_m: float


@dataclass(frozen=True)
class Hollow:
    """Inner and outer distances from the axis.

    axis_xy_m: (2,). z_m: (L,) heights from floor to rim, or to the underside of the lid. inner_m: (L, RAYS) distance
    of the inner surface in the directions 2 pi (k + 1/2) / RAYS; a pouring lip is part of it, a spout's channel not.
    outer_z_m: (M,), outer_m: (M, RAYS): of the outer surface without handle and spout, from foot to top.
    two_sided: whether the wall has two surfaces. holes: where channels leave it.
    """

    axis_xy_m: Array
    z_m: Array
    inner_m: Array
    outer_z_m: Array
    outer_m: Array
    wall_m: float
    is_open: bool
    two_sided: bool
    holes: tuple[Hole, ...]

    @property
    def volume_m3(self) -> float:
        """Volume from floor to rim or lid, a lip included, a spout's channel left out."""
        return float(np.trapezoid(ring_areas(self.inner_m), self.z_m))

    @property
    def middles_m(self) -> Array:
        """(L, 2) where the middle of each section is, from the axis."""
        return _centroids(self.inner_m)

    @property
    def throat_m(self) -> float:
        """Half width of the narrowest section above the widest one."""
        half = half_widths(self.inner_m)
        return float(half[int(np.argmax(half)) :].min())


def ring_angles(count: int = RAYS) -> Array:
    """(count,) directions of the rays, in rad from +x."""
    return np.asarray(2 * np.pi * (np.arange(count) + 0.5) / count)


def ray_toward(angle_rad: Any) -> Any:
    """Index of the ray nearest to an angle, or to each of an array of them."""
    return np.floor_divide(np.mod(angle_rad, 2 * np.pi), 2 * np.pi / RAYS).astype(np.int64) % RAYS


def ring_areas(rings_m: Array) -> Array:
    """(L,) areas of the polygons through points at distances (L, n) in equally spaced directions."""
    n = rings_m.shape[1]
    return np.asarray(0.5 * math.sin(2 * math.pi / n) * np.sum(rings_m * np.roll(rings_m, -1, axis=1), axis=1))


def ring_points(rings_m: Array) -> Array:
    """(L, n, 2) the points themselves."""
    angle = ring_angles(rings_m.shape[1])
    return np.asarray(rings_m[..., None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def ring_supports(rings_m: Array, count: int) -> Array:
    """(L, count) support distances of the convex hulls of rings (L, n), in the directions 2 pi k / count."""
    angle = 2 * np.pi * np.arange(count) / count
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray((ring_points(rings_m) @ normals.T).max(axis=1))


def half_widths(rings_m: Array) -> Array:
    """(L,) half of the smallest width of each ring."""
    support = ring_supports(rings_m, 36)
    return np.asarray(0.5 * (support + np.roll(support, 18, axis=1)).min(axis=1))


def find_hollow(vertices: Array, faces: Faces) -> Hollow:
    """The hollow of a mesh that stands upright (+z up).

    Raises UserError when there is none.
    """
    columns = Columns(vertices, faces)
    mouth = columns.mouth()
    if mouth is not None:
        return _hollow_between(vertices, faces, columns, mouth, _open_span(columns, mouth))
    found = [_hollow_between(vertices, faces, columns, None, span) for span in _closed_spans(columns)]
    # Between two surfaces there may be air or solid stuff: what has a wall around it is a hollow.
    return max(found, key=lambda hollow: (hollow.two_sided, hollow.volume_m3))


def _hollow_between(
    vertices: Array, faces: Faces, columns: Columns, mouth: Pit | None, span: tuple[float, float]
) -> Hollow:
    """The hollow around the axis between two heights."""
    low, high = span
    z = _levels(low, high)
    axis = _middle_of_body(columns)[0] if mouth is None else mouth.center_xy_m
    for _ in range(2):
        inner, _ = _clean_rings(radial_hits(vertices, faces, axis, z, RAYS, 1)[..., 0])
        # In a neck the axis must stay in the neck's middle; a closed body has none.
        narrow = int(np.argmin(half_widths(inner)[LEVELS // 5 :])) + LEVELS // 5
        rows = inner[[narrow]] if mouth is not None else inner
        axis = axis + _centroids(rows).mean(axis=0)
    hits = radial_hits(vertices, faces, axis, z, RAYS, MOST_HITS)
    inner, holes = _clean_rings(hits[..., 0])
    wall = _wall(hits, inner, z)
    low, high = (
        _leveled(columns, axis, inner[0], low, down=True),
        (high if mouth is not None else _leveled(columns, axis, inner[-1], high, down=False)),
    )
    outer_z, outer = _outer(vertices, faces, axis, z, inner, hits, wall, columns, mouth is not None)
    hollow = Hollow(
        axis, z, inner, outer_z, outer, SINGLE_WALL_M if wall is None else wall, mouth is not None, wall is not None,
        _holes(holes, inner, z, axis),
    )  # fmt: skip
    if wall is None:
        hollow = replace(hollow, inner_m=np.maximum(inner - SINGLE_WALL_M, 0.2 * inner))
        low, high = low + SINGLE_WALL_M, high if mouth is not None else high - SINGLE_WALL_M
    return replace(hollow, z_m=np.concatenate([[low], z[1:-1], [high]]))


def _levels(low: float, high: float) -> Array:
    edge = min(0.0004, 0.01 * (high - low))
    return np.linspace(low + edge, high - edge, LEVELS, dtype=np.float64)


def _middle_of_body(columns: Columns) -> tuple[Array, float]:
    """Middle (2,) and radius of the largest circle where the mesh is tallest: handles and spouts are narrower."""
    solid = np.isfinite(columns.hits[..., 0])
    tall = np.zeros(solid.shape)
    bottom = np.where(np.isfinite(columns.hits), columns.hits, np.inf).min(axis=2)
    tall[solid] = columns.hits[..., 0][solid] - bottom[solid]
    room = np.asarray(ndimage.distance_transform_edt(tall > 0.5 * np.percentile(tall[tall > 0], 90)))
    return columns.xy(room > 0.9 * room.max()).mean(axis=0), float(room.max()) * columns.cell_m


def _open_span(columns: Columns, mouth: Pit) -> tuple[float, float]:
    """Floor under the middle of the mouth, and rim."""
    hits = columns.hits[columns.disc(mouth.center_xy_m, 0.25 * math.sqrt(mouth.area_m2 / math.pi))]
    below = np.where(hits < mouth.spill_m - 0.5 * MIN_DEPTH_M, hits, -np.inf).max(axis=1)
    if np.mean(np.isfinite(below)) < 0.5:
        raise UserError("it has no bottom under the middle of its opening")
    return float(np.median(below[np.isfinite(below)])), mouth.spill_m


def _closed_spans(columns: Columns) -> list[tuple[float, float]]:
    """Pairs of neighbouring surfaces, one above the other in the middle of the body, that lie far enough apart."""
    middle, radius_m = _middle_of_body(columns)
    # Wide enough to look past a hole in the lid whose knob is missing.
    rows = columns.hits[columns.disc(middle, 0.4 * radius_m)]
    counts = np.isfinite(rows).sum(axis=1)
    usual = int(np.bincount(counts).argmax())
    heights = np.median(rows[counts == usual][:, :usual], axis=0)
    spans = [
        (float(low), float(high))
        for high, low in itertools.pairwise(heights)
        if high - low > MIN_DEPTH * columns.height_m
    ]
    if not spans:
        raise UserError("there is no room between the surfaces under its middle")
    return spans


def _leveled(columns: Columns, axis: Array, ring: Array, z_m: float, *, down: bool) -> float:
    """Height of a flat floor (or ceiling) that leaves the same volume as the true one around the axis.

    ring: (n,) inner distances right above it. Only what lies beyond `z_m` counts: a hump in the middle of a bottle's
    bottom, say, beside which the hollow goes on.
    """
    mask = columns.disc(axis, float(ring.max()))
    xy = columns.xy(mask) - axis
    angle = np.arctan2(xy[:, 1], xy[:, 0])
    inside = np.hypot(xy[:, 0], xy[:, 1]) < ring[ray_toward(angle)]
    hits = columns.hits[mask][inside]
    if down:
        beyond = z_m - np.where(hits < z_m + 0.001, hits, -np.inf).max(axis=1, initial=-np.inf)
    else:
        beyond = np.where((hits > z_m - 0.001) & np.isfinite(hits), hits, np.inf).min(axis=1, initial=np.inf) - z_m
    beyond = beyond[np.isfinite(beyond)]
    drop = float(np.clip(beyond, 0.0, None).mean()) if len(beyond) else 0.0
    return z_m - drop if down else z_m + drop


def _clean_rings(rings: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Rings (L, n) with gaps and narrow excursions bridged; and where they went farther out than the bridge."""
    clean, out = np.empty_like(rings), np.zeros(rings.shape, bool)
    bad = np.zeros(len(rings), bool)
    for level, ring in enumerate(rings):
        bridged = _without_jumps(ring)
        bad[level] = bridged is None
        clean[level] = ring if bridged is None else bridged
    if bad.all():
        raise UserError("no walls stand around the mesh's middle, so nothing can be held in it")
    good = np.flatnonzero(~bad)
    for level in np.flatnonzero(bad):
        clean[level] = clean[good[int(np.argmin(np.abs(good - level)))]]
    out[~bad] = rings[~bad] > clean[~bad] + JUMP_M
    return clean, out


def _without_jumps(ring: Array) -> Array | None:
    """One ring (n,) without jumps, the narrowest stretch between two jumps bridged first; None when little is left."""
    n = len(ring)
    known = np.isfinite(ring)
    if np.count_nonzero(known) < n // 3:
        return None
    while True:
        index = np.flatnonzero(known)
        values = ring[index]
        step = np.abs(np.roll(values, -1) - values)
        gap = (np.roll(index, -1) - index) % n
        limit = np.maximum(JUMP_M, JUMP_SHARE * np.minimum(values, np.roll(values, -1)))
        # Over a bridged gap the wall may have moved on by as much as its ends would at this slope.
        ends = np.flatnonzero(step > limit * np.maximum(1.0, 0.25 * gap))
        if len(ends) < 2:
            break
        lengths = np.diff(np.append(ends, ends[0] + len(index)))
        shortest = int(np.argmin(lengths))
        if lengths[shortest] * 2 * np.pi / n > MAX_GAP_RAD:
            break
        drop = (ends[shortest] + 1 + np.arange(lengths[shortest])) % len(index)
        known[index[drop]] = False
        if np.count_nonzero(known) < n // 3:
            return None
    index = np.flatnonzero(known)
    at = np.arange(n)
    return np.asarray(np.interp(at, np.concatenate([index - n, index, index + n]), np.tile(ring[index], 3)))


def _centroids(rings: Array) -> Array:
    """(L, 2) centroids of polygons given as rings."""
    p = ring_points(rings)
    q = np.roll(p, -1, axis=1)
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return np.asarray(((p + q) * cross[..., None]).sum(axis=1) / (3 * cross.sum(axis=1)[:, None]))


def _wall(hits: Array, inner: Array, z: Array) -> float | None:
    """Thickness of a wall with two surfaces; None for a single one."""
    gap = np.where(np.isfinite(hits[..., 1]), hits[..., 1], np.inf) - inner
    near = (np.abs(hits[..., 0] - inner) < 1e-6) & (gap < np.minimum(MAX_WALL_M, MAX_WALL_SHARE * inner))
    # The top and bottom tenths are rims and fillets.
    core = slice(LEVELS // 10, -LEVELS // 10)
    if np.mean(near[core]) < 0.5:
        return None
    slope = np.gradient(inner, z, axis=0)
    return float(np.median((gap / np.sqrt(1 + slope**2))[core][near[core]]))


def _outer(
    vertices: Array, faces: Faces, axis: Array, z: Array, inner: Array, hits: Array, wall: float | None,
    columns: Columns, is_open: bool,
) -> tuple[Array, Array]:  # fmt: skip
    """Heights and rings of the outer surface, from the foot to the rim or the top of the lid."""
    if wall is None:
        beside = inner
    else:
        # Scans have walls of very uneven thickness; beyond this it is the far side of a handle.
        second = np.where(hits[..., 1] - inner < 2.5 * MAX_WALL_M, hits[..., 1], inner + wall)
        beside, _ = _clean_rings(second)
    foot: Array = np.linspace(float(vertices[:, 2].min()) + 2e-4, float(z[0]), 16, dtype=np.float64)[:-1]
    parts_z, parts = [z], [beside]
    below = radial_hits(vertices, faces, axis, foot, RAYS, MOST_HITS)
    parts_z.insert(0, foot)
    parts.insert(0, _foot(below, beside[0]))
    if not is_open:
        column = columns.hits[columns.disc(axis, 3 * columns.cell_m)]
        above = np.where(column > z[-1] + 1e-4, column, np.inf).min(axis=1)
        top_m = float(np.median(above[np.isfinite(above)])) if np.isfinite(above).any() else float(z[-1]) + 0.001
        if top_m > z[-1] + 5e-4:
            lid: Array = np.linspace(float(z[-1]), top_m, 6, dtype=np.float64)[1:]
            parts_z.append(lid)
            parts.append(np.repeat(beside[-1:], len(lid), axis=0))
    return np.concatenate(parts_z), np.concatenate(parts)


def _foot(hits: Array, above: Array) -> Array:
    """Outer rings below the floor: what sticks out (a handle that reaches low) bridged, what is missing as above it."""
    rings = np.where(np.isfinite(hits), hits, -np.inf).max(axis=2)
    bridged = [_without_jumps(np.where(np.isfinite(ring), ring, np.inf)) for ring in rings]
    return np.stack([above if ring is None else ring for ring in bridged])


def _holes(out: NDArray[np.bool_], inner: Array, z: Array, axis: Array) -> tuple[Hole, ...]:
    """Openings in the wall: joined places where rays went on through it."""
    wide = np.concatenate([out, out], axis=1)
    labels: Any
    labels, _ = ndimage.label(wide)
    n = out.shape[1]
    area = float(z[1] - z[0]) * inner * (2 * np.pi / n)
    found = []
    for number, place in enumerate(ndimage.find_objects(labels), start=1):
        begin = place[1].start
        # Each opening appears twice in the doubled ring, or once across the seam.
        if not 0 < begin <= n:
            continue
        level, k = np.nonzero(labels == number)
        cells = area[level, k % n]
        if cells.sum() < 5e-6:
            continue
        angle = 2 * np.pi * (k + 0.5) / n
        r = inner[level, k % n]
        points = np.column_stack([axis[0] + r * np.cos(angle), axis[1] + r * np.sin(angle), z[level]])
        found.append(Hole(np.average(points, axis=0, weights=cells), math.sqrt(float(cells.sum()) / math.pi)))
    return tuple(sorted(found, key=lambda hole: -hole.radius_m))
