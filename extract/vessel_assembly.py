"""From a draft (profiles, parts, outlet) to a finished `Vessel`: walls, booleans, centring, mass, colours.

Drafts are written in the body frame: the vessel's axis is the z axis and it stands on z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import manifold3d
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, Symmetry
from .vessel_shapes import (
    SEGMENTS,
    Lip,
    Shape,
    Solid,
    cumulative_share,
    eroded,
    lofted,
    remembered,
    resampled,
    round_off,
    rounded_path,
    simplified,
    tube,
)
from .vessel_types import Color, GraspRegion, Outlet, Profile, Section, Vessel

STEEL_KG_M3, CERAMIC_KG_M3, GLASS_KG_M3, PLASTIC_KG_M3, CARD_KG_M3 = 7900.0, 2300.0, 2500.0, 1000.0, 800.0
BLACK: Color = (0.07, 0.07, 0.07, 1.0)
STEEL: Color = (0.74, 0.75, 0.77, 1.0)

# The cavity is cut a little beyond the rim so that no face of it coincides with the rim's.
OVERCUT_M = 0.002
# Profiles keep this close to their smooth shape; thin walls ask for less.
PROFILE_TOLERANCE_M = 1e-4
LIP_LEVELS: Array = np.linspace(0.1, 1.0, 9, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Walls:
    """Outer and inner profile (z, r) of a vessel's wall in the body frame, and what its cross-section is.

    corner_outer, corner_inner: corner ratio at every level of outer and inner, None for round.
    sides: number of flat sides of a faceted outside around the round inside, 0 for none.
    """

    outer: Array
    inner: Array
    wall_m: float
    is_open: bool = True
    aspect: float = 1.0
    corner_outer: Array | None = None
    corner_inner: Array | None = None
    lip: Lip | None = None
    sides: int = 0

    def outer_radius(self, z_m: float) -> float:
        return float(np.interp(z_m, self.outer[:, 0], self.outer[:, 1]))

    def inner_radius(self, z_m: float) -> float:
        return float(np.interp(z_m, self.inner[:, 0], self.inner[:, 1]))

    @property
    def height_m(self) -> float:
        return float(self.outer[-1, 0])

    @property
    def floor_m(self) -> float:
        return float(self.inner[0, 0])


@dataclass(frozen=True)
class Part:
    """A shape with its colour; density_kg_m3 None means the vessel's own material."""

    shape: Shape
    rgba: Color
    density_kg_m3: float | None = None


@dataclass
class Draft:
    """A vessel before its parts are joined.

    dents are cut from the bare body before the additions are joined to it; cuts are taken away together with the
    cavity, after all unions.
    """

    walls: Walls
    rgba: Color
    density_kg_m3: float
    outlet: Outlet
    grasps: list[GraspRegion]
    additions: list[Part] = field(default_factory=list)
    dents: list[Part] = field(default_factory=list)
    cuts: list[Part] = field(default_factory=list)
    symmetry_order: int = 1
    inside_rgba: Color | None = None


@remembered
def round_walls(
    outer: Array,
    wall_m: float,
    floor_m: float,
    *,
    base_round_m: float = 0.0,
    inner_fillet_m: float = 0.0,
    ceiling_m: float | None = None,
    lip: Lip | None = None,
    sides: int = 0,
) -> Walls:
    """Walls of a round vessel from its outer profile (z, r).

    floor_m: height of the inner floor. ceiling_m: underside of a closed lid; None for an open vessel, whose rim is
    rounded. base_round_m, inner_fillet_m: radii of the outer bottom edge and of the inner one.
    """
    top_m = float(outer[-1, 0]) if ceiling_m is None else ceiling_m
    inner = eroded(outer, wall_m, floor_m, top_m)
    fillet = max(0.0, min(inner_fillet_m, 0.8 * float(inner[0, 1]), 0.4 * (top_m - floor_m)))
    rim = 0.3 * wall_m
    if ceiling_m is None:
        outer = round_off(outer, base_round_m, rim)
        inner = round_off(inner, fillet, rim, top_outward=True)
    else:
        outer = round_off(outer, base_round_m, min(0.001, 0.5 * wall_m))
        inner = round_off(inner, fillet, 0.0)
    tolerance = min(PROFILE_TOLERANCE_M, 0.05 * wall_m)
    outer, inner = simplified(outer, tolerance), simplified(inner, tolerance)
    if lip is not None:
        outer, inner = (with_levels(p, top_m - lip.depth_m * LIP_LEVELS) for p in (outer, inner))
    return Walls(outer, inner, wall_m, ceiling_m is None, lip=lip, sides=sides)


