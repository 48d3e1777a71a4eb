"""`simulation.mp4`: the person's video and the robot side by side on one clock, and what was measured on the way."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..envs.observations import ENVIRONMENT_NAMES
from ..envs.reference import Reference
from ..extract.errors import UserError
from ..extract.geometry import Array
from ..extract.stages import Progress
from ..extract.video import VideoWriter, iterate_frames
from .attempt import FIXED_ENV_KWARGS
from .impedance import ImpedancePlayer
from .joints import JointTrajectory
from .rollout import DEFAULT_ENV_ID, Info, Observation, control_rate, make_env, roll_out

Image = NDArray[np.uint8]
PANEL_HEIGHT_PX = 480
STRIP_HEIGHT_PX = 40
# Told by environments in which friction holds the vessel: how far it has moved and turned in the hand.
_SLIP = ("slip_m", "slip_rad")
# Of the vessel itself, which under friction may have turned in the hand.
_TILT = ENVIRONMENT_NAMES.index("object_tilt_rad")
_BACKGROUND, _EMPTY = (24, 26, 30), (60, 64, 72)
_TEXT, _POURED, _SPILLED = (236, 238, 242), (74, 163, 255), (255, 107, 87)


def simulate(
    reference_path: Path,
    joints_path: Path,
    video: Path | None,
    out_mp4: Path,
    *,
    camera: str = "front",
    seed: int = 0,
    env_id: str = DEFAULT_ENV_ID,
    env_kwargs: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Play a joint motion in the environment, closed over the object's pose, and film it beside the video.

    Every frame shows the robot at time t and the video at the moment that the reference's knot at t was taken from,
    so the two stay together where the motion was slowed down. Without a video the robot stands alone.
    Returns figures (JSON-like) and `series`: lists over the steps, with `time_s`, `position_error_m`,
    `rotation_error_rad`, `tilt_rad`, `reference_tilt_rad`, `poured_fraction`, `spilled_fraction`, `q_rad` (N x 7),
    `target_rad` (N x 7), `reward` and `reward_terms` (name to list), and under friction `slip_m` and `slip_rad`.
    Raises UserError when the files do not belong together.
    """
    reference, joints = Reference.load(Path(reference_path)), JointTrajectory.load(Path(joints_path))
    if len(joints) != len(reference):
        raise UserError(
            f"{joints_path} has {len(joints)} knots and {reference_path} {len(reference)}: they are not of one motion; "
            "make the joints anew with `vid2demo retarget`"
        )
    kwargs = {**(env_kwargs or {}), "control_hz": reference.control_hz, **FIXED_ENV_KWARGS, "randomization": "none"}
    size = (PANEL_HEIGHT_PX, PANEL_HEIGHT_PX * 4 // 3)
    env = make_env(env_id, reference_path, **kwargs, obs_mode="both", cameras=(camera,), image_size=size)
    recorder = _Recorder(reference, control_rate(env), camera, progress)
    try:
        with VideoWriter(Path(out_mp4), fps=control_rate(env)) as writer:
            recorder.open(writer, _on_clock(Path(video), reference.video_time_s) if video is not None else None)
            episode = roll_out(env, ImpedancePlayer(joints), seed=seed, on_step=recorder)
    finally:
        env.close()
    series = recorder.series()
    moving = slice(0, len(reference) - 1)
    position_m, rotation_rad = (np.asarray(series[name])[moving] for name in ("position_error_m", "rotation_error_rad"))
    return {
        "is_success": episode.is_success,
        "poured_fraction": episode.summary["poured_fraction"],
        "spilled_fraction": episode.summary["spilled_fraction"],
        "position_error_m": {"mean": float(position_m.mean()), "max": float(position_m.max())},
        "rotation_error_rad": {"mean": float(rotation_rad.mean()), "max": float(rotation_rad.max())},
        "largest_tilt_rad": float(np.max(series["tilt_rad"])),
        **{name: float(np.max(series[name])) for name in _SLIP if name in series},
        "duration_s": float(series["time_s"][-1]),
        "steps": len(episode),
        "return": episode.summary["return"],
        "series": series,
    }


class _Recorder:
    """Called after every step: keeps the series and draws the frame that the step began with."""

    def __init__(self, reference: Reference, fps: int, camera: str, progress: Progress | None) -> None:
        self._reference, self._fps, self._camera, self._progress = reference, fps, camera, progress
        self._writer: VideoWriter | None = None
        self._human: Iterator[Image] | None = None
        self._lists: dict[str, list[Any]] = {}
        self._terms: dict[str, list[float]] = {}
        self._poured = self._spilled = 0.0

    def open(self, writer: VideoWriter, human: Iterator[Image] | None) -> None:
        self._writer, self._human = writer, human

    def __call__(
        self, step: int, action: NDArray[np.float32], observation: Observation, reward: float, info: Info
    ) -> None:
        q_rad = np.asarray(observation["agent_pos"][:7], float)
        tilt_rad = float(observation["environment_state"][_TILT])
        knot = min(step, len(self._reference) - 1)
        values = {
            "time_s": step / self._fps,
            "tilt_rad": tilt_rad,
            "reference_tilt_rad": float(self._reference.tilt_rad[knot]),
            "q_rad": q_rad.tolist(),
            "target_rad": np.asarray(action, float).tolist(),
            "reward": reward,
            **{
                name: float(info[name])
                for name in ("position_error_m", "rotation_error_rad", "poured_fraction", "spilled_fraction", *_SLIP)
                if name in info
            },
        }
        for name, value in values.items():
            self._lists.setdefault(name, []).append(value)
        for name, value in info["reward_terms"].items():
            self._terms.setdefault(name, []).append(float(value))
        self._draw(observation["pixels"][self._camera], step / self._fps, tilt_rad)
        # The frame was taken before the action, so it shows the fractions of the step before.
        self._poured, self._spilled = values["poured_fraction"], values["spilled_fraction"]
        if self._progress is not None:
            self._progress(step + 1, len(self._reference) + self._fps, "simulate")

    def series(self) -> dict[str, Any]:
        return {**self._lists, "reward_terms": self._terms}

    def _draw(self, robot: Image, time_s: float, tilt_rad: float) -> None:
        assert self._writer is not None
        panels = [] if self._human is None else [_caption(next(self._human), "video")]
        panels.append(_caption(robot, "robot"))
        picture = np.hstack(panels)
        strip = _legend(picture.shape[1], time_s, tilt_rad, self._poured, self._spilled)
        self._writer.write(np.vstack([picture, strip]))


def _on_clock(video: Path, at_s: Array) -> Iterator[Image]:
    """The frame shown at each time of `at_s` (not decreasing), as a panel; then the last one on and on."""
    frames = iterate_frames(video)
    current = upcoming = next(frames, None)
    if current is None:
        raise UserError(f"video {video} has no frames")
    panel, panel_of = _to_panel(current.rgb), current
    for time_s in at_s:
        while upcoming is not None and upcoming.time_s <= time_s + 1e-6:
            current, upcoming = upcoming, next(frames, None)
        if panel_of is not current:
            panel, panel_of = _to_panel(current.rgb), current
        yield panel
    while True:
        yield panel


def _to_panel(rgb: Image) -> Image:
    import cv2

    height, width = rgb.shape[:2]
    # Even widths, since the picture is stored with halved colour resolution.
    size = (max(2, round(width * PANEL_HEIGHT_PX / height / 2) * 2), PANEL_HEIGHT_PX)
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _caption(panel: Image, text: str) -> Image:
    import cv2

    panel = np.ascontiguousarray(panel).copy()
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)
    corner = panel[8 : height + 24, 8 : width + 24]
    corner[:] = corner // 3
    cv2.putText(panel, text, (16, height + 15), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT, 1, cv2.LINE_AA)
    return panel


