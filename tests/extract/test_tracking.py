"""Perception against exact synthetic truth: masks, first poses, shape, tracking, whole extraction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.extract.both_ways import Clip, follow_both_ways, look_again
from vid2demo.extract.candidates import vessel_model
from vid2demo.extract.colours import ColourModel, colour_bins, mask_evidence
from vid2demo.extract.errors import UserError
from vid2demo.extract.first_pose import PoseCandidate, find_first_pose, upright_rotation
from vid2demo.extract.follow import Followed
from vid2demo.extract.geometry import (
    focal_prior_camera_matrix,
    make_pose,
    project,
    rotation_angle_rad,
    transform_points,
)
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import extract_outline, refine
from vid2demo.extract.segment import check_box, mask_box, mask_from_box, mask_from_silhouette
from vid2demo.extract.shape_fit import View, fit_shape, tracking_mesh
from vid2demo.extract.smoothing import smooth_poses
from vid2demo.extract.spin import spun
from vid2demo.extract.starting import Hypothesis, Start
from vid2demo.extract.tracker import ObjectTracker
from vid2demo.extract.vessels import make_vessel
from vid2demo.extract.video import VideoWriter, read_video_info

WIDTH, HEIGHT = 320, 240
K = focal_prior_camera_matrix(WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def mug():
    return make_vessel("mug")


@pytest.fixture(scope="module")
def mesh(mug):
    return tracking_mesh(mug)


def pose_of(elevation_deg: float = 20, yaw_deg: float = 30, roll_deg: float = 0, t=(0.02, 0.01, 0.5)) -> np.ndarray:
    return make_pose(upright_rotation(elevation_deg, yaw_deg, roll_deg), t)


def picture(mesh, T: np.ndarray, seed: int = 0) -> np.ndarray:
    """The mesh in shaded red on a noisy bluish ground."""
    rng = np.random.default_rng(seed)
    image = rng.normal((90, 120, 150), 12, (HEIGHT, WIDTH, 3))
    window = render_depth(mesh.vertices_m, mesh.faces, T, K)
    inside = window.mask_in_image(WIDTH, HEIGHT)
    image[inside] = rng.normal((170, 60, 50), 12, (int(inside.sum()), 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def silhouette(mesh, T: np.ndarray) -> np.ndarray:
    return render_depth(mesh.vertices_m, mesh.faces, T, K).mask_in_image(WIDTH, HEIGHT)


def test_depth_of_a_facing_square_is_exact() -> None:
    square = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    window = render_depth(square, faces, make_pose(t=(0, 0, 1.0)), K)
    assert window is not None
    side_px = 0.2 * K[0, 0]
    assert np.count_nonzero(window.mask) == pytest.approx(side_px**2, rel=0.03)
    assert window.depth_m[window.mask] == pytest.approx(1.0)


def test_nearer_surfaces_hide_farther_ones_and_what_is_behind_the_camera_is_not_drawn() -> None:
    one = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.0, 0.1, 0.0]])
    farther = one + np.array([0.0, 0.0, 0.3])
    both, faces = np.vstack([farther, one]), np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    window = render_depth(both, faces, make_pose(t=(0, 0, 1.0)), K)
    assert window is not None
    assert window.depth_m[window.mask].min() == pytest.approx(1.0)
    y, x = np.argwhere(window.mask).mean(axis=0).astype(int)
    assert window.depth_m[y, x] == pytest.approx(1.0)
    assert render_depth(both, faces, make_pose(t=(0, 0, -1.0)), K) is None


def test_mask_from_a_box_and_from_a_silhouette(mesh) -> None:
    T = pose_of()
    image, truth = picture(mesh, T), silhouette(mesh, T)
    x, y, w, h = mask_box(truth)
    for mask in (
        mask_from_box(image, (x - 6, y - 6, w + 12, h + 12)),
        mask_from_silhouette(image, silhouette(mesh, pose_of(t=(0.025, 0.013, 0.5))), 8),
    ):
        assert np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth) > 0.93


@pytest.mark.parametrize("box", [(400, 10, 50, 50), (10, 10, 4, 50), (-50, -50, 55, 55)])
def test_box_outside_the_picture_is_refused(box: tuple) -> None:
    with pytest.raises(UserError, match="--box"):
        check_box(box, WIDTH, HEIGHT)


@pytest.mark.parametrize("yaw_deg", [30, 150, -30])
def test_first_pose_is_found_from_a_mask(mug, mesh, yaw_deg: float) -> None:
    T = pose_of(yaw_deg=yaw_deg)
    found = find_first_pose(vessel_model(mug), picture(mesh, T), silhouette(mesh, T), K)[0].T_camera_object
    assert np.rad2deg(rotation_angle_rad(found[:3, :3], T[:3, :3])) < 8
    assert np.linalg.norm(found[:2, 3] - T[:2, 3]) < 0.005
    assert abs(found[2, 3] - T[2, 3]) < 0.03


@pytest.mark.parametrize(
    "start",
    [
        pose_of(14, 38, 6, (0.028, 0.004, 0.52)),
        pose_of(26, 22, -6, (0.012, 0.016, 0.49)),
        pose_of(17, 24, 5, (0.014, 0.003, 0.515)),
    ],
)
def test_refinement_converges_from_a_wrong_pose(mesh, start: np.ndarray) -> None:
    """With the priors of the first pose's search: without any, a step along a turn hardly seen goes too far."""
    T = pose_of()
    truth = silhouette(mesh, T)
    priors = {"prior_rotation_rad": 0.12, "prior_translation": 0.05, "prior_depth": 0.1}
    found = refine(mesh, start, K, *mask_evidence(truth), **priors).T_camera_object
    shown = silhouette(mesh, start), silhouette(mesh, found)
    overlap = [np.count_nonzero(s & truth) / np.count_nonzero(s | truth) for s in shown]
    assert overlap[0] < 0.85
    assert overlap[1] > 0.96
    turned = [np.rad2deg(rotation_angle_rad(pose[:3, :3], T[:3, :3])) for pose in (start, found)]
    assert turned[1] < min(3.0, 0.5 * turned[0])
    assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 0.5 * np.linalg.norm(start[:3, 3] - T[:3, 3])


