"""Patch features of DINOv2 (with registers) and DINOv3 behind the protocol `PatchFeatures`.

As in FreePose: the tokens after any one block with the network's last LayerNorm applied, 30 x 30 of them for a crop
(420 px for DINOv2's patches of 14 px, 480 px for DINOv3's of 16 px), and the class token as the summary.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .model_folder import require_folder
from .models import model_card
from .protocols import Floats, PatchGrid
from .torch_models import Placement, Precision, described, load_network, load_processor, place

GRID = 30
PAPER_BLOCK = 22  # of the 24 of ViT-L: eleven twelfths of the way through
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class NeuralPatchFeatures:
    """Patch tokens and class token of a vision transformer."""

    def __init__(
        self,
        model: str = "dinov2-large",
        *,
        block: int | None = None,
        grid: int = GRID,
        models_dir: Path | None = None,
        device: str = "auto",
        precision: Precision = "auto",
        batch: int | None = None,
    ) -> None:
        """Load the network.

        model: a name of `vid2demo models list`.  block: after which one the tokens are taken, from 1 to the number of
        blocks; None takes the paper's (22 of 24, and as far through smaller networks). Later blocks are not even kept.
        grid: patches along a crop's side.  batch: crops at once, which bounds the memory; None for one fit for the
        device.
        Raises UserError when the weights are missing or another network's, and for a block there is not.
        """
        card = model_card(model, "features")
        self._folder = require_folder(card, models_dir)
        self._placement = place(device, precision)
        self._network = load_patch_encoder(card.name, self._folder, self._placement, block)
        config = self._network.config
        self.grid, self.crop_px = grid, grid * int(config.patch_size)
        self.patch_size = self.summary_size = int(config.hidden_size)
        self._skip = 1 + int(config.num_register_tokens)
        self._mean, self._std = normalisation(card.name, self._folder)
        self._batch = batch or self._placement.batch
        settings = (f"block{config.num_hidden_layers}", f"{self.crop_px}px")
        self.name = described(card, self._folder, self._placement, *settings)

    def encode(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> PatchGrid:
        """Features of crops (B, S, S, 3); the masks are not looked at."""
        check_crops(crops, self.crop_px)
        import torch

        tokens = np.empty((len(crops), 1 + self.grid**2, self.patch_size), np.float32)
        with torch.inference_mode():
            for start in range(0, len(crops), self._batch):
                part = slice(start, start + self._batch)
                pixels = torch.from_numpy(prepared(crops[part], self._mean, self._std))
                out = self._network(pixels.to(self._placement.device, self._placement.dtype)).last_hidden_state
                out = out.float().cpu().numpy()
                tokens[part, 0], tokens[part, 1:] = out[:, 0], out[:, self._skip :]
        return grid_of_tokens(tokens, self.grid)


def check_crops(crops: NDArray[np.uint8], side_px: int) -> None:
    """Raise ValueError unless crops are (B, S, S, 3) uint8 of the side an encoder takes."""
    if crops.ndim != 4 or crops.shape[1:] != (side_px, side_px, 3) or crops.dtype != np.uint8:
        raise ValueError(f"crops must be (B, {side_px}, {side_px}, 3) uint8, got {crops.shape} {crops.dtype}")


def grid_of_tokens(tokens: Floats, grid: int) -> PatchGrid:
    """The features in tokens (B, 1 + G * G, D), class token first."""
    return PatchGrid(tokens[:, 1:].reshape(-1, grid, grid, tokens.shape[-1]), tokens[:, 0])


def prepared(crops: NDArray[np.uint8], mean: Floats, std: Floats) -> Floats:
    """(B, 3, S, S) float32 of crops (B, S, S, 3) uint8: in [0, 1], less the mean, over the standard deviation."""
    return np.ascontiguousarray(((crops.astype(np.float32) / 255 - mean) / std).transpose(0, 3, 1, 2), np.float32)


def normalisation(model: str, folder: Path) -> tuple[Floats, Floats]:
    """Mean and standard deviation (3,) of the channels, RGB in [0, 1], as the checkpoint states them."""
    from transformers import AutoImageProcessor

    processor = load_processor(AutoImageProcessor, model_card(model), folder)
    mean, std = getattr(processor, "image_mean", None), getattr(processor, "image_std", None)
    return np.asarray(mean or IMAGENET_MEAN, np.float32), np.asarray(std or IMAGENET_STD, np.float32)


def load_patch_encoder(model: str, folder: Path, placement: Placement, block: int | None) -> Any:
    """The network without the blocks after `block`: its last LayerNorm then sees the tokens of that block."""
    from transformers import AutoModel

    card = model_card(model, "features")
    network = load_network(AutoModel, card, folder, placement)
    return cut_after(network, block, card.name)


def cut_after(network: Any, block: int | None, name: str) -> Any:
    """Leave out the blocks after `block` (from 1; None for the paper's share). Raises UserError if there is none."""
    encoder = network.encoder if hasattr(network, "encoder") else network.model  # DINOv2, DINOv3
    blocks = encoder.layer
    wanted = round(len(blocks) * PAPER_BLOCK / 24) if block is None else block
    if not 1 <= wanted <= len(blocks):
        raise UserError(f"{name} has the blocks 1 to {len(blocks)}, not {block}")
    encoder.layer = blocks[:wanted]
    network.config.num_hidden_layers = wanted
    return network
