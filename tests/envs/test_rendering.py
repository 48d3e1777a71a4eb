"""Cameras, one's own and built in, and what is drawn over their pictures."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from vid2demo.envs.cameras import CAMERAS, CameraPose, add_cameras, chosen_cameras
from vid2demo.envs.overlays import OVERLAYS, Hud, Overlay, Overlays, overlay_names, write_hud
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.envs.rendering import Cameras
from vid2demo.envs.scene import FLOOR_Z_M
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array, look_at, project

SIZE = (120, 160)
HUD = Hud(1.5, 0.5, 0.25, 0.012, 0.1)


@pytest.fixture(scope="module")
def full(mug_pour: Reference) -> Iterator[PandaPourEnv]:
    env = PandaPourEnv(mug_pour, num_particles=20)
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def empty(mug_pour: Reference) -> Iterator[PandaPourEnv]:
    env = PandaPourEnv(mug_pour, num_particles=0)
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pictures(full: PandaPourEnv) -> Iterator[Cameras]:
    made = Cameras(full.model)
    yield made
    made.close()


@pytest.fixture
def drawn(empty: PandaPourEnv) -> Iterator[Cameras]:
    made = Cameras(empty.model)
    yield made
    made.close()


def intrinsics(model: mujoco.MjModel, camera: str, size: tuple[int, int]) -> tuple[Array, Array]:
    """T_camera_world (4, 4) and camera matrix (3, 3) of a camera of a model, with OpenCV's axes."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    number = model.camera(camera).id
    T = np.eye(4)
    T[:3, :3] = data.cam_xmat[number].reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = data.cam_xpos[number]
    focal = size[0] / 2 / math.tan(math.radians(model.cam_fovy[number]) / 2)
    # The middle of the picture lies between pixels, pixel 0's centre at 0.
    K = np.array([[focal, 0, size[1] / 2 - 0.5], [0, focal, size[0] / 2 - 0.5], [0, 0, 1]])
    return np.linalg.inv(T), K


