"""The library's vessels are what they claim: solid, hollow, metric, symmetric, rebuildable."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from vid2demo.extract.errors import UserError
from vid2demo.extract.first_pose import upright_rotation
from vid2demo.extract.geometry import focal_prior_camera_matrix, make_pose
from vid2demo.extract.meshes import load_mesh, mesh_sha256
from vid2demo.extract.raster import render_depth
from vid2demo.extract.vessel_output import contact_sheet, export_vessel, library_table
from vid2demo.extract.vessel_shapes import Solid, remembered, stacked_rings
from vid2demo.extract.vessel_types import Profile, Section
from vid2demo.extract.vessels import (
    CATEGORIES,
    Vessel,
    _build,
    make_vessel,
    outline_mesh,
    parameter_space,
    resolve_category,
)

SEEDS = (None, 1)
every_vessel = pytest.mark.parametrize(
    ("category", "seed"), [(c, s) for c in CATEGORIES for s in SEEDS], ids=lambda v: str(v)
)
every_category = pytest.mark.parametrize("category", CATEGORIES)


def ray_hits_m(vessel: Vessel, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distances along a ray at which it crosses the mesh, ascending (Moeller-Trumbore over all faces)."""
    a, b, c = np.moveaxis(np.asarray(vessel.mesh.triangles), 1, 0)
    edge_1, edge_2 = b - a, c - a
    p = np.cross(direction, edge_2)
    determinant = np.sum(edge_1 * p, axis=1)
    parallel = np.abs(determinant) < 1e-18
    inverse = 1 / np.where(parallel, 1.0, determinant)
    s = origin - a
    u = np.sum(s * p, axis=1) * inverse
    q = np.cross(s, edge_1)
    v = (q @ direction) * inverse
    t = np.sum(edge_2 * q, axis=1) * inverse
    hit = ~parallel & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
    distances = np.sort(t[hit])
    # A ray through an edge meets both its faces.
    return distances[np.concatenate([[True], np.diff(distances) > 1e-7])] if len(distances) else distances


def as_solid(mesh) -> Solid:
    import manifold3d

    return Solid(
        manifold3d.Mesh64(
            vert_properties=np.ascontiguousarray(mesh.vertices, np.float64),
            tri_verts=np.ascontiguousarray(mesh.faces, np.uint64),
        )
    )


def inside_heights(vessel: Vessel, count: int) -> np.ndarray:
    """Heights within the interior that avoid the rounding at floor and rim."""
    low, high = vessel.interior.z_m[[0, -1]]
    return low + (high - low) * np.linspace(0.12, 0.9, count)


@every_vessel
def test_mesh_is_one_watertight_solid(category, seed):
    mesh = make_vessel(category, seed).mesh
    assert mesh.is_watertight
    assert mesh.is_volume
    # One shell also means that no cavity is closed: a kettle's spout really opens into its inside.
    assert mesh.body_count == 1
    assert mesh.volume > 1e-6


@every_vessel
def test_origin_is_the_centre_of_the_bounding_box_and_sizes_are_those_of_households(category, seed):
    vessel = make_vessel(category, seed)
    low, high = vessel.mesh.bounds
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    np.testing.assert_allclose(high - low, vessel.extents_m, atol=1e-12)
    assert 0.05 < max(vessel.extents_m) < 0.5
    assert min(vessel.extents_m) > 0.03
    assert 0.01 < vessel.mass_kg < 3.0
    assert 5e-5 < vessel.interior_volume_m3 < 6e-3


@every_vessel
def test_nothing_enters_the_interior(category, seed):
    vessel = make_vessel(category, seed)
    inner = vessel.interior
    z = np.unique(np.clip(inner.z_m, inner.z_m[0] + 2e-4, inner.z_m[-1] - vessel.wall_m - 1e-3))
    radius, corner = np.interp(z, inner.z_m, inner.radius_m), np.interp(z, inner.z_m, inner.corner)
    content = stacked_rings(Profile(z, radius - 3e-4, corner, inner.aspect, inner.axis_xy_m).outlines()).solid
    overlap = (content ^ as_solid(vessel.mesh)).volume()
    assert overlap < 1e-9


@every_vessel
def test_interior_volume_agrees_with_slices_of_the_mesh(category, seed):
    """Independent of the profile: the hole around the axis in horizontal slices, integrated over the height."""
    from shapely.geometry import Point, Polygon

    vessel = make_vessel(category, seed)
    axis_x, axis_y = vessel.interior.axis_xy_m
    low, high = vessel.interior.z_m[[0, -1]]
    step = (high - low) / 40
    heights = low + step * (np.arange(40) + 0.5)
    slices = vessel.mesh.section_multiplane([axis_x, axis_y, 0.0], [0.0, 0.0, 1.0], heights)
    volume = 0.0
    for cut in slices:
        to_3d = np.asarray(cut.metadata["to_3D"])
        center = Point((np.linalg.inv(to_3d) @ [axis_x, axis_y, to_3d[2, 3], 1.0])[:2])
        holes = [Polygon(ring) for shape in cut.polygons_full for ring in shape.interiors]
        around = [hole.area for hole in holes if hole.contains(center)]
        # A spout's channel may open the ring into the tube at the height where it leaves.
        assert around, f"no wall around the axis at {to_3d[2, 3]}"
        volume += max(around) * step
    assert volume == pytest.approx(vessel.interior_volume_m3, rel=0.02)


