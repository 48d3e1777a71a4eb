"""The paper's way through a video: the course of views, objects out of view, and the whole from the command line."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.cli import main
from vid2demo.extract.candidates import ObjectRequest
from vid2demo.extract.classical_segment import ClassicalSegmenter
from vid2demo.extract.coarse_pose import PoseGuess
from vid2demo.extract.errors import UserError
from vid2demo.extract.features import ClassicalFeatures
from vid2demo.extract.geometry import focal_prior_camera_matrix, make_pose, rotation_angle_rad
from vid2demo.extract.point_tracks import ClassicalTracks
from vid2demo.extract.raster import render_depth
from vid2demo.extract.steps import ObjectSettings, VideoSettings
from vid2demo.extract.templates import ViewSettings
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.video import VideoWriter, read_video_info
from vid2demo.extract.video_pose import TURN_COST, Means, pose_through_video, steady_course, surest

WIDTH, HEIGHT, COUNT, START, AWAY = 240, 180, 8, 3, (5,)
K = focal_prior_camera_matrix(WIDTH, HEIGHT)


def wedge() -> trimesh.Trimesh:
    """A block with a slanted top: no symmetry, and no two outlines alike."""
    corners = np.array([[x, y, z] for x in (-0.06, 0.06) for y in (-0.035, 0.035) for z in (-0.05, 0.05)])
    corners[7, 2] = corners[5, 2] = 0.0
    mesh = trimesh.convex.convex_hull(corners)
    mesh.apply_translation([0.02, 0.01, 0.03])  # a file's origin is seldom the middle
    return mesh


def pose_at(k: float) -> np.ndarray:
    turn = Rotation.from_euler("ZYX", [20 + 2.0 * k, 30, 110], degrees=True)
    return make_pose(turn.as_matrix(), (-0.03 + 0.004 * k, 0.0, 0.45))


def silhouette(T: np.ndarray) -> np.ndarray:
    mesh = wedge()
    window = render_depth(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), T, K)
    assert window is not None
    return window.mask_in_image(WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wedge that slides and turns, and is out of view in one frame."""
    folder = tmp_path_factory.mktemp("wedge")
    mesh = wedge()
    mesh.export(folder / "wedge.ply")
    speckle = np.random.default_rng(0).normal(0, 25, (HEIGHT, WIDTH))
    with VideoWriter(folder / "clip.mp4", 25.0, crf=10) as writer:
        for k in range(COUNT):
            image = np.full((HEIGHT, WIDTH, 3), (90, 120, 150), np.uint8)
            if k not in AWAY:
                inside = silhouette(pose_at(k))
                moved = np.roll(speckle, (2 * k, 2 * k), (0, 1))[inside]
                image[inside] = np.clip(np.array([190, 70, 50]) + moved[:, None], 0, 255)
            writer.write(image)
    cv2.imwrite(str(folder / "mask.png"), silhouette(pose_at(START)).astype(np.uint8) * 255)
    return folder


class MaskedByColour(ClassicalSegmenter):
    """What a network that finds objects again does: the mask of a frame is what is red there."""

    def propagate(self, frames, masks):  # type: ignore[no-untyped-def]
        for rgb in frames:
            yield (rgb[..., 0].astype(int) > rgb[..., 2].astype(int) + 30)[None]


def test_every_frame_is_posed_and_one_without_the_object_is_bridged(clip: Path, tmp_path: Path) -> None:
    views = ViewSettings(count=150)
    means = Means(ClassicalFeatures(), MaskedByColour(), ClassicalTracks(), views)
    request = ObjectRequest("wedge", None, clip / "wedge.ply", "m", clip / "mask.png")
    info = read_video_info(clip / "clip.mp4")
    told: list[str] = []
    posed = pose_through_video(info, request, K, means, START, lambda done, total, what: told.append(what), tmp_path)
    np.testing.assert_array_equal(posed.seen, [k not in AWAY for k in range(COUNT)])
    assert "posing wedge frame by frame" in told
    middle = np.append(wedge().bounds.mean(axis=0), 1.0)
    for k in np.flatnonzero(posed.seen):
        ours, true = silhouette(posed.coarse[k]), silhouette(pose_at(k))  # outlines alone may allow two turns
        assert np.count_nonzero(ours & true) > 0.75 * np.count_nonzero(ours | true)
        off = (posed.coarse[k] @ middle - pose_at(k) @ middle)[:3]
        assert np.linalg.norm(off[:2]) < 0.02
        assert abs(off[2]) < 0.04
    away = AWAY[0]
    assert any(np.array_equal(posed.coarse[away], posed.coarse[k]) for k in (away - 1, away + 1))
    assert posed.seen[posed.key]
    for kind in ("coarse", "pnp", "fused"):
        assert np.isfinite(posed.translated(kind)).all()


