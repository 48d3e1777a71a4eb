"""All objects of a picture: meshes, sizes, poses, and what the command leaves on disk."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from vid2demo.cli import main
from vid2demo.extract.bop import open_dataset
from vid2demo.extract.bop_pose import category_ranks, pose_dataset
from vid2demo.extract.bop_results import read_results
from vid2demo.extract.bop_write import Frame, Instance, write_models, write_scene
from vid2demo.extract.classical_segment import ClassicalSegmenter
from vid2demo.extract.errors import UserError
from vid2demo.extract.features import ClassicalFeatures, features_of
from vid2demo.extract.geometry import invert_pose, look_at, make_pose
from vid2demo.extract.image_pose import ANY_SIZE_M, ImagePoser, PoseSettings
from vid2demo.extract.mesh_sources import find_sources, library_sources
from vid2demo.extract.mesh_store import About, MeshStore
from vid2demo.extract.onboarding import onboard, read_source
from vid2demo.extract.protocols import Proposal, Segmenter
from vid2demo.extract.segment import mask_box
from vid2demo.extract.shading import render_picture
from vid2demo.extract.templates import ViewSettings
from vid2demo.extract.video import VideoWriter

CAMERA = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
T_CAMERA_TABLE = invert_pose(look_at(np.array([0.0, -0.8, 0.45]), np.array([0.0, 0.0, 0.05]), np.array([0, 0, 1.0])))
SHOWN = {"saucepan": (-0.18, 0.0), "bottle": (0.15, 0.05)}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three vessels in 100 views; none of them is in the picture."""
    folder = tmp_path_factory.mktemp("database") / "db"
    sources = [s for s in library_sources(1) if s.category in (*SHOWN, "mug")]
    onboard(sources, folder, settings=ViewSettings(count=100))
    return folder


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A picture of two other variants on a plain table; their masks and poses."""
    rgb = np.full((480, 640, 3), (150, 120, 90), np.uint8)
    masks, poses = {}, {}
    for name, (x, y) in SHOWN.items():
        mesh, size = vessel(name)
        T = T_CAMERA_TABLE @ make_pose(None, (x, y, size[2] / 2))
        picture = render_picture(mesh.vertices, mesh.faces, mesh.colors, T, CAMERA, (640, 480))
        rgb[picture.mask] = picture.rgb[picture.mask]
        masks[name], poses[name] = picture.mask, T
    return rgb, masks, poses


def vessel(name: str):  # type: ignore[no-untyped-def]
    stored = read_source(next(s for s in library_sources(4) if s.name == f"{name}:3"))
    return stored.mesh.scaled(max(stored.about.extents_m) / 2), np.array(stored.about.extents_m)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.count_nonzero(a & b) / np.count_nonzero(a | b))


def test_two_objects_of_a_picture_are_named_and_placed(root: Path, scene) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, _ = scene
    poser = ImagePoser(MeshStore.open(root), ClassicalFeatures())
    nothing = Proposal(np.zeros((480, 640), bool), (0.0, 0.0, 0.0, 0.0), 1.0)
    proposals = [nothing, *(Proposal(masks[name], mask_box(masks[name]), 1.0) for name in SHOWN)]
    found = poser.pose(rgb, proposals, CAMERA)
    assert [pose.hit.about.category for pose in found] == list(SHOWN)  # what shows nothing is left out
    for pose, name in zip(found, SHOWN, strict=True):
        mesh = poser.mesh(pose.hit.key).mesh.scaled(pose.size_m / 2)
        drawn = render_picture(mesh.vertices, mesh.faces, mesh.colors, pose.T_camera_object, CAMERA, (640, 480)).mask
        assert iou(drawn, masks[name]) > 0.7
        assert 0.05 < pose.size_m < 0.6
        assert len(pose.others) == 2


def test_known_sizes_set_the_distance(root: Path, scene) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, poses = scene
    poser = ImagePoser(MeshStore.open(root), ClassicalFeatures(), PoseSettings(meshes=1))
    proposals = [Proposal(masks["bottle"], mask_box(masks["bottle"]), 1.0)]
    true_m = float(vessel("bottle")[1].max())
    (near,), (far,) = (poser.pose(rgb, proposals, CAMERA, sizes_m=[size]) for size in (true_m, 2 * true_m))
    # A bottle of another shape, leaning or not, fills the same box within a third.
    assert near.T_camera_object[2, 3] == pytest.approx(poses["bottle"][2, 3], rel=0.33)
    assert far.T_camera_object[2, 3] == pytest.approx(2 * near.T_camera_object[2, 3], rel=0.05)


def test_the_size_table_overrules_a_mesh_of_an_unlikely_size(root: Path) -> None:
    poser = ImagePoser(MeshStore.open(root), ClassicalFeatures())
    likely = About("a", "mug", "a.glb", (0.0, 0.0, 0.0), 0.06, "m", (0.12, 0.09, 0.1), 10)
    assert poser.size_of(likely) == (0.12, "the mesh")
    size, source = poser.size_of(replace(likely, extents_m=(2.0, 1.5, 1.8)))
    assert 0.05 < size < 0.25
    assert "size table" in source
    assert poser.size_of(replace(likely, unit="", extents_m=(0.0, 0.0, 0.0)))[0] == size
    unknown = replace(likely, category="zorblax", name="zorblax", extents_m=(0.0, 0.0, 0.0))
    assert poser.size_of(unknown)[0] == ANY_SIZE_M


def test_a_person_s_word_selects_the_size(root: Path) -> None:
    poser = ImagePoser(MeshStore.open(root), ClassicalFeatures())
    sizeless = About("a", "zorblax", "a.glb", (0.0, 0.0, 0.0), 0.06, "", (0.0, 0.0, 0.0), 10)
    assert poser.size_of(sizeless, "my blue coffee mugs") == poser.size_of(replace(sizeless, category="mug"))
    # A word that the table does not know leaves the mesh's category to tell.
    mug = replace(sizeless, category="mug")
    assert poser.size_of(mug, "frobnicator") == poser.size_of(mug)
    # A mesh that knows its size is believed within the word's range, not beyond it.
    large = replace(sizeless, unit="m", extents_m=(0.12, 0.1, 0.1))
    assert poser.size_of(large, "mug") == (0.12, "the mesh")
    assert poser.size_of(large, "wardrobe")[0] > 1.0


def test_things_on_a_plain_table_are_found(scene) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, _ = scene
    segmenter = ClassicalSegmenter()
    assert isinstance(segmenter, Segmenter)
    proposals = segmenter.propose(rgb)
    for mask in masks.values():  # what comes after them are parts of theirs, or of the table
        assert max(iou(p.mask, mask) for p in proposals[:3]) > 0.8
    boxes = [mask_box(mask) for mask in masks.values()]
    assert min(iou(cut, mask) for cut, mask in zip(segmenter.segment(rgb, boxes), masks.values(), strict=True)) > 0.8
    assert segmenter.propose(np.full((6, 6, 3), 90, np.uint8)) == []


def test_masks_are_carried_and_what_has_gone_stays_empty(scene) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, _ = scene
    moved = [np.roll(rgb, 4 * k, axis=1) for k in range(4)]
    start = [masks["bottle"], np.zeros_like(masks["bottle"])]
    carried = list(ClassicalSegmenter().propagate(iter(moved), start))
    assert len(carried) == 4
    np.testing.assert_array_equal(carried[0], start)
    assert iou(carried[3][0], np.roll(masks["bottle"], 12, axis=1)) > 0.8
    assert not carried[3][1].any()


def test_the_command_writes_poses_meshes_and_a_picture(root: Path, scene, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, _ = scene
    cv2.imwrite(str(tmp_path / "table.png"), rgb[..., ::-1])
    cv2.imwrite(str(tmp_path / "mask.png"), masks["bottle"].astype(np.uint8) * 255)
    box = [str(round(v)) for v in mask_box(masks["saucepan"])]
    out = tmp_path / "out"
    words = ["pose", str(tmp_path / "table.png"), "--db", str(root), "--out", str(out), "--level", "classical"]
    camera = ["--camera", "600", "600", "320", "240"]
    assert main([*words, *camera, "--mask", str(tmp_path / "mask.png"), "--box", *box]) == 0
    told = json.loads((out / "poses.json").read_text())
    assert [found["category"] for found in told["objects"]] == ["bottle", "saucepan"]
    for found, estimate in zip(told["objects"], read_results(out / "poses.csv"), strict=True):
        np.testing.assert_allclose(found["T_camera_object"], estimate.T_camera_object, atol=1e-6)
        mesh = trimesh.load_mesh(out / found["mesh"])
        assert max(mesh.extents) == pytest.approx(found["size_m"], rel=1e-3)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-4)
    assert cv2.imread(str(out / "overlay.png")).shape == rgb.shape


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--box", "700", "10", "50", "50"], "less than 8 x 8 px"),
        (["--camera", "0", "600", "320", "240"], "is no camera"),
        (["--box", "60", "200", "200", "150", "--object", "bicycle"], "no mesh of the database"),
        (["--mask", "nowhere.png"], "does not exist"),
        (["--encoder", "dinov2"], "none that fit"),
        (["--level", "foundation"], "no weights"),
    ],
)
def test_bad_input_is_told_in_a_sentence(
    root: Path, scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], told: str
) -> None:  # type: ignore[no-untyped-def]
    cv2.imwrite(str(tmp_path / "table.png"), scene[0][..., ::-1])
    words = ["pose", str(tmp_path / "table.png"), "--db", str(root), "--out", str(tmp_path / "out")]
    assert main([*words, "--models-dir", str(tmp_path), *more]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_empty_picture_asks_for_a_box(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((120, 160, 3), 128, np.uint8))
    words = ["pose", str(tmp_path / "grey.png"), "--db", str(root), "--out", str(tmp_path / "out")]
    assert main([*words, "--level", "classical"]) == 2
    assert "--box" in capsys.readouterr().err


def test_a_database_of_unknown_features_is_told() -> None:
    with pytest.raises(UserError, match="not known"):
        features_of("oracle-7")


def test_a_network_fills_a_database_and_reads_it(tiny_models: Path, scene, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """The paper's encoder, here a tiny random one, through the same commands."""
    rgb, masks, _ = scene
    folder = ["--models-dir", str(tiny_models)]
    (tmp_path / "in").mkdir()
    trimesh.creation.box([0.1, 0.1, 0.2]).export(tmp_path / "in" / "box.ply")
    words = ["meshes", "onboard", str(tmp_path / "in"), "--out", str(tmp_path / "db"), "--views", "5"]
    assert main([*words, "--features", "dinov2-small", "--block", "2", *folder]) == 0
    store = MeshStore.open(tmp_path / "db", "dinov2")
    assert "block2" in store.encoder
    assert store.check() == []
    features = features_of(store.encoder, {"models_dir": str(tiny_models)})
    proposals = [Proposal(masks["bottle"], mask_box(masks["bottle"]), 1.0)]
    (pose,) = ImagePoser(store, features, PoseSettings(fine=False)).pose(rgb, proposals, CAMERA)
    assert pose.hit.about.name == "box"
    assert np.isfinite(pose.T_camera_object).all()


