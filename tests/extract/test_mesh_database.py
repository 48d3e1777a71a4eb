"""The database of meshes and views: nothing done twice, nothing lost, no row under another's name."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from vid2demo.cli import main
from vid2demo.extract.errors import UserError
from vid2demo.extract.mesh_sources import find_sources, library_sources
from vid2demo.extract.mesh_store import MeshStore, mesh_key
from vid2demo.extract.onboarding import onboard, read_source
from vid2demo.extract.templates import ViewSettings

FEW = ViewSettings(count=6)


def write_boxes(folder: Path, count: int, scale: float = 0.1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        trimesh.creation.box(np.array([1.0, 0.5 + 0.1 * k, 0.3]) * scale).export(folder / f"box_{k}.ply")


def files_of(store: MeshStore) -> dict[str, int]:
    return {
        str(p.relative_to(store.root)): p.stat().st_mtime_ns
        for p in store.root.rglob("*")
        if p.is_file() and "index" not in p.parts
    }


def test_every_mesh_of_a_folder_is_stored_under_its_own_name(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 4)
    result = onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    assert sorted(result.stored) == [f"box_{k}" for k in range(4)]
    store = MeshStore.open(tmp_path / "db")
    index = store.index()
    for row, about in enumerate(index.about()):
        again = read_source(next(s for s in find_sources(tmp_path / "in") if s.name == about.name))
        assert mesh_key(again) == index.keys[row]
        record = store.views(index.keys[row])
        np.testing.assert_array_equal(index.summary[row], record["summary"])
        assert np.linalg.norm(index.average[row]) == pytest.approx(1.0, abs=1e-4)
    assert store.check() == []


def test_a_mesh_of_a_folder_named_from_here_is_found_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_boxes(tmp_path / "in", 1)
    monkeypatch.chdir(tmp_path)
    (source,) = find_sources(Path("in"))
    monkeypatch.chdir("/")
    assert Path(read_source(source).about.source).is_file()


def test_normalisation_can_be_undone_and_keeps_the_size(tmp_path: Path) -> None:
    box = trimesh.creation.box([120.0, 80.0, 40.0])  # millimetres
    box.apply_translation([7.0, -3.0, 50.0])
    box.export(tmp_path / "box.stl")
    stored = read_source(find_sources(tmp_path)[0])
    assert np.abs(stored.mesh.vertices).max() == pytest.approx(1.0)
    assert (stored.about.unit, stored.about.half_extent) == ("mm", 60.0)
    np.testing.assert_allclose(stored.about.extents_m, [0.12, 0.08, 0.04], rtol=1e-6)
    back = stored.mesh.vertices * stored.about.half_extent + stored.about.centre
    np.testing.assert_allclose([back.min(axis=0), back.max(axis=0)], box.bounds, atol=1e-4)


def test_a_mesh_without_a_sensible_size_is_stored_with_its_size_open(tmp_path: Path) -> None:
    trimesh.creation.box([5000.0, 5000.0, 9000.0]).export(tmp_path / "hall.ply")
    about = read_source(find_sources(tmp_path)[0]).about
    assert (about.unit, about.extents_m) == ("", (0.0, 0.0, 0.0))


def test_broken_meshes_are_told_about_and_left_out(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 2)
    (tmp_path / "in" / "torn.glb").write_bytes(b"glTF\x02\x00\x00\x00nothing")
    (tmp_path / "in" / "empty.obj").write_text("# nothing here\n")
    (tmp_path / "in" / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    result = onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    assert sorted(name for name, _ in result.failed) == ["empty", "nan", "torn"]
    assert all(reason for _, reason in result.failed)
    assert len(MeshStore.open(tmp_path / "db").index()) == 2


def test_a_second_run_does_nothing_twice_and_a_new_file_is_added(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 3)
    onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    store = MeshStore.open(tmp_path / "db")
    before = files_of(store)
    write_boxes(tmp_path / "in", 4)
    (tmp_path / "in" / "box_1.ply").rename(tmp_path / "in" / "renamed.ply")
    result = onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    assert (result.stored, len(result.before)) == (["box_3"], 3)
    after = files_of(store)
    assert {name: after[name] for name in before} == before
    assert len(store.index()) == 4
    assert store.check() == []


def test_equal_meshes_are_stored_once(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 1)
    shutil.copy(tmp_path / "in" / "box_0.ply", tmp_path / "in" / "copy.ply")
    result = onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    assert (result.stored, result.same) == (["box_0"], ["copy"])


def test_killed_between_views_and_their_note_a_mesh_was_there_before(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 2)
    onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    for note in (tmp_path / "db" / "sources").rglob("*.json"):
        note.unlink()
    result = onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    assert (result.stored, result.same, result.before) == ([], [], ["box_0", "box_1"])


@pytest.mark.slow
def test_killed_half_way_nothing_is_lost_or_done_twice(tmp_path: Path) -> None:
    database = tmp_path / "db"
    code = (
        "from vid2demo.extract.onboarding import onboard\n"
        "from vid2demo.extract.mesh_sources import library_sources\n"
        "from vid2demo.extract.templates import ViewSettings\n"
        f"onboard(library_sources(1)[:8], {str(database)!r}, settings=ViewSettings(count=30))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"OMP_NUM_THREADS": "1"})
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline and len(list(database.glob("views/*/??/[!.]*.npy"))) < 3:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    # Names that begin with a dot are of files the writer was in the middle of.
    finished = {p: p.stat().st_mtime_ns for p in database.glob("views/*/??/[!.]*.npy")}
    assert 3 <= len(finished) < 8
    # What a killed writer leaves in the middle of a file.
    half = next(iter(finished)).with_name(".half.1.part.npy")
    half.write_bytes(b"half")
    result = onboard(library_sources(1)[:8], database, settings=ViewSettings(count=30))
    assert len(result.before) + len(result.stored) == 8
    assert len(result.stored) <= 8 - len(finished) + 1  # of the last one the note may be missing, not the views
    assert {p: p.stat().st_mtime_ns for p in finished} == finished
    assert not list(database.rglob("*.part*"))
    assert MeshStore.open(database).check() == []


@pytest.mark.slow
def test_workers_give_what_one_process_gives(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 3)
    onboard(find_sources(tmp_path / "in"), tmp_path / "one", settings=FEW)
    onboard(find_sources(tmp_path / "in"), tmp_path / "two", settings=FEW, workers=2)
    one, two = (MeshStore.open(tmp_path / name).index() for name in ("one", "two"))
    assert one.keys == two.keys
    np.testing.assert_array_equal(one.summary, two.summary)


def test_check_finds_swapped_records_false_rows_and_changed_meshes(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 3)
    onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    store = MeshStore.open(tmp_path / "db")
    first, second, third = store.keys()
    a, b = (store.views_folder / k[:2] / f"{k}.npy" for k in (first, second))
    content = a.read_bytes()
    a.write_bytes(b.read_bytes())
    assert any("not of that mesh" in problem for problem in store.check())
    a.write_bytes(content)
    assert store.check() == []
    column = store.index().folder / "summary.npy"
    rows = np.load(column)
    np.save(column, rows[::-1])
    assert sum("holds another summary" in problem for problem in store.check()) == 2  # the middle row stays its own
    np.save(column, rows)
    shutil.copy(store.root / "meshes" / first[:2] / f"{first}.npz", store.root / "meshes" / third[:2] / f"{third}.npz")
    assert any("mesh has changed" in problem for problem in store.check())


def test_the_index_follows_what_is_stored(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 3)
    onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    store = MeshStore.open(tmp_path / "db")
    gone = store.keys()[1]
    (store.views_folder / gone[:2] / f"{gone}.npy").unlink()
    index = store.index()
    assert gone not in index.keys
    assert len(index.about()) == len(index.average) == 2
    assert store.check() == []


def test_one_database_holds_several_settings(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 1)
    for count in (6, 12):
        onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=ViewSettings(count=count))
    with pytest.raises(UserError, match="several that fit"):
        MeshStore.open(tmp_path / "db")
    assert MeshStore.open(tmp_path / "db", views=12).settings.count == 12
    assert len(list((tmp_path / "db" / "meshes").rglob("*.npz"))) == 1


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    write_boxes(tmp_path / "in", 1)
    onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)
    with MeshStore.open(tmp_path / "db").only_writer(), pytest.raises(UserError, match="at work"):
        onboard(find_sources(tmp_path / "in"), tmp_path / "db", settings=FEW)


def test_folders_that_are_no_database_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    write_boxes(tmp_path / "in", 1)
    with pytest.raises(UserError, match="no mesh database"):
        onboard(find_sources(tmp_path / "in"), tmp_path, settings=FEW)
    with pytest.raises(UserError, match="no mesh database"):
        MeshStore.open(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no mesh file"):
        find_sources(tmp_path / "empty")


def test_layouts_of_the_great_collections(tmp_path: Path) -> None:
    box = trimesh.creation.box([0.1, 0.1, 0.2])
    uid = "0123456789abcdef0123456789abcdef"
    glb = tmp_path / "objaverse" / "glbs" / "000-023" / f"{uid}.glb"
    scanned = tmp_path / "gso" / "Cole_Hardware_Mug" / "meshes" / "model.obj"
    for path in (glb, scanned, tmp_path / "own" / "jug" / "a.ply", tmp_path / "own" / "RedCoffeeMug_2.ply"):
        path.parent.mkdir(parents=True, exist_ok=True)
        box.export(path)
    with gzip.open(tmp_path / "objaverse" / "lvis-annotations.json.gz", "wt") as stream:
        json.dump({"coffee_maker": [uid]}, stream)
    (scanned.parents[1] / "metadata.pbtxt").write_text('annotations {\n  categories { first: "Mug" }\n}\n')
    found = {s.name: s.category for k in ("objaverse", "gso", "own") for s in find_sources(tmp_path / k)}
    assert found == {uid: "coffee_maker", "Cole_Hardware_Mug": "Mug", "a": "jug", "RedCoffeeMug_2": "mug"}


def test_textures_of_scanned_objects_are_found_beside_the_mesh(tmp_path: Path) -> None:
    from PIL import Image

    folder = tmp_path / "Thing" / "meshes"
    folder.mkdir(parents=True)
    textures = tmp_path / "Thing" / "materials" / "textures"
    textures.mkdir(parents=True)
    Image.new("RGB", (8, 8), (200, 30, 40)).save(textures / "texture.png")
    (folder / "model.mtl").write_text("newmtl m\nmap_Kd texture.png\n")
    lines = ["mtllib model.mtl", "usemtl m", "v 0 0 0", "v 0.1 0 0", "v 0 0.1 0", "v 0 0 0.1"]
    lines += ["vt 0.5 0.5", "f 1/1 2/1 3/1", "f 1/1 2/1 4/1"]
    (folder / "model.obj").write_text("\n".join(lines))
    colors = read_source(find_sources(tmp_path)[0]).mesh.colors
    np.testing.assert_allclose(colors, np.tile([200, 30, 40], (len(colors), 1)), atol=2)


def test_the_commands_tell_what_is_in_a_database(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_boxes(tmp_path / "in" / "crate", 2)
    (tmp_path / "in" / "torn.obj").write_text("v 0 0\n")
    words = ["meshes", "onboard", str(tmp_path / "in"), "--out", str(tmp_path / "db"), "--views", "6"]
    assert main(words) == 1  # one was left out
    assert "left out: torn" in capsys.readouterr().out
    database = ["--db", str(tmp_path / "db")]
    assert main(["meshes", "list", *database]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [["box_0", "crate"], ["box_1", "crate"]]
    assert all("0.100 x 0.0" in line and "6 views" in line and "box_" in line.split()[-1] for line in lines)
    assert main(["meshes", "show", "box_1", *database, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["extents_m"] == pytest.approx([0.1, 0.06, 0.03])
    assert main(["meshes", "show", "crate", *database]) == 2
    assert "box_0, box_1" in capsys.readouterr().err
    assert main(["meshes", "check", *database]) == 0
    store = MeshStore.open(tmp_path / "db")
    first, second = (store.views_folder / k[:2] / f"{k}.npy" for k in store.index().keys)
    shutil.copy(first, second)
    assert main(["meshes", "check", *database]) == 1


def test_the_library_needs_no_database(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["meshes", "list"]) == 0
    assert "gooseneck kettle" in capsys.readouterr().out.replace("_", " ")
    assert main(["meshes", "show", "mug", "--seed", "3"]) == 0
    assert "mug" in capsys.readouterr().out
