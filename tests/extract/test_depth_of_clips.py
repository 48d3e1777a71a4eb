"""Depth pictures through the whole of extraction, on a clip whose object and distances are known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.synthetic import DEPTH_FOLDER, SyntheticClip, synthesize
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import make_vessel

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> SyntheticClip:
    return synthesize("mug", 0, tmp_path_factory.mktemp("clip"), seconds=1.2, size=(480, 360), depth=True)


def followed(clip: SyntheticClip, out: Path, *, own_mesh: bool, depth: bool) -> ObjectTrack:
    fx, _, cx, _, fy, cy = clip.truth.camera_matrix[:2].ravel()
    mesh = None
    if own_mesh:
        mesh = out / "mug.ply"
        make_vessel("mug", None, **clip.settings["vessels"]["object"]["params"]).mesh.export(mesh)
    box = tuple(float(v) for v in clip.settings["boxes_xywh_px"]["object"])
    request = ObjectRequest("mug", box, mesh, "m")  # type: ignore[arg-type]
    pictures = clip.video.parent / DEPTH_FOLDER if depth else None
    return extract(clip.video, [request], out=out, camera=(fx, fy, cx, cy), camera_motion="static", depth=pictures)[
        "mug"
    ]


def distance_error_mm(track: ObjectTrack, clip: SyntheticClip) -> float:
    """Mean over the frames of the error of the object's z in the camera's frame."""
    off_m = track.T_camera_object[:, 2, 3] - clip.truth.T_camera_object[:, 2, 3]
    return float(1e3 * np.abs(off_m).mean())


def test_depth_tells_how_far_away_a_known_mesh_is(clip: SyntheticClip, tmp_path: Path) -> None:
    error_mm = distance_error_mm(followed(clip, tmp_path, own_mesh=True, depth=True), clip)
    assert error_mm < 2


def test_depth_tells_how_far_away_a_vessel_of_the_library_is(clip: SyntheticClip, tmp_path: Path) -> None:
    """Without it, the size is that of a usual mug, and the distance as wrong as that."""
    (tmp_path / "with").mkdir()
    guessed = followed(clip, tmp_path / "without", own_mesh=False, depth=False)
    told = followed(clip, tmp_path / "with", own_mesh=False, depth=True)
    assert distance_error_mm(told, clip) < min(8, 0.6 * distance_error_mm(guessed, clip))
    assert told.header["settings"]["depth"]["scale_mm"] == 1.0
    assert "depth" not in guessed.header["settings"]
