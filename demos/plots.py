"""Plots over time as HTML figures with inline SVG: small, without a library, readable in light and dark and on a phone.

Colours come from CSS variables (`--line-1` ...), so that the page decides them. Every figure carries its data, with
which the page's script shows values under the pointer and moves a cursor along with a video.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..extract.geometry import Array

if TYPE_CHECKING:
    from .joints import JointTrajectory

WIDTH, HEIGHT = 460.0, 230.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 50.0, 12.0, 10.0, 34.0
_MAX_POINTS = 400


@dataclass(frozen=True)
class Line:
    """One curve: values (N,), gaps where they are not finite; `color` picks `--line-N`."""

    label: str
    value: Array
    color: int = 1
    dashed: bool = False


@dataclass(frozen=True)
class Mark:
    """A horizontal line that tells a limit or a target."""

    value: float
    label: str


def chart(
    title: str,
    unit: str,
    time_s: Array,
    lines: Sequence[Line],
    *,
    marks: Sequence[Mark] = (),
    limits: tuple[float | None, float | None] = (None, None),
    hidden: NDArray[np.bool_] | None = None,
    clock: str = "",
) -> str:
    """A figure of curves over time.

    limits: fixed lower and upper end of the value axis.  hidden: (N,) bool, times shaded as "not visible".
    clock: id of the video whose time the plot shares.
    """
    time_s = np.asarray(time_s, float)
    finite = [v[np.isfinite(v)] for v in (np.asarray(line.value, float) for line in lines)]
    pool = np.concatenate([*finite, np.array([mark.value for mark in marks]), np.zeros(0)])
    low, high = (float(pool.min()), float(pool.max())) if len(pool) else (0.0, 1.0)
    low, high = (limits[0] if limits[0] is not None else low), (limits[1] if limits[1] is not None else high)
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    pad = 0.06 * (high - low)
    low, high = low - (0 if limits[0] is not None else pad), high + (0 if limits[1] is not None else pad)
    start, end = float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-6)

    def x(t: Array | float) -> Array:
        return _LEFT + (np.asarray(t, float) - start) / (end - start) * (WIDTH - _LEFT - _RIGHT)

    def y(v: Array | float) -> Array:
        return HEIGHT - _BOTTOM - (np.asarray(v, float) - low) / (high - low) * (HEIGHT - _TOP - _BOTTOM)

    parts = []
    if hidden is not None:
        for a, b in _stretches(hidden):
            left, right = float(x(time_s[a])), float(x(time_s[min(b, len(time_s) - 1)]))
            parts.append(f'<rect class="hidden" x="{left:.1f}" y="{_TOP}" width="{max(right - left, 1):.1f}" '
                         f'height="{HEIGHT - _TOP - _BOTTOM}"/>')  # fmt: skip
    for tick in ticks(low, high):
        at = float(y(tick))
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
    parts += _time_axis(x, start, end, HEIGHT)
    for mark in marks:
        at = float(y(mark.value))
        parts.append(f'<path class="mark" d="M{_LEFT} {at:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="marklabel" x="{WIDTH - _RIGHT - 2}" y="{at - 4:.1f}" text-anchor="end">'
                     f"{escape(mark.label)}</text>")  # fmt: skip
    for line in lines:
        style = ' stroke-dasharray="5 4"' if line.dashed else ""
        d = _path(x(time_s), np.clip(y(line.value), _TOP - 4, HEIGHT - _BOTTOM + 4))
        parts.append(f'<path class="line" style="stroke:var(--line-{line.color})"{style} d="{d}"/>')
    return _figure(title, unit, parts, HEIGHT, time_s, [(li.label, li.color, li.value) for li in lines], clock)


def joint_rows(
    title: str,
    time_s: Array,
    value: Array,
    low: Array,
    high: Array,
    *,
    unit: str = "°",
    factor: float = 180.0 / math.pi,
    clock: str = "",
) -> str:
    """A figure with one row for each joint: its value (N, J) inside the band between its limits (J,).

    unit, factor: what is shown, and how much of it one of the value is; degrees of radians by default.
    """
    row, count = 40.0, value.shape[1]
    height = _TOP + row * count + _BOTTOM
    start, end = float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-6)

    def x(t: Array | float) -> Array:
        return _LEFT + (np.asarray(t, float) - start) / (end - start) * (WIDTH - _LEFT - _RIGHT)

    parts = _time_axis(x, start, end, height)
    for j in range(count):
        top = _TOP + row * j + 3
        part = (value[:, j] - low[j]) / (high[j] - low[j])
        margin = factor * float(np.minimum(value[:, j] - low[j], high[j] - value[:, j]).min())
        parts.append(f'<rect class="band" x="{_LEFT}" y="{top}" width="{WIDTH - _LEFT - _RIGHT}" height="{row - 6}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 8}" y="{top + 21}" text-anchor="end">joint {j + 1}</text>')
        d = _path(x(time_s), top + (1 - np.clip(part, -0.05, 1.05)) * (row - 6))
        parts.append(f'<path class="line" style="stroke:var(--line-1)" d="{d}"/>')
        amount = f"{abs(margin):.{0 if abs(margin) >= 10 or unit == '°' else 1}f}{'' if unit == '°' else ' '}{unit}"
        text = f"{amount} to the limit" if margin >= 0 else f"{amount} beyond the limit"
        near = part[len(part) * 3 // 5 :].mean() > 0.5
        at = top + (row - 12 if near else 11)
        parts.append(f'<text class="marklabel" x="{WIDTH - _RIGHT - 4}" y="{at}" text-anchor="end">{text}</text>')
    data = [(f"joint {j + 1}", 1, factor * value[:, j]) for j in range(count)]
    return _figure(title, unit, parts, height, time_s, data, clock, legend=False)


def motion_rows(joints: JointTrajectory, *, clock: str = "") -> str:
    """Three figures of a joint motion: positions, speeds and torques between their limits."""
    from .limits import LIMITS

    degrees = 180.0 / math.pi
    figures = []
    for title, kind, value, unit, factor in (
        ("joints between their limits", "position", joints.q_rad, "°", degrees),
        ("their speeds", "speed", joints.dq_rad_s, "°/s", degrees),
        ("their torques", "torque", joints.tau_nm, "N m", 1.0),
    ):
        low, high = LIMITS[kind].low, LIMITS[kind].high
        figures.append(joint_rows(title, joints.time_s, value, low, high, unit=unit, factor=factor, clock=clock))
    return "".join(figures)


def tries_figure(tries: Sequence[Mapping[str, Any]]) -> str:
    """What `--scale auto` tried: poured minus spilled percent over the receptacle's shift, a curve for every scale.

    Rings are tries with the receptacle moved sideways, the chosen try is a large dot, and what the arm cannot do stands
    at -100. Under the pointer each tells its fractions.
    """
    height = HEIGHT + 20.0
    most_cm = 1.1 * max(1.0, *(100.0 * abs(float(t["along_m"])) for t in tries))

    def x(cm: Array | float) -> Array:
        return _LEFT + (np.asarray(cm, float) / most_cm + 1.0) / 2.0 * (WIDTH - _LEFT - _RIGHT)

    def y(score: Array | float) -> Array:
        return height - _BOTTOM - (np.asarray(score, float) + 1.0) / 2.0 * (height - _TOP - 6.0 - _BOTTOM)

    parts = []
    for tick in (-100, -50, 0, 50, 100):
        at = float(y(tick / 100))
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick}</text>')
    for shift in ticks(-most_cm, most_cm):
        parts.append(
            f'<text class="tick" x="{float(x(shift)):.1f}" y="{height - _BOTTOM + 16}" text-anchor="middle">'
            f"{_number(shift)}</text>"
        )
    parts.append(
        f'<text class="tick" x="{WIDTH - _RIGHT}" y="{height - 4}" text-anchor="end">receptacle moved along the pour '
        "[cm]</text>"
    )
    motions: dict[str, list[Mapping[str, Any]]] = {}
    for t in tries:
        motions.setdefault("tipped further" if t["tip_deg"] else f"path ×{float(t['scale']):.2g}", []).append(t)
    keys = ""
    for number, (label, made) in enumerate(motions.items()):
        color = f"var(--line-{number + 1})"
        along = sorted((t for t in made if not t["across_m"]), key=lambda t: float(t["along_m"]))
        where_cm, scores = (np.array([float(t[name]) for t in along]) for name in ("along_m", "score"))
        d = _path(x(100.0 * where_cm), y(scores))
        parts.append(f'<path class="line" style="stroke:{color}" d="{d}"/>')
        for t in made:
            ring = f"stroke:{color};fill:none;stroke-width:2" if t["across_m"] else f"fill:{color}"
            where = f'cx="{float(x(100.0 * t["along_m"])):.1f}" cy="{float(y(t["score"])):.1f}"'
            what = f"{label}: {100 * t['poured']:.0f}% poured, {100 * t['spilled']:.0f}% spilled"
            what += f", {t['tip_deg']:.0f}° further" if t["tip_deg"] else ""
            parts.append(
                f'<circle {where} r="{7 if t["chosen"] else 3.5}" style="{ring}"><title>{what}</title></circle>'
            )
        keys += f'<span class="key"><i style="background:{color}"></i>{label}</span>'
    title = "pours tried: poured minus spilled"
    return (
        f"<figure><figcaption><b>{title}</b> <small>[%]</small> {keys}</figcaption>"
        f'<svg viewBox="0 0 {WIDTH:.0f} {height:.0f}" role="img" aria-label="{title}">{"".join(parts)}</svg></figure>'
    )


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round values inside [low, high], about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = min((m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999), default=10 * power)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _time_axis(x: object, start: float, end: float, height: float) -> list[str]:
    parts = []
    for tick in ticks(start, end, 6):
        at = float(x(tick))  # type: ignore[operator]
        parts.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{height - _BOTTOM}"/>')
        parts.append(f'<text class="tick" x="{at:.1f}" y="{height - _BOTTOM + 16}" text-anchor="middle">'
                     f"{_number(tick)}</text>")  # fmt: skip
    parts.append(f'<text class="tick" x="{WIDTH - _RIGHT}" y="{height - 4}" text-anchor="end">time [s]</text>')
    return parts


def _figure(
    title: str,
    unit: str,
    parts: Sequence[str],
    height: float,
    time_s: Array,
    curves: Sequence[tuple[str, int, Array]],
    clock: str,
    legend: bool = True,
) -> str:
    keep = np.unique(np.linspace(0, len(time_s) - 1, min(len(time_s), _MAX_POINTS)).astype(int))
    data = {
        "t": [round(float(v), 3) for v in time_s[keep]],
        "names": [label for label, _, _ in curves],
        "values": [[_short(float(v)) for v in np.asarray(value, float)[keep]] for _, _, value in curves],
        "unit": unit,
        "x": [_LEFT, WIDTH - _RIGHT],
    }
    keys = "".join(
        f'<span class="key"><i style="background:var(--line-{color})"></i>{escape(label)}</span>'
        for label, color, _ in curves
        if legend and len(curves) > 1
    )
    bottom = height - _BOTTOM
    return (
        f'<figure class="plot" data-clock="{escape(clock)}" data-plot="{escape(json.dumps(data), quote=True)}">'
        f"<figcaption><b>{escape(title)}</b> <small>[{escape(unit)}]</small> {keys}<output></output></figcaption>"
        f'<svg viewBox="0 0 {WIDTH:.0f} {height:.0f}" role="img" aria-label="{escape(title)} over time">'
        f'{"".join(parts)}<path class="cursor" d="M0 {_TOP}V{bottom}"/></svg></figure>'
    )


def _path(x: Array, y: Array) -> str:
    """SVG path through finite points; thinned where there are more points than pixels, extremes kept."""
    n = len(x)
    if n > 2 * _MAX_POINTS:
        blocks = np.array_split(np.arange(n), _MAX_POINTS)
        safe = np.where(np.isfinite(y), y, 0.0)
        chosen = {int(b[i]) for b in blocks for i in (safe[b].argmin(), safe[b].argmax())} | {0, n - 1}
        index = np.array(sorted(chosen))
        x, y = x[index], y[index]
    out, pen = [], "M"
    for a, b in zip(x, y, strict=True):
        if not np.isfinite(b):
            pen = "M"
            continue
        out.append(f"{pen}{a:.1f} {b:.1f}")
        pen = "L"
    return "".join(out)


def _stretches(flag: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """[first, last + 1) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flag, int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _number(value: float) -> str:
    text = f"{value:.6g}"
    return text.replace("-", "−") if float(text) != 0 else "0"


def _short(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None
