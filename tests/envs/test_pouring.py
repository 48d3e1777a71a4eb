from __future__ import annotations

import json
import pickle
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from vid2demo.envs.builtin import pour_reference
from vid2demo.envs.diverged import PhysicsError, read_diverged_state
from vid2demo.envs.liquid import Liquid
from vid2demo.envs.panda import DQ_MAX_RAD_S, Q_MAX_RAD, Q_MIN_RAD
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.randomization import Randomization
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.extract.vessels import make_vessel

Play = Callable[..., dict[str, Any]]
ActionsOf = Callable[[Reference, int], Any]

FEW = 12


@pytest.fixture(scope="module")
def env(mug_pour: Reference) -> PandaPourEnv:
    """One environment with few particles for tests that reset it."""
    return PandaPourEnv(mug_pour, num_particles=FEW, randomization="low")


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return bool(np.array_equal(a, b))


@pytest.mark.parametrize("control_mode", ["joint_position", "joint_delta", "ee_delta", "torque"])
@pytest.mark.parametrize("obs_mode", ["state", "pixels", "both"])
def test_gymnasium_accepts_every_mode(mug_pour: Reference, obs_mode: str, control_mode: str) -> None:
    made = gym.make(
        "vid2demo:PandaPour-v0",
        reference=mug_pour,
        num_particles=FEW,
        obs_mode=obs_mode,
        control_mode=control_mode,
        image_size=(24, 32),
        render_mode="rgb_array",
        render_size=(24, 32),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(made.unwrapped, skip_render_check=obs_mode != "both")
    assert made.spec is not None
    assert made.spec.kwargs["num_particles"] == FEW
    assert made.unwrapped.metadata["render_fps"] == 25
    made.close()


def test_equal_seeds_and_actions_give_equal_episodes(mug_pour: Reference) -> None:
    envs = [PandaPourEnv(mug_pour, num_particles=FEW, randomization="low", control_mode="joint_delta") for _ in "ab"]
    (obs_a, info_a), (obs_b, info_b) = (made.reset(seed=7) for made in envs)
    assert equal(obs_a, obs_b)
    assert equal(info_a, info_b)
    envs[0].action_space.seed(0)
    for _ in range(60):
        action = envs[0].action_space.sample()
        a, b = envs[0].step(action), envs[1].step(action)
        assert equal(a[0], b[0])
        assert a[1:4] == b[1:4]
        assert equal(a[4], b[4])


def test_a_reset_is_bitwise_the_same_whatever_came_before(env: PandaPourEnv, actions_of: ActionsOf) -> None:
    env.reset(seed=3)
    first = env.get_state()
    for action in actions_of(env.reference, 10):
        env.step(action)
    env.reset(seed=3)
    assert equal(first, env.get_state())
    env.reset(seed=4)
    assert not equal(first, env.get_state())


@pytest.mark.parametrize("fixture", ["mug_pour", "kettle_pour"])
def test_a_restored_state_goes_on_bit_by_bit(
    fixture: str, request: pytest.FixtureRequest, actions_of: ActionsOf
) -> None:
    reference = request.getfixturevalue(fixture)
    original, other = (PandaPourEnv(reference, num_particles=30, randomization="low") for _ in range(2))
    original.reset(seed=11)
    actions = actions_of(original.reference, original._max_episode_steps)
    middle = int(0.7 * len(reference))
    for action in actions[:middle]:
        original.step(action)
    state = pickle.loads(pickle.dumps(original.get_state()))
    expected = [original.step(action) for action in actions[middle:]]
    other.reset(seed=99)
    observation, info = other.reset(options={"state": state})
    assert info["reference_index"] == middle
    assert observation["agent_pos"].dtype == np.float32
    for action, wanted in zip(actions[middle:], expected, strict=True):
        found = other.step(action)
        assert equal(found[0], wanted[0])
        assert found[1:4] == wanted[1:4]
        assert equal(found[4], wanted[4])
    assert equal(original.get_state(), other.get_state())
    assert original.np_random.uniform() == other.np_random.uniform()


def test_a_state_of_another_environment_is_refused(env: PandaPourEnv, kettle_pour: Reference) -> None:
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(UserError, match="taken with other arguments"):
        PandaPourEnv(kettle_pour, num_particles=3).set_state(state)
    with pytest.raises(UserError, match="lacks simulation, step"):
        env.set_state({k: v for k, v in state.items() if k not in ("simulation", "step")})


def test_following_the_reference_pours_the_mug_into_the_bowl(mug_pour: Reference, play: Play) -> None:
    env = PandaPourEnv(mug_pour)
    end = play(env, seed=0)
    assert end["truncated"]
    assert end["poured_fraction"] >= 0.9
    assert end["spilled_fraction"] <= 0.05
    assert end["is_success"]
    assert end["outlet"] == "lip"
    assert end["worst_m"] < 0.002
    assert end["worst_rad"] < np.deg2rad(0.5)
    # Perfect tracking pays 1 a step, the pour 20 in all.
    assert end["return"] == pytest.approx(env._max_episode_steps + 20, rel=0.1)


def test_following_the_reference_pours_the_kettle_through_its_spout(
    kettle_pour: Reference, play: Play, actions_of: ActionsOf
) -> None:
    env = PandaPourEnv(kettle_pour)
    spout_tip = np.asarray(kettle_pour.vessel().outlet.point_m)
    seen = []
    env.reset(seed=0)
    for action in actions_of(kettle_pour, env._max_episode_steps):
        held = env.particle_places["held"]
        _, _, _, _, info = env.step(action)
        for i in np.flatnonzero(held & ~env.particle_places["held"]):
            T = env.T_world_object
            seen.append(np.linalg.norm(env.particle_positions_m[i] - (T[:3, :3] @ spout_tip + T[:3, 3])))
    assert info["outlet"] == "spout_conduit"
    assert info["poured_fraction"] >= 0.8
    assert info["spilled_fraction"] <= 0.05
    # Wherever a particle is first seen outside, it has flown at most one control period from the spout's tip.
    assert len(seen) >= 80
    assert max(seen) < 0.06


def test_standing_still_spills_nothing_and_moves_nothing(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour)
    env.reset(seed=0)
    start = env.particle_positions_m
    assert np.abs(env.data.qvel).max() == 0.0
    for _ in range(50):
        _, _, _, _, info = env.step(mug_pour.q_start_rad.astype(np.float32))
    assert info["held_fraction"] == 1.0
    assert np.abs(env.particle_positions_m - start).max() < 0.002
    assert np.abs(env.data.qvel).max() < 0.01


def test_the_objects_velocity_is_the_engines(env: PandaPourEnv, actions_of: ActionsOf) -> None:
    env.reset(seed=0)
    for action in actions_of(env.reference, 70):
        env.step(action)
    mujoco.mj_forward(env.model, env.data)
    engine = np.empty(6)
    body = env.model.body("vessel").id
    mujoco.mj_objectVelocity(env.model, env.data, mujoco.mjtObj.mjOBJ_XBODY, body, engine, 0)
    assert np.linalg.norm(engine[:3]) > 0.1
    np.testing.assert_allclose(env.simulation.twist, np.roll(engine, 3), atol=1e-9)


def test_reward_is_the_sum_of_its_terms_and_info_says_how_it_stands(env: PandaPourEnv, actions_of: ActionsOf) -> None:
    _, info = env.reset(seed=0)
    assert info["reference_index"] == 0
    assert info["position_error_m"] < 1e-3
    for k, action in enumerate(actions_of(env.reference, 20)):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert info["reference_index"] == k + 1
        assert not info["is_success"]
    json.dumps(info)
    assert "position" in env.reward_table()


def test_observations_are_named_entry_by_entry(env: PandaPourEnv) -> None:
    observation, info = env.reset(seed=5)
    values = {
        name: float(value)
        for key, names in env.observation_names.items()
        for name, value in zip(names, observation[key], strict=True)
    }
    np.testing.assert_allclose(values["panda_joint3_rad"], env.reference.q_start_rad[2], atol=1e-5)
    assert values["held_fraction"] == 1.0
    assert values["object_tilt_rad"] == pytest.approx(0.0, abs=1e-3)
    assert values["reference_phase"] == 0.0
    T = env.T_world_receptacle
    np.testing.assert_allclose([values[f"receptacle_position_{a}_m"] for a in "xyz"], T[:3, 3], atol=1e-6)
    ahead = env.reference.T_world_object[15, :3, 3] - env.reference.T_world_object[0, :3, 3]
    np.testing.assert_allclose([values[f"reference_600ms_offset_{a}_m"] for a in "xyz"], ahead, atol=1e-3)
    assert info["held_fraction"] == 1.0


def test_options_move_start_and_receptacle_in_place_of_the_draw(env: PandaPourEnv) -> None:
    options = {"start_offset_m": (0.01, -0.02, 0.03), "receptacle_offset_m": (0.02, 0.01, 0.0)}
    _, info = env.reset(seed=1, options=options)
    base = env._base
    np.testing.assert_allclose(
        env.T_world_object[:3, 3] - base.T_world_object[0, :3, 3], [0.01, -0.02, 0.03], atol=1e-3
    )
    np.testing.assert_allclose(env.T_world_receptacle[:3, 3] - base.T_world_receptacle[:3, 3], [0.02, 0.01, 0.0])
    assert info["held_fraction"] == 1.0
    assert info["position_error_m"] < 1e-3
    env.reset(seed=1)
    drawn = env.T_world_receptacle
    env.reset(seed=1, options={"start_offset_m": (0.0, 0.0, 0.0)})
    np.testing.assert_array_equal(env.T_world_receptacle, drawn)


def test_joint_targets_keep_speed_and_position_limits(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0)
    env.reset(seed=0)
    previous = env._control.state.target
    for corner in (Q_MAX_RAD, Q_MIN_RAD):
        for _ in range(40):
            env.step((corner * 1.5).astype(np.float32))
            assert np.all(np.abs(env._control.state.target - previous) <= DQ_MAX_RAD_S / 25 + 1e-12)
            assert np.all(env._control.state.target >= Q_MIN_RAD)
            assert np.all(env._control.state.target <= Q_MAX_RAD)
            previous = env._control.state.target
    assert np.all(np.isfinite(env.data.qpos))


@pytest.mark.parametrize("control_mode", ["joint_position", "joint_delta", "ee_delta", "torque"])
def test_random_actions_leave_everything_finite(mug_pour: Reference, control_mode: str) -> None:
    env = PandaPourEnv(mug_pour, num_particles=FEW, control_mode=control_mode)
    env.action_space.seed(0)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(100):
            observation, reward, _, _, _ = env.step(env.action_space.sample())
            assert np.isfinite(reward)
            assert all(np.all(np.isfinite(values)) for values in observation.values())


def test_the_arm_cannot_go_through_the_table(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0)
    env.reset(seed=0)
    down = np.array([0.0, 1.4, 0.0, -1.2, 0.0, 2.4, 0.785], np.float32)
    for _ in range(80):
        env.step(down)
    ideal = mujoco.MjData(env.model)
    ideal.qpos[:7] = down
    mujoco.mj_kinematics(env.model, ideal)
    assert ideal.body("panda_leftfinger").xpos[2] < -0.02, "the command would lead into the table"
    assert env.data.body("panda_leftfinger").xpos[2] > 0.0


def test_a_diverged_simulation_is_reported_with_seed_and_step(mug_pour: Reference, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a log file here
    env = PandaPourEnv(mug_pour, num_particles=0)
    env.reset(seed=5)
    env.step(mug_pour.q_start_rad)
    env.data.qvel[3] = np.nan
    with pytest.raises(PhysicsError, match="step 2 of the episode with seed 5") as caught:
        env.step(mug_pour.q_start_rad)
    state, action = read_diverged_state(re.search(r"are in (\S+)", str(caught.value))[1])
    np.testing.assert_array_equal(action, mug_pour.q_start_rad)
    env.set_state(state)
    assert np.isnan(env.data.qvel[3]), "the file leads back to just before the step"
    with pytest.raises(UserError, match="holds no diverged state"):
        read_diverged_state(tmp_path / "nowhere.npz")


@pytest.mark.parametrize("action", [np.zeros(6), np.full(7, np.nan)])
def test_malformed_actions_are_refused(env: PandaPourEnv, action: np.ndarray) -> None:
    env.reset(seed=0)
    with pytest.raises(UserError, match="7 finite numbers"):
        env.step(action)


def test_thresholds_end_an_episode_that_has_lost_the_object(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0, termination={"position_m": 0.05})
    env.reset(seed=0)
    for _ in range(60):
        _, _, terminated, truncated, info = env.step(mug_pour.q_start_rad.astype(np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert info["position_error_m"] > 0.05


def test_files_other_rates_and_kettles_without_liquid_work(tmp_path: Path, kettle_pour: Reference) -> None:
    path = tmp_path / "kettle.reference.npz"
    kettle_pour.save(path)
    for value in (path, str(path)):
        env = PandaPourEnv(value, num_particles=0, control_hz=50.0)
        assert len(env.reference) == pytest.approx(2 * len(kettle_pour), abs=2)
        _, info = env.reset(seed=0)
        assert info["outlet"] == "spout_conduit"
        assert not info["is_success"]
        assert env.model.opt.timestep * env.simulation.substeps == pytest.approx(0.02)


def test_a_start_that_spills_is_said_in_info(mug_pour: Reference, actions_of: ActionsOf) -> None:
    lying = Reference.from_poses(
        mug_pour.T_world_object[-20:],
        mug_pour.time_s[:20],
        mug_pour.with_header(q_start_rad=actions_of(mug_pour, len(mug_pour))[-1].tolist()).header,
    )
    _, info = PandaPourEnv(lying, num_particles=FEW).reset(seed=0)
    assert "run out in the start pose" in info["start_warning"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obs_mode": "images"}, "obs_mode is 'images'; choose state, pixels, both"),
        ({"control_mode": "force"}, "control_mode is 'force'"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi'"),
        ({"cameras": ("front", "top")}, "camera is 'top'; choose front, wrist, side"),
        ({"cameras": "front"}, "give a tuple"),
        ({"cameras": ("front", "front")}, "each of them once"),
        ({"num_particles": 501}, "num_particles is 501"),
        ({"num_particles": 2.5}, "num_particles is 2.5"),
        ({"image_size": (4, 4)}, r"image_size is \(4, 4\)"),
        ({"control_hz": 0.0}, "control_hz is 0.0"),
        ({"timestep_s": 0.004}, "let particles leak"),
        ({"timestep_s": 0.0015}, r"does not divide the control period of 0\.04 s; choose 0\.00148148"),
        ({"randomization": "huge"}, "randomization is 'huge'; choose none, low"),
        ({"reward_mode": "kind"}, "reward_mode is 'kind'; choose dense, tracking, pour, sparse"),
        ({"settle_s": -1.0}, "settle_s is -1.0"),
        ({"success_poured_fraction": 70}, "success_poured_fraction is 70"),
        ({"termination": {"position_m": 0.0}}, "termination position_m is 0.0"),
        ({"termination": {"far": 1.0}}, "termination has no far; it has position_m"),
        ({"start": "middle"}, "start is 'middle'; choose beginning, reference"),
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"vessel": "mug:x"}, "vessel is 'mug:x'"),
        ({"receptacle": "mugg"}, "receptacle is 'mugg'"),
        ({"reference": 3}, "reference is a int"),
        ({"reference": "nowhere.reference.npz"}, "nowhere.reference.npz does not exist"),
        ({"num_particles": 500, "liquid": Liquid(radius_m=0.01)}, "holds at most"),
    ],
)
def test_bad_arguments_are_answered_by_one_sentence(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        PandaPourEnv(**arguments)


def test_bad_reset_options_are_refused(env: PandaPourEnv) -> None:
    with pytest.raises(UserError, match="no option start_offset; it knows state, start_offset_m"):
        env.reset(options={"start_offset": (0, 0, 0)})
    with pytest.raises(UserError, match="three numbers in m"):
        env.reset(options={"start_offset_m": (0.1, 0.1)})
    with pytest.raises(UserError, match="out of the arm's reach"):
        env.reset(options={"start_offset_m": (1.0, 0.0, 0.0)})


def test_own_randomization_is_taken(mug_pour: Reference) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0, randomization=Randomization(receptacle_offset_m=(0.0, 0.0, 0.1)))
    heights = []
    for seed in range(5):
        env.reset(seed=seed)
        heights.append(env.T_world_receptacle[2, 3])
    assert np.ptp(heights) > 0.02


def test_pictures_show_the_liquid_and_repeat(mug_pour: Reference, play: Play) -> None:
    env = PandaPourEnv(
        mug_pour, num_particles=60, obs_mode="both", cameras=("front", "wrist", "side"), image_size=(96, 128)
    )
    first, _ = env.reset(seed=0)
    again, _ = env.reset(seed=0)
    assert equal(first["pixels"], again["pixels"])
    assert {name: picture.shape for name, picture in first["pixels"].items()} == dict.fromkeys(
        env.cameras, (96, 128, 3)
    )

    def watery(picture: np.ndarray) -> int:
        red, green, blue = picture[..., 0].astype(int), picture[..., 1].astype(int), picture[..., 2].astype(int)
        return int(np.count_nonzero((blue > red + 70) & (green > red + 40) & (blue > 150)))

    assert watery(first["pixels"]["wrist"]) > 60
    end_state = play(PandaPourEnv(mug_pour, num_particles=60))["state"]
    end, _ = env.reset(options={"state": end_state})
    assert watery(end["pixels"]["front"]) > 10, "the poured liquid is to be seen in the bowl"
    assert env.render() is None
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vessel", "receptacle", "tilt_deg"),
    [("tumbler", "bowl", 110.0), ("teapot", "mug", 70.0), ("jug", "saucepan", 125.0), ("bottle", "bowl", 125.0)],
)
def test_other_vessels_pour_too(vessel: str, receptacle: str, tilt_deg: float, play: Play) -> None:
    reference = pour_reference(make_vessel(vessel), make_vessel(receptacle), tilt_deg=tilt_deg)
    end = play(PandaPourEnv(reference, num_particles=50), seed=0)
    assert end["poured_fraction"] >= 0.7
    assert end["spilled_fraction"] <= 0.1
