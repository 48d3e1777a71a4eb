"""CLIP and SigLIP behind the protocol `TextImageEncoder`: which words describe a crop."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .model_folder import read_json, require_folder
from .models import model_card
from .protocols import Floats, Image
from .torch_models import Precision, described, load_network, load_processor, place


class NeuralWords:
    """One space for words and pictures."""

    def __init__(
        self,
        model: str = "clip-bigg",
        *,
        models_dir: Path | None = None,
        device: str = "auto",
        precision: Precision = "auto",
        batch: int | None = None,
    ) -> None:
        """Load the network. batch: texts or pictures at once. Raises UserError when the weights are missing."""
        from transformers import AutoImageProcessor, AutoModel

        card = model_card(model, "words")
        folder = require_folder(card, models_dir)
        self._placement = place(device, precision)
        self._network = load_network(AutoModel, card, folder, self._placement)
        self._tokenizer = load_processor(_tokenizer_kind(folder), card, folder)
        self._images = load_processor(AutoImageProcessor, card, folder)
        # SigLIP has been trained on texts filled up to their full length, CLIP marks where a text ends.
        text = self._network.config.text_config
        self._padding = "max_length" if self._network.config.model_type == "siglip" else True
        self._length = int(text.max_position_embeddings)
        self._batch = batch or 2 * self._placement.batch
        self.name = described(card, folder, self._placement)
        self.size = int(self.encode_texts(["mug"]).shape[1])

    def encode_texts(self, texts: Sequence[str]) -> Floats:
        """(N, size) unit vectors; texts longer than the network reads are cut."""

        def features(part: Sequence[str]) -> Any:
            tokens = self._tokenizer(
                list(part), padding=self._padding, truncation=True, max_length=self._length, return_tensors="pt"
            )
            read = ("input_ids",) if self._padding == "max_length" else ("input_ids", "attention_mask")
            return self._network.get_text_features(**{key: tokens[key].to(self._placement.device) for key in read})

        return self._in_batches(texts, features)

    def encode_images(self, images: Sequence[Image]) -> Floats:
        """(N, size) unit vectors of pictures (H, W, 3) of any size, made square with black rather than cut."""

        def features(part: Sequence[Image]) -> Any:
            pixels = self._images(images=[squared(image) for image in part], return_tensors="pt").pixel_values
            return self._network.get_image_features(pixels.to(self._placement.device, self._placement.dtype))

        return self._in_batches(images, features)

    def _in_batches(self, items: Sequence[Any], features: Any) -> Floats:
        import torch

        found: list[NDArray[np.float32]] = []
        with torch.inference_mode():
            for start in range(0, len(items), self._batch):
                out = features(items[start : start + self._batch])
                found.append(getattr(out, "pooler_output", out).float().cpu().numpy())
        if not found:
            return np.zeros((0, self.size), np.float32)
        vectors = np.concatenate(found)
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def _tokenizer_kind(folder: Path) -> Any:
    """What reads a folder's tokenizer: SigLIP's own needs sentencepiece, without which its tokenizer.json does."""
    from transformers import AutoTokenizer, PreTrainedTokenizerFast

    stated = folder / "tokenizer_config.json"
    siglip = stated.is_file() and read_json(stated).get("tokenizer_class") == "SiglipTokenizer"
    plain = siglip and importlib.util.find_spec("sentencepiece") is None and (folder / "tokenizer.json").is_file()
    return PreTrainedTokenizerFast if plain else AutoTokenizer


def squared(image: Image) -> Image:
    """A picture with black rims that make it square."""
    height, width = image.shape[:2]
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    rims = (top, side - height - top, left, side - width - left)
    return np.asarray(cv2.copyMakeBorder(image, *rims, cv2.BORDER_CONSTANT, value=(0, 0, 0)), np.uint8)