@every_vessel
def test_walls_have_the_stated_thickness_and_stand_where_the_profiles_say(category, seed):
    vessel = make_vessel(category, seed)
    axis_x, axis_y = vessel.interior.axis_xy_m
    for z in inside_heights(vessel, 7):
        for turn in (0.5 * np.pi, -0.5 * np.pi):
            direction = np.array([np.cos(turn), np.sin(turn), 0.0])
            hits = ray_hits_m(vessel, np.array([axis_x, axis_y, z]), direction)
            assert len(hits) >= 2
            assert hits[0] == pytest.approx(vessel.interior.radius_at(z), abs=4e-4)
            # A ray across a slope sees more wall than its normal thickness; simplified profiles lose 10% at most.
            assert hits[1] - hits[0] > 0.85 * vessel.wall_m


@every_vessel
def test_floor_and_ceiling_close_the_vessel(category, seed):
    vessel = make_vessel(category, seed)
    low, high = vessel.interior.z_m[[0, -1]]
    # Off the axis, where the ray meets no vertex.
    origin = np.array([vessel.interior.axis_xy_m[0] + 0.0011, 0.0007, 0.5 * (low + high)])
    down = ray_hits_m(vessel, origin, np.array([0.0, 0.0, -1.0]))
    assert origin[2] - down[0] == pytest.approx(low, abs=3e-4)
    assert down[1] - down[0] > 0.5 * vessel.wall_m
    up = ray_hits_m(vessel, origin, np.array([0.0, 0.0, 1.0]))
    if vessel.is_open:
        assert len(up) == 0
    else:
        assert origin[2] + up[0] == pytest.approx(high, abs=3e-4)


@every_vessel
def test_outlet_lies_at_the_rim_or_in_the_mouth_of_the_spout_toward_plus_x(category, seed):
    from trimesh.proximity import closest_point_naive

    vessel = make_vessel(category, seed)
    outlet = vessel.outlet
    assert np.linalg.norm(outlet.direction) == pytest.approx(1.0)
    assert outlet.direction[0] > 0
    assert outlet.point_m[0] > vessel.interior.axis_xy_m[0]
    assert abs(outlet.point_m[1]) < 1e-9
    _, distance, _ = closest_point_naive(vessel.mesh, outlet.point_m[None])
    if outlet.kind == "lip":
        assert vessel.is_open
        assert distance[0] < 5e-4
        assert outlet.point_m[2] == pytest.approx(vessel.interior.z_m[-1], abs=1e-4)
    else:
        assert distance[0] == pytest.approx(outlet.tip_radius_m, abs=0.4 * outlet.tip_radius_m + 2e-4)
        entry = outlet.entry_m
        assert vessel.interior.z_m[0] < entry[2] <= vessel.interior.z_m[-1]
        assert outlet.entry_radius_m > 0


@every_category
def test_handles_are_opposite_the_outlet_and_grasps_describe_real_surfaces(category):
    vessel = make_vessel(category)
    assert vessel.grasps
    axis_x = vessel.interior.axis_xy_m[0]
    low, high = vessel.mesh.bounds
    for grasp in vessel.grasps:
        assert np.linalg.norm(grasp.axis) == pytest.approx(1.0)
        assert np.linalg.norm(grasp.approach) == pytest.approx(1.0)
        assert abs(grasp.axis @ grasp.approach) < 1e-9
        assert grasp.length_m > 0.005
        assert np.all(grasp.center_m > low)
        assert np.all(grasp.center_m < high)
        if grasp.kind == "handle":
            assert 0.004 < grasp.width_m < 0.05
            if category != "stovetop_kettle":
                assert grasp.center_m[0] < axis_x - 0.02
        # The hand closes across axis and approach: what it spans is there.
        across = np.cross(grasp.axis, grasp.approach)
        # A little off, so as not to run along the edges of a mesh ring.
        hits = ray_hits_m(vessel, grasp.center_m - across * 0.5 + 7.3e-5, across)
        hits = hits[np.abs(hits - 0.5) < 0.5 * grasp.width_m + 0.02]
        assert len(hits) >= 2
        assert np.ptp(hits) < 1.25 * grasp.width_m + 0.002


