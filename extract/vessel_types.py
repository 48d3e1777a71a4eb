"""What a vessel is made of: its walls as profiles, its outlet, where to hold it.

Everything is in the vessel's own frame: metres, origin at the centre of the bounding box, +z up, +x toward the
spout, the lip or the side opposite the handle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from .geometry import Array, Symmetry

Vector = tuple[float, float, float]
Color = tuple[float, float, float, float]


@dataclass(frozen=True)
class Range:
    """Limits and nominal value of one shape parameter; `unit` is "m", "rad" or "1" for ratios."""

    low: float
    high: float
    nominal: float
    unit: str = "m"

    def __post_init__(self) -> None:
        if not self.low <= self.nominal <= self.high:
            raise ValueError(f"nominal value {self.nominal} outside [{self.low}, {self.high}]")


@dataclass(frozen=True)
class Section:
    """Horizontal cross-section: a rectangle with rounded corners, of which the circle is the limit.

    aspect: half extent along y over half extent along x.
    corner: corner radius over the smaller half extent, in (0, 1]; 1 with aspect 1 is a circle.
    """

    aspect: float = 1.0
    corner: float = 1.0

    @property
    def kind(self) -> Literal["round", "rounded_rectangle"]:
        return "round" if self.aspect == 1.0 and self.corner == 1.0 else "rounded_rectangle"

    def outline(self, radius_m: float, segments: int = 64) -> Array:
        """(segments, 2) closed polygon with half extent `radius_m` along x, counter-clockwise from +x."""
        return np.asarray(section_outlines(np.array([radius_m]), np.array([self.corner]), self.aspect, segments)[0])


def section_outlines(radius_m: Array, corner: Array, aspect: float, segments: int = 64) -> Array:
    """(K, segments, 2) polygons of K cross-sections (see `Section`); `segments` must be a multiple of 4.

    Vertices sit at half steps of the corner arcs, so that none coincide when the straight sides vanish and the
    polygon keeps both mirror planes.
    """
    per_corner = segments // 4
    angle_rad = (np.arange(segments) + 0.5) * (0.5 * np.pi / per_corner)
    arc = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    signs = np.sign(arc)
    half = radius_m[:, None] * np.array([1.0, aspect])
    rho_m = (corner * radius_m * min(1.0, aspect))[:, None, None]
    return np.asarray(signs * (half[:, None, :] - rho_m) + rho_m * arc)


def support_polygons(support_m: Array) -> Array:
    """(K, n, 2) corners of the polygons whose edges stand at distances (K, n) in the directions 2 pi k / n."""
    step = 2 * math.pi / support_m.shape[1]
    angle = step * np.arange(support_m.shape[1])
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    along = (np.roll(support_m, -1, axis=1) - support_m * math.cos(step)) / math.sin(step)
    return np.asarray(
        support_m[..., None] * normals + along[..., None] * (normals @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    )


def polygon_areas(points_m: Array) -> Array:
    """(K,) areas of polygons (K, n, 2), counter-clockwise ones positive."""
    x, y = points_m[..., 0], points_m[..., 1]
    return np.asarray(0.5 * np.sum(x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1), axis=-1))


@dataclass(frozen=True)
class Profile:
    """One surface of a vessel's wall: cross-sections stacked along a vertical axis, linear in between.

    z_m: (K,) strictly ascending heights, from the floor (or foot) to the rim (or the underside of a closed lid).
    radius_m: (K,) half extent along x at each height.
    corner: (K,) corner ratio of the cross-section at each height, all ones for a round vessel.
    aspect: half extent along y over half extent along x.
    axis_xy_m: where the vertical axis stands.
    support_m: for sections of any other convex shape, (K, n) how far each reaches from the axis in the directions
        2 pi k / n, n a multiple of 4; radius, corner and aspect then only sum it up.
    """

    z_m: Array
    radius_m: Array
    corner: Array
    aspect: float = 1.0
    axis_xy_m: tuple[float, float] = (0.0, 0.0)
    support_m: Array | None = None

    def radius_at(self, z_m: float) -> float:
        """Half extent along x at a height, held constant beyond both ends."""
        return float(np.interp(z_m, self.z_m, self.radius_m))

    def outlines(self, segments: int = 64) -> Array:
        """(K, segments, 3) polygon of the cross-section at every level, in the object frame.

        A section given by supports has as many corners as these.
        """
        if self.support_m is None:
            xy = section_outlines(self.radius_m, self.corner, self.aspect, segments)
        else:
            xy = support_polygons(self.support_m)
        xy = xy + np.asarray(self.axis_xy_m)
        z = np.broadcast_to(self.z_m[:, None, None], (*xy.shape[:2], 1))
        return np.concatenate([xy, z], axis=-1)

    def volume_below_m3(self, z_m: float) -> float:
        """Volume between the lowest level and height `z_m`: frusta of the true, not polygonal, cross-sections."""
        z = np.clip(self.z_m, None, z_m)
        if self.support_m is not None:
            root = np.interp(z, self.z_m, np.sqrt(polygon_areas(support_polygons(self.support_m))))
            return float(np.sum(np.diff(z) * (root[:-1] ** 2 + root[:-1] * root[1:] + root[1:] ** 2)) / 3)
        r = np.interp(z, self.z_m, self.radius_m)
        rho = r * np.interp(z, self.z_m, self.corner) * min(1.0, self.aspect)
        r_a, r_b, rho_a, rho_b = r[:-1], r[1:], rho[:-1], rho[1:]
        area = 4 * self.aspect * (r_a**2 + r_a * r_b + r_b**2) / 3
        area -= (4 - math.pi) * (rho_a**2 + rho_a * rho_b + rho_b**2) / 3
        return float(np.sum(np.diff(z) * area))

    @property
    def volume_m3(self) -> float:
        """Volume enclosed between the lowest and the highest level."""
        return self.volume_below_m3(float(self.z_m[-1]))

    def shifted(self, offset_m: Array) -> Profile:
        """The same profile moved by (3,) `offset_m`."""
        axis = (self.axis_xy_m[0] + float(offset_m[0]), self.axis_xy_m[1] + float(offset_m[1]))
        return replace(self, z_m=self.z_m + offset_m[2], axis_xy_m=axis)


@dataclass(frozen=True)
class Outlet:
    """Where the contents leave: over a lip of the rim, or through a spout.

    point_m: (3,) on the rim or in the middle of the spout's mouth.
    direction: (3,) unit vector out of the vessel there.
    entry_m, entry_radius_m: for a spout, where its channel leaves the interior and how wide it is there.
    tip_radius_m: for a spout, the radius of the channel at its mouth.
    """

    kind: Literal["lip", "spout"]
    point_m: Array
    direction: Array
    entry_m: Array | None = None
    entry_radius_m: float | None = None
    tip_radius_m: float | None = None


@dataclass(frozen=True)
class GraspRegion:
    """A stretch of the vessel that a two-finger hand can close on.

    center_m: (3,); axis: (3,) unit, along which the hand may slide by +-length_m / 2.
    width_m: what the fingers must span. approach: (3,) unit, the way the hand moves toward the vessel.
    """

    kind: Literal["body", "handle"]
    center_m: Array
    axis: Array
    length_m: float
    width_m: float
    approach: Array


@dataclass(frozen=True)
class MeshSource:
    """The file that a vessel was read from, and how.

    file: path. sha256: `meshes.mesh_sha256` of the mesh as read. unit: of the file's numbers. up: the file's axis that
    points out of the opening, such as "+y". open_top: whether a closed mesh was cut open at its top.
    T_file_vessel: (4, 4) pose of the vessel's frame in the file's own axes, in metres.
    """

    file: str
    sha256: str
    unit: str
    up: str
    open_top: bool
    T_file_vessel: Array


@dataclass(frozen=True)
class Vessel:
    """A vessel with walls: its interior, outlet and grasps, known exactly in the library's and measured in a mesh.

    category, params: for a vessel of the library, `make_vessel(category, **params)` rebuilds it exactly; for one from
        a mesh the nearest word for it, or "vessel", and nothing.
    mesh: trimesh.Trimesh in metres; face colours tell its parts (body, handle, lid ...) apart. The library's are
        watertight.
    symmetry: rotational symmetry of the outer shape.
    section: the cross-section where the body is widest.
    interior, exterior: inner and outer surface of the wall; a pulled-out pouring lip is left out of both.
    wall_m: thickness of the wall. is_open: False when a lid closes the top and only the spout pours.
    interior_volume_m3: volume from floor to rim (or lid), lip included, spout channel left out.
    mass_kg: of the empty vessel. color_rgba: of its body. extents_m: full size of its bounding box along x, y, z.
    source: the mesh file it was read from, None for the library's.
    """

    category: str
    params: Mapping[str, float]
    mesh: Any
    symmetry: Symmetry
    section: Section
    interior: Profile
    exterior: Profile
    wall_m: float
    outlet: Outlet
    is_open: bool
    grasps: tuple[GraspRegion, ...]
    interior_volume_m3: float
    mass_kg: float
    color_rgba: Color
    extents_m: Vector
    source: MeshSource | None = None