def with_levels(profile: Array, z_m: Array) -> Array:
    """Profile (z, r) with interpolated points added at heights z_m."""
    z_m = z_m[(z_m > profile[0, 0] + 1e-5) & (z_m < profile[-1, 0] - 1e-5)]
    z_m = z_m[np.abs(z_m[:, None] - profile[None, :, 0]).min(axis=1) > 1e-5]
    z = np.union1d(profile[:, 0], z_m)
    return np.column_stack([z, np.interp(z, profile[:, 0], profile[:, 1])])


def lip_outlet(walls: Walls) -> Outlet:
    """Outlet over the rim at +x."""
    # The polygon's side, not a vertex, faces +x, so the rim lies at the apothem.
    apothem = math.cos(math.pi / SEGMENTS) if walls.corner_outer is None else 1.0
    radius = 0.5 * (walls.outer[-1, 1] + walls.inner[-1, 1]) * apothem
    reach = walls.lip.reach_m if walls.lip is not None else 0.0
    point = np.array([radius + reach, 0.0, walls.height_m])
    return Outlet("lip", point, np.array([1.0, 0.0, 0.0]))


def beak(walls: Walls, rgba: Color, radius_m: float) -> tuple[Part, Outlet]:
    """Hole of `radius_m` through the closed top above a pulled-out lip: the channel to cut, and the outlet."""
    assert walls.lip is not None
    reach, top = walls.lip.reach_m, walls.height_m
    ceiling, inner = float(walls.inner[-1, 0]), float(walls.inner[-1, 1])
    x = inner + 0.72 * reach - 1.2 * radius_m
    lean = np.array([0.2, 1.0])
    hole = np.array([[x, ceiling], [x, ceiling]]) + np.array([[-1.0], [1.0]]) * (top - ceiling + OVERCUT_M) * lean
    outlet = Outlet(
        "spout",
        np.array([x, 0.0, top]),
        # What comes through the hole runs on along the beak.
        np.array([0.8, 0.0, 0.6]),
        np.array([x, 0.0, ceiling]),
        radius_m,
        radius_m,
    )
    channel = tube(hole, radius_m)
    return Part(channel, rgba), outlet


def spout(
    walls: Walls,
    path: Array,
    root_radius_m: float,
    tip_radius_m: float,
    wall_m: float,
    rgba: Color,
) -> tuple[Part, Part, Outlet]:
    """Hollow tapered tube from inside the body along `path` (K, 2) of (x, z) to its mouth: tube, channel, outlet.

    The path begins well inside the body; the tube begins where its round end last fits into the cavity, which then
    cuts it flush with the inner wall.
    """
    path, entry = _from_inside(walls, path, root_radius_m)
    share = cumulative_share(path)
    outer_m = root_radius_m + (tip_radius_m - root_radius_m) * share
    solid = tube(path, outer_m)
    direction = path[-1] - path[-2]
    direction = direction / np.linalg.norm(direction)
    longer = np.vstack([path, path[-1] + direction * OVERCUT_M])
    channel = tube(longer, np.append(outer_m, tip_radius_m) - wall_m)
    outlet = Outlet(
        "spout",
        np.array([path[-1, 0], 0.0, path[-1, 1]]),
        np.array([direction[0], 0.0, direction[1]]),
        np.array([entry[0], 0.0, entry[1]]),
        root_radius_m - wall_m,
        tip_radius_m - wall_m,
    )
    return Part(solid, rgba), Part(channel, rgba), outlet


