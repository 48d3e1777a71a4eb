"""Every way to drive, begin, vary and end an episode."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from scipy.spatial.transform import Rotation
from vid2demo.envs.control import CONTROL_MODES, Control, action_entries
from vid2demo.envs.kinematics import panda_chain
from vid2demo.envs.panda import Q_HOME_RAD, TAU_MAX_NM
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.envs.rewards import REWARD_MODES
from vid2demo.envs.start import ReferenceStart, StartSampler
from vid2demo.envs.tracking import PandaTrackEnv
from vid2demo.extract.errors import UserError
from vid2demo.extract.vessels import make_vessel

ActionsOf = Callable[[Reference, int], Any]


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return bool(np.array_equal(a, b))


def agree(first: gym.Env, second: gym.Env, steps: int, seed: int = 3) -> None:
    """Two environments, one seed, one stream of random actions, the same bits."""
    first.action_space.seed(seed)
    assert all(equal(x, y) for x, y in zip(first.reset(seed=seed), second.reset(seed=seed), strict=True))
    for _ in range(steps):
        action = first.action_space.sample()
        a, b = first.step(action), second.step(action)
        assert equal(a[0], b[0])
        assert a[1:4] == b[1:4]
        assert equal(a[4], b[4])
        if a[2] or a[3]:
            assert all(equal(x, y) for x, y in zip(first.reset(), second.reset(), strict=True))


@pytest.mark.parametrize("control_mode", CONTROL_MODES)
def test_two_environments_with_one_seed_agree_for_200_steps(mug_pour: Reference, control_mode: str) -> None:
    made = [
        PandaPourEnv(mug_pour, num_particles=4, control_mode=control_mode, randomization="high", termination="lost")
        for _ in "ab"
    ]
    agree(*made, steps=200)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("control_mode", "obs_mode", "reward_mode", "start"),
    list(itertools.product(CONTROL_MODES, ("state", "pixels", "both"), REWARD_MODES, ("beginning", "reference"))),
)
def test_every_combination_of_modes_agrees_with_itself(
    mug_pour: Reference, control_mode: str, obs_mode: str, reward_mode: str, start: str
) -> None:
    arguments: dict[str, Any] = {"control_mode": control_mode, "obs_mode": obs_mode, "reward_mode": reward_mode}
    made = [
        PandaPourEnv(mug_pour, num_particles=3, image_size=(24, 32), start=start, randomization="low", **arguments)
        for _ in "ab"
    ]
    agree(*made, steps=200)
    for environment in made:
        environment.close()


@pytest.mark.parametrize("reward_mode", list(REWARD_MODES))
def test_gymnasium_accepts_every_reward_and_the_track_environment(mug_pour: Reference, reward_mode: str) -> None:
    for name, arguments in (("PandaPour-v0", {"num_particles": 3}), ("PandaTrack-v0", {})):
        made = gym.make(f"vid2demo:{name}", reference=mug_pour, reward_mode=reward_mode, **arguments)
        check_env(made.unwrapped, skip_render_check=True)


def test_the_hand_goes_where_its_delta_says_and_turns_so() -> None:
    control = Control("ee_delta", 25.0, 20)
    control.reset(Q_HOME_RAD, np.zeros(7))
    rng = np.random.default_rng(0)
    for _ in range(40):
        before = panda_chain().hand(control.state.target[None])[0]
        action = rng.uniform(-1, 1, 6) * [0.01, 0.01, 0.01, 0.03, 0.03, 0.03]
        control.advance(action.astype(np.float32))
        after = panda_chain().hand(control.state.target[None])[0]
        np.testing.assert_allclose(after[:3, 3] - before[:3, 3], action[:3], atol=2e-4)
        turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        np.testing.assert_allclose(turned, action[3:], atol=2e-3)


def test_a_hand_that_is_asked_for_too_much_keeps_its_direction_and_the_joints_their_limits() -> None:
    control = Control("ee_delta", 25.0, 20)
    control.reset(Q_HOME_RAD, np.zeros(7))
    for action in control.space.high * np.eye(6)[:, :6]:
        start = control.state.target.copy()
        for _ in range(5):
            control.advance(action)
        assert np.all(np.abs(control.state.target - start) <= 5 * control._delta_rad + 1e-9)
    for _ in range(200):
        control.advance(control.space.high)
    low, high = (np.array([getattr(e, s) for e in action_entries("joint_position", 25.0)]) for s in ("low", "high"))
    assert np.all((control.state.target >= low) & (control.state.target <= high))


def test_torques_act_on_the_joint_they_name_and_none_keeps_still(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0, control_mode="torque")
    env.reset(seed=0)
    np.testing.assert_allclose(env.action_space.high, TAU_MAX_NM)
    q_rad = env.data.qpos[:7].copy()
    for _ in range(25):
        env.step(np.zeros(7, np.float32))
    np.testing.assert_allclose(env.data.qpos[:7], q_rad, atol=0.01)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1.0], np.float32))
    moved = env.data.qpos[:7] - q_rad
    assert moved[6] == np.abs(moved).max() > 0.02


def test_an_episode_begun_in_the_middle_is_where_the_reference_is(mug_pour: Reference, actions_of: ActionsOf) -> None:
    env = PandaPourEnv(mug_pour, num_particles=40, start="reference", randomization="low")
    played = PandaPourEnv(mug_pour, num_particles=40)
    played.reset(seed=0)
    knot = int(0.75 * len(mug_pour))
    for action in actions_of(mug_pour, knot):
        _, _, _, _, expected = played.step(action)
    none = {"start_offset_m": (0, 0, 0), "receptacle_offset_m": (0, 0, 0)}
    _, info = env.reset(seed=0, options={"start_index": knot, **none})
    assert info["reference_index"] == knot
    # Grains of a jet go other ways when an action is rounded to 32 bits, but as many.
    begun = info["poured_fraction"]
    assert begun == pytest.approx(expected["poured_fraction"], abs=0.15)
    assert begun > 0.0
    np.testing.assert_allclose(env.data.qpos[:7], played.data.qpos[:7], atol=1e-6)
    np.testing.assert_allclose(env.data.qvel[:7], played.data.qvel[:7], atol=1e-4)
    # With receptacle and start elsewhere, as much is in each as before.
    _, info = env.reset(seed=0, options={"start_index": knot, "receptacle_offset_m": (0.03, -0.02, 0.0)})
    assert info["poured_fraction"] == begun
    assert info["position_error_m"] < 0.005
    for action in actions_of(env.reference, env._max_episode_steps)[knot:]:
        _, _, _, truncated, info = env.step(action)
    assert truncated
    assert info["is_success"]


def test_starts_along_the_reference_are_spread_and_go_where_episodes_fail() -> None:
    even = StartSampler(ReferenceStart(), 101)
    rng = np.random.default_rng(0)
    knots = np.array([even.draw(rng) for _ in range(2000)])
    assert knots.min() == 0
    assert knots.max() == 90
    counts = np.histogram(knots, bins=9, range=(0, 91))[0]
    assert counts.min() > 150
    hard = StartSampler(ReferenceStart(failure_share=1.0), 101)
    for _ in range(20):
        hard.record(50, failed=True)
        hard.record(10, failed=False)
    near = np.array([hard.draw(rng) for _ in range(200)])
    assert np.all(np.abs(near - 50) <= 5)


def test_failure_statistics_belong_to_the_state(mug_pour: Reference) -> None:
    env = PandaTrackEnv(mug_pour, start={"failure_share": 0.5}, termination={"position_m": 0.01})
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(60):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    state = env.get_state()
    assert np.any(state["failure_rate"] > 0)
    twin = PandaTrackEnv(mug_pour, start={"failure_share": 0.5}, termination={"position_m": 0.01})
    twin.set_state(state)
    assert [env.reset()[1]["reference_index"] for _ in range(20)] == [
        twin.reset()[1]["reference_index"] for _ in range(20)
    ]


def test_following_the_reference_is_success_without_liquid_and_losing_it_ends_the_episode(
    mug_pour: Reference, actions_of: ActionsOf
) -> None:
    env = PandaTrackEnv(mug_pour)
    env.reset(seed=0)
    actions = actions_of(mug_pour, env._max_episode_steps)
    done = []
    for action in actions:
        _, reward, terminated, truncated, info = env.step(action)
        done.append(info["is_success"])
        assert not terminated
        assert 0.9 < reward <= 1.0
    assert truncated
    assert done == [step + 1 >= len(mug_pour) - 1 for step in range(len(done))]
    env.reset(seed=0)
    for _ in actions:
        _, _, terminated, _, info = env.step(actions[0])
        if terminated:
            break
    assert terminated
    assert info["position_error_m"] > 0.25 or info["rotation_error_rad"] > 0.8
    with pytest.raises(UserError, match="no liquid, so no num_particles"):
        PandaTrackEnv(mug_pour, num_particles=3)


def test_the_tolerance_widens_reward_and_termination_together(mug_pour: Reference) -> None:
    env = PandaTrackEnv(mug_pour, tolerance=4.0)
    still = mug_pour.q_start_rad.astype(np.float32)

    def run() -> tuple[int, float]:
        env.reset(seed=0)
        steps, total = 0, 0.0
        while True:
            _, reward, terminated, truncated, _ = env.step(still)
            steps, total = steps + 1, total + reward
            if terminated or truncated:
                return steps, total

    wide = run()
    env.tolerance = 0.5
    narrow = run()
    assert wide[0] > narrow[0]
    assert wide[1] > narrow[1]
    state = env.get_state()
    env.tolerance = 2.0
    env.set_state(state)
    assert env.tolerance == 0.5
    with pytest.raises(UserError, match="tolerance is 0"):
        env.tolerance = 0


def test_what_an_episode_drew_is_in_the_model_and_comes_back_with_its_state(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=3, randomization="high")
    seen = []
    for seed in range(6):
        env.reset(seed=seed)
        vessel = env.model.body("vessel").id
        seen.append((float(env.model.body_mass[vessel]), float(env.model.actuator_gainprm[0, 0])))
    assert len({mass for mass, _ in seen}) == len({gain for _, gain in seen}) == 6
    state, mass = env.get_state(), seen[-1][0]
    expected = [env.step(mug_pour.q_start_rad)[0] for _ in range(5)]
    env.reset(seed=99)
    assert float(env.model.body_mass[env.model.body("vessel").id]) != mass
    twin = PandaPourEnv(mug_pour, num_particles=3, randomization="high")
    for other in (env, twin):
        other.set_state(state)
        assert float(other.model.body_mass[other.model.body("vessel").id]) == mass
        assert all(equal(other.step(mug_pour.q_start_rad)[0], wanted) for wanted in expected)


def test_observation_noise_is_as_large_as_asked_for_and_leaves_the_physics_alone(mug_pour: Reference) -> None:
    quiet, noisy = PandaTrackEnv(mug_pour), PandaTrackEnv(mug_pour, randomization={"joint_noise_rad": 0.01})
    pairs = [[env.reset(seed=seed)[0]["agent_pos"] for env in (quiet, noisy)] for seed in range(100)]
    off = np.array([b - a for a, b in pairs])
    assert np.std(off[:, :7]) == pytest.approx(0.01, rel=0.1)
    assert not np.any(off[:, 7:])
    assert np.array_equal(quiet.data.qpos, noisy.data.qpos)


@pytest.mark.parametrize(("role", "word"), [("vessel", "pitcher:2"), ("receptacle", "mug:1")])
def test_vessel_and_receptacle_can_be_named(mug_pour: Reference, role: str, word: str) -> None:
    category, seed = word.split(":")
    for reference in (None, mug_pour):
        env = PandaPourEnv(reference, num_particles=0, **{role: word})
        assert getattr(env.reference, role)().params == make_vessel(category, int(seed)).params
        _, info = env.reset(seed=0)
        assert info["position_error_m"] < 1e-3
        assert env.observation_space.contains(env.reset(seed=0)[0])
        bottom_m = env.T_world_receptacle[2, 3] - env.reference.receptacle().extents_m[2] / 2
        assert bottom_m == pytest.approx(0.0, abs=1e-9)


def test_dicts_stand_for_dataclasses_so_that_a_spec_survives_json() -> None:
    arguments = {
        "num_particles": 5,
        "vessel": "mug:1",
        "liquid": {"radius_m": 0.004},
        "termination": {"position_m": 0.3},
        "randomization": {"start_offset_m": [0.01, 0.0, 0.0]},
        "start": {"failure_share": 0.5},
        "reward_mode": {"poured": 5.0},
    }
    made = gym.make("vid2demo:PandaPour-v0", **arguments)
    again = gym.make(EnvSpec.from_json(made.spec.to_json()))
    assert again.unwrapped.reward_config.poured == 5.0
    assert again.unwrapped.randomization.start_offset_m == (0.01, 0.0, 0.0)
    agree(made, again, steps=5)


@pytest.mark.slow
@pytest.mark.parametrize("control_mode", CONTROL_MODES)
def test_ten_thousand_random_actions_leave_everything_finite(mug_pour: Reference, control_mode: str) -> None:
    env = PandaPourEnv(mug_pour, num_particles=20, control_mode=control_mode, randomization="high")
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(10_000):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert np.isfinite(reward)
        assert env.observation_space.contains(observation)
        if terminated or truncated:
            env.reset()


def test_an_object_without_a_receptacle_can_be_followed_but_not_poured(
    mug_pour: Reference, actions_of: ActionsOf
) -> None:
    header = {name: value for name, value in mug_pour.header.items() if name != "receptacle"}
    alone = Reference.from_poses(mug_pour.T_world_object, mug_pour.time_s, header)
    env = PandaTrackEnv(alone, randomization="high", render_mode="rgb_array", render_size=(48, 64))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    for action in actions_of(env.reference, env._max_episode_steps):
        _, _, _, _, info = env.step(action)
    assert info["is_success"]
    assert env.render().std() > 10
    assert env.task == "move the mug"
    assert PandaTrackEnv(mug_pour).task == "pour from the mug into the bowl"
    with pytest.raises(UserError, match="no receptacle to pour 5 particles into"):
        PandaPourEnv(alone, num_particles=5)
