from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from numpy.typing import NDArray
from vid2demo.envs.control import CONTROL_MODES
from vid2demo.envs.diverged import PhysicsError
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.envs.rewards import REWARD_MODES
from vid2demo.envs.vector import PandaPourVectorEnv, PandaVectorEnv
from vid2demo.extract.errors import UserError

FEW = 12
SMALL = {"image_size": (16, 16), "cameras": ("front",)}


def equal(a: Any, b: Any) -> bool:
    """The same to the last bit, down to types and masks."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return isinstance(b, type(a)) and len(a) == len(b) and all(itertools.starmap(equal, zip(a, b, strict=True)))
    if isinstance(a, np.ndarray) and a.dtype == object:
        return a.shape == b.shape and all(itertools.starmap(equal, zip(a, b, strict=True)))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b, equal_nan=False)
    return type(a) is type(b) and bool(a == b)


def row(batch: Any, i: int) -> Any:
    """One environment's part of a batched observation."""
    return {key: row(value, i) for key, value in batch.items()} if isinstance(batch, dict) else batch[i]


def actions_near(env: PandaPourEnv, steps: int, count: int) -> NDArray[np.float32]:
    """(steps, count, A) actions that move every environment in its own way."""
    draw = np.random.default_rng(5).uniform(-1.0, 1.0, (steps, count, *env.action_space.shape))
    space = env.action_space
    if env.control_mode == "joint_position":
        return (env.reference.q_start_rad + 0.4 * draw).astype(np.float32)
    return (0.3 * draw * space.high).astype(np.float32)


def assert_as_single_ones(steps: int, count: int = 2, **arguments: Any) -> PandaVectorEnv:
    """Step a vector environment and as many single ones, and compare every bit."""
    vector = PandaPourVectorEnv(count, num_threads=2, **arguments)
    first = PandaPourEnv(**arguments)
    singles = [first, *(first.twin() for _ in range(count - 1))]
    observations, _ = vector.reset(seed=3)
    for i, single in enumerate(singles):
        assert equal(row(observations, i), single.reset(seed=3 + i)[0])
    for actions in actions_near(first, steps, count):
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        for i, single in enumerate(singles):
            observation, reward, over, cut, info = single.step(actions[i])
            assert equal(row(observations, i), observation)
            assert (rewards[i], terminated[i], truncated[i]) == (reward, over, cut)
            assert infos["poured_fraction"][i] == info["poured_fraction"]
            assert {name: terms[i] for name, terms in infos["reward_terms"].items() if name[0] != "_"} == info[
                "reward_terms"
            ]
            if over or cut:
                vector.close()
                return vector
    for ours, single in zip(vector.envs, singles, strict=True):
        assert equal(ours.get_state(), single.get_state())
        single.close()
    vector.close()
    return vector


@pytest.mark.parametrize(
    ("control_mode", "obs_mode", "reward_mode", "randomization", "particles"),
    [
        ("joint_position", "state", "dense", "low", 30),
        ("joint_delta", "both", "tracking", "high", 0),
        ("ee_delta", "pixels", "pour", "low", 0),
        ("torque", "state", "sparse", "high", FEW),
    ],
)
def test_it_gives_bit_for_bit_what_single_environments_give(
    mug_pour: Reference, control_mode: str, obs_mode: str, reward_mode: str, randomization: str, particles: int
) -> None:
    assert_as_single_ones(
        200,
        reference=mug_pour,
        num_particles=particles,
        control_mode=control_mode,
        obs_mode=obs_mode,
        reward_mode=reward_mode,
        randomization=randomization,
        **SMALL,
    )


@pytest.mark.parametrize("grasp", ["weld", "friction"])
@pytest.mark.parametrize("solver", ["engine", "fast"])
def test_both_liquids_and_both_grasps_keep_their_bits(mug_pour: Reference, solver: str, grasp: str) -> None:
    assert_as_single_ones(20, reference=mug_pour, num_particles=FEW, liquid={"solver": solver}, grasp=grasp)


