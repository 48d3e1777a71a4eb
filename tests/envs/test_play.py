"""Watching a pour: in MuJoCo's window, or in an mp4 where there is no screen."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import mujoco.viewer
import numpy as np
import pytest
from vid2demo.envs import display, play, rendering
from vid2demo.envs.overlays import Hud, Overlay
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.envs.rendering import Viewer, has_screen
from vid2demo.extract.errors import UserError
from vid2demo.extract.video import iterate_frames

HUD = Hud(1.5, 0.5, 0.25, 0.012, 0.1)
SMALL: dict[str, Any] = {"num_particles": 10, "render_size": (48, 64)}


class Window:
    """Stands in for the viewer's handle where there is no screen; a person closes it after so many pictures."""

    def __init__(self, model: mujoco.MjModel, patience: int = 10_000) -> None:
        self.user_scn = mujoco.MjvScene(model, 1000)
        self.patience, self.synced = patience, 0
        self.cam = mujoco.MjvCamera()
        self.texts: Any = ()

    @property
    def d(self) -> object:
        return self if self.patience else None

    def lock(self) -> Any:
        return contextlib.nullcontext()

    def is_running(self) -> bool:
        return self.synced < self.patience

    def sync(self) -> None:
        self.synced += 1

    def set_texts(self, texts: Any) -> None:
        self.texts = texts

    def close(self) -> None:
        self.patience = 0


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[Window]:
    """The windows that were opened, on a machine that seems to have a screen."""
    opened: list[Window] = []

    def launch(model: mujoco.MjModel, data: mujoco.MjData, **_: Any) -> Window:
        opened.append(Window(model))
        return opened[-1]

    for module in (display, rendering):
        monkeypatch.setattr(module, "require_screen", lambda: None)
        monkeypatch.setattr(module, "has_screen", lambda: True)
    monkeypatch.setattr(play, "has_screen", lambda: True)
    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    return opened


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.system", lambda: "Linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def empty(mug_pour: Reference) -> Iterator[PandaPourEnv]:
    env = PandaPourEnv(mug_pour, num_particles=0)
    env.reset(seed=0)
    yield env
    env.close()


# ---------------------------------------------------------------------- the window


def test_viewer_shows_particles_and_overlays_of_this_moment_only(empty: PandaPourEnv, windows: list[Window]) -> None:
    viewer = Viewer(empty.model, empty.data, "front", fps=1000)
    (window,) = windows
    particles = np.zeros((7, 3)), 0.005
    viewer.show(particles, Overlay(np.eye(4), np.zeros((4, 3)), HUD))
    shapes = window.user_scn.ngeom
    assert shapes > 7 + 3
    assert "50 %" in window.texts[3]
    viewer.show(particles)
    assert window.user_scn.ngeom == 7
    viewer.show()
    assert (window.user_scn.ngeom, window.synced) == (0, 3)
    assert viewer.is_open
    viewer.close()
    viewer.show()
    assert (viewer.is_open, window.synced) == (False, 3)


@pytest.mark.parametrize("camera", ["front", "wrist"])
def test_window_looks_from_the_camera_at_first(camera: str, empty: PandaPourEnv, windows: list[Window]) -> None:
    viewer = Viewer(empty.model, empty.data, camera, fps=1000)
    (window,) = windows
    mujoco.mjv_updateScene(
        empty.model, empty.data, mujoco.MjvOption(), None, window.cam, mujoco.mjtCatBit.mjCAT_ALL, window.user_scn
    )
    seen = window.user_scn.camera[0]
    number = empty.model.camera(camera).id
    assert np.allclose(seen.pos, empty.data.cam_xpos[number], atol=0.05)
    assert np.allclose(seen.forward, -empty.data.cam_xmat[number].reshape(3, 3)[:, 2], atol=1e-3)
    viewer.close()


def test_viewer_keeps_real_time(empty: PandaPourEnv, windows: list[Window]) -> None:
    viewer = Viewer(empty.model, empty.data, "front", fps=50)
    start = time.monotonic()
    for _ in range(10):
        viewer.show()
    assert 0.19 <= time.monotonic() - start < 0.5


