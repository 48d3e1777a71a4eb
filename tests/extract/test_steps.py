from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from vid2demo.extract.any_vessel import vessel_of_entry
from vid2demo.extract.candidates import ObjectRequest, candidate_models
from vid2demo.extract.errors import UserError


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
