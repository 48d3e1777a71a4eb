from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay
from vid2demo import cli
from vid2demo.extract.bop import open_dataset
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import transform_points
from vid2demo.extract.household import HOUSEHOLD, household_mesh
from vid2demo.extract.synthetic_bop import CATEGORIES, RENDERED, held_out, object_variants
from vid2demo.extract.synthetic_look import thing_look, vessel_look
from vid2demo.extract.synthetic_table import Thing, photograph, place
from vid2demo.extract.vessels import make_vessel

SIZE = (160, 120)


def some_things(rng: np.random.Generator) -> list[Thing]:
    vessels = [make_vessel(category, 1) for category in ("mug", "bottle", "saucepan")]
    things = [Thing(k + 1, v.mesh, vessel_look(rng, v), True) for k, v in enumerate(vessels)]
    ball, banana = household_mesh("ball", 0), household_mesh("banana", 0)
    return [*things, Thing(8, ball, thing_look(rng, ball), False), Thing(9, banana, thing_look(rng, banana), False)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tables")
    assert cli.main(words(out)) == 0
    return out


def words(out: Path, scenes: int = 2) -> list[str]:
    return ["synthesize", "bop", "--scenes", str(scenes), "--seed", "4", "--size", "160", "120", "--out", str(out)]


def digests(folder: Path) -> dict[str, str]:
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != "run.json")
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.mark.parametrize("category", HOUSEHOLD)
def test_household_things_are_closed_centred_and_of_ordinary_size(category: str) -> None:
    meshes = [household_mesh(category, seed) for seed in range(4)]
    for mesh in meshes:
        assert mesh.is_watertight
        assert mesh.volume > 0
        assert np.allclose(mesh.bounds.mean(axis=0), 0, atol=1e-9)
        assert 0.04 < mesh.extents.max() < 0.4
    assert len({tuple(np.round(mesh.extents, 6)) for mesh in meshes}) == 4
    assert np.array_equal(household_mesh(category, 0).vertices, meshes[0].vertices)


def test_unknown_household_thing_is_refused() -> None:
    with pytest.raises(UserError, match="unknown household thing 'fork'"):
        household_mesh("fork", 0)


@pytest.mark.parametrize("seed", range(3))
def test_things_lie_on_the_table_and_in_nothing_else(seed: int) -> None:
    things = some_things(np.random.default_rng(seed))
    poses = place(np.random.default_rng(seed), things)
    hulls = [t.mesh.convex_hull.copy().apply_transform(T) for t, T in zip(things, poses, strict=True)]
    for thing, T in zip(things, poses, strict=True):
        assert transform_points(T, np.asarray(thing.mesh.vertices))[:, 2].min() == pytest.approx(0, abs=1e-9)
    # Outlines that are apart on the table: no vertex of one hull stands over another's outline.
    for k, hull in enumerate(hulls):
        outline = Delaunay(hull.vertices[:, :2])
        for other in (h for n, h in enumerate(hulls) if n != k):
            assert np.all(outline.find_simplex(other.vertices[:, :2]) < 0)


def test_truth_is_what_the_picture_shows() -> None:
    """Depth against a ray caster, masks against the depth, both at the pixels' centres."""
    rng = np.random.default_rng(7)
    things = some_things(rng)
    frame, _ = photograph(rng, things, SIZE)
    scene, owner = [], []
    for k, (thing, instance) in enumerate(zip(things, frame.instances, strict=True)):
        scene.append(thing.mesh.copy().apply_transform(instance.T_camera_object))
        owner += [k] * len(thing.mesh.faces)
    world = trimesh.util.concatenate(scene)
    some = rng.integers([0, 0], SIZE, (300, 2))
    rays = np.column_stack([some, np.ones(len(some))]) @ np.linalg.inv(frame.camera_matrix).T
    hits, ray, face = world.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    seen = np.full(len(some), -1)
    seen[ray] = np.asarray(owner)[face]
    labels = np.full(SIZE[::-1], -1)
    for k, instance in enumerate(frame.instances):
        assert not np.any(instance.visible & ~instance.mask)
        labels[instance.visible] = k
    at = labels[some[:, 1], some[:, 0]]
    assert np.mean(at == seen) > 0.98  # a ray along an outline may go either way
    agree = (at == seen)[ray]
    depth_m = frame.depth_m[some[:, 1], some[:, 0]][ray]
    assert np.abs(depth_m - hits[:, 2])[agree].max() < 1e-3
    assert agree.sum() > 20


def test_picture_and_masks_lie_on_each_other() -> None:
    """A black and a white world differ just where the things are."""
    ball = household_mesh("ball", 1)
    pictures = []
    for shade in (0, 255):
        look = thing_look(np.random.default_rng(0), ball)
        look.texture[:] = shade
        frame, _ = photograph(np.random.default_rng(5), [Thing(1, ball, look, False)], SIZE)
        pictures.append(frame.rgb.astype(float).mean(axis=-1))
    changed = pictures[1] - pictures[0] > 25
    mask = frame.instances[0].visible
    assert np.count_nonzero(changed & mask) / np.count_nonzero(changed | mask) > 0.9


def test_the_data_set_is_whole(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert len(dataset.images) == 2
    assert set(dataset.models) == set(object_variants())
    categories = json.loads((folder / "categories.json").read_text())
    assert len(set(categories.values())) == len(CATEGORIES) >= 16
    for image in dataset.images:
        objects = dataset.objects(image)
        assert 5 <= len(objects) <= 8
        assert len({categories[str(o.obj_id)] for o in objects}) == len(objects)
    assert {t.obj_id for t in dataset.targets if t.image == dataset.images[0]} <= {
        o.obj_id for o in dataset.objects(dataset.images[0])
    }
    info = dataset.models[1]
    assert dataset.mesh(1).extents == pytest.approx(info.extents_m, abs=1e-6)
    assert dataset.mesh(1).extents == pytest.approx(make_vessel("mug", 0).mesh.extents, abs=1e-5)


def test_the_database_holds_none_of_what_is_rendered(folder: Path) -> None:
    entries = json.loads((folder / "database.json").read_text())
    assert entries == held_out()
    assert {e["category"] for e in entries} == set(CATEGORIES)
    rendered = set(object_variants().values())
    for entry in entries:
        assert (entry["category"], int(entry["name"].rpartition("_")[2])) not in rendered
        if "library" in entry:
            assert entry["library"]["seed"] >= RENDERED
        mesh = trimesh.load(folder / entry["file"])
        assert 0.03 < mesh.extents.max() < 0.6


def test_equal_seeds_give_equal_files_and_nothing_is_done_twice(folder: Path, tmp_path: Path) -> None:
    before = digests(folder)
    assert cli.main(words(tmp_path / "again")) == 0
    assert digests(tmp_path / "again") == before
    lost = tmp_path / "again/test/000001/rgb/000000.png"
    kept = (tmp_path / "again/test/000000/rgb/000000.png").stat().st_mtime_ns
    lost.unlink()
    assert cli.main(words(tmp_path / "again")) == 0
    assert digests(tmp_path / "again") == before
    assert (tmp_path / "again/test/000000/rgb/000000.png").stat().st_mtime_ns == kept


def test_impossible_numbers_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words(tmp_path, scenes=0)) == 2
    assert "--scenes 0" in capsys.readouterr().err
