"""Any vessel from a mesh: the same `Vessel` that the library makes, measured instead of known.

The mesh's own frame is the file's, in metres; the vessel's is the library's: origin at the centre of the bounding box,
+z up, +x toward spout, lip or the side opposite the handle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError
from .geometry import Array, Symmetry, make_pose
from .mesh_columns import UPS, Columns, Faces, find_up, rotation_to_up
from .mesh_parts import find_features, grasp_regions, without_lip
from .mesh_profile import RAYS, Hollow, find_hollow, half_widths, ring_areas, ring_supports
from .meshes import load_mesh, mesh_sha256
from .vessel_types import MeshSource, Profile, Section, Vessel, polygon_areas, support_polygons
from .vessels import CATEGORIES, make_vessel, resolve_category

# Directions in which profiles keep their support: the simulator's walls take every third or fourth.
SUPPORTS = 48
SURFACE_POINTS = 30_000
MAX_COLORS = 6
# Particles are 5 mm thick at least; less holds too few of them, or jams.
MIN_VOLUME_M3, MIN_THROAT_M = 15e-6, 0.006
# A closed mesh is cut open where it is at least so wide, in half, and so wide as a share of its widest.
CUT_HALF_WIDTH_M, CUT_SHARE = 0.009, 0.25
# What is in a vessel fills at least so much of it, box by box.
CONTENTS_SHARE = 0.1
# Where the name does not tell, thick walls are taken for ceramic or glass, thin ones for plastic or card.
THICK_WALL_M, THICK_KG_M3, THIN_KG_M3 = 0.0025, 2300.0, 1000.0
# Spread of a round outline's distances, and difference between an outline and itself turned, as shares of its size.
ROUND, FOLD = 0.05, 0.012
# A body that is longer than wide by so much and fills so much of its bounding box stands on its end.
LONG_BODY, FULL_BODY = 1.35, 0.45
SNAP_RAD, MAX_LEAN_RAD = math.radians(4), math.radians(6)


def vessel_from_mesh(path: Path | str, unit: str = "auto", *, up: str = "auto", open_top: bool = False) -> Vessel:
    """Measure a vessel in a GLB, OBJ, STL or PLY file.

    unit: of the file's numbers, as for `meshes.load_mesh`. up: the file's axis that points out of the opening ("+z",
        "-y", ...); "auto" finds it. open_top: cut a closed mesh open at its top and take it as a hollow with thin
        walls, for cartons, bottles and scans that are modelled solid.
    Raises UserError, with the reason and the mend, for what cannot hold or pour.
    """
    if up != "auto" and up not in UPS:
        raise UserError(f"the upward axis of {path} is {up!r}; give auto, {', '.join(UPS)}")
    path = Path(path)
    stamp = path.stat() if path.is_file() else None
    built = _built(str(path), unit, up, open_top, stamp and (stamp.st_mtime_ns, stamp.st_size))
    # The cached mesh stays out of the callers' hands, who may move or scale theirs.
    return replace(built, mesh=built.mesh.copy())


@lru_cache(maxsize=32)
def _built(path: str, unit: str, up: str, open_top: bool, stamp: tuple[int, int] | None) -> Vessel:
    mesh = load_mesh(path, unit)
    vessel, up, T_file_vessel = measured(mesh, Path(path).name, up=up, open_top=open_top)
    source = MeshSource(
        str(Path(path).resolve()), mesh_sha256(mesh), str(mesh.metadata["unit"]), up, open_top, T_file_vessel
    )
    return replace(vessel, source=source)


def measured(mesh: Any, name: str, *, up: str = "auto", open_top: bool = False) -> tuple[Vessel, str, Array]:
    """The vessel that a trimesh in metres shows, the axis that was up, and T_mesh_vessel (4, 4).

    The settings and errors are those of `vessel_from_mesh`.
    """
    try:
        return _measured(mesh, name, up, open_top)
    except UserError as error:
        raise UserError(f"{name} cannot serve as a vessel: {error}") from error


def _measured(mesh: Any, name: str, up: str, open_top: bool) -> tuple[Vessel, str, Array]:
    import trimesh

    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    colors = np.asarray(mesh.visual.face_colors, np.uint8)
    if (thin_m := float(np.ptp(vertices, axis=0).min())) < MIN_THROAT_M:
        raise UserError(f"it is only {1000 * thin_m:.1f} mm thick; check the unit (--mesh-unit)")
    kept = _without_contents(mesh, vertices, faces)
    faces, colors = faces[kept], colors[kept]
    if up == "auto":
        up = find_up(vertices, faces) or _up_of_closed(vertices, faces)
    R = rotation_to_up(up)
    points = np.ascontiguousarray(vertices @ R.T)
    if open_top:
        points, faces, colors = _cut_open(points, faces, colors)
    hollow = find_hollow(points, faces)
    # Samples are laid on by the seed, so that equal files give equal vessels.
    surface, _ = trimesh.sample.sample_surface(trimesh.Trimesh(points, faces, process=False), SURFACE_POINTS, seed=0)
    features = find_features(np.asarray(surface), points, faces, hollow, cut=open_top)
    _check(hollow, features.has_mouth)
    turn = -_snapped(features.heading_rad)
    R_turn = _rotation_about_z(turn)
    points = points @ R_turn.T
    if turn:
        # Rays look in fixed directions, so the turned mesh is measured again.
        hollow = find_hollow(points, faces)
    features = find_features(np.asarray(surface) @ R_turn.T, points, faces, hollow, cut=open_top)
    offset = -0.5 * (points[np.unique(faces)].min(axis=0) + points[np.unique(faces)].max(axis=0))
    rings = hollow.inner_m if features.lip_rad is None else without_lip(hollow, features.lip_rad)
    axis = (float(hollow.axis_xy_m[0] + offset[0]), float(hollow.axis_xy_m[1] + offset[1]))
    interior = _profile(hollow.z_m + offset[2], rings, axis)
    exterior = _profile(hollow.outer_z_m + offset[2], hollow.outer_m, axis)
    order = 1 if features.handles or features.spout or features.lip_rad is not None else _fold(hollow)
    visible = trimesh.Trimesh(points + offset, faces, process=False, face_colors=_few_colors(colors))
    visible.remove_unreferenced_vertices()
    outlet = features.outlet
    extent_x, extent_y, extent_z = (float(v) for v in np.ptp(visible.vertices, axis=0))
    vessel = Vessel(
        category=_word(name),
        params={},
        mesh=visible,
        symmetry=Symmetry(order=order),
        section=_section(exterior),
        interior=interior,
        exterior=exterior,
        wall_m=hollow.wall_m,
        outlet=replace(
            outlet,
            point_m=outlet.point_m + offset,
            entry_m=None if outlet.entry_m is None else outlet.entry_m + offset,
        ),
        is_open=hollow.is_open,
        grasps=tuple(replace(g, center_m=g.center_m + offset) for g in grasp_regions(features.handles, hollow)),
        interior_volume_m3=hollow.volume_m3,
        mass_kg=_mass_kg(hollow, _word(name)),
        color_rgba=_main_color(visible),
        extents_m=(extent_x, extent_y, extent_z),
    )
    R_vessel_mesh = R_turn @ R
    return vessel, up, make_pose(R_vessel_mesh.T, -R_vessel_mesh.T @ offset)


def _rotation_about_z(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _snapped(angle_rad: float) -> float:
    """An angle within a few degrees of the mesh's own axes is meant to be theirs."""
    nearest = round(angle_rad / (math.pi / 2)) * (math.pi / 2)
    return nearest if abs(angle_rad - nearest) < SNAP_RAD else angle_rad


