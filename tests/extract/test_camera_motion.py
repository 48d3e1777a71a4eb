"""Camera motion from the background: pictures warped by known turns, standing cameras, real clips."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.extract.camera_motion import CALM_FRAMES, LOOK_EVERY, CameraMotion, CameraWatch
from vid2demo.extract.geometry import focal_prior_camera_matrix, invert_pose, make_pose, rotation_angle_rad
from vid2demo.extract.video import iterate_frames

DATA = Path(__file__).parents[2].parent / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
WIDTH, HEIGHT, COUNT = 320, 240, 24
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
BOX = (120.0, 80.0, 60.0, 60.0)


def texture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)
    return cv2.resize(noise, (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_CUBIC)


def seen(H_frame_first: np.ndarray, k: int, *, noise: float = 3.0) -> np.ndarray:
    """The far background through a camera that sees the first frame moved by H, a moving thing in front."""
    middle = np.array([[1, 0, 1.5 * WIDTH], [0, 1, 1.5 * HEIGHT], [0, 0, 1.0]])  # the first frame inside the texture
    image = cv2.warpPerspective(texture(), H_frame_first @ np.linalg.inv(middle), (WIDTH, HEIGHT))
    x, y, w, h = (int(v) for v in BOX)
    thing = np.random.default_rng(5).integers(0, 255, (h, w, 3), np.uint8)
    image[y + k : y + h + k, x - 3 * k : x + w - 3 * k] = thing
    return np.clip(image + np.random.default_rng(k).normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def watched(H: Callable[[int], np.ndarray], *, leave_out: bool = True) -> CameraMotion:
    watch = CameraWatch(K)
    for k in range(COUNT):
        boxes = [(BOX[0] - 3 * k, BOX[1] + k, BOX[2], BOX[3])] if leave_out else []
        watch.step(seen(H(k), k), boxes=boxes)
    return watch.result()


def turn(k: int) -> np.ndarray:
    """R_camera_first of a camera that pans, tilts and rolls: 14 degrees in all."""
    return Rotation.from_rotvec(np.deg2rad([0.2, 0.5, 0.25]) * k).as_matrix()


@pytest.fixture(scope="module")
def panned() -> CameraMotion:
    return watched(lambda k: K @ turn(k) @ np.linalg.inv(K))


def test_known_turns_are_measured(panned: CameraMotion) -> None:
    truth = np.stack([turn(k) for k in range(COUNT)])
    assert not panned.static
    assert panned.rotates_only
    assert np.rad2deg(rotation_angle_rad(panned.R_camera_first, truth)).max() < 0.15
    assert panned.quality.min() > 0.7
    assert panned.H_frame_first[:, 2, 2] == pytest.approx(1.0)


def test_a_thing_that_stands_in_the_world_stands_still_after_compensation(panned: CameraMotion) -> None:
    T_first_object = make_pose(Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), (0.1, 0.05, 0.8))
    T_first_camera = np.stack([make_pose(turn(k).T) for k in range(COUNT)])
    found = panned.T_first_camera @ invert_pose(T_first_camera) @ T_first_object
    assert np.linalg.norm(found[:, :3, 3] - T_first_object[:3, 3], axis=1).max() < 0.003
    assert np.rad2deg(rotation_angle_rad(found[:, :3, :3], T_first_object[:3, :3])).max() < 0.2


@pytest.mark.parametrize("leave_out", [True, False])
def test_a_standing_camera_stands_whatever_moves_before_it(leave_out: bool) -> None:
    motion = watched(lambda _: np.eye(3), leave_out=leave_out)
    assert motion.static
    assert motion.stray_px < 0.1
    assert not motion.rotates_only
    assert motion.T_first_camera == pytest.approx(np.tile(np.eye(4), (COUNT, 1, 1)), abs=1e-6)


def test_a_wall_passed_sideways_is_no_turn() -> None:
    """A near wall seen at a slant slides and shears in ways no turn can."""

    def passing(k: int) -> np.ndarray:
        normal = np.array([0.5, 0.0, 0.87])
        R = Rotation.from_rotvec([0.0, 0.0, 0.01 * k]).as_matrix()
        return K @ (R + np.outer([0.012 * k, 0.004 * k, -0.006 * k], normal)) @ np.linalg.inv(K)

    motion = watched(passing)
    assert not motion.static
    assert not motion.rotates_only
    corners = np.array([[40.0, 40, 1], [280, 40, 1], [280, 200, 1], [40, 200, 1]])
    moved, truth = (corners @ H.T for H in (motion.H_frame_first[-1], passing(COUNT - 1)))
    assert np.abs(moved[:, :2] / moved[:, 2:] - truth[:, :2] / truth[:, 2:]).max() < 2.0


def test_nothing_to_see_is_no_motion() -> None:
    watch = CameraWatch(K)
    for _ in range(5):
        watch.step(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    motion = watch.result()
    assert motion.static
    assert motion.quality[1:].max() == 0
    assert motion.H_frame_first[-1] == pytest.approx(np.eye(3))


def test_masks_and_large_frames_are_taken() -> None:
    """A mask over everything that moves, on frames larger than those worked on; pixels are the large frame's."""
    watch = CameraWatch(np.diag([4, 4, 1.0]) @ K)
    for k in range(6):
        shift = np.array([[1, 0, 2.0 * k], [0, 1, 0], [0, 0, 1]])
        small = seen(shift, k, noise=0.0)
        mask = np.zeros((4 * HEIGHT, 4 * WIDTH), bool)
        mask[4 * 76 : 4 * 150, 4 * 95 : 4 * 185] = True
        watch.step(cv2.resize(small, None, fx=4, fy=4), mask)
    assert watch.result().H_frame_first[-1] @ [640, 480, 1] == pytest.approx([680, 480, 1], abs=1.5)


