"""Inner contours of a mesh, what they tell of a pose, and what a hand before the object must not tell."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.background import BACKGROUND, FOREGROUND, HIDDEN_TRUST, SHADOW, SHADOW_TRUST, mask_trust
from vid2demo.extract.colours import HIDDEN_BIN, ColourModel, colour_bins
from vid2demo.extract.creases import crease_pixels
from vid2demo.extract.geometry import make_pose, project, rotation_angle_rad, transform_points
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh, draw_outline, edge_strength, refine

WIDTH, HEIGHT = 320, 240
K = np.array([[400.0, 0.0, 160.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]])
GROUND, RED, SKIN = (90, 120, 150), (170, 60, 50), (205, 150, 125)


def tracked(mesh: trimesh.Trimesh) -> TrackingMesh:
    return TrackingMesh.build(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32))


def creases_of(mesh: TrackingMesh, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image positions (N, 2), directions (N, 2) and which are jumps (N,)."""
    window = render_depth(mesh.vertices_m, mesh.faces, T, K, margin_px=8)
    at, across, jump = crease_pixels(window.depth_m, K, mesh.radius_m)
    return at + np.array([window.x0_px, window.y0_px]), across, jump


def cup(segments: int = 64) -> TrackingMesh:
    """An open cup of 5 cm radius and 10 cm height with walls 2 mm thick, its axis +z."""
    outline = [[0, -0.05], [0.05, -0.05], [0.05, 0.05], [0.048, 0.05], [0.048, -0.046], [0, -0.046]]
    return tracked(trimesh.creation.revolve(np.array(outline), sections=segments))


def tipped(lean_deg: float, t: tuple[float, float, float] = (0.0, 0.0, 0.5)) -> np.ndarray:
    """+z up in the image, leaning toward the camera."""
    return make_pose(Rotation.from_euler("x", 90 + lean_deg, degrees=True).as_matrix(), np.array(t))


def to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - (a + along[:, None] * (b - a)), axis=1)


def test_the_creases_of_a_box_are_its_edges_that_are_not_its_outline() -> None:
    mesh = tracked(trimesh.creation.box((0.1, 0.1, 0.1)))
    T = make_pose(Rotation.from_euler("xy", [35, 40], degrees=True).as_matrix(), np.array([0.0, 0.0, 0.5]))
    corners = transform_points(T, np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05)
    near = int(np.argmin(corners[:, 2]))  # the corner that points at the camera: three edges meet there
    pixels = project(K, corners)
    ends = [k for k in range(8) if bin(near ^ k).count("1") == 1]
    at, across, jump = creases_of(mesh, T)
    off = np.stack([to_segment(at, pixels[near], pixels[k]) for k in ends])
    assert len(at) > 40
    assert not jump.any()
    assert off.min(axis=0).max() < 2.0
    for line, k in zip(off, ends, strict=True):
        own = line < 1.0
        assert own.sum() > 10
        direction = (pixels[k] - pixels[near]) / np.linalg.norm(pixels[k] - pixels[near])
        assert np.median(np.abs(across[own] @ direction)) < 0.35  # across the edge, not along it


def test_a_ball_has_no_creases() -> None:
    at, _, _ = creases_of(tracked(trimesh.creation.icosphere(5, 0.05)), tipped(20))
    assert len(at) == 0


def test_the_near_rim_of_a_cup_is_a_jump() -> None:
    at, _, jump = creases_of(cup(), tipped(30))
    rim = transform_points(
        tipped(30), np.array([[0.049 * np.cos(a), 0.049 * np.sin(a), 0.05] for a in np.linspace(0, 6.28, 400)])
    )
    seen = project(K, rim)
    near = at[jump & (at[:, 1] > np.median(seen[:, 1]))]
    assert len(near) > 30
    assert max(np.min(np.linalg.norm(seen - p, axis=1)) for p in near) < 3.0


def painted(mesh: TrackingMesh, T: np.ndarray) -> np.ndarray:
    """The mesh in red, darker where it is seen at a slant, on a noisy bluish ground."""
    image = np.random.default_rng(0).normal(GROUND, 6, (HEIGHT, WIDTH, 3))
    depth = render_depth(mesh.vertices_m, mesh.faces, T, K).depth_in_image(WIDTH, HEIGHT)
    dy, dx = np.gradient(depth)
    facing = 1 / np.sqrt(1 + (dx * 400 / 0.5) ** 2 + (dy * 400 / 0.5) ** 2)
    inside = depth > 0
    image[inside] = (np.array(RED) * (0.5 + 0.5 * facing[..., None]))[inside]
    return np.clip(image, 0, 255).astype(np.uint8)


def known_colours(bins: np.ndarray, inside: np.ndarray) -> ColourModel:
    colours = ColourModel()
    colours.start_global(bins[inside], bins[~inside])
    return colours


