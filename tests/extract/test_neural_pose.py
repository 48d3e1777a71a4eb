from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from vid2demo.cli import main

pytestmark = pytest.mark.slow  # loading torch and transformers alone takes longer than a fast test may


@pytest.mark.slow
def test_every_network_of_the_paper_takes_its_part_in_a_pose(
    tiny_models: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tiny random ones, through the commands: what they find is arbitrary, that they are asked is not."""
    models = ["--models-dir", str(tiny_models)]
    (tmp_path / "in").mkdir()
    trimesh.creation.box([0.1, 0.1, 0.2]).export(tmp_path / "in" / "box.ply")
    words = ["meshes", "onboard", str(tmp_path / "in"), "--out", str(tmp_path / "db"), "--views", "5"]
    assert main([*words, "--features", "dinov2-small", *models]) == 0
    picture = np.full((120, 160, 3), 200, np.uint8)
    picture[30:90, 40:80] = picture[40:100, 100:140] = (90, 40, 30)
    cv2.imwrite(str(tmp_path / "table.png"), picture)
    boxes = ["--box", "38", "28", "44", "64", "--box", "98", "38", "44", "64"]
    where = ["--db", str(tmp_path / "db"), "--encoder", "dinov2", "--out", str(tmp_path / "out")]
    capsys.readouterr()
    assert main(["pose", str(tmp_path / "table.png"), *where, *boxes, "--level", "foundation", *models]) == 0
    told = json.loads((tmp_path / "out/poses.json").read_text())
    assert "grounding-dino-tiny and sam2-small" in told["segmenter"]
    assert "zoedepth" in told["size"]
    assert "clip-large" in told["size"]
    assert told["encoder"].startswith("dinov2-small-block3-420px-")
    assert told["objects"]
    for found in told["objects"]:
        assert np.isfinite(found["T_camera_object"]).all()
        assert found["size_m"] >= 0.01
    assert list(tiny_models.glob("texts-*.npy"))
