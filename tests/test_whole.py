"""The whole way on a small clip, as `make demo` goes it: every stage real."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from vid2demo import cli

# The limit is far off: it is there to end a hang, not to measure a busy machine.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "demo"
    assert cli.main(demo_words(out)) == 0
    return out


def demo_words(out: Path, episodes: int = 2) -> list[str]:
    return ["demo", "--out", str(out), "--seconds", "4", "--episodes", str(episodes), "--seed", "0"]


def record(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "run.json").read_text()))


def test_every_file_is_there(folder: Path) -> None:
    wanted = (
        "clip/video.mp4 mug.track.npz bowl.track.npz overlay.mp4 mug.reference.npz mug.joints.npz feasibility.json "
        "simulation.mp4 series.json dataset/meta/info.json run.json report.html"
    )
    assert [name for name in wanted.split() if not (folder / name).is_file()] == []
    assert not [p.name for p in folder.iterdir() if p.name.startswith(".")]


def test_the_robot_pours_and_follows(folder: Path) -> None:
    figures = record(folder)["figures"]
    assert figures["simulate"]["poured_fraction"] >= 0.6
    assert figures["simulate"]["position_error_m"]["mean"] < 0.01
    assert figures["retarget"]["feasible"]


def test_the_report_needs_no_other_file(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert 'src="http' not in page
    assert "data:video/mp4;base64," in page


def test_every_episode_replays_to_the_same_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", str(folder / "dataset"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["same_end"], result["episodes"]) == (2, 2)


def test_the_same_command_again_does_nothing(folder: Path) -> None:
    def stamps() -> dict[str, int]:
        return {str(p): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file() and p.name != "run.json"}

    before, record_before = stamps(), record(folder)
    assert cli.main(demo_words(folder)) == 0
    assert stamps() == before
    assert record(folder) == record_before


def test_a_lost_file_is_made_again_and_nothing_else(folder: Path) -> None:
    finished = {name: stage["finished"] for name, stage in record(folder)["stages"].items()}
    content = (folder / "mug.joints.npz").read_bytes()
    (folder / "mug.joints.npz").unlink()
    assert cli.main(demo_words(folder)) == 0
    assert (folder / "mug.joints.npz").read_bytes() == content
    after = {name: stage["finished"] for name, stage in record(folder)["stages"].items()}
    assert {name for name in after if after[name] != finished[name]} <= {"retarget"}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_command_stopped_in_its_midst_leaves_nothing_half_done(tmp_path: Path, how: signal.Signals) -> None:
    out = tmp_path / "clip"
    words = ["synthesize", "--out", str(out), "--seconds", "6", "--size", "160", "120"]
    command = [str(Path(sys.executable).with_name("vid2demo")), *words]
    # Whoever runs the tests in the background has told them to ignore the interrupt, and they would hand that on.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    deadline_s = time.monotonic() + 120
    while not list(out.glob(".video.*.part.mp4")) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    process.send_signal(how)
    _, told = process.communicate(timeout=120)
    assert not (out / "video.mp4").exists()
    assert record(out)["stages"] == {}
    if how == signal.SIGINT:
        assert process.returncode == 130
        assert told.strip().endswith(f"to go on, type again: vid2demo {shlex.join(words)}")
        assert not list(out.glob(".*"))
    assert cli.main(words) == 0
    assert set(record(out)["stages"]) == {"synthesize"}
    assert not list(out.glob(".*"))
