"""Collecting: what is kept, what is counted, and that neither interruption nor rerun changes the result."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.demos import attempt
from vid2demo.demos import collect as collect_module
from vid2demo.demos.attempt import attempt_seed, finished_attempt
from vid2demo.demos.collect import collect
from vid2demo.demos.stored import read_collection, read_columns
from vid2demo.envs.pouring import PhysicsError
from vid2demo.extract.errors import UserError


def run(reference: Path, out: Path, env_id: str, **kwargs: Any) -> dict[str, Any]:
    options: dict[str, Any] = {"episodes": 3, "seed": 7, "image_size": (32, 32), "env_id": env_id, **kwargs}
    return collect(reference, out, **options)


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_keeps_successes_only_and_counts_the_rest(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    figures = run(stand_in_reference, tmp_path / "dataset", stand_in)
    assert figures["episodes"] == 3
    assert figures["complete"]
    attempts = figures["attempts"]
    assert attempts["succeeded"] == 3
    assert attempts["failed"] == {"poured too little": attempts["tried"] - 3}
    assert attempts["tried"] > 3
    level = read_columns(tmp_path / "dataset", ["observation.environment_state"])["observation.environment_state"][:, 0]
    assert level.max() < 0.5
    seeds = [record["seed"] for record in read_collection(tmp_path / "dataset")["episodes"]]
    expected = [attempt_seed(7, index) for index in range(attempts["tried"])]
    assert [seed for seed in expected if seed in seeds] == seeds
    assert figures["task"] == "pour from the gooseneck kettle into the mug"
    assert not (tmp_path / ".dataset.work").exists()


def test_same_seed_same_bytes_and_other_seed_other_rows(
    stand_in: str, stand_in_reference: Path, tmp_path: Path
) -> None:
    for name, seed in (("a", 7), ("b", 7), ("c", 4)):
        run(stand_in_reference, tmp_path / name, stand_in, seed=seed)
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys()
    assert a["data/chunk-000/file-000.parquet"] != c["data/chunk-000/file-000.parquet"]


def test_interrupted_collect_goes_on_and_ends_the_same(
    stand_in: str, stand_in_reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(stand_in_reference, tmp_path / "whole", stand_in)

    def stop(done: int, total: int, text: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(stand_in_reference, tmp_path / "cut", stand_in, progress=stop)
    assert not (tmp_path / "cut").exists()
    finished = [i for i in range(20) if finished_attempt(tmp_path / ".cut.work" / "attempts", i)]
    made: list[int] = []
    original = collect_module.AttemptRunner.run
    monkeypatch.setattr(collect_module.AttemptRunner, "run", lambda self, i: (made.append(i), original(self, i))[1])
    run(stand_in_reference, tmp_path / "cut", stand_in)
    assert finished
    assert not set(made) & set(finished)
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")


def test_attempts_of_other_settings_are_not_reused(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int, text: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(stand_in_reference, tmp_path / "dataset", stand_in, seed=6, progress=stop)
    run(stand_in_reference, tmp_path / "dataset", stand_in)
    run(stand_in_reference, tmp_path / "whole", stand_in)
    assert contents(tmp_path / "dataset") == contents(tmp_path / "whole")


def test_irreproducible_episodes_are_not_written(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="its replay ended differently"):
        run(stand_in_reference, tmp_path / "dataset", stand_in, env_kwargs={"forgetful": True})
    assert not (tmp_path / "dataset").exists()


def test_hopeless_motion_stops_early(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none of 20 attempts.*poured too little: 20"):
        run(stand_in_reference, tmp_path / "d", stand_in, episodes=100, env_kwargs={"success_below": 0.0})


def test_too_few_successes_are_kept_and_said(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    figures = run(stand_in_reference, tmp_path / "d", stand_in, episodes=10, max_attempts=6)
    assert 0 < figures["episodes"] < 10
    assert not figures["complete"]
    again = run(stand_in_reference, tmp_path / "d", stand_in, episodes=10, max_attempts=6)
    assert again == figures


def test_finished_dataset_is_not_made_again(
    stand_in: str, stand_in_reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = run(stand_in_reference, tmp_path / "dataset", stand_in)
    monkeypatch.setattr(collect_module, "AttemptRunner", None)
    assert run(stand_in_reference, tmp_path / "dataset", stand_in) == first


def test_more_episodes_keep_the_first_ones(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    run(stand_in_reference, tmp_path / "dataset", stand_in)
    three = read_columns(tmp_path / "dataset", ["action"])["action"]
    run(stand_in_reference, tmp_path / "dataset", stand_in, episodes=5)
    five = read_columns(tmp_path / "dataset", ["action"])["action"]
    np.testing.assert_array_equal(five[: len(three)], three)
    assert len(five) > len(three)


def test_folder_of_another_reference_is_refused(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    run(stand_in_reference, tmp_path / "dataset", stand_in)
    before = contents(tmp_path / "dataset")
    from vid2demo.envs.reference import Reference

    other = tmp_path / "mug.reference.npz"
    Reference.load(stand_in_reference).with_header(scale=0.5).save(other)
    with pytest.raises(UserError, match=r"another reference \(kettle.reference.npz\)"):
        run(other, tmp_path / "dataset", stand_in)
    with pytest.raises(UserError, match="other seed"):
        run(stand_in_reference, tmp_path / "dataset", stand_in, seed=9)
    assert contents(tmp_path / "dataset") == before
    run(other, tmp_path / "dataset", stand_in, force=True)
    assert read_collection(tmp_path / "dataset")["reference"]["name"] == "mug.reference.npz"


def test_foreign_folder_is_never_touched(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("years")
    for force in (False, True):
        with pytest.raises(UserError, match="no dataset that `collect` wrote"):
            run(stand_in_reference, tmp_path / "home", stand_in, force=force)
    assert (tmp_path / "home" / "thesis.txt").read_text() == "years"


def test_two_collects_in_one_place_are_refused(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    def second(done: int, total: int, text: str) -> None:
        run(stand_in_reference, tmp_path / "dataset", stand_in)

    with pytest.raises(UserError, match="another collect is at work"):
        run(stand_in_reference, tmp_path / "dataset", stand_in, progress=second)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"episodes": 0}, "--episodes is 0"),
        ({"workers": 0}, "--workers is 0"),
        ({"image_size": (33, 32)}, "must be even"),
        ({"cameras": ()}, "at least one"),
    ],
)
def test_bad_input(stand_in: str, stand_in_reference: Path, tmp_path: Path, change: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        run(stand_in_reference, tmp_path / "dataset", stand_in, **change)


def test_folder_that_cannot_be_made(stand_in: str, stand_in_reference: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be made"):
        run(stand_in_reference, tmp_path / "file" / "dataset", stand_in)


def test_nothing_asks_the_network(
    stand_in: str, stand_in_reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    run(stand_in_reference, tmp_path / "dataset", stand_in)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    assert len(LeRobotDataset("vid2demo/test", root=tmp_path / "dataset")) == 18


def test_diverged_simulation_is_a_failure_that_is_counted(
    stand_in: str, stand_in_reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Wild:
        def reset(self, env: Any, observation: Any, info: Any) -> None:
            raise PhysicsError("the simulation diverged at step 0")

    monkeypatch.setattr(attempt, "ReferencePlayer", Wild)
    with pytest.raises(UserError, match="the simulation diverged: 20"):
        run(stand_in_reference, tmp_path / "dataset", stand_in)


def test_missing_reference(stand_in: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        run(tmp_path / "no.reference.npz", tmp_path / "dataset", stand_in)


def test_attempt_seeds_are_independent() -> None:
    seeds = {attempt_seed(seed, index) for seed in range(20) for index in range(200)}
    assert len(seeds) == 4000
    assert max(seeds) < 2**53
    assert json.loads(json.dumps(max(seeds))) == max(seeds)