def changed(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> Array:
    """(K, 2) pixels (x, y) in which two pictures differ by more than rounding."""
    rows, columns = np.nonzero(np.abs(one.astype(int) - other).max(axis=2) > 3)
    return np.column_stack([columns, rows]).astype(float)


def on_picture(model: mujoco.MjModel, camera: str, point_m: Array) -> Array:
    T_camera_world, K = intrinsics(model, camera, SIZE)
    return np.asarray(project(K, (T_camera_world[:3, :3] @ point_m + T_camera_world[:3, 3])[None])[0])


# ---------------------------------------------------------------------- pictures


def test_pictures_are_of_the_wanted_size_and_repeat_bit_for_bit(empty: PandaPourEnv, drawn: Cameras) -> None:
    first = {(c, size): drawn.picture(empty.data, c, size) for c in CAMERAS for size in (SIZE, (96, 96), (240, 320))}
    for (camera, size), picture in first.items():
        assert picture.shape == (*size, 3)
        assert picture.dtype == np.uint8
        assert picture.flags.c_contiguous
        assert picture.std() > 10
        assert np.array_equal(drawn.picture(empty.data, camera, size), picture)


def test_pictures_stand_upright(empty: PandaPourEnv, drawn: Cameras) -> None:
    picture = drawn.picture(empty.data, "side", SIZE).astype(int)
    top, bottom = picture[:8].mean(axis=(0, 1)), picture[-8:].mean(axis=(0, 1))
    assert top[2] > top[0]  # sky
    assert bottom[0] > bottom[2] + 20  # wood


def test_a_picture_is_not_the_buffer_of_the_next(empty: PandaPourEnv, drawn: Cameras) -> None:
    front = drawn.picture(empty.data, "front", SIZE)
    kept = front.copy()
    drawn.picture(empty.data, "wrist", SIZE)
    assert np.array_equal(front, kept)


def test_scenes_draw_side_by_side_and_outlive_each_other(full: PandaPourEnv, empty: PandaPourEnv) -> None:
    one, other = Cameras(full.model), Cameras(empty.model)
    alone = one.picture(full.data, "wrist", SIZE), other.picture(empty.data, "wrist", SIZE)
    for _ in range(2):
        assert np.array_equal(one.picture(full.data, "wrist", SIZE), alone[0])
        assert np.array_equal(other.picture(empty.data, "wrist", SIZE), alone[1])
    one.close()
    assert np.array_equal(other.picture(empty.data, "wrist", SIZE), alone[1])
    assert np.array_equal(one.picture(full.data, "wrist", SIZE), alone[0])
    one.close()
    other.close()


def test_particles_beside_the_model_look_like_the_model_s(
    full: PandaPourEnv, pictures: Cameras, empty: PandaPourEnv, drawn: Cameras
) -> None:
    engine = pictures.picture(full.data, "wrist", (240, 320))
    particles = full.particle_positions_m, full.simulation.scene.radius_m
    for _ in range(2):
        beside = drawn.picture(empty.data, "wrist", (240, 320), particles)
        assert len(changed(engine, beside)) == 0
    assert len(changed(beside, drawn.picture(empty.data, "wrist", (240, 320)))) > 500


def test_more_and_fewer_particles_leave_none_behind(empty: PandaPourEnv, drawn: Cameras) -> None:
    points = np.array([[0.5, 0.0, 0.3], [0.5, 0.1, 0.3], [0.45, 0.05, 0.35]])
    two = drawn.picture(empty.data, "front", SIZE, (points[:2], 0.02))
    three = drawn.picture(empty.data, "front", SIZE, (points, 0.02))
    assert len(changed(two, three)) > 10
    assert np.array_equal(drawn.picture(empty.data, "front", SIZE, (points[:2], 0.02)), two)
    assert len(changed(drawn.picture(empty.data, "front", SIZE, (points[:2], 0.03)), two)) > 10
    assert len(changed(drawn.picture(empty.data, "front", SIZE, (points[:0], 0.02)), two)) > 10


@pytest.mark.parametrize("camera", ["front", "side"])
def test_built_in_cameras_see_vessel_and_receptacle_all_along(camera: str, empty: PandaPourEnv) -> None:
    T_camera_world, K = intrinsics(empty.model, camera, SIZE)
    path = np.vstack([empty.reference.T_world_object[:, :3, 3], empty.T_world_receptacle[:3, 3]])
    pixels = project(K, path @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])
    assert np.all(pixels > 0.08 * SIZE[0])
    assert np.all(pixels < np.array(SIZE[::-1]) - 0.08 * SIZE[0])


# ---------------------------------------------------------------------- one's own camera


def test_own_camera_sees_a_point_where_its_pose_says(empty: PandaPourEnv) -> None:
    eye, target = np.array([1.1, -0.4, 0.6]), np.array([0.5, 0.0, 0.15])
    pose = CameraPose("mine", look_at(eye, target, np.array([0.0, 0.0, 1.0])), 50.0)
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="panda_hand_tcp")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1], pos=[0, 0, FLOOR_Z_M])
    spec.visual.headlight.active = True
    add_cameras(spec, empty.reference, empty.reference.vessel(), (pose,))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    cameras = Cameras(model)
    assert {model.camera(i).name for i in range(model.ncam)} == {*CAMERAS, "mine"}
    assert np.allclose(np.linalg.inv(intrinsics(model, "mine", SIZE)[0]), pose.T_world_camera)
    blank = cameras.picture(data, "mine", SIZE)
    for point in (target, target + np.array([0.1, 0.05, 0.08]), target - np.array([0.05, 0.12, 0.02])):
        seen = changed(blank, cameras.picture(data, "mine", SIZE, (point[None], 0.02)))
        assert np.linalg.norm(seen.mean(axis=0) - on_picture(model, "mine", point)) < 0.7
    cameras.close()


