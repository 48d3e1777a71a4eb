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


def walked(n: int = 5) -> np.ndarray:
    """T_first_camera of a camera that turns about y while it is carried to the right."""
    T = np.tile(np.eye(4), (n, 1, 1))
    angle = 0.1 * np.arange(n)
    T[:, 0, 0] = T[:, 2, 2] = np.cos(angle)
    T[:, 0, 2], T[:, 2, 0] = np.sin(angle), -np.sin(angle)
    T[:, 0, 3] = 0.2 * np.arange(n)
    return T


def test_a_thing_at_rest_stays_at_rest_in_the_first_cameras_frame(tmp_path: Path) -> None:
    T_first_camera = walked()
    resting = np.eye(4)
    resting[:3, 3] = 0.1, 0.2, 0.9
    seen = np.linalg.inv(T_first_camera) @ resting
    some_track(T_camera_object=seen, T_camera_object_raw=seen, T_first_camera=T_first_camera).save(tmp_path / "a")
    back = ObjectTrack.load(tmp_path / "a").from_first_camera()
    assert back.T_first_camera is None
    for poses in (back.T_camera_object, back.T_camera_object_raw):
        assert poses is not None
        assert poses == pytest.approx(np.tile(resting, (5, 1, 1)), abs=1e-12)


def test_files_of_turning_cameras_written_by_version_1_are_read(tmp_path: Path) -> None:
    path, turned = tmp_path / "old.track.npz", walked()[:, :3, :3]
    some_track().save(path)
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    header = {**json.loads(str(arrays.pop("header"))), "version": 1}
    with open(path, "wb") as stream:
        np.savez(stream, **arrays, R_first_camera=turned, header=np.array(json.dumps(header)))
    track = ObjectTrack.load(path)
    assert track.T_first_camera is not None
    np.testing.assert_array_equal(track.T_first_camera[:, :3, :3], turned)
    assert not track.T_first_camera[:, :3, 3].any()
    track.save(path)  # as version 2, so that no older program takes the camera for still
    with np.load(path, allow_pickle=False) as archive:
        assert json.loads(str(archive["header"]))["version"] == 2
    with open(path, "wb") as stream:
        np.savez(stream, **arrays, R_first_camera=turned[:, 0], header=np.array(json.dumps(header)))
    with pytest.raises(UserError, match="R_first_camera has shape"):
        ObjectTrack.load(path)