def test_an_object_that_never_shows_is_refused(clip: Path, tmp_path: Path) -> None:
    class Blind(ClassicalSegmenter):
        def propagate(self, frames, masks):  # type: ignore[no-untyped-def]
            for rgb in frames:
                yield np.zeros((1, *rgb.shape[:2]), bool)

    means = Means(ClassicalFeatures(), Blind(), ClassicalTracks(), ViewSettings(count=10))
    request = ObjectRequest("wedge", None, clip / "wedge.ply", "m", clip / "mask.png")
    with pytest.raises(UserError, match=r"'wedge' was not found in .*clip\.mp4"):
        pose_through_video(read_video_info(clip / "clip.mp4"), request, K, means, START, lambda *_: None, tmp_path)


def test_the_course_is_the_best_of_all_there_are() -> None:
    """By trying every one of them."""
    rng = np.random.default_rng(4)
    turns = Rotation.random(12, random_state=4).as_matrix().reshape(4, 3, 3, 3)
    scores = rng.uniform(0, 1.5, (4, 3))
    views = {
        2 * k: [PoseGuess(make_pose(turns[k, v]), float(scores[k, v])) for v in range(3)] for k in range(4)
    }  # fmt: skip
    course = steady_course(views)

    def worth(path: tuple[int, ...]) -> float:
        steps = [rotation_angle_rad(turns[k, path[k]], turns[k + 1, path[k + 1]]) for k in range(3)]
        return float(sum(scores[k, v] for k, v in enumerate(path)) - TURN_COST * np.sum(np.square(steps)))

    best = max(itertools.product(range(3), repeat=4), key=worth)
    assert [course[2 * k] for k in range(4)] == [views[2 * k][v] for k, v in enumerate(best)]


def test_the_key_frame_is_sure_together_with_its_neighbours() -> None:
    assert surest(np.array([0.5, 0.5, 0.99, 0.1, 0.7, 0.8, 0.75, 0.2])) == 5
    assert surest(np.array([0.1, 0.4])) == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"translation": "pnp"}, "belong to --method freepose"),
        ({"level": "foundation"}, "belong to --method freepose"),
        ({"models_dir": Path("models")}, "belong to --method freepose"),
        ({"method": "freepose", "camera_motion": "moving"}, "takes the camera to stand still"),
    ],
)
def test_options_that_do_not_go_together_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(UserError, match=words):
        VideoSettings(Path("a.mp4"), ObjectSettings("mug"), **settings)


@pytest.mark.slow
def test_the_command_writes_what_extract_writes(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VID2DEMO_TEMPLATES", str(tmp_path / "templates"))
    words = ["extract", str(clip / "clip.mp4"), "--object", "wedge", "--mesh", str(clip / "wedge.ply")]
    words += [
        "--mesh-unit",
        "m",
        "--mask",
        str(clip / "mask.png"),
        "--start-frame",
        str(START),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*words, "--method", "freepose", "--level", "classical"]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir() if p.name != "run.json") == [
        "overlay.mp4", "wedge.mask.png", "wedge.masks.npz", "wedge.track.npz",
    ]  # fmt: skip
    track = ObjectTrack.load(tmp_path / "out/wedge.track.npz")
    assert len(track) == COUNT
    settings = track.header["settings"]
    assert (settings["tracker"], settings["translation"]) == ("freepose", "fused")
    assert settings["means"]["tracks"]["level"] == "classical"
    assert "the mask that was given" in capsys.readouterr().out
    assert main([*words, "--method", "freepose", "--level", "foundation"]) != 0
    assert "vid2demo models pull" in capsys.readouterr().err
