from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation
from vid2demo.extract.geometry import focal_prior_camera_matrix, invert_pose, look_at, make_pose
from vid2demo.extract.neural_words import NeuralWords
from vid2demo.extract.raster import render_depth
from vid2demo.extract.scale import (
    SizeReader,
    largest_part,
    measured_size,
    near_median,
    object_points,
    principal_extents,
    scene_sizes,
    without_rim,
)
from vid2demo.extract.size_table import SizeEntry, SizeTable, own_table, prompt
from vid2demo.extract.templates import crop_picture
from vid2demo.extract.vessels import make_vessel

WIDTH, HEIGHT = 1280, 960
CAMERA = focal_prior_camera_matrix(WIDTH, HEIGHT)
UNIT = 0.37  # metres in a unit of what the depth network says
Scene = tuple[Any, list[Any], np.ndarray[Any, Any]]


def table_scene(categories: tuple[str, ...], seed: int = 0) -> Scene:
    """Exact depth, masks and true largest extents [m] of vessels side by side on a table, none hidden by another."""
    rng = np.random.default_rng(seed)
    T_camera_world = invert_pose(look_at(np.array([-1.2, 0, 0.4]), np.array([0, 0, 0.1]), np.array([0.0, 0, 1])))
    depth, owner, true_m = np.full((HEIGHT, WIDTH), 9.0, np.float32), np.full((HEIGHT, WIDTH), -1), []
    for k, category in enumerate(categories):
        vessel = make_vessel(category)
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        y = (k - (len(categories) - 1) / 2) * 0.22
        T = T_camera_world @ make_pose(turn, (0.0, y, vessel.extents_m[2] / 2))
        window = render_depth(np.asarray(vessel.mesh.vertices), np.asarray(vessel.mesh.faces, np.int32), T, CAMERA)
        assert window is not None
        rows, columns = np.nonzero(window.mask)
        values = window.depth_m[rows, columns]
        rows, columns = rows + window.y0_px, columns + window.x0_px
        assert rows.min() >= 0
        assert columns.min() >= 0
        depth[rows, columns], owner[rows, columns] = values, k
        true_m.append(max(vessel.extents_m))
    return depth / UNIT, [owner == k for k in range(len(categories))], np.array(true_m)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return table_scene(("pitcher", "mug", "carton", "tumbler"))


def test_scale_is_recovered_when_the_table_is_right(scene: Scene) -> None:
    depth, masks, true_m = scene
    sharp = scene_sizes(depth, masks, CAMERA, true_m, rim_px=0)
    assert sharp.ratio == pytest.approx(UNIT, rel=0.04)
    np.testing.assert_allclose(sharp.sizes_m, true_m, rtol=0.08)
    papers = scene_sizes(depth, masks, CAMERA, true_m)
    assert np.median(np.abs(papers.sizes_m / true_m - 1)) < 0.05
    np.testing.assert_allclose(papers.sizes_m, true_m, rtol=0.3)  # the mug's handle goes with its rim


def test_median_over_the_scene_mends_a_wrong_entry(scene: Scene) -> None:
    depth, masks, true_m = scene
    for wrong in range(4):
        for factor in (0.2, 5.0):
            guesses = true_m.copy()
            guesses[wrong] *= factor
            found = scene_sizes(depth, masks, CAMERA, guesses, rim_px=0)
            np.testing.assert_allclose(found.sizes_m, true_m, rtol=0.12)


def test_unit_of_the_depth_does_not_matter(scene: Scene) -> None:
    depth, masks, true_m = scene
    one = scene_sizes(depth, masks, CAMERA, true_m)
    other = scene_sizes(depth * 40, masks, CAMERA, true_m)
    np.testing.assert_allclose(other.sizes_m, one.sizes_m, rtol=1e-5)
    assert other.ratio == pytest.approx(one.ratio / 40, rel=1e-5)


def test_table_that_is_wrong_by_a_factor_gives_sizes_wrong_by_it(scene: Scene) -> None:
    depth, masks, true_m = scene
    one, double = (scene_sizes(depth, masks, CAMERA, k * true_m) for k in (1, 2))
    np.testing.assert_allclose(double.sizes_m, 2 * one.sizes_m)


