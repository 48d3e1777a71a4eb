"""Leaps of a tracker: moments at which it takes something else, or another side, for the object.

A few frames elsewhere and back are left out. A leap that does not come back is bridged: what was tracked on the less
certain side is moved, as one piece, to where the motion beside the leap goes on to. A turn is taken out in the
object's own axes (a tracker that takes a handle for a spout stays wrong by the same turn of the object), a shift in
the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, rotation_angle_rad

Mask = NDArray[np.bool_]

# A hand does not move a vessel faster; a tracker that loses it does.
JUMP_M_S, JUMP_RAD_S = 4.0, 20.0
# Nor does it change its speed by so much for a single frame, unless the whole track is as restless.
START_M_S, START_RAD_S, RESTLESS = 1.5, 10.0, 8.0
# Steps that are none, however short the time between two frames.
STEP_M, STEP_RAD = 0.02, np.deg2rad(8.0)
# So many frames between two leaps are an excursion.
SHORT_FRAMES = 6
_NEAR = 5


@dataclass(frozen=True)
class Leap:
    """A leap that does not come back: before `time_s`, by distance_m and angle_rad; which side was moved."""

    time_s: float
    distance_m: float
    angle_rad: float
    moved: str

    def sentence(self) -> str:
        """What was done about it, for a person."""
        return (
            f"At {self.time_s:.2f} s the track leaps by {self.distance_m:.2f} m and {np.rad2deg(self.angle_rad):.0f} "
            f"degrees within one frame and does not come back; the leap was bridged: what was tracked {self.moved} it, "
            "where the tracker was less sure, was moved as one piece."
        )


def without_leaps(T: Array, time_s: Array, confidence: Array) -> tuple[Array, Mask, list[Leap]]:
    """Poses (N, 4, 4) without one-way leaps, which frames (N,) to keep, and the leaps that were bridged.

    confidence: (N,) decides which side of a leap stays: that with more of it in all.
    """
    if len(T) < 3:
        return T, np.ones(len(T), bool), []
    pieces = _pieces(T, time_s)
    if len(pieces) == 1:
        return T, np.ones(len(T), bool), []
    keep = np.zeros(len(T), bool)
    for piece in pieces:
        # One that lasts is no excursion, nor is one that makes up much of the track.
        keep[piece] = len(piece) > min(SHORT_FRAMES, len(T) // 4)
    index = np.flatnonzero(keep)
    if len(index) < 2:
        return T, keep, []
    out, leaps = _joined(T[index], time_s[index], confidence[index])
    poses = T.copy()
    poses[index] = out
    return poses, keep, leaps


def _pieces(T: Array, time_s: Array) -> list[NDArray[np.int64]]:
    """Indices of the frames between leaps."""
    return np.split(np.arange(len(T)), np.flatnonzero(_leaps(T, time_s)) + 1)


def _leaps(T: Array, time_s: Array) -> Mask:
    """(N - 1,) whether the track leaps from one frame to the next."""
    step_s = np.diff(time_s)[:, None]
    found = np.zeros(len(T) - 1, bool)
    turn = Rotation.from_matrix(T[1:, :3, :3] @ np.swapaxes(T[:-1, :3, :3], 1, 2)).as_rotvec()
    for step, most, start, least in (
        (np.diff(T[:, :3, 3], axis=0), JUMP_M_S, START_M_S, STEP_M),
        (turn, JUMP_RAD_S, START_RAD_S, STEP_RAD),
    ):
        rate = step / step_s
        change = np.linalg.norm(rate - median_filter(rate, size=(_NEAR, 1), mode="nearest"), axis=1)
        sudden = change > max(start, RESTLESS * float(np.median(change)))
        found |= (sudden | (np.linalg.norm(rate, axis=1) > most)) & (np.linalg.norm(step, axis=1) > least)
    return found


def _joined(T: Array, time_s: Array, confidence: Array) -> tuple[Array, list[Leap]]:
    """The pieces of a track that are still apart, moved together, and the leaps between them."""
    pieces = _pieces(T, time_s)
    surest = int(np.argmax([confidence[piece].sum() for piece in pieces]))
    out, leaps = T.copy(), []
    # Outward from the surest piece; all beyond a leap is moved with what follows it.
    for number in [*range(surest - 1, -1, -1), *range(surest + 1, len(pieces))]:
        later = number > surest
        at = int(pieces[number][0] if later else pieces[number][-1] + 1)
        R_step, step_m = _expected(out, time_s, at)
        from_R, to_R = out[at - 1, :3, :3], out[at, :3, :3]
        shift_m = out[at, :3, 3] - out[at - 1, :3, 3] - step_m
        angle_rad = float(rotation_angle_rad(to_R, R_step @ from_R))
        if later:
            out[at:, :3, :3] = out[at:, :3, :3] @ to_R.T @ R_step @ from_R
            out[at:, :3, 3] -= shift_m
        else:
            out[:at, :3, :3] = out[:at, :3, :3] @ from_R.T @ R_step.T @ to_R
            out[:at, :3, 3] += shift_m
        leaps.append(Leap(float(time_s[at]), float(np.linalg.norm(shift_m)), angle_rad, "after" if later else "before"))
    return out, sorted(leaps, key=lambda leap: leap.time_s)


def _expected(T: Array, time_s: Array, at: int) -> tuple[Array, Array]:
    """Turn (3, 3) and shift (3,) in the camera's axes from frame `at - 1` to `at`, as the motion on both sides goes."""
    turns, shifts = [], []
    for first, last in ((max(at - _NEAR, 0), at - 1), (at, min(at + _NEAR, len(T)) - 1)):
        span_s = float(time_s[last] - time_s[first])
        if span_s > 0.0:
            turns.append(Rotation.from_matrix(T[last, :3, :3] @ T[first, :3, :3].T).as_rotvec() / span_s)
            shifts.append((T[last, :3, 3] - T[first, :3, 3]) / span_s)
    step_s = float(time_s[at] - time_s[at - 1])
    if not turns:
        return np.eye(3), np.zeros(3)
    return Rotation.from_rotvec(step_s * np.mean(turns, axis=0)).as_matrix(), step_s * np.mean(shifts, axis=0)
