"""Meshes from files: read with limits, brought to metres, one plain triangle mesh each; and their fingerprint.

Files found in the wild come in any unit, as scenes of many parts, with a texture's seams cut open, with millions of
faces or with none. What leaves here has finite vertices in metres, at least one face and at most as many as asked.
"""

from __future__ import annotations

import hashlib
import logging
import math
import threading
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from .errors import UserError
from .geometry import Array

Unit = Literal["auto", "m", "mm", "cm", "in"]

SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply")
METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
MAX_FILE_BYTES = 256 * 1024 * 1024
MAX_LOADED_FACES = 5_000_000
# Largest extent of things one hand can pour with, and the widest range in which a stated unit is believed.
HOUSEHOLD_M = (0.02, 0.6)
BELIEVABLE_M = (0.005, 2.0)
TYPICAL_M = 0.16
# How unusual each unit is in mesh files, in units of log size: decides between two plausible readings.
UNIT_RARITY = {"m": 0.0, "mm": 0.2, "cm": 0.3, "in": 1.0}

_log = logging.getLogger(__name__)
THINNING = threading.Lock()  # fast_simplification keeps the mesh that it works on in global variables


def load_mesh(path: Path | str, unit: str = "auto", *, max_faces: int | None = 60_000) -> Any:
    """Read a GLB, GLTF, OBJ, STL or PLY file as one `trimesh.Trimesh` in metres, in the file's own axes.

    unit: of the numbers in the file; "auto" guesses it from the extent (a household object of 0.02 to 0.6 m) and
        logs what it took. The unit is left in `mesh.metadata["unit"]`, whether it was "given" or "guessed" in
        `mesh.metadata["unit_source"]`.
    max_faces: meshes with more are decimated (`mesh.metadata["faces_in_file"]` keeps the count); None for no limit.
    Vertex colours, from textures where there are any, are kept as `mesh.visual.vertex_colors`.
    Raises UserError for a file that is missing, too large, damaged, empty, not finite, or of an implausible size.
    """
    path = Path(path)
    if unit != "auto" and unit not in METRES_PER_UNIT:
        raise UserError(f"unknown mesh unit {unit!r} for {path.name}; give auto, {', '.join(METRES_PER_UNIT)}")
    vertices, faces, colors = _read(path)
    extent = float(np.ptp(vertices, axis=0).max())
    if unit == "auto":
        found = guess_unit(extent)
        if found is None:
            raise UserError(
                f"{path}: its extent of {extent:.4g} fits no household object in m, mm, cm or in; "
                "state the unit with --mesh-unit or scale the mesh"
            )
        scale = METRES_PER_UNIT[found]
        level = logging.INFO if found == "m" else logging.WARNING
        _log.log(level, "%s: no unit given; extent %.4g read as %s (%.3f m)", path, extent, found, extent * scale)
    else:
        found, scale = unit, METRES_PER_UNIT[unit]
        check_extent(extent * scale, found, str(path), extent)
    mesh = _joined(path, vertices, faces, colors, scale, max_faces)
    mesh.metadata.update(unit=found, unit_source="guessed" if unit == "auto" else "given")
    return mesh


def load_mesh_of_unknown_size(path: Path | str, *, max_faces: int | None = 60_000) -> Any:
    """Like `load_mesh`, in the file's own unit and of any size: what is stored by its shape alone is read so.

    Raises UserError for a file that is missing, too large, damaged, empty, not finite, or flat to a point.
    """
    path = Path(path)
    vertices, faces, colors = _read(path)
    if not np.ptp(vertices, axis=0).max() > 0:
        raise UserError(f"{path} has no extent; export the object's surface again")
    # Brought to a size at which the tolerances of joining vertices mean something, and back.
    size = float(np.ptp(vertices, axis=0).max())
    mesh = _joined(path, vertices, faces, colors, 1 / size, max_faces)
    mesh.apply_scale(size)
    return mesh


def _joined(
    path: Path,
    vertices: Array,
    faces: np.ndarray[Any, np.dtype[np.int64]],
    colors: np.ndarray[Any, np.dtype[np.uint8]],
    scale: float,
    max_faces: int | None,
) -> Any:
    """A scaled trimesh of at most so many faces, its equal vertices joined and its degenerate faces gone."""
    faces_in_file = len(faces)
    if max_faces is not None and faces_in_file > max_faces:
        vertices, faces, colors = _decimated(vertices, faces, colors, max_faces)
    import trimesh

    mesh = trimesh.Trimesh(vertices * scale, faces, process=False, vertex_colors=colors)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise UserError(f"{path} holds only degenerate triangles; export the object's surface again")
    mesh.metadata.update(name=path.stem, faces_in_file=faces_in_file)
    return mesh


def guess_unit(extent: float) -> str | None:
    """The unit in which a largest extent, as a bare number, is most likely a household object; None if in none."""
    best, best_cost = None, math.inf
    for unit, scale in METRES_PER_UNIT.items():
        size_m = extent * scale
        if not HOUSEHOLD_M[0] <= size_m <= HOUSEHOLD_M[1]:
            continue
        # A mesh scaled to a unit cube has lost its size, and inches are too rare to read it as a tiny object.
        if unit == "in" and size_m < 0.06:
            continue
        cost = abs(math.log(size_m / TYPICAL_M)) + UNIT_RARITY[unit]
        if cost < best_cost:
            best, best_cost = unit, cost
    return best