def test_inner_contours_tell_how_a_cup_leans(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, truth, start = cup(), tipped(25), tipped(33)
    image = painted(mesh, truth)
    bins, edges = colour_bins(image), edge_strength(image)
    inside = render_depth(mesh.vertices_m, mesh.faces, truth, K).mask_in_image(WIDTH, HEIGHT)

    def lean_error_deg() -> float:
        found = refine(mesh, start, K, bins, known_colours(bins, inside), edges=edges, prior_depth=0.05)
        up, right = found.T_camera_object[:3, 2], truth[:3, 2]
        return float(np.rad2deg(np.arccos(np.clip(up @ right, -1, 1))))

    with_creases = lean_error_deg()
    monkeypatch.setattr("vid2demo.extract.region.draw_creases", lambda *_: None)
    assert with_creases < 2.0
    assert with_creases <= lean_error_deg() + 0.1


def test_creases_move_with_the_mesh() -> None:
    mesh, T = cup(), tipped(25)
    outline = draw_outline(mesh, T, K)
    assert outline is not None
    assert outline.creases is not None
    at, _ = outline.creases.seen(T, K)
    shifted = T.copy()
    shifted[0, 3] += 0.05
    moved, across = outline.creases.seen(shifted, K)
    assert np.allclose(np.linalg.norm(across, axis=1), 1)
    depth_m = transform_points(T, outline.creases.point_object_m)[:, 2]
    assert np.allclose((moved - at)[:, 0], 400 * 0.05 / depth_m)
    assert np.abs((moved - at)[:, 1]).max() < 0.5


def test_only_what_stands_before_the_background_in_a_hands_colours_is_hidden() -> None:
    image = np.full((60, 90, 3), GROUND, np.uint8)
    image[:, 30:60], image[:, 60:] = RED, SKIN
    bins = colour_bins(image)
    column = np.arange(90)
    colours = known_colours(bins, np.broadcast_to((column >= 30) & (column < 60), (60, 90)))
    covered = np.broadcast_to(column >= 30, (60, 90)).copy()
    covered[:20] = False  # nothing is known to stand there
    before = bins.copy()
    colours.hide(bins, covered)
    assert np.array_equal(bins, before)  # no hand has been seen yet
    colours.start_hiding(before[20:, 60:].ravel())
    colours.hide(bins, covered)
    assert (bins[20:, 60:] == HIDDEN_BIN).all()
    assert np.array_equal(bins[:20], before[:20])
    assert np.array_equal(bins[:, :60], before[:, :60])


def test_a_hand_before_the_object_does_not_pull_its_outline() -> None:
    mesh, truth = tracked(trimesh.creation.box((0.1, 0.06, 0.12))), tipped(25)
    image = painted(mesh, truth)
    inside = render_depth(mesh.vertices_m, mesh.faces, truth, K).mask_in_image(WIDTH, HEIGHT)
    bare = colour_bins(image)
    hand = np.zeros((HEIGHT, WIDTH), np.uint8)
    xs = np.nonzero(inside.any(axis=0))[0]
    cv2.rectangle(hand, (int(xs.max()) - 18, 0), (WIDTH - 1, HEIGHT - 1), 1, -1)  # over the object's right end
    image[hand > 0] = SKIN
    errors = []
    for hides in (True, False):
        colours = known_colours(bare, inside)
        bins = colour_bins(image)
        colours.background[-1] = 0.5 * (
            colours.background[-1] + np.bincount(bins[hand > 0], minlength=colours.background.shape[1]) / hand.sum()
        )
        if hides:
            colours.start_hiding(bins[hand > 0])
            colours.hide(bins, (hand > 0) | inside)
        found = refine(mesh, truth, K, bins, colours, prior_rotation_rad=0.1, prior_translation=0.1).T_camera_object
        shift_px = np.linalg.norm(project(K, found[None, :3, 3]) - project(K, truth[None, :3, 3]))
        errors.append((float(shift_px), float(np.rad2deg(rotation_angle_rad(found[:3, :3], truth[:3, :3])))))
    assert errors[0][0] < 1.5
    assert errors[0][1] < 3
    assert errors[0][0] < errors[1][0]


def test_a_mask_is_half_trusted_over_shadows_and_hardly_beside_what_covers_the_background() -> None:
    mask = np.array([[True, True, True, False, False, False]])
    labels = np.array([[FOREGROUND, SHADOW, BACKGROUND, FOREGROUND, SHADOW, BACKGROUND]], np.uint8)
    trusts = [1, SHADOW_TRUST, 1, HIDDEN_TRUST, 1, 1]
    assert np.allclose(mask_trust(mask, labels), [trusts])
