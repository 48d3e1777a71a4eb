"""Patch features and depth by ONNX Runtime, from files that `vid2demo models export` wrote; torch is not needed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .neural_depth import NEAREST_M
from .neural_features import check_crops, grid_of_tokens, prepared
from .protocols import Floats, Image, PatchGrid

BATCH = 8
ZOEDEPTH_RIM = 3.0  # its reflected rim is this times the root of half the side


class OnnxPatchFeatures:
    """A patch encoder in an ONNX file, behind the protocol `PatchFeatures`."""

    def __init__(self, path: Path, *, threads: int | None = None, batch: int = BATCH) -> None:
        """Open the file. threads: None for one a core.  batch: crops at once.

        Raises UserError for a missing or damaged file, or one of another kind.
        """
        self._session, facts = open_network(path, "features", threads)
        self.grid, self._batch = int(facts["grid"]), batch
        self._mean, self._std = _numbers(facts["mean"]), _numbers(facts["std"])
        self.crop_px = int(self._session.get_inputs()[0].shape[2])
        self.patch_size = self.summary_size = int(self._session.get_outputs()[0].shape[2])
        self.name = f"{facts['name']}-onnx"

    def encode(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> PatchGrid:
        """Features of crops (B, S, S, 3) uint8; the masks are not looked at."""
        check_crops(crops, self.crop_px)
        tokens = np.empty((len(crops), 1 + self.grid**2, self.patch_size), np.float32)
        for start in range(0, len(crops), self._batch):
            part = slice(start, start + self._batch)
            (tokens[part],) = self._session.run(None, {"pixels": prepared(crops[part], self._mean, self._std)})
        return grid_of_tokens(tokens, self.grid)


class OnnxDepth:
    """A depth network in an ONNX file, behind the protocol `DepthEstimator`."""

    def __init__(self, path: Path, *, threads: int | None = None) -> None:
        """Open the file. Raises UserError as `OnnxPatchFeatures` does."""
        self._session, facts = open_network(path, "depth", threads)
        self._mean, self._std = _numbers(facts["mean"]), _numbers(facts["std"])
        self._height, self._width = (int(side) for side in self._session.get_inputs()[0].shape[2:])
        self._rim = ZOEDEPTH_RIM if facts["rim"] else 0.0
        self.name = f"{facts['name']}-onnx"

    def estimate(self, rgb: Image, camera_matrix: NDArray[np.float64] | None = None) -> Floats:
        """(H, W) depth along the camera's z [m]; the camera matrix is not looked at."""
        height, width = rgb.shape[:2]
        rim_y, rim_x = (int(np.sqrt(side / 2) * self._rim) for side in (height, width))
        padded = cv2.copyMakeBorder(rgb, rim_y, rim_y, rim_x, rim_x, cv2.BORDER_REFLECT_101) if self._rim else rgb
        how = cv2.INTER_LINEAR if self._rim else cv2.INTER_CUBIC
        small = cv2.resize(padded.astype(np.float32), (self._width, self._height), interpolation=how)
        pixels = ((small / 255 - self._mean) / self._std).transpose(2, 0, 1)[None].astype(np.float32)
        (found,) = self._session.run(None, {"pixels": pixels})
        size = width + 2 * rim_x, height + 2 * rim_y
        depth = cv2.resize(np.asarray(found, np.float32)[0], size, interpolation=cv2.INTER_LINEAR)
        inner = depth[rim_y : rim_y + height, rim_x : rim_x + width]
        return np.asarray(np.maximum(np.nan_to_num(inner, nan=NEAREST_M), NEAREST_M), np.float32)


def open_network(path: Path, part: str | None = None, threads: int | None = None) -> tuple[Any, dict[str, str]]:
    """An ONNX Runtime session and the facts in its file, which must be a network for `part` where that is given.

    Raises UserError for a missing, damaged or other file.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        raise UserError("ONNX files are run by onnxruntime; install it with `pip install 'vid2demo[onnx]'`")
    import onnxruntime

    if not path.is_file():
        raise UserError(f"{path} does not exist; write it with `vid2demo models export NAME --out {path}`")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or 0
    wanted = ("CUDAExecutionProvider", "CoreMLExecutionProvider", "CPUExecutionProvider")
    there = onnxruntime.get_available_providers()
    try:
        session = onnxruntime.InferenceSession(path, options, [name for name in wanted if name in there])
    except Exception as error:  # the runtime's errors have no common type
        raise UserError(f"{path} cannot be read as an ONNX file ({error}); export it again") from error
    facts = dict(session.get_modelmeta().custom_metadata_map)
    if part not in (None, facts.get("part")):
        what = f"a network for {facts['part']}" if "part" in facts else "not one of `vid2demo models export`"
        raise UserError(f"{path} is {what}, where one for {part} is needed")
    return session, facts


def _numbers(text: str) -> Floats:
    return np.array(text.split(), np.float32)
