from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from vid2demo.extract.any_vessel import vessel_of_entry
from vid2demo.extract.candidates import ObjectRequest, candidate_models
from vid2demo.extract.errors import UserError
from vid2demo.extract.segment import check_box
from vid2demo.extract.steps import ObjectSettings
from vid2demo.extract.wording import unseen_in_words


def test_what_the_user_says_of_a_closed_mesh_reaches_whoever_makes_a_vessel_of_it(tmp_path: Path) -> None:
    can = trimesh.creation.cylinder(0.033, 0.12, sections=48)
    can.apply_transform(trimesh.transformations.rotation_matrix(1.5707963, [1, 0, 0]))  # its axis is y
    can.export(tmp_path / "can.ply")
    (plain,) = candidate_models(ObjectRequest("can", mesh=tmp_path / "can.ply", mesh_unit="m"))
    with pytest.raises(UserError, match="--mesh-up"):
        vessel_of_entry(plain.header, "held vessel")
    told = ObjectRequest("can", mesh=tmp_path / "can.ply", mesh_unit="m", mesh_up="-y", mesh_open_top=True)
    (model,) = candidate_models(told)
    vessel = vessel_of_entry(model.header, "held vessel")
    assert vessel.is_open
    assert vessel.extents_m[2] == pytest.approx(0.12, abs=0.002)
    assert vessel.source is not None
    assert vessel.source.up == "-y"


def test_a_box_and_a_mask_at_once_are_refused() -> None:
    with pytest.raises(UserError, match=r"--box and --mask there\.png .* one of them"):
        ObjectSettings("mug", (1.0, 2.0, 30.0, 40.0), mask=Path("there.png"))


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("number", [float("nan"), float("-inf")])
def test_a_box_that_is_no_number_is_refused(place: int, number: float) -> None:
    box = [10.0, 20.0, 30.0, 40.0]
    box[place] = number
    with pytest.raises(UserError, match=r"--box .*(nan|-inf).* inside the 640 x 480 image"):
        check_box((box[0], box[1], box[2], box[3]), 640, 480)


@pytest.mark.parametrize(
    ("visible", "words"),
    [
        ("11111", ""),
        ("11100", "0.30 s to the end"),
        ("01011", "0.00 s to 0.00 s, 0.20 s to 0.20 s"),
        ("10010", "0.10 s to 0.20 s, 0.40 s to the end"),
        ("00000", "0.00 s to the end"),
    ],
)
def test_when_an_object_was_not_seen_is_told_with_its_times(visible: str, words: str) -> None:
    assert unseen_in_words([0.0, 0.1, 0.2, 0.3, 0.4], [letter == "1" for letter in visible]) == words
