from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from vid2demo.extract.bop import ImageKey, ModelSymmetry, Target, mask_from_rle, open_dataset, rle_from_mask
from vid2demo.extract.bop_results import Estimate, read_results, write_results
from vid2demo.extract.bop_write import Frame, Instance, box_of, diameter, write_models, write_scene, write_targets
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose

CAMERA = np.array([[500.0, 0.0, 31.5], [0.0, 510.0, 23.5], [0.0, 0.0, 1.0]])
GOOD_LINE = "3,7,2,0.5,1 0 0 0 1 0 0 0 1,10 -20 800,1.5"


def random_frame(rng: np.random.Generator, im_id: int) -> Frame:
    instances = []
    for obj_id in (2, 5):
        T = make_pose(Rotation.random(rng=rng).as_matrix(), rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 1.0]))
        mask = rng.random((48, 64)) < 0.4
        instances.append(Instance(obj_id, T, mask, mask & (rng.random((48, 64)) < 0.5)))
    depth_m = np.where(rng.random((48, 64)) < 0.2, 0, rng.uniform(0.4, 2.0, (48, 64))).astype(np.float32)
    rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    return Frame(im_id, rgb, depth_m, CAMERA, tuple(instances))


@pytest.fixture
def frames() -> list[Frame]:
    rng = np.random.default_rng(0)
    return [random_frame(rng, im_id) for im_id in (1, 36)]


@pytest.mark.parametrize("layout", ["scenes", "images"])
def test_what_was_written_is_read_in_either_layout(layout: str, frames: list[Frame], tmp_path: Path) -> None:
    write_scene(tmp_path, "test", 48, frames, layout)
    dataset = open_dataset(tmp_path)
    assert dataset.layout == layout
    assert dataset.images == (ImageKey(48, 1), ImageKey(48, 36))
    for frame, image in zip(frames, dataset.images, strict=True):
        assert np.array_equal(dataset.rgb(image), frame.rgb)
        depth_m = dataset.depth_m(image)
        assert depth_m is not None
        assert np.abs(depth_m - frame.depth_m).max() <= 0.6e-4
        assert np.array_equal(dataset.camera_matrix(image), CAMERA)
        objects = dataset.objects(image)
        assert [o.obj_id for o in objects] == [2, 5]
        for there, instance in zip(objects, frame.instances, strict=True):
            assert np.allclose(there.T_camera_object, instance.T_camera_object, atol=1e-12)
            for visible, mask in ((True, instance.visible), (False, instance.mask)):
                assert np.array_equal(dataset.mask(image, there.index, visible=visible), mask)
            assert there.visible_fraction == pytest.approx(instance.visible.sum() / instance.mask.sum())
    assert set(dataset.targets) == {Target(image, obj_id, 1) for image in dataset.images for obj_id in (2, 5)}


def test_files_hold_millimetres(frames: list[Frame], tmp_path: Path) -> None:
    write_scene(tmp_path, "test", 0, frames)
    truth = json.loads((tmp_path / "test/000000/scene_gt.json").read_text())["1"][0]
    assert np.allclose(truth["cam_t_m2c"], 1000 * frames[0].instances[0].T_camera_object[:3, 3])
    camera = json.loads((tmp_path / "test/000000/scene_camera.json").read_text())["1"]
    assert camera["depth_scale"] == 0.1


def test_models_keep_their_size_and_frame(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.03, 0.04, 0.12))
    box.apply_translation([0.01, 0.0, 0.0])
    write_models(tmp_path, {7: box})
    (tmp_path / "test").mkdir()
    write_scene(tmp_path, "test", 0, [random_frame(np.random.default_rng(0), 0)])
    dataset = open_dataset(tmp_path)
    assert dataset.models[7].diameter_m == pytest.approx(0.13)
    assert dataset.models[7].extents_m == pytest.approx((0.03, 0.04, 0.12))
    assert np.allclose(dataset.mesh(7).bounds, box.bounds, atol=1e-7)
    entry = json.loads((tmp_path / "models/models_info.json").read_text())["7"]
    assert entry["min_x"] == pytest.approx(-5.0)
    with pytest.raises(UserError, match="obj_000008"):
        dataset.mesh(8)


