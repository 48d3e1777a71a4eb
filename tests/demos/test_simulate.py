"""The film: right frames beside each other, right series, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.retarget import retarget
from vid2demo.demos.rollout import DEFAULT_ENV_ID, make_env
from vid2demo.demos.simulate import PANEL_HEIGHT_PX, STRIP_HEIGHT_PX, _on_clock, _Recorder, simulate
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.extract.video import VideoWriter, iterate_frames, read_video_info

FAST = {"env_kwargs": {"num_particles": 20}}
VIDEO_FPS = 10.0


def gray_of(frame_index: int) -> int:
    return 20 + 3 * frame_index


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frame k of this 10 Hz clip is gray by 20 + 3 k."""
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    with VideoWriter(path, fps=VIDEO_FPS) as writer:
        for index in range(70):
            writer.write(np.full((48, 64, 3), gray_of(index), np.uint8))
    return path


@pytest.fixture(scope="module")
def files(pour_reference: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The first second and a half of the built-in pour, whose video was twice as fast as the robot."""
    folder = tmp_path_factory.mktemp("simulate")
    whole = Reference.load(pour_reference)
    n = 40
    cut = Reference.from_poses(
        whole.T_world_object[:n], whole.time_s[:n], whole.header, video_time_s=2.0 * whole.time_s[:n]
    )
    cut.save(folder / "cut.reference.npz")
    retarget(cut).save(folder / "cut.joints.npz")
    return folder / "cut.reference.npz", folder / "cut.joints.npz"


@pytest.fixture(scope="module")
def result(files: tuple[Path, Path], video: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("film") / "simulation.mp4"
    told: list[int] = []
    figures = simulate(*files, video, out, progress=lambda done, total, text: told.append(done), **FAST)
    return {**figures, "out": out, "told": told}


def test_series_are_whole_and_plain(result: dict[str, Any]) -> None:
    series = result["series"]
    steps = 39 + 25
    assert result["steps"] == steps
    for name, values in series.items():
        for column in values.values() if name == "reward_terms" else [values]:
            assert len(column) == steps, name
    np.testing.assert_allclose(series["time_s"], np.arange(steps) / 25)
    assert np.shape(series["q_rad"]) == (steps, 7)
    json.dumps({"series": series, **{k: result[k] for k in ("position_error_m", "is_success")}}, allow_nan=False)
    assert result["told"][-1] == steps


def test_robot_follows_and_tilt_is_the_vessels(result: dict[str, Any]) -> None:
    assert result["position_error_m"]["max"] < 0.005
    assert result["rotation_error_rad"]["max"] < np.deg2rad(3)
    tilt, wanted = (np.array(result["series"][name]) for name in ("tilt_rad", "reference_tilt_rad"))
    np.testing.assert_allclose(tilt, wanted, atol=np.deg2rad(2))


def test_video_and_robot_share_the_clock(result: dict[str, Any], files: tuple[Path, Path]) -> None:
    info = read_video_info(result["out"])
    assert info.frame_count == result["steps"]
    assert info.fps == pytest.approx(25)
    assert info.height_px == PANEL_HEIGHT_PX + STRIP_HEIGHT_PX
    clock_s = Reference.load(files[0]).video_time_s
    for frame in iterate_frames(result["out"]):
        shown = float(frame.rgb[300:400, 100:200].mean())
        at_s = clock_s[min(frame.index, len(clock_s) - 1)]
        assert shown == pytest.approx(gray_of(int(at_s * VIDEO_FPS + 1e-6)), abs=2.0), frame.index


def test_clock_stops_at_the_end_of_the_video(video: Path) -> None:
    panels = _on_clock(video, np.array([0.0, 6.9, 50.0]))
    shown = [round(float(next(panels).mean())) for _ in range(5)]
    np.testing.assert_allclose(shown, [gray_of(0)] + [gray_of(69)] * 4, atol=2)


def test_without_a_video_the_robot_stands_alone_and_friction_tells_of_slip(
    files: tuple[Path, Path], result: dict[str, Any], tmp_path: Path
) -> None:
    held = simulate(*files, None, tmp_path / "alone.mp4", env_kwargs={"num_particles": 20, "grasp": "friction"})
    assert read_video_info(tmp_path / "alone.mp4").width_px == PANEL_HEIGHT_PX * 4 // 3
    assert 0.0 < held["slip_m"] == max(held["series"]["slip_m"]) < 0.005
    assert 0.0 < held["slip_rad"] < np.deg2rad(3)
    assert held["position_error_m"]["max"] < 0.005
    assert "slip_m" not in result


def test_the_tilt_told_is_the_vessels_own_when_it_has_turned_in_the_hand(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    reference = Reference.load(files[0])
    env = make_env(DEFAULT_ENV_ID, reference, num_particles=0, grasp="friction", obs_mode="both", image_size=(48, 64))
    env.reset(seed=0)
    simulation = env.unwrapped.simulation
    before_rad = float(np.arccos(simulation.vessel_R[2, 2]))
    turned = Rotation.from_rotvec([0.0, 0.4, 0.0]) * Rotation.from_matrix(simulation.vessel_R)
    env.unwrapped.data.qpos[12:16] = turned.as_quat(scalar_first=True)
    simulation.refresh()
    recorder = _Recorder(reference, 25, "front", None)
    with VideoWriter(tmp_path / "one.mp4", fps=25) as writer:
        recorder.open(writer, None)
        info = env.step(env.action_space.sample())[4]
        simulation.refresh()
        env.unwrapped.data.qpos[12:16] = turned.as_quat(scalar_first=True)
        simulation.refresh()
        recorder(0, np.zeros(7, np.float32), env.unwrapped._observation(), 0.0, info)
    env.close()
    assert before_rad < 0.05
    assert recorder.series()["tilt_rad"] == [pytest.approx(0.4, abs=0.05)]


def test_files_of_two_motions_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    joints = JointTrajectory.load(files[1])
    shorter = replace(
        joints, **{name: getattr(joints, name)[:-1] for name in ("time_s", "q_rad", "dq_rad_s", "tau_nm", "gripper_m")}
    )
    shorter.save(tmp_path / "other.joints.npz")
    with pytest.raises(UserError, match="39 knots"):
        simulate(files[0], tmp_path / "other.joints.npz", None, tmp_path / "film.mp4", **FAST)
    with pytest.raises(UserError, match=r"nothing\.mp4 does not exist"):
        simulate(*files, tmp_path / "nothing.mp4", tmp_path / "film.mp4", **FAST)
    assert not (tmp_path / "film.mp4").exists()
    assert not list(tmp_path.glob(".film*"))
