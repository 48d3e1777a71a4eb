"""One attempt at a demonstration: play it without rendering, and if it succeeded replay it with, to the same end."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.diverged import PhysicsError
from ..envs.panda import ARM_JOINTS
from ..extract.errors import UserError
from ..extract.files import write_json
from .dataset import DatasetLayout
from .episode import Episode, state_difference
from .rollout import DEFAULT_ENV_ID, ActionPlayer, ReferencePlayer, control_rate, make_env, roll_out

# The motions are absolute joint targets, and every attempt is to differ from the others. What the episodes hang on is
# written out, so that a dataset does not depend on defaults that may change.
FIXED_ENV_KWARGS = {"control_mode": "joint_position"}
DEFAULT_ENV_KWARGS = {"randomization": "low", "num_particles": 100, "control_hz": 25.0}


@dataclass(frozen=True)
class AttemptSettings:
    """What decides the result of attempt i, beside i itself. JSON-like, so that it can be compared and sent.

    reference: path of the `*.reference.npz`.  image_size: (height, width) in px.
    env_kwargs: further arguments of the environment.
    """

    reference: str
    seed: int = 0
    cameras: tuple[str, ...] = ("front", "wrist")
    image_size: tuple[int, int] = (224, 224)
    env_id: str = DEFAULT_ENV_ID
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)

    def physics_kwargs(self) -> dict[str, Any]:
        """Arguments of an environment that plays without rendering; `replay` needs nothing else."""
        return {**DEFAULT_ENV_KWARGS, **self.env_kwargs, **FIXED_ENV_KWARGS, "obs_mode": "state"}

    def render_kwargs(self) -> dict[str, Any]:
        return {
            **self.physics_kwargs(),
            "obs_mode": "both",
            "cameras": self.cameras,
            "image_size": self.image_size,
        }


class AttemptRunner:
    """Makes attempts; keeps one environment for the roll-outs without rendering."""

    def __init__(self, settings: AttemptSettings, folder: Path) -> None:
        self.settings = settings
        self.folder = folder
        self._env = make_env(settings.env_id, settings.reference, **settings.physics_kwargs())

    def layout(self, task: str) -> DatasetLayout:
        """What the dataset of these attempts looks like. Raises UserError when LeRobot cannot hold it."""
        env = self._env
        names = env.unwrapped.observation_names
        try:
            fps = control_rate(env)
        except ValueError as error:
            raise UserError(f"{self.settings.reference}: {error}; retarget it at 25 Hz") from error
        return DatasetLayout(
            fps=fps,
            task=task,
            action_names=tuple(f"{name}_rad" for name in ARM_JOINTS),
            state_names=tuple(names["agent_pos"]),
            environment_names=tuple(names["environment_state"]),
            cameras=self.settings.cameras,
            image_size=self.settings.image_size,
        )

    def run(self, index: int) -> dict[str, Any]:
        """Make attempt `index` and write its result; returns what `finished_attempt` will return for it."""
        seed = attempt_seed(self.settings.seed, index)
        result: dict[str, Any] = {"index": index, "seed": seed, "ok": False}
        try:
            tried = roll_out(self._env, ReferencePlayer(), seed=seed)
        except UserError as error:
            result |= {"reason": "the arm cannot follow the motion", "detail": str(error)}
        except PhysicsError as error:
            result |= {"reason": "the simulation diverged", "detail": str(error)}
        else:
            result["summary"] = dict(tried.summary)
            if tried.is_success:
                result |= self._verify(tried, index)
            else:
                result["reason"] = failure_reason(tried.summary, self._env.unwrapped)
        write_json(_result_file(self.folder, index), result)
        return result

    def close(self) -> None:
        self._env.close()

    def _verify(self, tried: Episode, index: int) -> dict[str, Any]:
        # A fresh environment, so that nothing an earlier episode left behind can help the replay.
        env = make_env(self.settings.env_id, self.settings.reference, **self.settings.render_kwargs())
        try:
            replayed = roll_out(env, ActionPlayer(tried.action), seed=tried.seed, options=tried.options)
        finally:
            env.close()
        if replayed.end_digest != tried.end_digest or not _same_rows(tried, replayed):
            words = state_difference(tried.end_state, replayed.end_state) or ["observations or rewards differ"]
            return {"ok": False, "reason": "its replay ended differently", "detail": "; ".join(words[:4])}
        replayed.save(episode_file(self.folder, index))
        return {"ok": True}


def _same_rows(a: Episode, b: Episode) -> bool:
    names = ("action", "agent_pos", "environment_state", "reward", "success")
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)


def attempt_seed(seed: int, index: int) -> int:
    """Seed of attempt `index`: independent of its neighbours, and below 2^53 so that every JSON reader keeps it."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0] >> np.uint64(11))


def failure_reason(summary: Mapping[str, Any], env: Any) -> str:
    """Why a roll-out that ended did not succeed, as one of a few phrases that can be counted."""
    if summary["terminated"]:
        return "stopped early"
    if summary["spilled_fraction"] > getattr(env, "success_spilled_fraction", 0.1):
        return "spilled too much"
    if summary["poured_fraction"] < getattr(env, "success_poured_fraction", 0.7):
        return "poured too little"
    return "no success at the end"


def episode_file(folder: Path, index: int) -> Path:
    """Where attempt `index` keeps its episode, if it succeeded."""
    return folder / f"attempt_{index:06d}.npz"


def finished_attempt(folder: Path, index: int) -> dict[str, Any] | None:
    """The result of an attempt that is on the disk in whole, else None."""
    try:
        result = json.loads(_result_file(folder, index).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if result["ok"] and not episode_file(folder, index).is_file():
        return None
    return dict(result)


def _result_file(folder: Path, index: int) -> Path:
    return folder / f"attempt_{index:06d}.json"
