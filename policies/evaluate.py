"""How often a policy succeeds: seeded roll-outs, a row for each, and an interval that says what so few can tell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..demos.attempt import failure_reason
from ..demos.rollout import DEFAULT_ENV_ID, Controller, make_env, roll_out
from ..envs.diverged import PhysicsError
from ..extract.errors import UserError
from ..extract.stages import Progress, plain, versions

# Other seeds than those of `collect`, so that a policy is never measured on the episodes it was taught with.
_EVALUATION_STREAM = 0xE7A1
_Z_95 = 1.959963984540054


@dataclass(frozen=True)
class EvalReport:
    """Roll-outs of one policy on one reference.

    episodes: one row each, JSON-like: index, seed, success, reason of a failure, fractions, errors, return.
    settings: seed, environment id and arguments, versions.
    """

    policy: str
    reference: str
    episodes: tuple[Mapping[str, Any], ...]
    settings: Mapping[str, Any]

    @property
    def successes(self) -> int:
        return sum(bool(row["success"]) for row in self.episodes)

    @property
    def success_rate(self) -> float:
        return self.successes / len(self.episodes)

    @property
    def interval_95(self) -> tuple[float, float]:
        """95% Wilson interval of the success rate."""
        return wilson_interval(self.successes, len(self.episodes))

    def to_json(self) -> dict[str, Any]:
        low, high = self.interval_95
        return {
            "policy": self.policy,
            "reference": self.reference,
            "episodes": len(self.episodes),
            "successes": self.successes,
            "success_rate": self.success_rate,
            "success_rate_95_low": low,
            "success_rate_95_high": high,
            "means": {
                name: float(np.mean([row[name] for row in self.episodes if name in row] or [0.0]))
                for name in ("poured_fraction", "spilled_fraction", "position_error_mean_m", "return")
            },
            "rows": [dict(row) for row in self.episodes],
            "settings": dict(self.settings),
        }

    def as_text(self) -> str:
        """One line for a person."""
        low, high = self.interval_95
        return (
            f"{self.policy}: {self.successes} of {len(self.episodes)} episodes succeed "
            f"({100 * self.success_rate:.0f}%, 95% interval {100 * low:.0f} to {100 * high:.0f}%)"
        )


def evaluate(
    policy: Controller,
    reference: Path | str | None,
    *,
    episodes: int = 10,
    seed: int = 0,
    env_id: str = DEFAULT_ENV_ID,
    env_kwargs: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> EvalReport:
    """Roll out a policy in `episodes` seeded episodes of the environment of a reference.

    reference: a `*.reference.npz`, or None for the environment's built-in one.
    env_kwargs: arguments of the environment; low randomisation unless they say otherwise.
    An episode in which the policy refuses to act (UserError) or the simulation diverges counts as a failure, with the
    error's sentence as its reason.
    """
    if episodes < 1:
        raise UserError(f"--episodes is {episodes}, it must be at least 1")
    kwargs = {"randomization": "low", **(env_kwargs or {})}
    env = make_env(env_id, reference, **kwargs)
    rows = []
    try:
        for index in range(episodes):
            rows.append(_row(env, policy, index, evaluation_seed(seed, index)))
            if progress is not None:
                wins = sum(row["success"] for row in rows)
                progress(index + 1, episodes, f"{wins} of {index + 1} episodes succeed")
    finally:
        env.close()
    settings = {"seed": seed, "env_id": env_id, "env_kwargs": plain(kwargs), "versions": versions()}
    name = str(getattr(policy, "name", type(policy).__name__))
    return EvalReport(name, "built-in" if reference is None else str(reference), tuple(rows), settings)


def evaluation_seed(seed: int, index: int) -> int:
    """Seed of evaluation episode `index`; never one of `collect`'s for the same seed."""
    drawn = np.random.SeedSequence([seed, index, _EVALUATION_STREAM]).generate_state(1, np.uint64)[0]
    return int(drawn >> np.uint64(11))


def wilson_interval(successes: int, trials: int, z: float = _Z_95) -> tuple[float, float]:
    """Wilson score interval of a success rate (95% by default): sound for few trials and at 0 or all successes."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes in {trials} trials make no rate")
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    middle, scale = rate + z**2 / (2 * trials), 1 + z**2 / trials
    low = 0.0 if successes == 0 else (middle - spread) / scale
    high = 1.0 if successes == trials else (middle + spread) / scale
    return low, high


def _row(env: Any, policy: Controller, index: int, seed: int) -> dict[str, Any]:
    try:
        episode = roll_out(env, policy, seed=seed)
    except (UserError, PhysicsError) as error:
        return {"index": index, "seed": seed, "success": False, "reason": str(error)}
    success = episode.is_success
    reason = None if success else failure_reason(episode.summary, env.unwrapped)
    return {"index": index, "seed": seed, "success": success, "reason": reason, **episode.summary}
