"""Many environments at once on several threads: `gym.make_vec("vid2demo:PandaPour-v0", num_envs=8)`.

Every environment of them steps exactly as it would alone, so equal seeds and actions give the same bits. The engine
and the compiled kernels let go of the interpreter while they work, so that one environment's physics runs beside
another's, and beside another's Python.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ..extract.crew import Crew, usable_cpus
from ..extract.errors import UserError
from .pouring import Info, Observation, PandaPourEnv
from .tracking import PandaTrackEnv

Bools = NDArray[np.bool_]


class _Turn(NamedTuple):
    """What one environment gave in one step; final: the last observation and info of an episode that ended in it."""

    observation: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: Info
    final: tuple[Observation, Info] | None = None


class PandaVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """`num_envs` `PandaPourEnv`s, made from the same arguments, in Gymnasium's vector interface.

    reference: as `PandaPourEnv`'s, or a list with one for each environment.
    num_threads: how many of them are simulated at a time; None takes one per processor. Results do not depend on it.
    autoreset_mode: `AutoresetMode` or its value. NextStep: the step after an episode's last begins the next one, its
        action is ignored. SameStep: an episode's last step begins the next one; `infos` holds `final_obs` and
        `final_info`. Disabled: the caller resets what has ended, with `options={"reset_mask": ...}`.
    max_episode_steps: truncate episodes after so many steps, as `gym.make` would.
    The other arguments are `PandaPourEnv`'s. What the environments have in common is built once.

    Seeds, infos, `call`, `get_attr`, `set_attr` and `render` are as in `gymnasium.vector.SyncVectorEnv`. Observations
    are new arrays at every step. Pictures are drawn in the caller's thread. Raises UserError for every argument that
    makes no sense; after any other error in a step all environments must be reset.
    """

    env_class: ClassVar[type[PandaPourEnv]] = PandaPourEnv

    def __init__(
        self,
        num_envs: int = 1,
        *,
        num_threads: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:
        self.num_envs = _count("num_envs", num_envs)
        threads = min(usable_cpus() if num_threads is None else _count("num_threads", num_threads), self.num_envs)
        self._limit = None if max_episode_steps is None else _count("max_episode_steps", max_episode_steps)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            valid = ", ".join(mode.value for mode in AutoresetMode)
            raise UserError(f"autoreset_mode is {autoreset_mode!r}; choose {valid}") from None
        self.envs = self._made(arguments)
        first = self.envs[0]
        self._crew = Crew(threads)
        # Graphics contexts and windows belong to one thread.
        self._is_seen = first.obs_mode != "state" or first.render_mode == "human"
        self.metadata = {**first.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = first.render_mode
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._observations: list[Observation] = [{} for _ in self.envs]
        self._steps = [0] * self.num_envs
        self._ended: Bools = np.zeros(self.num_envs, np.bool_)
        self._is_ready = False

    @property
    def num_threads(self) -> int:
        """How many environments are simulated at a time."""
        return self._crew.threads

    # ------------------------------------------------------------------ Gymnasium

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those of `options["reset_mask"]`, (num_envs,) of bool.

        seed: for each environment, or one that goes up by one from environment to environment. The other options are
        those of a single environment's reset.
        """
        seeds = self._seeds(seed)
        options = dict(options or {})
        mask = self._mask(options.pop("reset_mask", None))

        def renew(i: int) -> Info:
            self._observations[i], info = self.envs[i].reset(seed=seeds[i], options=options)
            self._steps[i] = 0
            return info

        chosen = np.flatnonzero(mask).tolist()
        infos = self._each(renew, chosen)
        self._ended[mask] = False
        self._is_ready = True
        return _stacked(self._observations), gathered(chosen, infos, self.num_envs)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], Bools, Bools, dict[str, Any]]:
        """Advance every environment by one control period; actions (num_envs, entries)."""
        actions = self._checked(actions)
        everyone = range(self.num_envs)
        # Until all have arrived at the end of the step, they are not in step.
        self._is_ready = False
        if self._is_seen:
            turns = self._crew.stream(lambda i: self._move(i, actions[i]), self._turn, everyone)
        else:
            turns = self._crew.run(lambda i: self._turn(i, self._move(i, actions[i])), everyone)
        self._is_ready = True
        self._observations = [turn.observation for turn in turns]
        terminated = np.array([turn.terminated for turn in turns], np.bool_)
        truncated = np.array([turn.truncated for turn in turns], np.bool_)
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._ended = terminated | truncated
        infos = gathered(everyone, [turn.info for turn in turns], self.num_envs)
        if last := [(i, turn.final) for i, turn in enumerate(turns) if turn.final is not None]:
            finals = [{"final_obs": observation, "final_info": info} for _, (observation, info) in last]
            infos |= gathered([i for i, _ in last], finals, self.num_envs)
        rewards = np.array([turn.reward for turn in turns], np.float64)
        return _stacked(self._observations), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8] | None, ...]:  # type: ignore[override]
        """One picture (H, W, 3) of every environment."""
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        """Close every environment and end the threads."""
        for env in getattr(self, "envs", ()):
            env.close()
        if hasattr(self, "_crew"):
            self._crew.close()

    # ------------------------------------------------------------------ each environment

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What every environment's method gives, or its attribute of that name."""
        found = [env.get_wrapper_attr(name) for env in self.envs]
        return tuple(entry(*args, **kwargs) if callable(entry) else entry for entry in found)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Every environment's attribute of that name."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute: a list or tuple has a value for every environment, anything else is for all of them."""
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise UserError(f"{len(values)} values of {name} were given to {self.num_envs} environments; give one each")
        for env, value in zip(self.envs, values, strict=True):
            env.set_wrapper_attr(name, value)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Every environment's generator."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed that every environment's generator began with."""
        return self.get_attr("np_random_seed")

    # ------------------------------------------------------------------ inside

    def _made(self, arguments: Mapping[str, Any]) -> list[PandaPourEnv]:
        given = arguments.get("reference")
        if not isinstance(given, list | tuple):
            first = self.env_class(**arguments)
            return [first, *(first.twin() for _ in range(self.num_envs - 1))]
        if len(given) != self.num_envs:
            raise UserError(f"{len(given)} references were given to {self.num_envs} environments; give one each")
        return [self.env_class(**{**arguments, "reference": reference}) for reference in given]

    def _each(self, job: Any, numbers: Sequence[int]) -> list[Any]:
        return [job(i) for i in numbers] if self._is_seen else self._crew.run(job, numbers)

    def _move(self, i: int, action: NDArray[np.float32]) -> float | None:
        """The physics of a step, and its action's jerkiness; None when the step is to begin an episode instead."""
        if self._ended[i]:
            return None
        env = self.envs[i]
        commands, jerk = env.before_step(action)
        env.simulation.advance(commands)
        return jerk

    def _turn(self, i: int, jerk: float | None) -> _Turn:
        env = self.envs[i]
        if jerk is None:
            observation, info = env.reset()
            self._steps[i] = 0
            return _Turn(observation, 0.0, False, False, info)
        observation, reward, terminated, truncated, info = env.after_step(jerk)
        self._steps[i] += 1
        truncated = truncated or (self._limit is not None and self._steps[i] >= self._limit)
        if not (terminated or truncated) or self.autoreset_mode != AutoresetMode.SAME_STEP:
            return _Turn(observation, reward, terminated, truncated, info)
        final = (observation, info)
        observation, info = env.reset()
        self._steps[i] = 0
        return _Turn(observation, reward, terminated, truncated, info, final)

    def _checked(self, given: Any) -> NDArray[np.float32]:
        if not self._is_ready:
            raise ResetNeeded("call reset() before step(): no episode has begun, or an error has left them out of step")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            raise UserError(
                f"the episodes of environments {np.flatnonzero(self._ended).tolist()} have ended; with autoreset "
                "disabled, call reset(options={'reset_mask': ended}) before the next step"
            )
        actions: NDArray[np.float32] = np.asarray(given)
        if actions.shape != self.action_space.shape:
            raise UserError(f"actions have the shape {actions.shape}; give {self.action_space.shape}")
        wrong = ~np.isfinite(actions).all(axis=1) & ~self._ended
        if wrong.any():
            raise UserError(f"the actions of environments {np.flatnonzero(wrong).tolist()} are not finite; mend them")
        return actions

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(f"{len(seed)} seeds were given for {self.num_envs} environments; give one each, or one int")
        return [None if one is None else int(one) for one in seed]

    def _mask(self, mask: Any) -> Bools:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        given = np.asarray(mask)
        if given.shape != (self.num_envs,) or given.dtype != np.bool_ or not given.any():
            raise UserError(f"reset_mask is {mask!r}; give {self.num_envs} of bool, at least one of them True")
        if not self._is_ready and not given.all():
            raise ResetNeeded("reset all environments before some of them")
        return given


