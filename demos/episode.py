"""`Episode`: what one roll-out gave, with the seed and simulator states that let it be replayed bit for bit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.track import load_npz_with_header

SCHEMA = "vid2demo/episode"
SCHEMA_VERSION = 1
_SEPARATOR = "."

State = Mapping[str, Any]


@dataclass(frozen=True)
class CameraVideo:
    """One camera's frames of an episode, already encoded.

    mp4: the file's bytes (h264, yuv420p, constant frame rate).
    frame_count: number of frames in it.
    shape: (height, width) in px.
    histogram: (3, 256) pixels per channel (red, green, blue) and value, over all frames, before encoding.
    """

    mp4: bytes
    frame_count: int
    shape: tuple[int, int]
    histogram: NDArray[np.int64]


@dataclass(frozen=True)
class Episode:
    """One roll-out of T control steps. Row t holds what was observed before action t and what came after it.

    seed, options: what `env.reset` was given.
    action: (T, A) float32 exactly as played.
    agent_pos, environment_state: (T, S), (T, E) float32 observations before each action.
    reward: (T,) float32; success: (T,) bool, after each action.
    start_state, end_state: `env.get_state()` after the reset and after the last action.
    videos: camera name to its encoded frames (T of them); empty for a roll-out without rendering.
    summary: JSON-like figures of the roll-out (poured_fraction, spilled_fraction, max errors, ...).
    """

    seed: int
    options: Mapping[str, Any]
    action: NDArray[np.float32]
    agent_pos: NDArray[np.float32]
    environment_state: NDArray[np.float32]
    reward: NDArray[np.float32]
    success: NDArray[np.bool_]
    start_state: State
    end_state: State
    videos: Mapping[str, CameraVideo] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        steps = len(self.action)
        for name in ("agent_pos", "environment_state", "reward", "success"):
            if len(getattr(self, name)) != steps:
                raise ValueError(f"{name} has {len(getattr(self, name))} rows for {steps} actions")
        for camera, video in self.videos.items():
            if video.frame_count != steps:
                raise ValueError(f"camera {camera} has {video.frame_count} frames for {steps} actions")

    def __len__(self) -> int:
        return len(self.action)

    @property
    def is_success(self) -> bool:
        """Success at the end, not on the way."""
        return bool(len(self) and self.success[-1])

    @property
    def end_digest(self) -> str:
        return state_digest(self.end_state)

    def save(self, path: Path, *, replay_only: bool = False) -> None:
        """Write one npz file atomically; `replay_only` leaves out observations, rewards and frames."""
        start_arrays, start_values = flatten_state(self.start_state)
        end_arrays, end_values = flatten_state(self.end_state)
        arrays: dict[str, NDArray[Any]] = {"action": self.action}
        arrays |= {f"start.{name}": value for name, value in start_arrays.items()}
        arrays |= {f"end.{name}": value for name, value in end_arrays.items()}
        header: dict[str, Any] = {
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "seed": self.seed,
            "options": dict(self.options),
            "start": start_values,
            "end": end_values,
            "start_digest": state_digest(self.start_state),
            "end_digest": self.end_digest,
            "is_success": self.is_success,
            "summary": dict(self.summary),
        }
        if not replay_only:
            for name in ("agent_pos", "environment_state", "reward", "success"):
                arrays[name] = getattr(self, name)
            header["cameras"] = {}
            for camera, video in self.videos.items():
                arrays[f"mp4.{camera}"] = np.frombuffer(video.mp4, np.uint8)
                arrays[f"histogram.{camera}"] = video.histogram
                header["cameras"][camera] = {"frame_count": video.frame_count, "shape": list(video.shape)}
        arrays["header"] = np.array(json.dumps(header, allow_nan=False))
        with atomic_path(path) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]

    @staticmethod
    def load(path: Path) -> Episode:
        """Read an episode; one saved with `replay_only` comes back with observations of width zero."""
        arrays, header = load_npz_with_header(path, SCHEMA, SCHEMA_VERSION)
        try:
            action = arrays["action"]
            steps = len(action)
            empty = np.zeros((steps, 0), np.float32)
            success = np.zeros(steps, bool)
            if steps:
                success[-1] = header["is_success"]
            return Episode(
                seed=int(header["seed"]),
                options=header["options"],
                action=action,
                agent_pos=arrays.get("agent_pos", empty),
                environment_state=arrays.get("environment_state", empty),
                reward=arrays.get("reward", np.zeros(steps, np.float32)),
                success=arrays.get("success", success),
                start_state=_unflatten("start", arrays, header["start"]),
                end_state=_unflatten("end", arrays, header["end"]),
                videos={
                    camera: CameraVideo(
                        mp4=arrays[f"mp4.{camera}"].tobytes(),
                        frame_count=int(value["frame_count"]),
                        shape=(int(value["shape"][0]), int(value["shape"][1])),
                        histogram=arrays[f"histogram.{camera}"],
                    )
                    for camera, value in header.get("cameras", {}).items()
                },
                summary=header["summary"],
            )
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise UserError(f"{path} is not a whole episode ({error}); collect the dataset again") from error


def flatten_state(state: State) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and plain values of a nested state, each under its dotted path."""
    arrays: dict[str, NDArray[Any]] = {}
    values: dict[str, Any] = {}

    def visit(path: str, value: Any) -> None:
        if isinstance(value, Mapping) and all(isinstance(key, str) and _SEPARATOR not in key for key in value):
            if not value:
                values[path] = {}
            for key in value:
                visit(f"{path}{_SEPARATOR}{key}" if path else key, value[key])
        elif isinstance(value, np.ndarray):
            arrays[path] = value
        elif isinstance(value, np.generic):
            values[path] = value.item()
        else:
            values[path] = value

    visit("", state)
    return arrays, values


