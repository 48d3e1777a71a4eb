from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tyro
from vid2demo import cli
from vid2demo.extract.bop import ImageKey
from vid2demo.extract.bop_results import Estimate, write_results
from vid2demo.extract.bop_write import Frame, Instance, write_models, write_scene
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose
from vid2demo.extract.paper_tables import TABLES
from vid2demo.extract.proposal_metrics import ProposedMask, write_proposals
from vid2demo.extract.raster import render_depth
from vid2demo.extract.tables import as_text, fill_table

PAPER = Path(__file__).parents[2].parent / "shared/docs/freepose_paper.tex"
CAMERA = np.array([[200.0, 0.0, 39.5], [0.0, 200.0, 29.5], [0.0, 0.0, 1.0]])
T = make_pose(t=(0.0, 0.0, 0.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of one picture of one box, with the true pose and the true mask as results."""
    import trimesh

    out = tmp_path_factory.mktemp("set")
    box = trimesh.creation.box((0.06, 0.05, 0.04))
    write_models(out, {1: box})
    window = render_depth(np.asarray(box.vertices), np.asarray(box.faces, np.int32), T, CAMERA)
    assert window is not None
    mask = window.mask_in_image(80, 60)
    picture = np.zeros((60, 80, 3), np.uint8)
    frame = Frame(0, picture, np.ones((60, 80), np.float32), CAMERA, (Instance(1, T, mask, mask),))
    write_scene(out, "test", 0, [frame])
    write_results(out / "poses.csv", [Estimate(ImageKey(0, 0), 1, 1.0, T, 0.3)])
    write_proposals(out / "proposals.json", {ImageKey(0, 0): [ProposedMask(mask, 1.0)]})
    return out


def row_of(table: dict[str, object], key: str) -> dict[str, dict[str, float | None]]:
    rows = table["rows"]
    assert isinstance(rows, list)
    (row,) = [row for row in rows if row["key"] == key]
    return dict(row)


@pytest.mark.parametrize("name", TABLES)
def test_every_row_without_figures_says_what_fills_it(name: str) -> None:
    table = fill_table(name)
    text = as_text(table)
    for row in table["rows"]:
        assert row["title"] in text
        assert not row["how"] or f"--results {row['key']}=FILE" in text
    assert len({row.key for row in TABLES[name].rows}) == len(TABLES[name].rows)


@pytest.mark.parametrize("name", TABLES)
def test_the_commands_that_fill_a_row_exist_as_they_are_written(name: str) -> None:
    for row in TABLES[name].rows:
        for command in (part.split() for part in row.how.split("; ") if part.startswith("vid2demo ")):
            called = next(words for words in (" ".join(command[1:3]), command[1]) if words in cli.COMMANDS)
            words = command[1 + len(called.split()) :]
            assert tyro.cli(cli.COMMANDS[called], args=words, config=(tyro.conf.FlagCreatePairsOff,)) is not None


@pytest.mark.skipif(not PAPER.exists(), reason="needs ../shared")
@pytest.mark.parametrize("name", TABLES)
def test_the_reference_figures_are_those_the_paper_prints(name: str) -> None:
    printed = {float(word) for word in re.findall(r"(?<![\w.])\d+(?:\.\d+)?", PAPER.read_text())}
    for row in TABLES[name].rows:
        for figures in row.paper.values():
            assert all(np.isnan(v) or v in printed for v in figures), row.title


def test_the_paper_s_average_recall_is_the_mean_of_the_three() -> None:
    for name in ("main", "retrieval", "views"):
        for row in TABLES[name].rows:
            for where, (ar, *others) in row.paper.items():
                # One of the printed figures (GigaPose on DTTD2) is 0.01 off.
                assert ar == pytest.approx(np.mean(others[:3]), abs=0.02), (row.title, where)


def test_poses_and_proposals_fill_a_row(folder: Path) -> None:
    results = [f"ours={folder / 'poses.csv'}", f"ours={folder / 'proposals.json'}"]
    measured = row_of(fill_table("proposals", results, dataset=folder), "ours")["measured"]
    assert measured["ap"] == pytest.approx(100)
    assert measured["ar_at_10"] == pytest.approx(100)
    assert measured["per_image"] == 1
    assert measured["scale_error_percent"] == pytest.approx(0, abs=1e-3)


def test_what_eval_bop_printed_fills_a_row_too(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval-bop", str(folder), str(folder / "poses.csv"), "--json"]) == 0
    (tmp_path / "scores.json").write_text(capsys.readouterr().out)
    table = fill_table("main", [f"foundpose={tmp_path / 'scores.json'}"])
    assert row_of(table, "foundpose")["measured"] == {"ar": 100, "ar_cou": 100, "ar_ch": 100, "ar_pch": 100}
    assert row_of(table, "megapose")["measured"]["ar"] is None


def test_errors_of_several_tracks_are_averaged(tmp_path: Path) -> None:
    for k in (1, 3):
        errors = {"e_rot": 1.0 * k, "e_proj": 0.1 * k, "e_depth": 0.01 * k}
        (tmp_path / f"{k}.json").write_text(json.dumps({"velocity": {"official": errors}}))
    table = fill_table("video", [f"refined={tmp_path / f'{k}.json'}" for k in (1, 3)])
    assert row_of(table, "refined")["measured"] == pytest.approx({"e_rot": 2.0, "e_proj": 0.2, "e_depth": 0.02})


def test_a_blind_guess_is_told_by_the_database(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "set")
    entries = [{"name": f"{c}{k}", "category": c, "file": f"{c}{k}.ply"} for c in "abcd" for k in range(3)]
    (tmp_path / "set/database.json").write_text(json.dumps(entries))
    (tmp_path / "ffa.json").write_text('{"figures": {"category_percent": 81.5}}')
    table = fill_table("retrieval", [f"classical-ffa={tmp_path / 'ffa.json'}"], dataset=tmp_path / "set")
    chance = row_of(table, "chance")["measured"]
    rng = np.random.default_rng(0)
    draws = np.array([rng.permutation(12)[:5] // 3 for _ in range(20_000)])
    assert chance["category_percent"] == pytest.approx(25)
    assert chance["category_top5_percent"] == pytest.approx(100 * np.mean((draws == 0).any(axis=1)), abs=1.5)
    assert row_of(table, "classical-ffa")["measured"]["category_percent"] == 81.5


def test_views_know_their_own_spacing() -> None:
    table = fill_table("views")
    spacing = [row_of(table, f"views-{n}")["measured"]["spacing_deg"] for n in (600, 1200, 1800)]
    assert spacing == pytest.approx([25.5, 20.5, 16.0], abs=0.1)


def test_bad_input_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    bad = {
        "names no row of the table main; give ROW=FILE with megapose-coarse": ["mine=a.csv"],
        "names no row": ["ours"],
        "beside its data set": [f"ours={folder / 'poses.csv'}"],
        "neither poses, proposals nor errors": [f"ours={tmp_path / 'other.json'}"],
        "does not exist": [f"ours={tmp_path / 'gone.json'}"],
    }
    for message, results in bad.items():
        with pytest.raises(UserError, match=message):
            fill_table("main", results)
    with pytest.raises(UserError, match="no table 'best'"):
        fill_table("best")


def test_the_command_prints_the_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "table", "--name", "main", "--dataset", str(folder), "--results", f"ours={folder / 'poses.csv'}"]
    assert cli.main(words) == 0
    told = capsys.readouterr().out
    assert "49.86" in told
    assert "100.00" in told
    assert cli.main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "main"