def test_object_alone_has_the_size_of_the_table(scene: Scene) -> None:
    depth, masks, _ = scene
    found = scene_sizes(depth, masks[:1], CAMERA, [0.25])
    assert found.sizes_m.tolist() == [0.25]
    assert np.isnan(found.ratio)
    assert np.isfinite(found.measured[0])


def test_object_that_hardly_shows_has_the_size_of_the_table(scene: Scene) -> None:
    depth, masks, true_m = scene
    speck = np.zeros((HEIGHT, WIDTH), bool)
    speck[5:9, 5:11] = True  # 24 px
    found = scene_sizes(depth, [*masks, speck], CAMERA, [*true_m, 0.123])
    assert found.sizes_m[-1] == 0.123
    assert np.isnan(found.measured[-1])
    np.testing.assert_allclose(found.sizes_m[:-1], scene_sizes(depth, masks, CAMERA, true_m).sizes_m)
    hidden = scene_sizes(depth, [masks[0], np.zeros_like(speck)], CAMERA, [0.3, 0.2])
    assert hidden.sizes_m.tolist() == [0.3, 0.2]


def test_sizes_are_never_below_a_centimetre() -> None:
    assert scene_sizes(np.ones((9, 9), np.float32), [np.ones((9, 9), bool)], CAMERA, [0.001]).sizes_m.tolist() == [0.01]


def test_bleeding_depth_spoils_sizes_unless_the_rim_is_taken_off(scene: Scene) -> None:
    """A network's depth slides from object to background over some pixels."""
    depth, masks, true_m = scene
    bled = ndimage.uniform_filter(depth, 7)

    def error(rim_px: int) -> float:
        sizes = np.array([measured_size(bled, mask, CAMERA, rim_px) for mask in masks])
        return float(np.median(np.abs(sizes * UNIT / true_m - 1)))

    assert error(8) < 0.15
    assert error(0) > 2 * error(8)


def plate() -> tuple[Any, Any]:
    """A cracker box seen from its front: 0.16 x 0.21 m at 1 m, its depth constant."""
    f = CAMERA[0, 0]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[300 : 300 + round(0.21 * f), 500 : 500 + round(0.16 * f)] = True
    return np.ones((HEIGHT, WIDTH), np.float32), mask


def as_the_reference_code_trims(z: Any) -> Any:
    """The first depth too far out is found by an argmax, which is 0 when no depth is."""
    off = np.abs(z - np.median(z))
    order = np.argsort(off, kind="stable")
    first_out = int(np.argmax(off[order] > 1.5 * np.std(z)))
    return order[: max(first_out, 25)]


def test_object_without_outliers_keeps_all_its_points() -> None:
    """Where nothing sticks out the reference code keeps 25 points, and takes a cracker box for a crumb."""
    depth, mask = plate()
    points = object_points(depth, mask, CAMERA)
    assert len(points) == np.count_nonzero(without_rim(mask))
    assert principal_extents(points)[0] == pytest.approx(0.21, rel=0.06)
    crumb = points[as_the_reference_code_trims(points[:, 2])]
    assert len(crumb) == 25
    assert principal_extents(crumb)[0] < 0.1 * 0.21


def test_where_something_sticks_out_both_trim_alike() -> None:
    rng = np.random.default_rng(0)
    z = np.concatenate([1 + 0.01 * rng.standard_normal(400), rng.uniform(2, 3, 20)])
    kept = near_median(z)
    assert kept[:400].all()
    assert not kept[400:].any()
    assert set(np.flatnonzero(kept)) == set(as_the_reference_code_trims(z))


def test_at_least_25_points_survive_trimming() -> None:
    z = np.concatenate([np.full(10, 1.0), 1 + np.linspace(0.5, 3, 90)])
    z[1::2] *= -1
    kept = near_median(z)
    assert np.count_nonzero(kept) >= 25
    assert near_median(np.ones(12)).all()


@pytest.mark.parametrize("seed", range(4))
def test_rim_is_what_a_distance_transform_says(seed: int) -> None:
    mask = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((90, 120)), 6) > 0.02
    mask = largest_part(mask)
    inner = without_rim(mask)
    oracle = next(e for r in (8, 4, 2, 1) if np.count_nonzero(e := ndimage.distance_transform_edt(mask) > r) > 25)
    np.testing.assert_array_equal(inner, oracle)


