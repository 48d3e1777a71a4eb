"""Which first poses count as upright, and which of them are worth carrying on beside each other."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.extract.candidates import ObjectRequest, candidate_models, with_stoutest
from vid2demo.extract.first_pose import PoseCandidate, distinct, is_upright, silhouette_ious, upright_rotation
from vid2demo.extract.geometry import Symmetry, make_pose
from vid2demo.extract.raster import render_depth
from vid2demo.extract.region import TrackingMesh
from vid2demo.extract.segment import mask_box
from vid2demo.extract.starting import APART_DEG, start_object


@pytest.mark.parametrize(
    ("elevation_deg", "yaw_deg", "roll_deg", "expected"),
    [
        (20, 0, 0, True),
        (0, 130, 0, True),  # seen from the side, at the height of the table
        (50, 250, 0, True),
        (20, 40, 25, True),
        (20, 40, -25, True),
        (20, 40, 40, False),  # leaning too far
        (20, 40, -40, False),
        (-15, 40, 0, False),  # seen from below
        (20, 40, 180, False),  # upside down
        (10, 0, 90, False),  # lying
    ],
)
def test_upright_is_standing_and_seen_from_above(
    elevation_deg: float, yaw_deg: float, roll_deg: float, expected: bool
) -> None:
    assert is_upright(make_pose(upright_rotation(elevation_deg, yaw_deg, roll_deg), (0.0, 0.0, 0.6))) is expected


def test_from_where_an_object_is_seen_depends_on_its_place_in_the_image() -> None:
    """High in the image the camera looks up at what, by its rotation alone, it would see slightly from above."""
    R = upright_rotation(8, 40)
    assert is_upright(make_pose(R, (0.0, 0.1, 0.6)))
    assert not is_upright(make_pose(R, (0.0, -0.2, 0.6)))


def candidate(yaw_deg: float, iou: float) -> PoseCandidate:
    return PoseCandidate(make_pose(upright_rotation(20, yaw_deg), (0.0, 0.0, 0.6)), iou, 0.0)


def yaws_deg(kept: list[PoseCandidate], pool: list[PoseCandidate], yaws: list[float]) -> list[float]:
    return [yaws[next(i for i, c in enumerate(pool) if c is k)] for k in kept]


@pytest.mark.parametrize(
    ("symmetry", "expected"),
    [
        (Symmetry(), [0, 180, 90]),
        (Symmetry(order=2), [0, 90]),  # half a turn shows the same object again
        (Symmetry(order=4), [0]),
        (Symmetry(order=0), [0]),
    ],
)
def test_distinct_poses_are_the_best_ones_that_look_different(symmetry: Symmetry, expected: list[float]) -> None:
    yaws = [0.0, 10.0, 180.0, 90.0, 100.0]
    pool = [candidate(yaw, 0.9 - 0.05 * i) for i, yaw in enumerate(yaws)]
    kept = distinct(pool, 40, 4, 0.5, symmetry)
    assert yaws_deg(kept, pool, yaws) == expected
    assert kept[0] is pool[0]


def test_distinct_poses_are_limited_in_number_and_in_how_much_worse_they_are() -> None:
    yaws = [0.0, 90.0, 180.0, 270.0]
    pool = [candidate(yaw, iou) for yaw, iou in zip(yaws, (0.9, 0.8, 0.7, 0.2), strict=True)]
    assert len(distinct(pool, 40, 2, 0.5, Symmetry())) == 2
    assert yaws_deg(distinct(pool, 40, 4, 0.5, Symmetry()), pool, yaws) == [0, 90, 180]
    assert len(distinct(pool, 40, 4, 0.8, Symmetry())) == 4
    merits = np.array([c.merit for c in pool])
    assert np.all(np.diff(merits) < 0)


@pytest.mark.parametrize("x_m", [0.0, 0.22, -0.25, 0.6])
@pytest.mark.parametrize("trusted", [True, False])
def test_silhouettes_are_compared_with_masks_in_the_image_and_as_far_as_these_are_trusted(
    x_m: float, trusted: bool
) -> None:
    rng = np.random.default_rng(1)
    corners = 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 2, 1], [0, 3, 2]], np.int32)
    mesh = TrackingMesh.build(corners, faces)
    K, T = np.array([[200.0, 0, 60], [0, 200, 45], [0, 0, 1]]), make_pose(upright_rotation(20, 30), (x_m, 0.0, 0.7))
    mask = np.zeros((90, 120), bool)
    mask[20:60, 45:100] = True
    trust = None if trusted else rng.choice(np.array([0.5, 1.0], np.float32), mask.shape)
    window = render_depth(mesh.vertices_m, mesh.faces, T, K)
    assert window is not None
    silhouette = window.mask_in_image(120, 90)
    weight = np.ones(mask.shape) if trust is None else trust.astype(float)
    found = silhouette_ious(mesh, T, K, mask, mask_box(silhouette) if silhouette.any() else mask_box(mask), trust)
    if x_m == 0.6:  # out of the picture
        assert not silhouette.any()
        assert found == (0.0, 0.0)
    else:
        assert found[0] == pytest.approx(weight[silhouette & mask].sum() / weight[silhouette | mask].sum())
        assert found[1] == pytest.approx(1.0)


def hanging_bottle() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A picture of a bottle with its neck down and toward the camera, in one colour; its mask, pose and camera."""
    bottle = candidate_models(ObjectRequest("bottle"))[0].mesh
    K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
    T = make_pose(upright_rotation(35, 0, 160), (0.0, 0.0, 0.9))
    window = render_depth(bottle.vertices_m, bottle.faces, T, K)
    assert window is not None
    mask = window.mask_in_image(640, 480)
    return np.where(mask[..., None], (200, 170, 30), (90, 90, 95)).astype(np.uint8), mask, T, K


def test_what_need_not_stand_is_several_things_turned_otherwise() -> None:
    request = ObjectRequest("bottle")
    models = with_stoutest(candidate_models(request))
    assert len(models) == len(candidate_models(request)) + 1
    rgb, mask, T, K = hanging_bottle()
    start = start_object(request, models, rgb, [mask_box(mask)], "given", K, standing=False)
    axes = np.array([h.pose.T_camera_object[:3, 2] for h in start.hypotheses])
    assert len(axes) > 1
    angles_deg = np.rad2deg(np.arccos(np.clip(axes @ axes.T, -1, 1)))[~np.eye(len(axes), dtype=bool)]
    assert angles_deg.min() > APART_DEG - 5  # the fit that follows moves them a little
    assert np.rad2deg(np.arccos(axes @ T[:3, 2])).min() < 15  # what it is, is among them
    assert not any(h.pose.stands for h in start.hypotheses)


def test_the_start_does_not_depend_on_the_number_of_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    request = ObjectRequest("bottle")
    rgb, mask, _, K = hanging_bottle()
    starts = []
    for count in (1, 3):
        monkeypatch.setattr("vid2demo.extract.crew.usable_cpus", lambda count=count: count)
        starts.append(start_object(request, candidate_models(request), rgb, [mask_box(mask)], "given", K))
    one, other = (start.best for start in starts)
    assert np.array_equal(one.pose.T_camera_object, other.pose.T_camera_object)
    assert np.array_equal(one.evidence, other.evidence)
    assert one.model.header == other.model.header