@remembered
def _from_inside(walls: Walls, path: Array, half_m: float) -> tuple[Array, Array]:
    """The path (K, 2) from where a tube of radius half_m leaves the cavity; and where its middle crosses the wall."""
    fine = resampled(path, 0.0005)
    tangent = np.gradient(fine, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    x = fine[:, :1] - half_m * np.cos(turn) * tangent[:, 1:]
    z = fine[:, 1:] + half_m * np.cos(turn) * tangent[:, :1]
    inner_z, inner_r = walls.inner.T
    room = np.interp(z, inner_z, inner_r) - np.hypot(x, half_m * np.sin(turn))
    inside = ((room > 2e-4) & (z > inner_z[0] + 2e-4) & (z < inner_z[-1] - 2e-4)).all(axis=1)
    if not inside[0]:
        raise ValueError(f"a spout of radius {half_m} m does not fit into the body")
    leaves = len(inside) if inside.all() else int(np.argmin(inside))
    middle_out = np.abs(fine[:, 0]) > np.interp(fine[:, 1], inner_z, inner_r)
    start = max(leaves - 3, 0)
    rest = path[cumulative_share(path) > cumulative_share(fine)[min(leaves, len(fine) - 1)]]
    return np.vstack([fine[start], rest]), np.asarray(fine[int(np.argmax(middle_out))])


def loop_handle(
    walls: Walls,
    points: Sequence[tuple[float, float]],
    half_m: float,
    half_y_m: float,
    rgba: Color,
    fillet_m: float,
    *,
    swell: float = 0.0,
) -> tuple[Part, GraspRegion]:
    """Handle on the -x side along a polyline of (x, z), x < 0, whose ends are sunk into the wall.

    Both end points give only the height of the joint. swell: how much thicker the middle is than the ends.
    """
    ends = []
    for _, z in (points[0], points[-1]):
        # Into the cavity by a little: what enters it is cut away with the cavity.
        radius = min(walls.inner_radius(z + dz) for dz in (-half_m, 0.0, half_m))
        ends.append((-(math.sqrt(max(radius**2 - half_y_m**2, 0.0)) - 0.001), z))
    polyline = np.array([ends[0], *points[1:-1], ends[1]])
    path = rounded_path(polyline, fillet_m)
    share = cumulative_share(path)
    growth = 1 + swell * np.sin(np.pi * share) ** 2
    solid = tube(path, half_m * growth, half_y_m * growth)
    outermost = path[:, 0] < path[:, 0].min() + 0.25 * np.ptp(path[:, 0])
    grip = path[outermost]
    return Part(solid, rgba), handle_grasp(grip, 2 * half_y_m * (1 + swell))


def handle_grasp(grip: Array, width_m: float) -> GraspRegion:
    """Grasp of a stick along `grip` (K, 2) of (x, z) behind the body, from the top end to the bottom end."""
    axis = grip[0] - grip[-1]
    length = float(np.linalg.norm(axis))
    axis = axis / length
    if axis[1] < 0:
        axis = -axis
    # Across the stick, toward the body.
    approach = np.array([axis[1], 0.0, -axis[0]])
    # On the stick itself, which may bow away from the chord.
    share = cumulative_share(grip)
    center = np.array([np.interp(0.5, share, grip[:, 0]), np.interp(0.5, share, grip[:, 1])])
    return GraspRegion(
        "handle",
        np.array([center[0], 0.0, center[1]]),
        np.array([axis[0], 0.0, axis[1]]),
        length,
        width_m,
        approach,
    )


def body_grasp(walls: Walls, low: float, high: float, *, sideways: bool = False) -> GraspRegion:
    """Grasp around the body between two shares of its height; from behind, or from +y when a handle is behind."""
    z_low, z_high = low * walls.height_m, high * walls.height_m
    radius = max(walls.outer_radius(z) for z in np.linspace(z_low, z_high, 9))
    width = 2 * radius * (1.0 if sideways else walls.aspect)
    return GraspRegion(
        "body",
        np.array([0.0, 0.0, 0.5 * (z_low + z_high)]),
        np.array([0.0, 0.0, 1.0]),
        z_high - z_low,
        width,
        np.array([0.0, -1.0, 0.0]) if sideways else np.array([1.0, 0.0, 0.0]),
    )


@dataclass(frozen=True)
class Joined:
    """A draft's parts as one watertight surface: vertices (V, 3) in m, faces (F, 3), and each face's part, (F,) in the
    order of `_parts`."""

    vertices: Array
    faces: NDArray[np.int64]
    part: NDArray[np.int64]
    mass_kg: float


def _parts(draft: Draft) -> tuple[list[Part], list[Part], list[Part]]:
    """The bare body with its dents, what is joined to it, and what is taken away from all of that."""
    walls = draft.walls
    shell = lofted(walls.outer, walls.corner_outer, walls.aspect, walls.lip, walls.height_m, walls.sides)
    cavity_profile, cavity_corner = walls.inner, walls.corner_inner
    if walls.is_open:
        cavity_profile = np.vstack([walls.inner, [walls.inner[-1, 0] + OVERCUT_M, walls.inner[-1, 1]]])
        cavity_corner = None if cavity_corner is None else np.append(cavity_corner, cavity_corner[-1])
    cavity = lofted(cavity_profile, cavity_corner, walls.aspect, walls.lip, walls.height_m)
    body = [Part(shell, draft.rgba), *draft.dents]
    return body, draft.additions, [Part(cavity, draft.inside_rgba or draft.rgba), *draft.cuts]


def joined(draft: Draft) -> Joined:
    """Join the parts and hollow them out: the slow half of making a vessel, which its colour has no say in."""
    numbers: dict[int, int] = {}

    def tagged(part: Part) -> Solid:
        solid = part.shape.solid.as_original()
        numbers[solid.original_id()] = len(numbers)
        return solid

    body, additions, hollow = ([tagged(part) for part in parts] for parts in _parts(draft))
    whole = Solid.batch_boolean(
        [Solid.batch_boolean(body, manifold3d.OpType.Subtract), *additions], manifold3d.OpType.Add
    )
    final = Solid.batch_boolean([whole, *hollow], manifold3d.OpType.Subtract)
    mass_kg = draft.density_kg_m3 * final.volume()
    for part in draft.additions:
        if part.density_kg_m3 is not None:
            mass_kg += (part.density_kg_m3 - draft.density_kg_m3) * part.shape.solid.volume()
    raw = final.to_mesh64()
    runs = np.diff(np.asarray(raw.run_index, np.int64) // 3)
    part_of_face = np.repeat([numbers[int(original)] for original in raw.run_original_id], runs)
    vertices, faces = np.asarray(raw.vert_properties[:, :3], np.float64), np.asarray(raw.tri_verts, np.int64)
    return Joined(vertices, faces, part_of_face, float(mass_kg))


def assemble(category: str, params: Mapping[str, float], draft: Draft, whole: Joined) -> Vessel:
    """Colour the draft's joined parts and move the origin to the centre of the bounding box."""
    import trimesh

    walls, vertices = draft.walls, whole.vertices
    face_rgba = np.round(255 * np.array([part.rgba for parts in _parts(draft) for part in parts])).astype(np.uint8)
    offset = -0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    mesh = trimesh.Trimesh(vertices + offset, whole.faces, process=False, face_colors=face_rgba[whole.part])

    interior = _profile(walls.inner, walls.corner_inner, walls.aspect).shifted(offset)
    exterior = _profile(walls.outer, walls.corner_outer, walls.aspect).shifted(offset)
    widest = int(np.argmax(exterior.radius_m))
    volume = interior.volume_m3
    if walls.lip is not None:
        volume += walls.lip.volume_m3(walls.inner[:, 0], walls.inner[:, 1], walls.height_m)
    outlet = draft.outlet
    entry = None if outlet.entry_m is None else outlet.entry_m + offset
    extent_x, extent_y, extent_z = (float(v) for v in np.ptp(mesh.vertices, axis=0))
    return Vessel(
        category=category,
        params=dict(params),
        mesh=mesh,
        symmetry=Symmetry(order=draft.symmetry_order),
        section=Section(walls.aspect, float(exterior.corner[widest])),
        interior=interior,
        exterior=exterior,
        wall_m=walls.wall_m,
        outlet=replace(outlet, point_m=outlet.point_m + offset, entry_m=entry),
        is_open=walls.is_open,
        grasps=tuple(replace(grasp, center_m=grasp.center_m + offset) for grasp in draft.grasps),
        interior_volume_m3=volume,
        mass_kg=whole.mass_kg,
        color_rgba=draft.rgba,
        extents_m=(extent_x, extent_y, extent_z),
    )


def outline_surfaces(draft: Draft) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) in m and faces (F, 3) of closed surfaces with the vessel's silhouette, in its frame.

    Dents and cuts lie inside the silhouette and are left out, and the parts lie in one another instead of being
    joined and hollowed out. That takes a tenth of the time, for fits that draw hundreds of shapes.
    """
    walls = draft.walls
    shell = lofted(walls.outer, walls.corner_outer, walls.aspect, walls.lip, walls.height_m, walls.sides)
    surfaces = [surface for shape in (shell, *(part.shape for part in draft.additions)) for surface in shape.surfaces]
    first = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces[:-1])])
    points = np.concatenate([vertices for vertices, _ in surfaces])
    faces = np.concatenate([faces + np.int32(start) for start, (_, faces) in zip(first, surfaces, strict=True)])
    return points - 0.5 * (points.min(axis=0) + points.max(axis=0)), faces


def _profile(points: Array, corner: Array | None, aspect: float) -> Profile:
    z, r = points[:, 0].copy(), points[:, 1].copy()
    return Profile(z, r, np.ones(len(z)) if corner is None else corner.copy(), aspect)


def knob(z_m: float, radius_m: float, height_m: float, rgba: Color, *, stem_ratio: float = 0.55) -> Part:
    """A lid's knob standing on z_m: a waisted stem with a flat rounded head."""
    head = min(0.45 * height_m, radius_m)
    profile = np.array(
        [
            [z_m - 0.001, stem_ratio * radius_m],
            [z_m + height_m - head, stem_ratio * radius_m],
            [z_m + height_m - 0.8 * head, radius_m],
            [z_m + height_m, radius_m],
        ]
    )
    return Part(lofted(round_off(resampled(profile, 0.002), 0.0, 0.35 * head)), rgba, PLASTIC_KG_M3)