@pytest.mark.parametrize("solver", ["engine", "fast"])
def test_a_spout_that_moves_particles_keeps_its_bits(kettle_pour: Reference, solver: str) -> None:
    # The pour is begun in its middle, where particles leave the spout.
    start = {"last_phase": 0.8}
    vector = assert_as_single_ones(
        50, reference=kettle_pour, num_particles=30, liquid={"solver": solver}, start=start, randomization="low"
    )
    assert vector.envs[0].simulation.scene.vessel.outlet.kind == "spout"


@pytest.mark.exhaustive
@pytest.mark.parametrize("control_mode", CONTROL_MODES)
@pytest.mark.parametrize("obs_mode", ["state", "pixels", "both"])
@pytest.mark.parametrize("reward_mode", list(REWARD_MODES))
def test_every_combination_of_modes_keeps_its_bits(
    mug_pour: Reference, control_mode: str, obs_mode: str, reward_mode: str
) -> None:
    modes = {"control_mode": control_mode, "obs_mode": obs_mode, "reward_mode": reward_mode}
    for randomization, particles in (("low", 0), ("high", FEW)):
        assert_as_single_ones(
            200, reference=mug_pour, num_particles=particles, randomization=randomization, **modes, **SMALL
        )


# ---------------------------------------------------------------------- against Gymnasium's own


def pair(count: int, mode: AutoresetMode, **arguments: Any) -> tuple[VectorEnv[Any, Any, Any], SyncVectorEnv[Any, Any]]:
    """Our vector environment and Gymnasium's of the same single ones."""
    ours = gym.make_vec(
        "vid2demo:PandaPour-v0", count, "vector_entry_point", autoreset_mode=mode, num_threads=2, **arguments
    )
    return ours, SyncVectorEnv([lambda: gym.make("vid2demo:PandaPour-v0", **arguments)] * count, autoreset_mode=mode)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_episodes_begin_anew_as_in_gymnasiums_vector_environment(mug_pour: Reference, mode: AutoresetMode) -> None:
    arguments = {
        "reference": mug_pour,
        "num_particles": 0,
        "randomization": {"start_offset_m": (0.02, 0.02, 0.0), "receptacle_shapes": 2, "joint_noise_rad": 0.001},
        "control_mode": "joint_delta",
        "termination": {"position_m": 0.025, "rotation_rad": 0.12},
        "max_episode_steps": 14,
    }
    ours, theirs = pair(3, mode, **arguments)
    assert ours.metadata["autoreset_mode"] is mode
    assert equal(ours.reset(seed=11), theirs.reset(seed=11))
    ended = np.zeros(3, np.bool_)
    finished = 0
    for actions in actions_near(ours.unwrapped.envs[0], 40, 3):
        if mode is AutoresetMode.DISABLED and ended.any():
            a, b = (env.reset(seed=[4, None, 6], options={"reset_mask": ended.copy()}) for env in (ours, theirs))
            assert equal(a, b)
        a, b = ours.step(actions), theirs.step(actions)
        assert equal(a, b)
        ended = a[2] | a[3]
        finished += int(ended.sum())
        assert ("final_obs" in a[4]) == (mode is AutoresetMode.SAME_STEP and bool(ended.any()))
    assert finished >= 6
    assert len({int(n) for n in ours.unwrapped._steps}) > 1, "episodes should be out of step with each other"
    ours.close()
    theirs.close()


