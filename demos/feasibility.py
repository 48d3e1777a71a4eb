"""Can the arm do it, how well, and what was changed from the video: figures for programs, sentences for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.kinematics import limit_margin_rad, manipulability, panda_chain
from ..envs.panda import DQ_MAX_RAD_S, TAU_MAX_NM
from ..extract.geometry import Array
from .retarget import tracking_errors

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from .joints import JointTrajectory

GOOD_POSITION_M, GOOD_ROTATION_RAD = 0.01, np.deg2rad(5.0)
_TIGHT_RAD = 0.05
_SHOULDER = np.array([0.0, 0.0, 0.333])


def feasibility(reference: Reference, joints: JointTrajectory) -> dict[str, Any]:
    """Findings (JSON-like) about a joint trajectory made for a reference on the same clock.

    `feasible`: tracking within 1 cm and 5 degrees, joint, speed and torque limits kept, no collision.
    `words`: the same in plain sentences. Raises ValueError when the two differ in length.
    """
    if len(joints) != len(reference):
        raise ValueError(f"the reference has {len(reference)} knots, the joint trajectory {len(joints)}")
    position_m, rotation_rad = tracking_errors(reference, joints.q_rad)
    margin = limit_margin_rad(joints.q_rad)
    speed_part = np.abs(joints.dq_rad_s) / DQ_MAX_RAD_S
    torque_part = np.abs(joints.tau_nm) / TAU_MAX_NM
    collisions = list(reference.header.get("feasibility", {}).get("collisions", []))
    hand = panda_chain().hand(joints.q_rad)[:, :3, 3]
    findings: dict[str, Any] = {
        "position_error_m": _summary(position_m, joints.time_s),
        "rotation_error_rad": _summary(rotation_rad, joints.time_s),
        "joint_limit_margin_rad": _per_joint(margin, joints.time_s, smallest=True),
        "speed_part_of_limit": _per_joint(speed_part, joints.time_s, smallest=False),
        "torque_part_of_limit": _per_joint(torque_part, joints.time_s, smallest=False),
        "reach_m": float(np.linalg.norm(hand - _SHOULDER, axis=1).max()),
        "manipulability": float(manipulability(joints.q_rad).min()),
        "lowest_hand_m": float(hand[:, 2].min()),
        "collisions": collisions,
        "scale": reference.scale,
        "time_stretch": float(reference.header.get("time_stretch", 1.0)),
        "solver": joints.header.get("solver", {}).get("name", "mink"),
        "payload_kg": float(joints.header.get("payload_kg", 0.0)),
        "caught_part_of_jet": reference.header.get("feasibility", {}).get("caught_part_of_jet"),
        "changes": reference.notes,
    }
    problems = _problems(findings, margin, speed_part, torque_part)
    findings["feasible"] = not problems
    note = joints.header.get("solver", {}).get("note")
    findings["words"] = [*_words(findings, problems), *([note] if note else []), *reference.notes]
    return findings


def _problems(findings: dict[str, Any], margin: Array, speed_part: Array, torque_part: Array) -> list[str]:
    problems = []
    position, rotation = findings["position_error_m"], findings["rotation_error_rad"]
    if position["max"] > GOOD_POSITION_M:
        problems.append(
            f"the object is up to {100 * position['max']:.1f} cm off the reference (at {position['max_at_s']:.1f} s)"
        )
    if rotation["max"] > GOOD_ROTATION_RAD:
        problems.append(
            f"the object is turned by up to {np.rad2deg(rotation['max']):.0f} degrees from the reference "
            f"(at {rotation['max_at_s']:.1f} s)"
        )
    for part, kind in (
        (1.0 - margin.min(axis=0), "position"),
        (speed_part.max(axis=0), "speed"),
        (torque_part.max(axis=0), "torque"),
    ):
        if part.max() > 1.0 + 1e-6:
            problems.append(f"joint {int(part.argmax()) + 1} exceeds its {kind} limit")
    problems += [
        f"the {c['first']} touches the {c['second']} around {c['video_time_s']:.1f} s of the video"
        for c in findings["collisions"]
    ]
    return problems


def _words(findings: dict[str, Any], problems: list[str]) -> list[str]:
    position, rotation = findings["position_error_m"], findings["rotation_error_rad"]
    verdict = (
        "The arm can do this motion." if not problems else f"The arm cannot do this motion well: {'; '.join(problems)}."
    )
    margins = findings["joint_limit_margin_rad"]
    tightest = min(margins, key=lambda entry: float(entry["value"]))
    fastest = max(findings["speed_part_of_limit"], key=lambda entry: float(entry["value"]))
    strongest = max(findings["torque_part_of_limit"], key=lambda entry: float(entry["value"]))
    words = [
        verdict,
        f"In the plan the object stays within {1000 * position['max']:.1f} mm and {np.rad2deg(rotation['max']):.1f} "
        f"degrees of the reference ({1000 * position['mean']:.2f} mm and {np.rad2deg(rotation['mean']):.2f} degrees on "
        "average).",
        f"Joint {tightest['joint']} comes nearest to its limit: {np.rad2deg(tightest['value']):.0f} degrees are left "
        f"at {tightest['at_s']:.1f} s.",
        f"Joint {fastest['joint']} is the fastest: {100 * fastest['value']:.0f}% of its speed limit "
        f"at {fastest['at_s']:.1f} s; joint {strongest['joint']} works hardest: "
        f"{100 * strongest['value']:.0f}% of its torque limit, with "
        f"{findings['payload_kg']:.2f} kg in the hand.",
    ]
    if tightest["value"] < _TIGHT_RAD:
        words.append("That is tight: a small change of the motion may not be possible.")
    if findings["time_stretch"] > 1.01:
        words.append(f"The robot takes {findings['time_stretch']:.2f} times as long as the human.")
    if findings["scale"] == 1.0:
        words.append("The path has the size seen in the video.")
    return words


def _summary(value: Array, time_s: Array) -> dict[str, float]:
    return {"mean": float(value.mean()), "max": float(value.max()), "max_at_s": float(time_s[int(value.argmax())])}


def _per_joint(value: Array, time_s: Array, *, smallest: bool) -> list[dict[str, Any]]:
    at = value.argmin(axis=0) if smallest else value.argmax(axis=0)
    return [
        {"joint": joint + 1, "value": float(value[k, joint]), "at_s": float(time_s[k])} for joint, k in enumerate(at)
    ]
