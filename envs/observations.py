"""What the agent sees: names and spaces of the observations, and the errors against the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, Symmetry, angle_between_rad, rotation_angle_rad
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
        self._position_m = reference.T_world_object[:, :3, 3]
        self._R = reference.T_world_object[:, :3, :3]
        self._twist = reference.twist_world
        self._symmetry = reference.symmetry
        self._axis = np.asarray(self._symmetry.axis, float)
        self._continuous = self._symmetry.order == 0
        self._last = len(reference) - 1
        self._steps = np.array([max(1, round(ahead * reference.control_hz)) for ahead in LOOK_AHEAD_S])

    def errors(self, index: int, position_m: Array, R: Array, twist: Array) -> tuple[float, float, float, float]:
        """Errors of position (m), rotation (rad, up to symmetry), linear (m/s) and angular velocity (rad/s) at a knot.

        R: (3, 3); twist: (6,) linear then angular, world axes. After the last knot the object should stand still.
        """
        wanted = self._twist[index] if index < self._last else np.zeros(6)
        spin = twist[3:] - wanted[3:]
        if self._continuous:
            axis = R @ self._axis
            spin = spin - (spin @ axis) * axis
        if self._symmetry.order == 1:
            rotation_rad = float(rotation_angle_rad(R, self._R[index]))
        else:
            rotation_rad = float(self._symmetry.error_rad(R, self._R[index]))
        return (
            float(np.linalg.norm(position_m - self._position_m[index])),
            rotation_rad,
            float(np.linalg.norm(twist[:3] - wanted[:3])),
            float(np.linalg.norm(spin)),
        )

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
        ahead = np.minimum(index + self._steps, self._last)
        offsets = self._position_m[ahead] - position_m
        turns = turn_vectors(R, self._R[ahead], self._symmetry)
        tilt_rad = float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))
        return np.concatenate(
            [
                position_m,
                R[:, 0],
                R[:, 2],
                twist,
                np.hstack([offsets, turns]).ravel(),
                [tilt_rad, *fractions],
                receptacle_m,
                [index / self._last],
            ]
        ).astype(np.float32)


def turn_vectors(R: Array, R_target: Array, symmetry: Symmetry) -> Array:
    """(M, 3) rotation vectors, world axes, that turn R (3, 3) into targets (M, 3, 3) most shortly, up to symmetry."""
    if symmetry.order == 0:
        a, b = R @ np.asarray(symmetry.axis), R_target @ np.asarray(symmetry.axis)
        cross = np.cross(a, b)
        sine = np.linalg.norm(cross, axis=1, keepdims=True)
        angle = angle_between_rad(a, b)[:, None]
        return np.asarray(cross * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0))
    if symmetry.order == 1:
        return np.asarray(Rotation.from_matrix(R_target @ R.T).as_rotvec())
    choices = symmetry.rotations()
    turned = np.stack([Rotation.from_matrix(R_target @ (R @ S).T).as_rotvec() for S in choices])
    best = np.argmin(np.linalg.norm(turned, axis=2), axis=0)
    return np.asarray(turned[best, np.arange(len(R_target))])


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
