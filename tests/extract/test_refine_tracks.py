"""Poses refined by point tracks: points followed, put on the mesh, solved by PnP, and what PnP drifts by."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import Symmetry, focal_prior_camera_matrix, make_pose, project, transform_points
from vid2demo.extract.point_tracks import ClassicalTracks
from vid2demo.extract.protocols import PointTracker
from vid2demo.extract.raster import render_depth
from vid2demo.extract.refine_tracks import Refined, Seen, drift, lifted_points, refine, solve_pose, with_translation
from vid2demo.extract.region import TrackingMesh

WIDTH, HEIGHT, COUNT = 320, 240, 16
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
NOISE = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 220, (400, 400, 3)), (0, 0), 2.0).clip(0, 255)
TEXTURE = NOISE.astype(np.uint8)
GROUND = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
Pixels = np.ndarray


def block() -> TrackingMesh:
    box = trimesh.creation.box([0.16, 0.1, 0.12])
    return TrackingMesh.build(np.asarray(box.vertices, float), np.asarray(box.faces, np.int32))


def pose_at(k: float) -> np.ndarray:
    turn = Rotation.from_euler("xyz", [25 + 1.5 * k, 30 - 2.0 * k, 5 + k], degrees=True)
    return make_pose(turn.as_matrix(), (-0.03 + 0.004 * k, 0.01, 0.55 - 0.004 * k))


def seen_at(k: int) -> Seen:
    """The block drawn with a texture glued to it: a pixel's colour is that of its place on the surface."""
    mesh, T = block(), pose_at(k)
    window = render_depth(mesh.vertices_m, mesh.faces, T, K)
    assert window is not None
    depth = window.depth_in_image(WIDTH, HEIGHT)
    rows, columns = np.nonzero(depth)
    rays = np.linalg.solve(K, np.stack([columns, rows, np.ones(len(rows))])).T * depth[rows, columns, None]
    p = (rays - T[:3, 3]) @ T[:3, :3]
    at = 200 + 1500 * np.stack([p[:, 0] + 0.3 * p[:, 2], p[:, 1] - 0.4 * p[:, 2]])
    rgb = GROUND.copy()
    rgb[rows, columns] = cv2.remap(
        TEXTURE, at[0].astype(np.float32)[:, None], at[1].astype(np.float32)[:, None], cv2.INTER_LINEAR
    )[:, 0]
    return Seen(rgb, depth > 0)


CLIP = [seen_at(k) for k in range(COUNT)]


def frames(at: int) -> Iterator[Seen]:
    return iter(CLIP[at:] if at >= 0 else CLIP[~at::-1])


def turn_deg(T: np.ndarray, truth: np.ndarray) -> float:
    return float(np.rad2deg(Rotation.from_matrix(T[:3, :3].T @ truth[:3, :3]).magnitude()))


def test_flow_follows_points_both_ways_from_their_own_frames() -> None:
    pictures = np.stack([TEXTURE[40 : 40 + HEIGHT, 40 + 2 * k : 40 + 2 * k + WIDTH] for k in range(5)])
    points = np.array([[100, 60], [200, 150], [160, 200]], np.float32)
    index = np.array([2, 0, 4])
    tracker = ClassicalTracks()
    assert isinstance(tracker, PointTracker)
    tracks = tracker.track(pictures, index, points)
    assert tracks.visible.all()
    for k in range(5):
        expected = points - np.stack([2.0 * (k - index), np.zeros(3)], axis=1)
        np.testing.assert_allclose(tracks.pixels_px[k], expected, atol=0.1)
    np.testing.assert_array_equal(tracks.confidence[index, np.arange(3)], 1.0)


def test_a_point_that_was_hidden_is_not_taken_up_again() -> None:
    pictures = np.stack([TEXTURE[:HEIGHT, :WIDTH]] * 5)
    pictures[2, 80:160, 80:160] = 255
    points = np.array([[120, 120], [250, 120]], np.float32)
    tracks = ClassicalTracks().track(pictures, np.zeros(2, np.int64), points)
    assert tracks.visible[:, 1].all()
    np.testing.assert_array_equal(tracks.visible[:, 0], [True, True, False, False, False])
    empty = ClassicalTracks().track(pictures, np.zeros(0, np.int64), points[:0])
    assert empty.pixels_px.shape == (5, 0, 2)


def test_points_are_put_where_the_mesh_is_seen() -> None:
    mesh = block()
    pixels, points = lifted_points(CLIP[0], pose_at(0), mesh, K)
    assert len(points) > 40
    np.testing.assert_allclose(project(K, transform_points(pose_at(0), points)), pixels, atol=1e-3)
    nearest = np.abs(np.abs(points) - [0.08, 0.05, 0.06]).min(axis=1)
    assert nearest.max() < 1e-4  # on one of the block's sides
    behind = make_pose(t=(0.0, 0.0, -1.0))
    assert len(lifted_points(CLIP[0], behind, mesh, K)[0]) == 0
    nowhere = Seen(CLIP[0].rgb, np.zeros((HEIGHT, WIDTH), bool))
    assert len(lifted_points(nowhere, pose_at(0), mesh, K)[0]) == 0


