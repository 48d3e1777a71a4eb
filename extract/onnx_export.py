"""Patch encoders and depth networks as ONNX files, which run without torch and on a CPU faster.

The file says itself what it is: the facts its runner needs (which network, crop size, mean and deviation) lie in its
metadata. Weights are kept in float32.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import UserError
from .files import atomic_path
from .model_folder import require_folder
from .models import model_card
from .neural_features import GRID, load_patch_encoder, normalisation
from .torch_models import described, load_network, load_processor, place

if TYPE_CHECKING:
    import torch

OPSET = 18
METADATA_FIELD = 14  # of ONNX's ModelProto: repeated {1: key, 2: value}
PICTURE_PX = (640, 480)


def export_model(
    model: str,
    out: Path,
    *,
    models_dir: Path | None = None,
    block: int | None = None,
    grid: int = GRID,
    picture_px: tuple[int, int] = PICTURE_PX,
) -> dict[str, str]:
    """Write a network of `vid2demo models list` as an ONNX file; returns the facts written into it.

    block, grid: of patch encoders, as `NeuralPatchFeatures` takes them.  picture_px: width and height of the pictures
    that a depth network will see; others are stretched to the network's input for them.
    Raises UserError for models of other parts, and when weights are missing.
    """
    card = model_card(model)
    if card.part not in ("features", "depth"):
        raise UserError(f"{model} is for {card.part}; only patch encoders and depth networks are exported")
    if out.suffix != ".onnx":
        raise UserError(f"--out {out} must end in .onnx")
    if card.part == "features":
        return _export_features(model, out, models_dir, block, grid)
    return _export_depth(model, out, models_dir, picture_px)


def _export_features(model: str, out: Path, models_dir: Path | None, block: int | None, grid: int) -> dict[str, str]:
    card, placement = model_card(model), place("cpu", "full")
    folder = require_folder(card, models_dir)
    network = load_patch_encoder(model, folder, placement, block)
    side = grid * int(network.config.patch_size)
    mean, std = normalisation(model, folder)
    facts = {
        "part": "features",
        "name": described(card, folder, placement, f"block{network.config.num_hidden_layers}", f"{side}px"),
        "grid": str(grid),
        "mean": " ".join(map(str, mean)),
        "std": " ".join(map(str, std)),
    }
    write_tokens(network, side, out, facts)
    return facts


def _export_depth(model: str, out: Path, models_dir: Path | None, picture_px: tuple[int, int]) -> dict[str, str]:
    import numpy as np
    from transformers import AutoImageProcessor, AutoModelForDepthEstimation

    card, placement = model_card(model), place("cpu", "full")
    folder = require_folder(card, models_dir)
    network = load_network(AutoModelForDepthEstimation, card, folder, placement)
    processor = load_processor(AutoImageProcessor, card, folder)
    width, height = picture_px
    pixels = processor(images=np.zeros((height, width, 3), np.uint8), return_tensors="pt").pixel_values
    facts = {
        "part": "depth",
        "name": described(card, folder, placement, f"{pixels.shape[3]}x{pixels.shape[2]}px"),
        "rim": "zoedepth" if "zoedepth" in card.architectures else "",
        "mean": " ".join(map(str, processor.image_mean)),
        "std": " ".join(map(str, processor.image_std)),
    }

    write_depth(network, pixels, out, facts)
    return facts


def write_depth(network: Any, pixels: torch.Tensor, out: Path, facts: Mapping[str, str]) -> None:
    """Write a depth network for one picture of the size of `pixels`: (1, 3, h, w) to depth (1, h, w)."""

    def depth(network: Any, pixels: torch.Tensor) -> Any:
        return network(pixel_values=pixels).predicted_depth

    _write(network, depth, pixels, out, "depth", facts, batches=False)


def write_tokens(network: Any, side_px: int, out: Path, facts: Mapping[str, str]) -> None:
    """Write a patch encoder for crops of `side_px`: pixels (B, 3, S, S) to tokens (B, 1 + G * G, D), class first."""
    import torch

    skip = 1 + int(network.config.num_register_tokens)
    _fix_positions(network, side_px)

    def tokens(network: Any, pixels: torch.Tensor) -> Any:
        found = network(pixels).last_hidden_state
        return torch.cat([found[:, :1], found[:, skip:]], dim=1)

    _write(network, tokens, torch.zeros(2, 3, side_px, side_px), out, "tokens", facts, batches=True)


def _fix_positions(network: Any, side_px: int) -> None:
    """Resample DINOv2's position embedding once, for the one crop size: ONNX has no antialiased bicubic resampling."""
    embeddings = network.embeddings
    if hasattr(embeddings, "interpolate_pos_encoding"):  # DINOv3 has rotary ones, which are computed
        import torch

        with torch.inference_mode():
            grid = side_px // int(network.config.patch_size)
            tokens = torch.zeros(1, 1 + grid**2, int(network.config.hidden_size))
            fixed = embeddings.interpolate_pos_encoding(tokens, side_px, side_px).clone()
        embeddings.interpolate_pos_encoding = lambda tokens, height, width: fixed


def _write(
    network: Any, ask: Callable[..., Any], pixels: Any, out: Path, result: str, facts: Mapping[str, str], batches: bool
) -> None:
    """Write what `ask(network, pixels)` computes."""
    import torch

    class Asked(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network  # a part of it, so that its weights are the file's

        def forward(self, pixels: torch.Tensor) -> Any:
            return ask(self.network, pixels)

    axes = {"pixels": {0: "batch"}, result: {0: "batch"}} if batches else None
    with atomic_path(out) as temporary, _without_onnx_package(), warnings.catch_warnings(), torch.inference_mode():
        warnings.simplefilter("ignore")  # the tracer's, about sizes that are fixed here on purpose
        torch.onnx.export(
            Asked().eval(), (pixels,), str(temporary), dynamo=False, opset_version=OPSET, input_names=["pixels"],
            output_names=[result], dynamic_axes=axes,
        )  # fmt: skip
        with open(temporary, "ab") as stream:
            stream.write(metadata(facts))


@contextmanager
def _without_onnx_package() -> Iterator[None]:
    """Let torch export where the package `onnx` is missing.

    torch asks for it only to add functions written in onnxscript to the file, of which these networks have none.
    """
    if importlib.util.find_spec("onnx") is not None:
        yield
        return
    try:
        from torch.onnx._internal.torchscript_exporter import onnx_proto_utils as internal

        kept = internal._add_onnxscript_fn
    except (ImportError, AttributeError) as error:
        raise UserError("this version of torch exports only where onnx is installed: `pip install onnx`") from error
    internal._add_onnxscript_fn = lambda model_bytes, custom_opsets: model_bytes
    try:
        yield
    finally:
        internal._add_onnxscript_fn = kept


def metadata(facts: Mapping[str, str]) -> bytes:
    """Facts as entries of an ONNX file's metadata: in Protocol Buffers, what is appended joins a message's list."""
    entries = b""
    for key, value in facts.items():
        entry = _field(1, key.encode()) + _field(2, value.encode())
        entries += _field(METADATA_FIELD, entry)
    return entries


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited field of a Protocol Buffers message."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])
