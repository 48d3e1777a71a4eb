"""Symmetry found from a mesh, against shapes whose symmetry is known by how they are made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import make_pose
from vid2demo.extract.meshes import load_mesh
from vid2demo.extract.symmetry import estimate_symmetry, surface_centroid
from vid2demo.extract.vessels import make_vessel

MESHES = Path(__file__).parents[2].parent / "shared" / "data" / "meshes"
needs_meshes = pytest.mark.skipif(not MESHES.is_dir(), reason="needs ../shared/data/meshes")


@pytest.mark.parametrize(
    "category",
    ["mug", "tumbler", "wine_glass", "bowl", "gooseneck_kettle", "saucepan", "milk_jug", "bottle", "carton", "carafe"],
)
@pytest.mark.parametrize("seed", [None, 1])
def test_library_vessels_have_the_symmetry_they_say(category: str, seed: int | None) -> None:
    vessel = make_vessel(category, seed)
    found = estimate_symmetry(vessel.mesh)
    assert found.order == vessel.symmetry.order
    if found.order != 1:
        assert found.axis == pytest.approx((0, 0, 1))


@pytest.mark.parametrize(
    ("extents", "axis", "order"),
    [
        ((0.05, 0.07, 0.12), 2, 2),
        ((0.05, 0.05, 0.12), 2, 4),
        ((0.12, 0.05, 0.05), 0, 4),
        ((0.05, 0.12, 0.05), 1, 4),
        ((0.05, 0.056, 0.20), 2, 2),
        ((0.10, 0.10, 0.10), 2, 4),
    ],
)
def test_boxes(extents: tuple[float, float, float], axis: int, order: int) -> None:
    found = estimate_symmetry(trimesh.creation.box(extents))
    assert (int(np.argmax(found.axis)), found.order) == (axis, order)


@pytest.mark.parametrize(("sections", "order"), [(3, 3), (5, 5), (6, 6), (8, 8), (12, 0), (64, 0)])
def test_prisms_are_round_from_twelve_sides_on(sections: int, order: int) -> None:
    assert estimate_symmetry(trimesh.creation.cylinder(0.03, 0.1, sections=sections)).order == order


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_place_turn_and_unit_do_not_matter(scale: float) -> None:
    mesh = trimesh.creation.cylinder(0.03, 0.1)
    R = Rotation.from_rotvec([0.7, -0.4, 0.9]).as_matrix()
    mesh.apply_transform(make_pose(R, (1.0, 2.0, 3.0)))
    mesh.apply_scale(scale)
    found = estimate_symmetry(mesh)
    assert found.order == 0
    assert abs(float(R[:, 2] @ found.axis)) > np.cos(np.deg2rad(0.5))
    assert surface_centroid(mesh) == pytest.approx(scale * np.array([1.0, 2.0, 3.0]))


def test_inside_out_torn_and_doubled_surfaces_do_not_matter() -> None:
    mesh = make_vessel("tumbler").mesh
    mesh.invert()
    # A label drawn twice on one side: more surface there, and no less symmetric to look at.
    sector = mesh.triangles_center[:, 0] > 0.93 * mesh.vertices[:, 0].max()
    faces = np.concatenate([mesh.faces[1:], mesh.faces[sector]])
    torn = trimesh.Trimesh(mesh.vertices, faces, process=False)
    assert not torn.is_watertight
    assert estimate_symmetry(torn).order == 0


def test_a_handle_or_a_stub_breaks_the_symmetry() -> None:
    body = trimesh.creation.cylinder(0.03, 0.1)
    stub = trimesh.creation.box((0.012, 0.01, 0.02))
    stub.apply_translation((0.035, 0, 0.02))
    assert estimate_symmetry(trimesh.util.concatenate([body, stub])).order == 1
    other = stub.copy()
    other.apply_translation((-0.07, 0, 0))
    assert estimate_symmetry(trimesh.util.concatenate([body, stub, other])).order == 2


def test_equal_seeds_give_equal_answers() -> None:
    mesh = make_vessel("carton").mesh
    assert estimate_symmetry(mesh, seed=3) == estimate_symmetry(mesh, seed=3)


@needs_meshes
@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("mustard_bottle.obj", 2),
        ("wine_bottle.glb", 0),
        ("white_bowl.glb", 0),
        ("ramekin.glb", 0),
        ("ycb_mug.glb", 1),
        ("stovetop_kettle.glb", 1),
        ("ycb_pitcher_base.glb", 1),
    ],
)
def test_meshes_from_the_wild(name: str, order: int) -> None:
    assert estimate_symmetry(load_mesh(MESHES / name)).order == order
