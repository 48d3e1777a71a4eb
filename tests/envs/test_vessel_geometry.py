from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.envs.scene import build_scene
from vid2demo.envs.vessel_geometry import (
    Cavity,
    cavity_of,
    collision_boxes,
    gripper_half_width_m,
    visual_parts,
)
from vid2demo.extract.geometry import Array, make_pose
from vid2demo.extract.vessel_from_mesh import measured
from vid2demo.extract.vessels import CATEGORIES, Vessel, make_vessel


@pytest.fixture
def cylinder() -> Cavity:
    """A hollow of 16 sides, apothem 40 mm, from z = -0.05 to 0.05, on an axis off the origin."""
    angle = 2 * np.pi * np.arange(16) / 16
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return Cavity(np.array([-0.05, 0.05]), np.full((2, 16), 0.04), normals, np.array([0.01, 0.0]))


def test_hollow_knows_its_inside(cylinder: Cavity) -> None:
    points = np.array([[0.01, 0, 0], [0.0499, 0, 0], [0.0501, 0, 0], [0.01, 0, 0.0501], [0.01, 0, -0.0501]])
    np.testing.assert_array_equal(cylinder.contains(points), [True, True, False, False, False])
    np.testing.assert_allclose(cylinder.clearance_m(points[:1]), 0.04)


def test_inside_agrees_with_clearance_in_any_pose() -> None:
    cavity = cavity_of(make_vessel("carton"))
    T = make_pose(Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix(), (0.3, -0.2, 0.5))
    local = np.random.default_rng(0).uniform(-0.1, 0.1, (5000, 3))
    inside = cavity.contains(local @ T[:3, :3].T + T[:3, 3], T)
    np.testing.assert_array_equal(inside, cavity.clearance_m(local) >= 0)
    assert 200 < np.count_nonzero(inside) < 4800


def test_volume_of_a_prism_and_of_a_pyramid_is_exact(cylinder: Cavity) -> None:
    area = 16 * 0.04**2 * np.tan(np.pi / 16)
    assert cylinder.volume_m3 == pytest.approx(0.1 * area, rel=1e-12)
    tip = Cavity(cylinder.z_m, np.stack([np.full(16, 1e-12), np.full(16, 0.04)]), cylinder.normals, np.zeros(2))
    assert tip.volume_m3 == pytest.approx(0.1 * area / 3, rel=1e-9)


def test_samples_spread_evenly_and_repeat(cylinder: Cavity) -> None:
    points = cylinder.sample(2000)
    assert len(points) == 2000
    assert np.all(cylinder.contains(points))
    np.testing.assert_allclose(points.mean(axis=0), [0.01, 0.0, 0.0], atol=5e-4)
    np.testing.assert_array_equal(points, cylinder.sample(2000))


@pytest.mark.parametrize("category", CATEGORIES)
def test_hollow_holds_what_the_vessel_holds(category: str) -> None:
    vessel = make_vessel(category)
    assert cavity_of(vessel).volume_m3 == pytest.approx(vessel.interior_volume_m3, rel=0.05)


@pytest.mark.parametrize("category", ["bowl", "carton", "teapot", "pitcher", "bottle"])
def test_the_hollow_measured_in_a_mesh_is_the_librarys(category: str) -> None:
    known = make_vessel(category)
    vessel, _, _ = measured(known.mesh, category)
    cavity = cavity_of(vessel)
    assert cavity.volume_m3 == pytest.approx(known.interior_volume_m3, rel=0.03)
    points = cavity_of(known).sample(2000)
    assert np.mean(cavity.contains(points)) > 0.96


def slanted_trough() -> Vessel:
    """A vessel from a mesh, of a section that is neither round nor alike in any direction: a leaning triangle."""
    corners = np.array([[0.07, 0.0], [-0.02, 0.05], [-0.03, -0.04]])
    outer, inner = (prism(corners * scale, low, 0.09) for scale, low in ((1.0, 0.0), (0.88, 0.006)))
    trough = trimesh.boolean.difference([outer, inner.apply_translation((0, 0, 0.001))], engine="manifold")
    return measured(trough, "trough", up="+z")[0]


def prism(corners_m: Array, low_m: float, high_m: float) -> trimesh.Trimesh:
    """The hull of a polygon (n, 2) at one height and, half as large again, at another."""
    rings = [np.column_stack([corners_m * f, np.full(len(corners_m), z)]) for f, z in ((1.0, low_m), (1.5, high_m))]
    return trimesh.Trimesh(np.vstack(rings)).convex_hull


