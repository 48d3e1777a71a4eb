"""Features of crops and the search for the mesh they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vid2demo.extract.errors import UserError
from vid2demo.extract.features import ClassicalFeatures, foreground_average, make_features, object_cells, unit
from vid2demo.extract.geometry import make_pose, super_fibonacci_rotations
from vid2demo.extract.mesh_sources import library_sources
from vid2demo.extract.mesh_store import MeshStore
from vid2demo.extract.onboarding import onboard, read_source
from vid2demo.extract.protocols import PatchFeatures
from vid2demo.extract.retrieval import Look, Retriever, look_at_object, matches, spread_frames, vote
from vid2demo.extract.segment import mask_box
from vid2demo.extract.shading import render_picture
from vid2demo.extract.templates import ViewSettings, crop_picture, template_picture, template_view

CAMERA = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
CATEGORIES = ("mug", "wine_glass", "saucepan", "bottle", "watering_can")
FEATURES = ClassicalFeatures()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> MeshStore:
    """One vessel of each of five categories in 60 views."""
    root = tmp_path_factory.mktemp("database") / "db"
    sources = [s for s in library_sources(1) if s.category in CATEGORIES]
    onboard(sources, root, settings=ViewSettings(count=60))
    return MeshStore.open(root)


def looks(category: str, seed: int, count: int = 4) -> Look:
    """Pictures of a vessel that is not stored, in rotations of their own."""
    source = next(s for s in library_sources(seed + 1) if s.name == f"{category}:{seed}")
    mesh = read_source(source).mesh.scaled(0.1)
    frames = []
    for R in super_fibonacci_rotations(97)[5 :: 90 // count][:count]:
        picture = render_picture(
            mesh.vertices, mesh.faces, mesh.colors, make_pose(R, (0.05, -0.03, 0.7)), CAMERA, (640, 480)
        )
        frames.append((picture.rgb, picture.mask))
    return look_at_object(FEATURES, 0.05, frames)


def test_classical_features_keep_the_protocol() -> None:
    assert isinstance(FEATURES, PatchFeatures)
    rng = np.random.default_rng(0)
    grid = FEATURES.encode(rng.integers(0, 255, (2, 120, 120, 3), np.uint8), rng.random((2, 120, 120)) > 0.5)
    assert grid.patches.shape == (2, FEATURES.grid, FEATURES.grid, FEATURES.patch_size)
    assert grid.summary.shape == (2, FEATURES.summary_size)
    assert np.isfinite(grid.patches).all()


def test_features_of_nothing_and_of_everything_are_finite() -> None:
    black = np.zeros((2, 120, 120, 3), np.uint8)
    grid = FEATURES.encode(black, np.stack([np.zeros((120, 120), bool), np.ones((120, 120), bool)]))
    assert np.isfinite(grid.patches).all()
    assert np.isfinite(grid.summary).all()
    assert not grid.summary[0].any()


def test_summary_is_of_shape_not_of_colour() -> None:
    mask = np.zeros((120, 120), bool)
    mask[20:100, 40:80] = True
    dark, light = (np.where(mask[..., None], np.uint8(v), np.uint8(0)) * np.ones(3, np.uint8) for v in (40, 220))
    turned = np.rot90(mask)
    summary = unit(FEATURES.encode(np.stack([dark, light, np.rot90(light)]), np.stack([mask, mask, turned])).summary)
    assert summary[0] @ summary[1] > 0.98
    assert summary[0] @ summary[2] < 0.3


def test_what_hides_a_part_changes_the_summary_less_than_another_shape_does() -> None:
    rows, columns = np.mgrid[:120, :120]
    disc = np.hypot(rows - 60, columns - 50) < 44
    ring = np.abs(np.hypot(rows - 60, columns - 98) - 14) < 4  # a handle
    whole, hidden = disc | ring, (disc | ring) & (rows + columns < 150)
    masks = np.stack([whole, hidden, disc, (disc | ring) & (rows > 0)])
    crops = np.where(masks[..., None], np.uint8(150), np.uint8(0)) * np.ones(3, np.uint8)
    mug, covered, ball, same = FEATURES.encode(crops, masks).summary
    assert mug @ same > 0.99
    assert mug @ ball < mug @ covered


def test_average_over_object_cells_is_that_of_a_loop() -> None:
    rng = np.random.default_rng(1)
    patches, masks = rng.normal(size=(3, 30, 30, 5)).astype(np.float32), rng.random((3, 120, 120)) > 0.97
    cells = object_cells(masks, 30)
    for b in range(3):
        total, count = np.zeros(5), 0
        for i in range(30):
            for j in range(30):
                covered = masks[b, 4 * i : 4 * i + 4, 4 * j : 4 * j + 4].any()
                assert covered == cells[b, i, j]
                if covered:
                    total += patches[b, i, j]
                    count += 1
        np.testing.assert_allclose(foreground_average(patches, cells)[b], total / count, rtol=1e-4, atol=1e-5)
    # A grid that does not divide the crop: any overlap still counts.
    odd = object_cells(masks[:, :119, :119], 30)
    assert odd.shape == (3, 30, 30)
    assert odd.sum() >= cells.sum() * 0.9


def test_a_view_is_cropped_as_a_picture_of_it_is(store: MeshStore) -> None:
    mesh = store.mesh(store.keys()[0]).mesh
    for index in (0, 17, 40):
        picture = template_picture(mesh, store.settings, index)
        view = template_view(mesh, store.settings, index, 120)
        _, mask = crop_picture(picture.rgb, picture.mask, mask_box(picture.mask), 0.05, 120)
        assert np.count_nonzero(mask & view.mask) / np.count_nonzero(mask | view.mask) > 0.96


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_vessel_that_is_not_stored_finds_its_category(store: MeshStore, category: str) -> None:
    hits = Retriever(store).retrieve(looks(category, 3), top=3)
    assert hits[0].about.category == category
    assert hits[0].score >= hits[1].score >= hits[2].score
    assert 0 <= hits[0].best_view < 60


def test_without_views_the_short_list_decides(store: MeshStore) -> None:
    retriever = Retriever(store)
    look = looks("bottle", 3)
    hits = retriever.retrieve(look, top=5, best_views=0)
    scores = [float((retriever.index.summary[k] @ look.descriptors("summary")[:, 0].T).mean()) for k in range(5)]
    np.testing.assert_allclose([h.score for h in hits], sorted(scores, reverse=True), atol=1e-5)
    assert {h.best_view for h in hits} == {-1}
    assert len(retriever.retrieve(look, top=5, short_list=2)) == 2


def test_the_average_over_patches_can_be_asked_for(store: MeshStore) -> None:
    hits = Retriever(store, "average").retrieve(looks("watering_can", 3), top=5)
    assert sorted(h.about.category for h in hits) == sorted(CATEGORIES)


def test_a_word_narrows_the_search(store: MeshStore) -> None:
    retriever = Retriever(store)
    assert {h.about.category for h in retriever.retrieve(looks("bottle", 3), text="glass")} == {"wine_glass"}
    assert retriever.retrieve(looks("bottle", 3), text="coffee mug")[0].about.category == "mug"
    with pytest.raises(UserError, match=r"'bicycle'.*bottle"):
        retriever.retrieve(looks("bottle", 3), text="bicycle")
    about = retriever.abouts[0]
    assert matches(about, about.category.upper().replace("_", "-"))


def test_a_picture_turned_in_its_plane_is_seen_as_one_that_was_not(store: MeshStore) -> None:
    """A quarter turn of the picture, undone by the turn of the look."""
    mesh = store.mesh(store.keys()[0]).mesh.scaled(0.1)
    picture = render_picture(
        mesh.vertices, mesh.faces, mesh.colors, make_pose(None, (0.0, 0.0, 0.7)), CAMERA, (640, 480)
    )
    look = look_at_object(FEATURES, 0.05, [(picture.rgb, picture.mask)], [0.0, np.pi / 2])
    turned = (np.rot90(picture.rgb, -1).copy(), np.rot90(picture.mask, -1).copy())
    again = look_at_object(FEATURES, 0.05, [turned], [0.0])
    np.testing.assert_array_equal(look.boxes_px[0, 1], look.boxes_px[0, 0][::-1])
    assert float(look.descriptors("summary")[0, 1] @ again.descriptors("summary")[0, 0]) > 0.995
    assert np.mean(look.cells[0, 1] == again.cells[0, 0]) > 0.98


def test_an_empty_database_and_an_empty_mask_are_told(tmp_path: Path) -> None:
    empty = MeshStore.create(tmp_path / "db", ViewSettings(count=6), FEATURES)
    with pytest.raises(UserError, match="is empty"):
        Retriever(empty).retrieve(looks("mug", 3, 1))
    with pytest.raises(UserError, match="mask of frame 0 is empty"):
        look_at_object(FEATURES, 0.05, [(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), bool))])
    with pytest.raises(UserError, match="unknown patch features"):
        make_features("nothing")


def test_frames_vote_with_their_mean() -> None:
    rng = np.random.default_rng(2)
    matrix, frames = rng.normal(size=(50, 8)).astype(np.float32), rng.normal(size=(7, 8)).astype(np.float32)
    np.testing.assert_allclose(vote(matrix, frames), (matrix @ frames.T).mean(axis=1), rtol=1e-4, atol=1e-5)


@given(st.lists(st.booleans(), max_size=200), st.integers(1, 40))
def test_frames_are_spread_over_those_in_view(shown: list[bool], count: int) -> None:
    visible = np.array(shown, bool)
    found = spread_frames(visible, count)
    assert visible[found].all()
    assert len(found) == len(set(found.tolist())) == min(count, int(visible.sum()))
    if len(found) > 1:
        inside = np.flatnonzero(visible)
        assert {found[0], found[-1]} == {inside[0], inside[-1]}
        gaps = np.diff(np.searchsorted(inside, found))
        assert gaps.max() - gaps.min() <= 1
