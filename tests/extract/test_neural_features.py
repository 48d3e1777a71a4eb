from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.model_folder import find_folder, fingerprint
from vid2demo.extract.models import model_card
from vid2demo.extract.neural_features import NeuralPatchFeatures, prepared
from vid2demo.extract.protocols import PatchFeatures
from vid2demo.extract.torch_models import place

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may

GRID = 6  # small crops: what is tested does not depend on the size


def crops_for(encoder: PatchFeatures, count: int, seed: int = 0) -> np.ndarray[Any, np.dtype[np.uint8]]:
    side = encoder.crop_px
    return np.random.default_rng(seed).integers(0, 256, (count, side, side, 3), dtype=np.uint8)


def encode(encoder: NeuralPatchFeatures, crops: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    found = encoder.encode(crops, np.ones(crops.shape[:3], bool))
    return found.patches, found.summary


@pytest.fixture(scope="module", params=["dinov2-small", "dinov3-small"])
def encoder(request: pytest.FixtureRequest, tiny_models: Path) -> NeuralPatchFeatures:
    return NeuralPatchFeatures(request.param, grid=GRID, models_dir=tiny_models, device="cpu", batch=2)


@pytest.mark.parametrize(("model", "side"), [("dinov2-small", 420), ("dinov3-small", 480)])
def test_crops_of_the_paper_give_30_by_30_patches(tiny_models: Path, model: str, side: int) -> None:
    encoder = NeuralPatchFeatures(model, models_dir=tiny_models, device="cpu")
    assert isinstance(encoder, PatchFeatures)
    assert (encoder.crop_px, encoder.grid) == (side, 30)
    patches, summary = encode(encoder, crops_for(encoder, 1))
    assert patches.shape == (1, 30, 30, encoder.patch_size)
    assert summary.shape == (1, encoder.summary_size)
    assert patches.dtype == summary.dtype == np.float32


def test_a_batch_gives_what_single_crops_give(encoder: NeuralPatchFeatures) -> None:
    crops = crops_for(encoder, 5)
    patches, summary = encode(encoder, crops)
    for k in range(5):
        one_patches, one_summary = encode(encoder, crops[k : k + 1])
        np.testing.assert_allclose(one_patches[0], patches[k], atol=1e-5)
        np.testing.assert_allclose(one_summary[0], summary[k], atol=1e-5)
    again, _ = encode(encoder, crops)
    np.testing.assert_array_equal(again, patches)
    assert encode(encoder, crops[:0])[0].shape == (0, GRID, GRID, encoder.patch_size)


def test_never_more_crops_go_through_at_once_than_the_batch_says(encoder: NeuralPatchFeatures) -> None:
    """What bounds the memory: seen from inside the network, when more are asked for."""
    seen: list[int] = []
    hook = encoder._network.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
    encode(encoder, crops_for(encoder, 7))
    hook.remove()
    assert seen == [2, 2, 2, 1]
    assert place("cpu").batch == 8


def test_patches_come_row_by_row(encoder: NeuralPatchFeatures) -> None:
    """A change of the picture in one patch moves that patch's features most."""
    crops = np.full((1, encoder.crop_px, encoder.crop_px, 3), 120, np.uint8)
    before, _ = encode(encoder, crops)
    step = encoder.crop_px // GRID
    crops[0, 1 * step : 2 * step, 4 * step : 5 * step] = np.random.default_rng(1).integers(0, 256, (step, step, 3))
    after, _ = encode(encoder, crops)
    moved = np.linalg.norm(after - before, axis=-1)[0]
    assert np.unravel_index(moved.argmax(), moved.shape) == (1, 4)


def test_last_layer_norm_is_applied_at_every_block(tiny_models: Path) -> None:
    """Its scale is one in a fresh network, so every token has mean zero and variance one, whatever the block."""
    seen = []
    for block in (1, 2, 3):
        encoder = NeuralPatchFeatures("dinov2-small", block=block, grid=GRID, models_dir=tiny_models, device="cpu")
        patches, summary = encode(encoder, crops_for(encoder, 1))
        assert f"block{block}" in encoder.name
        np.testing.assert_allclose(patches.mean(axis=-1), 0, atol=1e-4)
        np.testing.assert_allclose(summary.std(axis=-1), 1, atol=1e-3)
        seen.append(patches)
    assert not np.allclose(seen[0], seen[1], atol=1e-3)
    assert not np.allclose(seen[1], seen[2], atol=1e-3)


def test_tokens_of_a_block_are_those_of_the_whole_network(tiny_models: Path) -> None:
    """The slow way: run all blocks, take the hidden state after the second, apply the norm."""
    import torch
    from transformers import AutoModel

    folder = tiny_models / "dinov2-small"
    encoder = NeuralPatchFeatures("dinov2-small", block=2, grid=GRID, models_dir=tiny_models, device="cpu")
    crops = crops_for(encoder, 2)
    mean, std = np.float32([0.485, 0.456, 0.406]), np.float32([0.229, 0.224, 0.225])
    network = AutoModel.from_pretrained(folder)
    with torch.inference_mode():
        out = network(torch.from_numpy(prepared(crops, mean, std)), output_hidden_states=True)
        tokens = network.layernorm(out.hidden_states[2]).numpy()
    patches, summary = encode(encoder, crops)
    np.testing.assert_allclose(patches.reshape(2, GRID**2, -1), tokens[:, 5:], atol=1e-5)  # class token, 4 registers
    np.testing.assert_allclose(summary, tokens[:, 0], atol=1e-5)


def test_half_precision_is_close_and_says_so(tiny_models: Path, encoder: NeuralPatchFeatures) -> None:
    model = encoder.name.split("-block")[0]
    half = NeuralPatchFeatures(model, grid=GRID, models_dir=tiny_models, device="cpu", precision="half")
    crops = crops_for(encoder, 2)
    full_patches, rough = encode(encoder, crops)[0], encode(half, crops)[0]
    cosine = np.sum(full_patches * rough, -1) / np.linalg.norm(full_patches, axis=-1) / np.linalg.norm(rough, axis=-1)
    assert cosine.min() > 0.99
    assert rough.dtype == np.float32
    assert "bfloat16" in half.name
    assert half.name != encoder.name


def test_pixels_are_prepared_as_the_model_cards_say(tiny_models: Path) -> None:
    """(124 / 255 - 0.485) / 0.229 and so on: ImageNet's mean and deviation, channels RGB, in front."""
    mean, std = np.float32([0.485, 0.456, 0.406]), np.float32([0.229, 0.224, 0.225])
    crop = np.zeros((1, 14, 28, 3), np.uint8)
    crop[...] = (124, 116, 104)
    pixels = prepared(crop, mean, std)
    assert pixels.shape == (1, 3, 14, 28)
    np.testing.assert_allclose(pixels[0, :, 0, 0], [0.00557, -0.00490, 0.00819], atol=1e-5)
    from transformers import AutoImageProcessor

    theirs = AutoImageProcessor.from_pretrained(tiny_models / "dinov2-small")
    same = theirs(images=crop[0], do_resize=False, do_center_crop=False, return_tensors="np").pixel_values
    np.testing.assert_allclose(pixels, same, atol=1e-6)


def test_mean_and_deviation_are_the_checkpoints_own(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "dinov2-small", tmp_path / "dinov2-small")
    path = tmp_path / "dinov2-small/preprocessor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}))
    ours = NeuralPatchFeatures("dinov2-small", grid=GRID, models_dir=tmp_path, device="cpu")
    theirs = NeuralPatchFeatures("dinov2-small", grid=GRID, models_dir=tiny_models, device="cpu")
    grey = np.full((1, ours.crop_px, ours.crop_px, 3), 124, np.uint8)
    assert not np.allclose(encode(ours, grey)[0], encode(theirs, grey)[0], atol=1e-3)


def test_other_weights_have_another_name(tiny_models: Path, tmp_path: Path) -> None:
    """Features of two checkpoints must never be mistaken for each other in a store."""
    folder = tiny_models / "dinov2-small"
    shutil.copytree(folder, tmp_path / "dinov2-small")
    assert fingerprint(tmp_path / "dinov2-small") == fingerprint(folder)
    weights = tmp_path / "dinov2-small/model.safetensors"
    data = bytearray(weights.read_bytes())
    data[-3] ^= 0x01
    weights.write_bytes(data)
    assert fingerprint(tmp_path / "dinov2-small") != fingerprint(folder)


@pytest.mark.parametrize("block", [0, 4, -1])
def test_blocks_there_are_not_are_refused(tiny_models: Path, block: int) -> None:
    with pytest.raises(UserError, match="dinov2-small has the blocks 1 to 3"):
        NeuralPatchFeatures("dinov2-small", block=block, models_dir=tiny_models, device="cpu")


def test_crops_of_another_size_are_refused(encoder: NeuralPatchFeatures) -> None:
    with pytest.raises(ValueError, match="uint8"):
        encoder.encode(np.zeros((1, 20, 20, 3), np.uint8), np.ones((1, 20, 20), bool))
    with pytest.raises(ValueError, match="float64"):
        encoder.encode(np.zeros((1, encoder.crop_px, encoder.crop_px, 3)), np.ones((1, 1, 1), bool))


def test_missing_weights_name_the_command_that_fetches_them(tiny_models: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"vid2demo models pull dinov2-small --models-dir {tmp_path}"):
        NeuralPatchFeatures("dinov2-small", models_dir=tmp_path)
    shutil.copytree(tiny_models / "dinov2-small", tmp_path / "dinov2-small")
    (tmp_path / "dinov2-small/model.safetensors").unlink()
    with pytest.raises(UserError, match=r"lacks model\.safetensors; get them with `vid2demo models pull"):
        NeuralPatchFeatures("dinov2-small", models_dir=tmp_path)


def test_pickled_weights_are_not_taken(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "dinov2-small", tmp_path / "dinov2-small")
    (tmp_path / "dinov2-small/model.safetensors").rename(tmp_path / "dinov2-small/pytorch_model.bin")
    assert find_folder(model_card("dinov2-small"), tmp_path)[0] is None


def test_folder_of_another_network_is_refused(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "dinov3-small", tmp_path / "dinov2-small")
    with pytest.raises(UserError, match="holds a network of type 'dinov3_vit', not 'dinov2_with_registers'"):
        NeuralPatchFeatures("dinov2-small", models_dir=tmp_path)


def test_weights_that_lack_a_layer_are_refused(tiny_models: Path, tmp_path: Path) -> None:
    """transformers would fill it with random numbers and only remark on it."""
    from safetensors.numpy import load_file, save_file

    shutil.copytree(tiny_models / "dinov2-small", tmp_path / "dinov2-small")
    weights = tmp_path / "dinov2-small/model.safetensors"
    tensors = load_file(weights)
    gone = next(name for name in tensors if name.endswith("layer.1.mlp.fc1.weight"))
    del tensors[gone]
    save_file(tensors, weights, metadata={"format": "pt"})
    with pytest.raises(
        UserError, match=r"lacks 1 of the weights of dinov2-small, such as .*layer\.1\.mlp\.fc1\.weight"
    ):
        NeuralPatchFeatures("dinov2-small", models_dir=tmp_path, device="cpu")
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(UserError, match="cannot be read as dinov2-small"):
        NeuralPatchFeatures("dinov2-small", models_dir=tmp_path, device="cpu")


def test_devices_this_machine_lacks_are_named(tiny_models: Path) -> None:
    for device in ("cuda:97", "tpu", "cpu:3", "cuda:x"):
        with pytest.raises(UserError, match=f"--device {device}: torch on this machine can use cpu"):
            place(device)
    assert place("cpu").precision == "float32"
    assert place("cpu", "half").precision == "bfloat16"
    assert place("auto").device in ("cpu", "cuda", "mps")
