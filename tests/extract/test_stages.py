from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.files import write_text
from vid2demo.extract.progress import Listener, Progress
from vid2demo.extract.stages import Stage, StageError, content_hash, plain, read_run, run_stages


class Recorder(Listener):
    def __init__(self) -> None:
        self.done: list[str] = []
        self.skipped_names: list[str] = []
        self.pieces: list[tuple[int, int, str]] = []

    def finished(self, title: str, seconds: float) -> None:
        self.done.append(title)

    def skipped(self, title: str, number: int, count: int) -> None:
        self.skipped_names.append(title)

    def progress(self, done: int, total: int, text: str) -> None:
        self.pieces.append((done, total, text))


def copy_stage(
    folder: Path, source: Path, target: str, change: Callable[[str], str], name: str | None = None, **settings: Any
) -> Stage:
    """A real stage: reads a text, changes it, writes it."""

    def work(progress: Progress) -> Mapping[str, Any]:
        text = source.read_text()
        progress(1, 1, "copied")
        write_text(folder / target, change(text))
        return {"characters": len(text)}

    return Stage(name or f"make {target}", name or f"make {target}", work, settings, {"source": source}, (target,))


def chain(folder: Path, source: Path, **settings: Any) -> list[Stage]:
    return [
        copy_stage(folder, source, "upper.txt", str.upper),
        copy_stage(folder, folder / "upper.txt", "twice.txt", lambda t: t + t, **settings),
        copy_stage(folder, folder / "twice.txt", "last.txt", lambda t: t[::-1]),
    ]


NAMES = ["make upper.txt", "make twice.txt", "make last.txt"]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.txt"
    path.write_text("tea")
    return path


def go(folder: Path, stages: list[Stage], **options: Any) -> Recorder:
    recorder = Recorder()
    run_stages(folder, stages, command="test", settings={"seed": 3}, listener=recorder, **options)
    return recorder


def test_second_run_does_nothing(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    first = go(folder, chain(folder, source))
    before = {p.name: p.stat().st_mtime_ns for p in folder.glob("*.txt")}
    second = go(folder, chain(folder, source))
    assert (first.done, first.skipped_names) == (NAMES, [])
    assert (second.done, second.skipped_names) == ([], NAMES)
    assert {p.name: p.stat().st_mtime_ns for p in folder.glob("*.txt")} == before
    assert (folder / "last.txt").read_text() == "AETAET"
    assert first.pieces == [(1, 1, "copied")] * 3


def test_changed_input_is_followed_only_as_far_as_it_matters(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source))
    source.write_text("TeA")  # another input, but the first stage's output stays the same
    assert go(folder, chain(folder, source)).done == NAMES[:1]
    source.write_text("cup")
    assert go(folder, chain(folder, source)).done == NAMES
    assert (folder / "last.txt").read_text() == "PUCPUC"


def test_changed_setting_redoes_its_stage_alone_when_the_result_is_the_same(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source))
    assert go(folder, chain(folder, source, sugar=2)).done == NAMES[1:2]
    assert go(folder, chain(folder, source, sugar=2)).done == []


@pytest.mark.parametrize("damage", [Path.unlink, lambda p: p.write_text("spilled")])
def test_lost_or_altered_output_is_made_again(tmp_path: Path, source: Path, damage: Callable[[Path], Any]) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source))
    damage(folder / "twice.txt")
    assert go(folder, chain(folder, source)).done == NAMES[1:2]
    assert (folder / "twice.txt").read_text() == "TEATEA"


def test_changed_code_redoes_the_stage(tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "out"
    stage = copy_stage(folder, source, "a.txt", str.upper)
    of_room = Stage(stage.name, stage.title, stage.work, stage.settings, stage.inputs, stage.outputs, ("extract",))
    assert stage.key() != of_room.key()
    go(folder, [of_room])
    assert go(folder, [of_room]).done == []
    monkeypatch.setattr("vid2demo.extract.stages.code_hash", lambda rooms: "of tomorrow")
    assert go(folder, [of_room]).done == [stage.name]


def test_force_does_all_again(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source))
    assert go(folder, chain(folder, source), force=True).done == NAMES


