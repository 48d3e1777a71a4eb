"""Where the weights of a network lie on this machine, whether they are all there, and fetching them.

A models folder has one folder a network, named as in `vid2demo models list`. What the Hugging Face hub's own tools have
put into their cache is found as well. Only safetensors files count: they hold numbers and cannot run code.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import os
from pathlib import Path
from typing import Any

from .errors import UserError
from .files import write_json
from .models import ModelCard

FOLDER_VARIABLE = "VID2DEMO_MODELS"
RECEIPT = "vid2demo.json"  # what `pull` leaves beside the weights: repository and revision
FETCHED = ("*.json", "*.txt", "*.model", "model.safetensors", "model-*-of-*.safetensors")
SAMPLE_BYTES = 1 << 16


def models_folder(given: Path | None = None) -> Path:
    """The folder of all networks: the given one, else $VID2DEMO_MODELS, else ~/.cache/vid2demo/models."""
    named = given or os.environ.get(FOLDER_VARIABLE)
    return Path(named).expanduser() if named else Path.home() / ".cache/vid2demo/models"


def complaint(card: ModelCard, folder: Path) -> str | None:
    """Why a folder does not hold the network, in words that follow "it"; None when all is there."""
    if not folder.is_dir():
        return "does not exist"
    if card.checkpoint is not None:
        return None if (folder / card.checkpoint).is_file() else f"holds no {card.checkpoint}"
    if not (folder / "config.json").is_file():
        return "holds no config.json"
    found = read_json(folder / "config.json").get("model_type")
    if found not in card.architectures:
        return f"holds a network of type {found!r}, not {' or '.join(map(repr, card.architectures))}"
    missing = [name for name in weight_files(folder) if not (folder / name).is_file()]
    return f"lacks {missing[0]}" if missing else None


def weight_files(folder: Path) -> list[str]:
    """Names of the safetensors files a folder has or should have."""
    index = folder / "model.safetensors.index.json"
    if not index.is_file():
        return ["model.safetensors"]
    return sorted(set(read_json(index).get("weight_map", {}).values())) or ["model.safetensors"]


def find_folder(card: ModelCard, folder: Path | None = None) -> tuple[Path | None, str]:
    """Where the weights are, and in words where that is; (None, why not) when they are not on this machine."""
    own = models_folder(folder) / card.name
    why = complaint(card, own)
    if why is None:
        return own, str(own)
    cached = _hub_cache(card)
    if cached is not None and complaint(card, cached) is None:
        return cached, f"the hub's cache, {cached}"
    return None, f"{own} {why}"


def require_folder(card: ModelCard, folder: Path | None = None) -> Path:
    """Where the weights are. Raises UserError with the command that fetches them when they are not there."""
    found, why = find_folder(card, folder)
    if found is None:
        raise UserError(
            f"the weights of {card.name} are not at hand: {why}; get them with `{pull_command(card, folder)}`"
        )
    return found


def pull_command(card: ModelCard, folder: Path | None = None) -> str:
    """The command line that fetches a network to where it was looked for."""
    where = "" if folder is None else f" --models-dir {folder}"
    return f"vid2demo models pull {card.name}{where}"


def fingerprint(folder: Path) -> str:
    """Eight characters that tell weights apart: a hash of the configuration and of the ends of each weight file.

    A gigabyte is not read for it; checkpoints that differ do so in their headers, sizes or last numbers.
    """
    return _fingerprint(folder, tuple((folder / name).stat().st_mtime_ns for name in weight_files(folder)))


@functools.lru_cache(maxsize=32)
def _fingerprint(folder: Path, times: tuple[int, ...]) -> str:
    digest = hashlib.sha256((folder / "config.json").read_bytes())
    for name in weight_files(folder):
        path = folder / name
        size = path.stat().st_size
        digest.update(size.to_bytes(8, "little"))
        with open(path, "rb") as stream:
            digest.update(stream.read(SAMPLE_BYTES))
            stream.seek(max(0, size - SAMPLE_BYTES))
            digest.update(stream.read(SAMPLE_BYTES))
    return digest.hexdigest()[:8]


def pull(card: ModelCard, folder: Path | None = None) -> Path:
    """Fetch a network from the hub, at its pinned revision, into `folder`/NAME; what is there already is kept.

    An interrupted download goes on where it stopped. Returns the network's folder.
    Raises UserError when the hub cannot be reached, refuses, or lacks files.
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        raise UserError("fetching models needs huggingface_hub; install it with `pip install 'vid2demo[models]'`")
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import GatedRepoError

    target = models_folder(folder) / card.name
    receipt = target / RECEIPT
    if complaint(card, target) is None and receipt.is_file() and read_json(receipt).get("revision") == card.revision:
        return target
    patterns = list(FETCHED) if card.checkpoint is None else [card.checkpoint]
    try:
        snapshot_download(card.repository, revision=card.revision, local_dir=target, allow_patterns=patterns)
    except GatedRepoError as error:
        raise UserError(
            f"{card.repository} asks that its licence be accepted ({card.licence}): do so on its page of the hub, log "
            f"in with `hf auth login`, and call `{pull_command(card, folder)}` again"
        ) from error
    except Exception as error:  # the hub's client raises its own, httpx's and the system's errors
        raise UserError(
            f"{card.repository} could not be fetched ({type(error).__name__}: {_first_line(error)}); where there is a "
            f"network call `vid2demo models pull {card.name} --models-dir DIR`, and copy DIR/{card.name} to {target}"
        ) from error
    if why := complaint(card, target):
        raise UserError(f"{card.repository} at {card.revision} is not as expected: {target} {why}")
    write_json(receipt, {"repository": card.repository, "revision": card.revision, "licence": card.licence})
    return target


def _hub_cache(card: ModelCard) -> Path | None:
    """The snapshot in the hub's cache at the card's revision."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    home = os.environ.get("HF_HOME") or Path(base) / "huggingface"
    cache = Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()
    # Looked at first: the hub's package takes half a second to load, and most machines have nothing there.
    if not (cache / f"models--{card.repository.replace('/', '--')}").is_dir():
        return None
    if importlib.util.find_spec("huggingface_hub") is None:
        return None
    from huggingface_hub import try_to_load_from_cache

    first = card.checkpoint or "config.json"
    found = try_to_load_from_cache(card.repository, first, cache_dir=cache, revision=card.revision)
    return Path(found).parent if isinstance(found, str) else None


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file of a model's folder. Raises UserError when it is damaged."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise UserError(f"{path} is damaged ({error}); fetch the model again") from error
    if not isinstance(value, dict):
        raise UserError(f"{path} is damaged (no JSON object); fetch the model again")
    return value


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no reason given"])[0][:200]
