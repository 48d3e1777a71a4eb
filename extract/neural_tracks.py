"""Points followed by CoTracker 3 (offline), behind the protocol `PointTracker`.

transformers has no CoTracker: its authors' package `cotracker` does the work, installed, or as torch.hub keeps it.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .model_folder import pull_command, require_folder
from .models import model_card
from .protocols import Floats, PointTracks
from .torch_models import place

WINDOW = 60  # frames the offline network was trained with
HUB_FOLDER = "facebookresearch_co-tracker_main"


class NeuralTracks:
    """CoTracker 3, which sees the whole clip at once and follows points forward and backward."""

    def __init__(self, model: str = "cotracker", *, models_dir: Path | None = None, device: str = "auto") -> None:
        """Load the network, in full precision. Raises UserError when the package or the weights are missing."""
        card = model_card(model, "tracks")
        folder = require_folder(card, models_dir)
        self._placement = place(device, "full")
        predictor = _package().CoTrackerPredictor
        path = folder / str(card.checkpoint)
        self._network = predictor(checkpoint=None, offline=True, window_len=WINDOW)
        try:
            self._network.model.load_state_dict(_weights(path))
        except Exception as error:  # an unpickler's, a zip's or a shape's error
            raise UserError(
                f"{path} cannot be read as {model} ({error}); get it again: `{pull_command(card)}`"
            ) from error
        self._network.to(self._placement.device).eval()
        self.name = f"{card.name}3-offline"

    def track(self, frames: NDArray[np.uint8], frame_index: NDArray[np.int64], pixels_px: Floats) -> PointTracks:
        """Follow points (P, 2), each given in frame `frame_index` (P,), through frames (N, H, W, 3)."""
        count, (height, width) = len(frames), frames.shape[1:3]
        if not len(pixels_px):
            nothing = np.zeros((count, 0), np.float32)
            return PointTracks(np.zeros((count, 0, 2), np.float32), nothing > 0, nothing)
        import torch

        rows, columns = (int(side) for side in self._network.interp_shape)
        # The network sees every frame at this size: the large ones are never held together.
        small = np.stack([cv2.resize(frame, (columns, rows), interpolation=cv2.INTER_AREA) for frame in frames])
        scale = np.array([(columns - 1) / (width - 1), (rows - 1) / (height - 1)], np.float32)
        queries = np.concatenate([frame_index[:, None], pixels_px * scale], axis=1).astype(np.float32)
        device = self._placement.device
        video = torch.from_numpy(small).permute(0, 3, 1, 2)[None].float().to(device)
        asked = torch.from_numpy(queries)[None].to(device)
        with torch.inference_mode():
            tracks, visible = self._network(video, queries=asked, backward_tracking=True)
        seen = np.asarray(visible[0].cpu().numpy(), bool)
        return PointTracks(np.asarray(tracks[0].cpu().numpy() / scale, np.float32), seen, seen.astype(np.float32))


def _package() -> Any:
    """The module `cotracker.predictor`. Raises UserError when it is neither installed nor in torch.hub's folder."""
    if importlib.util.find_spec("cotracker") is None:
        import torch

        folder = Path(torch.hub.get_dir()) / HUB_FOLDER
        if not (folder / "cotracker/predictor.py").is_file():
            raise UserError(
                "cotracker is not installed: install its authors' package (facebookresearch/co-tracker), or call "
                f"torch.hub.load once where there is a network, which keeps it in {folder}"
            )
        sys.path.append(str(folder))
    return importlib.import_module("cotracker.predictor")


def _weights(path: Path) -> Any:
    """The tensors of a checkpoint; torch's own format, but nothing except tensors is unpickled."""
    import torch

    state = torch.load(path, map_location="cpu", weights_only=True)
    return state.get("model", state)
