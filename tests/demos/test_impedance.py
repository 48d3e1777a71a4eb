"""The object is where the reference says, whatever the hand does with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from vid2demo.demos.impedance import MOST_RAD, ImpedancePlayer
from vid2demo.demos.retarget import retarget
from vid2demo.demos.rollout import DEFAULT_ENV_ID, make_env, roll_out
from vid2demo.envs.builtin import builtin_reference
from vid2demo.envs.reference import Reference, vessel_to_header
from vid2demo.extract.geometry import Array
from vid2demo.extract.vessels import make_vessel


@pytest.fixture(scope="module")
def reference() -> Reference:
    return builtin_reference()


def played(reference: Path | Reference, player: ImpedancePlayer, **kwargs: Any) -> tuple[Array, Array]:
    """Errors (N,) in m and rad along the reference, at the end of each step."""
    env = make_env(DEFAULT_ENV_ID, reference, num_particles=0, control_mode="joint_position", **kwargs)
    errors: list[tuple[float, float]] = []
    roll_out(
        env,
        player,
        seed=0,
        on_step=lambda k, action, before, reward, info: errors.append(
            (info["position_error_m"], info["rotation_error_rad"])
        ),
    )
    env.close()
    along = np.array(errors)[: len(builtin_reference()) - 1]
    return along[:, 0], along[:, 1]


def test_the_object_stays_within_a_millimetre_and_closer_than_open_loop(reference: Reference) -> None:
    joints = retarget(reference)
    closed_m, closed_rad = played(reference, ImpedancePlayer(joints))
    open_m, open_rad = played(reference, ImpedancePlayer(joints, gain=0.0))
    assert closed_m.max() < 1e-3
    assert closed_rad.max() < np.deg2rad(0.5)
    assert closed_m.mean() < 0.7 * open_m.mean()
    assert closed_rad.mean() < open_rad.mean()


def test_an_object_that_has_turned_in_the_fingers_is_brought_back(reference: Reference) -> None:
    """Fingers give way a little under the mug's weight; the arm makes up for it."""
    position_m, rotation_rad = played(reference, ImpedancePlayer(), grasp="friction")
    loose_m, loose_rad = played(reference, ImpedancePlayer(gain=0.0), grasp="friction")
    settled = slice(25, None)
    assert position_m[settled].mean() < 0.5 * loose_m[settled].mean()
    assert rotation_rad[settled].mean() < 0.5 * loose_rad[settled].mean()
    assert position_m[settled].max() < 1e-3


class _Stand:
    """An environment's outside: an object that is wherever it is told to be."""

    def __init__(self, reference: Reference, T: Array) -> None:
        env = make_env(DEFAULT_ENV_ID, reference, num_particles=0)
        self.unwrapped, self.action_space = self, env.action_space
        self.reference, self.model, self.T_world_object = reference, env.unwrapped.model, T
        env.close()


def moved(reference: Reference, T: Array, steps: int = 20) -> NDArray[np.float64]:
    """(steps, 7) targets for an object that does not answer."""
    player, stand = ImpedancePlayer(), _Stand(reference, T)
    observation = {"agent_pos": reference.q_start_rad}
    player.reset(stand, observation, {})
    return np.array([player.act(observation) for _ in range(steps)], float)


def still(reference: Reference, knots: int = 30) -> Reference:
    T = np.tile(reference.T_world_object[:1], (knots, 1, 1))
    return Reference.from_poses(T, np.arange(knots) / 25.0, reference.header)


def test_a_correction_is_slow_and_a_dropped_object_is_not_chased(reference: Reference) -> None:
    waiting = still(reference)
    near, far = (waiting.T_world_object[0].copy() for _ in range(2))
    near[0, 3] += 0.05
    far[2, 3] -= 0.5
    steps = np.diff(moved(waiting, near), axis=0)
    assert np.abs(steps).max() == pytest.approx(MOST_RAD, rel=0.01)
    np.testing.assert_allclose(np.diff(moved(waiting, far), axis=0), 0.0, atol=1e-6)


def test_the_turn_of_a_round_vessel_is_not_mended(reference: Reference) -> None:
    for name, answers in (("tumbler", False), ("mug", True)):
        vessel = make_vessel(name)
        waiting = still(reference).with_header(vessel=vessel_to_header(vessel), symmetry=vessel.symmetry.to_json())
        T = waiting.T_world_object[0].copy()
        c, s = np.cos(0.3), np.sin(0.3)
        T[:3, :3] = T[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        assert bool(np.abs(np.diff(moved(waiting, T), axis=0)).max() > 1e-3) is answers
