"""`JointTrajectory`: what the arm's joints do, and its file `*.joints.npz`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.geometry import Array
from ..extract.track import load_npz_with_header

SCHEMA = "vid2demo/joint-trajectory"
SCHEMA_VERSION = 1
_SHAPES: dict[str, tuple[int, ...]] = {"time_s": (), "q_rad": (7,), "dq_rad_s": (7,), "tau_nm": (7,), "gripper_m": ()}


@dataclass(frozen=True)
class JointTrajectory:
    """Motion of the Panda's seven joints and of its fingers.

    time_s: (N,) in equal steps from 0. q_rad, dq_rad_s, tau_nm: (N, 7), torque with gravity and the empty vessel.
    gripper_m: (N,) position of each finger, half of what they span.
    header: JSON-like; tracking errors against the reference, margins to the limits, payload.
    """

    time_s: Array
    q_rad: Array
    dq_rad_s: Array
    tau_nm: Array
    gripper_m: Array
    header: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.time_s)
        for name, rest in _SHAPES.items():
            value = np.asarray(getattr(self, name))
            if value.shape != (n, *rest):
                raise ValueError(f"{name} has shape {value.shape}, expected {(n, *rest)}")
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name} contains values that are not finite")
        if n < 2 or np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s must hold at least 2 rising times")

    def __len__(self) -> int:
        return len(self.time_s)

    def save(self, path: Path) -> None:
        """Write `*.joints.npz` atomically."""
        header = {
            **self.header,
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "units": {"angle": "rad", "torque": "N m", "gripper": "m", "time": "s"},
            "joints": [f"panda_joint{i}" for i in range(1, 8)],
        }
        arrays = {name: np.asarray(getattr(self, name), np.float64) for name in _SHAPES}
        text = json.dumps(header, allow_nan=False)
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, header=np.array(text), **arrays)  # type: ignore[arg-type]

    @staticmethod
    def load(path: Path) -> JointTrajectory:
        """Read a trajectory. Raises UserError when the file is missing, damaged or of another kind."""
        arrays, header = load_npz_with_header(Path(path), SCHEMA, SCHEMA_VERSION)
        if missing := [name for name in _SHAPES if name not in arrays]:
            raise UserError(f"{path} lacks {', '.join(missing)}; write it again with `vid2demo retarget`")
        try:
            return JointTrajectory(**{name: arrays[name] for name in _SHAPES}, header=header)
        except ValueError as error:
            raise UserError(f"{path} is not a valid joint trajectory: {error}") from error