def test_a_data_set_is_posed_with_retrieved_and_with_true_meshes(root: Path, scene, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    rgb, masks, poses = scene
    objects = dict(enumerate(SHOWN, start=1))
    models = {}
    for obj_id, name in objects.items():
        mesh, _ = vessel(name)
        models[obj_id] = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        models[obj_id].apply_translation([0.01, 0.02, 0.03])  # origins of models are where they please
    write_models(tmp_path, models)
    offset = make_pose(None, (-0.01, -0.02, -0.03))
    instances = [Instance(k, poses[name] @ offset, masks[name], masks[name]) for k, name in objects.items()]
    write_scene(tmp_path, "test", 0, [Frame(0, rgb, np.ones(rgb.shape[:2], np.float32), CAMERA, tuple(instances))])
    dataset = open_dataset(tmp_path)

    found = pose_dataset(dataset, ImagePoser(MeshStore.open(root), ClassicalFeatures()), tmp_path / "own.csv")
    assert category_ranks(found, objects) == [0, 0]
    own = read_results(tmp_path / "own.csv")
    assert [e.mesh for e in own] == ["library:saucepan:0", "library:bottle:0"]
    assert all(e.size_m for e in own)

    onboard(find_sources(tmp_path / "models"), tmp_path / "true", settings=ViewSettings(count=100))
    poser = ImagePoser(MeshStore.open(tmp_path / "true"), ClassicalFeatures())
    pose_dataset(dataset, poser, tmp_path / "true.csv", meshes="true", sizes="true")
    for estimate, name in zip(read_results(tmp_path / "true.csv"), SHOWN, strict=True):
        mesh = models[estimate.obj_id]
        drawn = render_picture(
            mesh.vertices, mesh.faces.astype(np.int32), np.zeros((len(mesh.vertices), 3), np.uint8),
            estimate.T_camera_object, CAMERA, (640, 480),
        ).mask  # fmt: skip
        assert iou(drawn, masks[name]) > 0.8
    with pytest.raises(UserError, match="no obj_000001"):
        pose_dataset(dataset, ImagePoser(MeshStore.open(root), ClassicalFeatures()), tmp_path / "x.csv", meshes="true")


def test_a_video_finds_the_mesh_it_shows(root: Path, scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    """Half-way the object is hidden for good; the frames that still show it vote."""
    rgb, masks, _ = scene
    video = tmp_path / "clip.mp4"
    with VideoWriter(video, 10.0) as writer:
        for k in range(8):
            frame = np.roll(rgb, 5 * k, axis=1)
            frame[:, : 400 if k >= 6 else 0] = (150, 120, 90)
            writer.write(frame)
    box = [str(round(v)) for v in mask_box(masks["saucepan"])]
    words = ["meshes", "find", str(video), "--db", str(root), "--level", "classical", "--frames", "4", "--json"]
    assert main([*words, "--box", *box]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["meshes"][0]["category"] == "saucepan"
    assert len(told["meshes"]) == 3
    assert set(told["frames"]) <= {0, 2, 5, 7}
    assert len(told["frames"]) >= 2
    assert main([*words]) == 2
    assert "either --box" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("words", [["pose", "gone.png", "--out", "o"], ["meshes", "find", "gone.mp4"]])
def test_a_missing_picture_is_told_before_the_library_is_made(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VID2DEMO_LIBRARY", str(tmp_path / "library"))
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "library").exists()


@pytest.mark.slow
def test_without_a_database_the_vessels_that_ship_are_one(
    scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # type: ignore[no-untyped-def]
    few = [s for s in library_sources(1) if s.category == "bottle"]
    monkeypatch.setattr("vid2demo.extract.mesh_sources.library_sources", lambda variants: few)
    monkeypatch.setenv("VID2DEMO_LIBRARY", str(tmp_path / "library"))
    cv2.imwrite(str(tmp_path / "table.png"), scene[0][..., ::-1])
    box = [str(round(v)) for v in mask_box(scene[1]["bottle"])]
    words = ["pose", str(tmp_path / "table.png"), "--out", str(tmp_path / "out"), "--level", "classical", "--box", *box]
    assert main(words) == 0
    assert capsys.readouterr().out.count("bottle:0") == 1
    made = {p: p.stat().st_mtime_ns for p in (tmp_path / "library").rglob("*.npy")}
    assert main(words) == 0
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "library").rglob("*.npy")} == made
