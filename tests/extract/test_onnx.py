from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from vid2demo.cli import main
from vid2demo.extract.errors import UserError
from vid2demo.extract.features import features_of
from vid2demo.extract.neural_depth import NeuralDepth
from vid2demo.extract.neural_features import NeuralPatchFeatures
from vid2demo.extract.onnx_export import export_model, metadata
from vid2demo.extract.onnx_models import OnnxDepth, OnnxPatchFeatures, open_network
from vid2demo.extract.protocols import DepthEstimator, PatchFeatures

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may

GRID = 6


@pytest.fixture(scope="module", params=["dinov2-small", "dinov3-small"])
def exported(request: pytest.FixtureRequest, tiny_models: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A patch encoder by torch, and the same one by ONNX Runtime."""
    path = tmp_path_factory.mktemp("onnx") / f"{request.param}.onnx"
    export_model(request.param, path, models_dir=tiny_models, grid=GRID, block=2)
    torch_one = NeuralPatchFeatures(request.param, grid=GRID, block=2, models_dir=tiny_models, device="cpu")
    return torch_one, OnnxPatchFeatures(path, threads=1, batch=2)


def test_onnx_features_are_those_of_torch(exported: tuple[NeuralPatchFeatures, OnnxPatchFeatures]) -> None:
    torch_one, onnx_one = exported
    assert isinstance(onnx_one, PatchFeatures)
    for name in ("crop_px", "grid", "patch_size", "summary_size"):
        assert getattr(onnx_one, name) == getattr(torch_one, name)
    assert onnx_one.name == f"{torch_one.name}-onnx"
    side = onnx_one.crop_px
    crops = np.random.default_rng(0).integers(0, 256, (5, side, side, 3), dtype=np.uint8)
    masks = np.ones(crops.shape[:3], bool)
    ours, theirs = onnx_one.encode(crops, masks), torch_one.encode(crops, masks)
    np.testing.assert_allclose(ours.patches, theirs.patches, atol=1e-4)
    np.testing.assert_allclose(ours.summary, theirs.summary, atol=1e-4)
    np.testing.assert_allclose(onnx_one.encode(crops[3:4], masks[3:4]).patches[0], ours.patches[3], atol=1e-5)
    with pytest.raises(ValueError, match="crops must be"):
        onnx_one.encode(crops[:, :10], masks)


def test_network_is_as_before_after_its_export(tiny_models: Path, tmp_path: Path) -> None:
    before = NeuralPatchFeatures("dinov2-small", grid=4, models_dir=tiny_models, device="cpu")
    crops = np.random.default_rng(1).integers(0, 256, (1, before.crop_px, before.crop_px, 3), dtype=np.uint8)
    kept = before.encode(crops, crops[..., 0] > 0).patches
    export_model("dinov2-small", tmp_path / "a.onnx", models_dir=tiny_models, grid=GRID)
    after = NeuralPatchFeatures("dinov2-small", grid=4, models_dir=tiny_models, device="cpu")
    np.testing.assert_array_equal(after.encode(crops, crops[..., 0] > 0).patches, kept)


@pytest.mark.parametrize("model", ["depth-anything-small", pytest.param("zoedepth", marks=pytest.mark.slow)])
def test_onnx_depth_is_that_of_torch(tiny_models: Path, tmp_path: Path, model: str) -> None:
    """The networks' own outputs to numerical precision; whole pictures closely, for they are resampled elsewhere."""
    import torch
    from transformers import AutoModelForDepthEstimation

    path = tmp_path / f"{model}.onnx"
    export_model(model, path, models_dir=tiny_models, picture_px=(160, 120))
    session, _ = open_network(path, "depth", 1)
    shape = session.get_inputs()[0].shape
    pixels = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    network = AutoModelForDepthEstimation.from_pretrained(tiny_models / model)
    with torch.inference_mode():
        theirs = network(pixel_values=torch.from_numpy(pixels)).predicted_depth.numpy()
    np.testing.assert_allclose(session.run(None, {"pixels": pixels})[0], theirs, rtol=1e-4, atol=1e-5)
    estimator = OnnxDepth(path, threads=1)
    assert isinstance(estimator, DepthEstimator)
    picture = np.random.default_rng(2).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    depth = estimator.estimate(picture)
    assert depth.shape == (120, 160)
    by_torch = NeuralDepth(model, models_dir=tiny_models, device="cpu").estimate(picture)
    np.testing.assert_allclose(depth, by_torch, rtol=0.02)
    assert estimator.estimate(picture[:70, :90]).shape == (70, 90)


def test_onnx_features_run_without_torch(tiny_models: Path, tmp_path: Path) -> None:
    path = tmp_path / "small.onnx"
    export_model("dinov2-small", path, models_dir=tiny_models, grid=2)
    code = f"""
import sys, numpy as np
from pathlib import Path
from vid2demo.extract.onnx_models import OnnxPatchFeatures
encoder = OnnxPatchFeatures(Path({str(path)!r}), threads=1)
found = encoder.encode(np.zeros((1, 28, 28, 3), np.uint8), np.ones((1, 28, 28), bool))
print(found.patches.shape, "torch" in sys.modules, "transformers" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.strip() == "(1, 2, 2, 32) False False", done.stderr


def test_an_exported_encoder_fills_a_database_and_poses_by_it(tiny_models: Path, tmp_path: Path) -> None:
    """Its .onnx file names it where meshes are taken in; later it is found by what the database says."""
    models = tmp_path / "models"
    models.mkdir()
    path = models / "anything.onnx"
    export_model("dinov2-small", path, models_dir=tiny_models, grid=4)
    export_model("depth-anything-small", models / "a-depth.onnx", models_dir=tiny_models, picture_px=(64, 48))
    (tmp_path / "in").mkdir()
    trimesh.creation.box([0.1, 0.1, 0.2]).export(tmp_path / "in" / "box.ply")
    db = str(tmp_path / "db")
    words = ["meshes", "onboard", str(tmp_path / "in"), "--out", db, "--views", "3"]
    assert main([*words, "--features", str(path)]) == 0
    assert main([*words, "--features", str(path), "--block", "2"]) == 2
    picture = np.full((120, 160, 3), 200, np.uint8)
    picture[30:90, 40:80] = (90, 40, 30)
    cv2.imwrite(str(tmp_path / "table.png"), picture)
    pose = ["pose", str(tmp_path / "table.png"), "--db", db, "--box", "38", "28", "44", "64"]
    pose += ["--level", "classical", "--out", str(tmp_path / "out")]
    assert main([*pose, "--models-dir", str(models)]) == 0
    told = json.loads((tmp_path / "out/poses.json").read_text())
    assert told["encoder"] == f"{open_network(path)[1]['name']}-onnx"
    assert [found["name"] for found in told["objects"]] == ["box"]
    with pytest.raises(UserError, match=r"which no \.onnx file in .* is; name its --models-dir"):
        features_of(told["encoder"], {"models_dir": str(tmp_path)})


def test_facts_in_the_file_are_read_back(tiny_models: Path, tmp_path: Path) -> None:
    """Long values too: their length takes more than one byte."""
    path = tmp_path / "a.onnx"
    facts = export_model("dinov2-small", path, models_dir=tiny_models, grid=2)
    with open(path, "ab") as stream:
        stream.write(metadata({"long": "x" * 70_000, "words": "müde"}))
    _, found = open_network(path, "features")
    assert found == {**facts, "long": "x" * 70_000, "words": "müde"}


def test_files_of_other_kinds_are_refused(tiny_models: Path, tmp_path: Path) -> None:
    features, depth = tmp_path / "f.onnx", tmp_path / "d.onnx"
    export_model("dinov2-small", features, models_dir=tiny_models, grid=2)
    export_model("depth-anything-small", depth, models_dir=tiny_models, picture_px=(64, 48))
    with pytest.raises(UserError, match="is a network for depth, where one for features is needed"):
        OnnxPatchFeatures(depth)
    with pytest.raises(UserError, match="is a network for features, where one for depth is needed"):
        OnnxDepth(features)
    (tmp_path / "noise.onnx").write_bytes(b"not a network")
    with pytest.raises(UserError, match="cannot be read as an ONNX file"):
        OnnxDepth(tmp_path / "noise.onnx")
    with pytest.raises(UserError, match="vid2demo models export NAME --out"):
        OnnxDepth(tmp_path / "none.onnx")


def test_what_cannot_be_exported_is_refused(tiny_models: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="only patch encoders and depth networks are exported"):
        export_model("clip-large", tmp_path / "a.onnx", models_dir=tiny_models)
    with pytest.raises(UserError, match=r"must end in \.onnx"):
        export_model("dinov2-small", tmp_path / "a.bin", models_dir=tiny_models)
    with pytest.raises(UserError, match="blocks 1 to 3"):
        export_model("dinov2-small", tmp_path / "a.onnx", models_dir=tiny_models, block=9)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_export_command_writes_the_file_and_tells_its_facts(tiny_models: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep/encoder.onnx"
    command = ["models", "export", "dinov2-small", "--out", str(out), "--models-dir", str(tiny_models), "--json"]
    code = "import sys; from vid2demo.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *command], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["file"] == str(out)
    assert OnnxPatchFeatures(out).name == f"{told['name']}-onnx"
    assert importlib.util.find_spec("onnxruntime") is not None