@every_category
def test_symmetry_holds_for_the_mesh(category):
    vessel = make_vessel(category)
    points = np.asarray(vessel.mesh.vertices)
    tree = cKDTree(points)

    def worst_gap_m(angle_rad: float) -> float:
        return float(tree.query(points @ Rotation.from_euler("z", angle_rad).as_matrix().T)[0].max())

    if vessel.symmetry.order == 0:
        # Exactly by the polygon's own steps; in between by less than its sagitta.
        for steps in (1, 5, 16):
            assert worst_gap_m(2 * np.pi * steps / 64) < 1e-6
        radius = np.linalg.norm(points[:, :2], axis=1).max()
        assert np.ptp(vessel.extents_m[:2]) < 1e-6
        assert vessel.extents_m[0] == pytest.approx(2 * radius, rel=0.002)
    elif vessel.symmetry.order > 1:
        assert worst_gap_m(2 * np.pi / vessel.symmetry.order) < 1e-6
        assert worst_gap_m(np.pi / vessel.symmetry.order) > 2e-3
    else:
        for angle_rad in (np.pi / 2, 2 * np.pi / 3, np.pi):
            assert worst_gap_m(angle_rad) > 2e-3


@every_category
def test_every_vessel_is_mirrored_about_its_xz_plane(category):
    solid = as_solid(make_vessel(category, 3).mesh)
    assert (solid - solid.mirror((0.0, 1.0, 0.0))).volume() < 1e-3 * solid.volume()


@every_category
def test_equal_seeds_and_parameters_rebuild_the_same_mesh(category):
    first = make_vessel(category, 7)
    fresh = _build.__wrapped__(category, tuple(first.params.items()))
    again = make_vessel(category, **first.params)
    assert mesh_sha256(first.mesh) == mesh_sha256(fresh.mesh) == mesh_sha256(again.mesh)
    np.testing.assert_array_equal(first.mesh.vertices, fresh.mesh.vertices)
    assert again.params == first.params
    assert mesh_sha256(make_vessel(category, 8).mesh) != mesh_sha256(first.mesh)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_parameters_within_the_ranges_give_a_solid(data):
    category = data.draw(st.sampled_from(CATEGORIES))
    space = parameter_space(category)
    # Corners of the space are where shapes break.
    params = {
        name: data.draw(st.one_of(st.sampled_from([r.low, r.nominal, r.high]), st.floats(r.low, r.high)), label=name)
        for name, r in space.items()
    }
    vessel = make_vessel(category, **params)
    assert vessel.mesh.is_volume
    assert vessel.mesh.body_count == 1
    assert np.all(vessel.interior.radius_m > 0)
    assert np.all(np.diff(vessel.interior.z_m) > 0)
    assert np.all(np.diff(vessel.exterior.z_m) > 0)
    assert vessel.interior_volume_m3 > 0


def test_cached_vessels_cannot_be_spoiled_by_their_users():
    first = make_vessel("tumbler")
    before = mesh_sha256(first.mesh)
    first.mesh.apply_scale(1000.0)
    dict(first.params).clear()
    assert mesh_sha256(make_vessel("tumbler").mesh) == before


def test_the_library_covers_the_named_categories():
    wanted = "mug cup tumbler wine_glass gooseneck_kettle stovetop_kettle teapot jug pitcher carafe bottle thermos can "
    wanted += "carton bowl measuring_cup saucepan watering_can vase moka_pot"
    assert set(wanted.split()) <= set(CATEGORIES)


def test_unknown_category_lists_the_known_ones():
    with pytest.raises(UserError, match=r"ketle.*did you mean .*kettle") as caught:
        resolve_category("stovetop_ketle")
    assert all(category in str(caught.value) for category in CATEGORIES)
    with pytest.raises(UserError, match="library has mug"):
        make_vessel("spoon")


def test_words_of_users_resolve_to_categories():
    kettles = resolve_category("kettle")
    assert kettles[0] == "gooseneck_kettle"
    assert {"stovetop_kettle", "electric_kettle"} <= set(kettles)
    assert resolve_category("Wine Glass") == ("wine_glass",)
    assert resolve_category("coffee mug") == ("mug",)
    assert resolve_category("moka-pot") == ("moka_pot",)
    for category in CATEGORIES:
        assert resolve_category(category) == (category,)


@pytest.mark.parametrize("value", [0.5, -1.0, float("nan"), float("inf")])
def test_parameter_out_of_range_names_the_range(value):
    with pytest.raises(UserError, match=r"height_m=.* of mug is out of range; give 0.07 to 0.13 m"):
        make_vessel("mug", height_m=value)


def test_unknown_parameter_lists_the_known_ones():
    with pytest.raises(UserError, match=r"mug has no parameter 'heigth_m'; it has height_m"):
        make_vessel("mug", heigth_m=0.1)