def test_cameras_may_be_names_poses_and_mappings() -> None:
    mine = CameraPose("mine", np.eye(4))
    names, own = chosen_cameras(("wrist", mine, {"name": "top", "T_world_camera": np.eye(4).tolist()}, "front"))
    assert names == ("wrist", "mine", "top", "front")
    assert [camera.name for camera in own] == ["mine", "top"]
    assert chosen_cameras(("side",)) == (("side",), ())


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ((), "give a tuple"),
        ("front", "give a tuple"),
        (("back",), "'back'"),
        ((3,), "3"),
        (("front", "front"), "once"),
        ((CameraPose("a", np.eye(4)), {"name": "a", "T_world_camera": np.eye(4)}), "once"),
        (({"name": "a"},), "T_world_camera"),
        (({"name": "a", "T_world_camera": np.eye(4), "zoom": 2},), "zoom"),
    ],
)
def test_cameras_that_make_no_sense_are_refused(cameras: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        chosen_cameras(cameras)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"name": "front"}, "built-in"),
        ({"name": "a/b"}, "underscores"),
        ({"name": ""}, "underscores"),
        ({"T_world_camera": np.eye(3)}, "rigid"),
        ({"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid"),
        ({"T_world_camera": 2 * np.eye(4)}, "rigid"),
        ({"T_world_camera": np.full((4, 4), np.nan)}, "rigid"),
        ({"T_world_camera": "here"}, "numbers"),
        ({"fovy_deg": 0.0}, "fovy_deg"),
        ({"fovy_deg": math.nan}, "fovy_deg"),
        ({"fovy_deg": "wide"}, "fovy_deg"),
    ],
)
def test_own_cameras_that_make_no_sense_are_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        CameraPose(**{"name": "mine", "T_world_camera": np.eye(4), **fields})


# ---------------------------------------------------------------------- overlays


def test_overlays_are_drawn_and_leave_no_trace(full: PandaPourEnv, pictures: Cameras) -> None:
    before = full.get_state()
    plain = pictures.picture(full.data, "front", SIZE)
    ghost = full.T_world_object
    ghost[:3, 3] += [0.0, 0.12, 0.08]
    trail = np.linspace(ghost[:3, 3], full.T_world_object[:3, 3] + [0, 0, 0.1], 10)
    for overlay in (Overlay(T_world_ghost=ghost), Overlay(trail_m=trail), Overlay(hud=HUD)):
        assert len(changed(plain, pictures.picture(full.data, "front", SIZE, overlay=overlay))) > 30
    assert np.array_equal(pictures.picture(full.data, "front", SIZE), plain)
    assert np.array_equal(pictures.picture(full.data, "front", SIZE, overlay=Overlay()), plain)
    after = full.get_state()
    assert all(np.array_equal(before["simulation"][name], value) for name, value in after["simulation"].items())


def test_ghost_stands_at_the_reference_s_pose_and_lets_the_scene_through(empty: PandaPourEnv, drawn: Cameras) -> None:
    plain = drawn.picture(empty.data, "side", SIZE)
    T = empty.T_world_object
    T[:3, 3] += [0.0, 0.02, 0.15]
    # Half a turn about the upright axis brings the handle to the other side.
    turned = T.copy()
    turned[:3, :2] *= -1
    pictures = [drawn.picture(empty.data, "side", SIZE, overlay=Overlay(T_world_ghost=pose)) for pose in (T, turned)]
    assert len(changed(*pictures)) > 10
    seen = changed(plain, pictures[0])
    assert np.linalg.norm(np.median(seen, axis=0) - on_picture(empty.model, "side", T[:3, 3])) < 6
    x, y = np.median(seen, axis=0).astype(int)
    assert pictures[0][y, x, 1] > plain[y, x, 1] * 0.6  # translucent, not opaque


def test_trail_runs_through_its_points(empty: PandaPourEnv, drawn: Cameras) -> None:
    points = np.array([[0.45, -0.2, 0.25], [0.5, 0.0, 0.28], [0.5, 0.2, 0.3]])
    plain = drawn.picture(empty.data, "front", SIZE)
    seen = changed(plain, drawn.picture(empty.data, "front", SIZE, overlay=Overlay(trail_m=points)))
    for point in points:
        assert np.linalg.norm(seen - on_picture(empty.model, "front", point), axis=1).min() < 3
    one_point = drawn.picture(empty.data, "front", SIZE, overlay=Overlay(trail_m=points[:1]))
    assert np.array_equal(one_point, plain)


