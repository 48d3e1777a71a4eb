"""Fingers hold the vessel by friction alone: without slipping when they press, not at all when nothing rubs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from vid2demo.envs.builtin import arm_trajectory, pour_reference
from vid2demo.envs.holding import grip_points
from vid2demo.envs.liquid import Liquid
from vid2demo.envs.panda import PAD_M, PADS
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.envs.simulation import Simulation
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import transform_points
from vid2demo.extract.vessels import make_vessel

HANDLES = ("mug", "cup", "teapot", "jug", "milk_jug", "measuring_cup")
BODIES = ("beaker", "tumbler", "bottle", "thermos", "can")


@pytest.fixture(scope="module")
def env(mug_pour: Reference) -> PandaPourEnv:
    return PandaPourEnv(mug_pour, num_particles=20, grasp="friction")


def follow(env: PandaPourEnv, steps: int | None = None) -> tuple[float, dict[str, Any]]:
    """The greatest slip in m while the reference is followed open loop, and the last info."""
    q_rad = arm_trajectory(env.reference).astype(np.float32)
    env.reset(seed=0)
    slip_m, info = 0.0, {}
    for k in range(steps or env._max_episode_steps):
        *_, info = env.step(q_rad[min(k + 1, len(q_rad) - 1)])
        slip_m = max(slip_m, info["slip_m"])
    return slip_m, info


def test_a_mug_is_poured_without_slipping(env: PandaPourEnv) -> None:
    slip_m, info = follow(env)
    assert slip_m < 0.002
    assert info["slip_rad"] < np.deg2rad(1.0)
    assert info["poured_fraction"] == 1.0
    assert info["position_error_m"] < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("category", [*HANDLES, *BODIES])
def test_handles_and_bodies_are_held_through_a_pour_and_spill_no_more_than_welded(category: str) -> None:
    tilt_deg = 80.0 if category == "teapot" else 110.0
    reference = pour_reference(make_vessel(category), make_vessel("bowl"), tilt_deg=tilt_deg)
    slip_m, info = follow(PandaPourEnv(reference, num_particles=100, grasp="friction"))
    assert slip_m < 0.005
    welded = PandaPourEnv(reference, num_particles=100)
    welded.reset(seed=0)
    q_rad = arm_trajectory(reference).astype(np.float32)
    for k in range(welded._max_episode_steps):
        *_, held = welded.step(q_rad[min(k + 1, len(q_rad) - 1)])
    assert info["spilled_fraction"] <= held["spilled_fraction"] + 0.03
    assert abs(info["poured_fraction"] - held["poured_fraction"]) < 0.1


@pytest.fixture(scope="module")
def slippery(mug_pour: Reference) -> Simulation:
    simulation = Simulation(mug_pour, 0, Liquid(), 0.002, 20, grasp="friction")
    for pad in PADS:
        simulation.model.geom_friction[simulation.model.geom(pad).id] = [0.005, 0.0, 0.0]
    return simulation


def test_without_friction_the_vessel_slides_down_and_the_table_stops_it(slippery: Simulation) -> None:
    simulation = slippery
    higher = simulation.data.qpos[:7] + np.array([0.0, -0.25, 0.0, 0.0, 0.0, -0.25, 0.0])
    simulation.begin(higher, simulation.receptacle_m.copy())
    start_m = simulation.vessel_m[2]
    simulation.advance(np.repeat(higher[None], 1000, 0))
    simulation.refresh()
    assert simulation.vessel_m[2] < start_m - 0.05
    assert simulation.holding.slip()[0] > 0.02
    assert simulation.vessel_m[2] > 0.02, "the mug lies on the table, not in it"
    assert simulation.is_finite


def test_a_posed_vessel_is_at_rest_in_the_hand(env: PandaPourEnv) -> None:
    env.reset(seed=0)
    simulation = env.simulation
    assert simulation.holding.slip() == pytest.approx((0.0, 0.0), abs=1e-6)
    T = simulation.holding.T_hand_object
    assert np.linalg.norm(T[:3, 3] - env.reference.T_hand_object[:3, 3]) < 0.001
    simulation.advance(np.repeat(env.reference.q_start_rad[None], 50, 0))
    simulation.refresh()
    assert np.linalg.norm(simulation.twist[:3]) < 0.01
    assert simulation.holding.slip()[0] < 0.0005
    assert simulation.contacts() == (0, 0)


def test_the_free_vessels_velocity_is_the_engines(env: PandaPourEnv) -> None:
    follow(env, 40)
    simulation, vessel = env.simulation, env.model.body("vessel").id
    mujoco.mj_forward(env.model, env.data)
    engine = np.zeros(6)
    mujoco.mj_objectVelocity(env.model, env.data, int(mujoco.mjtObj.mjOBJ_XBODY), vessel, engine, 0)
    assert np.linalg.norm(engine[3:]) > 0.05
    np.testing.assert_allclose(simulation.twist, [*engine[3:], *engine[:3]], atol=1e-9)


def test_states_continue_exactly_and_resets_repeat(env: PandaPourEnv) -> None:
    def run(count: int) -> list[float]:
        return [float(env.step(action)[1]) for action in actions[:count]] + env.data.qpos.tolist()

    q_rad = arm_trajectory(env.reference).astype(np.float32)
    actions = q_rad[1:40]
    env.reset(seed=3)
    first = run(5)
    state = env.get_state()
    later = run(20)
    env.set_state(state)
    assert run(20) == later
    env.reset(seed=3)
    assert run(5) == first


def test_an_episode_may_begin_on_the_way_with_the_vessel_in_hand(env: PandaPourEnv) -> None:
    env.reset(seed=0, options={"start_index": 70, "start_offset_m": [0.01, 0.0, 0.0]})
    held_m, _ = env.simulation.holding.slip()
    assert held_m < 0.003
    _, _, _, _, info = env.step(arm_trajectory(env.reference).astype(np.float32)[71])
    assert info["slip_m"] < 0.004
    assert info["position_error_m"] < 0.01


def test_the_pads_touch_what_lies_between_them(mug_pour: Reference) -> None:
    points = transform_points(mug_pour.T_hand_object, grip_points(mug_pour.vessel(), mug_pour.T_hand_object))
    assert len(points) >= 8
    assert np.all(np.abs(points[:, 0]) < PAD_M[1][0] + 0.004)
    # The handle alone: the wall of the body is wider by far.
    assert np.abs(points[:, 1]).max() < 0.01


def test_a_welded_vessel_cannot_slip(mug_pour: Reference) -> None:
    simulation = Simulation(mug_pour, 0, Liquid(), 0.002, 20)
    simulation.begin(mug_pour.q_start_rad, mug_pour.T_world_receptacle[:3, 3])
    assert simulation.holding.slip() == (0.0, 0.0)


@pytest.mark.parametrize(
    ("moved", "problem"),
    [(lambda T: T + 0.5 * np.eye(4, k=3), "not between the fingers"), (lambda T: T, "wider than the hand")],
)
def test_what_the_fingers_cannot_close_on_is_refused(
    mug_pour: Reference, moved: Callable[[np.ndarray], np.ndarray], problem: str
) -> None:
    T = moved(np.array(mug_pour.T_hand_object))
    if problem.startswith("wider"):
        T = np.eye(4)  # the hand in the middle of the mug, whose walls are farther apart than the fingers
    with pytest.raises(UserError, match=problem):
        grip_points(mug_pour.vessel(), T)