def _legend(width_px: int, time_s: float, tilt_rad: float, poured: float, spilled: float) -> Image:
    """The strip below the panels: time, tilt, and a bar of what is poured and spilled."""
    import cv2

    strip = np.full((STRIP_HEIGHT_PX, width_px, 3), _BACKGROUND, np.uint8)
    words = [f"{time_s:5.2f} s", f"tilt {np.rad2deg(tilt_rad):3.0f} deg", f"poured {100 * poured:3.0f}%"]
    words.append(f"spilled {100 * spilled:3.0f}%")
    pitch = min(170, (width_px - 16) // (len(words) + 1))
    for column, text in enumerate(words):
        place = (16 + column * pitch, STRIP_HEIGHT_PX // 2 + 6)
        cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, pitch / 300, _TEXT, 1, cv2.LINE_AA)
    left, right = 16 + len(words) * pitch, width_px - 16
    if right - left > 40:
        top, bottom = STRIP_HEIGHT_PX // 2 - 5, STRIP_HEIGHT_PX // 2 + 5
        ends = [left, left + round((right - left) * poured), left + round((right - left) * min(poured + spilled, 1.0))]
        strip[top:bottom, left:right] = _EMPTY
        strip[top:bottom, ends[0] : ends[1]] = _POURED
        strip[top:bottom, ends[1] : ends[2]] = _SPILLED
    return strip
