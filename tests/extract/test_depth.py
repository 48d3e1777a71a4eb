"""Depth pictures: how they are read and refused, what they say of a pose and a size, and that tracking listens."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.depth_size import scaled_vessel, size_of_clip
from vid2demo.extract.depth_term import Surface, draw_surface, settle, size_told
from vid2demo.extract.depth_video import DepthVideo, DepthView
from vid2demo.extract.errors import UserError
from vid2demo.extract.first_pose import upright_rotation
from vid2demo.extract.geometry import focal_prior_camera_matrix, make_pose, transform_points
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh
from vid2demo.extract.shape_fit import tracking_mesh
from vid2demo.extract.spin import mirrored
from vid2demo.extract.steps import ObjectSettings, VideoSettings
from vid2demo.extract.synthetic_depth import sensed_depth
from vid2demo.extract.tracker import ObjectTracker
from vid2demo.extract.vessels import make_vessel
from vid2demo.extract.video import VideoInfo, VideoWriter, iterate_frames, read_video_info

WIDTH, HEIGHT, COUNT = 320, 240, 8
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
WALL_M = 0.9
rng = np.random.default_rng(0)
GROUND = cv2.GaussianBlur(rng.normal((90, 120, 150), 40, (HEIGHT, WIDTH, 3)), (0, 0), 2.0)


def wedge() -> trimesh.Trimesh:
    """A block with a slanted top: no symmetry, and no two outlines alike."""
    corners = np.array([[x, y, z] for x in (-0.06, 0.06) for y in (-0.035, 0.035) for z in (-0.05, 0.05)])
    corners[7, 2] = corners[5, 2] = 0.0
    return trimesh.convex.convex_hull(corners).subdivide().subdivide()


MESH = TrackingMesh.build(np.asarray(wedge().vertices, float), np.asarray(wedge().faces, np.int32))


def pose_at(k: float) -> np.ndarray:
    turn = Rotation.from_euler("zxz", [20 + 2.0 * k, 110, 35 + 2 * k], degrees=True)
    return make_pose(turn.as_matrix(), (-0.03 + 0.006 * k, 0.01, 0.5))


RAY = pose_at(0)[:3, 3] / np.linalg.norm(pose_at(0)[:3, 3])
# An outline's information: 10 mrad, 0.3 mm sideways and 3 cm along the line of sight.
WEAK = np.diag([1e4] * 3 + [1e7] * 3)
WEAK[3:, 3:] += np.outer(RAY, RAY) * (1e3 - 1e7)


def depth_at(k: float, mesh: TrackingMesh = MESH, T: np.ndarray | None = None) -> np.ndarray:
    """(H, W) exact depth in m of the object before a wall."""
    window = render_depth(mesh.vertices_m, mesh.faces, pose_at(k) if T is None else T, K)
    assert window is not None
    depth = window.depth_in_image(WIDTH, HEIGHT)
    return np.where(depth > 0, depth, np.float32(WALL_M))


def surface_at(T: np.ndarray) -> Surface:
    surface = draw_surface(MESH, T, K)
    assert surface is not None
    return surface


def settled(start: np.ndarray, view: DepthView, information: np.ndarray = WEAK) -> np.ndarray:
    T = settle(surface_at(start), start, view, information)
    assert T is not None
    return T


def shifted(T: np.ndarray, along_m: float) -> np.ndarray:
    """The pose slid along its line of sight, where an outline sees least."""
    out = T.copy()
    out[:3, 3] *= 1 + along_m / np.linalg.norm(T[:3, 3])
    return out


def metres_of(exact_m: np.ndarray, seed: int) -> np.ndarray:
    """What a depth camera sees of it, in m."""
    return sensed_depth(exact_m, np.random.default_rng(seed)).astype(np.float32) / 1000


def off_mm(T: np.ndarray, truth: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def test_a_drawn_surface_lies_on_the_mesh_and_faces_the_camera() -> None:
    T = pose_at(0)
    surface = surface_at(T)
    _, distance, face = trimesh.proximity.closest_point(wedge(), surface.point_object_m)
    assert distance.max() < 1e-4
    assert len(surface.point_object_m) > 100
    inside = np.abs(np.sum(wedge().face_normals[face] * surface.normal_object, axis=1))
    assert np.mean(inside > 0.99) > 0.8  # the others sit on edges
    seen = transform_points(T, surface.point_object_m)
    assert np.all(np.sum(seen * (surface.normal_object @ T[:3, :3].T), axis=1) < 0)
    assert surface.serves(shifted(T, 0.02))
    assert not surface.serves(pose_at(8))


@pytest.mark.parametrize("along_m", [-0.04, -0.01, 0.01, 0.04])
def test_depth_pulls_a_pose_along_the_axis_to_where_the_object_is(along_m: float) -> None:
    view = DepthView(depth_at(0), K)
    T = settled(shifted(pose_at(0), along_m), view)
    assert off_mm(T, pose_at(0)) < 0.02 * 1e3 * abs(along_m) + 0.5


def test_what_the_outline_is_sure_of_stays() -> None:
    start = pose_at(0)
    start[0, 3] += 0.004
    T = settled(start, DepthView(depth_at(0), K), np.diag([1e12] * 6))
    moved = T[:3, 3] - start[:3, 3]
    assert np.linalg.norm(moved - (moved @ RAY) * RAY) < 1e-4
    assert np.allclose(T[:3, :3], start[:3, :3], atol=1e-4)


def test_noise_holes_and_a_hand_before_the_object_are_endured() -> None:
    truth = pose_at(0)
    metres = metres_of(depth_at(0), 3)
    ys, xs = np.nonzero(depth_at(0) < WALL_M)
    hand = (slice(ys.min(), ys.max()), slice(xs.min(), xs.min() + int(0.4 * np.ptp(xs))))
    metres[hand] -= 0.03
    T = settled(shifted(truth, 0.02), DepthView(metres, K))
    assert off_mm(T, truth) < 2.0


def test_nothing_is_said_without_readings_or_far_from_the_object() -> None:
    start = shifted(pose_at(0), 0.02)
    for metres in (np.zeros((HEIGHT, WIDTH), np.float32), np.full((HEIGHT, WIDTH), 2.0, np.float32)):
        view = DepthView(metres, K)
        assert settle(surface_at(start), start, view, WEAK) is None
        assert size_told(surface_at(start), start, view) is None or metres.any()


def test_a_body_of_revolution_keeps_the_spin_it_had() -> None:
    can = trimesh.creation.cylinder(0.03, 0.12, sections=64).subdivide()
    mesh = TrackingMesh.build(np.asarray(can.vertices, float), np.asarray(can.faces, np.int32))
    truth = pose_at(0)
    metres = metres_of(depth_at(0, mesh, truth), 0)
    surface = draw_surface(mesh, truth, K)
    assert surface is not None
    held = WEAK + np.pad(np.outer(truth[:3, 2], truth[:3, 2]) * 1e6, (0, 3))
    T = settle(surface, truth, DepthView(metres, K), held)
    assert T is not None
    turn = Rotation.from_matrix(truth[:3, :3].T @ T[:3, :3]).as_rotvec()
    assert abs(turn[2]) < np.deg2rad(0.3)


def test_a_pose_that_leans_the_wrong_way_is_put_right_without_a_motion_of_its_own() -> None:
    bottle = make_vessel("bottle")
    mesh = tracking_mesh(bottle)
    truth = make_pose(upright_rotation(-28, 0, 20), (0.0, 0.0, 0.9))
    window = render_depth(mesh.vertices_m, mesh.faces, truth, K)
    assert window is not None
    shown = window.mask_in_image(WIDTH, HEIGHT)
    picture = np.where(shown[..., None], (170, 60, 50), GROUND).clip(0, 255).astype(np.uint8)
    view = DepthView(np.where(shown, window.depth_in_image(WIDTH, HEIGHT), 1.4), K)
    tracker = ObjectTracker(mesh, K, picture, shown, mirrored(truth), bottle.symmetry, exact=False)
    found = tracker.step(picture, depth=view)
    # Nothing there: the pose is where the motion leads, and being put right is no motion.
    lost = tracker.step(GROUND.clip(0, 255).astype(np.uint8))
    assert found.visible
    assert not lost.visible
    for T in (found.T_camera_object, lost.T_camera_object):
        assert np.rad2deg(np.arccos(T[:3, 2] @ truth[:3, 2])) < 8


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_depth_tells_how_large_a_vessel_is(factor: float) -> None:
    true = make_vessel("mug")
    T = make_pose(Rotation.from_euler("x", 110, degrees=True).as_matrix(), (0.02, 0.01, 0.6))
    view = DepthView(metres_of(depth_at(0, tracking_mesh(true), T), 1), K)
    guessed = scaled_vessel(true, 1 / factor)
    # What looks the same is as many times nearer as it is smaller.
    nearer = T.copy()
    nearer[:3, 3] /= factor
    ratio = size_of_clip(tracking_mesh(guessed), [(nearer, view)])
    assert ratio == pytest.approx(factor, rel=0.01)
    assert ratio is not None
    assert scaled_vessel(guessed, ratio).mesh.extents == pytest.approx(true.mesh.extents, rel=0.02)
    assert size_of_clip(tracking_mesh(true), [(T, DepthView(depth_at(0, tracking_mesh(true), T), K))]) is None


# Reading ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    with VideoWriter(path, 25.0, crf=10) as writer:
        for k in range(COUNT):
            noise = np.random.default_rng(1000 + k)
            image = GROUND + noise.normal(0, 3, GROUND.shape)
            inside = depth_at(k) < WALL_M
            image[inside] = noise.normal((190, 70, 50), 6, (int(inside.sum()), 3))
            writer.write(np.clip(image, 0, 255).astype(np.uint8))
    return path


@pytest.fixture(scope="module")
def info(clip: Path) -> VideoInfo:
    return read_video_info(clip)


def write(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir()
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"depth_{k + 5}.png"), picture)  # 5 to 12: names do not sort as numbers do
    return folder


def sensed(count: int = COUNT) -> list[np.ndarray]:
    return [sensed_depth(depth_at(k), np.random.default_rng(k)) for k in range(count)]


def test_pictures_are_taken_in_the_order_of_their_numbers(tmp_path: Path, info: VideoInfo) -> None:
    pictures = sensed()
    opened = DepthVideo.open(write(tmp_path / "depth", pictures), info)
    for k in (0, 5, COUNT - 1):
        view = opened.view(k, K, (WIDTH, HEIGHT))
        assert np.allclose(view.metres, pictures[k] / 1000)
        assert np.array_equal(view.camera_matrix, K)


def test_an_array_says_the_same_as_a_folder_and_is_mapped(tmp_path: Path, info: VideoInfo) -> None:
    folder = DepthVideo.open(write(tmp_path / "depth", sensed()), info)
    np.save(tmp_path / "steps.npy", np.stack(sensed()))
    metres = np.stack(sensed()).astype(np.float32) / 1000
    metres[metres == 0] = np.nan
    np.save(tmp_path / "metres.npy", metres)
    for name, scale_mm in (("steps", 1.0), ("metres", 1000.0)):
        opened = DepthVideo.open(tmp_path / f"{name}.npy", info, scale_mm)
        assert isinstance(opened._stack, np.memmap)
        assert np.allclose(opened.view(2, K, (WIDTH, HEIGHT)).metres, folder.view(2, K, (WIDTH, HEIGHT)).metres)


def test_pictures_of_another_size_show_the_same_view(tmp_path: Path, info: VideoInfo) -> None:
    halves = [picture[::2, ::2] for picture in sensed()]
    view = DepthVideo.open(write(tmp_path / "depth", halves), info).view(0, K, (WIDTH, HEIGHT))
    T = settled(shifted(pose_at(0), 0.02), view)
    assert off_mm(T, pose_at(0)) < 2.5


ZEROS = np.zeros((HEIGHT, WIDTH), np.uint16)


@pytest.mark.parametrize(
    ("pictures", "scale_mm", "words"),
    [
        (sensed(COUNT - 1), 1.0, f"holds {COUNT - 1} pictures, .* {COUNT} frames"),
        ([p.astype(np.uint8) for p in sensed()], 1.0, "1 x 8 bits"),
        ([np.dstack([p, p, p]) for p in sensed()], 1.0, "3 x 16 bits"),
        ([ZEROS] * COUNT, 1.0, "holds no reading"),
        (sensed(), 0.001, "--depth-scale MM"),
        (sensed(), 1000.0, "--depth-scale MM"),
        (sensed(), -1.0, "is no length"),
        ([p[:, : WIDTH // 2] for p in sensed()], 1.0, "160 x 240 px, the video 320 x 240"),
        ([], 1.0, "holds no PNG"),
    ],
)
def test_bad_pictures_are_refused(
    pictures: list[np.ndarray], scale_mm: float, words: str, tmp_path: Path, info: VideoInfo
) -> None:
    with pytest.raises(UserError, match=words):
        DepthVideo.open(write(tmp_path / "depth", pictures), info, scale_mm)


def test_bad_files_are_refused(tmp_path: Path, info: VideoInfo) -> None:
    with pytest.raises(UserError, match="does not exist"):
        DepthVideo.open(tmp_path / "gone", info)
    (tmp_path / "text.npy").write_text("no array")
    with pytest.raises(UserError, match="neither a folder"):
        DepthVideo.open(tmp_path / "text.npy", info)
    np.save(tmp_path / "flat.npy", np.zeros((COUNT, 4)))
    with pytest.raises(UserError, match=r"float64 \(8, 4\)"):
        DepthVideo.open(tmp_path / "flat.npy", info)
    np.savez(tmp_path / "many.npz", a=np.zeros(3))
    with pytest.raises(UserError, match="several arrays"):
        DepthVideo.open(tmp_path / "many.npz", info)
    np.save(tmp_path / "objects.npy", np.array([{}] * COUNT), allow_pickle=True)
    with pytest.raises(UserError, match="neither a folder"):
        DepthVideo.open(tmp_path / "objects.npy", info)
    broken = write(tmp_path / "depth", [*sensed()[:-2], sensed()[0][:10], sensed()[1]])
    opened = DepthVideo.open(broken, info)
    with pytest.raises(UserError, match="320 x 10 px, the first 320 x 240"):
        opened.view(COUNT - 2, K, (WIDTH, HEIGHT))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"depth": Path("depth"), "method": "freepose"}, "reads no depth pictures"),
        ({"depth_scale_mm": 0.1}, "belongs to --depth"),
    ],
)
def test_options_of_depth_that_do_not_go_together_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(UserError, match=words):
        VideoSettings(Path("a.mp4"), ObjectSettings("mug"), **settings)


# Tracking --------------------------------------------------------------------------------------------------------


def tracked(clip: Path, depth: Path | None) -> np.ndarray:
    """(N,) m along the axis, of the wedge followed with a focal length 6 % too long: its outline says 3 cm farther."""
    camera = np.diag([1.06, 1.06, 1.0]) @ K
    camera[:2, 2] = K[:2, 2]
    filmed = None if depth is None else DepthVideo.open(depth, read_video_info(clip))
    start = pose_at(0)
    tracker = None
    found = []
    for frame in iterate_frames(clip):
        tracker = tracker or ObjectTracker(MESH, camera, frame.rgb, depth_at(0) < WALL_M, start)
        view = None if filmed is None else filmed.view(frame.index, camera, (WIDTH, HEIGHT))
        estimate = tracker.step(frame.rgb, None, view)
        assert estimate.visible
        found.append(estimate.T_camera_object[2, 3])
    return np.array(found)


def test_with_depth_an_object_is_as_far_away_as_it_is(clip: Path, tmp_path: Path) -> None:
    depth = write(tmp_path / "depth", sensed())
    cv2.imwrite(str(depth / "depth_8.png"), ZEROS)  # a frame without readings
    off_m = [np.abs(tracked(clip, given) - 0.5) for given in (depth, None)]
    assert off_m[1][-1] > 0.015
    assert off_m[0].max() < 0.006
    assert off_m[0][-1] < 0.25 * off_m[1][-1]
