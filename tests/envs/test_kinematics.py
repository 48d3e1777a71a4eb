from __future__ import annotations

import mujoco
import numpy as np
import pytest
from vid2demo.envs.kinematics import (
    HAND_BODY,
    arm_seeds,
    configuration_near,
    hand_jacobian,
    limit_margin_rad,
    manipulability,
    panda_chain,
    pose_error,
    solve_ik,
)
from vid2demo.envs.panda import Q_HOME_RAD, Q_MAX_RAD, Q_MIN_RAD, panda_spec
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose


def test_chain_and_jacobian_agree_with_the_simulator() -> None:
    model = panda_spec(visuals=False).compile()
    data = mujoco.MjData(model)
    hand = model.body(HAND_BODY).id
    q = np.random.default_rng(0).uniform(Q_MIN_RAD, Q_MAX_RAD, (20, 7))
    T, J = panda_chain().hand(q), hand_jacobian(panda_chain().frames(q))
    position, rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for k in range(20):
        data.qpos[:7] = q[k]
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBody(model, data, position, rotation, hand)
        np.testing.assert_allclose(T[k, :3, 3], data.xpos[hand], atol=1e-12)
        np.testing.assert_allclose(T[k, :3, :3], data.xmat[hand].reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(J[k], np.vstack([position, rotation])[:, :7], atol=1e-12)


def test_inverse_finds_reachable_poses_inside_the_limits() -> None:
    rng = np.random.default_rng(1)
    q = np.clip(Q_HOME_RAD + rng.uniform(-0.8, 0.8, (200, 7)), Q_MIN_RAD + 0.1, Q_MAX_RAD - 0.1)
    T = panda_chain().hand(q)
    found = np.zeros(200, bool)
    for seed in arm_seeds(T):
        solved, error = solve_ik(T, seed, iterations=40)
        assert limit_margin_rad(solved).min() >= 0.0199
        np.testing.assert_allclose(error, pose_error(panda_chain().hand(solved), T), atol=1e-12)
        found |= np.abs(error).max(axis=1) < 1e-3
    assert found.mean() > 0.98


def test_redundancy_draws_near_the_rest_posture_without_leaving_the_pose() -> None:
    T = panda_chain().hand(Q_HOME_RAD)
    turned, _ = solve_ik(T, Q_HOME_RAD[None] + 0.3, iterations=80, q_rest_rad=Q_HOME_RAD, rest_gain=0.5, damping=1e-3)
    np.testing.assert_allclose(turned[0], Q_HOME_RAD, atol=1e-3)


def test_manipulability_shrinks_with_the_elbow_stretched() -> None:
    stretched = np.array([[0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert manipulability(stretched)[0] < 5e-3 < 0.05 < manipulability(Q_HOME_RAD[None])[0]


def test_out_of_reach_is_said_with_place_and_distance() -> None:
    T = panda_chain().hand(Q_HOME_RAD)[0]
    near = configuration_near(T @ make_pose(None, (0.02, 0.0, 0.0)), np.eye(4), Q_HOME_RAD)
    assert np.abs(near - Q_HOME_RAD).max() < 0.2
    far = T.copy()
    far[:3, 3] += [1.0, 0.0, 0.0]
    with pytest.raises(UserError, match=r"\(1\.\d\d, .*out of the arm's reach by \d+ mm"):
        configuration_near(far, np.eye(4), Q_HOME_RAD)
