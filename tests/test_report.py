from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.plots import Line, chart, ticks
from vid2demo.envs.panda import Q_HOME_RAD
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.video import VideoWriter, iterate_frames
from vid2demo.report import write_report

EVIL = "<script>alert(1)</script>&\"'"
STAGES = ("extract", "reference", "retarget", "simulate", "collect")
VOID = {"meta", "br", "img", "path", "rect"}


class Outline(HTMLParser):
    """Collects tags, text and addresses, and checks that elements are closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.words: list[str] = []
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == [], self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def run_folder(folder: Path, name: str = "kettle", target: str = "mug") -> Path:
    """A run's folder as `vid2demo run` leaves it, made up."""
    folder.mkdir(parents=True)
    n, fps = 150, 25.0
    time_s = np.arange(n) / fps
    tilt = np.deg2rad(70) * np.sin(np.pi * time_s / time_s[-1]) ** 2
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("y", tilt[:, None]).as_matrix()
    T[:, :3, 3] = np.stack([0.4 + 0.1 * np.cos(time_s), 0.1 * np.sin(time_s), 0.2 + 0.05 * time_s], axis=1)
    visible = np.abs(time_s - 3) > 0.4
    mesh = {"name": "gooseneck_kettle", "extents_m": [0.31, 0.14, 0.2], "symmetry": {"axis": [0, 0, 1], "order": 1}}
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    for who in (name, target):
        confidence = np.where(visible, 0.9, 0.3) + 0.05 * np.sin(9 * time_s)
        track = ObjectTrack(T, time_s, K, confidence, visible, {"object": who, "mesh": mesh})
        track.save(folder / f"{who}.track.npz")
    Reference.from_poses(T, time_s, {"scale": 0.8}).save(folder / f"{name}.reference.npz")
    q_rad = Q_HOME_RAD + 0.3 * np.sin(time_s[:, None] + np.arange(7))
    zeros = np.zeros((n, 7))
    JointTrajectory(time_s, q_rad, zeros, zeros, np.full(n, 0.02)).save(folder / f"{name}.joints.npz")
    step = np.clip((time_s - 2) / 2, 0, 1)
    series: dict[str, Any] = {
        "time_s": time_s.tolist(),
        "position_error_m": (0.004 + 0.002 * np.sin(time_s)).tolist(),
        "rotation_error_rad": np.full(n, 0.02).tolist(),
        "tilt_rad": (tilt + 0.01).tolist(),
        "reference_tilt_rad": tilt.tolist(),
        "poured_fraction": (0.82 * step).tolist(),
        "spilled_fraction": (0.05 * step).tolist(),
        "q_rad": q_rad.tolist(),
    }
    series["position_error_m"][3] = None
    (folder / "series.json").write_text(json.dumps(series))
    words = ["The arm can do this motion.", "Joint 4 comes nearest to its limit: 21 degrees are left at 3.1 s."]
    (folder / "feasibility.json").write_text(json.dumps({"feasible": True, "words": words}))
    for video in ("overlay", "simulation"):
        with VideoWriter(folder / f"{video}.mp4", fps) as writer:
            for k in range(30):
                writer.write(np.full((96, 128, 3), 40 + 5 * k, np.uint8))
    (folder / "dataset" / "meta").mkdir(parents=True)
    info = {"total_episodes": 10, "total_frames": 1500, "fps": 25, "codebase_version": "v3.0"}
    (folder / "dataset" / "meta" / "info.json").write_text(json.dumps(info))
    record = {
        "schema": "vid2demo/run",
        "version": 1,
        "command": "run",
        "settings": {
            "video": "clips/coffee pour.mp4",
            "object": {"name": name, "box_xywh_px": [1, 2, 3, 4], "mesh": None, "mesh_unit": "auto"},
            "receptacle": {"name": target, "box_xywh_px": None, "mesh": None, "mesh_unit": "auto"},
            "camera": None,
            "scale": "auto",
            "episodes": 10,
            "seed": 7,
        },
        "versions": {"python": "3.12.1", "mujoco": "3.17.0"},
        "video": {"path": "clips/coffee pour.mp4", "sha256": "ab" * 32, "frames": 150},
        "machine": {"system": "Linux", "processors": 2},
        "stages": {stage: {"seconds": 12.5, "figures": {}} for stage in STAGES},
    }
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return run_folder(tmp_path / "run")


def test_shows_everything_of_a_finished_run(folder: Path) -> None:
    path = write_report(folder)
    assert path == folder / "report.html"
    outline = Outline(path.read_text())
    text = " ".join(outline.words)
    assert "pours 82% of the kettle's contents into the mug and spills 5%" in text
    assert "10 verified demonstrations" in text
    assert "is not there" not in text
    assert "cannot be read" not in text
    assert outline.tags.count("video") == 2
    for title in ("position in the camera frame", "confidence", "tracking: position error", "joints between their"):
        assert title in text
    assert text.count("to the limit") >= 7
    assert "The arm can do this motion." in text
    for command in ("vid2demo replay", "lerobot-train", "gym.make("):
        assert command in text
    for fact in ("coffee pour.mp4", "3.17.0", "62.5 s", "31.0 × 14.0 × 20.0 cm", "150"):
        assert fact in text


