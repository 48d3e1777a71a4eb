"""From a track at the video's own, possibly uneven, frame times to clean poses at the control rate.

Frames the tracker did not see or trust are bridged, jumps there and back are cut out, and the ends get a short hold
and, where the object is already moving, a gentle start, because a robot cannot begin at speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array, rotation_angle_rad
from ..extract.track import ObjectTrack
from .reference import interpolate_poses, spline_poses

Mask = NDArray[np.bool_]

MIN_FRAMES = 4
MIN_DURATION_S = 0.3
MAX_TRAVEL_M = 5.0
# A hand does not move a vessel faster; a tracker that loses it does.
JUMP_M_S, JUMP_RAD_S, JUMP_FRAMES = 4.0, 20.0, 6
_STILL_M_S, _STILL_RAD_S = 0.04, 0.2


@dataclass(frozen=True)
class ResampledTrack:
    """Poses at the control rate.

    T_camera_object: (N, 4, 4); video_time_s: (N,) the video's clock, not decreasing; confidence: (N,) in [0, 1].
    notes: what was bridged, cut or added, in plain sentences.
    """

    T_camera_object: Array
    video_time_s: Array
    confidence: Array
    notes: list[str]


def resample_track(
    track: ObjectTrack, control_hz: float, *, min_confidence: float = 0.2, hold_s: float = 0.2, ease_s: float = 0.4
) -> ResampledTrack:
    """Poses of a track on knots of `control_hz`, between the first and the last frame that can be trusted.

    hold_s: the robot stands still for so long before and after. ease_s: over so long it gathers speed when the track
    begins or ends in motion. Raises UserError for a track that is too short, never visible or not in metres.
    """
    if not 1.0 <= control_hz <= 1000.0:
        raise UserError(f"the control rate is {control_hz} Hz; choose one from 1 to 1000")
    _check_units(track)
    notes: list[str] = []
    good = _trusted_frames(track, min_confidence, notes)
    good &= ~_jump_frames(track, good, notes)
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
    return ResampledTrack(
        spline_poses(T, time_s, video_time_s), video_time_s, np.interp(video_time_s, time_s, confidence), notes
    )


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


def _jump_frames(track: ObjectTrack, good: Mask, notes: list[str]) -> Mask:
    """Frames between a leap away and a leap back, at most `JUMP_FRAMES` of them."""
    index = np.flatnonzero(good)
    T, time_s = track.T_camera_object[index], track.time_s[index]
    bad = np.zeros(len(track), bool)
    if len(index) < 3:
        return bad
    step_s = np.diff(time_s)
    speed_m_s = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / step_s
    speed_rad_s = rotation_angle_rad(T[1:, :3, :3], T[:-1, :3, :3]) / step_s
    leaps = np.flatnonzero((speed_m_s > JUMP_M_S) | (speed_rad_s > JUMP_RAD_S))
    paired = 0
    while paired < len(leaps):
        here = leaps[paired]
        partner = leaps[paired + 1] if paired + 1 < len(leaps) else None
        if partner is not None and partner - here <= JUMP_FRAMES:
            bad[index[here + 1 : partner + 1]] = True
            paired += 2
            continue
        if here == 0:
            bad[index[0]] = True
        elif here == len(index) - 2:
            bad[index[-1]] = True
        else:
            notes.append(
                f"At {time_s[here]:.2f} s the track leaps by {speed_m_s[here] * step_s[here]:.2f} m and "
                f"{np.rad2deg(speed_rad_s[here] * step_s[here]):.0f} degrees within one frame and does not come back; "
                "the robot follows more slowly."
            )
        paired += 1
    if bad.any():
        when = ", ".join(f"{t:.2f}" for t in track.time_s[bad][:5])
        notes.append(f"{int(bad.sum())} frames in which the tracker leapt away were cut out (at {when} s).")
    return bad


def _video_clock(T: Array, time_s: Array, control_hz: float, hold_s: float, ease_s: float, notes: list[str]) -> Array:
    """(N,) the video's time at each control knot: hold, gather speed, run, slow down, hold."""
    duration_s = float(time_s[-1] - time_s[0])
    head = max(1, int(np.searchsorted(time_s, time_s[0] + 0.15)))
    eases_s = []
    for a, b, where in ((0, head, "begins"), (-1, -1 - head, "ends")):
        span_s = abs(time_s[b] - time_s[a])
        moving = (
            np.linalg.norm(T[b, :3, 3] - T[a, :3, 3]) > _STILL_M_S * span_s
            or rotation_angle_rad(T[b, :3, :3], T[a, :3, :3]) > _STILL_RAD_S * span_s
        )
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
