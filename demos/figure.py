"""Pictures of a run for a paper or a slide: what was seen, what was followed, what the robot did; and the joints.

`figure.png` has a column a moment and the rows input, prediction and simulation, as in FreePose's figures; `joints.png`
shows position, speed and torque of every joint between its limits.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..envs.reference import Reference
from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.geometry import Array
from ..extract.video import iterate_frames, read_video_info
from .joints import JointTrajectory
from .limits import LIMITS
from .simulate import PANEL_HEIGHT_PX

Image = NDArray[np.uint8]
MAX_COLUMNS = 12
ROW_PX, _LABEL_PX, _TITLE_PX, _GAP_PX = 240, 34, 30, 4
_PAPER, _INK, _GRID, _BAND = (255, 255, 255), (40, 40, 44), (222, 224, 228), (238, 243, 250)
_LINE, _LIMIT = (30, 100, 200), (200, 60, 50)
_PLOT_PX = (320, 92)


def figure(folder: Path, times_s: Sequence[float] | None = None, columns: int = 5) -> dict[str, Any]:
    """Write figure.png and joints.png into a run's folder; tells what was written and the moments shown.

    times_s: on the video's clock; None: `columns` of them, evenly over the motion. The video is looked for where
    run.json says; without it, as after `simulate` without one, that row is left out, like every row whose film is
    missing. Raises UserError when the folder holds no run or no film of it.
    """
    folder = Path(folder)
    found = sorted(folder.glob("*.reference.npz"))
    if len(found) != 1:
        raise UserError(f"{folder} holds {len(found)} *.reference.npz, a run has one; give the folder of a run")
    reference = Reference.load(found[0])
    start_s, end_s = float(reference.video_time_s[0]), float(reference.video_time_s[-1])
    if times_s is None and not 1 <= columns <= MAX_COLUMNS:
        raise UserError(f"{columns} columns make no figure; choose 1 to {MAX_COLUMNS}")
    at_s = np.array(np.linspace(start_s, end_s, columns) if times_s is None else times_s, np.float64)
    if not 1 <= len(at_s) <= MAX_COLUMNS or not np.all((at_s >= start_s - 1e-6) & (at_s <= end_s + 1e-6)):
        raise UserError(
            f"the times must be 1 to {MAX_COLUMNS} from {start_s:.2f} to {end_s:.2f} s of the video, got "
            f"{', '.join(f'{t:g}' for t in at_s)}"
        )
    rows: dict[str, list[Image]] = {}
    video = _video_of(folder)
    for label, film in (("input", video), ("prediction", folder / "overlay.mp4")):
        if film is not None and film.is_file():
            rows[label] = _frames_at(film, at_s)
    simulation = folder / "simulation.mp4"
    if simulation.is_file():
        knots = [int(np.abs(reference.video_time_s - t).argmin()) for t in at_s]
        played_s = np.array(knots) / reference.control_hz
        rows["simulation"] = [_robot_panel(frame) for frame in _frames_at(simulation, played_s)]
    if not rows:
        raise UserError(f"{folder} holds no overlay.mp4 and no simulation.mp4; make them with `vid2demo run`")
    written = [_write(folder / "figure.png", _grid(rows, at_s))]
    joints = folder / f"{found[0].name.removesuffix('.reference.npz')}.joints.npz"
    if joints.is_file():
        written.append(_write(folder / "joints.png", joint_plots(JointTrajectory.load(joints))))
    return {"written": written, "rows": list(rows), "times_s": [round(float(t), 3) for t in at_s]}


def joint_plots(joints: JointTrajectory) -> Image:
    """Position, speed and torque (columns) of every joint (rows) over time, between lines for the limits."""
    columns = (("position", joints.q_rad), ("speed", joints.dq_rad_s), ("torque", joints.tau_nm))
    width, height = _PLOT_PX
    picture = np.full((_TITLE_PX + 7 * (height + _GAP_PX), _LABEL_PX + 3 * (width + _GAP_PX), 3), _PAPER, np.uint8)
    for c, (quantity, value) in enumerate(columns):
        left = _LABEL_PX + c * (width + _GAP_PX)
        _text(picture, f"{quantity} [{LIMITS[quantity].unit}]", (left + 6, 20), 0.5)
        for j in range(7):
            top = _TITLE_PX + j * (height + _GAP_PX)
            if c == 0:
                _text(picture, f"{j + 1}", (10, top + height // 2), 0.5)
            limit = LIMITS[quantity]
            plot = _plot(joints.time_s, value[:, j], float(limit.low[j]), float(limit.high[j]))
            picture[top : top + height, left : left + width] = plot
    return picture


def _plot(time_s: Array, value: Array, low: float, high: float) -> Image:
    width, height = _PLOT_PX
    picture = np.full((height, width, 3), _BAND, np.uint8)
    pad = 8
    bottom, top = min(low, float(value.min())), max(high, float(value.max()))

    def y(v: Array | float) -> Array:
        return height - pad - (np.asarray(v, float) - bottom) / (top - bottom) * (height - 2 * pad)

    for second in range(int(time_s[-1]) + 1):
        x = round(second / float(time_s[-1]) * (width - 1))
        cv2.line(picture, (x, 0), (x, height - 1), _GRID, 1)
    for edge in (low, high):
        cv2.line(picture, (0, round(float(y(edge)))), (width - 1, round(float(y(edge)))), _LIMIT, 1)
    x = time_s / time_s[-1] * (width - 1)
    points = np.round(np.column_stack([x, y(value)]) * 16).astype(np.int32)
    cv2.polylines(picture, [points[:, None]], False, _LINE, 2, cv2.LINE_AA, 4)
    part = float((np.abs(value - 0.5 * (low + high)) / (0.5 * (high - low))).max())
    _text(picture, f"{100 * part:.0f}%", (width - 46, 24), 0.42)
    return picture


def _video_of(folder: Path) -> Path | None:
    """The clip that the run was made from, if run.json names one that is still there."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        path = Path(record["video"]["path"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return path if path.is_file() else None


