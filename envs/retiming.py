"""Slowing a motion down where the arm's joints would have to move too fast, and only there."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from ..extract.geometry import Array
from .panda import DDQ_MAX_RAD_S2, DQ_MAX_RAD_S
from .reference import Reference

# Part of the joint limits that a reference may ask for: the rest is for the controller.
SPEED_PART, ACCELERATION_PART = 0.8, 0.8
# So long before and after a fast moment the clock slows down and recovers, so that no joint jerks.
_EASE_S = 0.12
_ROUNDS = 6


def at_speed(reference: Reference, q_rad: Array, speed: float) -> tuple[Reference, Array]:
    """The reference and its joint motion (N, 7), played `speed` times as fast on knots of the same rate."""
    if speed == 1.0:
        return reference, q_rad
    time_s = np.arange(len(reference)) / reference.control_hz
    knots = max(2, round(reference.duration_s / speed * reference.control_hz) + 1)
    at_s = np.linspace(0.0, time_s[-1], knots)
    note = f"The motion is played at {speed:g} times the video's speed, as asked."
    played = reference.retimed(at_s)
    return played.with_header(notes=[*played.notes, note]), np.asarray(CubicSpline(time_s, q_rad)(at_s))


def slowed(reference: Reference, q_rad: Array) -> Reference:
    """The reference on a clock on which the joint motion q (N, 7) that follows it keeps to its limits.

    Limits of speed, and of acceleration as far as knots at the control rate can tell.

    `time_stretch` in the header becomes new over old duration, and a note says where and how much time was stretched.
    The very same reference is returned when nothing is too fast.
    """
    hz = reference.control_hz
    time_s = np.arange(len(reference)) / hz
    path = CubicSpline(time_s, q_rad)
    at_s: Array = time_s
    stretch: Array = np.ones(len(reference))
    for _ in range(_ROUNDS):
        # Speed by the new clock, brought back to the old one, where the stretch is kept.
        ratio = _excess(path(at_s), hz)
        if ratio.max() <= 1.0:
            break
        excess = np.maximum(np.interp(time_s, at_s, ratio), 1.0)
        wide = maximum_filter1d(excess, 2 * round(_EASE_S * hz) + 1)
        stretch = stretch * np.maximum(gaussian_filter1d(wide, 0.5 * _EASE_S * hz), excess) ** 1.02
        at_s = _positions(stretch, time_s, hz)
    if len(at_s) == len(time_s) and np.array_equal(at_s, time_s):
        return reference
    slow = reference.retimed(at_s)
    where = float(np.interp(time_s[int(stretch.argmax())], time_s, reference.video_time_s))
    note = (
        f"The human moves faster than the arm may: around {where:.1f} s of the video the motion was slowed down by a "
        f"factor of {stretch.max():.1f}, and in all it takes {slow.duration_s / reference.duration_s:.2f} times as "
        "long."
    )
    return slow.with_header(notes=[*reference.notes, note])


def _excess(q_rad: Array, hz: float) -> Array:
    """(N,) by how much the clock must slow down at each knot to keep to the limits of speed and acceleration."""
    bend = np.abs(np.diff(q_rad, n=2, axis=0)) * hz**2 / (ACCELERATION_PART * DDQ_MAX_RAD_S2)
    part = (np.abs(np.diff(q_rad, axis=0)) * hz / (SPEED_PART * DQ_MAX_RAD_S)).max(axis=1)
    speed = np.maximum(np.append(part, part[-1]), np.insert(part, 0, part[0]))
    # Acceleration falls with the square of the clock's rate.
    return np.asarray(np.maximum(speed, np.pad(np.sqrt(bend.max(axis=1)), 1, mode="edge")))


def _positions(stretch: Array, time_s: Array, hz: float) -> Array:
    """(M,) old times at the knots of the new clock that runs `stretch` times slower, both ends included."""
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]) * np.diff(time_s))])
    knots = int(np.ceil(passed[-1] * hz - 1e-6)) + 1
    return np.asarray(np.interp(np.arange(knots) * passed[-1] / (knots - 1), passed, time_s))