def test_symmetries_are_kept_and_errors_told_up_to_them(tmp_path: Path) -> None:
    half = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
    told = {
        1: ModelSymmetry(half),
        2: ModelSymmetry(axes=((0.0, 0.0, 1.0),)),
        4: ModelSymmetry(axes=((0, 0, 1), (1, 0, 0))),
    }
    write_models(tmp_path, dict.fromkeys((1, 2, 3, 4), trimesh.creation.box((0.1, 0.1, 0.2))), told)
    write_scene(tmp_path, "test", 0, [random_frame(np.random.default_rng(0), 0)])
    read = {obj_id: info.symmetry for obj_id, info in open_dataset(tmp_path).models.items()}
    assert np.allclose(read[1].rotations, half)
    R = Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    spin, tilt = (Rotation.from_euler(axis, 40, degrees=True).as_matrix() for axis in "zx")
    off_deg = {obj_id: np.rad2deg([s.error_rad(R @ T, R) for T in (spin, tilt, half[1])]) for obj_id, s in read.items()}
    assert off_deg[1] == pytest.approx([40, 40, 0], abs=1e-5)
    assert off_deg[2] == pytest.approx([0, 40, 0], abs=1e-5)
    assert off_deg[3] == pytest.approx([40, 40, 180], abs=1e-5)
    assert off_deg[4] == pytest.approx([0, 0, 0])


def test_targets_file_is_read_where_there_is_one(frames: list[Frame], tmp_path: Path) -> None:
    write_scene(tmp_path, "test", 0, frames)
    wanted = (Target(ImageKey(0, 36), 5, 1),)
    write_targets(tmp_path, "test", wanted)
    assert open_dataset(tmp_path).targets == wanted


def test_pictures_may_be_grey_or_jpeg_and_depth_absent(frames: list[Frame], tmp_path: Path) -> None:
    import cv2

    write_scene(tmp_path, "val", 3, frames[:1])
    folder = tmp_path / "val/000003"
    (folder / "rgb/000001.png").unlink()
    (folder / "depth/000001.png").unlink()
    (folder / "gray").mkdir()
    grey = np.full((48, 64), 77, np.uint8)
    cv2.imwrite(str(folder / "gray/000001.jpg"), grey)
    dataset = open_dataset(tmp_path)
    assert dataset.split == "val"
    assert np.abs(dataset.rgb(dataset.images[0]).astype(int) - 77).max() <= 2
    assert dataset.depth_m(dataset.images[0]) is None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("{", "scene_gt.json is not valid JSON"),
        ('{"1": [{"cam_R_m2c": [1], "cam_t_m2c": [0, 0, 1], "obj_id": 1}]}', "cam_R_m2c must be 9 finite numbers"),
        ('{"1": [{"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "obj_id": 1}]}', "cam_t_m2c"),
        ('{"1": []}', "tells of 0 objects, gt_info of 2"),
    ],
)
def test_damaged_truth_is_named(damage: str, message: str, frames: list[Frame], tmp_path: Path) -> None:
    write_scene(tmp_path, "test", 0, frames)
    (tmp_path / "test/000000/scene_gt.json").write_text(damage)
    if "gt_info" not in message:
        (tmp_path / "test/000000/scene_gt_info.json").unlink()
    with pytest.raises(UserError, match=message):
        open_dataset(tmp_path).objects(ImageKey(0, 1))


def test_what_is_no_data_set_is_refused(tmp_path: Path) -> None:
    for folder, message in ((tmp_path / "gone", "does not exist"), (tmp_path, "no folder test, val")):
        with pytest.raises(UserError, match=message):
            open_dataset(folder)
    (tmp_path / "test").mkdir()
    with pytest.raises(UserError, match="unpack"):
        open_dataset(tmp_path)
    with pytest.raises(UserError, match="no folder val;"):
        open_dataset(tmp_path, "val")


@settings(max_examples=100, deadline=None)
@given(arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_run_length_coding_is_exact(mask: np.ndarray) -> None:
    coded = rle_from_mask(mask)
    assert np.array_equal(mask_from_rle(coded), mask)
    # The oracle walks down the columns, as COCO's coding is defined.
    counts, value = [0], False
    for pixel in mask.T.ravel():
        if bool(pixel) != value:
            counts.append(0)
            value = not value
        counts[-1] += 1
    assert coded == {"counts": counts, "size": list(mask.shape)}


def packed(counts: list[int]) -> str:
    """COCO's text, bit by bit: five at a time, lowest first, a sixth tells that more follow, 48 is added."""
    text = ""
    for k, count in enumerate(counts):
        value = count - (counts[k - 2] if k > 2 else 0)
        while True:
            bits, value = value & 31, value >> 5
            last = value == (-1 if bits & 16 else 0)
            text += chr(bits + (0 if last else 32) + 48)
            if last:
                break
    return text


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=9))
def test_lengths_packed_as_coco_does_are_read(counts: list[int]) -> None:
    size = [1, sum(counts)]
    assert np.array_equal(
        mask_from_rle({"counts": packed(counts), "size": size}), mask_from_rle({"counts": counts, "size": size})
    )


