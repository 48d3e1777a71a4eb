"""Mesh files: units guessed or checked, limits kept, bad files answered by one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from vid2demo.extract import meshes
from vid2demo.extract.errors import UserError
from vid2demo.extract.meshes import METRES_PER_UNIT, guess_unit, load_mesh, mesh_sha256

SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "meshes"


def box_file(path: Path, extents: tuple[float, float, float] = (0.08, 0.1, 0.2)) -> Path:
    trimesh.creation.box(extents).export(path)
    return path


@pytest.mark.parametrize("suffix", meshes.SUFFIXES)
def test_every_format_reads_in_metres(tmp_path, suffix):
    if suffix == ".gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.creation.box((0.08, 0.1, 0.2)).scene()).items():
            (tmp_path / name).write_bytes(data)
        path = tmp_path / "model.gltf"
    else:
        path = box_file(tmp_path / f"box{suffix}")
    mesh = load_mesh(path)
    assert mesh.extents == pytest.approx([0.08, 0.1, 0.2])
    assert mesh.is_watertight
    assert len(mesh.faces) == 12
    assert mesh.metadata["unit"] == "m"
    assert mesh.metadata["unit_source"] == "guessed"


@pytest.mark.parametrize("unit", ["m", "mm", "cm", "in"])
def test_stated_units_are_converted(tmp_path, unit):
    scale = METRES_PER_UNIT[unit]
    path = box_file(tmp_path / "box.stl", (0.08 / scale, 0.1 / scale, 0.2 / scale))
    mesh = load_mesh(path, unit)
    assert mesh.extents == pytest.approx([0.08, 0.1, 0.2], rel=1e-5)
    assert mesh.metadata["unit_source"] == "given"


@given(st.floats(0.08, 0.35), st.sampled_from(["m", "mm", "cm"]))
def test_ordinary_sizes_are_recognised_in_metric_units(size_m, unit):
    assert guess_unit(size_m / METRES_PER_UNIT[unit]) == unit


@given(st.floats(1e-12, 1e12))
def test_a_guessed_unit_always_gives_a_household_size(extent):
    unit = guess_unit(extent)
    if unit is not None:
        assert 0.02 <= extent * METRES_PER_UNIT[unit] <= 0.6


def test_millimetres_read_as_metres_are_refused_with_the_mend(tmp_path):
    path = box_file(tmp_path / "kettle.stl", (60.0, 50.0, 96.0))
    with pytest.raises(UserError, match=r"extent is 96 m when read in m; did you mean --mesh-unit mm\?"):
        load_mesh(path, "m")


def test_a_size_that_fits_no_unit_asks_for_it(tmp_path):
    path = box_file(tmp_path / "unit_cube.stl", (1.0, 1.0, 1.0))
    with pytest.raises(UserError, match="state the unit"):
        load_mesh(path)
    assert load_mesh(path, "m").extents.max() == pytest.approx(1.0)


def test_a_guess_other_than_metres_is_said(tmp_path, caplog):
    load_mesh(box_file(tmp_path / "box.stl", (80.0, 100.0, 200.0)))
    assert "read as mm (0.200 m)" in caplog.text


def test_unknown_unit_lists_the_known_ones(tmp_path):
    with pytest.raises(UserError, match=r"'ft'.*give auto, m, mm, cm, in"):
        load_mesh(box_file(tmp_path / "box.stl"), "ft")


def test_missing_file_and_unknown_format(tmp_path):
    with pytest.raises(UserError, match=r"nowhere.glb does not exist"):
        load_mesh(tmp_path / "nowhere.glb")
    other = tmp_path / "mesh.pkl"
    other.write_bytes(b"\x80\x04.")
    with pytest.raises(UserError, match=r"suffix '.pkl'; a mesh is read from .glb"):
        load_mesh(other)


@pytest.mark.parametrize("suffix", meshes.SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"nonsense\n", b"glTF\x02\x00\x00\x00\xff\xff\xff\xff", b"{}"])
def test_damaged_files_are_one_user_error(tmp_path, suffix, content):
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"broken\S+ (cannot be read|holds no triangles)"):
        load_mesh(path)


def test_truncated_glb_is_one_user_error(tmp_path):
    whole = box_file(tmp_path / "whole.glb").read_bytes()
    path = tmp_path / "cut.glb"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"cut\.glb"):
        load_mesh(path)


def test_points_without_faces_are_refused(tmp_path):
    path = tmp_path / "points.ply"
    trimesh.PointCloud(np.eye(3)).export(path)
    with pytest.raises(UserError, match="no triangles"):
        load_mesh(path)


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_vertices_that_are_not_finite_are_refused(tmp_path, number):
    path = tmp_path / "box.obj"
    path.write_text(f"v 0 0 0\nv 0.1 0 0\nv 0 {number} 0\nf 1 2 3\n")
    with pytest.raises(UserError, match=r"not finite|cannot be read"):
        load_mesh(path)


def test_a_mesh_of_slivers_only_is_refused(tmp_path):
    path = tmp_path / "line.obj"
    path.write_text("v 0 0 0\nv 0.1 0 0\nv 0.2 0 0\nf 1 2 3\n")
    with pytest.raises(UserError, match="degenerate"):
        load_mesh(path)


def test_too_large_a_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = box_file(tmp_path / "box.stl")
    monkeypatch.setattr(meshes, "MAX_FILE_BYTES", 100)
    with pytest.raises(UserError, match="decimate it first"):
        load_mesh(path)


def test_too_many_faces_are_refused(tmp_path, monkeypatch):
    path = box_file(tmp_path / "box.stl")
    monkeypatch.setattr(meshes, "MAX_LOADED_FACES", 11)
    with pytest.raises(UserError, match="12 faces"):
        load_mesh(path)


def test_scenes_are_put_together_with_their_transforms(tmp_path):
    scene = trimesh.Scene()
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([0.2, 0, 0]))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = -0.2
    scene.add_geometry(box.copy(), transform=mirror)
    scene.export(tmp_path / "three.glb")
    mesh = load_mesh(tmp_path / "three.glb")
    assert mesh.extents == pytest.approx([0.5, 0.1, 0.1])
    # The mirrored part is not inside out.
    assert mesh.volume == pytest.approx(3e-3, rel=1e-4)


def test_many_faces_are_decimated_and_counted(tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(5, 0.1).export(path)
    mesh = load_mesh(path, max_faces=2000)
    assert 500 < len(mesh.faces) <= 2000
    assert mesh.metadata["faces_in_file"] == 20480
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.02)
    assert len(load_mesh(path, max_faces=None).faces) == 20480


def gltf_triangle(uri: str) -> str:
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}
    ]
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": accessors,
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"uri": uri, "byteLength": 36}],
        }
    )


@pytest.mark.parametrize("uri", ["../secret.bin", "http://localhost:9/secret.bin", "file:///etc/hostname"])
def test_side_files_outside_the_folder_are_not_opened(tmp_path, uri):
    triangle = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], np.float32)
    (tmp_path / "secret.bin").write_bytes(triangle.tobytes())
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "model.gltf").write_text(gltf_triangle(uri))
    with pytest.raises(UserError, match="cannot be read"):
        load_mesh(inside / "model.gltf")
    (inside / "own.bin").write_bytes(triangle.tobytes())
    (inside / "model.gltf").write_text(gltf_triangle("own.bin"))
    assert len(load_mesh(inside / "model.gltf").faces) == 1


def test_a_missing_texture_does_not_cost_the_shape(tmp_path):
    path = tmp_path / "box.obj"
    path.write_text("mtllib nowhere.mtl\nusemtl gone\nv 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    assert len(load_mesh(path).faces) == 1


def test_hash_sees_shape_only():
    mesh = trimesh.creation.icosphere(2, 0.1)
    same = mesh.copy()
    same.visual.face_colors = [255, 0, 0, 255]
    same.vertices = same.vertices + 1e-9
    assert mesh_sha256(same) == mesh_sha256(mesh)
    moved = mesh.copy()
    moved.vertices[0] += 1e-4
    assert mesh_sha256(moved) != mesh_sha256(mesh)
    flipped = mesh.copy()
    flipped.invert()
    assert mesh_sha256(flipped) != mesh_sha256(mesh)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data/meshes")
@pytest.mark.parametrize(
    ("name", "unit", "largest_m"),
    [
        ("frypan.glb", "m", 0.356),
        ("ketchup.glb", "cm", 0.149),
        ("milk_carton.glb", "cm", 0.190),
        ("moka_pot.glb", "in", 0.141),
        ("mustard_bottle.obj", "m", 0.191),
        ("porcelain_mug.glb", "m", 0.131),
        ("ramekin.glb", "m", 0.089),
        ("red_coffee_mug.glb", "m", 0.135),
        ("stovetop_kettle.glb", "m", 0.299),
        ("white_bowl.glb", "m", 0.170),
        ("wine_bottle.glb", "m", 0.300),
        ("ycb_bleach_cleanser.glb", "m", 0.251),
        ("ycb_mug.glb", "m", 0.117),
        ("ycb_pitcher_base.glb", "m", 0.242),
    ],
)
def test_meshes_as_found_in_the_wild(name, unit, largest_m):
    mesh = load_mesh(SHARED / name)
    assert mesh.metadata["unit"] == unit
    assert mesh.extents.max() == pytest.approx(largest_m, abs=1e-3)
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)
