"""The dm_env adapter, held to dm_env's own tests, and the package's lazy names."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import dm_env
import gymnasium as gym
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import specs, test_utils
from gymnasium import spaces
from vid2demo import envs
from vid2demo.envs.dm_adapter import as_dm_env
from vid2demo.envs.panda import Q_MAX_RAD
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.extract.errors import UserError

QUICK: dict[str, Any] = {"num_particles": 0, "control_hz": 25.0}


class TestStateEnvironment(test_utils.EnvironmentTestMixin, absltest.TestCase):
    def make_object_under_test(self) -> dm_env.Environment:
        return as_dm_env(PandaPourEnv(**QUICK), seed=1)

    def make_action_sequence(self) -> Any:
        for _ in range(20):
            yield self.make_action()


class TestPixelEnvironmentMadeByGymnasium(test_utils.EnvironmentTestMixin, absltest.TestCase):
    def make_object_under_test(self) -> dm_env.Environment:
        options = {**QUICK, "obs_mode": "both", "image_size": (32, 40), "control_mode": "ee_delta"}
        return as_dm_env(gym.make("vid2demo:PandaPour-v0", **options))

    def make_action_sequence(self) -> Any:
        for _ in range(4):
            yield self.make_action()


@pytest.fixture(scope="module")
def env() -> Any:
    made = PandaPourEnv(**QUICK, termination={"position_m": 0.1}, settle_s=0.0)
    yield made
    made.close()


def test_specs_carry_names_bounds_and_types(env: PandaPourEnv) -> None:
    adapted = as_dm_env(env)
    action = adapted.action_spec()
    assert isinstance(action, specs.BoundedArray)
    assert tuple(action.name.split("\t")) == env.action_names
    assert action.dtype == np.float32
    assert np.array_equal(action.maximum, Q_MAX_RAD.astype(np.float32))
    observation = adapted.observation_spec()
    assert set(observation) == {"agent_pos", "environment_state"}
    assert observation["environment_state"].shape == (len(env.observation_names["environment_state"]),)
    assert adapted.reward_spec().dtype == np.dtype(float)
    assert (adapted.discount_spec().minimum, adapted.discount_spec().maximum) == (0.0, 1.0)


def test_truncated_episode_ends_with_discount_1_and_the_next_step_begins_another(env: PandaPourEnv) -> None:
    adapted = as_dm_env(env, seed=3)
    first = adapted.step(np.zeros(7))
    assert first.first()
    assert first.reward is None
    assert first.discount is None
    still = np.asarray(env.reference.q_start_rad, np.float32)
    env._step_index = env._max_episode_steps - 2
    env.termination = type(env.termination)()
    middle, last = adapted.step(still), adapted.step(still)
    assert (middle.mid(), middle.discount) == (True, 1.0)
    assert (last.last(), last.discount) == (True, 1.0)
    assert isinstance(last.reward, float)
    assert adapted.step(still).first()
    assert adapted.step(still).mid()


def test_terminated_episode_ends_with_discount_0() -> None:
    made = PandaPourEnv(**QUICK, termination={"position_m": 0.05})
    adapted = as_dm_env(made)
    adapted.reset()
    for _ in range(50):
        step = adapted.step(Q_MAX_RAD)
        if step.last():
            break
    assert (step.last(), step.discount) == (True, 0.0)
    adapted.close()


def test_same_seed_gives_the_same_episode_as_the_environment_itself(env: PandaPourEnv) -> None:
    adapted = as_dm_env(env, seed=5)
    action = env.action_space.sample()
    adapted_steps = [adapted.reset(), adapted.step(action), adapted.step(action)]
    env.reset(seed=5)
    env.step(action)
    observation, reward, *_ = env.step(action)
    assert adapted_steps[-1].reward == reward
    for key, value in observation.items():
        assert np.array_equal(adapted_steps[-1].observation[key], value)


def test_spaces_without_arrays_are_refused(env: PandaPourEnv) -> None:
    class Discrete(gym.Wrapper[Any, Any, Any, Any]):
        action_space = spaces.Discrete(3)

    with pytest.raises(UserError, match="Discrete"):
        as_dm_env(Discrete(env))


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    return done.stdout.strip()


def test_without_dm_env_the_install_command_is_named() -> None:
    code = (
        "import sys; sys.modules['dm_env'] = None\n"
        "import vid2demo.envs as envs\n"
        "try: envs.as_dm_env\n"
        "except ValueError as error: print(error)"
    )
    assert "pip install 'dm-env>=1.6'" in run(code)


# ---------------------------------------------------------------------- the package


def test_import_of_the_package_is_light() -> None:
    code = (
        "import time, sys; start = time.process_time()\n"
        "import vid2demo.envs\n"
        "spent = time.process_time() - start\n"
        "heavy = ['torch', 'lerobot', 'transformers', 'ray', 'numba', 'trimesh', 'cv2', 'scipy', 'mujoco', 'dm_env']\n"
        "print(spent, [name for name in heavy if name in sys.modules])"
    )
    spent_s, loaded = run(code).split(" ", 1)
    assert loaded == "[]"
    assert float(spent_s) < 0.7


def test_every_name_of_the_package_can_be_had() -> None:
    assert set(envs.__all__) == set(envs._HOMES)
    for name in envs.__all__:
        assert getattr(envs, name).__name__ == name
        assert name in dir(envs)
    with pytest.raises(AttributeError, match="PandaCook"):
        _ = envs.PandaCook  # type: ignore[attr-defined]
