from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo import cli
from vid2demo.extract.bop import Dataset, ImageKey, ModelSymmetry, Target, open_dataset
from vid2demo.extract.bop_eval import evaluate, find_mesh, targets_of
from vid2demo.extract.bop_results import Estimate, write_results
from vid2demo.extract.bop_write import Frame, Instance, write_models, write_scene, write_targets
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose
from vid2demo.extract.raster import render_depth

SIZE = (160, 120)
CAMERA = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
MODELS = {
    1: trimesh.creation.box((0.06, 0.08, 0.12)).subdivide().subdivide(),
    2: trimesh.creation.cylinder(0.03, 0.1, sections=32).subdivide(),
}
POSES = {
    1: make_pose(Rotation.from_euler("xyz", [0.5, 0.4, 0.3]).as_matrix(), np.array([-0.1, 0.0, 0.7])),
    2: make_pose(Rotation.from_euler("xyz", [1.2, 0.1, 0.7]).as_matrix(), np.array([0.1, 0.02, 0.6])),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("set")
    write_models(folder, MODELS, {2: ModelSymmetry(axes=((0.0, 0.0, 1.0),))})
    write_scene(folder, "test", 3, frames())
    write_targets(folder, "test", [Target(ImageKey(3, k), obj_id, 1) for k in (0, 5) for obj_id in (1, 2)])
    return open_dataset(folder)


def frames() -> list[Frame]:
    """Two equal pictures of both objects."""
    instances = []
    for obj_id, T in POSES.items():
        window = render_depth(MODELS[obj_id].vertices, np.asarray(MODELS[obj_id].faces, np.int32), T, CAMERA)
        assert window is not None
        mask = window.mask_in_image(*SIZE)
        instances.append(Instance(obj_id, T, mask, mask))
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    return [Frame(k, picture, np.ones(SIZE[::-1], np.float32), CAMERA, tuple(instances)) for k in (0, 5)]


def perfect(dataset: Dataset) -> list[Estimate]:
    return [
        Estimate(image, there.obj_id, 0.9, there.T_camera_object, 0.4)
        for image in dataset.images
        for there in dataset.objects(image)
    ]


@pytest.mark.parametrize("protocol", ["official", "paper"])
def test_the_truth_itself_has_full_marks(protocol: str, dataset: Dataset) -> None:
    scores = evaluate(dataset, perfect(dataset), protocol=protocol)  # type: ignore[arg-type]
    assert (scores.ar, scores.ar_cou, scores.ar_ch, scores.ar_pch) == (100, 100, 100, 100)
    assert (scores.targets, scores.estimates, scores.images, scores.matched) == (4, 4, 2, 4)
    assert scores.scale_error_percent == pytest.approx(0, abs=1e-6)
    assert scores.adds_m == pytest.approx(0, abs=1e-9)
    assert scores.rotation_deg == pytest.approx(0, abs=1e-4)
    assert scores.seconds_per_image == pytest.approx(0.4)


def test_no_estimates_have_no_marks(dataset: Dataset) -> None:
    scores = evaluate(dataset, [])
    assert (scores.ar, scores.targets, scores.matched, scores.scale_error_percent) == (0, 4, 0, None)


def test_half_the_objects_give_half_the_recall(dataset: Dataset) -> None:
    assert evaluate(dataset, perfect(dataset)[:2]).ar == pytest.approx(50)
    boxes = evaluate(dataset, [e for e in perfect(dataset) if e.obj_id == 1]).by_object
    assert boxes["1"] == {"targets": 2, "ar_cou": 100, "ar_ch": 100, "ar_pch": 100}
    assert boxes["2"]["ar_ch"] == 0


def test_the_layout_of_the_files_does_not_matter(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.root / "models", tmp_path / "models")
    write_scene(tmp_path, "test", 3, frames(), "images")
    other = open_dataset(tmp_path)
    assert other.layout == "images"
    scores = evaluate(other, [replace(e, score=0.1) for e in perfect(dataset)])
    assert (scores.ar, scores.targets) == (100, 4)


def test_spurious_estimates_cost_nothing_officially_and_wrong_names_do_not_matter(dataset: Dataset) -> None:
    swapped = [replace(e, obj_id=3 - e.obj_id) for e in perfect(dataset)]
    both = [*perfect(dataset), *swapped]
    assert evaluate(dataset, both).ar == 100
    # A cylinder where the box is: the paper's protocol does not try it on the box at all.
    assert evaluate(dataset, swapped, protocol="paper").ar < evaluate(dataset, swapped).ar < 100


def test_another_mesh_of_the_same_shape_and_size_is_as_good(dataset: Dataset, tmp_path: Path) -> None:
    moved = MODELS[1].copy()
    moved.apply_scale(17.0)  # a file of unknown unit and origin
    moved.apply_translation([3.0, 1.0, 2.0])
    moved.export(tmp_path / "box.ply")
    estimates = [replace(e, obj_id=0, mesh="box.ply", size_m=0.12) for e in perfect(dataset) if e.obj_id == 1]
    scores = evaluate(dataset, estimates, folders=(tmp_path,))
    assert scores.ar == pytest.approx(50)
    assert scores.scale_error_percent == pytest.approx(0, abs=1e-3)
    assert scores.adds_m is None
    larger = [replace(e, size_m=0.15) for e in estimates]
    assert evaluate(dataset, larger, folders=(tmp_path,)).scale_error_percent == pytest.approx(25, abs=1e-3)


def test_categories_are_judged_where_the_data_set_tells_them(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.root, tmp_path / "set")
    (tmp_path / "set/categories.json").write_text('{"1": "box", "2": "can"}')
    box = {"name": "box", "category": "box", "file": "box.ply"}
    mug = {"name": "mug_3", "category": "mug", "file": "mug.ply", "library": {"category": "mug", "seed": 3}}
    (tmp_path / "set/database.json").write_text(json.dumps([box, mug]))
    MODELS[1].export(tmp_path / "box.ply")
    meshes = {1: "box.ply", 2: "library:mug:3"}
    estimates = [replace(e, mesh=meshes[e.obj_id], size_m=0.1) for e in perfect(dataset)]
    told = evaluate(open_dataset(tmp_path / "set"), estimates, folders=(tmp_path,)).category_percent
    assert told == pytest.approx(50)
    assert evaluate(dataset, estimates, folders=(tmp_path,)).category_percent is None


def test_rotation_is_judged_up_to_symmetry(dataset: Dataset) -> None:
    turned = []
    for e in perfect(dataset):
        spin = make_pose(Rotation.from_euler("z", 90 if e.obj_id == 2 else 10, degrees=True).as_matrix())
        turned.append(replace(e, T_camera_object=e.T_camera_object @ spin))
    errors = {obj_id: evaluate(dataset, [e for e in turned if e.obj_id == obj_id]).rotation_deg for obj_id in MODELS}
    assert errors == pytest.approx({1: 10, 2: 0}, abs=1e-4)


def test_targets_are_the_most_visible(dataset: Dataset, tmp_path: Path) -> None:
    objects = [
        replace(dataset.objects(dataset.images[0])[0], index=k, visible_fraction=v) for k, v in enumerate((0.2, 0.9))
    ]
    instances = tuple(
        Instance(
            1, o.T_camera_object, np.ones((10, 10), bool), np.arange(100).reshape(10, 10) < 100 * o.visible_fraction
        )
        for o in objects
        if o.visible_fraction is not None
    )
    picture = np.zeros((10, 10, 3), np.uint8)
    write_scene(tmp_path, "test", 0, [Frame(0, picture, np.ones((10, 10), np.float32), CAMERA, instances)])
    write_targets(tmp_path, "test", [Target(ImageKey(0, 0), 1, 1)])
    ((chosen,),) = targets_of(open_dataset(tmp_path)).values()
    assert chosen.index == 1


def test_library_vessels_and_files_are_found_by_name(tmp_path: Path) -> None:
    from vid2demo.extract.vessels import make_vessel

    assert np.array_equal(find_mesh("library:mug:3", ()).vertices, make_vessel("mug", 3).mesh.vertices)
    for name, message in (
        ("library:mug:x", "whole number"),
        ("gone.ply", "name its --meshes"),
        ("library:fork:1", "fork"),
    ):
        with pytest.raises(UserError, match=message):
            find_mesh(name, (tmp_path,))


def test_strange_estimates_are_named(dataset: Dataset) -> None:
    (first, *_) = perfect(dataset)
    with pytest.raises(UserError, match="scene 9, image 0"):
        evaluate(dataset, [replace(first, image=ImageKey(9, 0))])
    with pytest.raises(UserError, match="object 8"):
        evaluate(dataset, [replace(first, obj_id=8)])


def test_the_command_prints_a_table_or_json(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "results.csv", perfect(dataset))
    words = ["eval-bop", str(dataset.root), str(tmp_path / "results.csv")]
    assert cli.main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ar_cou"] == 100
    assert cli.main(words) == 0
    told = capsys.readouterr().out
    assert "100.00" in told
    assert "median scale error" in told
    assert cli.main([*words[:2], str(tmp_path / "gone.csv")]) == 2
    assert "gone.csv" in capsys.readouterr().err