def test_outline_points_project_onto_their_pixels(mesh) -> None:
    T = pose_of()
    outline = extract_outline(mesh, T, K, (HEIGHT, WIDTH))
    assert outline is not None
    points = outline.point_object_m @ T[:3, :3].T + T[:3, 3]
    assert (points @ K.T)[:, :2] / points[:, 2:] == pytest.approx(outline.pixel, abs=1e-6)
    # One pixel further out there is no object, one pixel further in there is.
    truth = silhouette(mesh, T)
    for step, expected in ((2.0, False), (-2.0, True)):
        x, y = np.round(outline.pixel + step * outline.normal).astype(int).T
        assert np.mean(truth[y, x] == expected) > 0.9


def test_shape_fit_recovers_height_and_radius(mug) -> None:
    taller = make_vessel("mug", height_m=1.15 * mug.params["height_m"])
    T = pose_of(15, 60)
    truth = silhouette(tracking_mesh(taller), T)
    start = find_first_pose(vessel_model(mug), picture(tracking_mesh(taller), T), truth, K)[0].T_camera_object
    fitted, (pose,) = fit_shape(mug, [View(*mask_evidence(truth), start)], K)
    ratio = [v.params["height_m"] / v.params["top_radius_m"] for v in (mug, fitted, taller)]
    assert abs(ratio[1] - ratio[2]) < 0.6 * abs(ratio[0] - ratio[2])
    mask = silhouette(tracking_mesh(fitted), pose)
    assert np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth) > 0.95


def moving_pose(k: int) -> np.ndarray:
    return pose_of(20, 30, -1.5 * k, (0.02 - 0.0015 * k, 0.01 - 0.001 * k, 0.5 + 0.001 * k))


def test_tracker_follows_a_tilting_mug_without_drift(mesh) -> None:
    tracker = ObjectTracker(mesh, K, picture(mesh, moving_pose(0)), silhouette(mesh, moving_pose(0)), moving_pose(0))
    for k in range(1, 41):
        estimate = tracker.step(picture(mesh, moving_pose(k), seed=k))
    assert estimate.visible
    assert estimate.confidence > 0.6
    assert np.rad2deg(rotation_angle_rad(estimate.T_camera_object[:3, :3], moving_pose(40)[:3, :3])) < 8
    assert np.linalg.norm(estimate.T_camera_object[:2, 3] - moving_pose(40)[:2, 3]) < 0.006


