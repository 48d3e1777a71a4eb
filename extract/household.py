"""Household things that are no vessels, made by code from a seed: what else stands on a table in synthetic pictures.

Each is a closed `trimesh.Trimesh` in metres whose origin is the centre of its bounding box, +z up as it usually lies or
stands; face colours tell its parts apart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .errors import UserError
from .geometry import Array, make_pose
from .synthetic_textures import random_color

Part = tuple[Any, Array]


def household_mesh(category: str, seed: int) -> Any:
    """A seeded variant of one of `HOUSEHOLD`. Raises UserError for another category."""
    import trimesh

    if category not in _SHAPES:
        raise UserError(f"unknown household thing {category!r}; there are {', '.join(HOUSEHOLD)}")
    rng = np.random.default_rng([seed, *category.encode()])
    parts = _SHAPES[category](rng)
    for part, color in parts:
        part.visual.face_colors = [*np.rint(255 * np.asarray(color)).astype(int), 255]
    mesh = trimesh.util.concatenate([part for part, _ in parts])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def _book(rng: np.random.Generator) -> list[Part]:
    length, thick = rng.uniform(0.17, 0.26), rng.uniform(0.018, 0.045)
    width, board = length * rng.uniform(0.62, 0.78), 0.003
    cover, paper = random_color(rng, (0.4, 0.9), (0.25, 0.8)), np.array([0.94, 0.92, 0.85])
    sheets = _box((width - 0.008, length - 0.01, thick - 2 * board), (0.0, 0.0, 0.0))
    boards = [_box((width, length, board), (0.0, 0.0, side * (thick - board) / 2)) for side in (-1, 1)]
    spine = _box((board, length, thick - 2 * board), (-(width - board) / 2, 0.0, 0.0))
    return [(sheets, paper), *((board_, cover) for board_ in boards), (spine, cover)]


def _ball(rng: np.random.Generator) -> list[Part]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=rng.uniform(0.03, 0.065))
    return [(ball, random_color(rng, (0.3, 0.9), (0.4, 0.95)))]


def _banana(rng: np.random.Generator) -> list[Part]:
    length, bend = rng.uniform(0.16, 0.21), rng.uniform(0.9, 1.5)
    thick = length * rng.uniform(0.085, 0.105)
    along = np.linspace(0.0, 1.0, 25)
    angle = bend * (along - 0.5)
    middle = length / bend * np.column_stack([np.sin(angle), np.zeros(25), 1 - np.cos(angle)])
    profile = np.interp(along, [0.0, 0.06, 0.14, 0.35, 0.65, 0.93, 1.0], [0.30, 0.32, 0.75, 1.0, 1.0, 0.55, 0.25])
    turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    inward = np.column_stack([-np.sin(angle), np.zeros(25), np.cos(angle)])
    rings = middle[:, None] + thick * profile[:, None, None] * (
        np.cos(turn)[:, None] * np.array([0.0, 1.0, 0.0]) + np.sin(turn)[:, None] * inward[:, None]
    )
    lying = rings.reshape(-1, 3) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    yellow = np.array([0.93, 0.80, 0.20]) * rng.uniform(0.85, 1.0)
    return [(_tube(lying.reshape(25, 20, 3)), yellow)]


def _hammer(rng: np.random.Generator) -> list[Part]:
    import trimesh

    length, head = rng.uniform(0.24, 0.32), rng.uniform(0.09, 0.125)
    grip, thick = rng.uniform(0.011, 0.015), rng.uniform(0.012, 0.016)
    handle = trimesh.creation.cylinder(grip, length, sections=24)
    handle.apply_transform(_lying("y"))
    face = trimesh.creation.cylinder(thick, head * 0.45, sections=28)
    face.apply_transform(_lying("x"))
    face.apply_translation([head * 0.275, length / 2 - thick, 0.0])
    claw = _box((head * 0.6, 2 * thick * 0.8, 2 * thick * 0.55), (-head * 0.2, length / 2 - thick, 0.0))
    wood = np.array([0.72, 0.53, 0.33]) * rng.uniform(0.7, 1.0)
    steel = np.full(3, rng.uniform(0.35, 0.6))
    return [(handle, wood), (face, steel), (claw, steel)]


_SHAPES: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "book": _book,
    "ball": _ball,
    "banana": _banana,
    "hammer": _hammer,
}
HOUSEHOLD: tuple[str, ...] = tuple(_SHAPES)


def _box(size_m: tuple[float, float, float], center_m: tuple[float, float, float]) -> Any:
    import trimesh

    box = trimesh.creation.box(size_m)
    box.apply_translation(center_m)
    return box


def _lying(axis: str) -> Array:
    """Pose that lays a cylinder's axis along x or y."""
    return make_pose(Rotation.from_euler("yx"["xy".index(axis)], 90, degrees=True).as_matrix())


def _tube(rings: Array) -> Any:
    """A closed surface through rings (K, S, 3), with a fan over either end."""
    import trimesh

    count, corners = rings.shape[:2]
    k, s = np.meshgrid(np.arange(count - 1), np.arange(corners), indexing="ij")
    a, b = k * corners + s, k * corners + (s + 1) % corners
    walls = np.concatenate([np.stack([a, b, b + corners], -1), np.stack([a, b + corners, a + corners], -1)])
    ends = [rings[0].mean(axis=0), rings[-1].mean(axis=0)]
    ring = np.arange(corners)
    after = (ring + 1) % corners
    top = (count - 1) * corners
    first = np.column_stack([np.full(corners, count * corners), after, ring])
    last = np.column_stack([np.full(corners, count * corners + 1), top + ring, top + after])
    faces = np.concatenate([walls.reshape(-1, 3), first, last])
    mesh = trimesh.Trimesh(np.vstack([rings.reshape(-1, 3), *ends]), faces, process=False)
    mesh.fix_normals()
    return mesh
