"""When a simulation diverges: the error, and the file from which the last good step can be looked at again."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.geometry import Array


class PhysicsError(RuntimeError):
    """The simulation has produced values that are not finite; the message names seed, step, state file and mend."""


def diverged_message(state: Mapping[str, Any], action: Any, seed: int | None, step: int) -> str:
    """Keep the environment's state before the step that diverged, and its action, in a file; what to tell the user."""
    where = ""
    try:
        path = Path(tempfile.mkdtemp(prefix="vid2demo-diverged-")) / "state.npz"
        arrays = {f"simulation/{name}": np.asarray(value) for name, value in state["simulation"].items()}
        rest = json.dumps({name: _plain(value) for name, value in state.items() if name != "simulation"})
        with atomic_path(path) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(
                stream, allow_pickle=False, rest=np.array(rest), action=np.asarray(action, np.float64), **arrays
            )
        where = f"; the state before it and the action are in {path} (envs.diverged.read_diverged_state)"
    except OSError:
        pass  # a full disk must not hide the divergence
    return (
        f"the simulation diverged at step {step} of the episode with seed {seed}{where}; "
        "reset the environment, and use a smaller timestep_s or fewer particles if it happens again"
    )


def read_diverged_state(path: Path | str) -> tuple[dict[str, Any], Array]:
    """State for `env.set_state` and action (A,) of a step that diverged. Raises UserError for any other file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            state = json.loads(str(archive["rest"]))
            parts = {name: archive[name] for name in archive.files if name.startswith("simulation/")}
            action = np.asarray(archive["action"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} holds no diverged state ({error}); its path is in the message of the error") from error
    return {**state, "simulation": {name.removeprefix("simulation/"): value for name, value in parts.items()}}, action


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
