"""`Reference`: what the robot must reproduce, in the robot's world at the control rate, and its file `*.reference.npz`.

World frame = robot base (`panda_link0`), z up, table top at z = 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.geometry import Array, Symmetry, angle_between_rad
from ..extract.track import load_npz_with_header

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

SCHEMA = "vid2demo/reference"
SCHEMA_VERSION = 1
_ARRAYS = ("T_world_object", "time_s", "twist_world", "confidence", "video_time_s")


@dataclass(frozen=True)
class Reference:
    """Motion of the held object, its vessel and receptacle, and the grasp and start pose chosen for the Panda.

    T_world_object: (N, 4, 4) poses of the object in the robot's base frame, m.
    time_s: (N,) uniform from 0 in steps of the control period.
    twist_world: (N, 6) velocity of the object's origin in m/s, then angular velocity in rad/s, both in world axes.
    confidence: (N,) in [0, 1], how sure the tracker was; ones by default.
    video_time_s: (N,) the video's clock at each knot, not decreasing (a hold repeats it); `time_s` by default.
    header: JSON-like; `symmetry`, `vessel` ({"library": {category, params}} or {"file", "unit", "up", ...}),
        `receptacle` (the same and `T_world_receptacle`), `T_hand_object` (4x4, object in `panda_hand_tcp`),
        `q_start_rad` (7), `grasp`, `scale`, `time_stretch`, `T_world_camera`, `notes` (list of sentences), `changed`
        (leaps of the tracker that were bridged, by how much the camera was turned upright, how far the vessel was
        lifted over the rim and the receptacle moved to the jet, contacts given way to), `scale_search` (the pours tried
        and what came of them), `feasibility`.
    """

    T_world_object: Array
    time_s: Array
    twist_world: Array
    header: Mapping[str, Any] = field(default_factory=dict)
    confidence: Array = field(default_factory=lambda: np.zeros(0))
    video_time_s: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        n = len(self.time_s)
        if len(self.confidence) == 0:
            object.__setattr__(self, "confidence", np.ones(n))
        if len(self.video_time_s) == 0:
            object.__setattr__(self, "video_time_s", np.array(self.time_s, float))
        shapes = ((n, 4, 4), (n,), (n, 6), (n,), (n,))
        for name, shape in zip(_ARRAYS, shapes, strict=True):
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name} contains values that are not finite")
        if n < 2:
            raise ValueError(f"a reference needs at least 2 knots, got {n}")
        steps_s = np.diff(self.time_s)
        if np.any(steps_s <= 0) or np.ptp(steps_s) > 1e-6:
            raise ValueError("time_s must rise in equal steps")
        R = np.asarray(self.T_world_object)[:, :3, :3]
        if not np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-6) or np.any(np.linalg.det(R) < 0):
            raise ValueError("T_world_object holds matrices that are not rotations")

    @staticmethod
    def from_poses(
        T_world_object: Array,
        time_s: Array,
        header: Mapping[str, Any],
        confidence: Array | None = None,
        video_time_s: Array | None = None,
    ) -> Reference:
        """A reference whose twist is derived from its poses by central differences."""
        given = {"confidence": confidence, "video_time_s": video_time_s}
        return Reference(
            T_world_object,
            time_s,
            twist_of(T_world_object, time_s),
            header,
            **{name: value for name, value in given.items() if value is not None},
        )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def control_hz(self) -> float:
        return float((len(self) - 1) / (self.time_s[-1] - self.time_s[0]))

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def symmetry(self) -> Symmetry:
        return Symmetry.from_json(self.header["symmetry"]) if "symmetry" in self.header else Symmetry()

    @property
    def tilt_rad(self) -> Array:
        """(N,) angle between the object's +z axis and the vertical."""
        return angle_between_rad(self.T_world_object[:, :3, 2], np.array([0.0, 0.0, 1.0]))

    @property
    def pour_index(self) -> int:
        """The knot of greatest tilt; the middle of its plateau when the tilt stays there."""
        tilt_rad = self.tilt_rad
        return int(np.median(np.flatnonzero(tilt_rad >= tilt_rad.max() - 1e-3)))

    @property
    def scale(self) -> float:
        return float(self.header.get("scale", 1.0))

    @property
    def notes(self) -> list[str]:
        return [str(note) for note in self.header.get("notes", [])]

    @property
    def T_hand_object(self) -> Array:
        """(4, 4) pose of the object in the frame `panda_hand_tcp`: the grasp."""
        return self._array("T_hand_object", (4, 4))

    @property
    def q_start_rad(self) -> Array:
        """(7,) arm configuration that holds the object in its first pose."""
        return self._array("q_start_rad", (7,))

    @property
    def has_receptacle(self) -> bool:
        return bool(self.header.get("receptacle"))

    @property
    def T_world_receptacle(self) -> Array:
        """(4, 4) pose of the receptacle in the world."""
        self._require_receptacle()
        return np.asarray(self.header["receptacle"]["T_world_receptacle"], float).reshape(4, 4)

    @property
    def receptacle_m(self) -> Array:
        """(3,) origin of the receptacle in the world; zeros without one."""
        return self.T_world_receptacle[:3, 3] if self.has_receptacle else np.zeros(3)

    def vessel(self) -> Vessel:
        """The held vessel, rebuilt from the header. Raises UserError when the header names none."""
        return vessel_from_header(self.header.get("vessel") or {}, "held vessel")

    def receptacle(self) -> Vessel:
        """The vessel poured into, rebuilt from the header. Raises UserError when there is none."""
        self._require_receptacle()
        return vessel_from_header(self.header["receptacle"], "receptacle")

    def with_header(self, **changes: Any) -> Reference:
        """The same motion with some header entries replaced."""
        return replace(self, header={**self.header, **changes})

    def warped(
        self,
        start_offset_m: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
        receptacle_offset_m: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Reference:
        """The motion for a start and a receptacle that stand elsewhere.

        The start offset (m, world) fades into the receptacle's along a minimum-jerk curve between the first knot and
        the greatest tilt and stays there; rotations stay as they are. The header's receptacle pose moves along, and
        the start configuration is solved anew when the start moves.
        """
        start_m, receptacle_m = np.asarray(start_offset_m, float), np.asarray(receptacle_offset_m, float)
        if start_m.shape != (3,) or receptacle_m.shape != (3,):
            raise ValueError(f"offsets must have shape (3,), got {start_m.shape} and {receptacle_m.shape}")
        if not np.any(start_m) and not np.any(receptacle_m):
            return self
        pour_s = self.time_s[self.pour_index] - self.time_s[0]
        blend = minimum_jerk((self.time_s - self.time_s[0]) / max(pour_s, 1e-9))[:, None]
        offset_m = (1.0 - blend) * start_m + blend * receptacle_m
        T = np.array(self.T_world_object)
        T[:, :3, 3] += offset_m
        # Central differences are linear in the positions, and nothing turns in another way.
        twist = np.array(self.twist_world)
        twist[:, :3] += _central_differences(offset_m, self.time_s)
        header = dict(self.header)
        if self.has_receptacle:
            T_receptacle = self.T_world_receptacle.copy()
            T_receptacle[:3, 3] += receptacle_m
            header["receptacle"] = {**self.header["receptacle"], "T_world_receptacle": T_receptacle.tolist()}
        if "q_start_rad" in header and "T_hand_object" in header and np.any(T[0] != self.T_world_object[0]):
            from .kinematics import configuration_near

            q_rad = configuration_near(T[0], self.T_hand_object, self.q_start_rad)
            header["q_start_rad"] = q_rad.tolist()
        return Reference(T, self.time_s, twist, header, self.confidence, self.video_time_s)

    def stretched(self, factor: float) -> Reference:
        """The same path, `factor` times slower (or faster below 1), on knots of the same rate."""
        if not 0.0 < factor < np.inf:
            raise ValueError(f"the stretch factor must be positive and finite, got {factor}")
        if factor == 1.0:
            return self
        knots = max(2, round(self.duration_s * factor * self.control_hz) + 1)
        return self.retimed(np.arange(knots, dtype=np.float64) * (self.duration_s / (knots - 1)))

    def retimed(self, at_s: Array) -> Reference:
        """The same path on a new clock: knot k (same rate) is where this one is `at_s[k]` after its start.

        at_s: (M,) s, not decreasing, inside the duration. `time_stretch` is multiplied by new over old duration.
        """
        position = self.time_s[0] + np.asarray(at_s, float)
        time_s = np.arange(len(position)) / self.control_hz
        factor = float(time_s[-1]) / self.duration_s
        return Reference.from_poses(
            spline_poses(self.T_world_object, self.time_s, position),
            time_s,
            {**self.header, "time_stretch": float(self.header.get("time_stretch", 1.0)) * factor},
            np.interp(position, self.time_s, self.confidence),
            np.interp(position, self.time_s, self.video_time_s),
        )

    def save(self, path: Path) -> None:
        """Write `*.reference.npz` atomically."""
        header = {
            **self.header,
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "units": {"length": "m", "time": "s", "angle": "rad"},
            "frames": {"world": "panda_link0, z up, table top at z = 0", "hand": "panda_hand_tcp"},
        }
        arrays = {name: np.asarray(getattr(self, name), np.float64) for name in _ARRAYS}
        text = json.dumps(header, allow_nan=False)
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, header=np.array(text), **arrays)  # type: ignore[arg-type]

    @staticmethod
    def load(path: Path) -> Reference:
        """Read a reference. Raises UserError when the file is missing, damaged or of another kind."""
        arrays, header = load_npz_with_header(Path(path), SCHEMA, SCHEMA_VERSION)
        if missing := [name for name in _ARRAYS if name not in arrays]:
            raise UserError(f"{path} lacks {', '.join(missing)}; write it again with `vid2demo retarget`")
        try:
            return Reference(**{name: arrays[name] for name in _ARRAYS}, header=header)
        except ValueError as error:
            raise UserError(f"{path} is not a valid reference: {error}") from error

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        if name not in self.header:
            raise UserError(f"the reference has no {name}; build it with `vid2demo retarget`")
        value = np.asarray(self.header[name], float)
        if value.shape != shape or not np.all(np.isfinite(value)):
            raise UserError(
                f"the reference's {name} must hold {shape} finite numbers; build it with `vid2demo retarget`"
            )
        return value

    def _require_receptacle(self) -> None:
        if not self.has_receptacle:
            raise UserError("the reference has no receptacle; build it with `vid2demo retarget --receptacle NAME`")


