"""What a synthetic vessel looks like: a picture wrapped around its outer wall, plain colours everywhere else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .geometry import Array
from .synthetic_textures import PRINT_KINDS, PRINT_V, Image, plain_v, random_color, vessel_texture

if TYPE_CHECKING:
    from .vessel_types import Vessel

_MAX_PART_COLORS = 5


@dataclass(frozen=True)
class Look:
    """kind: of the print. color_rgb: of the body, in [0, 1]. texture: the picture.

    uv: (3 F, 2) texture coordinates, uv_faces: (F, 3) their indices.
    """

    kind: str
    color_rgb: Array
    texture: Image
    uv: Array
    uv_faces: NDArray[np.int32]


def vessel_look(rng: np.random.Generator, vessel: Vessel) -> Look:
    """Draw a look: the library's own colours or a random body colour, with or without a print and a light inside."""
    part_colors, part = _parts(vessel)
    body = int(np.argmax(np.bincount(part, weights=np.asarray(vessel.mesh.area_faces), minlength=len(part_colors))))
    color = random_color(rng, (0.1, 0.85), (0.3, 0.95))
    if rng.random() < 0.5:
        color = part_colors[body]
    inside = color * 0.9 if rng.random() < 0.5 else random_color(rng, (0.0, 0.15), (0.75, 0.95))
    kind = str(rng.choice(PRINT_KINDS, p=[0.4, 0.2, 0.15, 0.15, 0.1]))
    part_colors[body] = color
    plain = [inside, *part_colors]

    corner, printed, inner = _regions(vessel, part == body)
    vertices = np.asarray(vessel.mesh.vertices, float)
    turn = np.arctan2(corner[..., 1], corner[..., 0]) / (2 * np.pi)
    turn = turn[:, :1] + (turn - turn[:, :1] + 0.5) % 1 - 0.5  # keeps a face together across the seam
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    rise = PRINT_V[0] + 0.02 + (corner[..., 2] - low) / (high - low) * (PRINT_V[1] - PRINT_V[0] - 0.04)
    strip = np.where(inner, 0, 1 + part)
    flat = plain_v(len(plain))[strip][:, None] * np.ones((1, 3))
    uv = np.stack([turn, np.where(printed[:, None], rise, flat)], axis=-1).reshape(-1, 2)
    texture = vessel_texture(rng, kind, color, plain)
    return Look(kind, color, texture, uv, np.arange(len(uv), dtype=np.int32).reshape(-1, 3))


def _parts(vessel: Vessel) -> tuple[list[Array], NDArray[np.int64]]:
    """Distinct face colours (RGB in [0, 1]) and, for every face, which one it has."""
    if getattr(vessel.mesh.visual, "kind", None) == "face":
        colors, part = _colors_of(vessel.mesh)
        if len(colors) <= _MAX_PART_COLORS:
            return colors, part
    return [np.asarray(vessel.color_rgba, float)[:3]], np.zeros(len(vessel.mesh.faces), np.int64)


def _colors_of(mesh: Any) -> tuple[list[Array], NDArray[np.int64]]:
    colors, part = np.unique(np.asarray(mesh.visual.face_colors)[:, :3], axis=0, return_inverse=True)
    return [np.asarray(c, float) / 255 for c in colors], np.asarray(part, np.int64).reshape(-1)


def _regions(vessel: Vessel, is_body: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Face corners (F, 3, 3) about the vessel's axis, and which faces are outer wall and which inside."""
    vertices, faces = np.asarray(vessel.mesh.vertices, float), np.asarray(vessel.mesh.faces, np.int64)
    exterior, interior = vessel.exterior, vessel.interior
    corner = vertices[faces] - [*interior.axis_xy_m, 0.0]
    center, normal = corner.mean(axis=1), np.asarray(vessel.mesh.face_normals, float)
    radius = np.linalg.norm(center[:, :2], axis=1)
    outward = np.einsum("fi,fi->f", normal[:, :2], center[:, :2]) / np.maximum(radius, 1e-9)
    box = np.maximum(np.abs(center[:, 0]), np.abs(center[:, 1]) / exterior.aspect)
    wall = np.interp(center[:, 2], exterior.z_m, exterior.radius_m)
    hollow = np.interp(center[:, 2], interior.z_m, interior.radius_m)
    printed = is_body & (outward > 0.2) & (box < 1.03 * wall + 0.001) & (radius > 0.9 * min(1, exterior.aspect) * wall)
    box = np.maximum(np.abs(center[:, 0]), np.abs(center[:, 1]) / interior.aspect)
    inner = (box < hollow + 0.0005) & (outward < 0.2) & (center[:, 2] > interior.z_m[0] - 0.0005)
    return corner, printed, inner & (center[:, 2] < interior.z_m[-1] + 0.0005)


def thing_look(rng: np.random.Generator, mesh: Any) -> Look:
    """Draw a look for any mesh with coloured parts: a print on the largest part, laid on from its six sides."""
    part_colors, part = _colors_of(mesh)
    body = int(np.argmax(np.bincount(part, weights=np.asarray(mesh.area_faces), minlength=len(part_colors))))
    kind = str(rng.choice(PRINT_KINDS, p=[0.4, 0.25, 0.1, 0.15, 0.1]))
    corner, normal = np.asarray(mesh.vertices, float)[mesh.faces], np.abs(np.asarray(mesh.face_normals, float))
    low, size = np.asarray(mesh.bounds[0], float), np.maximum(np.asarray(mesh.extents, float), 1e-9)
    inside = (corner - low) / size
    across = np.array([[1, 2], [0, 2], [0, 1]])[np.argmax(normal, axis=1)]
    uv = np.take_along_axis(inside, across[:, None, :].repeat(3, axis=1), axis=2)
    uv[..., 1] = PRINT_V[0] + 0.02 + uv[..., 1] * (PRINT_V[1] - PRINT_V[0] - 0.04)
    flat = plain_v(len(part_colors))[part]
    uv[part != body, :, 1] = flat[part != body, None]
    uv = uv.reshape(-1, 2)
    texture = vessel_texture(rng, kind, part_colors[body], part_colors)
    return Look(kind, part_colors[body], texture, uv, np.arange(len(uv), dtype=np.int32).reshape(-1, 3))


def face_colors(look: Look) -> NDArray[np.uint8]:
    """(F, 3) the texture's colour in the middle of every face, for a mesh file without a picture."""
    height, width = look.texture.shape[:2]
    middle = look.uv[look.uv_faces].mean(axis=1)
    column = np.clip((middle[:, 0] % 1.0) * width, 0, width - 1).astype(int)
    return np.asarray(look.texture[np.clip(middle[:, 1] * height, 0, height - 1).astype(int), column])
