"""References without a video, shared because building an environment takes a moment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from vid2demo.envs.builtin import arm_trajectory, builtin_reference, pour_reference
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.extract.vessels import make_vessel

Play = Callable[..., dict[str, Any]]
ActionsOf = Callable[[Reference, int], NDArray[np.float32]]


@pytest.fixture(scope="session")
def mug_pour() -> Reference:
    """A mug emptied into a bowl."""
    return builtin_reference()


@pytest.fixture(scope="session")
def kettle_pour() -> Reference:
    """A gooseneck kettle poured into a mug, through its spout."""
    return pour_reference(make_vessel("gooseneck_kettle"), make_vessel("mug"), tilt_deg=75.0)


@pytest.fixture(scope="session")
def actions_of() -> ActionsOf:
    """Gives (steps, 7) joint targets that follow a reference and then hold its end."""

    def follow(reference: Reference, steps: int) -> NDArray[np.float32]:
        q_rad = arm_trajectory(reference).astype(np.float32)
        return q_rad[np.minimum(np.arange(1, steps + 1), len(q_rad) - 1)]

    return follow


@pytest.fixture(scope="session")
def play(actions_of: ActionsOf) -> Play:
    """Plays an environment's reference to the end; the last info, with worst errors, return and final state added."""

    def run(env: PandaPourEnv, **reset: Any) -> dict[str, Any]:
        _, info = env.reset(**reset)
        total, worst_m, worst_rad = 0.0, 0.0, 0.0
        for action in actions_of(env.reference, env._max_episode_steps):
            _, reward, terminated, truncated, info = env.step(action)
            total += reward
            worst_m = max(worst_m, info["position_error_m"])
            worst_rad = max(worst_rad, info["rotation_error_rad"])
            if terminated or truncated:
                break
        found = {"return": total, "worst_m": worst_m, "worst_rad": worst_rad, "truncated": truncated}
        return {**info, **found, "state": env.get_state()}

    return run
