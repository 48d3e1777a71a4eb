"""The commands with every network of the paper at once, tiny and random: what they find is arbitrary."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from vid2demo.cli import main
from vid2demo.extract.find_mesh import SizeMeans, size_over_frames
from vid2demo.extract.neural_depth import NeuralDepth
from vid2demo.extract.neural_segment import NeuralSegmenter
from vid2demo.extract.neural_words import NeuralWords
from vid2demo.extract.scale import SizeReader
from vid2demo.extract.segment import mask_box
from vid2demo.extract.templates import ViewSettings
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.video import VideoWriter
from vid2demo.extract.video_pose import Means

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may


def test_every_network_of_the_paper_takes_its_part_in_a_pose(
    tiny_models: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tiny random ones, through the commands: what they find is arbitrary, that they are asked is not."""
    models = ["--models-dir", str(tiny_models)]
    (tmp_path / "in").mkdir()
    trimesh.creation.box([0.1, 0.1, 0.2]).export(tmp_path / "in" / "box.ply")
    words = ["meshes", "onboard", str(tmp_path / "in"), "--out", str(tmp_path / "db"), "--views", "5"]
    assert main([*words, "--features", "dinov2-small", *models]) == 0
    picture = np.full((120, 160, 3), 200, np.uint8)
    picture[30:90, 40:80] = picture[40:100, 100:140] = (90, 40, 30)
    cv2.imwrite(str(tmp_path / "table.png"), picture)
    boxes = ["--box", "38", "28", "44", "64", "--box", "98", "38", "44", "64"]
    where = ["--db", str(tmp_path / "db"), "--encoder", "dinov2", "--out", str(tmp_path / "out")]
    capsys.readouterr()
    assert main(["pose", str(tmp_path / "table.png"), *where, *boxes, "--level", "foundation", *models]) == 0
    told = json.loads((tmp_path / "out/poses.json").read_text())
    assert "grounding-dino-tiny and sam2-small" in told["segmenter"]
    assert "zoedepth" in told["size"]
    assert "clip-large" in told["size"]
    assert told["encoder"].startswith("dinov2-small-block3-420px-")
    assert told["objects"]
    for found in told["objects"]:
        assert np.isfinite(found["T_camera_object"]).all()
        assert found["size_m"] >= 0.01
    assert list(tiny_models.glob("texts-*.npy"))


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red box that slides past a blue one, its mesh, and its mask in the first frame."""
    folder = tmp_path_factory.mktemp("clip")
    (folder / "in").mkdir()
    trimesh.creation.box([0.1, 0.1, 0.2]).export(folder / "in" / "box.ply")
    with VideoWriter(folder / "clip.mp4", 25.0, crf=10) as writer:
        for k in range(5):
            picture = np.full((96, 128, 3), 200, np.uint8)
            picture[20:70, 20 + 2 * k : 50 + 2 * k] = (180, 40, 30)
            picture[40:80, 85:115] = (30, 50, 160)
            writer.write(picture)
    mask = np.zeros((96, 128), np.uint8)
    mask[20:70, 20:50] = 255
    cv2.imwrite(str(folder / "mask.png"), mask)
    return folder


def test_every_network_takes_its_part_in_finding_a_mesh_in_a_video(
    tiny_models: Path, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = ["--models-dir", str(tiny_models)]
    words = ["meshes", "onboard", str(clip / "in"), "--out", str(tmp_path / "db"), "--views", "5"]
    assert main([*words, "--features", "dinov2-small", *models]) == 0
    capsys.readouterr()
    asked = ["meshes", "find", str(clip / "clip.mp4"), "--db", str(tmp_path / "db"), "--mask", str(clip / "mask.png")]
    assert main([*asked, "--level", "foundation", "--json", *models]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [mesh["name"] for mesh in told["meshes"]] == ["box"]
    assert "grounding-dino-tiny and sam2-small" in told["segmenter"]
    assert "zoedepth" in told["size"]
    assert "clip-large" in told["size"]
    assert told["size_m"] >= 0.01


def test_the_size_of_a_video_is_the_median_of_its_frames(tiny_models: Path) -> None:
    made = {"models_dir": tiny_models, "device": "cpu"}
    segmenter, depth = NeuralSegmenter("grounding-dino-tiny", "sam2-small", **made), NeuralDepth("zoedepth", **made)
    means = SizeMeans(SizeReader(NeuralWords("clip-large", **made)), depth)
    rng = np.random.default_rng(0)
    shown = []
    for _ in range(3):
        mask = np.zeros((96, 128), bool)
        x, y = rng.integers(10, 40, 2)
        mask[y : y + 45, x : x + 40] = True
        rgb = rng.integers(0, 255, (96, 128, 3), np.uint8)
        shown.append((rgb, mask))

    class Alone(NeuralSegmenter):
        """Nothing else is found."""

        def propose(self, rgb, prompt="objects."):  # type: ignore[no-untyped-def]
            return []

    alone = Alone("grounding-dino-tiny", "sam2-small", **made)
    each = [means.words.guess(rgb, [mask], [mask_box(mask)])[0].size_m for rgb, mask in shown]
    assert size_over_frames(shown, alone, means) == pytest.approx(np.median(each))
    assert size_over_frames(shown, segmenter, means) >= 0.01


def test_a_video_is_followed_with_networks_for_all_but_the_points(
    tiny_models: Path, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CoTracker cannot be had in miniature; the classical points stand in, as --level auto has it."""
    monkeypatch.setenv("VID2DEMO_TEMPLATES", str(tmp_path / "templates"))
    monkeypatch.setattr("vid2demo.extract.video_pose.Means", partial(Means, views=ViewSettings(count=20)))
    words = ["extract", str(clip / "clip.mp4"), "--object", "box", "--mesh", str(clip / "in" / "box.ply")]
    words += ["--mesh-unit", "m", "--mask", str(clip / "mask.png"), "--out", str(tmp_path / "out")]
    assert main([*words, "--method", "freepose", "--models-dir", str(tiny_models)]) == 0
    track = ObjectTrack.load(tmp_path / "out" / "box.track.npz")
    assert len(track) == 5
    assert np.isfinite(track.T_camera_object).all()
    means = track.header["settings"]["means"]
    assert means["features"]["models"] == ["dinov2-small"]
    assert means["segmenter"]["models"] == ["grounding-dino-tiny", "sam2-small"]
    assert means["tracks"]["level"] == "classical"