def _frames_at(film: Path, at_s: Array) -> list[Image]:
    """The frame nearest in time to each moment, scaled to the rows' height."""
    info = read_video_info(film)
    best: list[tuple[float, Image | None]] = [(np.inf, None)] * len(at_s)
    for frame in iterate_frames(film):
        for i, t in enumerate(at_s):
            off = abs(frame.time_s - float(t))
            if off < best[i][0]:
                best[i] = (off, frame.rgb)
    frames = [rgb for _, rgb in best if rgb is not None]
    if len(frames) < len(at_s):
        raise UserError(f"the film {film} has no frames ({info.frame_count} announced); make it again")
    return frames


def _robot_panel(frame: Image) -> Image:
    """The right half of `simulation.mp4`'s picture: the robot alone, without the strip below."""
    return frame[:PANEL_HEIGHT_PX, -(PANEL_HEIGHT_PX * 4 // 3) :]


def _grid(rows: dict[str, list[Image]], at_s: Array) -> Image:
    scaled = {label: [_scaled(frame) for frame in frames] for label, frames in rows.items()}
    # Rows may differ in shape: every column is as wide as its widest picture, the others stand in its middle.
    width = max(frame.shape[1] for frames in scaled.values() for frame in frames)
    picture = np.full(
        (_TITLE_PX + len(rows) * (ROW_PX + _GAP_PX), _LABEL_PX + len(at_s) * (width + _GAP_PX), 3), _PAPER, np.uint8
    )
    for c, t in enumerate(at_s):
        _text(picture, f"{t:.1f} s", (_LABEL_PX + c * (width + _GAP_PX) + width // 2 - 24, 21), 0.55)
    for r, (label, frames) in enumerate(scaled.items()):
        top = _TITLE_PX + r * (ROW_PX + _GAP_PX)
        strip = np.full((_LABEL_PX, ROW_PX, 3), _PAPER, np.uint8)
        (length, _), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)
        _text(strip, label, ((ROW_PX - length) // 2, 23), 0.6)
        picture[top : top + ROW_PX, :_LABEL_PX] = np.rot90(strip)
        for c, frame in enumerate(frames):
            left = _LABEL_PX + c * (width + _GAP_PX) + (width - frame.shape[1]) // 2
            picture[top : top + ROW_PX, left : left + frame.shape[1]] = frame
    return picture


def _scaled(frame: Image) -> Image:
    height, width = frame.shape[:2]
    size = (max(1, round(width * ROW_PX / height)), ROW_PX)
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)


def _text(picture: Image, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def _write(path: Path, picture: Image) -> str:
    _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return str(path)
