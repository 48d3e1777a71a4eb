from __future__ import annotations

import mujoco
import numpy as np
import pytest
from vid2demo.envs import panda


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return panda.panda_spec().compile()


def test_limits_named_in_code_are_those_of_the_urdf(model: mujoco.MjModel) -> None:
    joints = [model.joint(name) for name in panda.ARM_JOINTS]
    np.testing.assert_allclose([j.range[0] for j in joints], panda.Q_MIN_RAD)
    np.testing.assert_allclose([j.range[1] for j in joints], panda.Q_MAX_RAD)
    np.testing.assert_allclose([model.jnt_actfrcrange[j.id][1] for j in joints], panda.TAU_MAX_NM)
    assert np.all(panda.Q_HOME_RAD > panda.Q_MIN_RAD)
    assert np.all(panda.Q_HOME_RAD < panda.Q_MAX_RAD)


def test_tcp_lies_between_the_fingertips_and_points_down_at_home(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.qpos[:7] = panda.Q_HOME_RAD
    mujoco.mj_forward(model, data)
    tcp = data.site(panda.TCP_SITE)
    fingers = (data.body("panda_leftfinger").xpos + data.body("panda_rightfinger").xpos) / 2
    np.testing.assert_allclose(tcp.xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-3)
    np.testing.assert_allclose((tcp.xpos - fingers)[:2], 0, atol=1e-4)
    assert 0.25 < tcp.xpos[0] < 0.35


def test_gravity_does_not_move_a_robot_that_holds_its_posture(model: mujoco.MjModel) -> None:
    model.opt.timestep, model.opt.integrator = 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    data.qpos[:7] = data.ctrl[:7] = [0.3, 0.4, -0.2, -1.5, 0.1, 2.0, 0.5]
    start = data.qpos.copy()
    mujoco.mj_step(model, data, 500)
    np.testing.assert_allclose(data.qpos, start, atol=1e-4)


def test_servos_follow_a_slow_motion_within_two_millimetres(model: mujoco.MjModel) -> None:
    model.opt.timestep, model.opt.integrator = 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, ideal = mujoco.MjData(model), mujoco.MjData(model)
    direction = np.array([0.6, 0.3, -0.4, 0.4, 0.3, -0.3, 0.5])

    def target(time_s: float) -> np.ndarray:
        return panda.Q_HOME_RAD + 0.4 * direction * (1 - np.cos(time_s))  # up to 0.24 rad/s in a joint

    data.qpos[:7] = target(0.0)
    worst_m, period_s = 0.0, 0.04
    for k in range(75):
        start, end = target(k * period_s), target((k + 1) * period_s)
        for i in range(1, 21):
            command = panda.joint_command(start + (end - start) * i / 20, (end - start) / period_s)
            data.ctrl[:7] = command
            mujoco.mj_step(model, data)
        ideal.qpos[:7] = target((k + 1) * period_s)
        mujoco.mj_kinematics(model, ideal)
        mujoco.mj_kinematics(model, data)
        worst_m = max(worst_m, float(np.linalg.norm(data.site("tcp").xpos - ideal.site("tcp").xpos)))
    assert worst_m < 0.002


def test_visuals_are_light_and_can_be_left_out(model: mujoco.MjModel) -> None:
    bare = panda.panda_spec(visuals=False).compile()
    assert bare.nq == model.nq
    drawn = [g for g in range(model.ngeom) if model.geom_group[g] == 2]
    faces = sum(int(model.mesh_facenum[model.geom_dataid[g]]) for g in drawn)
    assert 3000 < faces < 25000
    assert {model.body(model.geom_bodyid[g]).name for g in drawn} == set(panda.LINKS)
    assert all(model.geom_contype[g] == 0 and model.geom_conaffinity[g] == 0 for g in drawn)


def test_visuals_come_from_the_cache_the_second_time(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tiny = {"hand_white.vertices": np.eye(4, 3, dtype=np.float32), "hand_white.faces": np.array([[0, 1, 2]], np.int32)}
    monkeypatch.setattr(panda, "_decimated_visuals", lambda: tiny)
    panda._visual_meshes.cache_clear()
    try:
        panda._visual_meshes()
        assert [p.suffix for p in (tmp_path / "vid2demo").iterdir()] == [".npz"]
        panda._visual_meshes.cache_clear()
        monkeypatch.setattr(panda, "_decimated_visuals", lambda: pytest.fail("cache was not used"))
        np.testing.assert_array_equal(panda._visual_meshes()["hand_white"][1], [[0, 1, 2]])
    finally:
        panda._visual_meshes.cache_clear()
