from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from vid2demo.extract.any_vessel import resolve_vessel, vessel_of_entry
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import transform_points
from vid2demo.extract.meshes import load_mesh
from vid2demo.extract.vessel_from_mesh import measured, vessel_from_mesh
from vid2demo.extract.vessel_output import export_vessel
from vid2demo.extract.vessels import CATEGORIES, make_vessel

SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "meshes"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs the meshes in ../shared/data")
OPEN_MESHES = {
    "frypan.glb": 820, "porcelain_mug.glb": 528, "ramekin.glb": 144, "red_coffee_mug.glb": 469, "white_bowl.glb": 890,
    "wine_bottle.glb": 884, "ycb_mug.glb": 274, "stovetop_kettle.glb": 6040, "moka_pot.glb": 481,
}  # fmt: skip
CLOSED_MESHES = {
    "ketchup.glb": 224, "milk_carton.glb": 734, "mustard_bottle.obj": 551, "ycb_bleach_cleanser.glb": 875,
    "ycb_pitcher_base.glb": 2154,
}  # fmt: skip


def tube(profile: list[tuple[float, float]], *, close: bool = True, sections: int = 48) -> trimesh.Trimesh:
    """Body of revolution of a line of (r, z), closed to a ring where its ends meet."""
    line = [*profile, profile[0]] if close else profile
    return trimesh.creation.revolve(np.array(line), sections=sections)


def cup(height_m: float = 0.1, wall_m: float = 0.003) -> trimesh.Trimesh:
    """A plain cup, 80 mm wide."""
    return tube(
        [(0.0, 0.0), (0.04, 0.0), (0.04, height_m), (0.04 - wall_m, height_m), (0.04 - wall_m, wall_m), (0.0, wall_m)],
        close=False,
    )


def leaning(angle_deg: float) -> trimesh.Trimesh:
    """A tall tumbler askew."""
    mesh = make_vessel("tumbler").mesh.copy()
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(math.radians(angle_deg), [1, 0, 0]))


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_librarys_own_meshes_are_measured_right(category: str) -> None:
    for seed in (None, 3):
        known = make_vessel(category, seed)
        vessel, up, T_mesh_vessel = measured(known.mesh, category)
        assert up == "+z"
        np.testing.assert_allclose(T_mesh_vessel, np.eye(4), atol=1e-6)
        assert vessel.category == category
        assert vessel.interior_volume_m3 == pytest.approx(known.interior_volume_m3, rel=0.02)
        assert vessel.interior.volume_m3 == pytest.approx(known.interior.volume_m3, rel=0.03)
        assert (vessel.is_open, vessel.outlet.kind) == (known.is_open, known.outlet.kind)
        assert np.linalg.norm(vessel.outlet.point_m - known.outlet.point_m) < 0.008
        assert vessel.outlet.direction @ known.outlet.direction > math.cos(math.radians(45))
        assert vessel.symmetry.order == known.symmetry.order
        handles = [[g for g in v.grasps if g.kind == "handle"] for v in (vessel, known)]
        assert len(handles[0]) == len(handles[1])
        for found, true in zip(*handles, strict=True):
            assert np.linalg.norm(found.center_m - true.center_m) < 0.03
            assert abs(found.axis @ true.axis) > math.cos(math.radians(20))
            assert found.width_m == pytest.approx(true.width_m, abs=0.005)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".ply"])
def test_a_file_in_other_axes_and_millimetres_gives_the_same_vessel(tmp_path: Path, suffix: str) -> None:
    known = make_vessel("jug")
    turned = known.mesh.copy()
    # y up, x toward the viewer, 1000 times larger and away from the origin.
    turned.apply_transform(np.array([[0, 1, 0, 0.3], [0, 0, 1, 0.1], [1, 0, 0, -0.2], [0, 0, 0, 1.0]]))
    turned.apply_scale(1000)
    turned.export(tmp_path / f"jug{suffix}")
    vessel = vessel_from_mesh(tmp_path / f"jug{suffix}")
    assert vessel.source is not None
    assert (vessel.source.unit, vessel.source.up) == ("mm", "+y")
    assert vessel.interior_volume_m3 == pytest.approx(known.interior_volume_m3, rel=0.02)
    np.testing.assert_allclose(vessel.outlet.point_m, known.outlet.point_m, atol=0.004)
    np.testing.assert_allclose(vessel.extents_m, known.extents_m, atol=1e-4)
    in_file = load_mesh(tmp_path / f"jug{suffix}")
    lifted = transform_points(vessel.source.T_file_vessel, np.asarray(vessel.mesh.vertices))
    np.testing.assert_allclose([lifted.min(0), lifted.max(0)], in_file.bounds, atol=1e-5)