@pytest.mark.usefixtures("no_screen")
def test_viewer_without_a_screen_names_the_mend(empty: PandaPourEnv) -> None:
    assert not has_screen()
    with pytest.raises(UserError, match="rgb_array"):
        Viewer(empty.model, empty.data, "front", fps=25)
    with pytest.raises(UserError, match="rgb_array"):
        PandaPourEnv(num_particles=0, render_mode="human")
    assert empty.metadata["render_modes"] == ["rgb_array"] or has_screen()


@pytest.mark.filterwarnings("error")
def test_viewer_with_a_screen_that_is_not_there_does_not_hang(
    empty: PandaPourEnv, no_screen: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":7391")
    assert has_screen()
    with pytest.raises(UserError, match=":7391"):
        Viewer(empty.model, empty.data, "front", fps=25)


def test_window_follows_every_step_and_reset(mug_pour: Reference, windows: list[Window]) -> None:
    env = PandaPourEnv(mug_pour, num_particles=0, control_hz=100.0, render_mode="human", overlays=("ghost", "trail"))
    assert "human" in env.metadata["render_modes"]
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    assert env.render() is None
    (window,) = windows
    assert window.synced == 6
    assert window.user_scn.ngeom == 1 + 4
    env.reset(seed=0)
    assert window.user_scn.ngeom == 1
    assert env.is_watched
    env.close()
    assert not window.is_running()


# ---------------------------------------------------------------------- play


@pytest.mark.usefixtures("no_screen")
def test_play_without_a_screen_films_the_whole_pour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    told: list[tuple[int, int, str]] = []
    found = play.play(arguments=SMALL, progress=lambda *now: told.append(now))
    assert found["shown"] == str(play.DEFAULT_OUT)
    assert found["is_success"]
    assert found["poured_fraction"] > 0.8
    assert found["position_error_m"] < 0.002
    assert found["rotation_error_rad"] < 0.01
    frames = list(iterate_frames(play.DEFAULT_OUT))
    assert len(frames) == round(found["seconds"] * 25) + 1
    assert frames[0].rgb.shape == (48, 64, 3)
    assert [done for done, _, _ in told] == list(range(1, told[-1][1] + 1))


def test_play_takes_reference_and_joints(mug_pour: Reference, tmp_path: Path) -> None:
    mug_pour.save(tmp_path / "mug.reference.npz")
    still = np.tile(mug_pour.q_start_rad, (len(mug_pour), 1))
    arguments = {**SMALL, "num_particles": 0, "settle_s": 0.0}
    found = play.play(tmp_path / "mug.reference.npz", still, tmp_path / "still.mp4", 0, arguments)
    assert found["position_error_m"] > 0.1
    assert (tmp_path / "still.mp4").exists()
    with pytest.raises(UserError, match="10 knots and the reference"):
        play.play(tmp_path / "mug.reference.npz", still[:10], tmp_path / "cut.mp4", 0, arguments)
    assert not (tmp_path / "cut.mp4").exists()


def test_play_in_a_window_ends_when_it_is_closed(windows: list[Window]) -> None:
    def close_soon(done: int, total: int, text: str) -> None:
        windows[0].patience = 5

    found = play.play(arguments=SMALL, progress=close_soon)
    assert found["shown"] == "window"
    assert found["seconds"] < 1.0
    assert len(windows) == 1


def test_play_in_a_window_begins_again_until_it_is_closed(
    windows: list[Window], mug_pour: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = Reference.from_poses(mug_pour.T_world_object[:4], mug_pour.time_s[:4], mug_pour.header)
    short.save(tmp_path / "short.reference.npz")
    begun = 0
    once = play._episode

    def counted(*arguments: Any) -> dict[str, Any]:
        nonlocal begun
        begun += 1
        if begun == 3:
            windows[0].patience = 0
        return once(*arguments)

    monkeypatch.setattr(play, "_episode", counted)
    arguments = {**SMALL, "num_particles": 0, "settle_s": 0.0}
    play.play(tmp_path / "short.reference.npz", arguments=arguments)
    assert begun == 3


@pytest.mark.parametrize("name", ["film.avi", "film"])
def test_play_writes_mp4_only(name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"ends in \.mp4"):
        play.play(out=tmp_path / name)
