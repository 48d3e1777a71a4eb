from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import invert_pose, project, rotation_angle_rad, transform_points
from vid2demo.extract.synthetic import SyntheticClip, synthesize
from vid2demo.extract.synthetic_camera import CameraPath, move_camera
from vid2demo.extract.synthetic_hand import grips
from vid2demo.extract.synthetic_motion import PourPath, PourShape, minimum_jerk, place_camera, plan_pour
from vid2demo.extract.synthetic_scene import HAND, OBJECT, Scene
from vid2demo.extract.synthetic_textures import TABLE_KINDS, WALL_KINDS, table_texture, wall_texture
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import CATEGORIES, Vessel, make_vessel
from vid2demo.extract.video import iterate_frames, read_video_info

SMALL = {"seconds": 0.4, "fps": 25.0, "size": (160, 120)}


def shape_of(vessel: Vessel, receptacle: Vessel) -> PourShape:
    return PourShape(
        points_m=np.asarray(vessel.mesh.vertices),
        outlet_m=np.asarray(vessel.outlet.point_m),
        outlet_kind=vessel.outlet.kind,
        receptacle_points_m=np.asarray(receptacle.mesh.vertices),
        rim_radius_m=float(receptacle.interior.radius_m[-1]),
    )


def planned(category: str, seed: int) -> tuple[Vessel, Vessel, PourShape, PourPath]:
    vessel, receptacle = make_vessel(category, seed), make_vessel("mug", seed + 1)
    shape = shape_of(vessel, receptacle)
    return vessel, receptacle, shape, plan_pour(np.random.default_rng(seed), shape, 6.0, 25.0)


