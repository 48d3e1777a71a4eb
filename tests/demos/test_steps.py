"""What the command line says reaches what is built from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vid2demo.demos.commands import Retarget
from vid2demo.demos.steps import reference_stage, simulate_stage
from vid2demo.envs.reference import vessel_to_header
from vid2demo.extract.errors import UserError
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import make_vessel


@pytest.fixture
def track(tmp_path: Path) -> Path:
    """A mug that stands still for a second."""
    mug = make_vessel("mug")
    mesh = {
        "name": "mug",
        "extents_m": list(mug.extents_m),
        "symmetry": mug.symmetry.to_json(),
        **vessel_to_header(mug),
    }
    n, path = 25, tmp_path / "mug.track.npz"
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = 1.0
    header = {"object": "mug", "mesh": mesh}
    ObjectTrack(T, np.arange(n) / 25.0, np.diag([500.0, 500.0, 1.0]), np.ones(n), np.ones(n, bool), header).save(path)
    return path


def test_a_camera_that_looks_beyond_the_vertical_is_named(track: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"elevation is 120\.0 degrees"):
        Retarget(track=track, out=tmp_path / "out", elevation=120.0).do()
    stage = reference_stage(track, None, tmp_path, elevation_deg=-100.0)
    with pytest.raises(UserError, match=r"elevation is -100\.0 degrees"):
        stage.work(lambda done, total, text: None)


def test_another_choice_is_another_stage(track: Path, tmp_path: Path) -> None:
    low, high = (reference_stage(track, None, tmp_path, elevation_deg=e).settings for e in (20.0, 40.0))
    assert low != high
    weld, rub = (simulate_stage(track, track, None, tmp_path, grasp=g).settings for g in ("weld", "friction"))
    assert weld != rub