def vessel_to_header(vessel: Vessel) -> dict[str, Any]:
    """The header entry from which `vessel_from_header` rebuilds a vessel exactly."""
    if (source := vessel.source) is not None:
        kept = ("file", "sha256", "unit", "up", "open_top")
        return {name: getattr(source, name) for name in kept}
    return {"library": {"category": vessel.category, "params": {k: float(v) for k, v in vessel.params.items()}}}


def vessel_from_header(entry: Mapping[str, Any], role: str) -> Vessel:
    """Rebuild a vessel from a track's `mesh` or a reference's `vessel` entry. `role` names it in errors."""
    from ..extract.any_vessel import vessel_of_entry

    return vessel_of_entry(entry, role)


def minimum_jerk(phase: Array) -> Array:
    """Minimum-jerk step from 0 (phase <= 0) to 1 (phase >= 1)."""
    p = np.clip(phase, 0.0, 1.0)
    return np.asarray(p**3 * (10.0 - 15.0 * p + 6.0 * p**2))


def interpolate_poses(T: Array, time_s: Array, at_s: Array) -> Array:
    """Poses (M, 4, 4) at times `at_s` inside [time_s[0], time_s[-1]]: linear in position, Slerp in rotation."""
    at_s = np.clip(at_s, time_s[0], time_s[-1])
    out = np.tile(np.eye(4), (len(at_s), 1, 1))
    out[:, :3, :3] = Slerp(time_s, Rotation.from_matrix(T[:, :3, :3]))(at_s).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(at_s, time_s, T[:, axis, 3])
    return out


