"""Patch encoders and depth by torch and by ONNX Runtime: seconds a crop or picture, and how far the results differ.

The networks have the real sizes and random weights, for the time does not depend on what they have learned.
Run it on the machine in question: `python bench/networks.py --models dinov2-small dinov2-large --threads 1`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from vid2demo.extract.neural_features import cut_after
from vid2demo.extract.onnx_export import write_depth, write_tokens
from vid2demo.extract.onnx_models import open_network

# Width, blocks and heads of the three sizes (model cards of facebook/dinov2-with-registers-*).
SIZES = {"small": (384, 12, 6), "base": (768, 12, 12), "large": (1024, 24, 16)}
# Feature sizes of Depth Anything V2's heads, and the blocks they read (its model cards).
HEADS = {"small": ([48, 96, 192, 384], 64, [3, 6, 9, 12]), "large": ([256, 512, 1024, 1024], 256, [5, 12, 18, 24])}
SIDE_PX, REGISTERS = 420, 4
DEPTH_PX = (392, 518)  # what a 640 x 480 picture becomes


class Seconds(NamedTuple):
    """Time by the clock, and of all threads together, which a busy machine hardly changes."""

    clock: float
    processor: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    names = [f"dinov2-{size}" for size in SIZES] + [f"depth-anything-{size}" for size in HEADS]
    parser.add_argument("--models", nargs="+", choices=names, default=["dinov2-small", "depth-anything-small"])
    parser.add_argument("--threads", type=int, default=1, help="Threads of each runtime.")
    parser.add_argument("--batch", type=int, default=1, help="Crops at once.")
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    import torch

    torch.set_num_threads(chosen.threads)
    torch.manual_seed(0)
    print(f"{'':<22}{'milliseconds':>22}{'of processor':>22}")
    print(f"{'network':<22}{'torch':>11}{'ONNX':>11}{'torch':>11}{'ONNX':>11}  largest difference")
    for name in chosen.models:
        by_torch, by_onnx, difference = measure(name, chosen.threads, chosen.batch, chosen.repeats)
        times = (by_torch.clock, by_onnx.clock, by_torch.processor, by_onnx.processor)
        print(f"{name:<22}{''.join(f'{1e3 * t:11.0f}' for t in times)}  {difference:.1e}", flush=True)


def measure(name: str, threads: int, batch: int, repeats: int) -> tuple[Seconds, Seconds, float]:
    """Seconds a crop or picture by torch and by ONNX Runtime, and the largest difference over the largest value."""
    import torch

    kind, _, size = name.rpartition("-")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.onnx"
        if kind == "dinov2":
            network, part, height, width = patch_encoder(size), "features", SIDE_PX, SIDE_PX
            shown = np.random.default_rng(0).standard_normal((batch, 3, height, width)).astype(np.float32)
            by_torch, theirs = timed(lambda: network(torch.from_numpy(shown)).last_hidden_state.numpy(), repeats)
            theirs = np.delete(theirs, range(1, 1 + REGISTERS), axis=1)
            write_tokens(network, SIDE_PX, path, {"part": part})
        else:
            network, part, (height, width), batch = depth_network(size), "depth", DEPTH_PX, 1
            shown = np.random.default_rng(0).standard_normal((batch, 3, height, width)).astype(np.float32)
            by_torch, theirs = timed(lambda: network(torch.from_numpy(shown)).predicted_depth.numpy(), repeats)
            write_depth(network, torch.from_numpy(shown), path, {"part": part})
        session, _ = open_network(path, part, threads)
        by_onnx, ours = timed(lambda: session.run(None, {"pixels": shown})[0], repeats)
    each = [Seconds(times.clock / batch, times.processor / batch) for times in (by_torch, by_onnx)]
    return each[0], each[1], float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def timed(work: Callable[[], Any], repeats: int) -> tuple[Seconds, Any]:
    """The least time of some runs after a first one, by the clock and of the processor, and the result."""
    import torch

    spent = []
    with torch.inference_mode():
        result = work()
        for _ in range(repeats):
            clock, processor = time.perf_counter(), time.process_time()
            work()
            spent.append((time.perf_counter() - clock, time.process_time() - processor))
    return Seconds(*np.min(spent, axis=0)), result


def patch_encoder(size: str) -> Any:
    """DINOv2 with registers, cut after the paper's share of its blocks, with random weights."""
    from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

    width, blocks, heads = SIZES[size]
    config = Dinov2WithRegistersConfig(
        hidden_size=width, num_hidden_layers=blocks, num_attention_heads=heads, patch_size=14, image_size=518,
        num_register_tokens=REGISTERS,
    )  # fmt: skip
    return cut_after(Dinov2WithRegistersModel(config).eval(), None, size)


def depth_network(size: str) -> Any:
    """Depth Anything V2 (metric) with random weights."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation

    width, blocks, heads = SIZES[size]
    neck, fusion, read = HEADS[size]
    backbone = {
        "model_type": "dinov2", "hidden_size": width, "num_hidden_layers": blocks, "num_attention_heads": heads,
        "patch_size": 14, "image_size": 518, "out_indices": read, "reshape_hidden_states": False,
        "apply_layernorm": True,
    }  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=width, neck_hidden_sizes=neck, fusion_hidden_size=fusion,
        depth_estimation_type="metric", max_depth=20,
    )  # fmt: skip
    return DepthAnythingForDepthEstimation(config).eval()


if __name__ == "__main__":
    main()