@pytest.mark.parametrize("category", [*CATEGORIES, "trough"])
def test_walls_leave_the_hollow_free_and_close_it_all_round(category: str) -> None:
    vessel = slanted_trough() if category == "trough" else make_vessel(category)
    cavity = cavity_of(vessel)
    boxes = collision_boxes(vessel, cavity)
    low = np.array([*(cavity.axis_xy_m - 1.2 * cavity.reach_m), cavity.z_m[0] - 0.01])
    high = np.array([*(cavity.axis_xy_m + 1.2 * cavity.reach_m), cavity.rim_m])
    points = np.random.default_rng(0).uniform(low, high, (15000, 3))
    clearance_m = cavity.clearance_m(points)
    to_wall_m = np.min([box.distance_m(points) for box in boxes], axis=0)
    assert not np.any((clearance_m > 1.5e-4) & (to_wall_m == 0.0)), "a wall reaches into the hollow"
    middle_m, half_height_m = (cavity.z_m[0] + cavity.rim_m) / 2, (cavity.rim_m - cavity.z_m[0]) / 2
    # Right behind the surface there must be wall everywhere but at the very rim, where the wall's end is cut square.
    away_from_rim = np.abs(points[:, 2] - middle_m) < half_height_m - 0.003
    shell = (clearance_m < -0.0002) & (clearance_m > -0.003) & away_from_rim
    assert np.count_nonzero(shell) > 200
    assert to_wall_m[shell].max() == 0.0, "there is a gap in the wall"


def test_a_closed_kettle_gets_a_lid_and_an_open_mug_does_not() -> None:
    for category, closed in (("gooseneck_kettle", True), ("mug", False)):
        vessel = make_vessel(category)
        cavity = cavity_of(vessel)
        above = np.array([[*cavity.axis_xy_m, cavity.rim_m + 0.004]])
        covered = min(box.distance_m(above)[0] for box in collision_boxes(vessel, cavity)) == 0.0
        assert covered == closed


def test_visual_parts_keep_colours_and_stay_light() -> None:
    mesh = make_vessel("gooseneck_kettle").mesh
    parts = visual_parts(mesh, max_faces=2000)
    assert len(parts) == len(np.unique(mesh.visual.face_colors, axis=0))
    assert sum(len(faces) for _, _, faces in parts) <= 2100
    vertices = np.vstack([vertices for _, vertices, _ in parts])
    np.testing.assert_allclose(vertices.min(0), mesh.bounds[0], atol=0.003)
    np.testing.assert_allclose(vertices.max(0), mesh.bounds[1], atol=0.003)


def test_a_textured_mesh_is_thinned_as_a_whole_so_that_it_does_not_tear() -> None:
    mesh = make_vessel("mug").mesh
    shades = np.random.default_rng(0).integers(4, size=len(mesh.faces))
    palette = np.array([[200, 30, 30, 255], [30, 200, 30, 255], [30, 30, 200, 255], [90, 90, 90, 255]], np.uint8)
    mesh.visual.face_colors = palette[shades]
    parts = visual_parts(mesh, max_faces=1500)
    assert len(parts) == 4
    assert sum(len(faces) for _, _, faces in parts) <= 1500
    together = trimesh.util.concatenate([trimesh.Trimesh(v, f, process=False) for _, v, f in parts])
    together.merge_vertices()
    assert together.is_watertight


def test_fingers_close_on_the_handle(mug_pour) -> None:
    vessel = mug_pour.vessel()
    handle = next(g for g in vessel.grasps if g.kind == "handle")
    assert gripper_half_width_m(vessel, mug_pour.T_hand_object) == pytest.approx(handle.width_m / 2, abs=0.002)
    assert gripper_half_width_m(vessel, make_pose(None, (1.0, 0.0, 0.0))) == 0.0


def test_a_receptacle_in_the_table_is_refused_and_one_above_it_stands_on_a_pedestal(mug_pour) -> None:
    from vid2demo.envs.liquid import Liquid
    from vid2demo.extract.errors import UserError

    def moved(dz_m: float):
        entry = dict(mug_pour.header["receptacle"])
        T = np.array(entry["T_world_receptacle"])
        T[2, 3] += dz_m
        return mug_pour.with_header(receptacle={**entry, "T_world_receptacle": T.tolist()})

    with pytest.raises(UserError, match="40 mm below the table"):
        build_scene(moved(-0.04), 0, Liquid(), 0.002)
    names = [
        {build.model.geom(i).name for i in range(build.model.ngeom)}
        for build in (build_scene(moved(dz), 0, Liquid(), 0.002) for dz in (0.0, 0.1))
    ]
    assert "pedestal" not in names[0]
    assert "pedestal" in names[1]
