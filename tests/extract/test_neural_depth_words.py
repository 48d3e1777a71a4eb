from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.neural_depth import NeuralDepth
from vid2demo.extract.neural_words import NeuralWords, squared
from vid2demo.extract.protocols import DepthEstimator, TextImageEncoder

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may


def picture(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("model", ["zoedepth", "depth-anything-small"])
def test_depth_has_the_size_of_the_picture_and_is_positive(tiny_models: Path, model: str) -> None:
    network = NeuralDepth(model, models_dir=tiny_models, device="cpu")
    assert isinstance(network, DepthEstimator)
    for height, width in ((120, 160), (161, 97)):
        depth = network.estimate(picture(height, width))
        assert depth.shape == (height, width)
        assert depth.dtype == np.float32
        assert np.all(np.isfinite(depth))
        assert depth.min() > 0
        np.testing.assert_array_equal(depth, network.estimate(picture(height, width), np.eye(3)))
    half = NeuralDepth(model, models_dir=tiny_models, device="cpu", precision="half")
    np.testing.assert_allclose(half.estimate(picture()), network.estimate(picture()), rtol=0.05)
    assert half.name != network.name


def test_depth_without_metres_is_refused(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "depth-anything-small", tmp_path / "depth-anything-small")
    path = tmp_path / "depth-anything-small/config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"depth_estimation_type": "relative"}))
    with pytest.raises(UserError, match=r"knows no metres .*/Depth-Anything-V2-Metric-Indoor-Small-hf"):
        NeuralDepth("depth-anything-small", models_dir=tmp_path, device="cpu")


def test_depth_pictures_are_scaled_as_the_model_cards_say(tiny_models: Path) -> None:
    """Depth Anything: 518 px along one side, multiples of 14; ZoeDepth: about 384 x 512, multiples of 32."""
    from transformers import AutoImageProcessor

    wide = np.full((360, 640, 3), 124, np.uint8)
    anything = AutoImageProcessor.from_pretrained(tiny_models / "depth-anything-small")
    pixels = anything(images=wide, return_tensors="np").pixel_values
    assert pixels.shape == (1, 3, 294, 518)
    np.testing.assert_allclose(pixels[0, 0].mean(), (124 / 255 - 0.485) / 0.229, atol=1e-3)
    zoe = AutoImageProcessor.from_pretrained(tiny_models / "zoedepth")
    pixels = zoe(images=wide, return_tensors="np").pixel_values
    assert pixels.shape[2] % 32 == pixels.shape[3] % 32 == 0
    np.testing.assert_allclose(pixels[0, 0].mean(), (124 / 255 - 0.5) / 0.5, atol=1e-3)


@pytest.fixture(scope="module", params=["clip-large", "siglip-base"])
def words(request: pytest.FixtureRequest, tiny_models: Path) -> NeuralWords:
    return NeuralWords(request.param, models_dir=tiny_models, device="cpu", batch=2)


def test_texts_and_pictures_become_unit_vectors(words: NeuralWords) -> None:
    assert isinstance(words, TextImageEncoder)
    texts = ["mug", "a photo of a kettle", "a photo of a mug " * 60]
    vectors = words.encode_texts(texts)
    pictures = words.encode_images([picture(), picture(50, 200, 1), picture(300, 20, 2)])
    for found in (vectors, pictures):
        assert found.shape == (3, words.size)
        assert found.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert words.encode_texts([]).shape == words.encode_images([]).shape == (0, words.size)


def test_batches_of_words_and_pictures_give_what_single_ones_give(words: NeuralWords) -> None:
    """Padding to the longest text of a batch must not show."""
    texts = ["mug", "a photo of a kettle", "an"]
    together = words.encode_texts(texts)
    alone = np.concatenate([words.encode_texts([text]) for text in texts])
    np.testing.assert_allclose(together, alone, atol=1e-5)
    pictures = [picture(seed=k) for k in range(3)]
    alone = np.concatenate([words.encode_images([p]) for p in pictures])
    np.testing.assert_allclose(words.encode_images(pictures), alone, atol=1e-5)
    assert not np.allclose(together[0], together[1], atol=1e-3)


def test_half_precision_of_words_is_close(tiny_models: Path, words: NeuralWords) -> None:
    half = NeuralWords(words.name.rsplit("-", 1)[0], models_dir=tiny_models, device="cpu", precision="half")
    texts, pictures = ["mug", "kettle"], [picture()]
    assert np.sum(half.encode_texts(texts) * words.encode_texts(texts), axis=1).min() > 0.99
    assert np.sum(half.encode_images(pictures) * words.encode_images(pictures), axis=1).min() > 0.99


def test_siglip_reads_words_without_sentencepiece(tiny_models: Path, tmp_path: Path) -> None:
    """Its checkpoints ask for a tokenizer that needs that package; their tokenizer.json says the same."""
    shutil.copytree(tiny_models / "siglip-base", tmp_path / "siglip-base")
    path = tmp_path / "siglip-base/tokenizer_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"tokenizer_class": "SiglipTokenizer"}))
    words = NeuralWords("siglip-base", models_dir=tmp_path, device="cpu")
    plain = NeuralWords("siglip-base", models_dir=tiny_models, device="cpu")
    np.testing.assert_array_equal(words.encode_texts(["a photo of a mug"]), plain.encode_texts(["a photo of a mug"]))


def test_pictures_are_made_square_not_cut() -> None:
    tall = squared(np.full((40, 10, 3), 200, np.uint8))
    assert tall.shape == (40, 40, 3)
    assert np.array_equal(np.flatnonzero(tall[5, :, 0]), np.arange(15, 25))
    assert np.sum(tall > 0) == 40 * 10 * 3


def test_word_pictures_are_scaled_as_the_model_cards_say(tiny_models: Path) -> None:
    """CLIP: 224 px, its own mean and deviation; SigLIP: 224 px, to [-1, 1]."""
    from transformers import AutoImageProcessor

    grey = np.full((300, 300, 3), 124, np.uint8)
    clip = AutoImageProcessor.from_pretrained(tiny_models / "clip-large")(images=grey, return_tensors="np").pixel_values
    siglip = AutoImageProcessor.from_pretrained(tiny_models / "siglip-base")(images=grey, return_tensors="np")
    assert clip.shape == siglip.pixel_values.shape == (1, 3, 224, 224)
    mean, std = np.array([0.48145466, 0.4578275, 0.40821073]), np.array([0.26862954, 0.26130258, 0.27577711])
    np.testing.assert_allclose(clip[0].mean(axis=(1, 2)), (124 / 255 - mean) / std, atol=1e-3)
    np.testing.assert_allclose(siglip.pixel_values.mean(), (124 / 255 - 0.5) / 0.5, atol=1e-3)


def test_checkpoint_without_its_tokenizer_is_refused(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "clip-large", tmp_path / "clip-large")
    (tmp_path / "clip-large/preprocessor_config.json").unlink()
    with pytest.raises(UserError, match="lacks the pre-processing of clip-large"):
        NeuralWords("clip-large", models_dir=tmp_path, device="cpu")
