"""What the agent sees: names, units, frames and ranges of the observations, and the errors against the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array
from .panda import ARM_JOINTS, DQ_MAX_RAD_S, Q_MAX_RAD, Q_MIN_RAD
from .reference import Reference, interpolate_poses

# The reference's pose so many seconds ahead is part of the observation.
LOOK_AHEAD_S = (0.04, 0.2, 0.6)
_XYZ = ("x", "y", "z")
_NO_LIMIT = math.inf


@dataclass(frozen=True)
class Entry:
    """One number of an action or an observation. `low` and `high`: what it keeps to; infinite when nothing binds it."""

    name: str
    unit: str
    frame: str
    low: float
    high: float
    description: str


def _vector(name: str, unit: str, frame: str, description: str, limit: float = _NO_LIMIT) -> tuple[Entry, ...]:
    suffix = "_" + unit.replace("/", "_") if unit != "1" else ""
    return tuple(Entry(f"{name}_{axis}{suffix}", unit, frame, -limit, limit, description) for axis in _XYZ)


AGENT_ENTRIES = (
    *(
        # Soft limits give way a little under load: the range is the robot's, not a promise to the last digit.
        Entry(f"{name}_rad", "rad", "joint", -_NO_LIMIT, _NO_LIMIT, f"joint position, limits {low:g} to {high:g}")
        for name, low, high in zip(ARM_JOINTS, Q_MIN_RAD, Q_MAX_RAD, strict=True)
    ),
    *(
        Entry(f"{name}_rad_s", "rad/s", "joint", -_NO_LIMIT, _NO_LIMIT, f"joint velocity, limit {most:g}")
        for name, most in zip(ARM_JOINTS, DQ_MAX_RAD_S, strict=True)
    ),
)
ENVIRONMENT_ENTRIES = (
    *_vector("object_position", "m", "world", "origin of the held vessel"),
    *_vector("object_x_axis", "1", "world", "its x axis: toward spout, lip or away from the handle", 1.0),
    *_vector("object_z_axis", "1", "world", "its z axis: up when upright", 1.0),
    *_vector("object_velocity", "m/s", "world", "velocity of its origin"),
    *_vector("object_angular_velocity", "rad/s", "world", "its angular velocity"),
    *_vector("object_in_reference", "m", "reference", "its origin seen from where the reference is now"),
    *_vector("object_turn_in_reference", "rad", "reference", "rotation vector from there, up to symmetry", math.pi),
    *(
        entry
        for ahead in LOOK_AHEAD_S
        for entry in (
            *_vector(f"reference_{round(1000 * ahead)}ms_offset", "m", "world", "way to the reference then"),
            *_vector(f"reference_{round(1000 * ahead)}ms_turn", "rad", "world", "rotation vector to it", math.pi),
        )
    ),
    Entry("object_tilt_rad", "rad", "world", 0.0, math.pi, "angle between the vessel's z axis and the vertical"),
    Entry("held_fraction", "1", "vessel", 0.0, 1.0, "share of the particles in the held vessel: its fill"),
    Entry("poured_fraction", "1", "receptacle", 0.0, 1.0, "share of the particles in the receptacle"),
    Entry("spilled_fraction", "1", "world", 0.0, 1.0, "share of the particles in neither and below the rim"),
    *_vector("receptacle_position", "m", "world", "origin of the receptacle; zeros without one"),
    Entry("reference_phase", "1", "reference", 0.0, 1.0, "how far the reference has gone"),
)
AGENT_NAMES = tuple(entry.name for entry in AGENT_ENTRIES)
ENVIRONMENT_NAMES = tuple(entry.name for entry in ENVIRONMENT_ENTRIES)
# Rounding to 32 bits may pass a bound by so much.
_ROUNDING = 1e-5


def space(
    obs_mode: str, cameras: tuple[str, ...], image_size: tuple[int, int]
) -> tuple[spaces.Dict, dict[str, tuple[str, ...]]]:
    """The observation space of a mode, and the name of every entry of its vectors."""

    def vector(entries: tuple[Entry, ...]) -> spaces.Box:
        low, high = (np.array([getattr(entry, side) for entry in entries], np.float32) for side in ("low", "high"))
        return spaces.Box(low - np.float32(_ROUNDING), high + np.float32(_ROUNDING), dtype=np.float32)

    entries: dict[str, spaces.Space[Any]] = {"agent_pos": vector(AGENT_ENTRIES)}
    names = {"agent_pos": AGENT_NAMES}
    if obs_mode != "pixels":
        entries["environment_state"] = vector(ENVIRONMENT_ENTRIES)
        names["environment_state"] = ENVIRONMENT_NAMES
    if obs_mode != "state":
        picture = spaces.Box(0, 255, (*image_size, 3), np.uint8)
        entries["pixels"] = spaces.Dict(dict.fromkeys(cameras, picture))
    return spaces.Dict(entries), names


@dataclass(frozen=True)
class Targets:
    """A reference prepared for fast comparison with the object's state at any of its knots.

    position_m (N, 3), twist (N, 6), R (N, 3, 3): as in the reference. images: (N, K, 4) quaternions wxyz of the
    attitudes that count as the same under a discrete symmetry. axis (3,), axes (N, 3): the symmetry axis in the
    object and at each knot in the world. continuous: whether the object may turn about it. ahead: look-ahead, knots.
    """

    position_m: Array
    twist: Array
    R: Array
    images: Array
    axis: Array
    axes: Array
    continuous: bool
    ahead: NDArray[np.int64]

    @staticmethod
    def of(reference: Reference) -> Targets:
        """Targets of a reference."""
        R = np.ascontiguousarray(reference.T_world_object[:, :3, :3])
        symmetry = reference.symmetry
        continuous = symmetry.order == 0
        axis = np.array(symmetry.axis, float)
        images = R[:, None] @ (np.eye(3)[None] if continuous else symmetry.rotations())
        quats = Rotation.from_matrix(images.reshape(-1, 3, 3)).as_quat(scalar_first=True)
        ahead = [max(1, round(ahead * reference.control_hz)) for ahead in LOOK_AHEAD_S]
        return Targets(
            np.ascontiguousarray(reference.T_world_object[:, :3, 3]),
            np.ascontiguousarray(reference.twist_world, np.float64),
            R,
            np.ascontiguousarray(quats.reshape(len(R), -1, 4)),
            axis,
            R @ axis,
            continuous,
            np.array(ahead),
        )

    def shifted(self, reference: Reference) -> Targets:
        """The same attitudes along the path of a reference that was only moved; saves most of `of`'s work."""
        return replace(
            self,
            position_m=np.ascontiguousarray(reference.T_world_object[:, :3, 3]),
            twist=np.ascontiguousarray(reference.twist_world, np.float64),
        )

    def errors(self, index: int, position_m: Array, R: Array, twist: Array) -> tuple[float, float, float, float]:
        """Errors of position (m), rotation (rad, up to symmetry), linear (m/s) and angular velocity (rad/s) at a knot.

        R: (3, 3); twist: (6,) linear then angular, world axes. After the last knot the object should stand still.
        """
        from .kernels import tracking_errors

        out = np.empty(4)
        tracking_errors(
            index,
            position_m,
            R,
            twist,
            self.position_m,
            self.twist,
            self.images,
            self.axis,
            self.axes,
            self.continuous,
            out,
        )
        position, rotation, linear, angular = out.tolist()
        return position, rotation, linear, angular

    def turn_vector(self, index: int, R: Array) -> Array:
        """(3,) shortest rotation vector, world axes, that turns R (3, 3) into the knot's attitude up to symmetry."""
        from .kernels import turn_vector

        out = np.empty(3)
        turn_vector(R, self.images[index], self.axis, self.axes[index], self.continuous, out)
        return out

    def environment_state(
        self, index: int, position_m: Array, R: Array, twist: Array, receptacle_m: Array, share: Array
    ) -> NDArray[np.float32]:
        """The vector named by `ENVIRONMENT_NAMES`; share: (3,) held, poured and spilled fractions."""
        from .kernels import environment_vector

        out = np.empty(len(ENVIRONMENT_NAMES), np.float32)
        environment_vector(
            index,
            self.ahead,
            position_m,
            R,
            twist,
            receptacle_m,
            share,
            self.position_m,
            self.images,
            self.axis,
            self.axes,
            self.continuous,
            self.R,
            out,
        )
        return out


def resampled(reference: Reference, control_hz: float) -> Reference:
    """The same motion on knots of another rate; itself when the rate is its own."""
    if abs(reference.control_hz - control_hz) < 1e-6 * control_hz:
        return reference
    time_s = np.arange(max(2, round(reference.duration_s * control_hz) + 1)) / control_hz
    at_s = np.minimum(time_s, reference.duration_s) + reference.time_s[0]
    return Reference.from_poses(
        interpolate_poses(reference.T_world_object, reference.time_s, at_s),
        time_s,
        reference.header,
        np.interp(at_s, reference.time_s, reference.confidence),
        np.interp(at_s, reference.time_s, reference.video_time_s),
    )
