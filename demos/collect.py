"""Collecting verified demonstrations: seeded attempts, the successful ones replayed, a LeRobot dataset at the end.

The result hangs on reference, settings and seed alone: not on the number of workers, and not on how often the work
was interrupted. Until the dataset is whole it lives in a hidden work folder beside its final place.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..envs.reference import Reference
from ..extract.errors import UserError
from ..extract.files import sha256_of_file, write_json
from ..extract.stages import Progress, code_hash, plain, versions
from .attempt import AttemptRunner, AttemptSettings, episode_file
from .dataset import import_lerobot, require_lerobot, write_dataset
from .rollout import DEFAULT_ENV_ID
from .stored import COLLECTION_FILE, check_dataset, read_collection
from .workers import attempts_in_order

ROOMS = ("extract", "envs", "demos")
# Below this yield the motion should be mended instead of tried more often.
ATTEMPTS_PER_EPISODE = 5
MIN_ATTEMPTS = 20
HOPELESS_AFTER = 20


def collect(
    reference_path: Path,
    out: Path,
    *,
    episodes: int = 10,
    seed: int = 0,
    cameras: Sequence[str] = ("front", "wrist"),
    image_size: tuple[int, int] = (224, 224),
    workers: int = 1,
    max_attempts: int | None = None,
    env_id: str = DEFAULT_ENV_ID,
    env_kwargs: Mapping[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a dataset of `episodes` successful, replayed roll-outs of a reference to the folder `out`.

    image_size: (height, width) in px, even numbers.  env_kwargs: further arguments of the environment.
    workers: processes; more than one needs a main module that can be imported (`if __name__ == "__main__":`).
    max_attempts: 5 per episode by default, at least 20. When it is reached with fewer successes than asked for, the
        dataset holds those there are and the returned `complete` is False.
    force: replace a dataset at `out` that was made from another reference or with other settings.
    Returns figures (JSON-like): episodes, attempts tried, succeeded and failed by reason, dataset path.
    Raises UserError on bad input, when `out` holds something else, and when no attempt succeeds.
    """
    reference_path, out = Path(reference_path), Path(out)
    _check_input(episodes, workers, image_size, cameras)
    limit = max_attempts or max(MIN_ATTEMPTS, ATTEMPTS_PER_EPISODE * episodes)
    reference = Reference.load(reference_path)
    require_lerobot()
    settings = AttemptSettings(
        reference=str(reference_path.resolve()),
        seed=seed,
        cameras=tuple(cameras),
        image_size=(int(image_size[0]), int(image_size[1])),
        env_id=env_id,
        env_kwargs=plain(env_kwargs or {}),
    )
    identity = _identity(settings)
    if (found := _existing(out, identity, episodes, limit, force)) is not None:
        return found
    work = out.parent / f".{out.name}.work"
    with _only_one(work):
        attempts_folder = _attempts_folder(work, identity)
        runner = AttemptRunner(settings, attempts_folder)
        if workers > 1:
            # This process only waits while the others work: it may as well load what it will need at the end.
            threading.Thread(target=import_lerobot, daemon=True).start()
        try:
            layout = runner.layout(task_of(reference))
            kept, failed, tried = _attempt(settings, attempts_folder, episodes, limit, workers, runner, progress)
        finally:
            runner.close()
        attempts = {"tried": tried, "succeeded": len(kept), "failed": dict(sorted(failed.items()))}
        if not kept:
            raise UserError(_nothing_succeeded(reference_path, attempts))
        collection = {
            **identity,
            "env_kwargs": plain(settings.physics_kwargs()),
            "reference": {"name": reference_path.name, "sha256": identity["reference_sha256"]},
            "task": layout.task,
            "requested_episodes": episodes,
            "attempts": attempts,
            "versions": versions(),
        }
        part = work / "dataset"
        shutil.rmtree(part, ignore_errors=True)
        files = [episode_file(attempts_folder, index) for index in kept]
        write_dataset(part, files, layout, reference_path, collection)
        if out.exists():
            os.rename(out, work / "replaced")
        os.rename(part, out)
        shutil.rmtree(work)
    return _figures(out, read_collection(out))


def useful_workers(episodes: int) -> int:
    """As many processes as this machine has processors for, and no more than there are episodes."""
    return max(1, min(len(os.sched_getaffinity(0)), episodes))


def task_of(reference: Reference) -> str:
    """The task in words, such as "pour from the gooseneck kettle into the mug"."""

    def name(entry: Mapping[str, Any], otherwise: str) -> str:
        return str(entry.get("library", {}).get("category", otherwise)).replace("_", " ")

    vessel = name(reference.header.get("vessel") or {}, "vessel")
    if not reference.has_receptacle:
        return f"pour from the {vessel}"
    return f"pour from the {vessel} into the {name(reference.header['receptacle'], 'receptacle')}"