def test_rim_is_halved_for_small_objects_and_left_on_tiny_ones() -> None:
    for side, left in ((40, 24), (15, 7), (9, 7), (6, 6)):
        mask = np.zeros((60, 60), bool)
        mask[10 : 10 + side, 10 : 10 + side] = True
        assert np.count_nonzero(without_rim(mask)) == left**2


def test_only_the_largest_part_of_a_mask_counts() -> None:
    mask = np.zeros((40, 40), bool)
    mask[2:20, 2:20] = mask[30:35, 30:35] = True
    assert np.count_nonzero(largest_part(mask)) == 18 * 18
    assert not largest_part(np.zeros((4, 4), bool)).any()


def test_extents_do_not_depend_on_the_pose() -> None:
    rng = np.random.default_rng(0)
    box = rng.uniform(-1, 1, (4000, 3)) * [0.5, 0.3, 0.1]
    for R in Rotation.random(5, rng=rng).as_matrix():
        np.testing.assert_allclose(principal_extents(box @ R.T + [3.0, 2.0, 9.0]), [1.0, 0.6, 0.2], rtol=0.06)


def test_model_reads_the_median_size_of_the_11_likeliest_phrases(tiny_models: Path) -> None:
    """Against the slow way, by a loop; the network is random, so what it likes is arbitrary but fixed."""
    encoder = NeuralWords("clip-large", models_dir=tiny_models, device="cpu")
    entries = own_table().entries[::20]
    table = SizeTable("part", entries)
    rgb = np.random.default_rng(0).integers(0, 256, (80, 120, 3), dtype=np.uint8)
    masks = [np.zeros((80, 120), bool) for _ in range(2)]
    masks[0][10:60, 10:40] = masks[1][5:70, 60:110] = True
    boxes = [(10.0, 10.0, 30.0, 50.0), (60.0, 5.0, 50.0, 65.0)]
    guesses = SizeReader(encoder, table).guess(rgb, masks, boxes)
    texts = encoder.encode_texts([prompt(entry.phrase) for entry in entries])
    for guess, mask, box in zip(guesses, masks, boxes, strict=True):
        (picture,) = encoder.encode_images([crop_picture(rgb, mask, box, 0.05, 224)[0]])
        likeness = [float(np.dot(picture, text)) for text in texts]
        best = sorted(range(len(entries)), key=lambda k: -likeness[k])[:11]
        assert set(guess.phrases) == {entries[k].phrase for k in best}
        assert guess.size_m == sorted(entries[k].typical_m for k in best)[5]
        assert guess.source == "the 11 phrases of part most like it"


def test_vectors_of_the_phrases_are_kept(tiny_models: Path, tmp_path: Path) -> None:
    """Read again by the same network; another network or another table has its own."""
    encoder = NeuralWords("clip-large", models_dir=tiny_models, device="cpu")
    other = NeuralWords("siglip-base", models_dir=tiny_models, device="cpu")
    table = SizeTable("part", own_table().entries[:40])
    picture = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    asked = (picture, [np.ones((40, 40), bool)], [(0.0, 0.0, 40.0, 40.0)])
    first = SizeReader(encoder, table, cache=tmp_path).guess(*asked)
    (kept,) = tmp_path.iterdir()
    assert np.load(kept).shape == (40, encoder.size)
    assert SizeReader(encoder, table, cache=tmp_path).guess(*asked) == first == SizeReader(encoder, table).guess(*asked)
    assert len(list(tmp_path.iterdir())) == 1
    SizeReader(other, table, cache=tmp_path)
    SizeReader(encoder, SizeTable("less", table.entries[:30]), cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


def test_small_tables_are_read_whole(tiny_models: Path) -> None:
    encoder = NeuralWords("clip-large", models_dir=tiny_models, device="cpu")
    table = SizeTable("two", (SizeEntry("mug", 0.1, 0.1, 0.1), SizeEntry("kettle", 0.3, 0.3, 0.3)))
    mask = np.ones((30, 30), bool)
    (guess,) = SizeReader(encoder, table).guess(np.zeros((30, 30, 3), np.uint8), [mask], [(0.0, 0.0, 30.0, 30.0)])
    assert guess.size_m == pytest.approx(0.2)