def _check(hollow: Hollow, has_mouth: bool) -> None:
    if not has_mouth and not hollow.two_sided:
        raise UserError(
            "its surface is closed all round, without an opening or a spout; if it stands for a full container, cut it "
            "open with --mesh-open-top (open_top), or say which axis is up with --mesh-up"
        )
    if not has_mouth:
        raise UserError("its hollow is closed all round and has no spout; say which axis is up with --mesh-up")
    if hollow.volume_m3 < MIN_VOLUME_M3:
        raise UserError(
            f"its hollow takes {1e6 * hollow.volume_m3:.1f} ml, too little for particles, which need "
            f"{1e6 * MIN_VOLUME_M3:.0f} ml; check the unit (--mesh-unit)"
        )
    if hollow.is_open and hollow.throat_m < MIN_THROAT_M:
        raise UserError(
            f"its opening is {2000 * hollow.throat_m:.1f} mm wide, where particles jam below {2000 * MIN_THROAT_M:.0f} "
            "mm; check the unit (--mesh-unit)"
        )
    leaning = float(np.arctan(np.linalg.norm(np.polyfit(hollow.z_m, hollow.middles_m, 1)[0])))
    if leaning > MAX_LEAN_RAD:
        raise UserError(
            f"it leans by about {math.degrees(leaning):.0f} degrees in its file; turn it upright there, or say which "
            "axis is up with --mesh-up"
        )
    widest = float(half_widths(hollow.inner_m).max())
    if widest < 1.5 * MIN_THROAT_M:
        raise UserError(f"its hollow is only {2000 * widest:.0f} mm wide; check the unit (--mesh-unit)")


