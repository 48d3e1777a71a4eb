"""`ObjectTrack`: the 6D trajectory of one object in one video, and its public file format `*.track.npz`."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError
from .files import atomic_path
from .geometry import Array, Symmetry

SCHEMA = "vid2demo/object-track"
SCHEMA_VERSION = 2  # 2: T_first_camera, where 1 had R_first_camera, of cameras that turn in place only
OPTIONAL = ("T_first_camera", "T_camera_object_raw")  # arrays that a file may lack


@dataclass(frozen=True)
class ObjectTrack:
    """Pose of one object in every frame of a video.

    T_camera_object: (N, 4, 4) poses; camera frame as in OpenCV, translation in m.
    time_s: (N,) presentation time of each frame, strictly increasing.
    camera_matrix: (3, 3) pinhole intrinsics in px.
    confidence: (N,) in [0, 1].
    visible: (N,) bool, False where the object is out of view or lost.
    header: JSON-like; `object`, `mesh` (name, sha256, extents_m, symmetry, up_axis, and for library vessels
        `library` = {category, params}), `image_size_px` [w, h], `video`, `camera`, `settings`.
    T_first_camera: (N, 4, 4) pose of each frame's camera in the first frame's, in m; its translation is zero for a
        camera that turns in place. None for one that stands still.
    T_camera_object_raw: (N, 4, 4) the poses before smoothing; None where they were not smoothed.
    """

    T_camera_object: Array
    time_s: Array
    camera_matrix: Array
    confidence: Array
    visible: np.ndarray[Any, np.dtype[np.bool_]]
    header: Mapping[str, Any] = field(default_factory=dict)
    T_first_camera: Array | None = None
    T_camera_object_raw: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.time_s)
        expected = {
            "T_camera_object": (n, 4, 4),
            "time_s": (n,),
            "camera_matrix": (3, 3),
            "confidence": (n,),
            "visible": (n,),
        }
        if self.T_first_camera is not None:
            expected["T_first_camera"] = (n, 4, 4)
        if self.T_camera_object_raw is not None:
            expected["T_camera_object_raw"] = (n, 4, 4)
        for name, shape in expected.items():
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
            if not np.all(np.isfinite(value)):
                raise ValueError(_not_finite(name, value, n))
        if n == 0:
            raise ValueError("a track needs at least one frame")
        if np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s must be strictly increasing")

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def name(self) -> str:
        return str(self.header.get("object", "object"))

    @property
    def symmetry(self) -> Symmetry:
        mesh = self.header.get("mesh", {})
        return Symmetry.from_json(mesh["symmetry"]) if "symmetry" in mesh else Symmetry()

    def from_first_camera(self) -> ObjectTrack:
        """The same motion as the camera of the first frame would have seen it, had it stood still."""
        if self.T_first_camera is None:
            return self
        raw = None if self.T_camera_object_raw is None else self.T_first_camera @ self.T_camera_object_raw
        seen = np.asarray(self.T_first_camera @ self.T_camera_object)
        return replace(self, T_camera_object=seen, T_camera_object_raw=raw, T_first_camera=None)

    def save(self, path: Path) -> None:
        """Write `*.track.npz` atomically."""
        header = {
            "units": {"length": "m", "time": "s", "image": "px"},
            "frames": {"camera": "OpenCV: x right, y down, z forward", "pose": "T_camera_object: object in camera"},
            **self.header,
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,  # this file's, not that of the one the track was read from
        }
        optional = {name: getattr(self, name) for name in OPTIONAL}
        extra: dict[str, Any] = {k: np.asarray(v, np.float64) for k, v in optional.items() if v is not None}
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(
                stream,
                T_camera_object=np.asarray(self.T_camera_object, np.float64),
                time_s=np.asarray(self.time_s, np.float64),
                camera_matrix=np.asarray(self.camera_matrix, np.float64),
                confidence=np.asarray(self.confidence, np.float64),
                visible=np.asarray(self.visible, bool),
                header=np.array(json.dumps(header, allow_nan=False)),
                **extra,
            )

    @staticmethod
    def load(path: Path) -> ObjectTrack:
        """Read a track of any version. Raises UserError when the file is missing, damaged or of another kind."""
        arrays, header = load_npz_with_header(Path(path), SCHEMA, SCHEMA_VERSION)
        names = ("T_camera_object", "time_s", "camera_matrix", "confidence", "visible")
        if missing := [name for name in names if name not in arrays]:
            raise UserError(f"{path} lacks {', '.join(missing)}; write it again with `vid2demo extract`")
        try:
            if "R_first_camera" in arrays:  # version 1
                arrays["T_first_camera"] = _turning(arrays["R_first_camera"])
            optional = {name: arrays[name] for name in OPTIONAL if name in arrays}
            return ObjectTrack(**{name: arrays[name] for name in names}, header=header, **optional)
        except ValueError as error:
            raise UserError(f"{path} is not a valid track: {error}") from error


def _turning(R_first_camera: Array) -> Array:
    """(N, 4, 4) poses of a camera that turns in place."""
    if R_first_camera.ndim != 3 or R_first_camera.shape[1:] != (3, 3):
        raise ValueError(f"R_first_camera has shape {R_first_camera.shape}, expected (N, 3, 3)")
    T = np.tile(np.eye(4), (len(R_first_camera), 1, 1))
    T[:, :3, :3] = R_first_camera
    return T


def _not_finite(name: str, value: Array, frames: int) -> str:
    """Where values are not finite, and what to do about it."""
    if name == "camera_matrix":
        return "camera_matrix contains values that are not finite; give the camera again, or none"
    bad = np.flatnonzero(~np.isfinite(value.reshape(frames, -1)).all(axis=1))
    return (
        f"{name} contains values that are not finite (first in frame {bad[0]}, {len(bad)} in all); write such frames "
        "with their last good pose, visible False and confidence 0, or leave them out"
    )


def load_npz_with_header(path: Path, schema: str, version: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and JSON header of one of this project's npz files, without pickle.

    Raises UserError when the file is missing, damaged, of another schema or newer than this program.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays.pop("header")))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise UserError(f"{path} is damaged or not a {schema} file ({error}); write it again") from error
    if header.get("schema") != schema:
        raise UserError(f"{path} holds {header.get('schema', 'an unknown format')!r}, expected {schema!r}")
    if int(header.get("version", 0)) > version:
        raise UserError(f"{path} has version {header['version']}, this program reads up to {version}; update vid2demo")
    return arrays, header