@pytest.mark.parametrize("flat", [False, True])
def test_pnp_stands_points_that_went_astray(flat: bool) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.06, 0.06, (60, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    truth = pose_at(4)
    pixels = project(K, transform_points(truth, points)) + rng.normal(0, 0.2, (60, 2))
    pixels[:20] += rng.uniform(10, 60, (20, 2))
    guess = pose_at(1)
    found = solve_pose(points, pixels, K, guess)
    assert found is not None
    T, agree = found
    assert turn_deg(T, truth) < 1.5
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.01
    assert 38 <= agree <= 42
    assert solve_pose(points[:5], pixels[:5], K, guess) is None
    assert solve_pose(points, rng.uniform(0, 200, (60, 2)), K, guess) is None


@pytest.mark.parametrize("key", [0, 7, COUNT - 1])
def test_single_frames_errors_vanish_but_for_that_of_the_key_frame(key: int) -> None:
    rng = np.random.default_rng(1)
    coarse = np.stack([pose_at(k) for k in range(COUNT)])
    noise = Rotation.from_rotvec(rng.normal(0, 0.1, (COUNT, 3))).as_matrix()
    coarse[:, :3, :3] = coarse[:, :3, :3] @ noise
    coarse[:, 2, 3] *= 1 + rng.normal(0, 0.05, COUNT)
    coarse[key] = pose_at(key)
    found = refine(frames, coarse, key, block(), K, ClassicalTracks(), interval=5)
    np.testing.assert_array_equal(found.T_camera_object[key], coarse[key])
    assert (found.share > 0.3).all()
    for k in range(COUNT):
        assert turn_deg(found.T_camera_object[k], pose_at(k)) < 2.0
        assert abs(found.T_camera_object[k, 2, 3] / pose_at(k)[2, 3] - 1) < 0.02


def test_where_nothing_can_be_followed_single_frames_are_kept() -> None:
    def plain(at: int) -> Iterator[Seen]:
        return (Seen(GROUND, seen.mask) for seen in frames(at))

    coarse = np.stack([pose_at(k) for k in range(COUNT)])
    found = refine(plain, coarse, 3, block(), K, ClassicalTracks())
    np.testing.assert_allclose(found.T_camera_object, coarse, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(found.share), [3])


def chained(count: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth, poses that drift, and poses that scatter, of which some are turned round."""
    rng = np.random.default_rng(5)
    truth = np.stack([pose_at(0.2 * k) for k in range(count)])
    drifting, single = truth.copy(), truth.copy()
    slow = np.cumsum(rng.normal(0, 0.008, (count, 3)), axis=0)
    drifting[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(slow).as_matrix()
    drifting[:, 2, 3] *= 1 + np.linspace(0, 0.2, count)
    scatter = rng.normal(0, 0.12, (count, 3))
    scatter[::9] += [0.0, 0.0, 3.0]
    single[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(scatter).as_matrix()
    single[:, 2, 3] *= 1 + rng.normal(0, 0.04, count)
    return truth, drifting, single


def test_fused_poses_are_nearer_the_truth_than_either() -> None:
    truth, drifting, single = chained()
    refined, seen = Refined(drifting, np.ones(len(truth))), np.ones(len(truth), bool)
    rows = {kind: with_translation(kind, single, refined, seen, Symmetry()) for kind in ("coarse", "pnp", "fused")}
    np.testing.assert_array_equal(rows["pnp"], drifting)
    np.testing.assert_array_equal(rows["coarse"][:, :3, :3], drifting[:, :3, :3])
    np.testing.assert_array_equal(rows["coarse"][:, :3, 3], single[:, :3, 3])
    off = {kind: np.abs(T[:, 2, 3] / truth[:, 2, 3] - 1).mean() for kind, T in rows.items()}
    assert off["fused"] < 0.5 * off["coarse"] < 0.5 * off["pnp"]
    turn = [np.mean([turn_deg(a, b) for a, b in zip(T, truth, strict=True)]) for T in (rows["fused"], drifting, single)]
    assert turn[0] < 0.6 * min(turn[1:])


def test_the_spin_of_a_body_of_revolution_is_that_of_the_points() -> None:
    """Single frames cannot see it turn about its own axis; the points on it can."""
    truth, drifting, single = chained()
    spin = Rotation.from_rotvec(np.linspace(0, 4, len(truth))[:, None] * [0, 0, 1.0]).as_matrix()
    turning = truth.copy()
    turning[:, :3, :3] = truth[:, :3, :3] @ spin
    fused = with_translation(
        "fused", single, Refined(turning, np.ones(len(truth))), np.ones(len(truth), bool), Symmetry(order=0)
    )
    about = [Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()[2] for a, b in zip(fused, turning, strict=True)]
    assert np.ptp(about) < 0.15
    assert drifting.shape == fused.shape


def test_drift_may_leap_where_the_chain_is_broken() -> None:
    rng = np.random.default_rng(2)
    gap = rng.normal(0, 0.1, (80, 2)) + np.where(np.arange(80) < 40, 0.0, 2.0)[:, None]
    known, joined = np.ones(80, bool), np.arange(79) != 39
    found = drift(gap, known, joined)
    assert np.abs(found[:40]).max() < 0.15
    assert np.abs(found[40:] - 2).max() < 0.15
    blind = known.copy()
    blind[60:] = False
    gap[60:] = 50.0
    assert np.abs(drift(gap, blind, joined)[60:] - 2).max() < 0.2
    np.testing.assert_array_equal(drift(gap[:2], known[:2], joined[:1]), gap[:2])
