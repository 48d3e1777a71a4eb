"""Joint motions for real arms: commands at 1 kHz as CSV for libfranka-style players, and a ROS message as JSON.

CSV: a row a millisecond, columns `CSV_COLUMNS`. ROS: `trajectory_msgs/JointTrajectory`, a point a knot with position,
speed, acceleration and effort, between which ROS's controllers go along the very quintic that the curve here is.
Torques are the motors' whole effort: what gravity, the vessel and its contents ask for is part of them. libfranka adds
the arm's own gravity by itself, so a torque player must take that off (`model.gravity(state)`).
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.interpolate import BPoly, CubicSpline

from ..envs.panda import ARM_JOINTS, FINGER_MAX_M
from ..extract.errors import UserError
from ..extract.files import atomic_path, write_json
from ..extract.geometry import Array
from .joints import JointTrajectory
from .limits import COMMAND_HZ
from .motion import JointCurve

Format = Literal["csv", "ros"]
_NUMBERS = range(1, 8)
CSV_COLUMNS = (
    "time_s",
    *(f"q{i}_rad" for i in _NUMBERS),
    *(f"dq{i}_rad_s" for i in _NUMBERS),
    *(f"tau{i}_nm" for i in _NUMBERS),
    "gripper_width_m",
)
_ROS_FIELDS = ("positions", "velocities", "accelerations", "effort")


@dataclass(frozen=True)
class Commands:
    """What an arm is told, row by row: time_s (N,), q_rad, dq_rad_s, tau_nm (N, 7), gripper_width_m (N,)."""

    time_s: Array
    q_rad: Array
    dq_rad_s: Array
    tau_nm: Array
    gripper_width_m: Array


def commands_of(joints: JointTrajectory, rate_hz: float = COMMAND_HZ) -> Commands:
    """A joint motion between its knots: the quintic through its positions, torques along a cubic, from time 0."""
    time_s = joints.time_s - joints.time_s[0]
    curve = JointCurve(time_s, joints.q_rad)
    fine_s = curve.clock(rate_hz)
    inside_s = np.minimum(fine_s, time_s[-1])
    tau_nm = CubicSpline(time_s, joints.tau_nm)(inside_s)
    width_m = 2.0 * np.interp(inside_s, time_s, joints.gripper_m)
    return Commands(fine_s, curve.at(fine_s), curve.at(fine_s, 1), np.asarray(tau_nm), np.asarray(width_m))


def write_csv(joints: JointTrajectory, path: Path) -> None:
    """Write commands at 1 kHz, atomically."""
    told = commands_of(joints)
    rows = np.column_stack([told.time_s, told.q_rad, told.dq_rad_s, told.tau_nm, told.gripper_width_m])
    with atomic_path(Path(path)) as temporary:
        # Differences at 1 kHz are taken three times: what is rounded away here would come back as jerk.
        np.savetxt(temporary, rows, fmt="%.13g", delimiter=",", header=",".join(CSV_COLUMNS), comments="")


def write_ros(joints: JointTrajectory, path: Path) -> None:
    """Write a `trajectory_msgs/JointTrajectory` as JSON, as ROS 2 tools turn messages into text, atomically."""
    time_s = joints.time_s - joints.time_s[0]
    curve = JointCurve(time_s, joints.q_rad)
    columns = [joints.q_rad, curve.at(time_s, 1), curve.at(time_s, 2), joints.tau_nm]
    points = [
        {name: row.tolist() for name, row in zip(_ROS_FIELDS, rows, strict=True)} | {"time_from_start": _duration(t)}
        for t, *rows in zip(time_s, *columns, strict=True)
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "panda_link0"}
    write_json(Path(path), {"header": header, "joint_names": list(ARM_JOINTS), "points": points})


def read_commands(path: Path) -> Commands:
    """What a file makes the arm do, at 1 kHz: CSV as it is, ROS JSON and `*.joints.npz` between their knots.

    Raises UserError when it is missing, of another kind, or holds what is no number.
    """
    path = Path(path)
    if path.suffix == ".csv":
        return _read_csv(path)
    if path.suffix == ".json":
        return _read_ros(path)
    if path.name.endswith(".npz"):
        return commands_of(JointTrajectory.load(path))
    raise UserError(f"{path} is no trajectory: give a .csv or .json of `export-trajectory`, or a *.joints.npz")


def _read_csv(path: Path) -> Commands:
    lines = _text(path).splitlines()
    head = next(csv.reader(lines[:1]), [])
    if [name.strip() for name in head] != list(CSV_COLUMNS):
        raise UserError(
            f"{path} must begin with the columns {','.join(CSV_COLUMNS)}; it begins with {','.join(head)!r}"
        )
    try:
        rows = np.loadtxt(io.StringIO("\n".join(lines[1:])), delimiter=",", ndmin=2)
    except ValueError as error:
        raise UserError(f"{path} holds a row that is not {len(CSV_COLUMNS)} numbers: {error}") from error
    if rows.shape[1:] != (len(CSV_COLUMNS),) or len(rows) < 2:
        raise UserError(f"{path} must hold at least 2 rows of {len(CSV_COLUMNS)} numbers, it has {rows.shape}")
    return _checked(path, rows[:, 0], rows[:, 1:8], rows[:, 8:15], rows[:, 15:22], rows[:, 22])


def _read_ros(path: Path) -> Commands:
    try:
        message: Any = json.loads(_text(path))
        points = message["points"]
        order = [list(message["joint_names"]).index(name) for name in ARM_JOINTS]
        time_s = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points], float)
        q, dq, ddq, tau = (np.array([p[name] for p in points], float)[:, order] for name in _ROS_FIELDS)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError(
            f"{path} is no trajectory_msgs/JointTrajectory of the Panda with {', '.join(_ROS_FIELDS)}: {error!r}"
        ) from error
    knots = _checked(path, time_s, q, dq, tau, np.full(len(time_s), 2 * FINGER_MAX_M))
    if len(time_s) < 2 or np.any(np.diff(time_s) <= 0) or not np.isfinite(ddq).all():
        raise UserError(f"{path} must hold at least 2 points of rising time and finite accelerations")
    path_of = BPoly.from_derivatives(time_s, np.stack([q, dq, ddq], axis=1))
    fine_s = time_s[0] + np.arange(int(np.ceil((time_s[-1] - time_s[0]) * COMMAND_HZ - 1e-6)) + 1) / COMMAND_HZ
    inside_s = np.minimum(fine_s, time_s[-1])
    effort = CubicSpline(time_s, knots.tau_nm)(inside_s)
    width_m = np.full(len(fine_s), 2 * FINGER_MAX_M)
    return Commands(fine_s, path_of(inside_s), path_of(inside_s, nu=1), np.asarray(effort), width_m)


def _checked(path: Path, time_s: Array, q: Array, dq: Array, tau: Array, width_m: Array) -> Commands:
    for name, value in {"time": time_s, "position": q, "speed": dq, "torque": tau, "gripper": width_m}.items():
        bad = ~np.isfinite(value.reshape(len(value), -1)).all(axis=1)
        if bad.any():
            raise UserError(f"{path} holds a {name} that is no finite number in row {int(bad.argmax()) + 1}")
    return Commands(time_s, q, dq, tau, width_m)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read the trajectory {path}: {error}") from error


def _duration(time_s: float) -> Mapping[str, int]:
    nanoseconds = round(float(time_s) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