def behind_a_hand(mug, mesh, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame k with a patch of skin over the whole handle, and the mask of the patch."""
    image, hand = picture(mesh, moving_pose(k), seed=k), np.zeros((HEIGHT, WIDTH), bool)
    handle = mesh.vertices_m[mesh.vertices_m[:, 0] < mug.interior.axis_xy_m[0] - mug.params["top_radius_m"] - 0.004]
    pixels = project(K, transform_points(moving_pose(k), handle))
    (left, top), (right, bottom) = (pixels.min(axis=0) - 6).astype(int), (pixels.max(axis=0) + 6).astype(int)
    hand[top:bottom, left:right] = True
    skin = np.random.default_rng(100 + k).normal((215, 160, 130), 12, (int(hand.sum()), 3))
    image[hand] = np.clip(skin, 0, 255).astype(np.uint8)
    return image, hand


def errors_of_both_passes_deg(mug, mesh, hidden: int, wrong_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation errors in 20 frames, the handle hidden in the first ones and guessed wrong in the very first."""
    poses = [moving_pose(k) for k in range(20)]
    frames = [behind_a_hand(mug, mesh, k)[0] if k < hidden else picture(mesh, T, seed=k) for k, T in enumerate(poses)]
    mask = silhouette(mesh, poses[0]) & ~behind_a_hand(mug, mesh, 0)[1]
    wrong = spun(poses[0], np.deg2rad(wrong_deg), mug.interior.axis_xy_m)

    def followed_deg(followed: Followed) -> np.ndarray:
        for k, frame in enumerate(frames):
            followed.step(frame, k, len(frames))
        found = np.stack([e.T_camera_object for e in followed.estimates])
        return np.rad2deg(rotation_angle_rad(found[:, :3, :3], np.stack(poses)[:, :3, :3]))

    first = Followed.start(mesh, mug, K, frames[0], mask, wrong)
    first_deg = followed_deg(first)
    return first_deg, followed_deg(first.second_pass(frames[0]))


def test_second_pass_has_the_spin_right_where_the_handle_was_hidden(mug, mesh) -> None:
    """A spin that the first pass held wrong through the clip is put right, in the hidden frames as well."""
    first_deg, second_deg = errors_of_both_passes_deg(mug, mesh, 2, 50.0)
    assert first_deg.min() > 25
    # Where nothing is seen of the handle, the spin is what lies between: nearer, but not exact.
    assert second_deg[:2].max() < 0.6 * first_deg[:2].min()
    assert second_deg[2:].max() < 6


@pytest.mark.parametrize("wrong_deg", [50.0, -50.0])
def test_frames_that_hide_the_handle_do_not_mislead_those_that_show_it(mug, mesh, wrong_deg: float) -> None:
    """Of the hidden frames nothing is asked here: with the whole handle covered for long, their spin is a guess.

    The first frame that shows it may still be on the way from that guess.
    """
    first_deg, second_deg = errors_of_both_passes_deg(mug, mesh, 8, wrong_deg)
    assert first_deg[:8].min() > 20
    assert second_deg[8] < 20
    assert second_deg[9:].max() < 6


def test_a_vanished_object_is_reported_and_found_again(mesh) -> None:
    T = pose_of()
    image = picture(mesh, T)
    empty = np.clip(np.random.default_rng(9).normal((90, 120, 150), 12, image.shape), 0, 255).astype(np.uint8)
    tracker = ObjectTracker(mesh, K, image, silhouette(mesh, T), T)
    seen = tracker.step(image)
    gone = [tracker.step(empty) for _ in range(5)][-1]
    back = [tracker.step(image) for _ in range(2)][-1]
    assert seen.visible
    assert back.visible
    assert gone.confidence < 0.5 * seen.confidence
    assert back.confidence > 0.8 * seen.confidence
    assert np.linalg.norm(back.T_camera_object[:3, 3] - T[:3, 3]) < 0.02


def test_colour_model_tells_object_from_ground(mesh) -> None:
    T = pose_of()
    image, truth = picture(mesh, T), silhouette(mesh, T)
    bins, colours = colour_bins(image), ColourModel()
    colours.start_global(bins[truth], bins[~truth])
    more_likely = colours.foreground[-1][bins] > colours.background[-1][bins]
    assert np.mean(more_likely == truth) > 0.99


def test_smoothing_takes_noise_off_and_keeps_accelerated_motion() -> None:
    rng = np.random.default_rng(0)
    time_s = np.arange(60) / 30
    exact = np.stack(
        [
            make_pose(Rotation.from_rotvec([0, 0.8 * t + 0.5 * t * t, 0]).as_matrix(), (t * t, 0.1 * t, 0))
            for t in time_s
        ]
    )
    noise = Rotation.from_rotvec(rng.normal(0, 0.01, (60, 3))).as_matrix()
    noisy = exact.copy()
    noisy[:, :3, :3] = exact[:, :3, :3] @ noise
    noisy[:, :3, 3] += rng.normal(0, 0.003, (60, 3))
    smooth = smooth_poses(noisy, time_s, np.ones(60), 0.1)
    inner = slice(8, -8)

    def errors(T: np.ndarray) -> tuple[float, float]:
        angle = rotation_angle_rad(T[inner, :3, :3], exact[inner, :3, :3])
        return float(angle.mean()), float(np.linalg.norm(T[inner, :3, 3] - exact[inner, :3, 3], axis=1).mean())

    assert errors(smooth)[0] < 0.6 * errors(noisy)[0]
    assert errors(smooth)[1] < 0.6 * errors(noisy)[1]
    assert errors(smooth_poses(exact, time_s, np.ones(60), 0.1))[1] < 1e-3


def test_an_outlier_of_no_confidence_is_ignored() -> None:
    time_s = np.arange(20) / 25
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[10, 0, 3] = 1.0
    weight = np.ones(20)
    weight[10] = 0.0
    assert smooth_poses(poses, time_s, weight, 0.08)[10, 0, 3] < 0.02


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, mesh) -> Path:
    path = tmp_path_factory.mktemp("clip") / "mug.mp4"
    with VideoWriter(path, 25.0, crf=12) as writer:
        for k in range(12):
            writer.write(picture(mesh, moving_pose(k), seed=k))
    return path


