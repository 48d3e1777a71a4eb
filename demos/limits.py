"""The Panda's limits, and what part of each a motion takes, at the rate at which the real arm looks.

The numbers and their source stand in `envs/panda.py`. Rates of change are looked at where the arm controller does: from
one command to the next, at 1 kHz, before and after which the arm stands still.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..envs.panda import (
    DDDQ_MAX_RAD_S3,
    DDQ_MAX_RAD_S2,
    DQ_MAX_RAD_S,
    DTAU_MAX_NM_S,
    Q_MAX_RAD,
    Q_MIN_RAD,
    TAU_MAX_NM,
)
from ..extract.geometry import Array

COMMAND_HZ = 1000.0


@dataclass(frozen=True)
class Limit:
    """What one quantity may be: unit, low (7,) and high (7,)."""

    unit: str
    low: Array
    high: Array

    def part(self, value: Array) -> Array:
        """(..., 7) distance from the middle of the range over half of it: above 1 is beyond the limit."""
        return np.abs(value - 0.5 * (self.low + self.high)) / (0.5 * (self.high - self.low))


def _within(unit: str, most: Array) -> Limit:
    return Limit(unit, -most, most)


LIMITS: Mapping[str, Limit] = {
    "position": Limit("rad", Q_MIN_RAD, Q_MAX_RAD),
    "speed": _within("rad/s", DQ_MAX_RAD_S),
    "acceleration": _within("rad/s^2", DDQ_MAX_RAD_S2),
    "jerk": _within("rad/s^3", DDDQ_MAX_RAD_S3),
    "torque": _within("N m", TAU_MAX_NM),
    "torque rate": _within("N m/s", np.full(7, DTAU_MAX_NM_S)),
}


@dataclass(frozen=True)
class Extreme:
    """Where one joint comes nearest to a limit, or goes furthest beyond: `part` of it, above 1 is beyond."""

    quantity: str
    joint: int
    time_s: float
    value: float
    limit: float
    part: float

    @property
    def broken(self) -> bool:
        return self.part > 1.0 + 1e-6

    def sentence(self) -> str:
        """What is broken, for a person."""
        unit = LIMITS[self.quantity].unit
        return (
            f"joint {self.joint} exceeds its {self.quantity} limit at {self.time_s:.3f} s: {self.value:.4g} {unit}, "
            f"limit {self.limit:.4g} {unit}"
        )


def commanded(q_rad: Array, tau_nm: Array, rate_hz: float = COMMAND_HZ) -> dict[str, Array]:
    """All that `LIMITS` knows of commands (N, 7) in equal steps, by their differences, as the controller sees them.

    Rows of a quantity belong to the command that made the difference; the arm stands before the first and after the
    last, so a motion that begins at speed shows as acceleration and jerk.
    """
    still = np.concatenate([q_rad[:1].repeat(3, axis=0), q_rad, q_rad[-1:].repeat(3, axis=0)])
    speed, acceleration, jerk = (np.diff(still, n, axis=0) * rate_hz**n for n in (1, 2, 3))
    return {
        "position": q_rad,
        "speed": speed[2 : 2 + len(q_rad)],
        "acceleration": acceleration[1 : 3 + len(q_rad)],
        "jerk": jerk,
        "torque": tau_nm,
        "torque rate": np.diff(tau_nm, axis=0) * rate_hz,
    }


def extremes(motion: Mapping[str, Array], rate_hz: float = COMMAND_HZ) -> list[Extreme]:
    """Where every joint comes nearest to each limit, for a motion in equal steps (see `commanded`)."""
    found = []
    for quantity, value in motion.items():
        limit = LIMITS[quantity]
        part = limit.part(value)
        for joint, at in enumerate(part.argmax(axis=0) if len(part) else []):
            low, high = float(limit.low[joint]), float(limit.high[joint])
            reached = float(value[at, joint])
            beyond = high if reached > 0.5 * (low + high) else low
            time_s = min(int(at), len(motion["position"]) - 1) / rate_hz
            found.append(Extreme(quantity, joint + 1, time_s, reached, beyond, float(part[at, joint])))
    return found