def spline_poses(T: Array, time_s: Array, at_s: Array) -> Array:
    """Poses (M, 4, 4) on cubic splines in position and rotation: a robot needs a continuous velocity."""
    at_s = np.clip(at_s, time_s[0], time_s[-1])
    out = np.tile(np.eye(4), (len(at_s), 1, 1))
    out[:, :3, 3] = CubicSpline(time_s, T[:, :3, 3], bc_type="natural")(at_s)
    out[:, :3, :3] = RotationSpline(time_s, Rotation.from_matrix(T[:, :3, :3]))(at_s).as_matrix()
    return out


def twist_of(T: Array, time_s: Array) -> Array:
    """(N, 6) twist of poses (N, 4, 4): v in m/s, omega in rad/s, world; central differences, one-sided at the ends."""
    before, after = _neighbours(len(time_s))
    rotation = Rotation.from_matrix(T[after, :3, :3]) * Rotation.from_matrix(T[before, :3, :3]).inv()
    angular = rotation.as_rotvec() / (time_s[after] - time_s[before])[:, None]
    return np.asarray(np.hstack([_central_differences(T[:, :3, 3], time_s), angular]))


def _neighbours(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the knots before and after each; at the ends the knot itself."""
    index = np.arange(count)
    return np.maximum(index - 1, 0), np.minimum(index + 1, count - 1)


def _central_differences(values: Array, time_s: Array) -> Array:
    before, after = _neighbours(len(time_s))
    return np.asarray((values[after] - values[before]) / (time_s[after] - time_s[before])[:, None])
