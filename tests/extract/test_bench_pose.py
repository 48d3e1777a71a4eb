"""The method over a small data set by its commands, up to a line of the paper's table."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from vid2demo import cli
from vid2demo.extract.bop_results import read_results
from vid2demo.extract.bop_write import write_models, write_scene
from vid2demo.extract.household import household_mesh
from vid2demo.extract.proposal_metrics import read_proposals
from vid2demo.extract.synthetic_look import thing_look, vessel_look
from vid2demo.extract.synthetic_table import Thing, photograph
from vid2demo.extract.vessels import make_vessel

SHOWN = ("saucepan", "bottle", "book")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A picture of three things, a database of other variants of them, and one of themselves."""
    out = tmp_path_factory.mktemp("bench")
    rng = np.random.default_rng(2)
    things = []
    for obj_id, name in enumerate(SHOWN, start=1):
        if name == "book":
            mesh = household_mesh(name, 0)
            things.append(Thing(obj_id, mesh, thing_look(rng, mesh), True))
        else:
            vessel = make_vessel(name, 0)
            things.append(Thing(obj_id, vessel.mesh, vessel_look(rng, vessel), True))
    write_models(out / "set", {t.obj_id: t.mesh for t in things})
    write_scene(out / "set", "test", 0, [photograph(rng, things, (320, 240))[0]])
    entries = []
    for name in SHOWN:
        mesh = household_mesh(name, 5) if name == "book" else make_vessel(name, 5).mesh
        (out / "others" / name).mkdir(parents=True)
        mesh.export(out / "others" / name / f"{name}_5.ply")
        entries.append({"name": f"{name}_5", "category": name, "file": f"others/{name}/{name}_5.ply"})
    (out / "set/categories.json").write_text(json.dumps(dict(enumerate(SHOWN, start=1))))
    (out / "set/database.json").write_text(json.dumps(entries))
    for source, unit, db in (("others", "m", "db"), ("set/models", "mm", "own")):
        words = ["meshes", "onboard", str(out / source), "--unit", unit, "--out", str(out / db), "--views", "80"]
        assert cli.main(words) == 0
    return out


def posed(folder: Path, *words: str) -> Path:
    out = folder / "-".join(["out", *words])
    assert cli.main(["bench", "pose", str(folder / "set"), "--out", str(out), *words]) == 0
    return out


def judged(folder: Path, results: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    capsys.readouterr()
    assert cli.main(["eval-bop", str(folder / "set"), str(results), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_retrieved_meshes_fill_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = posed(folder, "--db", str(folder / "db"))
    scores = judged(folder, out / "poses.csv", capsys)
    assert scores["ar_pch"] > 60
    assert scores["category_percent"] == pytest.approx(100)
    files = [f"classical-ffa={out / name}" for name in ("poses.csv", "figures.json")]
    words = ["bench", "table", "--name", "retrieval", "--dataset", str(folder / "set"), "--json", "--results", *files]
    assert cli.main(words) == 0
    rows = {row["key"]: row["measured"] for row in json.loads(capsys.readouterr().out)["rows"]}
    assert rows["classical-ffa"]["ar"] == pytest.approx(scores["ar"])
    assert rows["classical-ffa"]["category_top5_percent"] == pytest.approx(100)


def test_true_meshes_and_sizes_are_the_oracle(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = posed(folder, "--db", str(folder / "own"), "--meshes", "true", "--sizes", "true")
    assert {e.obj_id for e in read_results(out / "poses.csv")} == {1, 2, 3}
    scores = judged(folder, out / "poses.csv", capsys)
    assert scores["scale_error_percent"] == pytest.approx(0, abs=1e-3)
    assert scores["ar_cou"] > 50


def test_a_constant_size_is_a_constant(folder: Path) -> None:
    out = posed(folder, "--db", str(folder / "db"), "--sizes", "constant")
    assert {e.size_m for e in read_results(out / "poses.csv")} == {0.1}


def test_proposed_masks_are_written_too(folder: Path) -> None:
    out = posed(folder, "--db", str(folder / "db"), "--masks", "proposed", "--level", "classical")
    found = read_proposals(out / "proposals.json")
    assert sum(map(len, found.values())) == len(read_results(out / "poses.csv")) >= 1
    assert "category_percent" not in json.loads((out / "figures.json").read_text())["figures"]


def test_a_missing_database_is_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "pose", str(folder / "set"), "--db", str(tmp_path / "gone"), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    assert "gone" in capsys.readouterr().err
