"""Metric depth from one picture by ZoeDepth or Depth Anything V2, behind the protocol `DepthEstimator`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .model_folder import require_folder
from .models import model_card
from .protocols import Floats, Image
from .torch_models import Precision, described, load_network, load_processor, place

NEAREST_M = 1e-3


class NeuralDepth:
    """A depth network; its own image processor scales and pads as its model card says."""

    def __init__(
        self,
        model: str = "zoedepth",
        *,
        models_dir: Path | None = None,
        device: str = "auto",
        precision: Precision = "auto",
    ) -> None:
        """Load the network. Raises UserError when the weights are missing, or of a network without metres."""
        from transformers import AutoImageProcessor, AutoModelForDepthEstimation

        card = model_card(model, "depth")
        folder = require_folder(card, models_dir)
        self._placement = place(device, precision)
        self._network = load_network(AutoModelForDepthEstimation, card, folder, self._placement)
        if getattr(self._network.config, "depth_estimation_type", "metric") != "metric":
            raise UserError(f"{folder} knows no metres (relative depth); take a Metric one, such as {card.repository}")
        self._processor = load_processor(AutoImageProcessor, card, folder)
        self.name = described(card, folder, self._placement)

    def estimate(self, rgb: Image, camera_matrix: NDArray[np.float64] | None = None) -> Floats:
        """(H, W) depth along the camera's z [m]; the camera matrix is not looked at: the network guesses the lens."""
        import torch

        pixels = self._processor(images=rgb, return_tensors="pt").pixel_values
        with torch.inference_mode():
            out = self._network(pixel_values=pixels.to(self._placement.device, self._placement.dtype))
        out.predicted_depth = out.predicted_depth.float().cpu()
        size = [rgb.shape[:2]]
        padded = {"source_sizes": size} if hasattr(self._processor, "do_pad") and self._pads() else {}
        (found,) = self._processor.post_process_depth_estimation(out, target_sizes=size, **padded)
        depth = found["predicted_depth"].numpy()
        return np.asarray(np.maximum(np.nan_to_num(depth, nan=NEAREST_M), NEAREST_M), np.float32)

    def _pads(self) -> bool:
        """Whether the processor adds a rim that has to be cut off again (ZoeDepth's does)."""
        return type(self._processor).__name__.startswith("ZoeDepth")
