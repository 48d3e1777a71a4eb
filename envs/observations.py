"""What the agent sees: names and spaces of the observations, and the errors against the reference."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array
from .panda import ARM_JOINTS
from .reference import Reference, interpolate_poses

# The reference's pose so many seconds ahead is part of the observation.
LOOK_AHEAD_S = (0.04, 0.2, 0.6)
_XYZ = ("x", "y", "z")

AGENT_NAMES = (*(f"{name}_rad" for name in ARM_JOINTS), *(f"{name}_rad_s" for name in ARM_JOINTS))
ENVIRONMENT_NAMES = (
    *(f"object_position_{axis}_m" for axis in _XYZ),
    *(f"object_x_axis_{axis}" for axis in _XYZ),
    *(f"object_z_axis_{axis}" for axis in _XYZ),
    *(f"object_velocity_{axis}_m_s" for axis in _XYZ),
    *(f"object_angular_velocity_{axis}_rad_s" for axis in _XYZ),
    *(
        f"reference_{round(1000 * ahead)}ms_{kind}"
        for ahead in LOOK_AHEAD_S
        for kind in (*(f"offset_{axis}_m" for axis in _XYZ), *(f"turn_{axis}_rad" for axis in _XYZ))
    ),
    "object_tilt_rad",
    "held_fraction",
    "poured_fraction",
    "spilled_fraction",
    *(f"receptacle_position_{axis}_m" for axis in _XYZ),
    "reference_phase",
)


def space(
    obs_mode: str, cameras: tuple[str, ...], image_size: tuple[int, int]
) -> tuple[spaces.Dict, dict[str, tuple[str, ...]]]:
    """The observation space of a mode, and the name of every entry of its vectors."""

    def vector(names: tuple[str, ...]) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (len(names),), np.float32)

    entries: dict[str, spaces.Space[Any]] = {"agent_pos": vector(AGENT_NAMES)}
    names = {"agent_pos": AGENT_NAMES}
    if obs_mode != "pixels":
        entries["environment_state"] = vector(ENVIRONMENT_NAMES)
        names["environment_state"] = ENVIRONMENT_NAMES
    if obs_mode != "state":
        picture = spaces.Box(0, 255, (*image_size, 3), np.uint8)
        entries["pixels"] = spaces.Dict(dict.fromkeys(cameras, picture))
    return spaces.Dict(entries), names


class Targets:
    """A reference prepared for fast comparison with the object's state at any of its knots."""

    def __init__(self, reference: Reference) -> None:
        self._position_m = np.ascontiguousarray(reference.T_world_object[:, :3, 3])
        R = reference.T_world_object[:, :3, :3]
        symmetry = reference.symmetry
        self._continuous = symmetry.order == 0
        self._axis = np.asarray(symmetry.axis, float)
        self._axes = R @ self._axis
        # (N, K, 4): the attitudes that count as the same under a discrete symmetry.
        images = R[:, None] @ (np.eye(3)[None] if self._continuous else symmetry.rotations())
        self._quats = Rotation.from_matrix(images.reshape(-1, 3, 3)).as_quat(scalar_first=True)
        self._quats = self._quats.reshape(len(R), -1, 4)
        self._twist = reference.twist_world
        self._last = len(reference) - 1
        self._steps = [max(1, round(ahead * reference.control_hz)) for ahead in LOOK_AHEAD_S]

    def errors(self, index: int, position_m: Array, R: Array, twist: Array) -> tuple[float, float, float, float]:
        """Errors of position (m), rotation (rad, up to symmetry), linear (m/s) and angular velocity (rad/s) at a knot.

        R: (3, 3); twist: (6,) linear then angular, world axes. After the last knot the object should stand still.
        """
        error = twist - self._twist[index] if index < self._last else twist
        spin = error[3:]
        if self._continuous:
            axis = R @ self._axis
            spin = spin - (spin @ axis) * axis
        return (
            _length(position_m - self._position_m[index]),
            _length(self.turn_vector(index, R)),
            _length(error[:3]),
            _length(spin),
        )

    def turn_vector(self, index: int, R: Array) -> Array:
        """(3,) shortest rotation vector, world axes, that turns R (3, 3) into the knot's attitude up to symmetry."""
        if self._continuous:
            ax, ay, az = (R @ self._axis).tolist()
            bx, by, bz = self._axes[index].tolist()
            cross = np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
            sine = _length(cross)
            angle = math.atan2(sine, ax * bx + ay * by + az * bz)
            if sine > 1e-9:
                return np.asarray(cross * (angle / sine))
            # Aligned, or opposite: then every axis across will do.
            return np.zeros(3) if angle < 1.0 else angle * np.linalg.svd(np.array([[ax, ay, az]]))[2][1]
        quat, local = np.empty(4), np.empty((len(self._quats[index]), 3))
        mujoco.mju_mat2Quat(quat, R.ravel())
        for vector, wanted in zip(local, self._quats[index], strict=True):
            mujoco.mju_subQuat(vector, wanted, quat)
        if len(local) > 1:
            local = local[np.argmin(np.einsum("ij,ij->i", local, local))][None]
        return np.asarray(R @ local[0])

    def environment_state(
        self,
        index: int,
        position_m: Array,
        R: Array,
        twist: Array,
        receptacle_m: Array,
        fractions: tuple[float, float, float],
    ) -> NDArray[np.float32]:
        """The vector named by `ENVIRONMENT_NAMES`; fractions: held, poured, spilled."""
        parts = [position_m, R[:, 0], R[:, 2], twist]
        for step in self._steps:
            ahead = min(index + step, self._last)
            parts += [self._position_m[ahead] - position_m, self.turn_vector(ahead, R)]
        tilt_rad = math.atan2(math.hypot(R[0, 2], R[1, 2]), R[2, 2])
        parts += [np.array([tilt_rad, *fractions]), receptacle_m, np.array([index / self._last])]
        return np.concatenate(parts).astype(np.float32)


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))


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