class PandaPourVectorEnv(PandaVectorEnv):
    """`PandaPourEnv`s."""


class PandaTrackVectorEnv(PandaVectorEnv):
    """`PandaTrackEnv`s."""

    env_class = PandaTrackEnv


def gathered(numbers: Iterable[int], infos: Sequence[Mapping[str, Any]], count: int) -> dict[str, Any]:
    """Infos of the environments of these numbers, out of `count`, as Gymnasium has them: arrays with `_key` masks.

    What `VectorEnv._add_info` makes one environment and one key after another.
    """
    numbers = list(numbers)
    names = list(infos[0])
    if len(infos) == count and all(list(info) == names for info in infos):
        columns = list(zip(*(info.values() for info in infos), strict=True))
        # Most are floats, and one conversion is much cheaper than twenty.
        floats = [j for j, column in enumerate(columns) if type(column[0]) is float]
        masks = iter(np.ones((len(names), count), np.bool_))
        table = dict(zip(floats, np.array([columns[j] for j in floats], np.float64), strict=True))
        out: dict[str, Any] = {}
        for j, name in enumerate(names):
            out[name] = table[j] if j in table else _column(name, numbers, columns[j], count)
            out[f"_{name}"] = next(masks)
        return out
    out = {}
    for name in dict.fromkeys(name for info in infos for name in info):
        rows = [i for i, info in zip(numbers, infos, strict=True) if name in info]
        mask = np.zeros(count, np.bool_)
        mask[rows] = True
        out[name], out[f"_{name}"] = _column(name, rows, [info[name] for info in infos if name in info], count), mask
    return out


def _column(name: str, rows: list[int], values: Sequence[Any], count: int) -> Any:
    """One entry of the infos of the environments `rows`."""
    first = values[0]
    if isinstance(first, dict) and name != "final_obs":
        return gathered(rows, values, count)
    if type(first) in (int, float, bool) or isinstance(first, np.number):
        if len(rows) == count:
            return np.array(values, type(first))
        column: NDArray[Any] = np.zeros(count, type(first))
        column[rows] = values
    elif isinstance(first, np.ndarray):
        column = np.zeros((count, *first.shape), first.dtype)
        column[rows] = values
    else:
        column = np.full(count, None, object)
        for row, value in zip(rows, values, strict=True):
            column[row] = value
    return column


def _stacked(observations: Sequence[Observation]) -> Observation:
    """Arrays with the environments along their first axis, where single observations have them."""
    first = observations[0]
    return {
        key: _stacked([one[key] for one in observations])
        if isinstance(value, dict)
        else np.stack([one[key] for one in observations])
        for key, value in first.items()
    }


def _count(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise UserError(f"{name} is {value!r}; give a whole number from 1")
    return int(value)
