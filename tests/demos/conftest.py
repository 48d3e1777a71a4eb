"""A tiny environment with PandaPour's interface: one number follows the action, no simulator, microseconds a step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from vid2demo.demos import attempt
from vid2demo.envs.reference import Reference

ENV_ID = "StandIn-v0"
STEPS = 6


class StandInEnv(gymnasium.Env[Any, Any]):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012  (Gymnasium's own form)
    constructed = 0
    success_poured_fraction = 0.7
    success_spilled_fraction = 0.1

    def __init__(
        self,
        reference: Path | str,
        obs_mode: str = "state",
        cameras: tuple[str, ...] = (),
        image_size: tuple[int, int] = (16, 16),
        control_mode: str = "joint_position",
        randomization: str = "none",
        success_below: float = 0.5,
        forgetful: bool = False,
        **others: object,
    ) -> None:
        type(self).constructed += 1
        self.number = type(self).constructed
        self.reference = Reference.load(Path(reference))
        self.obs_mode, self.cameras, self.image_size = obs_mode, cameras, image_size
        self.success_below, self.forgetful = success_below, forgetful
        self.action_space = gymnasium.spaces.Box(-3.0, 3.0, (7,), np.float32)
        self.observation_space = gymnasium.spaces.Dict()
        self.observation_names = {
            "agent_pos": [f"q{i}" for i in range(7)],
            "environment_state": ["level", "time_s"],
        }
        self.x = np.zeros(7)
        self.level = 0.0
        self.step_count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.level = float(self.np_random.uniform())
        self.x = self.np_random.normal(size=7)
        self.step_count = 0
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        self.x = self.x + 0.3 * (np.asarray(action, float) - self.x)
        if self.forgetful:
            self.x += 1e-9 * self.number
        self.step_count += 1
        return self._observation(), float(-np.abs(self.x).sum()), False, self.step_count == STEPS, self._info()

    def get_state(self) -> dict[str, Any]:
        return {"x": self.x.copy(), "level": self.level, "rng": self.np_random.bit_generator.state}

    def _observation(self) -> dict[str, Any]:
        observation: dict[str, Any] = {
            "agent_pos": self.x.astype(np.float32),
            "environment_state": np.array([self.level, self.step_count / 25], np.float32),
        }
        if self.obs_mode == "both":
            gray = int(255 * self.level)
            observation["pixels"] = {camera: np.full((*self.image_size, 3), gray, np.uint8) for camera in self.cameras}
        return observation

    def _info(self) -> dict[str, Any]:
        good = self.level < self.success_below
        return {
            "is_success": good and self.step_count == STEPS,
            "poured_fraction": 0.9 if good else 0.2,
            "spilled_fraction": 0.0,
            "position_error_m": 0.001,
            "rotation_error_rad": 0.01,
            "reward_terms": {},
        }


class StillController:
    """Stands for the retargeted motion: the same ramp in every episode."""

    def reset(self, env: Any, observation: Any, info: Any) -> None:
        self.step = 0

    def act(self, observation: Any) -> Any:
        self.step += 1
        return np.full(7, 0.1 * self.step, np.float32)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> str:
    """Id of the stand-in environment, with a motion that needs no robot."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, entry_point=StandInEnv)
    monkeypatch.setattr(attempt, "ReferencePlayer", StillController)
    return ENV_ID


@pytest.fixture
def stand_in_reference(tmp_path: Path) -> Path:
    """A still motion of a kettle over a mug."""
    header = {
        "vessel": {"library": {"category": "gooseneck_kettle", "params": {}}},
        "receptacle": {"library": {"category": "mug", "params": {}}, "T_world_receptacle": np.eye(4).tolist()},
    }
    path = tmp_path / "kettle.reference.npz"
    Reference.from_poses(np.tile(np.eye(4), (STEPS, 1, 1)), np.arange(STEPS) / 25, header).save(path)
    return path


# Small pictures and few particles: everything is as in a real collection, and quick.
SMALL = {"image_size": (64, 64), "env_kwargs": {"num_particles": 20}}


@pytest.fixture(scope="session")
def pour_reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in pour of a mug into a bowl, as a file."""
    from vid2demo.envs.builtin import builtin_reference

    path = tmp_path_factory.mktemp("reference") / "mug.reference.npz"
    builtin_reference().save(path)
    return path


@pytest.fixture(scope="session")
def pour_dataset(pour_reference: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of the real environment. Read only."""
    from vid2demo.demos.collect import collect

    out = tmp_path_factory.mktemp("collected") / "dataset"
    collect(pour_reference, out, episodes=2, seed=1, **SMALL)
    return out