def state_digest(state: State) -> str:
    """Hex SHA-256 over every bit of a simulator state: names, dtypes, shapes, bytes and plain values."""
    arrays, values = flatten_state(state)
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}|{array.dtype.str}|{arrays[name].shape}|".encode())
        digest.update(array.tobytes())
    # Python's float repr is exact, so JSON text keeps every bit of a plain value too.
    digest.update(json.dumps(values, sort_keys=True).encode())
    return digest.hexdigest()


def state_difference(expected: State, found: State) -> list[str]:
    """What differs between two states, in words, largest first; empty when they are bit-equal."""
    (arrays_a, values_a), (arrays_b, values_b) = flatten_state(expected), flatten_state(found)
    words: list[tuple[float, str]] = []
    for name in sorted({*arrays_a, *arrays_b}):
        if name not in arrays_a or name not in arrays_b:
            words.append((np.inf, f"{name} is only in the {'new' if name in arrays_b else 'stored'} state"))
            continue
        a, b = arrays_a[name], arrays_b[name]
        if a.shape != b.shape or a.dtype != b.dtype:
            words.append((np.inf, f"{name} is {b.dtype}{b.shape} instead of {a.dtype}{a.shape}"))
        elif a.tobytes() != b.tobytes():
            gap = _largest_gap(a, b)
            words.append((gap, f"{name} differs by up to {gap:.3g}"))
    for name in sorted({*values_a, *values_b}):
        if json.dumps(values_a.get(name), sort_keys=True) != json.dumps(values_b.get(name), sort_keys=True):
            words.append((0.0, f"{name} is {_short(values_b.get(name))} instead of {_short(values_a.get(name))}"))
    return [text for _, text in sorted(words, key=lambda item: -item[0])]


def _largest_gap(a: NDArray[Any], b: NDArray[Any]) -> float:
    if a.dtype.kind not in "fiub":
        return np.inf
    return float(np.max(np.abs(a.astype(np.float64) - b.astype(np.float64)), initial=0.0))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _unflatten(prefix: str, arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> dict[str, Any]:
    state: dict[str, Any] = {}
    flat = {key.removeprefix(f"{prefix}."): array for key, array in arrays.items() if key.startswith(f"{prefix}.")}
    for path, value in {**flat, **values}.items():
        *parents, leaf = path.split(_SEPARATOR)
        node = state
        for parent in parents:
            node = node.setdefault(parent, {})
        node[leaf] = value
    return state