def test_it_looks_like_gymnasiums_vector_environment(mug_pour: Reference) -> None:
    arguments = {"reference": mug_pour, "num_particles": 0, "render_mode": "rgb_array", "render_size": (16, 24)}
    ours, theirs = pair(2, AutoresetMode.NEXT_STEP, **arguments)
    assert isinstance(ours.unwrapped, PandaVectorEnv)
    for name in ("num_envs", "observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert ours.metadata == theirs.metadata
    assert ours.render_mode == theirs.render_mode
    for seed in (5, [7, 2], [None, 3]):
        ours.reset(seed=seed)
        theirs.reset(seed=seed)
        assert ours.np_random_seed[1] == theirs.np_random_seed[1]
        for a, b in zip(ours.unwrapped.call("get_state"), theirs.call("get_state"), strict=True):
            assert seed == [None, 3] or equal(a, b)
    ours.reset(seed=5)
    theirs.reset(seed=5)
    assert equal(ours.render(), theirs.render())
    for env in (ours.unwrapped, theirs):
        env.set_attr("tolerance", 0.5)
        assert env.get_attr("tolerance") == (0.5, 0.5)
        env.set_attr("tolerance", [0.5, 2.0])
        assert env.call("tolerance") == (0.5, 2.0)
        assert env.call("_max_episode_steps") == (ours.unwrapped.envs[0]._max_episode_steps,) * 2
    offset = {"start_offset_m": [0.01, 0.0, 0.0]}
    assert equal(ours.reset(seed=1, options=offset), theirs.reset(seed=1, options=offset))
    assert ours.spec is not None
    assert ours.spec.kwargs["num_envs"] == 2
    ours.close()
    theirs.close()


def test_gymnasiums_vector_wrappers_take_it(mug_pour: Reference) -> None:
    made = gym.make_vec("vid2demo:PandaTrack-v0", 2, "vector_entry_point", reference=mug_pour, max_episode_steps=5)
    env = RecordEpisodeStatistics(made)
    env.reset(seed=0)
    total = np.zeros(2)
    for _ in range(5):
        _, rewards, _, truncated, infos = env.step(np.tile(mug_pour.q_start_rad, (2, 1)).astype(np.float32))
        total += rewards
    assert truncated.all()
    assert infos["episode"]["l"].tolist() == [5, 5]
    assert infos["episode"]["r"] == pytest.approx(total)
    env.close()


# ---------------------------------------------------------------------- its own promises


def test_every_environment_may_have_a_reference_of_its_own(mug_pour: Reference) -> None:
    short = mug_pour.stretched(0.5)
    vector = PandaPourVectorEnv(2, reference=[short, mug_pour], num_particles=FEW)
    singles = [PandaPourEnv(reference, num_particles=FEW) for reference in (short, mug_pour)]
    observations, _ = vector.reset(seed=3)
    for i, single in enumerate(singles):
        assert equal(row(observations, i), single.reset(seed=3 + i)[0])
    assert [env._max_episode_steps for env in vector.envs] == [env._max_episode_steps for env in singles]
    for action in actions_near(singles[0], 5, 2):
        observations, rewards, *_ = vector.step(action)
        for i, single in enumerate(singles):
            observation, reward, *_ = single.step(action[i])
            assert equal(row(observations, i), observation)
            assert rewards[i] == reward
    vector.close()
    with pytest.raises(UserError, match="2 references were given to 3 environments"):
        PandaPourVectorEnv(3, reference=[short, mug_pour])


def test_results_do_not_depend_on_the_number_of_threads(mug_pour: Reference) -> None:
    arguments = {"reference": mug_pour, "num_particles": FEW, "randomization": "high", "control_mode": "joint_delta"}
    made = [PandaPourVectorEnv(5, num_threads=threads, **arguments) for threads in (1, 2, 5)]
    assert [env.num_threads for env in made] == [1, 2, 5]
    assert equal(made[0].reset(seed=0), made[1].reset(seed=0))
    made[2].reset(seed=0)
    for actions in actions_near(made[0].envs[0], 15, 5):
        one, two, five = (env.step(actions) for env in made)
        assert equal(one, two)
        assert equal(one, five)
    for env in made:
        env.close()


@pytest.fixture(scope="module")
def small(mug_pour: Reference) -> PandaVectorEnv:
    """Two environments without particles."""
    return PandaPourVectorEnv(2, reference=mug_pour, num_particles=0, autoreset_mode="Disabled", max_episode_steps=3)


def test_observations_are_the_callers_own(small: PandaVectorEnv) -> None:
    observations, _ = small.reset(seed=0)
    kept = observations["agent_pos"].copy()
    small.step(np.zeros((2, 7), np.float32))
    assert np.array_equal(observations["agent_pos"], kept)
    assert small.observation_space.contains(observations)


def test_twins_share_the_scene_and_not_the_state(small: PandaVectorEnv) -> None:
    first, second = small.envs
    small.reset(seed=[1, 2])
    before = second.get_state()
    first.step(np.zeros(7, np.float32))
    assert equal(before, second.get_state())
    assert first.simulation.scene.vessel_cavity is second.simulation.scene.vessel_cavity
    assert first.model is not second.model
    assert first.action_space is not second.action_space


def test_ended_episodes_must_be_reset_when_autoreset_is_disabled(small: PandaVectorEnv) -> None:
    small.reset(seed=0)
    for _ in range(3):
        small.step(np.zeros((2, 7), np.float32))
    with pytest.raises(UserError, match=r"environments \[0, 1\] have ended"):
        small.step(np.zeros((2, 7), np.float32))
    small.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(UserError, match=r"environments \[1\] have ended"):
        small.step(np.zeros((2, 7), np.float32))


def test_nothing_moves_when_an_action_is_wrong(small: PandaVectorEnv) -> None:
    small.reset(seed=0)
    before = small.call("get_state")
    wrong = np.zeros((2, 7), np.float32)
    wrong[1, 3] = np.nan
    with pytest.raises(UserError, match=r"environments \[1\] are not finite"):
        small.step(wrong)
    with pytest.raises(UserError, match=r"shape \(7,\); give \(2, 7\)"):
        small.step(wrong[0])
    assert equal(before, small.call("get_state"))


def test_after_an_error_in_one_environment_all_are_reset(
    small: PandaVectorEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the engine writes its warnings there
    small.reset(seed=0)
    small.envs[1].data.qpos[3] = np.nan
    with pytest.raises(PhysicsError, match="diverged at step 1"):
        small.step(np.zeros((2, 7), np.float32))
    with pytest.raises(ResetNeeded):
        small.step(np.zeros((2, 7), np.float32))
    with pytest.raises(ResetNeeded):
        small.reset(options={"reset_mask": np.array([False, True])})
    small.reset(seed=0)
    small.step(np.zeros((2, 7), np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0; give a whole number from 1"),
        ({"num_envs": 2.5}, "num_envs is 2.5"),
        ({"num_threads": 0}, "num_threads is 0"),
        ({"max_episode_steps": -3}, "max_episode_steps is -3"),
        ({"autoreset_mode": "sometimes"}, "choose NextStep, SameStep, Disabled"),
        ({"num_particles": 1000}, "num_particles is 1000"),
    ],
)
def test_wrong_arguments_are_told(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        PandaPourVectorEnv(**arguments)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda env: env.reset(seed=[1, 2, 3]), "3 seeds were given for 2 environments"),
        (lambda env: env.reset(options={"reset_mask": np.zeros(2, np.bool_)}), "at least one of them True"),
        (lambda env: env.reset(options={"reset_mask": [1, 0]}), "2 of bool"),
        (lambda env: env.reset(options={"colour": 3}), "no option colour"),
        (lambda env: env.set_attr("tolerance", [1.0]), "1 values of tolerance"),
        (lambda env: env.set_attr("tolerance", -1.0), "tolerance is -1.0"),
    ],
)
def test_wrong_calls_are_told(small: PandaVectorEnv, act: Callable[[PandaVectorEnv], Any], message: str) -> None:
    small.reset(seed=0)
    with pytest.raises(UserError, match=message):
        act(small)
