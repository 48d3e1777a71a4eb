"""Collections that are killed, and collections by several processes, end in the very same files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from vid2demo.demos.collect import collect
from vid2demo.demos.dataset import check_dataset, read_columns
from vid2demo.demos.replay import replay
from vid2demo.demos.stored import read_collection

SCRIPT = """
import sys
from pathlib import Path
from vid2demo.demos.collect import collect

if __name__ == "__main__":
    collect(Path(sys.argv[1]), Path(sys.argv[2]), episodes=3, seed=1, image_size=(64, 64), workers=int(sys.argv[3]),
            env_kwargs={"num_particles": 20})
"""


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def whole(pour_reference: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes collected by one process without interruption."""
    out = tmp_path_factory.mktemp("whole") / "dataset"
    collect(pour_reference, out, episodes=3, seed=1, image_size=(64, 64), env_kwargs={"num_particles": 20})
    return out


def children_of(process: int) -> list[int]:
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == process:
                found.append(int(folder.name))
        except (OSError, IndexError):
            continue
    return found


def alive(process: int) -> bool:
    try:
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_killed_collect_leaves_nothing_half_done_and_goes_on(
    pour_reference: Path, whole: Path, tmp_path: Path, workers: int
) -> None:
    (tmp_path / "run.py").write_text(SCRIPT)
    out = tmp_path / "dataset"
    attempts = tmp_path / ".dataset.work" / "attempts"
    command = [sys.executable, str(tmp_path / "run.py"), str(pour_reference), str(out), str(workers)]
    process = subprocess.Popen(command, start_new_session=True)
    deadline_s = time.monotonic() + 200
    while not list(attempts.glob("attempt_*.json")) and process.poll() is None and time.monotonic() < deadline_s:
        time.sleep(0.05)
    helpers = children_of(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert list(attempts.glob("attempt_*.json")), "it was killed before its first attempt was finished"
    assert not out.exists()
    deadline_s = time.monotonic() + 60
    while any(alive(helper) for helper in helpers) and time.monotonic() < deadline_s:
        time.sleep(0.2)
    assert not [helper for helper in helpers if alive(helper)], "workers outlive their killed parent"
    collect(pour_reference, out, episodes=3, seed=1, image_size=(64, 64), env_kwargs={"num_particles": 20})
    assert contents(out) == contents(whole)
    assert not (tmp_path / ".dataset.work").exists()


@pytest.mark.slow
def test_two_workers_write_the_same_dataset(pour_reference: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    figures = collect(
        pour_reference, out, episodes=3, seed=1, image_size=(64, 64), workers=2, env_kwargs={"num_particles": 20}
    )
    assert figures["episodes"] == 3
    names = ["action", "observation.state", "observation.environment_state", "next.reward", "episode_index"]
    ours, theirs = read_columns(out, names), read_columns(whole, names)
    assert all(ours[name].tobytes() == theirs[name].tobytes() for name in names)
    digests = [[record["end_digest"] for record in read_collection(root)["episodes"]] for root in (out, whole)]
    assert digests[0] == digests[1]
    assert contents(out) == contents(whole)


@pytest.mark.slow
def test_real_episodes_are_verified_and_replay(whole: Path) -> None:
    check_dataset(whole)
    report = replay(whole)
    assert (report["episodes"], report["same_end"], report["success"]) == (3, 3, 3)


@pytest.mark.slow
def test_pictures_show_the_pour(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("vid2demo/test", root=whole)
    assert dataset.num_episodes == 3
    for camera in ("front", "wrist"):
        first, middle = (dataset[row][f"observation.images.{camera}"] for row in (0, 100))
        assert first.shape == (3, 64, 64)
        assert float(first.std()) > 0.05, "the picture is empty"
        assert float((first - middle).abs().mean()) > 0.01, "nothing moves"
