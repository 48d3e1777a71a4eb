"""A moving camera from exact, noisy and wrong corners of a still room; its scale from things that rest in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.extract.bundle import Bundle, Sightings, adjusted, in_cameras, misses, pose_adjusted
from vid2demo.extract.camera_motion import CameraWatch, Sighting
from vid2demo.extract.camera_of_tracks import with_camera
from vid2demo.extract.camera_path import CameraPath, camera_path
from vid2demo.extract.camera_scale import path_scale
from vid2demo.extract.compare import Comparison, compare_tracks, load_truth
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Symmetry, invert_pose, look_at, make_pose, project, rotation_angle_rad
from vid2demo.extract.overlay import where_it_was
from vid2demo.extract.track import ObjectTrack

K = np.array([[620.0, 0, 319.5], [0, 620.0, 239.5], [0, 0, 1]])
UP = np.array([0.0, 0, 1])
COUNT = 90
PX = 1 / K[0, 0]


def camera_poses(kind: str) -> np.ndarray:
    """T_world_camera (COUNT, 4, 4): carried 35 degrees around the table, or turned in place, with unsteady hands."""
    poses = []
    for u in np.linspace(0, 1, COUNT):
        angle = np.deg2rad(35) * (u - 0.5)
        eye = np.array([0.8 * np.sin(angle), -0.8 * np.cos(angle), 0.45 + 0.01 * np.sin(9 * u)])
        target = np.array([0.01 * np.sin(11 * u), 0.01 * np.cos(7 * u), 0.05])
        if kind == "turn":
            eye, target = np.array([0.0, -0.8, 0.45]), np.array([0.3 * np.sin(3 * u), 0.0, 0.05 + 0.1 * u])
        poses.append(look_at(eye, target, UP))
    return np.stack(poses)


def corners_of(
    kind: str, T_world_camera: np.ndarray, *, noise_px: float = 0.2, wrong: float = 0.1
) -> list[Sighting | None]:
    """Corners on a table and, unless only that is there, a wall: some slide over it, all come and go."""
    rng, n = np.random.default_rng(4), 500
    places = np.column_stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.8, 1.0, n), np.zeros(n)])
    if kind != "table":
        places[: n // 2] = np.column_stack([rng.uniform([-1.2, 0.7, 0.0], [1.2, 0.9, 1.0], (n // 2, 3))])
    slides, speed = rng.uniform(size=n) < wrong, rng.normal(0, 1, (n, 2))
    born, life = rng.integers(-60, COUNT, n), rng.integers(40, 140, n)
    seen: list[Sighting | None] = []
    for k, T in enumerate(T_world_camera):
        inside = (places - T[:3, 3]) @ T[:3, :3]
        pixels = project(K, inside) + rng.normal(0, noise_px, (n, 2)) + slides[:, None] * speed * k
        there = (inside[:, 2] > 0.1) & np.all((pixels > 0) & (pixels < [640, 480]), axis=1)
        ids = np.flatnonzero(there & (born <= k) & (k < born + life))
        view = k % 6 == 0
        ids = ids if view else ids[:: len(ids) // 60 + 1]
        seen.append(Sighting(ids.astype(np.int32), pixels[ids].astype(np.float32), view))
    return seen


def path_of(kind: str, **changes: float) -> tuple[CameraPath | None, np.ndarray]:
    T = camera_poses(kind)
    return camera_path(corners_of(kind, T, **changes), K), invert_pose(T[0]) @ T


def errors(path: CameraPath, truth: np.ndarray) -> tuple[float, float]:
    """Largest distance from the true path after the best scale, as a share of its length, and largest angle in deg."""
    found, true = path.T_first_camera[:, :3, 3], truth[:, :3, 3]
    scale = np.sum(found * true) / np.sum(found**2)
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    angle = rotation_angle_rad(path.T_first_camera[:, :3, :3], truth[:, :3, :3])
    return float(np.linalg.norm(scale * found - true, axis=1).max() / length), float(np.rad2deg(angle.max()))


@pytest.fixture(scope="module")
def walked() -> tuple[CameraPath, np.ndarray]:
    path, truth = path_of("walk")
    assert path is not None
    return path, truth


def test_exact_corners_give_the_exact_path() -> None:
    path, truth = path_of("walk", noise_px=0.0, wrong=0.0)
    assert path is not None
    assert errors(path, truth) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert path.error_px < 1e-2


def test_noise_and_sliding_corners_are_borne(walked: tuple[CameraPath, np.ndarray]) -> None:
    path, truth = walked
    off, angle_deg = errors(path, truth)
    assert off < 0.02
    assert angle_deg < 0.4
    assert path.quality.min() > 0.7
    assert path.parallax_deg > 4
    assert path.T_first_camera[0] == pytest.approx(np.eye(4), abs=1e-9)


def test_a_flat_background_is_enough() -> None:
    """Two views of a plane leave two answers open; the others decide."""
    path, truth = path_of("table")
    assert path is not None
    off, angle_deg = errors(path, truth)
    assert off < 0.03
    assert angle_deg < 0.5


def test_a_camera_that_turns_in_place_has_no_path() -> None:
    assert path_of("turn")[0] is None


def test_nothing_to_see_has_no_path() -> None:
    nothing = Sighting(np.zeros(0, np.int32), np.zeros((0, 2), np.float32), True)
    assert camera_path([], K) is None
    assert camera_path([None] * 10, K) is None
    assert camera_path([nothing, None, replace(nothing), replace(nothing)], K) is None


def test_frames_without_corners_are_put_between_their_neighbours(walked: tuple[CameraPath, np.ndarray]) -> None:
    T = camera_poses("walk")
    seen = corners_of("walk", T)
    seen[40:44] = [None] * 4
    path = camera_path(seen, K)
    assert path is not None
    assert np.flatnonzero(path.quality == 0).tolist() == [40, 41, 42, 43]
    assert errors(path, walked[1])[0] < 0.02


def test_adjustment_brings_a_shaken_scene_back() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform([-0.5, -0.5, 1.5], [0.5, 0.5, 3.0], (40, 3))
    turns = Rotation.from_rotvec(0.05 * rng.normal(size=(5, 3)))
    true = Bundle(turns.as_matrix(), 0.2 * rng.normal(size=(5, 3)), places)
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(5), np.arange(40), indexing="ij"))
    seen = Sightings(view, point, np.zeros((200, 2)))
    seen = replace(seen, at=misses(in_cameras(true, seen), seen.at))
    shaken = Bundle(
        np.concatenate([true.R[:1], (Rotation.from_rotvec(0.03 * rng.normal(size=(4, 3))) * turns[1:]).as_matrix()]),
        true.t + [[0.0]] + 0.03 * rng.normal(size=(5, 3)) * (np.arange(5) > 0)[:, None],
        places + 0.05 * rng.normal(size=places.shape),
    )
    before = np.abs(misses(in_cameras(shaken, seen), seen.at)).max()
    done = adjusted(shaken, seen, PX, rounds=60)
    assert before > 20 * PX
    assert np.abs(misses(in_cameras(done, seen), seen.at)).max() < 0.05 * PX
    np.testing.assert_array_equal(done.R[0], true.R[0])
    # One view against known places, of which a third are not where they are said to be.
    at = seen.at[view == 2].copy()
    at[::3] += 0.1
    R, t = pose_adjusted(places, at, true.R[1], true.t[1], PX)
    assert rotation_angle_rad(R, true.R[2]) < 1e-3
    assert t == pytest.approx(true.t[2], abs=2e-3)


def track_of(T_first_object: np.ndarray, truth: np.ndarray, seed: int, order: int = 0) -> ObjectTrack:
    """What a tracker says of an object: unsure mostly along the line of sight, and for a third of a second alike."""
    rng = np.random.default_rng(seed)
    T = invert_pose(truth) @ T_first_object
    slow = np.convolve(rng.normal(size=COUNT + 40), np.ones(8) / np.sqrt(8), "same")[20:-20]
    distance = T[:, 2, 3].copy()
    T[:, :3, 3] *= 1 + 0.01 * slow[:, None]
    T[:, :3, 3] += distance[:, None] * rng.normal(0, 0.002, (COUNT, 3))
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.02, (COUNT, 3))).as_matrix()
    header = {"mesh": {"symmetry": Symmetry(order=order).to_json()}, "camera": {"source": "given"}}
    return ObjectTrack(T, np.arange(COUNT) / 25, K, np.full(COUNT, 0.9), np.ones(COUNT, bool), header)


def bowl(truth: np.ndarray) -> ObjectTrack:
    at = invert_pose(camera_poses("walk")[0]) @ make_pose(t=(0.1, 0.0, 0.03))
    return track_of(np.tile(at, (COUNT, 1, 1)), truth, 1)


def kettle(truth: np.ndarray, lifted: float, set_down: float) -> ObjectTrack:
    """Carried and tilted between two shares of the clip."""
    u = np.clip((np.linspace(0, 1, COUNT) - lifted) / (set_down - lifted), 0, 1)
    path = [
        make_pose(
            Rotation.from_rotvec([6 * x * (1 - x), 0, 0]).as_matrix(), (-0.1 + 0.25 * x, 0.1 * x, 0.05 + x * (1 - x))
        )
        for x in u * u * (3 - 2 * u)
    ]
    return track_of(invert_pose(camera_poses("walk")[0]) @ np.stack(path), truth, 2, order=1)


def test_what_rests_tells_the_scale(walked: tuple[CameraPath, np.ndarray]) -> None:
    truth = walked[1]
    in_units = truth.copy()
    in_units[:, :3, 3] /= 1.5
    for tracks, within in (
        ([bowl(truth)], 0.03),
        ([kettle(truth, 0.05, 0.95), bowl(truth)], 0.03),
        ([kettle(truth, 0.4, 0.8)], 0.12),
    ):
        scale = path_scale(tracks, in_units)
        assert scale.why_not == ""
        assert scale.m == pytest.approx(1.5, rel=within)
        assert abs(scale.m - 1.5) < 4 * scale.std


def test_what_never_rests_tells_no_scale(walked: tuple[CameraPath, np.ndarray]) -> None:
    truth = walked[1]
    assert "rest" in path_scale([kettle(truth, 0.0, 1.0)], truth).why_not
    hidden = replace(bowl(truth), visible=np.zeros(COUNT, bool))
    assert "no object was seen" in path_scale([hidden], truth).why_not
    still = np.tile(np.eye(4), (COUNT, 1, 1))
    still[:, :3, 3] = 1e-4 * truth[:, :3, 3]  # a camera that hardly moved, whatever its path's unit
    assert path_scale([bowl(still)], still).why_not


def watch_of(kind: str) -> CameraWatch:
    """A watch that has seen the corners; of the homographies only that they are far from standing still."""
    watch = CameraWatch(K, corners_of(kind, camera_poses(kind)))
    far = np.array([[1.0, 0, 90], [0, 1, 0], [0, 0, 1]])
    watch._H, watch._R = [np.eye(3)] + [far] * (COUNT - 1), [np.eye(3)] * COUNT
    watch._quality, watch._shape = [(0.9, 0.4)] * COUNT, (480, 640)
    return watch


def test_tracks_are_told_where_their_camera_was() -> None:
    truth = invert_pose(camera_poses("walk")[0]) @ camera_poses("walk")
    tracks = {"kettle": kettle(truth, 0.1, 0.9), "bowl": bowl(truth)}
    told = with_camera(tracks, watch_of("walk"), "auto")
    words = told["bowl"].header["camera"]["motion"]
    assert told["bowl"].header["camera"]["source"] == "given"
    assert words["kind"] == "moving"
    assert words["path_m"] == pytest.approx(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum(), rel=0.05)
    assert words["scale_std"] < 0.05
    assert np.ptp(told["bowl"].from_first_camera().T_camera_object[:, 0, 3]) < 0.5 * np.ptp(
        tracks["bowl"].T_camera_object[:, 0, 3]
    )
    alone = with_camera({"kettle": kettle(truth, 0.0, 1.0)}, watch_of("walk"), "auto")["kettle"]
    assert alone.T_first_camera is None
    assert alone.header["camera"]["motion"]["kind"] == "moving, not compensated"
    assert "rest" in alone.header["camera"]["motion"]["why_not"]


def test_what_is_asked_for_is_obeyed() -> None:
    truth = invert_pose(camera_poses("turn")[0]) @ camera_poses("turn")
    tracks = {"bowl": bowl(truth)}
    forced = with_camera(tracks, watch_of("turn"), "moving")["bowl"]
    assert forced.header["camera"]["motion"]["kind"] == "turning"
    assert "parallax" in forced.header["camera"]["motion"]["why_not"]
    assert forced.T_first_camera is not None
    assert not forced.T_first_camera[:, :3, 3].any()
    unwatched = with_camera(tracks, None, "static")["bowl"]
    assert unwatched.T_first_camera is None
    assert unwatched.header["camera"]["motion"] == {"asked": "static", "kind": "static"}


def test_tracks_are_compared_in_the_first_frames_camera_as_well(tmp_path: Path) -> None:
    truth = invert_pose(camera_poses("walk")[0]) @ camera_poses("walk")
    exact = kettle(truth, 0.1, 0.9)
    exact = replace(exact, header={**exact.header, "mesh": {**exact.header["mesh"], "extents_m": [0.1, 0.1, 0.2]}})
    arrays = {"T_camera_object": exact.T_camera_object, "camera_matrix": K, "time_s": exact.time_s}
    np.savez(tmp_path / "moving.npz", **arrays, T_first_camera=truth)
    moving = load_truth(tmp_path / "moving.npz")
    right, unaware = (
        compare_tracks(track, moving).first_camera for track in (replace(exact, T_first_camera=truth), exact)
    )
    assert right is not None
    assert unaware is not None
    assert (right.rotation_deg, right.translation_m) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert unaware.rotation_deg > 8
    report = compare_tracks(exact, moving)
    assert "in the first frame's camera" in report.table()
    assert Comparison.from_json(report.to_json()) == report
    np.savez(tmp_path / "still.npz", **arrays)
    assert compare_tracks(exact, load_truth(tmp_path / "still.npz")).first_camera is None
    np.savez(tmp_path / "odd.npz", **arrays, T_first_camera=truth[:5])
    with pytest.raises(UserError, match="T_first_camera"):
        load_truth(tmp_path / "odd.npz")


def test_the_trail_in_the_overlay_stays_where_the_object_was() -> None:
    """A thing at rest leaves its trail in one place, however the camera moves."""
    truth = invert_pose(camera_poses("walk")[0]) @ camera_poses("walk")
    at = invert_pose(camera_poses("walk")[0]) @ make_pose(t=(0.1, 0.0, 0.03))
    resting = replace(bowl(truth), T_camera_object=invert_pose(truth) @ at, T_first_camera=truth)
    past = np.arange(COUNT) < 60
    trail = project(K, where_it_was(resting, past, 59))
    assert np.ptp(trail, axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert np.ptp(project(K, where_it_was(replace(resting, T_first_camera=None), past, 59)), axis=0).max() > 10