@pytest.mark.parametrize("size", [(16, 16), (96, 96), (96, 640), (480, 640), (1080, 1920)])
def test_hud_fits_every_picture_and_its_bar_tells_the_fractions(size: tuple[int, int]) -> None:
    def coloured(hud: Hud, rgb: tuple[int, int, int]) -> int:
        picture = np.full((*size, 3), 127, np.uint8)
        write_hud(picture, hud)
        return int(np.count_nonzero(np.all(picture == rgb, axis=2)))

    poured, spilled = (74, 163, 255), (255, 107, 87)
    half, full_bar = (coloured(Hud(0, part, 0, 0, 0), poured) for part in (0.5, 1.0))
    assert 0.35 < half / full_bar < 0.65
    assert coloured(Hud(0, 0, 0, 0, 0), poured) == 0
    assert coloured(Hud(0, 0.5, 0.5, 0, 0), spilled) == full_bar - half


def test_trail_remembers_about_a_second_and_forgets_on_restart() -> None:
    overlays = Overlays(("trail", "hud"), control_hz=10)
    overlays.restart()
    lip_m = np.zeros(3)
    for k in range(30):
        lip_m[0] = k
        overlays.record(lip_m)
    now = overlays.at(np.eye(4), HUD)
    assert now is not None
    assert now.trail_m is not None
    assert np.allclose(now.trail_m[:, 0], np.arange(19, 30))
    assert now.T_world_ghost is None
    assert now.hud is HUD
    overlays.restart()
    again = overlays.at(np.eye(4), HUD)
    assert again is not None
    assert again.trail_m is not None
    assert len(again.trail_m) == 0


def test_no_overlay_is_the_default_choice() -> None:
    assert Overlays((), 25).at(np.eye(4), HUD) is None
    assert overlay_names(OVERLAYS) == OVERLAYS


@pytest.mark.parametrize("names", ["hud", ("shadow",), ("hud", "hud")])
def test_unknown_overlays_are_refused(names: Any) -> None:
    with pytest.raises(UserError, match="ghost, trail, hud"):
        overlay_names(names)


# ---------------------------------------------------------------------- in the environment


def test_render_draws_the_overlays_and_the_observations_stay_free_of_them(mug_pour: Reference) -> None:
    common: dict[str, Any] = {"num_particles": 5, "obs_mode": "both", "image_size": SIZE, "render_size": SIZE}
    top = CameraPose("top", look_at(np.array([0.5, 0.0, 1.2]), np.array([0.5, 0.01, 0.0]), np.array([0.0, 1.0, 0.0])))
    pictures, observations = {}, {}
    for overlays in ((), OVERLAYS):
        env = PandaPourEnv(
            mug_pour, **common, cameras=("side", top), render_mode="rgb_array", render_camera="top", overlays=overlays
        )
        env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step(np.asarray(mug_pour.q_start_rad + 0.05, np.float32))
        pictures[overlays], observations[overlays] = env.render(), observation["pixels"]
        env.close()
    assert set(observations[()]) == {"side", "top"}
    for camera in ("side", "top"):
        assert np.array_equal(observations[()][camera], observations[OVERLAYS][camera])
    plain, drawn = pictures[()], pictures[OVERLAYS]
    assert plain is not None
    assert drawn is not None
    assert np.array_equal(plain, observations[()]["top"])
    assert len(changed(plain, drawn)) > 100


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"render_mode": "ansi"}, "render_mode"),
        ({"render_camera": "top"}, "render_camera"),
        ({"overlays": ("fog",)}, "overlays"),
        ({"cameras": ("back",)}, "camera"),
    ],
)
def test_rendering_arguments_are_checked(arguments: dict[str, Any], said: str, mug_pour: Reference) -> None:
    with pytest.raises(UserError, match=said):
        PandaPourEnv(mug_pour, num_particles=0, **arguments)


@pytest.mark.slow
def test_forked_process_draws_what_its_parent_drew() -> None:
    code = """
import multiprocessing
from vid2demo.envs.pouring import PandaPourEnv

def take(queue):
    env = PandaPourEnv(num_particles=0, obs_mode="pixels", image_size=(32, 48))
    queue.put(env.reset(seed=0)[0]["pixels"]["front"].tobytes())

context = multiprocessing.get_context("fork")
queue = context.Queue()
take(queue)
child = context.Process(target=take, args=(queue,), daemon=True)
child.start()
print(queue.get(timeout=60) == queue.get(timeout=60))
"""
    # As a vector environment of forked processes does; a rasterizer with threads of its own would wait for ever.
    variables = {name: value for name, value in os.environ.items() if name != "LP_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120, env=variables
    )
    assert done.stdout.strip() == "True"
