"""Resumable stages: what is done is remembered in `run.json`, what has not changed is not done again.

A stage is skipped when `run.json` holds its key (a hash of the contents it reads, its settings and the code of the
rooms it uses) and everything it wrote is still there, unchanged. `run.json` is written after every stage and every
file appears under its name only when complete, so a run that is killed at any moment goes on where it was.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from .errors import UserError
from .files import sha256_of_file, write_json
from .progress import Listener
from .progress import Progress as Progress

SCHEMA = "vid2demo/run"
SCHEMA_VERSION = 1
RUN_FILE = "run.json"
PACKAGE_ROOT = Path(__file__).parents[1]
_PACKAGES = (
    "vid2demo",
    "numpy",
    "scipy",
    "mujoco",
    "mink",
    "gymnasium",
    "trimesh",
    "av",
    "opencv-python-headless",
    "lerobot",
)


class StageError(UserError):
    """Bad input that a stage met at work; `stage` is its name. The stages before it are done."""

    def __init__(self, stage: str, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@dataclass(frozen=True)
class Stage:
    """One step of a run.

    name: short and unique in the folder; key of `run.json`'s `stages`.  title: what a person reads while it runs.
    work: does it; is given `progress(done, total, text)` and returns figures (JSON-like).
    settings: everything but files that decides the result (JSON-like).
    inputs: files or folders read, by role.  outputs: files or folders written, relative to the run's folder.
    rooms: packages whose source decides the result, such as ("extract", "envs").
    """

    name: str
    title: str
    work: Callable[[Progress], Mapping[str, Any]]
    settings: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Path] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    rooms: tuple[str, ...] = ()

    def key(self) -> str:
        """Hex SHA-256 of all that decides the result. Raises UserError when an input is missing."""
        contents = {}
        for role, path in self.inputs.items():
            if (digest := content_hash(path)) is None:
                raise UserError(f"{role} {path} does not exist")
            contents[role] = digest
        parts = {
            "stage": self.name,
            "settings": self.settings,
            "inputs": contents,
            "outputs": self.outputs,
            "code": code_hash(self.rooms),
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


def content_hash(path: Path) -> str | None:
    """Hex SHA-256 of a file, or of the names and contents of all files below a folder; None when there is neither."""
    if path.is_file():
        return sha256_of_file(path)
    if not path.is_dir():
        return None
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        digest.update(f"{file.relative_to(path).as_posix()}\0{sha256_of_file(file)}\n".encode())
    return digest.hexdigest()


@cache
def code_hash(rooms: tuple[str, ...]) -> str:
    """Hex SHA-256 of the source files of some packages of vid2demo."""
    digest = hashlib.sha256()
    for room in sorted(rooms):
        for file in sorted((PACKAGE_ROOT / room).rglob("*.py")):
            digest.update(f"{file.relative_to(PACKAGE_ROOT).as_posix()}\0{sha256_of_file(file)}\n".encode())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python, vid2demo and the libraries that decide results."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def read_run(folder: Path) -> dict[str, Any] | None:
    """What `run.json` of a folder says; None when there is none. Raises UserError when it is damaged or newer."""
    path = folder / RUN_FILE
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        known = record["schema"] == SCHEMA and isinstance(record["stages"], dict)
        version = int(record["version"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged ({error}); delete it, and the stages are done again") from error
    if not known:
        raise UserError(f"{path} was not written by vid2demo; give another --out")
    if version > SCHEMA_VERSION:
        raise UserError(f"{path} has version {version}, this program reads up to {SCHEMA_VERSION}; update vid2demo")
    return dict(record)


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    command: str,
    settings: Mapping[str, Any],
    video: Mapping[str, Any] | None = None,
    force: bool = False,
    listener: Listener | None = None,
) -> dict[str, Any]:
    """Do the stages that are not done yet, in order, and return what `run.json` then says.

    command, settings: recorded for the reader of `run.json`.
    video: {"path", "sha256"} of the video that the folder belongs to, where there is one.
    force: do every stage again.
    Raises UserError when the folder belongs to another video, is no folder, or another process is at work in it, and
    StageError when a stage refuses its input.
    """
    listener = listener or Listener()
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder} is a file; name a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder} cannot be made ({error.strerror}); name another folder") from error
    with _only_one(folder):
        record = read_run(folder) or {"schema": SCHEMA, "version": SCHEMA_VERSION, "stages": {}}
        check_belongs(folder, record, video)
        for left_over in folder.glob(".*.part*"):  # of a run that was killed
            left_over.unlink(missing_ok=True)
        record |= {"command": command, "settings": dict(settings), "versions": versions()}
        record |= {"seeds": {"seed": settings["seed"]} if "seed" in settings else {}}
        record["machine"] = {"system": platform.platform(), "processors": os.cpu_count()}
        if video is not None:
            record["video"] = dict(video)
        for number, stage in enumerate(stages, start=1):
            key = stage.key()
            if not force and _is_done(folder, record["stages"].get(stage.name), key):
                listener.skipped(stage.title, number, len(stages))
                continue
            listener.started(stage.title, number, len(stages))
            _forget(folder, record, stage)
            _write(folder, record)
            begin_s = time.perf_counter()
            try:
                figures = stage.work(listener.progress)
            except BaseException as error:
                listener.failed(stage.title)
                if isinstance(error, UserError):
                    raise StageError(stage.name, str(error)) from error
                raise
            seconds = time.perf_counter() - begin_s
            record["stages"][stage.name] = {
                "key": key,
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "seconds": round(seconds, 3),
                "settings": dict(stage.settings),
                "versions": versions(),
                "inputs": {role: str(path) for role, path in stage.inputs.items()},
                "outputs": _output_hashes(folder, stage),
                "figures": plain(figures),
            }
            _write(folder, record)
            listener.finished(stage.title, seconds)
        _write(folder, record)
    return record


def check_belongs(folder: Path, record: Mapping[str, Any], video: Mapping[str, Any] | None) -> None:
    """Raise UserError when a folder's record is about another video."""
    owner = record.get("video")
    if owner and video and owner.get("sha256") != video["sha256"]:
        raise UserError(
            f"{folder} belongs to the video {owner.get('path')}, not to {video['path']}; "
            "give another --out, or delete the folder"
        )


