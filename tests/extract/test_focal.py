"""The focal length read from a clip: pictures of a block with a known camera, begun with a wrong one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.candidates import ObjectRequest
from vid2demo.extract.colours import ColourModel, colour_bins
from vid2demo.extract.focal import FocalEstimate, FocalView, estimate_focal, scaled_focal, with_focal
from vid2demo.extract.geometry import focal_prior_camera_matrix, invert_pose, make_pose, project, transform_points
from vid2demo.extract.perceive import extract
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh, extract_outline
from vid2demo.extract.video import Frame, VideoWriter

WIDTH, HEIGHT = 480, 360
PRIOR = focal_prior_camera_matrix(WIDTH, HEIGHT)
FINER = 4  # subpixels, for smooth outlines


def block() -> trimesh.Trimesh:
    """A block with a slanted top: no symmetry, and no two outlines alike."""
    corners = np.array([[x, y, z] for x in (-0.06, 0.06) for y in (-0.035, 0.035) for z in (-0.05, 0.05)])
    corners[7, 2] = corners[5, 2] = 0.0
    return trimesh.convex.convex_hull(corners).subdivide().subdivide()


MESH = TrackingMesh.build(np.asarray(block().vertices), np.asarray(block().faces, np.int32))


def picture(T: np.ndarray, camera: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    fine = np.diag([FINER, FINER, 1.0]) @ camera
    fine[:2, 2] += (FINER - 1) / 2
    window = render_depth(MESH.vertices_m, MESH.faces, T, fine)
    assert window is not None
    cover = window.mask_in_image(FINER * WIDTH, FINER * HEIGHT).astype(np.float32)
    cover = cv2.resize(cover, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)[..., None]
    ground = cv2.GaussianBlur(np.random.default_rng(0).normal((90, 120, 150), 40, (HEIGHT, WIDTH, 3)), (0, 0), 2.0)
    image = ground * (1 - cover) + cover * np.array([190.0, 70.0, 50.0])
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 4, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def poses(rng: np.random.Generator, count: int, near_m: float, far_m: float, aside: float = 0.1) -> list[np.ndarray]:
    base = Rotation.random(rng=rng)
    out = []
    for z in rng.uniform(near_m, far_m, count):
        R = base * Rotation.from_rotvec(np.pi / 2 * rng.uniform(-1, 1, 3))
        out.append(make_pose(R.as_matrix(), (*(rng.uniform(-aside, aside, 2) * z), z)))
    return out


def told(camera: np.ndarray, wrong: float, seen: list[np.ndarray], seed: int = 0) -> FocalEstimate | None:
    """What pictures tell when it is begun with a focal length that is `wrong` times the true one."""
    rng, colours, views = np.random.default_rng(seed), ColourModel(), []
    for k, T in enumerate(seen):
        image = picture(T, camera, rng)
        bins, outline = colour_bins(image), extract_outline(MESH, T, camera, (HEIGHT, WIDTH))
        window = render_depth(MESH.vertices_m, MESH.faces, T, camera)
        assert outline is not None
        assert window is not None
        if k == 0:
            inside = window.mask_in_image(WIDTH, HEIGHT)
            colours.start_global(bins[inside], bins[~inside])
        outline.teach(colours, bins, 0.3)
        start = scaled_focal(camera, wrong)
        view = FocalView.of(Frame(k, 0.06 * k, image), MESH, start, with_focal(T, wrong))
        assert view is not None
        views.append(view)
    return estimate_focal(MESH, colours, views, scaled_focal(camera, wrong), -float(np.log(wrong)))


@pytest.mark.parametrize(("true_over_prior", "wrong"), [(0.7, 1.4), (1.0, 1.0), (1.3, 0.75)])
def test_a_known_focal_length_is_found_as_surely_as_is_said(true_over_prior: float, wrong: float) -> None:
    camera = scaled_focal(PRIOR, true_over_prior)
    seen = poses(np.random.default_rng(3), 10, 0.4, 0.7)
    found = told(camera, wrong, seen)
    assert found is not None
    assert found.trusted(found.factor * wrong * true_over_prior)
    off = np.log(found.factor * wrong)
    assert abs(off) < 0.03
    assert found.contradicts == (wrong != 1.0)
    assert found.agree(replace(found, factor=1.0))


def test_what_is_too_far_away_to_show_perspective_is_not_believed() -> None:
    # Ten times as far with ten times the focal length: as large in the picture, but flat.
    camera = scaled_focal(PRIOR, 10.0)
    found = told(camera, 1.0, poses(np.random.default_rng(3), 8, 5.0, 6.0, 0.01))
    assert found is None or not found.trusted(found.factor)
    assert found is None or found.log_std > 0.12


def test_few_views_tell_nothing() -> None:
    assert told(PRIOR, 1.0, poses(np.random.default_rng(0), 4, 0.4, 0.7)) is None


def test_a_focal_length_that_no_camera_has_is_not_believed_however_sure() -> None:
    sure = FocalEstimate(0.2, 0.01, 20)
    assert not sure.trusted(0.2)
    assert sure.trusted(0.8)
    assert not replace(sure, log_std=0.2).trusted(0.8)


def test_an_answer_that_changes_when_asked_again_does_not_agree() -> None:
    assert FocalEstimate(0.8, 0.02, 20).agree(FocalEstimate(1.04, 0.02, 20))
    assert not FocalEstimate(0.8, 0.02, 20).agree(FocalEstimate(1.3, 0.02, 20))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_another_focal_length_shows_the_object_in_its_place_its_size_and_from_its_side(factor: float) -> None:
    for T in poses(np.random.default_rng(1), 5, 0.8, 1.0):
        moved, camera = with_focal(T, factor), scaled_focal(PRIOR, factor)
        assert project(camera, moved[None, :3, 3]) == pytest.approx(project(PRIOR, T[None, :3, 3]))
        sides = [invert_pose(pose)[:3, 3] / np.linalg.norm(pose[:3, 3]) for pose in (T, moved)]
        assert sides[1] == pytest.approx(sides[0])
        here, there = (project(K, transform_points(P, MESH.vertices_m)) for K, P in ((PRIOR, T), (camera, moved)))
        assert np.ptp(there, axis=0) == pytest.approx(np.ptp(here, axis=0), rel=0.15)


@pytest.mark.slow
def test_a_clip_of_an_exact_mesh_tells_its_camera(tmp_path: Path) -> None:
    camera, rng = scaled_focal(PRIOR, 0.75), np.random.default_rng(0)
    block().export(tmp_path / "block.ply")
    truth = []
    for k in range(16):
        R = Rotation.from_euler("zxz", [35 + 6 * k, 110, 20 + 6 * k], degrees=True)
        truth.append(make_pose(R.as_matrix(), (-0.05 + 0.008 * k, 0.01, 0.45 + 0.009 * k)))
    with VideoWriter(tmp_path / "clip.mp4", 25.0, crf=10) as writer:
        for T in truth:
            writer.write(picture(T, camera, rng))
    pixel = project(camera, transform_points(truth[0], MESH.vertices_m))
    (x, y), (w, h) = pixel.min(axis=0), np.ptp(pixel, axis=0)
    request = ObjectRequest("block", (float(x), float(y), float(w), float(h)), tmp_path / "block.ply", "m")
    track = extract(tmp_path / "clip.mp4", [request], out=tmp_path / "out")["block"]
    said = track.header["camera"]
    assert said["source"] == "estimated"
    assert track.camera_matrix[0, 0] == pytest.approx(said["focal_px"], abs=0.1)
    assert said["focal_px"] == pytest.approx(camera[0, 0], abs=0.12 * camera[0, 0])  # the prior is 33 % off
    assert track.T_camera_object[:, 2, 3] == pytest.approx(np.stack(truth)[:, 2, 3], rel=0.12)