def test_runs_that_do_not_fill_the_picture_are_refused() -> None:
    for coded in ({"counts": [3], "size": [2, 2]}, {"counts": "3", "size": [2, 2]}, {}):
        with pytest.raises(UserError, match="here"):
            mask_from_rle(coded, "here")


def test_results_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    own = Estimate(ImageKey(3, 7), 2, 0.25, make_pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)), 1.5)
    other = Estimate(ImageKey(3, 8), 0, 0.5, make_pose(t=rng.normal(size=3)), None, "library:mug:3", 0.12)
    for estimates in ([own], [own, other]):
        write_results(tmp_path / "results.csv", estimates)
        found = read_results(tmp_path / "results.csv")
        for a, b in zip(estimates, found, strict=True):
            assert np.allclose(a.T_camera_object, b.T_camera_object, atol=1e-12)
            assert (a.image, a.obj_id, a.score, a.time_s, a.mesh, a.size_m) == (
                *(b.image, b.obj_id, b.score, b.time_s, b.mesh, b.size_m),
            )
    assert (tmp_path / "results.csv").read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time,mesh,size_m"


def test_a_line_of_the_benchmark_s_is_read_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{GOOD_LINE}\n\n")
    (estimate,) = read_results(path)
    assert estimate.image == ImageKey(3, 7)
    assert np.allclose(estimate.T_camera_object, make_pose(t=(0.01, -0.02, 0.8)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3,7", "x,7", "line 3: scene_id is 'x'"),
        ("0.5,", "nan,", "line 3: score"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0", "line 3: R is .*give 9 finite numbers"),
        ("1 0 0 0 1 0 0 0 1", "2 0 0 0 1 0 0 0 1", "line 3: R is not a rotation"),
        ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 -1", "line 3: R is not a rotation"),
        ("10 -20 800", "10 -20 inf", "line 3: t is"),
        (",1.5", "", "line 3 has 6 columns, the first line 7"),
    ],
)
def test_a_bad_line_is_named_with_its_file(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    bad = GOOD_LINE.replace(old, new)
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{GOOD_LINE}\n{bad}\n")
    with pytest.raises(UserError, match=rf"bad\.csv, {message}"):
        read_results(path)


def test_missing_columns_and_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text("scene_id,im_id,obj_id,score,R,time\n")
    with pytest.raises(UserError, match="line 1: columns t are missing"):
        read_results(path)
    with pytest.raises(UserError, match=r"gone\.csv cannot be read"):
        read_results(tmp_path / "gone.csv")
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time,mesh,size_m\n{GOOD_LINE},mug.ply,-1\n")
    with pytest.raises(UserError, match="line 2: size_m is -1"):
        read_results(path)


def test_the_authors_own_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "freepose.csv"
    line = "3,7,0a1b,0.5,1 0 0 0 1 0 0 0 1,10 -20 800,4 5 30 40,0.06,-1"
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,bbox_visib,scale,time\n{line}\n")
    (estimate,) = read_results(path)
    assert (estimate.mesh, estimate.size_m, estimate.obj_id) == ("0a1b/0a1b.obj", 0.12, 0)
    assert np.allclose(estimate.T_camera_object, make_pose(t=(0.01, -0.02, 0.8)))
    path.write_text(path.read_text().replace("0.06", "half"))
    with pytest.raises(UserError, match="line 2: scale is 'half'"):
        read_results(path)


def test_diameter_is_the_largest_distance() -> None:
    points = np.random.default_rng(2).normal(size=(300, 3))
    assert diameter(points) == pytest.approx(pdist(points).max())


def test_box_is_around_the_mask() -> None:
    mask = np.zeros((6, 8), bool)
    assert box_of(mask) == [-1, -1, -1, -1]
    mask[2:4, 3:7] = True
    assert box_of(mask) == [3, 2, 4, 2]
