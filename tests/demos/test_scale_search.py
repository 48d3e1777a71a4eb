from __future__ import annotations

import numpy as np
import pytest
from vid2demo.demos.retarget import retarget
from vid2demo.demos.scale_search import (
    ENOUGH,
    MOST_TRIES,
    pours,
    search_scale,
    tipped_further,
    with_receptacle_moved,
)
from vid2demo.envs.builtin import builtin_reference
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError


@pytest.fixture(scope="module")
def faithful() -> Reference:
    return builtin_reference()


def no_other(scale: float) -> Reference:
    raise UserError(f"scale {scale:.2f} does not fit")


def test_what_pours_well_is_kept_as_it_is_after_one_try(faithful: Reference) -> None:
    kept = search_scale(faithful, no_other)
    np.testing.assert_array_equal(kept.T_world_object, faithful.T_world_object)
    (only,) = kept.header["scale_search"]
    assert only["chosen"]
    assert only["score"] >= ENOUGH
    assert kept.notes == faithful.notes


def test_a_receptacle_that_is_missed_is_moved_under_the_jet(faithful: Reference) -> None:
    aside = with_receptacle_moved(faithful, 0.09, 0.0)
    found = search_scale(aside, no_other)
    tried = found.header["scale_search"]
    chosen = next(t for t in tried if t["chosen"])
    assert chosen["score"] == max(t["score"] for t in tried)
    assert chosen["score"] > tried[0]["score"] + 0.2
    assert chosen["along_m"] < 0.0
    assert np.linalg.norm((found.T_world_receptacle - aside.T_world_receptacle)[:2, 3]) == pytest.approx(
        np.hypot(chosen["along_m"], chosen["across_m"])
    )
    assert "the receptacle moved by" in found.notes[-1]
    # The path is the human's still.
    np.testing.assert_array_equal(found.T_world_object, faithful.T_world_object)


@pytest.mark.slow
@pytest.mark.parametrize("less_deg", [25.0, 40.0])  # so little that tipping it somewhat does not help yet
def test_what_is_tipped_too_little_is_tipped_further(faithful: Reference, less_deg: float) -> None:
    little = tipped_further(faithful, -less_deg)
    found = search_scale(little, no_other)
    chosen = next(t for t in found.header["scale_search"] if t["chosen"])
    assert chosen["tip_deg"] > 0.0
    assert chosen["poured"] > found.header["scale_search"][0]["poured"] + 0.2
    assert f"tipped {chosen['tip_deg']:.0f} degrees further" in found.notes[-1]
    assert np.rad2deg(found.tilt_rad.max() - little.tilt_rad.max()) == pytest.approx(chosen["tip_deg"], abs=1e-6)


@pytest.mark.slow
def test_the_choice_does_not_depend_on_the_number_of_threads(faithful: Reference) -> None:
    aside = with_receptacle_moved(faithful, 0.09, 0.0)
    first, second = (search_scale(aside, no_other, num_threads=threads) for threads in (1, 3))
    assert len(first.header["scale_search"]) > 1
    assert first.header["scale_search"] == second.header["scale_search"]
    np.testing.assert_array_equal(first.T_world_receptacle, second.T_world_receptacle)


@pytest.mark.slow
def test_pours_side_by_side_come_out_as_each_alone(faithful: Reference) -> None:
    motions = []
    for reference in (faithful, with_receptacle_moved(faithful, 0.09, 0.0), tipped_further(faithful, -25.0)):
        motions.append((reference, retarget(reference)))
    # One that takes longer must not lose what the others pour meanwhile.
    slow = faithful.stretched(1.3)
    motions.append((slow, retarget(slow)))
    together = pours(motions, num_threads=2)
    assert together == [pours([motion])[0] for motion in motions]
    assert len({fractions for fractions in together if fractions is not None}) >= 3


@pytest.mark.slow
def test_a_smaller_path_is_tried_where_no_place_catches_all(faithful: Reference) -> None:
    missed = with_receptacle_moved(faithful, 0.25, 0.0)
    asked = []

    def at_scale(scale: float) -> Reference:
        asked.append(scale)
        if scale < 0.8:
            raise UserError(f"scale {scale:.2f} does not fit")
        return faithful.with_header(scale=scale)

    found = search_scale(missed, at_scale)
    tried = found.header["scale_search"]
    assert asked == [0.85, 0.7]  # each placed once
    assert {t["scale"] for t in tried} == {1.0, 0.85}
    chosen = next(t for t in tried if t["chosen"])
    assert chosen["scale"] == 0.85
    assert found.scale == 0.85
    assert "the path scaled by 0.85" in found.notes[-1]
    assert len(tried) <= MOST_TRIES


def test_tipping_further_leaves_the_outlet_and_the_upright_start_where_they_were(faithful: Reference) -> None:
    tipped = tipped_further(faithful, 20.0)
    outlet = np.append(faithful.vessel().outlet.point_m, 1.0)
    np.testing.assert_allclose(tipped.T_world_object @ outlet, faithful.T_world_object @ outlet, atol=1e-9)
    np.testing.assert_allclose(tipped.T_world_object[0], faithful.T_world_object[0], atol=1e-6)
    further = faithful.tilt_rad * (1 + np.deg2rad(20.0) / faithful.tilt_rad.max())
    np.testing.assert_allclose(tipped.tilt_rad, further, atol=1e-9)


def test_along_and_across_are_level_and_square(faithful: Reference) -> None:
    lean = faithful.T_world_object[faithful.pour_index, :2, 2]
    along, across = (
        (with_receptacle_moved(faithful, *by).T_world_receptacle - faithful.T_world_receptacle)[:3, 3]
        for by in ((0.03, 0.0), (0.0, 0.03))
    )
    assert along[2] == across[2] == 0.0
    assert along @ across == pytest.approx(0.0, abs=1e-12)
    assert along[:2] @ lean == pytest.approx(0.03 * np.linalg.norm(lean))


def test_without_a_receptacle_there_is_nothing_to_search(faithful: Reference) -> None:
    alone = faithful.with_header(receptacle={})
    assert search_scale(alone, no_other) is alone
