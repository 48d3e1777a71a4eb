"""Playing one episode in an environment and keeping all of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .camera_encoder import CameraEncoder
from .episode import Episode

if TYPE_CHECKING:
    from ..envs.reference import Reference
    from .retarget import JointTrajectory

DEFAULT_ENV_ID = "vid2demo:PandaPour-v0"

Observation = Mapping[str, Any]
Info = Mapping[str, Any]
OnStep = Callable[[int, NDArray[np.float32], Observation, float, Info], None]


class Controller(Protocol):
    """Anything that chooses actions: a recording, an open-loop motion, a learned policy."""

    def reset(self, env: Any, observation: Observation, info: Info) -> None:
        """An episode begins; `env` is the environment after its reset."""

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The action for this observation."""


class ActionPlayer:
    """Plays recorded actions (T, A); the last one is held when the episode is longer."""

    def __init__(self, actions: NDArray[np.float32]) -> None:
        self.actions = np.asarray(actions, np.float32)
        self._step = 0

    def reset(self, env: Any, observation: Observation, info: Info) -> None:
        self._step = 0

    def act(self, observation: Observation) -> NDArray[np.float32]:
        action = self.actions[min(self._step, len(self.actions) - 1)]
        self._step += 1
        return np.asarray(action)


class ReferencePlayer:
    """Retargets the reference of the episode at hand and plays it open loop as absolute joint targets."""

    def __init__(self) -> None:
        self._player: ActionPlayer | None = None

    def reset(self, env: Any, observation: Observation, info: Info) -> None:
        """Raises UserError when the arm cannot follow this episode's reference."""
        from .retarget import retarget

        self._player = ActionPlayer(joint_actions(retarget(env.unwrapped.reference), env))
        self._player.reset(env, observation, info)

    def act(self, observation: Observation) -> NDArray[np.float32]:
        assert self._player is not None, "reset comes first"
        return self._player.act(observation)


def joint_actions(joints: JointTrajectory, env: Any) -> NDArray[np.float32]:
    """(N, 7) float32 joint targets in rad inside the action space: action t is where the arm is to be at its end.

    Raises ValueError when the environment is not controlled by absolute joint positions.
    """
    space = env.action_space
    if space.shape != (joints.q_rad.shape[1],):
        raise ValueError(f"joint targets of width {joints.q_rad.shape[1]} do not fit the action space {space}")
    actions: NDArray[np.float32] = np.clip(joints.q_rad[1:].astype(np.float32), space.low, space.high)
    return actions


def make_env(env_id: str, reference: Reference | Path | str | None, **kwargs: Any) -> Any:
    """`gym.make` without the passive checker, whose warnings are for people who write environments."""
    import gymnasium

    return gymnasium.make(env_id, reference=reference, disable_env_checker=True, **kwargs)


def roll_out(
    env: Any,
    controller: Controller,
    *,
    seed: int,
    options: Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
) -> Episode:
    """Play one episode. Frames are kept when the observations hold `pixels`.

    on_step: called after every step with its index, action, the observation before it, the reward and the info after.
    """
    options = dict(options or {})
    observation, info = env.reset(seed=seed, options=options or None)
    unwrapped = env.unwrapped
    start_state = unwrapped.get_state()
    controller.reset(env, observation, info)
    encoders = {camera: CameraEncoder(control_rate(env)) for camera in observation.get("pixels", {})}
    actions, agent_pos, environment, rewards, success = [], [], [], [], []
    position_error_m: list[float] = []
    rotation_error_rad: list[float] = []
    done = False
    while not done:
        action = np.asarray(controller.act(observation), np.float32)
        actions.append(action)
        agent_pos.append(np.array(observation["agent_pos"], np.float32))
        # A policy that sees pixels only is rolled out without it.
        environment.append(np.array(observation.get("environment_state", ()), np.float32))
        for camera, encoder in encoders.items():
            encoder.write(observation["pixels"][camera])
        before = observation
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(float(reward))
        success.append(bool(info["is_success"]))
        position_error_m.append(float(info["position_error_m"]))
        rotation_error_rad.append(float(info["rotation_error_rad"]))
        done = bool(terminated or truncated)
        if on_step is not None:
            on_step(len(actions) - 1, action, before, float(reward), info)
    return Episode(
        seed=seed,
        options=options,
        action=np.stack(actions),
        agent_pos=np.stack(agent_pos),
        environment_state=np.stack(environment),
        reward=np.asarray(rewards, np.float32),
        success=np.asarray(success),
        start_state=start_state,
        end_state=unwrapped.get_state(),
        videos={camera: encoder.finish() for camera, encoder in encoders.items()},
        summary={
            "steps": len(actions),
            "is_success": success[-1],
            "terminated": bool(terminated),
            "return": float(np.sum(rewards)),
            "poured_fraction": float(info["poured_fraction"]),
            "spilled_fraction": float(info["spilled_fraction"]),
            "position_error_mean_m": float(np.mean(position_error_m)),
            "position_error_max_m": float(np.max(position_error_m)),
            "rotation_error_mean_rad": float(np.mean(rotation_error_rad)),
            "rotation_error_max_rad": float(np.max(rotation_error_rad)),
        },
    )


def control_rate(env: Any) -> int:
    """Control rate in Hz as LeRobot wants it: a whole number. Raises ValueError when it is not."""
    rate_hz = float(env.unwrapped.metadata["render_fps"])
    if abs(rate_hz - round(rate_hz)) > 1e-6:
        raise ValueError(f"LeRobot needs a whole number of frames per second, the control rate is {rate_hz} Hz")
    return round(rate_hz)