def test_a_section_of_any_shape_is_followed() -> None:
    def slab(half_x: float, half_y: float, low: float, high: float) -> trimesh.Trimesh:
        box = trimesh.creation.box((2 * half_x, 2 * half_y, high - low))
        return box.apply_translation((0, 0, (low + high) / 2))

    # A trough: a box with a smaller box taken out of it.
    trough = trimesh.boolean.difference([slab(0.06, 0.03, 0, 0.08), slab(0.056, 0.026, 0.004, 0.09)], engine="manifold")
    vessel, _, _ = measured(trough, "trough")
    assert vessel.interior_volume_m3 == pytest.approx(0.112 * 0.052 * 0.076, rel=0.01)
    assert vessel.interior.support_m is not None
    n = vessel.interior.support_m.shape[1]
    np.testing.assert_allclose(vessel.interior.support_m[40, [0, n // 2]], 0.056, rtol=0.02)
    np.testing.assert_allclose(vessel.interior.support_m[40, [n // 4, 3 * n // 4]], 0.026, rtol=0.02)
    assert vessel.symmetry.order == 2
    assert vessel.section.kind == "rounded_rectangle"
    assert min(g.width_m for g in vessel.grasps) == pytest.approx(0.06, abs=0.002)


def test_a_wall_of_one_surface_and_a_torn_mesh_still_hold() -> None:
    sheet = tube([(0.0, 0.0), (0.035, 0.0), (0.04, 0.09)], close=False)
    vessel, _, _ = measured(sheet, "sheet")
    frustum = math.pi * 0.09 / 3 * (0.035**2 + 0.035 * 0.04 + 0.04**2)
    assert vessel.is_open
    assert vessel.interior_volume_m3 == pytest.approx(frustum, rel=0.1)
    torn = cup().subdivide_to_size(0.01)
    keep = np.random.default_rng(0).random(len(torn.faces)) > 0.05
    torn.update_faces(keep)
    assert not torn.is_watertight
    assert measured(torn, "torn")[0].interior_volume_m3 == pytest.approx(math.pi * 0.037**2 * 0.097, rel=0.05)


def test_contents_modelled_in_a_vessel_are_left_out() -> None:
    wine = trimesh.creation.cylinder(0.0365, 0.06, sections=48).apply_translation((0, 0, 0.04))
    vessel, _, _ = measured(trimesh.util.concatenate([cup(), wine]), "full")
    assert vessel.interior_volume_m3 == pytest.approx(math.pi * 0.037**2 * 0.097, rel=0.02)
    assert len(vessel.mesh.faces) == len(cup().faces)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (trimesh.creation.icosphere(radius=0.05), "which is up with --mesh-up"),
        (trimesh.creation.cylinder(0.03, 0.2), "--mesh-up"),
        (trimesh.creation.cone(0.04, 0.15), "open_top"),
        (tube([(0.02, 0.0), (0.04, 0.0), (0.04, 0.1), (0.02, 0.1)]), "which is up with --mesh-up"),
        (cup(height_m=0.1).apply_scale(0.2), "ml, too little"),
        (leaning(20.0), "leans by about .* degrees in its file"),
        (trimesh.creation.box((0.1, 0.1, 0.002)), r"only 2\.0 mm thick"),
        (cup().slice_plane((0, 0, 0.05), (0, 0, 1)), "no bottom"),
    ],
)
def test_what_cannot_hold_is_refused_with_reason_and_mend(mesh: trimesh.Trimesh, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        measured(mesh, "thing")


def test_an_opening_at_both_ends_asks_which_is_up() -> None:
    double = trimesh.util.concatenate([cup(), cup().apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))])
    with pytest.raises(UserError, match=r"open toward [+-]z and toward [+-]z; say which is up"):
        measured(double, "double")
    assert measured(double, "double", up="-z")[0].is_open


def test_files_entries_and_names_resolve(tmp_path: Path) -> None:
    vessel = make_vessel("mug")
    export_vessel(vessel, tmp_path / "mug.stl")
    path = str(tmp_path / "mug.stl")
    assert resolve_vessel(vessel) is vessel
    assert resolve_vessel("mug:3").params == make_vessel("mug", 3).params
    found = resolve_vessel(path, "receptacle")
    assert found.category == "mug"
    assert resolve_vessel({"file": path, "unit": "m", "up": "+z"}).interior_volume_m3 == found.interior_volume_m3
    found.mesh.apply_scale(2.0)
    assert resolve_vessel(path).mesh.extents[2] == pytest.approx(vessel.extents_m[2], abs=1e-6)
    for bad, word in (("mgu", "mug, cup"), ("mug:x", "mug:3"), (tmp_path / "no.glb", "does not exist"), ({}, "names")):
        with pytest.raises(UserError, match=word):
            resolve_vessel(bad, "held vessel")
    with pytest.raises(UserError, match=r"give auto, \+z"):
        vessel_from_mesh(path, up="z")
    assert found.source is not None
    entry = {"file": path, "sha256": found.source.sha256}
    export_vessel(make_vessel("mug", 1), tmp_path / "mug.stl")
    with pytest.raises(UserError, match="has changed"):
        vessel_of_entry(entry, "held vessel")


@needs_shared
@pytest.mark.parametrize("name", OPEN_MESHES)
def test_vessels_found_in_the_wild_hold(name: str) -> None:
    vessel = vessel_from_mesh(SHARED / name)
    assert 1e6 * vessel.interior_volume_m3 == pytest.approx(OPEN_MESHES[name], rel=0.03)
    assert vessel.source is not None
    assert vessel.source.up == "+z"
    assert vessel.is_open == (name not in ("stovetop_kettle.glb", "moka_pot.glb"))
    assert vessel.outlet.kind == ("lip" if vessel.is_open else "spout")
    has_handle = name in ("frypan.glb", "porcelain_mug.glb", "red_coffee_mug.glb", "ycb_mug.glb")
    assert any(g.kind == "handle" and g.center_m[0] < -0.03 for g in vessel.grasps) == has_handle
    assert len(np.unique(vessel.mesh.visual.face_colors, axis=0)) <= 6


@needs_shared
@pytest.mark.parametrize("name", CLOSED_MESHES)
def test_solid_scans_are_refused_and_can_be_cut_open(name: str) -> None:
    with pytest.raises(UserError, match=r"closed all round.*--mesh-open-top"):
        vessel_from_mesh(SHARED / name)
    vessel = vessel_from_mesh(SHARED / name, open_top=True)
    assert vessel.is_open
    assert 1e6 * vessel.interior_volume_m3 == pytest.approx(CLOSED_MESHES[name], rel=0.03)
    assert any(g.kind == "handle" for g in vessel.grasps) == (name == "ycb_pitcher_base.glb")