@pytest.mark.slow
def test_extract_writes_a_track_that_hugs_the_object(clip: Path, mesh, tmp_path: Path) -> None:
    box = mask_box(silhouette(mesh, moving_pose(0)))
    done: list[tuple[int, int]] = []
    tracks = extract(
        clip, [ObjectRequest("mug", box)], out=tmp_path, progress=lambda d, total, _: done.append((d, total))
    )
    track = tracks["mug"]
    assert {p.name for p in tmp_path.iterdir()} == {"mug.track.npz", "mug.masks.npz", "mug.mask.png", "overlay.mp4"}
    assert len(track) == 12
    assert track.header["camera"]["source"] == "prior"
    assert track.header["settings"]["box_source"] == "given"
    errors_px = [
        np.linalg.norm((K @ track.T_camera_object[k, :3, 3])[:2] / track.T_camera_object[k, 2, 3] - expected)
        for k in range(12)
        for expected in [(K @ moving_pose(k)[:3, 3])[:2] / moving_pose(k)[2, 3]]
    ]
    assert max(errors_px) < 0.015 * np.hypot(WIDTH, HEIGHT)
    assert done[-1] == (12, 12)
    again = extract(clip, [ObjectRequest("mug", box)], out=tmp_path / "again")["mug"]
    assert np.array_equal(again.T_camera_object, track.T_camera_object)


def test_what_is_not_followed_surely_is_looked_at_again_and_the_surer_kept(
    clip: Path, mug, mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow = make_vessel("mug", None, **{**mug.params, "top_radius_m": 0.7 * mug.params["top_radius_m"]})
    mask, T = silhouette(mesh, moving_pose(0)), moving_pose(0)
    box = mask_box(mask)
    start = Start((Hypothesis(vessel_model(narrow), PoseCandidate(T, 1.0, 1.0), mask, box, mask),), "given", box)
    film = Clip(read_video_info(clip), 0, picture(mesh, T, seed=0), K)
    with monkeypatch.context() as first:
        first.setattr("vid2demo.extract.follow.FIT_STEPS_PX", ())  # the shape stays wrong
        done, watched = follow_both_ways(film, [start], lambda *_: None)

    monkeypatch.setattr("vid2demo.extract.both_ways.SURE_ENOUGH", 0.0)
    assert look_again(film, done, watched, lambda *_: None) == done
    monkeypatch.setattr("vid2demo.extract.both_ways.SURE_ENOUGH", 1.1)  # nothing is
    (again,) = look_again(film, done, watched, lambda *_: None)

    assert again.sure > done[0].sure

    def astray(self: Followed, rgb: np.ndarray) -> Followed:
        poses = np.stack([spun(e.T_camera_object, 0.5) for e in self.estimates])
        return replace(self, guesses=poses, vessel=narrow, mesh=vessel_model(narrow).mesh)

    monkeypatch.setattr(Followed, "second_pass", astray)
    assert look_again(film, done, watched, lambda *_: None) == done


def test_bad_requests_are_one_clear_error(clip: Path, tmp_path: Path) -> None:
    for request, camera, words in (
        (ObjectRequest("spoonhat", (10, 10, 60, 60)), None, "mug"),
        (ObjectRequest("mug", (900, 10, 60, 60)), None, "--box"),
        (ObjectRequest("mug", (10, 10, 60, 60)), (1.0, 1.0, 160.0, 120.0), "--camera"),
    ):
        with pytest.raises(UserError, match=words):
            extract(clip, [request], out=tmp_path, camera=camera)
    assert list(tmp_path.iterdir()) == []


def test_an_object_that_is_not_there_is_not_invented(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mp4"
    with VideoWriter(empty, 25.0) as writer:
        for k in range(3):
            rng = np.random.default_rng(k)
            writer.write(np.clip(rng.normal(120, 8, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8))
    with pytest.raises(UserError, match="was not found"):
        extract(empty, [ObjectRequest("mug")], out=tmp_path / "out")