def test_is_one_page_without_outside_addresses(folder: Path) -> None:
    text = write_report(folder).read_text()
    assert all(address.startswith("data:video/mp4;base64,") for address in Outline(text).addresses)
    assert not re.search(r"https?://|@import|url\(", text)


@pytest.mark.parametrize(
    "name",
    [
        "run.json",
        "series.json",
        "feasibility.json",
        "overlay.mp4",
        "simulation.mp4",
        "kettle.track.npz",
        "kettle.reference.npz",
        "kettle.joints.npz",
    ],
)
@pytest.mark.parametrize("fault", ["missing", "empty", "garbage", "another kind"])
def test_a_missing_or_damaged_part_is_named(folder: Path, name: str, fault: str) -> None:
    path = folder / name
    if fault == "missing":
        path.unlink()
    else:
        path.write_bytes({"empty": b"", "garbage": b"\x00\xffgarbage", "another kind": b"[1, 2]"}[fault])
    text = " ".join(Outline(write_report(folder).read_text()).words)
    assert name in text
    assert ("is not there" if fault == "missing" else "cannot be read") in text
    assert "lerobot-train" in text


def test_an_empty_folder_says_so(tmp_path: Path) -> None:
    text = " ".join(Outline(write_report(tmp_path).read_text()).words)
    assert "There is nothing to show yet" in text
    assert "Not done: extract, reference, retarget, simulate, collect" in text


def test_an_interrupted_run_tells_how_to_go_on(folder: Path) -> None:
    record = json.loads((folder / "run.json").read_text())
    for stage in ("simulate", "collect"):
        del record["stages"][stage]
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "series.json").unlink()
    (folder / "simulation.mp4").unlink()
    text = " ".join(Outline(write_report(folder).read_text()).words)
    assert "Not done: simulate, collect" in text
    assert "vid2demo run 'clips/coffee pour.mp4' --object kettle --box 1 2 3 4 --receptacle mug" in text
    assert f"--episodes 10 --seed 7 --out {folder}" in text


def test_nothing_from_outside_becomes_markup(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run")
    record = json.loads((folder / "run.json").read_text())
    record["video"]["path"] = EVIL
    record["settings"]["object"]["name"] = EVIL
    record["settings"][EVIL] = EVIL
    record["versions"][EVIL] = [EVIL]
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "feasibility.json").write_text(json.dumps({"feasible": False, "words": [EVIL, EVIL]}))
    track = ObjectTrack.load(folder / "kettle.track.npz")
    mesh = {**track.header["mesh"], "name": EVIL}
    bad = ObjectTrack(
        track.T_camera_object, track.time_s, track.camera_matrix, track.confidence, track.visible, {"mesh": mesh}
    )
    bad.save(folder / f"{EVIL.replace('/', '')}.track.npz")
    text = write_report(folder).read_text()
    assert "<script>alert" not in text
    assert Outline(text).tags.count("script") == 1


def test_a_large_video_is_made_smaller(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vid2demo.report.MAX_VIDEO_BYTES", 100)
    rng = np.random.default_rng(0)
    with VideoWriter(folder / "overlay.mp4", 25.0) as writer:
        for _ in range(5):
            writer.write(rng.integers(0, 255, (480, 1280, 3), np.uint8))
    text = write_report(folder).read_text()
    address = next(a for a in Outline(text).addresses)
    import base64

    small = folder / "small.mp4"
    small.write_bytes(base64.b64decode(address.partition("base64,")[2]))
    frames = list(iterate_frames(small))
    assert len(frames) == 5
    assert frames[0].rgb.shape[1] == 854
    assert small.stat().st_size < (folder / "overlay.mp4").stat().st_size / 2


def test_goes_to_another_place_when_told(folder: Path, tmp_path: Path) -> None:
    assert write_report(folder, tmp_path / "page.html").is_file()
    assert not (folder / "report.html").exists()


def test_no_folder_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist; give the --out folder"):
        write_report(tmp_path / "nowhere")


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 7.9), (0.001, 0.0012), (0.0, 12345.0)])
def test_ticks_are_round_few_and_inside(low: float, high: float) -> None:
    values = ticks(low, high)
    assert 2 <= len(values) <= 8
    assert all(low - 1e-9 <= v <= high + 1e-9 for v in values)
    steps = np.diff(values)
    np.testing.assert_allclose(steps, steps[0])
    assert round(steps[0] / 10 ** math.floor(math.log10(steps[0] * 1.0001)), 6) in (1, 2, 2.5, 5)


def test_a_chart_of_gaps_constants_and_many_points_stays_small_and_valid() -> None:
    time_s = np.linspace(0, 1200, 30_000)
    noisy = np.random.default_rng(0).normal(size=30_000)
    noisy[100:900] = np.nan
    text = chart("x", "m", time_s, [Line("noisy", noisy), Line("flat", np.zeros(30_000), 2)])
    assert len(text) < 40_000
    assert "nan" not in text
    Outline(text)
    assert "nan" not in chart("nothing", "m", np.array([0.0]), [Line("gap", np.array([np.nan]))])
