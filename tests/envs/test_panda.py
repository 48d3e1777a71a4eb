from __future__ import annotations

import mujoco
import numpy as np
import pytest
from vid2demo.envs import panda
from vid2demo.envs.builtin import arm_trajectory
from vid2demo.envs.contacts import RobotContacts
from vid2demo.envs.liquid import Liquid
from vid2demo.envs.reference import Reference
from vid2demo.envs.scene import build_scene


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


def test_capsules_stay_within_two_centimetres_of_the_collision_meshes() -> None:
    import trimesh

    folder = panda._description_folder() / "meshes" / "collision"
    for link, (start, end, radius_m) in panda.CAPSULES_M.items():
        hull = trimesh.load(folder / f"{link.removeprefix('panda_')}.stl").convex_hull
        a, b = np.array(start), np.array(end)
        points = np.asarray(trimesh.sample.sample_surface(hull, 500, seed=0)[0])
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)[:, None]
        uncovered_m = np.linalg.norm(points - (a + along * (b - a)), axis=1) - radius_m
        assert uncovered_m.max() < (0.022 if link == "panda_link0" else 0.016), link
        if link != "panda_link0":  # its capsule ends in the table, where nothing can come
            ball = trimesh.creation.icosphere(subdivisions=2, radius=radius_m).vertices
            shell = np.concatenate([ball + a + t * (b - a) for t in (0.0, 0.5, 1.0)])
            offsets = np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
            assert (shell @ hull.face_normals.T - offsets).max(axis=1).max() < 0.02, link


def test_the_arm_collides_with_itself_when_folded_and_not_at_home(model: mujoco.MjModel) -> None:
    data, contacts = mujoco.MjData(model), RobotContacts(model)
    data.qpos[:9] = [*panda.Q_HOME_RAD, 0.04, 0.04]
    mujoco.mj_forward(model, data)
    assert (data.ncon, contacts.count(data)) == (0, (0, 0))
    data.qpos[:7] = [0.0, 1.7, 0.0, -3.0, 0.0, 3.7, 0.8]
    mujoco.mj_forward(model, data)
    itself, furniture = contacts.count(data)
    assert itself > 0
    assert furniture == 0, "there is no table in the robot's own spec"


def test_torque_motors_hold_against_gravity_and_push_no_harder_than_they_may() -> None:
    torque = panda.panda_spec(visuals=False, actuation="torque").compile()
    torque.opt.timestep = 0.002
    data = mujoco.MjData(torque)
    data.qpos[:7] = panda.Q_HOME_RAD
    mujoco.mj_step(torque, data, 500)
    np.testing.assert_allclose(data.qpos[:7], panda.Q_HOME_RAD, atol=1e-3)
    mujoco.mj_resetData(torque, data)
    data.qpos[:7] = panda.Q_HOME_RAD
    data.ctrl[:7] = 1e4
    mujoco.mj_forward(torque, data)
    np.testing.assert_allclose(data.actuator_force[:7], panda.TAU_MAX_NM)
    assert np.all(np.abs(data.qfrc_actuator[:7]) <= panda.TAU_MAX_NM + 1e-9)


def test_fingers_press_with_seventy_newton_at_most_and_stop_at_their_ends(model: mujoco.MjModel) -> None:
    model.opt.timestep = 0.002
    data = mujoco.MjData(model)
    data.qpos[:9] = [*panda.Q_HOME_RAD, 0.03, 0.03]
    data.ctrl[:9] = [*panda.Q_HOME_RAD, -1.0, -1.0]
    mujoco.mj_step(model, data, 300)
    np.testing.assert_allclose(data.actuator_force[7:9], -panda.FINGER_MAX_N)
    np.testing.assert_allclose(data.qpos[7:9], 0.0, atol=2e-3)


def test_the_built_in_pour_touches_nothing_and_a_low_hand_touches_the_table(mug_pour: Reference) -> None:
    scene = build_scene(mug_pour, 0, Liquid(), 0.002)
    data, contacts = mujoco.MjData(scene.model), RobotContacts(scene.model)
    hull = scene.model.geom("vessel_hull").id
    for q_rad in arm_trajectory(mug_pour)[::5]:
        data.qpos[:7] = q_rad
        mujoco.mj_forward(scene.model, data)
        assert contacts.count(data) == (0, 0)
    # The mug is pressed onto the table it stood on: it stays above, and that is told.
    data.qpos[:7] = data.ctrl[:7] = mug_pour.q_start_rad
    data.ctrl[1] += 0.15
    mujoco.mj_step(scene.model, data, 300)
    assert contacts.count(data)[1] > 0
    touching = {int(geom) for contact in data.contact for geom in contact.geom}
    assert hull in touching
    bottom_m = data.body("vessel").xpos[2] - scene.vessel.extents_m[2] / 2
    assert bottom_m > -0.012