def silhouette(
    vessel: Vessel, T_camera_object: np.ndarray, camera_matrix: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Filled projection of every face, drawn independently of MuJoCo; a pixel counts when its centre is covered."""
    fine = 4
    pixels = project(camera_matrix, transform_points(T_camera_object, np.asarray(vessel.mesh.vertices)))
    # A pixel of the picture is `fine` pixels wide here, and centres are at integers in both.
    corners = np.rint(((pixels + 0.5) * fine - 0.5) * 16).astype(np.int32)[np.asarray(vessel.mesh.faces)]
    image = np.zeros((size[1] * fine, size[0] * fine), np.uint8)
    for triangle in corners:
        cv2.fillConvexPoly(image, triangle, 1, shift=4)
    cover = image.reshape(size[1], fine, size[0], fine).mean(axis=(1, 3))
    return cover >= 0.5


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> SyntheticClip:
    return synthesize("mug", 3, tmp_path_factory.mktemp("clip"), receptacle="mug", **SMALL)


@pytest.mark.parametrize(
    ("category", "seed", "kind"), [("mug", 0, "still"), ("gooseneck_kettle", 1, "still"), ("mug", 2, "walk")]
)
def test_projected_truth_coincides_with_the_render(category: str, seed: int, kind: CameraPath) -> None:
    vessel, receptacle, shape, path = planned(category, seed)
    rng = np.random.default_rng(seed)
    size = (640, 480)
    camera, T_world_camera = move_camera(rng, place_camera(rng, path, shape, size)[0], path, shape, size, kind)
    T_camera_object = invert_pose(T_world_camera) @ path.T_world_object
    with Scene(rng, vessel, receptacle, path, camera, size, None, T_world_camera) as scene:
        for k in (0, 90):
            rendered = scene.labels(k, only=OBJECT) == OBJECT
            drawn = silhouette(vessel, T_camera_object[k], camera.camera_matrix, size)
            assert np.sum(rendered & drawn) / np.sum(rendered | drawn) > 0.97
            centers = [np.argwhere(mask).mean(axis=0) for mask in (rendered, drawn)]
            assert np.linalg.norm(centers[0] - centers[1]) < 0.15  # half a pixel of shift would show
            # No outline is further than one pixel from the other.
            band = np.ones((3, 3), np.uint8)
            assert not np.any(rendered & ~cv2.dilate(drawn.astype(np.uint8), band).astype(bool))
            assert not np.any(drawn & ~cv2.dilate(rendered.astype(np.uint8), band).astype(bool))


def test_files_agree_with_each_other(clip: SyntheticClip) -> None:
    info = read_video_info(clip.video)
    truth, receptacle = ObjectTrack.load(clip.truth_path), ObjectTrack.load(clip.receptacle_path)
    settings = json.loads(clip.settings_path.read_text())
    assert (info.width_px, info.height_px) == (160, 120)
    assert info.frame_count == len(truth) == len(receptacle) == 10
    np.testing.assert_allclose(truth.time_s, [frame.time_s for frame in iterate_frames(clip.video)], atol=1e-12)
    np.testing.assert_allclose(np.diff(truth.time_s), 0.04, atol=1e-6)
    np.testing.assert_array_equal(truth.camera_matrix[:2, 2], [79.5, 59.5])
    assert truth.camera_matrix[0, 0] == truth.camera_matrix[1, 1]
    assert truth.name == "mug"
    assert receptacle.name == "receptacle"  # two vessels of one category keep different names
    assert truth.header["video"]["sha256"] == info.sha256 == settings["video_sha256"]
    assert settings["seed"] == 3
    assert np.ptp(receptacle.T_camera_object, axis=0).max() == 0
    np.testing.assert_array_equal(truth.confidence, 1)
    assert {p.name for p in clip.video.parent.iterdir()} == {
        "video.mp4",
        "truth.track.npz",
        "receptacle.track.npz",
        "settings.json",
    }


def test_the_header_rebuilds_the_vessel(clip: SyntheticClip) -> None:
    mesh = ObjectTrack.load(clip.truth_path).header["mesh"]
    vessel = make_vessel(mesh["library"]["category"], **mesh["library"]["params"])
    np.testing.assert_allclose(vessel.mesh.extents, mesh["extents_m"], atol=1e-9)


def test_first_frame_boxes_enclose_the_projection(clip: SyntheticClip) -> None:
    for role, track in (("object", clip.truth), ("receptacle", clip.receptacle)):
        library = track.header["mesh"]["library"]
        vessel = make_vessel(library["category"], **library["params"])
        pixels = project(
            track.camera_matrix, transform_points(track.T_camera_object[0], np.asarray(vessel.mesh.vertices))
        )
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        x, y, width, height = clip.boxes_xywh_px[role]
        # The hand may hide a part, so the visible box is inside the projected one.
        assert x >= low[0] - 1
        assert y >= low[1] - 1
        assert x + width <= high[0] + 1
        assert y + height <= high[1] + 1


def test_one_seed_one_clip(clip: SyntheticClip, tmp_path: Path) -> None:
    again = synthesize("mug", 3, tmp_path / "again", receptacle="mug", **SMALL)
    np.testing.assert_array_equal(again.truth.T_camera_object, clip.truth.T_camera_object)
    assert again.video.read_bytes() == clip.video.read_bytes()
    assert again.settings == clip.settings
    other = synthesize("mug", 4, tmp_path / "other", receptacle="mug", **SMALL)
    assert np.abs(other.truth.T_camera_object - clip.truth.T_camera_object).max() > 0.01


@pytest.mark.parametrize("category", ["mug", "gooseneck_kettle"])
@pytest.mark.parametrize("seed", range(4))
def test_the_motion_is_a_pour(category: str, seed: int) -> None:
    vessel, receptacle, shape, path = planned(category, seed)
    T = path.T_world_object
    tilt_deg = np.rad2deg(np.arccos(np.clip(T[:, 2, 2], -1, 1)))
    resting = path.time_s <= path.rest_s
    assert np.ptp(T[resting], axis=0).max() == 0
    assert tilt_deg[0] < 1e-6
    assert 65 < tilt_deg.max() < 120
    assert 20 < tilt_deg[-1] < tilt_deg.max() - 15  # turned back a bit
    assert np.isclose(transform_points(T[0], shape.points_m)[:, 2].min(), 0, atol=1e-9)
    # At the greatest tilt the outlet points down, over the opening and above the rim of the receptacle.
    fullest = T[np.argmax(tilt_deg)]
    outlet = transform_points(fullest, np.asarray(vessel.outlet.point_m)[None])[0]
    assert np.linalg.norm(outlet[:2]) < receptacle.interior.radius_m[-1]
    assert outlet[2] > np.ptp(receptacle.mesh.vertices[:, 2])
    assert outlet[2] < np.ptp(receptacle.mesh.vertices[:, 2]) + 0.15
    assert (fullest[:3, :3] @ [1.0, 0.0, 0.0])[2] < -0.85
    # Smooth: a hand does not exceed about 3 m/s^2 at this pace, and never jumps.
    acceleration = np.diff(T[:, :3, 3], n=2, axis=0) * 25**2
    assert np.abs(acceleration).max() < 3


@pytest.mark.parametrize("seed", range(3))
def test_the_vessel_passes_through_nothing(seed: int) -> None:
    _, receptacle, shape, path = planned("mug", seed)
    rim = float(np.ptp(receptacle.mesh.vertices[:, 2]))
    reach = float(np.linalg.norm(receptacle.mesh.vertices[:, :2], axis=1).max())
    for T in path.T_world_object:
        world = transform_points(T, shape.points_m)
        assert world[:, 2].min() > -1e-9
        assert not np.any((np.linalg.norm(world[:, :2], axis=1) < reach) & (world[:, 2] < rim))


@pytest.mark.parametrize("seed", range(6))
def test_the_vessel_stays_in_a_fair_sized_picture(seed: int) -> None:
    category = ("mug", "gooseneck_kettle")[seed % 2]
    _, _, shape, path = planned(category, seed)
    camera, share = place_camera(np.random.default_rng(seed), path, shape, (640, 480))
    assert 0.15 < share < 0.36
    assert 15 <= np.rad2deg(camera.elevation_rad) <= 35
    T_camera_object = invert_pose(camera.T_world_camera) @ path.T_world_object
    for T in T_camera_object[::5]:
        pixels = project(camera.camera_matrix, transform_points(T, shape.points_m))
        assert np.all(pixels > 0)
        assert np.all(pixels < [640, 480])


def test_hand_hides_a_part_and_can_be_left_out() -> None:
    vessel, receptacle, shape, path = planned("mug", 2)
    camera, _ = place_camera(np.random.default_rng(2), path, shape, (160, 120))
    grip = grips(np.random.default_rng(2), vessel.grasps)[0]
    with Scene(np.random.default_rng(2), vessel, receptacle, path, camera, (160, 120), grip) as scene:
        assert np.count_nonzero(scene.labels(60) == HAND) > 200
    with Scene(np.random.default_rng(2), vessel, receptacle, path, camera, (160, 120), grip=None) as scene:
        assert not np.any(scene.labels(60) == HAND)


@pytest.mark.parametrize("kind", ["turn", "walk"])
def test_a_moving_camera_keeps_everything_in_view_and_tells_where_it_was(kind: CameraPath) -> None:
    _, _, shape, path = planned("mug", 1)
    size = (640, 480)
    placed, _ = place_camera(np.random.default_rng(1), path, shape, size)
    camera, T = move_camera(np.random.default_rng(0), placed, path, shape, size, kind)
    assert np.array_equal(camera.T_world_camera, T[0])
    for k in range(0, len(T), 10):
        for pose, points in (
            (path.T_world_object[k], shape.points_m),
            (path.T_world_receptacle, shape.receptacle_points_m),
        ):
            pixels = project(camera.camera_matrix, transform_points(invert_pose(T[k]) @ pose, points))
            assert np.all((pixels > 0) & (pixels < size))
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = rotation_angle_rad(T[0, :3, :3], T[:, :3, :3]).max()
    assert step.max() < 0.03
    assert np.deg2rad(4) < turned < np.deg2rad(60)
    assert (step.sum() > 0.25) == (kind == "walk")
    assert step.any() == (kind == "walk")


def test_the_truth_of_a_walk_lets_the_receptacle_rest(tmp_path: Path) -> None:
    clip = synthesize("mug", 3, tmp_path, receptacle="bowl", camera_path="walk", **{**SMALL, "seconds": 0.2})
    track = ObjectTrack.load(clip.receptacle_path)
    assert track.T_first_camera is not None
    assert track.header["camera"]["motion"]["kind"] == "moving"
    assert np.ptp(track.T_first_camera[:, :3, 3], axis=0).max() > 0.05
    assert np.ptp(track.from_first_camera().T_camera_object, axis=0).max() < 1e-9


def test_pictures_are_scenes_and_noise_is_noise(clip: SyntheticClip, tmp_path: Path) -> None:
    frame = next(iter(iterate_frames(clip.video))).rgb.astype(float)
    assert 40 < frame.mean() < 215
    assert frame.std() > 20
    still = synthesize("mug", 3, tmp_path, receptacle="mug", noise=False, **SMALL)
    first, second = (f.rgb.astype(float) for f, _ in zip(iterate_frames(still.video), range(2), strict=False))
    noisy = [f.rgb.astype(float) for f, _ in zip(iterate_frames(clip.video), range(2), strict=False)]
    # The vessel stands still in the first two frames: without noise nothing changes, with noise something does.
    assert np.abs(first - second).mean() < np.abs(noisy[0] - noisy[1]).mean()


@pytest.mark.parametrize("surface", [table_texture, wall_texture])
def test_surface_textures_tile_and_vary(surface: object) -> None:
    kinds = set()
    for seed in range(40):
        kind, image = surface(np.random.default_rng(seed), 128)  # type: ignore[operator]
        kinds.add(kind)
        assert image.shape == (128, 128, 3)
        assert image.dtype == np.uint8
        assert 20 < image.mean() < 250
    assert kinds == set(TABLE_KINDS if surface is table_texture else WALL_KINDS)


def test_minimum_jerk_starts_and_ends_at_rest() -> None:
    tau = np.linspace(-0.2, 1.2, 1401)
    s = minimum_jerk(tau)
    assert s[0] == 0
    assert s[-1] == 1
    assert np.all(np.diff(s) >= 0)
    assert np.abs(np.diff(s, n=2)).max() / 0.001**2 < 6  # peak acceleration of the polynomial is 5.77


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"category": "amphora"}, "unknown vessel category 'amphora'"),
        ({"receptacle": "amphora"}, "unknown vessel category 'amphora'"),
        ({"seconds": 0.0}, "seconds is 0"),
        ({"seconds": 1e6}, "give a length between"),
        ({"fps": 0.0}, "fps is 0"),
        ({"fps": float("nan")}, "fps is nan"),
        ({"seconds": float("nan")}, "seconds is nan"),
        ({"size": (161, 120)}, "size is 161x120"),
        ({"size": (16, 12)}, "between 64 and"),
        ({"camera_path": "fly"}, "camera_path is 'fly'"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(arguments: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words):
        synthesize(**{"category": "mug", "receptacle": "mug", "out": tmp_path / "clip", **arguments})  # type: ignore[arg-type]
    assert not (tmp_path / "clip").exists()


def test_an_interrupted_clip_leaves_no_half_files(tmp_path: Path) -> None:
    def stop(done: int, total: int, text: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize("mug", 0, tmp_path, receptacle="mug", progress=stop, **SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("category", ["cup", "wine_glass", "bowl"])
def test_the_hand_leaves_enough_to_see(category: str, tmp_path: Path) -> None:
    for seed in range(2):
        clip = synthesize(category, seed, tmp_path, seconds=1.0, fps=6.0, size=(160, 120))
        assert clip.visible_fraction.mean() > 0.4
        assert clip.visible_fraction.min() > 0.2
        assert clip.truth.visible.all()


@pytest.mark.slow
@pytest.mark.parametrize("category", CATEGORIES)
def test_every_category_pours(category: str, tmp_path: Path) -> None:
    clip = synthesize(category, 11, tmp_path, seconds=6.0, fps=5.0, size=(160, 120), receptacle="mug")
    assert len(clip.truth) == 30
    assert clip.visible_fraction.min() > 0.2
    assert clip.truth.visible.all()
    assert clip.boxes_xywh_px["object"] is not None
    assert clip.boxes_xywh_px["receptacle"] is not None
