"""Can the arm do it, how well, and what was changed from the video: figures for programs, sentences for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.grasps import MAX_WIDTH_M
from ..envs.kinematics import limit_margin_rad, manipulability, panda_chain
from ..envs.panda import DQ_MAX_RAD_S, FLANGE_TO_TCP_M, PAYLOAD_MAX_KG, REACH_MAX_M, TAU_MAX_NM
from ..extract.geometry import Array
from .collisions import collisions_of, told
from .dynamics import payload_of
from .export import commands_of
from .grip import grip_of, slip_of
from .limits import LIMITS, Extreme, commanded, extremes
from .retarget import Solver, retarget, tracking_errors
from .variants import Variant, freed_of, nearest_variant

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from .joints import JointTrajectory

GOOD_POSITION_M, GOOD_ROTATION_RAD = 0.01, np.deg2rad(5.0)
_TIGHT_RAD = 0.05
_SHOULDER = np.array([0.0, 0.0, 0.333])
# While the tilt is above this part of its greatest value it is the pour.
_POURING_PART = 0.5


def feasibility(reference: Reference, joints: JointTrajectory) -> dict[str, Any]:
    """Findings (JSON-like) about a joint trajectory made for a reference on the same clock.

    `feasible`: tracking within 1 cm and 5 degrees, all limits of joints, gripper and payload kept, no collision.
    `limits`: where the motion comes nearest to each limit at 1 kHz, and the margin that is left of it. `reach`: of the
    flange from the shoulder. `phases`: errors before, in and after the pour. `collisions`: of arm, vessel, table and
    receptacle, looked for at every knot. `grip`: what the fingers would have to bear by friction alone, and by how much
    the vessel slips where that is too much. `changed`: from the video, in numbers. `variant`: for what is not feasible,
    the nearest motion found that is, and how far that is away; None if there is none. `scale_search`: what
    `--scale auto` tried and what came of it. `words`: all of it in plain sentences. Raises ValueError when the two
    differ in length.
    """
    findings, problems = _findings(reference, joints)
    findings["feasible"] = not problems
    variant = _variant(reference, joints, findings, problems) if problems else None
    findings["variant"] = variant and variant.told(reference)
    if findings["grip"]["part"] > 1.0 and reference.has_receptacle and (slip := slip_of(reference, joints)):
        findings["grip"] |= slip.told()
        findings["grip"]["words"] += f" {slip.sentence()}"
    note = joints.header.get("solver", {}).get("note")
    said = [variant.words] if variant else []
    findings["words"] = [*_words(findings, problems, said), *([note] if note else []), *reference.notes]
    return findings


def without_contact(reference: Reference) -> Reference:
    """The reference free of touching table and receptacle, where that is all that is wrong and a little mends it.

    The whole path is raised, or the receptacle moved, by at most 5 cm, whichever is less; a note and `changed` in the
    header say so. Everything else, what needs more included, comes back as it is, for the report to tell.
    """
    joints = retarget(reference, strict=False)
    findings, problems = _findings(reference, joints)
    if not _only_touches(findings, problems):
        return reference
    variant = _variant(reference, joints, findings, problems)
    return variant.taken(findings["collisions"]) if variant and variant.is_small else reference


def _only_touches(findings: dict[str, Any], problems: list[str]) -> bool:
    collisions = findings["collisions"]
    return 0 < len(problems) == len(collisions) and bool(freed_of(collisions))


def _findings(reference: Reference, joints: JointTrajectory) -> tuple[dict[str, Any], list[str]]:
    """All but the verdict, and what is wrong."""
    if len(joints) != len(reference):
        raise ValueError(f"the reference has {len(reference)} knots, the joint trajectory {len(joints)}")
    position_m, rotation_rad = tracking_errors(reference, joints.q_rad)
    margin = limit_margin_rad(joints.q_rad)
    speed_part = np.abs(joints.dq_rad_s) / DQ_MAX_RAD_S
    torque_part = np.abs(joints.tau_nm) / TAU_MAX_NM
    T_hand = panda_chain().hand(joints.q_rad)
    hand = T_hand[:, :3, 3]
    flange_m = np.linalg.norm(hand - FLANGE_TO_TCP_M * T_hand[:, :3, 2] - _SHOULDER, axis=1)
    commands = commands_of(joints)
    found = extremes(commanded(commands.q_rad, commands.tau_nm))
    nearest = {name: max((e for e in found if e.quantity == name), key=lambda e: e.part) for name in LIMITS}
    grasp = reference.header.get("grasp", {})
    payload = payload_of(reference, float(joints.header.get("contents_kg", 0.0)))
    width_m = float(grasp.get("width_m", 0.0))
    grip = grip_of(joints, reference.T_hand_object, payload, width_m, grasp.get("kind") == "body")
    findings: dict[str, Any] = {
        "position_error_m": _summary(position_m, joints.time_s),
        "rotation_error_rad": _summary(rotation_rad, joints.time_s),
        "phases": _phases(reference, position_m, rotation_rad),
        "joint_limit_margin_rad": _per_joint(margin, joints.time_s, smallest=True),
        "speed_part_of_limit": _per_joint(speed_part, joints.time_s, smallest=False),
        "torque_part_of_limit": _per_joint(torque_part, joints.time_s, smallest=False),
        "limits": {name: _limit(extreme) for name, extreme in nearest.items()},
        "reach": {
            "value_m": float(flange_m.max()),
            "limit_m": REACH_MAX_M,
            "margin_m": float(REACH_MAX_M - flange_m.max()),
            "at_s": float(joints.time_s[int(flange_m.argmax())]),
        },
        "manipulability": float(manipulability(joints.q_rad).min()),
        "lowest_hand_m": float(hand[:, 2].min()),
        "collisions": [told(reference, collision) for collision in collisions_of(reference, joints.q_rad)],
        "scale": reference.scale,
        "time_stretch": float(reference.header.get("time_stretch", 1.0)),
        "solver": joints.header.get("solver", {}).get("name", "mink"),
        "payload_kg": float(joints.header.get("payload_kg", 0.0)),
        "gripper_width_m": width_m,
        "grip": {**grip.told(), "words": grip.sentence()},
        "caught_part_of_jet": reference.header.get("feasibility", {}).get("caught_part_of_jet"),
        "changed": _changed(reference),
        "scale_search": list(reference.header.get("scale_search", [])),
        "changes": reference.notes,
    }
    problems = _problems(findings, margin, speed_part, torque_part)
    problems += [
        f"joint {e.joint} exceeds its {name} limit ({e.value:.3g} {LIMITS[name].unit} at {e.time_s:.2f} s, "
        f"limit {e.limit:.3g})"
        for name, e in nearest.items()
        if name in ("acceleration", "jerk", "torque rate") and e.broken
    ]
    return findings, problems


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
    if findings["payload_kg"] > PAYLOAD_MAX_KG:
        problems.append(
            f"vessel and contents weigh {findings['payload_kg']:.1f} kg, "
            f"the arm carries {PAYLOAD_MAX_KG:.0f} kg at most"
        )
    if findings["gripper_width_m"] > MAX_WIDTH_M:
        problems.append(
            f"the vessel is {100 * findings['gripper_width_m']:.1f} cm wide where it is held, the fingers open to "
            f"{100 * MAX_WIDTH_M:.1f} cm"
        )
    problems += [
        f"the {c['first']} touches the {c['second']} at {c['time_s']:.1f} s, around {c['video_time_s']:.1f} s of the "
        f"video, {1000 * c['depth_m']:.0f} mm deep"
        for c in findings["collisions"]
    ]
    return problems


def _phases(reference: Reference, position_m: Array, rotation_rad: Array) -> list[dict[str, Any]]:
    """Errors before, in and after the pour; a motion that never tilts is one phase."""
    tilt_rad = reference.tilt_rad
    pouring = np.flatnonzero(tilt_rad >= _POURING_PART * tilt_rad.max())
    first, last = (
        (int(pouring[0]), int(pouring[-1]) + 1) if tilt_rad.max() > np.deg2rad(10.0) else (len(reference),) * 2
    )
    spans = {"carry": slice(0, first), "pour": slice(first, last), "return": slice(last, len(reference))}
    return [
        {
            "name": name,
            "from_s": float(reference.time_s[span][0]),
            "to_s": float(reference.time_s[span][-1]),
            "position_error_m": {"mean": float(position_m[span].mean()), "max": float(position_m[span].max())},
            "rotation_error_rad": {"mean": float(rotation_rad[span].mean()), "max": float(rotation_rad[span].max())},
        }
        for name, span in spans.items()
        if span.stop > span.start
    ]


def _changed(reference: Reference) -> dict[str, Any]:
    """What the robot does otherwise than the video shows, in numbers; `changes` tells the same in words."""
    video_s = float(reference.video_time_s[-1] - reference.video_time_s[0])
    # Of the pour that `--scale auto` chose; another scale stands in the reference already.
    chosen: dict[str, float] = next((t for t in reference.header.get("scale_search", []) if t["chosen"]), {})
    return {
        "scale": reference.scale,
        "receptacle_moved_m": float(np.hypot(chosen.get("along_m", 0.0), chosen.get("across_m", 0.0))),
        "tipped_further_rad": float(np.deg2rad(chosen.get("tip_deg", 0.0))),
        "time_stretch": float(reference.header.get("time_stretch", 1.0)),
        "video_s": video_s,
        "robot_s": reference.duration_s,
        "unsure_part": float(np.mean(reference.confidence < 0.2)),
        **reference.header.get("changed", {}),
    }


def _limit(extreme: Extreme) -> dict[str, Any]:
    return {
        "joint": extreme.joint,
        "at_s": extreme.time_s,
        "value": extreme.value,
        "limit": extreme.limit,
        "unit": LIMITS[extreme.quantity].unit,
        "part": extreme.part,
        "margin": 1.0 - extreme.part,
    }


def _variant(
    reference: Reference, joints: JointTrajectory, findings: dict[str, Any], problems: list[str]
) -> Variant | None:
    """The nearest motion found that is feasible; see `nearest_variant`."""
    parts = {name: entry["part"] for name, entry in findings["limits"].items()}
    speed = max(max(entry["value"] for entry in findings["speed_part_of_limit"]), parts["speed"])
    slower = max(speed, parts["acceleration"] ** 0.5, parts["jerk"] ** (1 / 3), 1.05)
    solver: Solver = "torque" if findings["solver"] == "crocoddyl" else "mink"
    usual_kg = joints.header.get("contents_kg")
    touched = freed_of(findings["collisions"]) if _only_touches(findings, problems) else set()

    def works(changed: Reference, contents_kg: float | None) -> bool:
        made = joints
        if contents_kg != usual_kg or not np.array_equal(changed.T_world_object, reference.T_world_object):
            made = retarget(changed, contents_kg=contents_kg, strict=False, solver=solver)
        return not _findings(changed, made)[1]

    return nearest_variant(reference, usual_kg, findings["payload_kg"], slower, touched, works)


def _words(findings: dict[str, Any], problems: list[str], variant: list[str]) -> list[str]:
    position, rotation = findings["position_error_m"], findings["rotation_error_rad"]
    verdict = (
        "The arm can do this motion." if not problems else f"The arm cannot do this motion well: {'; '.join(problems)}."
    )
    margins = findings["joint_limit_margin_rad"]
    tightest = min(margins, key=lambda entry: float(entry["value"]))
    fastest = max(findings["speed_part_of_limit"], key=lambda entry: float(entry["value"]))
    strongest = max(findings["torque_part_of_limit"], key=lambda entry: float(entry["value"]))
    bend, jerk = (findings["limits"][name] for name in ("acceleration", "jerk"))
    reach = findings["reach"]
    words = [
        verdict,
        *variant,
        f"In the plan the object stays within {1000 * position['max']:.1f} mm and {np.rad2deg(rotation['max']):.1f} "
        f"degrees of the reference ({1000 * position['mean']:.2f} mm and {np.rad2deg(rotation['mean']):.2f} degrees on "
        "average).",
        f"Joint {tightest['joint']} comes nearest to its limit: {np.rad2deg(tightest['value']):.0f} degrees are left "
        f"at {tightest['at_s']:.1f} s.",
        f"Joint {fastest['joint']} is the fastest: {100 * fastest['value']:.0f}% of its speed limit "
        f"at {fastest['at_s']:.1f} s; joint {strongest['joint']} works hardest: "
        f"{100 * strongest['value']:.0f}% of its torque limit, with "
        f"{findings['payload_kg']:.2f} kg in the hand.",
        f"The flange comes up to {100 * reach['value_m']:.0f} cm from the shoulder (at {reach['at_s']:.1f} s), of the "
        f"{100 * reach['limit_m']:.1f} cm that the arm reaches.",
        f"At 1 kHz the largest acceleration is {100 * bend['part']:.0f}% of its limit (joint {bend['joint']}), the "
        f"largest jerk {100 * jerk['part']:.0f}% (joint {jerk['joint']}).",
    ]
    words.append(findings["grip"]["words"])
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
