"""The environments as `dm_env.Environment`, for agents and tools written for dm_control."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..extract.errors import UserError

try:
    import dm_env
    from dm_env import specs
except ModuleNotFoundError as error:
    raise UserError("as_dm_env needs the package dm-env; install it with `pip install 'dm-env>=1.6'`") from error


def as_dm_env(env: gym.Env[Any, NDArray[Any]], seed: int | None = None) -> DmEnvironment:
    """Adapt an environment, wrapped or not, of which the adapter takes hold. seed: of the first episode.

    An episode that is terminated ends with discount 0, one that is truncated with discount 1, as bootstrapping wants
    it. Raises UserError for spaces that dm_env has no arrays for.
    """
    return DmEnvironment(env, seed)


class DmEnvironment(dm_env.Environment):  # type: ignore[misc]
    """A Gymnasium environment behind DeepMind's interface; `env` is the environment itself."""

    def __init__(self, env: gym.Env[Any, NDArray[Any]], seed: int | None = None) -> None:
        self.env = env
        self._seed = seed
        self._over = True
        self._observation_spec = _spec("observation", env.observation_space)
        # As dm_control has it: the entries' names, separated by tabs.
        self._action_spec = _spec("\t".join(getattr(env.unwrapped, "action_names", ("action",))), env.action_space)

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode."""
        observation, _ = self.env.reset(seed=self._seed)
        self._seed, self._over = None, False
        return dm_env.restart(observation)

    def step(self, action: NDArray[Any]) -> dm_env.TimeStep:
        """Advance one control period; after the last step of an episode, or before the first, begin one instead."""
        if self._over:
            return self.reset()
        observation, reward, terminated, truncated, _ = self.env.step(np.asarray(action, self._action_spec.dtype))
        self._over = terminated or truncated
        if terminated:
            return dm_env.termination(float(reward), observation)
        if truncated:
            return dm_env.truncation(float(reward), observation, discount=1.0)
        return dm_env.transition(float(reward), observation, discount=1.0)

    def observation_spec(self) -> Any:
        """Specs of the observation, nested as the observation is."""
        return self._observation_spec

    def action_spec(self) -> specs.BoundedArray:
        """Spec of the action, named after its entries."""
        return self._action_spec

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _spec(name: str, space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _spec(key, inner) for key, inner in space.spaces.items()}
    if isinstance(space, spaces.Box):
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name)
    raise UserError(f"the space of {name} is a {type(space).__name__}; as_dm_env knows Box and Dict")