@given(
    radius=st.floats(0.01, 0.1),
    height=st.floats(0.01, 0.3),
    aspect=st.floats(0.4, 1.0),
    corner=st.floats(0.05, 1.0),
)
def test_profile_volume_is_that_of_the_rounded_prism(radius, height, aspect, corner):
    profile = Profile(np.array([0.0, height]), np.full(2, radius), np.full(2, corner), aspect)
    area = 4 * radius * radius * aspect - (4 - np.pi) * (corner * radius * aspect) ** 2
    assert profile.volume_m3 == pytest.approx(area * height)
    assert profile.volume_below_m3(0.25 * height) == pytest.approx(0.25 * area * height)
    polygon = stacked_rings(profile.outlines(256)).solid.volume()
    assert polygon == pytest.approx(profile.volume_m3, rel=2e-3)


def test_profile_volume_of_a_cone_frustum():
    profile = Profile(np.array([0.0, 0.3]), np.array([0.1, 0.05]), np.ones(2))
    assert profile.volume_m3 == pytest.approx(np.pi * 0.3 / 3 * (0.1**2 + 0.1 * 0.05 + 0.05**2))
    assert Section().kind == "round"
    assert Section(1.0, 0.2).kind == "rounded_rectangle"
    assert Section(0.5, 0.2).outline(0.04).max(axis=0) == pytest.approx([0.04, 0.02], rel=0.01)


def test_library_table_has_a_row_per_category():
    rows = library_table()
    assert [row["category"] for row in rows] == list(CATEGORIES)
    assert all(row["interior_volume_ml"] > 50 and row["faces"] > 500 for row in rows)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".ply"])
def test_exported_vessel_reads_back_in_the_same_frame(tmp_path, suffix):
    vessel = make_vessel("gooseneck_kettle", 2)
    path = tmp_path / f"kettle{suffix}"
    export_vessel(vessel, path)
    mesh = load_mesh(path, "m", max_faces=None)
    np.testing.assert_allclose(mesh.bounds, vessel.mesh.bounds, atol=1e-6)
    assert mesh.volume == pytest.approx(vessel.mesh.volume, rel=1e-3)
    if suffix != ".stl":
        colors = np.unique(mesh.visual.vertex_colors[:, :3], axis=0)
        body = np.round(255 * np.asarray(vessel.color_rgba[:3]))
        assert np.abs(colors - body).max(axis=1).min() <= 2
        assert len(colors) >= 2
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_export_to_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"suffix '.fbx'"):
        export_vessel(make_vessel("mug"), tmp_path / "mug.fbx")


def test_contact_sheet_shows_every_vessel(tmp_path):
    from PIL import Image

    path = tmp_path / "sheet.png"
    contact_sheet(path, categories=("mug", "teapot"), seeds=(None, 1), columns=2, cell_px=96)
    image = np.asarray(Image.open(path))
    assert image.shape == (192, 192, 3)
    for x in (0, 96):
        for y in (0, 96):
            assert image[y + 20 : y + 96, x : x + 96].std() > 10


@pytest.mark.parametrize("category", CATEGORIES)
def test_outline_mesh_has_the_silhouette_of_the_vessel(category: str) -> None:
    vessel = make_vessel(category, seed=7)
    camera = focal_prior_camera_matrix(320, 240)
    meshes = [(np.asarray(vessel.mesh.vertices, float), np.asarray(vessel.mesh.faces, np.int32))]
    meshes.append(outline_mesh(category, vessel.params))
    for elevation, yaw, roll in ((20, 30, 0), (45, 140, 0), (10, -70, 90)):
        T = make_pose(upright_rotation(elevation, yaw, roll), (0.0, 0.0, 0.8))
        a, b = (render_depth(v, f, T, camera).mask_in_image(320, 240) for v, f in meshes)
        assert np.count_nonzero(a & b) / np.count_nonzero(a | b) > 0.995
        vertices, faces = meshes[1]
        whole = render_depth(vertices, faces, T, camera)
        front = render_depth(vertices, faces, T, camera, closed=True)
        assert np.array_equal(whole.mask, front.mask)


def test_what_is_remembered_is_told_apart_by_the_values_of_all_arguments() -> None:
    calls = []

    @remembered
    def scaled(points: np.ndarray, by: float = 1.0) -> np.ndarray:
        calls.append(by)
        return points * by

    points = np.arange(6.0)
    first = scaled(points.reshape(2, 3), by=2.0)
    assert scaled(points.reshape(2, 3).copy(), by=2.0) is first
    assert len(calls) == 1
    for other, by in ((points.reshape(3, 2), 2.0), (points.reshape(2, 3), 3.0), (points.reshape(2, 3) + 1e-12, 2.0)):
        assert np.array_equal(scaled(other, by=by), other * by)
    points[:] = 7.0
    assert np.array_equal(scaled(points, by=2.0), points * 2)
    assert len(calls) == 5
