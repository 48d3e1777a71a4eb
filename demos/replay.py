"""Playing a dataset's episodes again, from the dataset alone, and comparing where they end, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..extract.errors import UserError
from ..extract.files import sha256_of_file
from ..extract.stages import Progress, versions
from .episode import Episode, state_difference
from .rollout import ActionPlayer, make_env, roll_out
from .stored import RECORD_FOLDER, REFERENCE_FILE, read_collection, read_columns

# What the simulator's bits hang on; other versions of other packages only read and write files.
_PHYSICS = ("mujoco", "numpy", "vid2demo")


def replay(dataset: Path, episodes: Sequence[int] | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Re-run episodes (all by default) of a dataset that `collect` wrote.

    The environment is rebuilt from the dataset's own copy of the reference; the actions are those of the LeRobot
    parquet files. Returns {"episodes", "same_end", "success", "notes", "details"}: numbers of episodes re-run, that
    came to the bit-same end, and that succeeded; sentences about other versions; and per episode its differences in
    words. Raises UserError when the dataset is damaged or was not written by `collect`.
    """
    dataset = Path(dataset)
    collection = read_collection(dataset)
    records = collection["episodes"]
    chosen = range(len(records)) if episodes is None else episodes
    if outside := [index for index in chosen if not 0 <= index < len(records)]:
        raise UserError(f"{dataset} has episodes 0 to {len(records) - 1}, there is no episode {outside[0]}")
    reference = _whole_reference(dataset, collection)
    rows = read_columns(dataset, ["action", "episode_index"])
    env = make_env(collection["env_id"], reference, **_env_kwargs(collection))
    details = []
    try:
        for count, index in enumerate(chosen):
            stored = _whole_record(dataset, index, records[index])
            details.append(_replay_one(env, index, stored, rows["action"][rows["episode_index"] == index]))
            if progress is not None:
                same = sum(detail["same_end"] for detail in details)
                progress(count + 1, len(chosen), f"{same} of {count + 1} episodes end the same")
    finally:
        env.close()
    same_end = sum(detail["same_end"] for detail in details)
    return {
        "dataset": str(dataset),
        "episodes": len(details),
        "same_end": same_end,
        "success": sum(detail["success"] for detail in details),
        "notes": version_notes(collection["versions"]),
        "details": details,
    }


def version_notes(stored: Mapping[str, str]) -> list[str]:
    """One sentence per library that decides the simulator's bits and is not the one the dataset was made with."""
    here = versions()
    return [
        f"the dataset was made with {name} {stored[name]}, this is {name} {here.get(name, 'missing')}: "
        f"a bit-same end can only be expected from {name}=={stored[name]}"
        for name in _PHYSICS
        if name in stored and stored[name] != here.get(name)
    ]


def _replay_one(
    env: Any, index: int, stored: Episode, actions: np.ndarray[Any, np.dtype[np.float32]]
) -> dict[str, Any]:
    differences = []
    if actions.shape != stored.action.shape:
        differences.append(f"the dataset has {actions.shape[0]} actions, {stored.action.shape[0]} were played")
    elif actions.tobytes() != stored.action.tobytes():
        changed = np.flatnonzero((actions != stored.action).any(axis=1))
        gap = float(np.max(np.abs(actions - stored.action)))
        differences.append(
            f"{len(changed)} actions are not those played (first at step {changed[0]}, by up to {gap:.3g} rad)"
        )
    played = roll_out(env, ActionPlayer(actions), seed=stored.seed, options=stored.options)
    differences += [f"at the start, {words}" for words in state_difference(stored.start_state, played.start_state)[:3]]
    end = state_difference(stored.end_state, played.end_state)
    differences += [f"at the end, {words}" for words in end[:3]]
    return {
        "episode": index,
        "seed": stored.seed,
        "same_end": not end,
        "success": played.is_success,
        "poured_fraction": played.summary["poured_fraction"],
        "spilled_fraction": played.summary["spilled_fraction"],
        "differences": differences,
    }


def _env_kwargs(collection: Mapping[str, Any]) -> dict[str, Any]:
    # JSON has no tuples, spaces and sizes want them.
    return {
        name: tuple(value) if isinstance(value, list) else value for name, value in collection["env_kwargs"].items()
    }


def _whole_reference(dataset: Path, collection: Mapping[str, Any]) -> Path:
    path = dataset / REFERENCE_FILE
    _check_hash(path, collection["reference"]["sha256"])
    return path


def _whole_record(dataset: Path, index: int, record: Mapping[str, Any]) -> Episode:
    path = dataset / RECORD_FOLDER / record["file"]
    _check_hash(path, record["sha256"])
    episode = Episode.load(path)
    if episode.end_digest != record["end_digest"]:
        raise UserError(f"{path} does not hold episode {index} of the collection; collect the dataset again")
    return episode


def _check_hash(path: Path, expected: str) -> None:
    if not path.is_file():
        raise UserError(f"{path} is missing; copy the dataset again, with its meta/vid2demo folder")
    if sha256_of_file(path) != expected:
        raise UserError(f"{path} is damaged (its content does not have the recorded hash); copy the dataset again")


def as_text(report: Mapping[str, Any]) -> str:
    """The report of `replay` for a person: a line per episode that differs, and a last line with the count."""
    lines = list(report["notes"])
    for detail in report["details"]:
        if detail["differences"]:
            lines.append(f"episode {detail['episode']}: {'; '.join(detail['differences'])}")
    lines.append(f"{report['same_end']} of {report['episodes']} episodes end bit for bit as recorded")
    return "\n".join(lines)
