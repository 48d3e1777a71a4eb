"""Would a real Panda take this trajectory? Every broken limit is a finding with joint, time, value and limit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.panda import FINGER_MAX_M
from ..extract.errors import UserError
from .export import Commands, Format, commands_of, read_commands, write_csv, write_ros
from .joints import JointTrajectory
from .limits import COMMAND_HZ, LIMITS, Extreme, commanded, extremes

# A player's clock and the speed stated beside a position may be off by so much.
_CLOCK_S, _SPEED_RAD_S = 1e-6, 0.01


def check_file(path: Path) -> dict[str, Any]:
    """Findings (JSON-like) about a trajectory file; see `check`. Raises UserError when it cannot be read."""
    return {"file": str(path), **check(read_commands(Path(path)))}


def export_file(joints: Path, kind: Format, out: Path | None = None) -> dict[str, Any]:
    """Write a `*.joints.npz` for a real arm that would take it, beside it if `out` is None. Tells what was written.

    Raises UserError with everything that is wrong otherwise.
    """
    motion = JointTrajectory.load(joints)
    result = check(commands_of(motion))
    if not result["ok"]:
        wrong = "; ".join(finding["sentence"] for finding in result["findings"][:3])
        raise UserError(f"{joints} is nothing for a real arm: {wrong}; retarget it with a smaller --speed or --scale")
    stem = joints.name.removesuffix(".npz").removesuffix(".joints")
    out = out or joints.parent / f"{stem}.{'csv' if kind == 'csv' else 'ros.json'}"
    (write_csv if kind == "csv" else write_ros)(motion, out)
    return {"written": str(out), "duration_s": result["duration_s"]}


def check(commands: Commands) -> dict[str, Any]:
    """What is wrong with commands at 1 kHz, and how near they come to every limit.

    `ok`: nothing is. `findings`: sentences with what, joint, time, value and limit. `largest_part_of_limit`: of each
    quantity. Position, speed, acceleration, jerk, torque and its rate are held against the datasheet, derivatives as
    the arm's controller takes them, from one command to the next and from and to standing still.
    """
    found = extremes(commanded(commands.q_rad, commands.tau_nm))
    findings = [{"sentence": e.sentence(), **_entry(e)} for e in found if e.broken]
    findings += _clock(commands) + _stated_speed(commands) + _gripper(commands)
    nearest = {name: max((e for e in found if e.quantity == name), key=lambda e: e.part) for name in LIMITS}
    return {
        "ok": not findings,
        "duration_s": float(commands.time_s[-1] - commands.time_s[0]),
        "rows": len(commands.time_s),
        "findings": findings,
        "largest_part_of_limit": {name: _entry(extreme) for name, extreme in nearest.items()},
    }


def as_text(result: Mapping[str, Any]) -> str:
    """The findings for a person."""
    lines = [str(finding["sentence"]) + "." for finding in result["findings"]]
    verdict = "The arm would take this trajectory" if result["ok"] else "The arm would refuse this trajectory"
    parts = ", ".join(
        f"{name} {100 * entry['part']:.0f}% (joint {entry['joint']} at {entry['time_s']:.2f} s)"
        for name, entry in result["largest_part_of_limit"].items()
    )
    told = f"{verdict}: {result['rows']} commands over {result['duration_s']:.2f} s."
    return "\n".join([told, *lines, f"Largest parts of the limits: {parts}."])


def _entry(extreme: Extreme) -> dict[str, Any]:
    return {
        "quantity": extreme.quantity,
        "joint": extreme.joint,
        "time_s": extreme.time_s,
        "value": extreme.value,
        "limit": extreme.limit,
        "unit": LIMITS[extreme.quantity].unit,
        "part": extreme.part,
    }


def _clock(commands: Commands) -> list[dict[str, Any]]:
    step_s = np.diff(commands.time_s)
    off = np.abs(step_s - 1.0 / COMMAND_HZ)
    worst = int(off.argmax())
    if off[worst] <= _CLOCK_S:
        return []
    at_s, value = float(commands.time_s[worst]), float(step_s[worst])
    sentence = f"the clock does not run at 1 kHz: after {at_s:.3f} s the next command comes {1000 * value:.4g} ms later"
    return [{"sentence": sentence, "quantity": "clock", "time_s": at_s, "value": value, "limit": 1.0 / COMMAND_HZ}]


def _stated_speed(commands: Commands) -> list[dict[str, Any]]:
    travelled = np.diff(commands.q_rad, axis=0) * COMMAND_HZ
    off = np.abs(travelled - 0.5 * (commands.dq_rad_s[1:] + commands.dq_rad_s[:-1]))
    row, joint = (int(i) for i in np.unravel_index(int(off.argmax()), off.shape))
    if off[row, joint] <= _SPEED_RAD_S:
        return []
    at_s, value = row / COMMAND_HZ, float(off[row, joint])
    sentence = (
        f"joint {joint + 1}'s speed is not that of its positions at {at_s:.3f} s: they differ by {value:.3g} rad/s, "
        f"{_SPEED_RAD_S} are allowed"
    )
    told = {"quantity": "stated speed", "joint": joint + 1, "time_s": at_s, "value": value, "limit": _SPEED_RAD_S}
    return [{"sentence": sentence, **told}]


def _gripper(commands: Commands) -> list[dict[str, Any]]:
    width_m = commands.gripper_width_m
    beyond = np.maximum(width_m - 2 * FINGER_MAX_M, -width_m)
    row = int(beyond.argmax())
    if beyond[row] <= 1e-9:
        return []
    at_s, value = row / COMMAND_HZ, float(width_m[row])
    sentence = (
        f"the gripper is told to open to {1000 * value:.1f} mm at {at_s:.3f} s, it opens from 0 to "
        f"{2000 * FINGER_MAX_M:.0f} mm"
    )
    return [{"sentence": sentence, "quantity": "gripper", "time_s": at_s, "value": value, "limit": 2 * FINGER_MAX_M}]