def test_asked_before_the_first_frame_it_refuses() -> None:
    with pytest.raises(ValueError, match="no frame"):
        CameraWatch(K).result()


def test_corners_keep_their_numbers_and_standing_frames_share_theirs() -> None:
    """What the path of a camera is told from: a number is one place of the texture, in whatever frame."""
    watch = CameraWatch(K)
    shifts = np.array([0.0, 0, 0, 4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 44, 44])
    for shift in shifts:
        watch.step(seen(np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]), 0, noise=0.0), boxes=[BOX])
    first = watch.sightings[0]
    assert first is not None
    assert watch.sightings[2] is first
    assert sum(s is not None and s.view for s in watch.sightings) < len(shifts)
    for sighting, shift in zip(watch.sightings, shifts, strict=True):
        assert sighting is not None
        _, a, b = np.intersect1d(first.ids, sighting.ids, return_indices=True)
        assert len(a) > 20
        moved = sighting.pixels[b] - first.pixels[a]
        assert np.median(moved, axis=0) == pytest.approx([shift, 0], abs=0.1)
        assert np.mean(np.abs(moved - [shift, 0]) < 0.5) > 0.97


def test_no_motion_begins_late_after_the_camera_has_stood() -> None:
    """Of a standing camera only some frames are looked at; those passed over before it moves are gone through."""
    begins = CALM_FRAMES + 2 * LOOK_EVERY + LOOK_EVERY // 2
    shifts = np.maximum(0.0, 3.0 * (np.arange(begins + 2 * LOOK_EVERY + 1) - begins))
    watch = CameraWatch(K)
    for k, shift in enumerate(shifts):
        watch.step(seen(np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]), k), boxes=[(BOX[0] - 3 * k, *BOX[1:])])
    motion = watch.result()
    assert len(motion.quality) == len(watch.sightings) == len(shifts)
    middle = motion.H_frame_first @ [WIDTH / 2, HEIGHT / 2, 1.0]
    assert middle[:, 0] / middle[:, 2] == pytest.approx(WIDTH / 2 + shifts, abs=1.0)  # of 3 px a frame
    assert all(sighting is watch.sightings[0] for sighting in watch.sightings[:begins])
    for sighting, shift in zip(watch.sightings[begins:], shifts[begins:], strict=True):
        first = watch.sightings[0]
        assert first is not None
        assert sighting is not None
        _, a, b = np.intersect1d(first.ids, sighting.ids, return_indices=True)
        assert np.median(sighting.pixels[b] - first.pixels[a], axis=0) == pytest.approx([shift, 0], abs=0.1)


@needs_data
def test_a_real_clip_from_a_tripod_is_static() -> None:
    watch: CameraWatch | None = None
    for frame in iterate_frames(DATA / "tracking/mustard_a/video.mp4"):
        watch = watch or CameraWatch(focal_prior_camera_matrix(frame.rgb.shape[1], frame.rgb.shape[0]))
        if frame.index % 3 == 0:
            watch.step(frame.rgb)
    assert watch is not None
    assert watch.result().static
