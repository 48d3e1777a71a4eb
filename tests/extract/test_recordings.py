"""A person's pour, filmed: the track against what can be read off the frames by eye. Needs ../shared."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.compare import compare_tracks, load_truth
from vid2demo.extract.errors import UserError
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.video import VideoWriter, iterate_frames

VIDEOS = Path(__file__).parents[2].parent / "shared" / "data" / "videos"
COFFEE, BOX_TURN = VIDEOS / "coffee_pour.mp4", VIDEOS / "box_turn.mp4"
MUSTARD = VIDEOS.parent / "tracking/mustard_a"
KETTLE_BOX_PX = (345.0, 297.0, 488.0, 342.0)
# Frame -> tilt of the kettle's body in the image, from the slopes of its base and rim, +-2 degrees.
TILT_BY_EYE_DEG = {
    0: 0.0, 10: 7.0, 20: 22.5, 32: 33.5, 60: 46.3, 90: 49.5,
    120: 54.5, 150: 55.0, 180: 55.5, 210: 59.5, 240: 58.0, 270: 54.8,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not COFFEE.exists(), reason=f"needs the recording {COFFEE}")
def test_the_kettle_of_a_filmed_pour_tilts_as_read_by_eye(tmp_path: Path) -> None:
    track = extract(COFFEE, [ObjectRequest("kettle", KETTLE_BOX_PX)], out=tmp_path)["kettle"]
    up = track.T_camera_object[:, :3, 2]
    tilt_deg = np.rad2deg(np.arctan2(up[:, 0], -up[:, 1]))
    errors_deg = np.abs([tilt_deg[frame] - by_eye for frame, by_eye in TILT_BY_EYE_DEG.items()])
    assert len(track) > max(TILT_BY_EYE_DEG)
    assert track.visible.all()
    assert errors_deg.mean() < 4.0, errors_deg


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not BOX_TURN.exists(), reason=f"needs the recording {BOX_TURN}")
def test_a_teapot_is_not_found_where_a_box_is_turned(tmp_path: Path) -> None:
    fewer = tmp_path / "fewer.mp4"
    with VideoWriter(fewer, 10.0) as writer:
        for frame in islice(iterate_frames(BOX_TURN), 0, None, 3):
            writer.write(frame.rgb)
    with pytest.raises(UserError, match="'teapot' was not found"):
        extract(fewer, [ObjectRequest("teapot")], out=tmp_path / "out")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not MUSTARD.exists(), reason=f"needs the recording {MUSTARD}")
def test_a_bottle_that_hangs_upside_down_is_followed_as_one_of_the_library_s(tmp_path: Path) -> None:
    box = tuple(json.loads((MUSTARD / "info.json").read_text())["box_first_frame_xywh_px"])
    track = extract(MUSTARD / "video.mp4", [ObjectRequest("bottle", box)], out=tmp_path)["bottle"]
    assert track.visible.all()
    assert track.header["settings"]["first_frame"]["alternatives"]  # a bottle's outline leans either way
    assert compare_tracks(track, load_truth(MUSTARD / "truth.npz")).pose.aligned_rotation_deg < 10.0