def check_extent(extent_m: float, unit: str, name: str, extent: float) -> None:
    """Raise UserError when an extent is impossible for a held object, naming the unit that would make it possible."""
    if BELIEVABLE_M[0] <= extent_m <= BELIEVABLE_M[1]:
        return
    better = guess_unit(extent)
    hint = f"did you mean --mesh-unit {better}?" if better else "scale the mesh or state its unit with --mesh-unit"
    raise UserError(f"{name}: extent is {extent_m:.3g} m when read in {unit}; {hint}")


def mesh_sha256(mesh: Any) -> str:
    """Hex SHA-256 of vertices, rounded to a micrometre, and faces: equal shapes give equal hashes on any machine."""
    # Adding zero turns -0 into 0.
    vertices = np.round(np.asarray(mesh.vertices, np.float64) * 1e6).astype("<i8") + 0
    digest = hashlib.sha256(np.ascontiguousarray(vertices, "<i8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, "<i8").tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[Array, np.ndarray[Any, np.dtype[np.int64]], np.ndarray[Any, np.dtype[np.uint8]]]:
    """Vertices in the file's unit, faces and RGBA vertex colours of everything in a file, its scene put together."""
    if not path.is_file():
        raise UserError(f"mesh file {path} does not exist")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"{path} has the suffix {path.suffix!r}; a mesh is read from {', '.join(SUFFIXES)}")
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise UserError(
            f"{path} has {size / 2**20:.0f} MiB, more than the {MAX_FILE_BYTES / 2**20:.0f} MiB read; decimate it first"
        )
    import trimesh

    class FolderResolver(trimesh.resolvers.FilePathResolver):
        """Side files (buffers, textures) from the mesh's own folder only, and no larger than a mesh may be."""

        def get(self, name: str) -> bytes:
            target = Path(self.absolute(name))
            # Google Scanned Objects keep textures in a folder beside the mesh's, which their materials do not say.
            aside = path.parent.parent / "materials" / "textures" / Path(name).name
            if not target.is_file() and path.parent.name == "meshes" and aside.is_file():
                target = aside
            if target.is_file() and target.stat().st_size > MAX_FILE_BYTES:
                raise ValueError(f"its side file {name} is too large")
            return target.read_bytes() if target == aside else cast(bytes, super().get(name))

    try:
        with open(path, "rb") as stream:
            scene = trimesh.load_scene(
                stream, file_type=suffix[1:], resolver=FolderResolver(str(path)), allow_remote=False, process=False
            )
        placed = [
            (transform, scene.geometry[name])
            for transform, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
            if isinstance(scene.geometry[name], trimesh.Trimesh)
        ]
    except Exception as error:  # the readers raise whatever the damaged bytes lead them into
        raise UserError(f"{path} cannot be read as a mesh ({error}); export it again") from error
    count = sum(len(part.faces) for _, part in placed)
    if count == 0:
        raise UserError(f"{path} holds no triangles; export the object's surface, not points or curves")
    if count > MAX_LOADED_FACES:
        raise UserError(f"{path} has {count} faces, more than the {MAX_LOADED_FACES} read; decimate it first")
    vertices, faces, colors, offset = [], [], [], 0
    for transform, part in placed:
        points = trimesh.transform_points(np.asarray(part.vertices, np.float64), transform)
        triangles = np.asarray(part.faces, np.int64)
        # A mirroring transform turns the surface inside out.
        faces.append((triangles[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0 else triangles) + offset)
        vertices.append(points)
        colors.append(_vertex_colors(part))
        offset += len(points)
    all_vertices, all_faces = np.concatenate(vertices), np.concatenate(faces)
    if all_faces.min() < 0 or all_faces.max() >= len(all_vertices):
        raise UserError(f"{path} has faces that name vertices it does not hold; export it again")
    # Vertices that no face uses (a scene's helper points) do not count.
    used = np.unique(all_faces)
    if not np.all(np.isfinite(all_vertices[used])):
        raise UserError(f"{path} has vertices that are not finite numbers; export it again")
    all_faces = np.searchsorted(used, all_faces)
    return all_vertices[used], all_faces, np.concatenate(colors)[used]


def _vertex_colors(part: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(V, 4) RGBA of a part, its texture sampled at the vertices; grey where it has no usable colour."""
    grey = np.full((len(part.vertices), 4), (160, 160, 160, 255), np.uint8)
    try:
        visual = part.visual
        colors = np.asarray((visual.to_color() if visual.kind == "texture" else visual).vertex_colors, np.uint8)
    except Exception:  # textures may be missing or damaged; the shape is still good
        return grey
    if colors.shape == (4,):
        return np.tile(colors, (len(grey), 1))
    return colors if colors.shape == grey.shape else grey


def _decimated(
    vertices: Array,
    faces: np.ndarray[Any, np.dtype[np.int64]],
    colors: np.ndarray[Any, np.dtype[np.uint8]],
    max_faces: int,
) -> tuple[Array, np.ndarray[Any, np.dtype[np.int64]], np.ndarray[Any, np.dtype[np.uint8]]]:
    """Fewer faces by quadric edge collapse; colours taken from the nearest old vertex."""
    import fast_simplification
    from scipy.spatial import cKDTree

    # Texture seams cut the surface open and the collapse would tear it there: weld first.
    welded, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    faces = inverse.ravel()[faces]
    with THINNING:
        points, triangles = fast_simplification.simplify(welded, faces, target_count=max_faces)[:2]
    points = np.asarray(points, np.float64)
    _, nearest = cKDTree(welded).query(points)
    return points, np.asarray(triangles, np.int64), colors[first][nearest]
