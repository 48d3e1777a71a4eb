"""Nothing passes a wall: vessels are shaken and turned over as fast as the arm's joints may move."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.envs.kinematics import arm_seeds, panda_chain, solve_ik
from vid2demo.envs.liquid import fill_positions
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.envs.vessel_geometry import collision_boxes
from vid2demo.extract.geometry import invert_pose, make_pose
from vid2demo.extract.vessels import CATEGORIES, make_vessel

SHAKE_S, AFTER_S = 0.8, 0.5


def still_reference(category: str, receptacle: str = "bowl") -> Reference:
    """The vessel held upright in the air by a horizontal hand, so that the last joint turns it over."""
    vessel, bowl = make_vessel(category), make_vessel(receptacle)
    hand = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    T_hand = make_pose(hand, (0.5, 0.0, 0.55))[None]
    q, error = solve_ik(np.repeat(T_hand, 5, 0), arm_seeds(T_hand)[:, 0], iterations=100, rest_gain=0.02)
    q_start = q[int(np.argmin(np.linalg.norm(error, axis=1)))]
    # The vessel's +y points along the hand, its +z up.
    T_object = make_pose(np.column_stack([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (0.5, 0.0, 0.55))
    T_receptacle = make_pose(None, (0.5, 0.5, bowl.extents_m[2] / 2))
    header = {
        "symmetry": vessel.symmetry.to_json(),
        "vessel": vessel_to_header(vessel),
        "receptacle": {**vessel_to_header(bowl), "T_world_receptacle": T_receptacle.tolist()},
        "T_hand_object": (invert_pose(panda_chain().hand(q_start[None])[0]) @ T_object).tolist(),
        "q_start_rad": q_start.tolist(),
    }
    return Reference.from_poses(np.repeat(T_object[None], 2, 0), np.arange(2) / 25, header)


def escapes(env: PandaPourEnv, seed: int) -> tuple[int, int]:
    """Shake and turn over; how many went through a wall and how many over the rim, checked every 4 ms."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    simulation = env.simulation
    simulation._conduit = None  # what leaves by the spout would count as leaked
    q_start = env.reference.q_start_rad
    amplitude, hz, phase = rng.uniform(0.05, 0.2, 7), rng.uniform(1.5, 4.0, 7), rng.uniform(0, 2 * np.pi, 7)
    turn_rad, turn_s = np.deg2rad(rng.uniform(100, 160)), rng.uniform(0.5, 1.0)
    turn_rad *= -1.0 if q_start[6] + turn_rad > 2.85 else 1.0
    cavity, radius_m = simulation.scene.vessel_cavity, simulation.scene.radius_m
    inside = np.full(simulation.scene.num_particles, True)
    through = 0
    commands = []
    for k in range(round((SHAKE_S + turn_s + AFTER_S) * env.control_hz)):
        t = k / env.control_hz
        wanted = q_start + amplitude * (np.sin(2 * np.pi * hz * t + phase) - np.sin(phase))
        wanted[6] = q_start[6] + turn_rad * minimum_jerk(np.array((t - SHAKE_S) / turn_s))
        commands.append(env._control.advance(wanted)[0].copy())
    for k, command in enumerate(np.concatenate(commands)):
        simulation.advance([command])
        if k % 2 == 0:
            simulation.refresh()
            T = env.T_world_object
            local = (env.particle_positions_m - T[:3, 3]) @ T[:3, :3]
            # Outside means clear of the hollow and of the walls: a hard hit sinks in for a moment and comes back.
            left = np.flatnonzero(inside & (cavity.clearance_m(local) < -radius_m))
            left = left[np.min([box.distance_m(local[left]) for box in simulation.scene.vessel_boxes], axis=0) > 0.0]
            through += int(np.count_nonzero(local[left, 2] < cavity.rim_m - 1.5 * radius_m))
            inside[left] = False
    return through, int(np.count_nonzero(~inside))


@pytest.mark.parametrize("category", ["mug", "gooseneck_kettle"])
def test_shaking_and_turning_over_leaks_nothing(category: str) -> None:
    env = PandaPourEnv(still_reference(category), num_particles=50)
    through, over = escapes(env, seed=0)
    assert through == 0
    assert over == (0 if category == "gooseneck_kettle" else 50), "an open vessel empties, a closed one stays full"


@pytest.mark.slow
@pytest.mark.parametrize("category", CATEGORIES)
def test_no_category_leaks(category: str) -> None:
    env = PandaPourEnv(still_reference(category), num_particles=100)
    assert [escapes(env, seed)[0] for seed in range(2)] == [0, 0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", [50, 100, 300])
@pytest.mark.parametrize("category", CATEGORIES)
def test_twenty_violent_motions_of_any_vessel_leak_nothing(category: str, count: int) -> None:
    env = PandaPourEnv(still_reference(category), num_particles=count)
    assert [escapes(env, seed)[0] for seed in range(20)] == [0] * 20


@pytest.mark.parametrize(
    "category",
    [
        category if category in ("mug", "bowl", "carton") else pytest.param(category, marks=pytest.mark.slow)
        for category in CATEGORIES
    ],
)
def test_what_stands_still_stays_still_and_gains_no_energy(category: str) -> None:
    env = PandaPourEnv(still_reference(category), num_particles=100)
    simulation, action = env.simulation, env.reference.q_start_rad.astype(np.float32)
    env.reset(seed=0)
    speeds = []
    for _ in range(75):
        env.step(action)
        speeds.append(np.linalg.norm(simulation.particle_velocities_m_s, axis=1).max())
    assert max(speeds[25:]) < 0.02, "at rest within a second, and for good"
    assert simulation.share[0] == 1.0


@pytest.mark.parametrize("category", ["mug", "bowl", "wine_glass", "carton"])
def test_what_falls_hard_into_a_receptacle_stays_in_it(category: str) -> None:
    env = PandaPourEnv(still_reference("gooseneck_kettle", category), num_particles=60)
    env.reset(seed=0)
    simulation, scene = env.simulation, env.simulation.scene
    cavity, T = scene.receptacle_cavity, env.T_world_receptacle
    boxes = collision_boxes(scene.receptacle, cavity)
    places = fill_positions(cavity, boxes, 60, scene.radius_m, category)
    simulation.particles_m[:] = places @ T[:3, :3].T + T[:3, 3]
    simulation.particle_velocities_m_s[:] = [0.2, 0.1, -1.5]  # a fall from 11 cm
    for _ in range(15):
        _, _, _, _, info = env.step(env.reference.q_start_rad.astype(np.float32))
    assert info["poured_fraction"] > 0.95
    local = (env.particle_positions_m - T[:3, 3]) @ T[:3, :3]
    below = (local[:, 2] < cavity.z_m[0]) & (np.linalg.norm(local[:, :2] - cavity.axis_xy_m, axis=1) < cavity.reach_m)
    outside = cavity.clearance_m(local) < 0
    assert not np.any(below & outside & (env.particle_positions_m[:, 2] < 0.0))
