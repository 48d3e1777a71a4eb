"""Reward: small pure terms, their weights and scales in one frozen dataclass, and a table a person can print.

The reward of a step is the sum of weight x term. Tracking terms lie in [0, 1], so that their weights are their share;
pouring terms pay for particles as they arrive, so that over an episode they add up to weight x final fraction. One
number, the tolerance, widens or narrows all tracking kernels at once: a curriculum begins wide and ends at 1 or below.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from ..extract.errors import UserError

JOINT_MARGIN_RAD = 0.1


class StepErrors(NamedTuple):
    """What one control step gave; all terms are functions of this.

    position_error_m, linear_velocity_error_m_s: Euclidean; rotation_error_rad: smallest over the object's symmetry;
    angular_velocity_error_rad_s: without the turn about a continuous symmetry axis, which nobody can see.
    poured_gain, spilled_gain: change of the fractions in this step. action_rate: mean square change of the joint
    targets' speed since the last step, over twice the joints' speed limits. limit_share: 0 while every joint keeps
    `JOINT_MARGIN_RAD` from its limits, 1 when one is there. self_contact, table_contact: 1 while the arm touches
    itself, and while arm or held vessel touch the table. success: 1 when the episode counts as one.
    """

    position_error_m: float
    rotation_error_rad: float
    linear_velocity_error_m_s: float
    angular_velocity_error_rad_s: float
    poured_gain: float
    spilled_gain: float
    action_rate: float
    limit_share: float
    self_contact: float
    table_contact: float
    success: float


@dataclass(frozen=True)
class RewardConfig:
    """Weights (1) of the terms and scales of the tracking kernels, at which a term has fallen to 1/e."""

    position: float = 0.4
    rotation: float = 0.3
    linear_velocity: float = 0.15
    angular_velocity: float = 0.15
    poured: float = 20.0
    spilled: float = -10.0
    action_rate: float = -0.1
    joint_limits: float = -0.1
    self_contact: float = -0.5
    table_contact: float = -0.5
    success: float = 0.0
    position_scale_m: float = 0.1
    rotation_scale_rad: float = 0.4
    linear_velocity_scale_m_s: float = 0.3
    angular_velocity_scale_rad_s: float = 1.5

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not math.isfinite(value):
                raise UserError(f"reward {entry.name} is {value}; give a finite number")
            if "_scale_" in entry.name and value <= 0:
                raise UserError(f"reward {entry.name} is {value}; a kernel's scale must be positive")


_NO_TRACKING = {"position": 0.0, "rotation": 0.0, "linear_velocity": 0.0, "angular_velocity": 0.0}
_NO_POUR = {"poured": 0.0, "spilled": 0.0}
_NO_CARE = {"action_rate": 0.0, "joint_limits": 0.0, "self_contact": 0.0, "table_contact": 0.0}
REWARD_MODES = {
    "dense": RewardConfig(),
    "tracking": RewardConfig(**_NO_POUR),
    "pour": RewardConfig(**_NO_TRACKING),
    "sparse": RewardConfig(**_NO_TRACKING, **_NO_POUR, **_NO_CARE, success=1.0),
}


def kernel(error: float, scale: float) -> float:
    """exp(-(error / scale)^2): 1 without error, 1/e at `scale`, always in (0, 1]."""
    return math.exp(-min((error / scale) ** 2, 700.0))


def position(errors: StepErrors, config: RewardConfig) -> float:
    """Nearness of the object's origin to the reference's."""
    return kernel(errors.position_error_m, config.position_scale_m)


def rotation(errors: StepErrors, config: RewardConfig) -> float:
    """Nearness of the object's attitude to the reference's, up to symmetry."""
    return kernel(errors.rotation_error_rad, config.rotation_scale_rad)


def linear_velocity(errors: StepErrors, config: RewardConfig) -> float:
    """Nearness of the velocity of the object's origin."""
    return kernel(errors.linear_velocity_error_m_s, config.linear_velocity_scale_m_s)


def angular_velocity(errors: StepErrors, config: RewardConfig) -> float:
    """Nearness of the object's angular velocity."""
    return kernel(errors.angular_velocity_error_rad_s, config.angular_velocity_scale_rad_s)


def poured(errors: StepErrors, config: RewardConfig) -> float:
    """Share of the particles that arrived in the receptacle in this step."""
    return errors.poured_gain


def spilled(errors: StepErrors, config: RewardConfig) -> float:
    """Share of the particles that were lost in this step."""
    return errors.spilled_gain


def action_rate(errors: StepErrors, config: RewardConfig) -> float:
    """Jerkiness of the commands."""
    return errors.action_rate


def joint_limits(errors: StepErrors, config: RewardConfig) -> float:
    """Nearness of the worst joint to its limit."""
    return errors.limit_share


def self_contact(errors: StepErrors, config: RewardConfig) -> float:
    """1 while the arm touches itself."""
    return errors.self_contact


def table_contact(errors: StepErrors, config: RewardConfig) -> float:
    """1 while the arm or the held vessel touches the table."""
    return errors.table_contact


def success(errors: StepErrors, config: RewardConfig) -> float:
    """1 while the episode counts as a success."""
    return errors.success


Term = Callable[[StepErrors, RewardConfig], float]
TERMS: dict[str, Term] = {
    function.__name__: function
    for function in (
        position,
        rotation,
        linear_velocity,
        angular_velocity,
        poured,
        spilled,
        action_rate,
        joint_limits,
        self_contact,
        table_contact,
        success,
    )
}


def weighted_terms(errors: StepErrors, config: RewardConfig) -> dict[str, float]:
    """weight x term for every term; their sum is the reward."""
    return {name: getattr(config, name) * term(errors, config) for name, term in TERMS.items()}


def with_tolerance(config: RewardConfig, tolerance: float) -> RewardConfig:
    """The same reward with all tracking kernels `tolerance` times as wide."""
    scales = {
        entry.name: getattr(config, entry.name) * tolerance for entry in fields(config) if "_scale_" in entry.name
    }
    return replace(config, **scales)


def limit_share(q_rad: Sequence[float], low_rad: Sequence[float], high_rad: Sequence[float]) -> float:
    """0 while every joint of q (7,) keeps `JOINT_MARGIN_RAD` from its limits, rising linearly to 1 at a limit."""
    margin_rad = min(min(q - low, high - q) for q, low, high in zip(q_rad, low_rad, high_rad, strict=True))
    return min(max(1.0 - margin_rad / JOINT_MARGIN_RAD, 0.0), 1.0)


def term_table(config: RewardConfig) -> str:
    """The terms, their weights and scales as a table in plain text."""
    rows = [("term", "weight", "scale", "what it measures")]
    scales = {entry.name.split("_scale_")[0]: entry.name for entry in fields(config) if "_scale_" in entry.name}
    for name, term in TERMS.items():
        scale = ""
        if name in scales:
            unit = scales[name].split("_scale_")[1].replace("_s", "/s")
            scale = f"{getattr(config, scales[name]):g} {unit}"
        rows.append((name, f"{getattr(config, name):g}", scale, (term.__doc__ or "").strip()))
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])