def _without_contents(mesh: Any, vertices: Array, faces: Faces) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(F,) faces without closed bodies that lie in a vessel as its contents: the wine in a bottle."""
    import trimesh

    graph: Any = trimesh.graph  # through Any, since these parts of trimesh carry no types
    labels = graph.connected_component_labels(mesh.face_adjacency, node_count=len(faces))
    kept = np.ones(len(faces), bool)
    for label in np.unique(labels):
        mine = labels == label
        body, rest = vertices[np.unique(faces[mine])], kept & ~mine
        around = vertices[np.unique(faces[rest])] if rest.any() else body
        inside = np.all(body.min(axis=0) > around.min(axis=0)) and np.all(body.max(axis=0) < around.max(axis=0))
        if not inside or np.prod(np.ptp(body, axis=0)) < CONTENTS_SHARE * np.prod(np.ptp(around, axis=0)):
            continue
        closed = trimesh.Trimesh(vertices, faces[mine], process=False).is_watertight
        if closed and find_up(vertices, faces[rest]) is not None:
            kept = rest
    return kept


def _up_of_closed(vertices: Array, faces: Faces) -> str:
    """Up of a closed mesh: along a long and full body toward its narrower end, else away from the broadest base."""
    bases: dict[str, float] = {}
    full = 0.0
    for up in UPS:
        columns = Columns(np.ascontiguousarray(vertices @ rotation_to_up(up).T), faces)
        bases[up] = columns.base_m2()
        full = max(full, columns.fullness())
    extents = np.ptp(vertices, axis=0)
    longest = int(np.argmax(extents))
    ups = list(UPS)
    if full > FULL_BODY and extents[longest] > LONG_BODY * np.sort(extents)[1]:
        ups = [up for up in UPS if up[1] == "xyz"[longest]]
    ups.sort(key=lambda up: -bases[up])
    if bases[ups[0]] > 1.4 * bases[ups[1]]:
        return ups[0]
    raise UserError(
        "no opening was found in any of the six axis directions; say which is up with --mesh-up (up) and, if it stands "
        "for a full container, cut it open there with --mesh-open-top (open_top)"
    )


def _cut_open(points: Array, faces: Faces, colors: Any) -> tuple[Array, Faces, Any]:
    """The mesh without what lies above the highest place where it is one closed, wide enough outline."""
    import trimesh

    hollow = find_hollow(points, faces)
    if hollow.is_open:
        raise UserError("it has an opening already; leave out --mesh-open-top (open_top)")
    half = half_widths(hollow.inner_m)
    wide = np.flatnonzero(half > max(CUT_HALF_WIDTH_M, CUT_SHARE * float(half.max())))
    if len(wide) == 0:
        raise UserError(f"it is nowhere wider than {2000 * CUT_HALF_WIDTH_M:.0f} mm; check the unit (--mesh-unit)")
    z_m = float(hollow.z_m[wide[-1]])
    for hole in hollow.holes:
        # A scanner that saw a little way into the opening folded the surface inward there: below that.
        if hole.radius_m > 0.5 * half[wide[-1]]:
            z_m = min(z_m, float(hole.center_m[2]) - hole.radius_m)
    mesh = trimesh.Trimesh(points, faces, process=False)
    intersections: Any = trimesh.intersections
    cut, new_faces, _ = intersections.slice_faces_plane(
        mesh.vertices, mesh.faces, plane_normal=[0, 0, -1], plane_origin=[0, 0, z_m]
    )
    nearest = trimesh.Trimesh(cut, new_faces, process=False).triangles_center
    from scipy.spatial import cKDTree

    _, old = cKDTree(mesh.triangles_center).query(nearest)
    return np.ascontiguousarray(cut), np.asarray(new_faces, np.int64), colors[old]


def _profile(z: Array, rings: Array, axis_xy_m: tuple[float, float]) -> Profile:
    """A profile with the supports of the rings' hulls, drawn in so that each section keeps its area."""
    support = ring_supports(rings, SUPPORTS)
    hull = polygon_areas(support_polygons(support))
    wanted = ring_areas(rings)
    support = support * np.sqrt(np.clip(wanted / hull, 0.5, 1.0))[:, None]
    half_x = 0.5 * (support[:, 0] + support[:, SUPPORTS // 2])
    half_y = 0.5 * (support[:, SUPPORTS // 4] + support[:, 3 * SUPPORTS // 4])
    aspect = float(np.median(half_y / half_x))
    corner = np.array([_corner(r, aspect, area) for r, area in zip(half_x, wanted, strict=True)])
    return Profile(np.asarray(z, float), half_x, corner, aspect, axis_xy_m, support)


def _corner(half_x: float, aspect: float, area_m2: float) -> float:
    """Corner ratio of the rounded rectangle with this extent and area."""
    missing = 4 * aspect * half_x**2 - area_m2
    ratio = math.sqrt(max(missing, 0.0) / (4 - math.pi)) / (half_x * min(1.0, aspect))
    return float(np.clip(ratio, 0.05, 1.0))


def _section(exterior: Profile) -> Section:
    widest = int(np.argmax(exterior.radius_m))
    corner = float(exterior.corner[widest])
    if abs(exterior.aspect - 1) < 0.04 and corner > 0.93:
        return Section()
    return Section(exterior.aspect, corner)


def _fold(hollow: Hollow) -> int:
    """Rotational symmetry of the outer wall: 0 for a body of revolution, else the largest number of folds."""
    rings = hollow.outer_m / hollow.outer_m.mean(axis=1, keepdims=True)
    if float(np.mean(np.ptp(np.percentile(rings, [5, 95], axis=1), axis=0))) < ROUND:
        return 0
    for order in (10, 9, 8, 6, 5, 4, 3, 2):
        if RAYS % order == 0 and np.mean(np.abs(rings - np.roll(rings, RAYS // order, axis=1))) < FOLD:
            return order
    return 1


def _mass_kg(hollow: Hollow, category: str) -> float:
    """Mass of walls, floor and lid by their area and thickness, and what vessels of that name are made of."""
    z, rings = hollow.outer_z_m, hollow.outer_m
    around = 2 * np.pi * rings.mean(axis=1)
    slope = np.gradient(rings.mean(axis=1), z)
    area = float(np.trapezoid(around * np.sqrt(1 + slope**2), z)) + math.pi * float(rings[0].mean()) ** 2
    if not hollow.is_open:
        area += math.pi * float(rings[-1].mean()) ** 2
    if category in CATEGORIES:
        nominal = make_vessel(category)
        density = nominal.mass_kg / float(nominal.mesh.volume)
    else:
        density = THICK_KG_M3 if hollow.wall_m > THICK_WALL_M else THIN_KG_M3
    return float(np.clip(area * hollow.wall_m * density, 0.02, 3.0))


def _few_colors(colors: Any) -> Any:
    """Face colours (F, 4) brought down to a few, since every one is drawn as a mesh of its own."""
    from scipy.cluster.vq import kmeans2

    distinct = np.unique(colors, axis=0)
    if len(distinct) <= MAX_COLORS:
        return colors
    rgb = np.asarray(colors[:, :3], np.float64)
    shade = np.argsort(rgb.sum(axis=1))
    start = rgb[shade[np.linspace(0, len(rgb) - 1, MAX_COLORS).astype(np.int64)]]
    centers, label = kmeans2(rgb, start, iter=10, minit="matrix", missing="warn")
    few = np.full_like(colors, 255)
    few[:, :3] = np.clip(np.round(centers[label]), 0, 255)
    return few


def _main_color(mesh: Any) -> tuple[float, float, float, float]:
    colors, which = np.unique(mesh.visual.face_colors, axis=0, return_inverse=True)
    area = np.bincount(which.ravel(), weights=mesh.area_faces)
    red, green, blue, _ = (float(v) / 255 for v in colors[int(np.argmax(area))])
    return red, green, blue, 1.0


def _word(name: str) -> str:
    """The library's category that the file's name speaks of, or "vessel"."""
    stem = Path(name).stem.lower().replace("-", "_")
    words = [stem, *reversed(stem.split("_"))]
    for word in words:
        for length in range(len(word), 2, -1):
            try:
                return resolve_category(word[-length:])[0]
            except UserError:
                continue
    return "vessel"
