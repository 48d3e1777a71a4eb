"""Textured points tell what the outline cannot, and are not believed where they contradict it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import Symmetry, focal_prior_camera_matrix, make_pose, rotation_angle_rad
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh
from vid2demo.extract.spin import spun
from vid2demo.extract.surface_flow import CarriedPoints, SurfaceFlow, spin_by_flow
from vid2demo.extract.texture import Texture, flattened
from vid2demo.extract.tracker import ObjectTracker, Signs

WIDTH, HEIGHT = 320, 240
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
RADIUS_M, HALF_M = 0.045, 0.07


@pytest.fixture(scope="module")
def can() -> TrackingMesh:
    """A cylinder about +z: its outline never tells how it is turned."""
    turns = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = np.stack([RADIUS_M * np.cos(turns), RADIUS_M * np.sin(turns)], axis=1)
    rows = [np.column_stack([ring, np.full(48, z)]) for z in np.linspace(-HALF_M, HALF_M, 8)]
    vertices = np.vstack([*rows, [[0, 0, -HALF_M], [0, 0, HALF_M]]])
    faces = []
    for row in range(7):
        for k in range(48):
            a, b = 48 * row + k, 48 * row + (k + 1) % 48
            faces += [[a, b, a + 48], [b, b + 48, a + 48]]
    for k in range(48):
        faces += [[k, (k + 1) % 48, 384], [336 + k, 336 + (k + 1) % 48, 385]]
    return TrackingMesh.build(vertices, np.array(faces, np.int32))


def label(seed: int = 3) -> np.ndarray:
    """A printed label, (height, circumference)."""
    blotches = np.random.default_rng(seed).normal(0, 1, (60, 120))
    return 60 * np.sign(cv2.GaussianBlur(np.tile(blotches, (1, 3)), (0, 0), 2.0)[:, 120:240])


def picture(can: TrackingMesh, T: np.ndarray, seed: int, printed: np.ndarray | None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = rng.normal((70, 110, 160), 4, (HEIGHT, WIDTH, 3))
    window = render_depth(can.vertices_m, can.faces, T, K)
    assert window is not None
    j, i = np.nonzero(window.depth_m)
    z, x, y = window.depth_m[j, i].astype(float), i + window.x0_px, j + window.y0_px
    points = np.column_stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z])
    at = (points - T[:3, 3]) @ T[:3, :3]
    colour = rng.normal((170, 110, 70), 4, (len(z), 3))
    if printed is not None:
        u = (np.arctan2(at[:, 1], at[:, 0]) / (2 * np.pi) * 120).astype(int) % 120
        v = np.clip((at[:, 2] / (2 * HALF_M) + 0.5) * 60, 0, 59).astype(int)
        colour += printed[v, u][:, None]
    keep = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    image[y[keep], x[keep]] = colour[keep]
    return np.clip(image, 0, 255).astype(np.uint8)


def pose(spin_deg: float, lean_deg: float = 0.0, x_m: float = 0.0) -> np.ndarray:
    turn = Rotation.from_euler("z", lean_deg, degrees=True) * Rotation.from_euler("x", 110, degrees=True)
    return make_pose((turn * Rotation.from_euler("z", spin_deg, degrees=True)).as_matrix(), (x_m, 0.01, 0.45))


def tracker_at(can: TrackingMesh, T: np.ndarray, printed: np.ndarray | None) -> ObjectTracker:
    window = render_depth(can.vertices_m, can.faces, T, K)
    assert window is not None
    mask = window.mask_in_image(WIDTH, HEIGHT)
    return ObjectTracker(can, K, picture(can, T, 0, printed), mask, T, Symmetry(order=0))


def test_matches_lie_where_the_mesh_s_points_went(can: TrackingMesh) -> None:
    texture, printed = Texture(can), label()
    texture.keep(flattened(picture(can, pose(0), 0, printed)), K, pose(0))
    T = pose(6.0, 4.0, 0.006)
    found = texture.match(flattened(picture(can, T, 1, printed)), K, pose(3.0, 1.0, 0.002))
    assert len(found) > 25
    assert found.rigid_share > 0.7
    assert np.median(found.points.errors_px(T, K)) < 0.7
    assert found.T_camera_object is not None
    assert np.rad2deg(rotation_angle_rad(found.T_camera_object[:3, :3], T[:3, :3])) < 2


def test_a_spin_that_only_the_label_shows_is_followed(can: TrackingMesh) -> None:
    printed = label()
    tracker = tracker_at(can, pose(0), printed)
    for k in range(1, 31):
        T = pose(2.0 * k, 0.3 * k, 0.0005 * k)
        estimate = tracker.step(picture(can, T, k, printed))
    assert np.rad2deg(rotation_angle_rad(estimate.T_camera_object[:3, :3], T[:3, :3])) < 5
    assert tracker.spin_source(30) == "texture"


def seen_twice(can: TrackingMesh, exact: bool, before_deg: float) -> Texture:
    """Texture with a key view at no spin, and then a frame at another that is none."""
    texture = Texture(can, exact)
    texture.keep(flattened(picture(can, pose(0), 0, label())), K, pose(0))
    texture.keep(flattened(picture(can, pose(before_deg), 0, label())), K, pose(before_deg), key=False)
    return texture


def test_the_frame_before_helps_where_no_key_view_shows_that_side(can: TrackingMesh) -> None:
    frame = flattened(picture(can, pose(42.0), 1, label()))
    found = {exact: seen_twice(can, exact, 40.0).match(frame, K, pose(40.0)) for exact in (True, False)}
    assert len(found[True]) == 0
    assert len(found[False]) > 25
    # What moves as the frame before does not tell that the pose is right.
    assert not found[False].keyed.any()


def test_views_turned_away_count_less_when_the_mesh_is_only_like_the_object(can: TrackingMesh) -> None:
    frame = flattened(picture(can, pose(15.0), 1, label()))
    weights = {}
    for exact in (True, False):
        found = seen_twice(can, exact, 13.0).match(frame, K, pose(15.0))
        assert found.keyed.any()
        weights[exact] = found.points.weight[found.keyed].mean()
        if not exact:
            assert not found.keyed.all()
            assert found.points.weight[~found.keyed].mean() > weights[exact]
    assert weights[False] < 0.5 * weights[True]


def test_nothing_is_matched_where_a_frame_does_not_show_the_object(can: TrackingMesh) -> None:
    texture, printed = Texture(can), label()
    left = np.zeros((HEIGHT, WIDTH), bool)
    left[:, : WIDTH // 2] = True
    texture.keep(flattened(picture(can, pose(0), 0, printed)), K, pose(0), left)
    found = texture.match(flattened(picture(can, pose(0), 1, printed)), K, pose(0))
    assert len(found) > 12
    assert found.points.pixel[:, 0].max() < WIDTH // 2 + 2


@pytest.mark.parametrize(("x_m", "shows"), [(-0.4, False), (-0.15, True), (0.15, True), (0.4, False)])
def test_an_object_at_the_border_is_matched_where_it_shows(can: TrackingMesh, x_m: float, shows: bool) -> None:
    texture, printed = Texture(can), label()
    texture.keep(flattened(picture(can, pose(0, x_m=0.98 * x_m), 0, printed)), K, pose(0, x_m=0.98 * x_m))
    found = texture.match(flattened(picture(can, pose(0, x_m=x_m), 1, printed)), K, pose(0, x_m=0.99 * x_m))
    assert (len(found) > 12) == shows
    if shows:
        assert found.points.errors_px(pose(0, x_m=x_m), K).max() < 3


def test_a_spin_that_nothing_shows_is_not_invented(can: TrackingMesh) -> None:
    tracker = tracker_at(can, pose(0), None)
    for k in range(1, 21):
        estimate = tracker.step(picture(can, pose(0, 0.5 * k, 0.0005 * k), k, None))
    turned, leant = estimate.T_camera_object[:3, :3], pose(0, 10.0)[:3, :3]
    assert np.rad2deg(np.arccos(turned[:, 2] @ leant[:, 2])) < 3
    # The shortest turn that takes the axis there, and no more.
    assert np.rad2deg(rotation_angle_rad(turned, pose(0)[:3, :3])) < 11
    assert tracker.spin_source(20) == "none"


def test_sensor_noise_gives_no_matches(can: TrackingMesh) -> None:
    texture = Texture(can)
    texture.keep(flattened(picture(can, pose(0), 0, None)), K, pose(0))
    assert len(texture.match(flattened(picture(can, pose(0), 1, None)), K, pose(0))) == 0


def test_what_is_not_rigid_or_contradicts_the_outline_loses_trust(can: TrackingMesh) -> None:
    texture = Texture(can)
    texture.keep(flattened(picture(can, pose(0), 0, label())), K, pose(0))
    found = texture.match(flattened(picture(can, pose(0), 1, label())), K, pose(0))
    for _ in range(30):
        texture.judge(found, 0.0)
    trusted = texture.trust
    for _ in range(30):
        texture.judge(replace(found, rigid_share=0.4), 0.0)
    assert trusted > 0.8
    assert texture.trust < 0.1
    for _ in range(30):
        texture.judge(replace(found, rigid_share=0.8), 2.0)
    assert texture.trust < 0.1


def test_confidence_rises_with_every_sign_and_says_little_of_nothing() -> None:
    base = Signs(0.5, 0.5, 0.2)
    better = [Signs(0.8, 0.5, 0.2), Signs(0.5, 0.8, 0.2), Signs(0.5, 0.5, 0.6)]
    assert all(s.confidence > base.confidence for s in better)
    assert Signs(0.0, 0.1, 0.0).confidence < 0.1
    assert Signs(0.95, 0.9, 0.9).confidence > 0.95


def flow_through(can: TrackingMesh, poses: list[np.ndarray], printed: np.ndarray | None) -> SurfaceFlow | None:
    """The flow from the first picture of a can to the last; sensor noise is drawn anew in each."""
    greys = [cv2.cvtColor(picture(can, T, k, printed), cv2.COLOR_RGB2GRAY) for k, T in enumerate(poses)]
    inside = np.abs(np.arange(greys[0].shape[1]) - greys[0].shape[1] / 2) < 25
    points = CarriedPoints(greys[0], np.broadcast_to(inside, greys[0].shape))
    for grey in greys[1:]:
        points.step(grey)
    return points.flow()


@pytest.mark.parametrize("step_deg", [-4.0, 0.0, 3.0])
def test_a_printed_can_tells_by_how_much_it_spun_more_than_its_poses_say(can: TrackingMesh, step_deg: float) -> None:
    true = [pose(step_deg * k, lean_deg=2.0 * k, x_m=0.002 * k) for k in range(6)]
    flow = flow_through(can, true, label())
    assert flow is not None
    assert flow.frames == 5
    for missed_deg in (-9.0, 0.0, 14.0):
        said = spun(true[-1], np.deg2rad(-missed_deg))
        spin, share = spin_by_flow(can, true[0], said, K, flow)
        assert spin == pytest.approx(np.deg2rad(missed_deg), abs=np.deg2rad(1.5))
        assert 0.7 < share <= 1.0


def test_a_flow_backward_in_time_tells_the_opposite(can: TrackingMesh) -> None:
    true = [pose(4.0 * k) for k in range(4)]
    there, back = flow_through(can, true, label()), flow_through(can, true[::-1], label())
    assert there is not None
    assert back is not None
    forward, _ = spin_by_flow(can, true[0], true[0], K, there)
    backward, _ = spin_by_flow(can, true[-1], true[-1], K, back)
    assert forward == pytest.approx(np.deg2rad(12.0), abs=np.deg2rad(1.5))
    assert backward == pytest.approx(-np.deg2rad(12.0), abs=np.deg2rad(1.5))


def test_a_mesh_that_is_only_like_the_can_tells_it_as_well(can: TrackingMesh) -> None:
    true = [pose(3.0 * k) for k in range(5)]
    flow = flow_through(can, true, label())
    slim = TrackingMesh.build(can.vertices_m * [0.92, 0.92, 1.05], can.faces)
    assert flow is not None
    assert spin_by_flow(slim, true[0], true[0], K, flow)[0] == pytest.approx(np.deg2rad(12.0), abs=np.deg2rad(2.5))


def test_a_plain_can_tells_nothing(can: TrackingMesh) -> None:
    assert flow_through(can, [pose(4.0 * k) for k in range(6)], None) is None


def test_points_that_move_at_random_tell_nothing(can: TrackingMesh) -> None:
    flow = flow_through(can, [pose(0.0)] * 3, label())
    assert flow is not None
    astray = flow.after_px + np.random.default_rng(0).normal(0, 12, flow.after_px.shape)
    assert spin_by_flow(can, pose(0.0), pose(0.0), K, SurfaceFlow(2, flow.before_px, astray)) == (0.0, 0.0)


def test_poses_that_lean_otherwise_than_the_can_are_believed_less(can: TrackingMesh) -> None:
    true = [pose(0.0, lean_deg=9.0 * k) for k in range(4)]
    flow = flow_through(can, true, label())
    assert flow is not None
    upright = pose(0.0)
    assert spin_by_flow(can, true[0], true[-1], K, flow)[1] > spin_by_flow(can, upright, upright, K, flow)[1] + 0.2