def _is_done(folder: Path, done: Mapping[str, Any] | None, key: str) -> bool:
    if done is None or done.get("key") != key:
        return False
    return all(content_hash(folder / name) == digest for name, digest in done["outputs"].items())


def _output_hashes(folder: Path, stage: Stage) -> dict[str, str]:
    hashes = {name: content_hash(folder / name) for name in stage.outputs}
    if missing := [name for name, digest in hashes.items() if digest is None]:
        raise RuntimeError(f"stage {stage.name} did not write {', '.join(missing)}")
    return {name: digest for name, digest in hashes.items() if digest is not None}


def _forget(folder: Path, record: dict[str, Any], stage: Stage) -> None:
    """Drop a stage's old record, and what it wrote under names that nothing writes any more."""
    old = record["stages"].pop(stage.name, None)
    if old is None:
        return
    kept = {name for other in record["stages"].values() for name in other["outputs"]} | set(stage.outputs)
    for name in set(old["outputs"]) - kept:
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _write(folder: Path, record: dict[str, Any]) -> None:
    done = record["stages"]
    record["timings_s"] = {name: stage["seconds"] for name, stage in done.items()}
    record["figures"] = {name: stage["figures"] for name, stage in done.items()}
    write_json(folder / RUN_FILE, {name: record[name] for name in sorted(record, key=_place)})


def _place(name: str) -> int:
    """Where a reader of `run.json` looks for an entry: what was asked first, hashes last."""
    order = (
        "schema",
        "version",
        "command",
        "video",
        "settings",
        "seeds",
        "timings_s",
        "figures",
        "versions",
        "machine",
    )
    return order.index(name) if name in order else len(order)


@contextmanager
def _only_one(folder: Path) -> Iterator[None]:
    """Hold the folder for this process; the system lets go of it however the process ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(f"another vid2demo is at work in {folder}; wait for it, or give another --out") from error
        yield
    finally:
        os.close(handle)


def plain(value: Any) -> Any:
    """The same value as JSON has it: NumPy's numbers and arrays become Python's, paths text, NaN and infinity None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