def test_failure_keeps_what_was_done_and_the_next_run_goes_on_there(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"

    def fail(text: str) -> str:
        raise KeyboardInterrupt

    stages = chain(folder, source)
    broken = [stages[0], copy_stage(folder, folder / "upper.txt", "twice.txt", fail), stages[2]]
    with pytest.raises(KeyboardInterrupt):
        go(folder, broken)
    record = read_run(folder)
    assert record is not None
    assert list(record["stages"]) == NAMES[:1]
    resumed = go(folder, stages)
    assert (resumed.skipped_names, resumed.done) == (NAMES[:1], NAMES[1:])


def test_refused_input_names_its_stage_and_keeps_what_was_done(tmp_path: Path, source: Path) -> None:
    def refuse(text: str) -> str:
        raise UserError("the tea is cold; heat it")

    stages = [*chain(tmp_path, source)[:1], copy_stage(tmp_path, source, "twice.txt", refuse)]
    with pytest.raises(StageError, match="the tea is cold; heat it") as caught:
        go(tmp_path, stages)
    assert caught.value.stage == NAMES[1]
    assert go(tmp_path, chain(tmp_path, source)).skipped_names == NAMES[:1]


def test_process_killed_in_a_stage_leaves_a_folder_that_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    script = textwrap.dedent(
        """
        import sys, time
        from pathlib import Path
        from vid2demo.extract.files import atomic_path
        from vid2demo.extract.stages import Stage, run_stages

        folder, slow = Path(sys.argv[1]), sys.argv[2] == "slow"

        def first(progress):
            (folder / "a.txt").write_text("a")
            return {}

        def second(progress):
            with atomic_path(folder / "b.txt") as temporary:
                temporary.write_text("b")
                (folder / "reached").touch()
                time.sleep(60 if slow else 0)
            return {}

        stages = [Stage("first", "", first, outputs=("a.txt",)), Stage("second", "", second, outputs=("b.txt",))]
        run_stages(folder, stages, command="test", settings={})
        """
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(folder), "slow"])
    deadline_s = time.monotonic() + 60
    while not (folder / "reached").exists() and time.monotonic() < deadline_s and process.poll() is None:
        time.sleep(0.02)
    with pytest.raises(UserError, match="another vid2demo is at work"):
        run_stages(folder, [], command="test", settings={})
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "b.txt").exists()
    assert list(folder.glob(".b*.part*"))
    record = read_run(folder)
    assert record is not None
    assert list(record["stages"]) == ["first"]
    subprocess.run([sys.executable, "-c", script, str(folder), "quick"], check=True)
    record = read_run(folder)
    assert record is not None
    assert list(record["stages"]) == ["first", "second"]
    assert not list(folder.glob(".*"))


def test_record_tells_settings_versions_seeds_timings_and_figures(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source))
    record = json.loads((folder / "run.json").read_text())
    assert record["settings"] == {"seed": 3}
    assert record["seeds"] == {"seed": 3}
    assert {"python", "vid2demo", "mujoco", "mink", "numpy"} <= set(record["versions"])
    assert record["figures"]["make upper.txt"] == {"characters": 3}
    assert set(record["timings_s"]) == set(NAMES)
    assert all(seconds >= 0 for seconds in record["timings_s"].values())


def test_folder_of_another_video_is_refused_by_naming_both(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, chain(folder, source), video={"path": "coffee.mp4", "sha256": "1"})
    before = (folder / "run.json").read_bytes()
    for force in (False, True):
        with pytest.raises(UserError, match=r"belongs to the video coffee\.mp4, not to tea\.mp4"):
            go(folder, chain(folder, source), video={"path": "tea.mp4", "sha256": "2"}, force=force)
    assert (folder / "run.json").read_bytes() == before
    go(folder, chain(folder, source), video={"path": "moved/coffee.mp4", "sha256": "1"})


def test_file_that_no_setting_writes_any_more_is_removed(tmp_path: Path, source: Path) -> None:
    folder = tmp_path / "out"
    go(folder, [copy_stage(folder, source, "kettle.txt", str.upper, name="extract")])
    (folder / "mine.txt").write_text("not of this program")
    go(folder, [copy_stage(folder, source, "jug.txt", str.upper, name="extract")])
    assert sorted(p.name for p in folder.glob("*.txt")) == ["jug.txt", "mine.txt"]


def test_stage_that_does_not_write_what_it_says_is_not_taken_as_done(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"did not write nothing\.txt"):
        go(tmp_path, [Stage("idle", "", lambda progress: {}, outputs=("nothing.txt",))])
    record = read_run(tmp_path)
    assert record is not None
    assert record["stages"] == {}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "is damaged"),
        ("[]", "is damaged"),
        ('{"schema": "other", "version": 1, "stages": {}}', "was not written by vid2demo"),
        ('{"schema": "vid2demo/run", "version": 99, "stages": {}}', "update vid2demo"),
    ],
)
def test_unreadable_record_is_one_sentence(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(UserError, match=match):
        go(tmp_path, [])


def test_missing_input_is_named_with_its_role(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"source .*gone\.txt does not exist"):
        go(tmp_path, [copy_stage(tmp_path, tmp_path / "gone.txt", "a.txt", str.upper)])


def test_file_as_output_folder_is_refused(tmp_path: Path, source: Path) -> None:
    with pytest.raises(UserError, match="is a file; name a folder"):
        go(source, [])


def test_folder_hash_sees_names_contents_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "d/e").mkdir(parents=True)
    (tmp_path / "d/e/a.txt").write_text("1")
    first = content_hash(tmp_path / "d")
    os.utime(tmp_path / "d/e/a.txt", (1, 1))
    assert content_hash(tmp_path / "d") == first
    (tmp_path / "d/e/a.txt").rename(tmp_path / "d/e/b.txt")
    assert content_hash(tmp_path / "d") != first
    assert content_hash(tmp_path / "absent") is None


def test_plain_makes_json_of_numpy_paths_and_numbers_that_json_refuses() -> None:
    value = {
        "a": np.float32(0.5),
        "b": np.arange(2),
        "c": [math.nan, -math.inf],
        "d": (Path("x"), np.bool_(True)),
        5: None,
    }
    expected = {"a": 0.5, "b": [0, 1], "c": [None, None], "d": ["x", True], "5": None}
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == expected
