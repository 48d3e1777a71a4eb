"""The library seen from outside: a table of its categories, mesh files, and a picture of every vessel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError
from .files import atomic_path
from .offscreen import load_mujoco
from .vessel_types import Vessel
from .vessels import CATEGORIES, make_vessel, parameter_space

EXPORT_SUFFIXES = (".glb", ".obj", ".stl", ".ply")


def library_table() -> list[dict[str, Any]]:
    """One row per category, of its nominal vessel: extents in m, volume in ml, symmetry, outlet, parameters."""
    rows = []
    for category in CATEGORIES:
        vessel = make_vessel(category)
        rows.append(
            {
                "category": category,
                "extents_m": [round(extent, 4) for extent in vessel.extents_m],
                "interior_volume_ml": round(1e6 * vessel.interior_volume_m3, 1),
                "mass_g": round(1e3 * vessel.mass_kg, 1),
                "outlet": vessel.outlet.kind,
                "symmetry_order": vessel.symmetry.order,
                "faces": len(vessel.mesh.faces),
                "parameters": list(parameter_space(category)),
            }
        )
    return rows


def export_vessel(vessel: Vessel, path: Path) -> None:
    """Write the mesh in metres as GLB, OBJ, STL or PLY by the suffix, with the colours of its parts.

    Every file keeps the vessel's own axes, z up, so that reading it back gives the same frame; viewers that take
    GLB for y up show it lying. STL carries no colour.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in EXPORT_SUFFIXES:
        raise UserError(f"{path} has the suffix {path.suffix!r}; a mesh is written as {', '.join(EXPORT_SUFFIXES)}")
    with atomic_path(path) as temporary:
        if suffix == ".glb":
            temporary.write_bytes(_glb_bytes(vessel))
        elif suffix == ".obj":
            temporary.write_text(_obj_text(vessel), encoding="utf-8")
        else:
            vessel.mesh.export(temporary, file_type=suffix[1:])


def _obj_text(vessel: Vessel) -> str:
    """OBJ with one colour per vertex in the extended form that most viewers read."""
    mesh = vessel.mesh
    colors = np.zeros((len(mesh.vertices), 3))
    colors[mesh.faces] = (mesh.visual.face_colors[:, :3] / 255.0)[:, None]
    lines = [f"# vid2demo {vessel.category}, metres, z up", f"o {vessel.category}"]
    lines += [
        f"v {x:.7f} {y:.7f} {z:.7f} {r:.3f} {g:.3f} {b:.3f}"
        for (x, y, z), (r, g, b) in zip(mesh.vertices, colors, strict=True)
    ]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    return "\n".join(lines) + "\n"


def _glb_bytes(vessel: Vessel) -> bytes:
    """GLB with one primitive and material per part colour."""
    import trimesh

    # Through Any, since these parts of trimesh carry no types.
    visual: Any = trimesh.visual
    scene: Any = trimesh.Scene()
    for index, (color, part) in enumerate(colored_parts(vessel)):
        material = visual.material.PBRMaterial(
            name=f"{vessel.category}_{index}", baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.5
        )
        part.visual = visual.TextureVisuals(material=material)
        scene.add_geometry(part, node_name=f"{vessel.category}_{index}", geom_name=f"part_{index}")
    data: bytes = scene.export(file_type="glb")
    return data


def colored_parts(vessel: Vessel) -> list[tuple[np.ndarray[Any, np.dtype[np.uint8]], Any]]:
    """The mesh split by face colour, for renderers with one colour a mesh: (RGBA bytes (4,), trimesh.Trimesh) each."""
    import trimesh

    mesh = vessel.mesh
    colors, which = np.unique(mesh.visual.face_colors, axis=0, return_inverse=True)
    parts = []
    for index, color in enumerate(colors):
        faces = mesh.faces[which.ravel() == index]
        used, renumbered = np.unique(faces, return_inverse=True)
        parts.append((color, trimesh.Trimesh(mesh.vertices[used], renumbered.reshape(-1, 3), process=False)))
    return parts


def contact_sheet(
    path: Path,
    *,
    categories: Sequence[str] = CATEGORIES,
    seeds: Sequence[int | None] = (None,),
    columns: int = 6,
    cell_px: int = 240,
) -> None:
    """Draw vessels in a grid to a PNG, each category once per seed (None: the nominal variant), all to one scale."""
    from PIL import Image, ImageDraw

    shown = [(category, seed) for category in categories for seed in seeds]
    rows = math.ceil(len(shown) / columns)
    sheet = Image.new("RGB", (columns * cell_px, rows * cell_px), (245, 245, 243))
    draw = ImageDraw.Draw(sheet)
    for index, (category, seed) in enumerate(shown):
        x, y = index % columns * cell_px, index // columns * cell_px
        sheet.paste(Image.fromarray(render_vessel(make_vessel(category, seed), cell_px)), (x, y))
        draw.text((x + 8, y + 6), category if seed is None else f"{category} {seed}", fill=(40, 40, 40))
    with atomic_path(Path(path)) as temporary:
        sheet.save(temporary, format="PNG")


def render_vessel(
    vessel: Vessel, size_px: int = 240, *, elevation_deg: float = 22.0, azimuth_deg: float = 115.0
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(size_px, size_px, 3) picture of a vessel by MuJoCo's renderer, framed to fill it."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth = spec.visual.global_.offheight = size_px
    spec.visual.global_.fovy = 30.0
    spec.visual.headlight.ambient = [0.38] * 3
    spec.visual.headlight.diffuse = [0.42] * 3
    spec.visual.headlight.specular = [0.15] * 3
    spec.visual.map.znear = 0.01
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.96, 0.96, 0.95],
        rgb2=[0.96, 0.96, 0.95],
        width=16,
        height=96,
    )
    spec.worldbody.add_light(
        pos=[0.6, -0.8, 1.5], dir=[-0.35, 0.5, -1.0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[0.45] * 3
    )
    for index, (color, part) in enumerate(colored_parts(vessel)):
        mesh = spec.add_mesh(name=f"part_{index}")
        mesh.uservert = np.asarray(part.vertices, float).ravel()
        mesh.userface = np.asarray(part.faces, np.int32).ravel()
        # Parts are open surfaces, of which no volume can be taken.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part_{index}", rgba=color / 255.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.distance = 0.54 * float(np.linalg.norm(vessel.extents_m)) / math.tan(math.radians(15.0))
    camera.elevation, camera.azimuth = -elevation_deg, azimuth_deg
    with mujoco.Renderer(model, size_px, size_px) as renderer:
        renderer.update_scene(data, camera)
        return np.asarray(renderer.render(), np.uint8)
