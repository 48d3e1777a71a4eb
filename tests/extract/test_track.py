"""The track's file format: what is written comes back, what is damaged is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Symmetry
from vid2demo.extract.track import ObjectTrack


def some_track(n: int = 5, **changes) -> ObjectTrack:
    values = {
        "T_camera_object": np.tile(np.eye(4), (n, 1, 1)),
        "time_s": np.arange(n) * 0.04,
        "camera_matrix": np.diag([500.0, 510.0, 1.0]),
        "confidence": np.linspace(0, 1, n),
        "visible": np.ones(n, bool),
        "header": {"object": "mug", "mesh": {"symmetry": Symmetry(order=0).to_json()}},
    }
    return ObjectTrack(**{**values, **changes})


def test_round_trip(tmp_path: Path) -> None:
    track = some_track()
    track.save(tmp_path / "mug.track.npz")
    back = ObjectTrack.load(tmp_path / "mug.track.npz")
    for name in ("T_camera_object", "time_s", "camera_matrix", "confidence", "visible"):
        assert np.array_equal(getattr(back, name), getattr(track, name))
    assert back.name == "mug"
    assert back.symmetry.order == 0
    assert list(tmp_path.iterdir()) == [tmp_path / "mug.track.npz"]


def test_other_programs_can_read_it_without_pickle(tmp_path: Path) -> None:
    some_track().save(tmp_path / "a.track.npz")
    with np.load(tmp_path / "a.track.npz", allow_pickle=False) as archive:
        header = json.loads(str(archive["header"]))
        assert archive["T_camera_object"].shape == (5, 4, 4)
    assert header["schema"] == "vid2demo/object-track"
    assert header["units"]["length"] == "m"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time_s": np.array([0.0, 0.1, 0.1, 0.2, 0.3])}, "strictly increasing"),
        ({"T_camera_object": np.full((5, 4, 4), np.nan)}, r"not finite \(first in frame 0, 5 in all\); write"),
        ({"confidence": np.array([1.0, 1.0, np.inf, 1.0, np.nan])}, "first in frame 2, 2 in all"),
        ({"camera_matrix": np.full((3, 3), np.nan)}, "give the camera again"),
        ({"confidence": np.zeros(4)}, "shape"),
    ],
)
def test_nonsense_is_refused(changes: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        some_track(**changes)


def test_an_empty_track_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        some_track(0)


def test_damaged_foreign_and_newer_files_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.track.npz"
    with pytest.raises(UserError, match="does not exist"):
        ObjectTrack.load(path)
    some_track().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="damaged"):
        ObjectTrack.load(path)
    for header, words in (
        ({"schema": "vid2demo/reference", "version": 1}, "expected 'vid2demo/object-track'"),
        ({"schema": "vid2demo/object-track", "version": 99}, "update vid2demo"),
        ({"schema": "vid2demo/object-track", "version": 1}, "lacks T_camera_object"),
    ):
        np.savez(path, header=np.array(json.dumps(header)))
        with pytest.raises(UserError, match=words):
            ObjectTrack.load(path)


def test_a_file_with_pickled_objects_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "a.track.npz"
    np.savez(path, header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UserError, match="damaged"):
        ObjectTrack.load(path)


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.track.npz"
    some_track().save(path)
    before = path.read_bytes()

    def full_disk(*args, **kwargs) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="No space left"):
        some_track(7).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
