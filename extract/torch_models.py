"""Loading networks with transformers: where they run, in which precision, and that nothing is missing.

Everything here loads torch when it is called, never when it is imported.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from .errors import UserError
from .model_folder import complaint, fingerprint, pull_command
from .models import ModelCard

if TYPE_CHECKING:
    import torch

Device = Literal["auto", "cpu", "cuda", "mps"]
Precision = Literal["auto", "full", "half"]
NEEDS = {"torch": "torch", "transformers": "transformers", "safetensors": "safetensors", "torchvision": "torchvision"}


@dataclass(frozen=True)
class Placement:
    """Where a network runs and what its numbers are: "float32", "float16" or "bfloat16"."""

    device: str
    precision: str

    @property
    def dtype(self) -> torch.dtype:
        import torch

        return {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}[self.precision]

    @property
    def batch(self) -> int:
        """How many crops of 420 px go through a ViT-L at once: under 2 GB of activations on a CPU, 8 GB elsewhere."""
        return 8 if self.device == "cpu" else 64


def place(device: str = "auto", precision: Precision = "auto") -> Placement:
    """Where to run: "auto" takes a CUDA device, else Apple's, else the CPU; and half precision where it is faster.

    device: "auto", "cpu", "mps", "cuda" or "cuda:N".  precision: "half" is bfloat16 where the device has it (the
    paper's), else float16; on a CPU "auto" is full.  Raises UserError for a device this machine lacks.
    """
    require_packages()
    import torch

    mps = torch.backends.mps.is_available()
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "mps" if mps else "cpu"
    numbered = [f"cuda:{n}" for n in range(torch.cuda.device_count())]
    there = ["cpu", *(["mps"] if mps else []), *(["cuda"] if numbered else []), *numbered]
    if device not in there:
        raise UserError(f"--device {device}: torch on this machine can use {', '.join(there)}")
    kind = device.partition(":")[0]
    if precision == "full" or (precision == "auto" and kind == "cpu"):
        return Placement(device, "float32")
    bfloat = kind == "cpu" or (kind == "cuda" and torch.cuda.is_bf16_supported())
    return Placement(device, "bfloat16" if bfloat else "float16")


def packages_missing() -> list[str]:
    """Packages that networks need and this environment lacks."""
    return [name for name in NEEDS if importlib.util.find_spec(name) is None]


def require_packages() -> None:
    """Raise UserError with the command that installs them when torch or transformers is missing."""
    if missing := packages_missing():
        raise UserError(f"neural models need {', '.join(missing)}; install with `pip install 'vid2demo[models]'`")


def load_network(kind: Any, card: ModelCard, folder: Path, placement: Placement, config: Any = None) -> Any:
    """A network of a transformers class from a folder, ready to be asked.

    config: its configuration where that must differ from what transformers makes of the folder's.
    Only safetensors are read, no code of the checkpoint's is run, and the network is never looked for elsewhere.
    Raises UserError for a wrong or incomplete folder, damaged files, and weights that the network needs and the
    checkpoint lacks (transformers would fill them with random numbers).
    """
    if why := complaint(card, folder):
        raise UserError(f"{folder} {why}; get {card.name} with `{pull_command(card)}`")
    try:
        with _quietly():
            network, report = kind.from_pretrained(
                folder, local_files_only=True, use_safetensors=True, trust_remote_code=False, output_loading_info=True,
                dtype=placement.dtype, config=config,
            )  # fmt: skip
    except Exception as error:  # safetensors, JSON and shape errors come in many kinds
        raise UserError(f"{folder} cannot be read as {card.name} ({error}); fetch it again") from error
    absent = sorted(report["missing_keys"]) + sorted(str(entry[0]) for entry in report["mismatched_keys"])
    if absent:
        raise UserError(
            f"{folder} lacks {len(absent)} of the weights of {card.name}, such as {absent[0]}; fetch it again"
        )
    return network.to(placement.device).eval()


@contextmanager
def _quietly() -> Iterator[None]:
    """Without the bars and remarks of transformers; what matters of them is raised by `load_network`."""
    from transformers.utils import logging as module

    logging: Any = module  # its functions are not typed
    drawn, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if drawn:
            logging.enable_progress_bar()


def load_processor(kind: Any, card: ModelCard, folder: Path) -> Any:
    """What prepares the input of a network, from its folder. Raises UserError when its files are missing."""
    try:
        with _quietly():
            return kind.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    except Exception as error:  # as above
        raise UserError(f"{folder} lacks the pre-processing of {card.name} ({error}); fetch it again") from error


def described(card: ModelCard, folder: Path, placement: Placement, *settings: str) -> str:
    """A name that holds everything that changes the numbers: model, settings, precision and the weights themselves."""
    half = [] if placement.precision == "float32" else [placement.precision]
    return "-".join([card.name, *settings, *half, fingerprint(folder)])
