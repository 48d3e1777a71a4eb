"""From a track at the video's own, possibly uneven, frame times to clean poses at the control rate.

Frames the tracker did not see or trust are bridged, its leaps are taken out (`leaps`), and the ends get a short hold
and, where the object is already moving, a gentle start, because a robot cannot begin at speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array
from ..extract.track import ObjectTrack
from .leaps import Leap, without_leaps
from .reference import interpolate_poses, spline_poses

Mask = NDArray[np.bool_]

MIN_FRAMES = 4
MIN_DURATION_S = 0.3
MAX_TRAVEL_M = 5.0
# Second differences at the control rate (rms) below which jitter is nothing the arm would show.
JITTER_M, JITTER_RAD = 0.0003, np.deg2rad(0.15)
SMOOTHING_S = (0.0, 0.03, 0.05, 0.08, 0.12, 0.16)
_STILL_M_S, _STILL_RAD_S, _HEAD_S = 0.04, 0.2, 0.3


@dataclass(frozen=True)
class ResampledTrack:
    """Poses at the control rate.

    T_camera_object: (N, 4, 4); video_time_s: (N,) the video's clock, not decreasing; confidence: (N,) in [0, 1].
    notes: what was bridged, cut or added, in plain sentences. leaps: those of the tracker that were bridged.
    """

    T_camera_object: Array
    video_time_s: Array
    confidence: Array
    notes: list[str]
    leaps: list[Leap]


def resample_track(
    track: ObjectTrack, control_hz: float, *, min_confidence: float = 0.2, hold_s: float = 0.2, ease_s: float = 0.4
) -> ResampledTrack:
    """Poses of a track on knots of `control_hz`, between the first and the last frame that can be trusted.

    hold_s: the robot stands still for so long before and after. ease_s: over so long it gathers speed when the track
    begins or ends in motion. Raises UserError for a track that is too short, never visible, not in metres or all leaps.
    """
    if not 1.0 <= control_hz <= 1000.0:
        raise UserError(f"the control rate is {control_hz} Hz; choose one from 1 to 1000")
    _check_units(track)
    notes: list[str] = []
    good = _trusted_frames(track, min_confidence, notes)
    track, good, leaps = _without_leaps(track, good, notes)
    first, last = np.flatnonzero(good)[[0, -1]]
    if good.sum() < MIN_FRAMES or track.time_s[last] - track.time_s[first] < MIN_DURATION_S:
        raise UserError(
            f"the track of {track.name!r} has {int(good.sum())} usable frames over "
            f"{track.time_s[last] - track.time_s[first]:.2f} s; at least {MIN_FRAMES} over "
            f"{MIN_DURATION_S} s are needed: use a longer clip"
        )
    if first > 0 or last < len(track) - 1:
        notes.append(
            f"The track is used from {track.time_s[first]:.2f} s to {track.time_s[last]:.2f} s; "
            "outside, the object was not seen well enough."
        )
    inside = slice(first, last + 1)
    time_s, good = track.time_s[inside], good[inside]
    T = interpolate_poses(track.T_camera_object[inside][good], time_s[good], time_s)
    if not good.all():
        longest_s = float(np.diff(time_s[good]).max())
        notes.append(
            f"{int((~good).sum())} frames were bridged by interpolation; the longest gap lasts {longest_s:.2f} s."
        )
    video_time_s = _video_clock(T, time_s, control_hz, hold_s, ease_s, notes)
    confidence = np.where(good, track.confidence[inside], 0.0)
    sure = np.interp(video_time_s, time_s, confidence)
    poses = _without_jitter(spline_poses(T, time_s, video_time_s), sure, control_hz, notes)
    return ResampledTrack(poses, video_time_s, sure, notes, leaps)


def _check_units(track: ObjectTrack) -> None:
    position_m = track.T_camera_object[:, :3, 3]
    seen = position_m[track.visible] if track.visible.any() else position_m
    travel_m = float(np.linalg.norm(np.ptp(np.percentile(seen, [2, 98], axis=0), axis=0)))
    if travel_m > MAX_TRAVEL_M:
        mend = (
            "the translations look like millimetres: divide them by 1000"
            if travel_m / 1000 < MAX_TRAVEL_M
            else "check the track's units (m) and the mesh's size"
        )
        raise UserError(f"the track of {track.name!r} moves over {travel_m:.0f} m, which no arm can follow; {mend}")


def _trusted_frames(track: ObjectTrack, min_confidence: float, notes: list[str]) -> Mask:
    visible = np.asarray(track.visible, bool)
    if not visible.any():
        raise UserError(f"the object {track.name!r} is visible in no frame of its track; extract it again with --box")
    good = visible & (track.confidence >= min_confidence)
    if good.sum() < 0.5 * visible.sum():
        # A tracker unsure nearly everywhere gives no ground for choosing among its frames.
        notes.append(
            f"The tracker's confidence is below {min_confidence:.2f} in most frames; all frames with the object in "
            "view are used, and the motion may be wrong."
        )
        return visible
    return np.asarray(good)


def _without_leaps(track: ObjectTrack, good: Mask, notes: list[str]) -> tuple[ObjectTrack, Mask, list[Leap]]:
    """The track with its leaps bridged, which frames are good then, and the leaps that did not come back."""
    index = np.flatnonzero(good)
    seen, keep, leaps = without_leaps(track.T_camera_object[index], track.time_s[index], track.confidence[index])
    if 2 * keep.sum() < len(index):
        raise UserError(
            f"the track of {track.name!r} leaps to and fro in {int((~keep).sum())} of its {len(index)} frames, as no "
            "object does; extract it again, with a --box around it"
        )
    T = track.T_camera_object.copy()
    T[index] = seen
    if not keep.all():
        away_s = track.time_s[index[~keep]]
        when = ", ".join(f"{t:.2f}" for t in away_s[:5])
        notes.append(f"{len(away_s)} frames in which the tracker leapt away were cut out (at {when} s).")
    notes += [leap.sentence() for leap in leaps]
    good = good.copy()
    good[index[~keep]] = False
    return replace(track, T_camera_object=T), good, leaps


def _video_clock(T: Array, time_s: Array, control_hz: float, hold_s: float, ease_s: float, notes: list[str]) -> Array:
    """(N,) the video's time at each control knot: hold, gather speed, run, slow down, hold."""
    duration_s = float(time_s[-1] - time_s[0])
    head = max(2, int(np.searchsorted(time_s, time_s[0] + _HEAD_S)) // 2)
    eases_s = []
    for ends, where in ((slice(None), "begins"), (slice(None, None, -1), "ends")):
        # Means of two short stretches, so that jitter does not pass for motion.
        near, far = (Rotation.from_matrix(T[ends][part, :3, :3]).mean() for part in _halves(head))
        moved_m = np.diff([T[ends][part, :3, 3].mean(axis=0) for part in _halves(head)], axis=0)
        span_s = abs(float(time_s[ends][head] - time_s[ends][0]))
        moving = np.linalg.norm(moved_m) > _STILL_M_S * span_s or (near.inv() * far).magnitude() > _STILL_RAD_S * span_s
        eases_s.append(min(ease_s, 0.5 * duration_s) if moving else 0.0)
        if eases_s[-1] > 0:
            notes.append(f"The object already moves where the track {where}; the robot eases over {eases_s[-1]:.1f} s.")

    def advance(t: Array, ease: float) -> Array:
        # Integral of a minimum-jerk rise of the clock's rate from 0 to 1 over `ease`.
        if ease == 0.0:
            return np.maximum(t, 0.0)
        p = np.clip(t / ease, 0.0, 1.0)
        return np.asarray(ease * (2.5 * p**4 - 3 * p**5 + p**6) + np.maximum(t - ease, 0.0))

    total_s = 2 * hold_s + duration_s + 0.5 * sum(eases_s)
    t = np.arange(int(np.ceil(total_s * control_hz - 1e-6)) + 1) / control_hz
    rising = advance(t - hold_s, eases_s[0])
    falling = duration_s - advance(total_s - hold_s - t, eases_s[1])
    clock_s = np.where(rising < 0.5 * duration_s, rising, falling)
    return np.asarray(time_s[0] + np.clip(clock_s, 0.0, duration_s))


def _halves(count: int) -> tuple[slice, slice]:
    return slice(0, count), slice(count, 2 * count)


def _without_jitter(T: Array, confidence: Array, control_hz: float, notes: list[str]) -> Array:
    """Poses smoothed as little as makes neighbouring accelerations agree; a track that is smooth stays as it is.

    White noise makes second differences alternate (their correlation from knot to knot is -2/3), a hand's motion
    makes them agree: that tells jitter from haste without knowing how fast the hand may be. Frames of low confidence
    weigh less.
    """
    weight = np.maximum(confidence, 0.05)[:, None]
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    # One sign along the way, so that averaging quaternions means something.
    xyzw[1:] *= np.cumprod(np.where(np.sum(xyzw[1:] * xyzw[:-1], axis=1) < 0, -1.0, 1.0))[:, None]

    def smoothed(value: Array, width_s: float) -> Array:
        if width_s == 0.0:
            return value
        sigma = width_s * control_hz
        top = gaussian_filter1d(weight * value, sigma, axis=0, mode="nearest")
        return np.asarray(top / gaussian_filter1d(weight, sigma, axis=0, mode="nearest"))

    out = T.copy()
    for what, value, floor in (("position", T[:, :3, 3], JITTER_M), ("rotation", xyzw, 0.5 * JITTER_RAD)):
        width_s = next((w for w in SMOOTHING_S if not _jitters(smoothed(value, w), floor)), SMOOTHING_S[-1])
        if width_s == 0.0:
            continue
        notes.append(f"The tracked {what} jitters; it was smoothed over {width_s:.2f} s.")
        if what == "position":
            out[:, :3, 3] = smoothed(value, width_s)
        else:
            out[:, :3, :3] = Rotation.from_quat(smoothed(value, width_s)).as_matrix()
    return out


def _jitters(value: Array, floor: float) -> bool:
    """Whether the second differences of (N, D) are larger than `floor` (rms) and alternate rather than agree."""
    bend = np.diff(value, n=2, axis=0)
    power = float(np.sum(bend**2))
    if len(bend) < 8 or np.sqrt(power / len(bend)) < floor:
        return False
    return float(np.sum(bend[1:] * bend[:-1])) < 0.2 * power