def _attempt(
    settings: AttemptSettings,
    folder: Path,
    episodes: int,
    limit: int,
    workers: int,
    runner: AttemptRunner,
    progress: Progress | None,
) -> tuple[list[int], Counter[str], int]:
    """Indices of the attempts kept, failures by reason, number of attempts made."""
    kept: list[int] = []
    failed: Counter[str] = Counter()
    tried = 0
    with closing(attempts_in_order(settings, folder, limit, workers, lambda: runner)) as results:
        for result in results:
            tried += 1
            if result["ok"]:
                kept.append(int(result["index"]))
            else:
                failed[result["reason"]] += 1
            if progress is not None:
                progress(len(kept), episodes, f"{len(kept)} of {tried} attempts succeeded")
            if len(kept) == episodes or (tried == HOPELESS_AFTER and not kept):
                break
    return kept, failed, tried


def _check_input(episodes: int, workers: int, image_size: Sequence[int], cameras: Sequence[str]) -> None:
    for name, value in (("episodes", episodes), ("workers", workers)):
        if value < 1:
            raise UserError(f"--{name} is {value}, it must be at least 1")
    if len(image_size) != 2 or any(side < 16 or side % 2 for side in image_size):
        raise UserError(f"the image size is {tuple(image_size)}, both sides must be even and at least 16 px for h264")
    if not cameras or len(set(cameras)) != len(cameras):
        raise UserError(f"the cameras are {tuple(cameras)}, name at least one and none twice")


def _identity(settings: AttemptSettings) -> dict[str, Any]:
    """All that decides the attempts; two datasets with equal identity have equal episodes."""
    chosen = {name: value for name, value in versions().items() if name not in ("vid2demo", "lerobot", "av")}
    return {
        **plain(asdict(settings) | {"reference": None}),
        "reference_sha256": sha256_of_file(Path(settings.reference)),
        "env_kwargs": plain(settings.physics_kwargs()),
        "libraries": chosen,
        "code_sha256": code_hash(ROOMS),
    }


def _existing(out: Path, identity: Mapping[str, Any], episodes: int, limit: int, force: bool) -> dict[str, Any] | None:
    """Figures of the dataset at `out` when it is what is asked for; None when it is to be made."""
    if not out.exists():
        return None
    if out.is_dir() and not any(out.iterdir()):
        out.rmdir()
        return None
    if not (out / COLLECTION_FILE).is_file():
        raise UserError(f"{out} exists and is no dataset that `collect` wrote; name another --out")
    try:
        stored = read_collection(out)
        check_dataset(out)
    except UserError as error:
        if force:
            return None
        raise UserError(f"{error} with --force, or name another --out") from error
    words = []
    if stored.get("reference", {}).get("sha256") != identity["reference_sha256"]:
        words.append(f"another reference ({stored.get('reference', {}).get('name')})")
    for name in ("seed", "cameras", "image_size", "env_id", "env_kwargs", "libraries", "code_sha256"):
        if stored.get(name) != identity[name]:
            words.append("another version of vid2demo" if name == "code_sha256" else f"other {name.replace('_', ' ')}")
    if not words:
        # Fewer than asked for is all there is to have when as many attempts were made as are allowed now.
        whole = len(stored["episodes"]) == episodes or stored["attempts"]["tried"] >= limit
        return _figures(out, stored) if whole and stored["requested_episodes"] == episodes else None
    if force:
        return None
    raise UserError(
        f"{out} holds a dataset made from {', '.join(words)}; name another --out or replace it with --force"
    )


def _attempts_folder(work: Path, identity: Mapping[str, Any]) -> Path:
    """The folder of finished attempts; emptied when they were made with other settings."""
    settings_file, folder = work / "settings.json", work / "attempts"
    try:
        same = json.loads(settings_file.read_text(encoding="utf-8")) == identity
    except (OSError, ValueError):
        same = False
    if not same:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(exist_ok=True)
    for left_over in folder.glob(".*.part*"):
        left_over.unlink(missing_ok=True)
    write_json(settings_file, identity)
    return folder


@contextmanager
def _only_one(work: Path) -> Iterator[None]:
    """Hold the work folder for this process; the system lets go of it however the process ends."""
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {work.parent} cannot be made ({error.strerror}); name another folder") from error
    handle = os.open(work, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise UserError(f"another collect is at work in {work}; wait for it, or name another --out") from error
    finally:
        os.close(handle)


def _nothing_succeeded(reference_path: Path, attempts: Mapping[str, Any]) -> str:
    reasons = ", ".join(f"{reason}: {count}" for reason, count in attempts["failed"].items())
    return (
        f"none of {attempts['tried']} attempts at {reference_path} succeeded ({reasons}); look at simulation.mp4 and "
        "feasibility.json, and retarget with another --scale"
    )


def _figures(out: Path, collection: Mapping[str, Any]) -> dict[str, Any]:
    count = len(collection["episodes"])
    return {
        "dataset": str(out),
        "task": collection["task"],
        "episodes": count,
        "requested_episodes": collection["requested_episodes"],
        "complete": count == collection["requested_episodes"],
        "frames": sum(int(episode["length"]) for episode in collection["episodes"]),
        "attempts": collection["attempts"],
        "poured_fraction": [episode["summary"].get("poured_fraction") for episode in collection["episodes"]],
        "spilled_fraction": [episode["summary"].get("spilled_fraction") for episode in collection["episodes"]],
    }
