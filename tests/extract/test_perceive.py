"""Extraction as a whole: options, start frames, and videos and meshes that are not as they should be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from vid2demo.extract.candidates import ObjectRequest, candidate_models
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import focal_prior_camera_matrix, make_pose, project
from vid2demo.extract.masks import Masks, read_mask
from vid2demo.extract.perceive import extract
from vid2demo.extract.raster import render_depth
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.video import VideoWriter, iterate_backward, iterate_frames

WIDTH, HEIGHT, COUNT = 320, 240, 10
K = focal_prior_camera_matrix(WIDTH, HEIGHT)
CAMERA = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
rng = np.random.default_rng(0)
GROUND = cv2.GaussianBlur(rng.normal((90, 120, 150), 40, (HEIGHT, WIDTH, 3)), (0, 0), 2.0)
OTHER = cv2.GaussianBlur(rng.normal((150, 140, 60), 40, (HEIGHT, WIDTH, 3)), (0, 0), 4.0)
BLACK = np.zeros((HEIGHT, WIDTH, 3))


def wedge() -> trimesh.Trimesh:
    """A block with a slanted top: no symmetry, and no two outlines alike."""
    corners = np.array([[x, y, z] for x in (-0.06, 0.06) for y in (-0.035, 0.035) for z in (-0.05, 0.05)])
    corners[7, 2] = corners[5, 2] = 0.0
    return trimesh.convex.convex_hull(corners).subdivide().subdivide()


def pose_at(k: float) -> np.ndarray:
    turn = Rotation.from_euler("zx", [20 + 2.0 * k, 110], degrees=True) * Rotation.from_euler(
        "z", 35 + 2 * k, degrees=True
    )
    return make_pose(turn.as_matrix(), (-0.03 + 0.006 * k, 0.01, 0.5))


def picture(k: float, ground: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(1000 + int(10 * k) + seed)
    image = (GROUND if ground is None else ground) + noise.normal(0, 3, GROUND.shape)
    inside = silhouette(k)
    image[inside] = noise.normal((190, 70, 50), 6, (int(inside.sum()), 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def silhouette(k: float) -> np.ndarray:
    mesh = wedge()
    window = render_depth(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), pose_at(k), K)
    assert window is not None
    return window.mask_in_image(WIDTH, HEIGHT)


def box_at(k: float) -> tuple[float, float, float, float]:
    ys, xs = np.nonzero(silhouette(k))
    return float(xs.min()), float(ys.min()), float(np.ptp(xs) + 1), float(np.ptp(ys) + 1)


def write(path: Path, images: list[np.ndarray], times_s: list[float] | None = None) -> Path:
    with VideoWriter(path, 25.0, crf=10) as writer:
        for k, image in enumerate(images):
            writer.write(np.clip(image, 0, 255).astype(np.uint8), None if times_s is None else times_s[k])
    return path


@pytest.fixture(scope="module")
def mesh_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "wedge.ply"
    wedge().export(path)
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("clip") / "clip.mp4", [picture(k) for k in range(COUNT)])


def follow(video: Path, mesh: Path, out: Path, start: int = 0, **options) -> ObjectTrack:
    request = ObjectRequest("wedge", box_at(start), mesh, "m")
    return extract(video, [request], out=out, start_frame=start, camera=CAMERA, **options)["wedge"]


def off_px(track: ObjectTrack, frames: range | list[int]) -> float:
    """Largest distance of the projected origin from the truth's."""
    pairs = [(project(K, track.T_camera_object[k, None, :3, 3]), project(K, pose_at(k)[None, :3, 3])) for k in frames]
    return max(float(np.linalg.norm(a - b)) for a, b in pairs)


@pytest.mark.parametrize("start", [0, 6, COUNT - 1])
def test_a_clip_is_followed_both_ways_from_any_frame(clip: Path, mesh_file: Path, tmp_path: Path, start: int) -> None:
    track = follow(clip, mesh_file, tmp_path, start)
    assert len(track) == COUNT
    assert track.visible.all()
    assert off_px(track, range(COUNT)) < 4
    assert track.header["settings"]["start_frame"] == start
    masks = Masks(tmp_path / "wedge.masks.npz")
    assert len(masks) == COUNT
    for k in (0, COUNT - 1):
        both = np.count_nonzero(masks[k] & silhouette(k)) / np.count_nonzero(masks[k] | silhouette(k))
        assert both > 0.9


@pytest.mark.slow
def test_what_was_followed_unsurely_is_looked_for_in_a_wider_box_as_well(
    clip: Path, mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = follow(clip, mesh_file, tmp_path / "plain")
    assert plain.header["settings"]["box_source"] == "given"
    monkeypatch.setattr("vid2demo.extract.attempts.SURELY_BEGUN", 1.1)  # nothing is
    kept = follow(clip, mesh_file, tmp_path / "kept")  # of what is as sure the first
    assert np.array_equal(kept.T_camera_object, plain.T_camera_object)
    monkeypatch.setattr("vid2demo.extract.attempts.OTHER_MARGIN", -1.0)
    with monkeypatch.context() as strict:
        strict.setattr("vid2demo.extract.attempts.SAME_PLACE_IOU", 1.0)  # nor is anything the same object
        other = follow(clip, mesh_file, tmp_path / "other")
        assert np.array_equal(other.T_camera_object, plain.T_camera_object)
    track = follow(clip, mesh_file, tmp_path / "wider")
    assert track.header["settings"]["box_source"] == "widened"
    assert track.header["settings"]["start_frame"] == 0
    assert off_px(track, range(COUNT)) < 4


def test_what_was_followed_unsurely_is_followed_again_from_where_it_shows_best(
    clip: Path, mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vid2demo.extract.attempts.SURELY_FOLLOWED", 1.1)  # nothing is
    monkeypatch.setattr("vid2demo.extract.attempts.ELSEWHERE_MARGIN", -1.0)
    monkeypatch.setattr("vid2demo.extract.attempts.AWAY_FRAMES", 3)
    monkeypatch.setattr("vid2demo.extract.attempts.SURELY_BEGUN", 0.0)  # no wider box
    track = follow(clip, mesh_file, tmp_path)
    assert track.header["settings"]["start_frame"] > 3
    assert track.header["settings"]["box_source"] == "followed"
    for k in range(COUNT):  # the wedge looks nearly the same from behind: only its outline is asked for
        window = render_depth(
            np.asarray(wedge().vertices), np.asarray(wedge().faces, np.int32), track.T_camera_object[k], K
        )
        assert window is not None
        found, true = window.mask_in_image(WIDTH, HEIGHT), silhouette(k)
        assert np.sum(found & true) / np.sum(found | true) > 0.85
    assert track.visible.all()


def test_a_mask_says_where_the_object_is(clip: Path, mesh_file: Path, tmp_path: Path) -> None:
    file = tmp_path / "mask.png"
    cv2.imwrite(str(file), silhouette(3).astype(np.uint8) * 255)
    request = ObjectRequest("wedge", None, mesh_file, "m", file)
    track = extract(clip, [request], out=tmp_path / "out", start_frame=3, camera=CAMERA)["wedge"]
    assert off_px(track, range(COUNT)) < 4
    assert track.header["settings"]["box_source"] == "mask"


@pytest.mark.parametrize(
    ("paint", "words"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), "is empty"),
        (np.full((HEIGHT, WIDTH), 255, np.uint8), "covers 100%"),
        (np.full((48, 64), 255, np.uint8), "64 x 48"),
    ],
)
def test_a_mask_that_cannot_be_one_is_refused(paint: np.ndarray, words: str, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), paint)
    with pytest.raises(UserError, match=words):
        read_mask(tmp_path / "mask.png", WIDTH, HEIGHT)


def test_a_file_that_is_no_picture_is_no_mask(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_mask(tmp_path / "gone.png", WIDTH, HEIGHT)
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(UserError, match="cannot be read"):
        read_mask(tmp_path / "text.png", WIDTH, HEIGHT)


@pytest.mark.parametrize("frame", [-1, COUNT, 9999])
def test_a_start_frame_outside_the_clip_is_refused(frame: int, clip: Path, mesh_file: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"--start-frame {frame}.*0 to {COUNT - 1}"):
        extract(clip, [ObjectRequest("wedge", box_at(0), mesh_file, "m")], out=tmp_path / "out", start_frame=frame)
    assert not (tmp_path / "out").exists()


def test_frames_read_backward_are_those_read_forward(tmp_path: Path) -> None:
    images = [np.full((48, 64, 3), 2 * k, np.uint8) for k in range(100)]
    times_s = list(np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 100)))
    video = write(tmp_path / "grey.mp4", images, times_s)
    forward = list(iterate_frames(video))
    backward = list(iterate_backward(video, [f.time_s for f in forward]))
    assert [f.index for f in backward] == list(range(99, -1, -1))
    assert [f.time_s for f in backward] == [f.time_s for f in reversed(forward)]
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(backward, reversed(forward), strict=True))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_frames_are_enough(count: int, mesh_file: Path, tmp_path: Path) -> None:
    video = write(tmp_path / "short.mp4", [picture(k) for k in range(count)])
    track = follow(video, mesh_file, tmp_path / "out")
    assert len(track) == count
    assert off_px(track, range(count)) < 4


def test_black_frames_are_told_as_not_seen_and_the_rest_is_followed(mesh_file: Path, tmp_path: Path) -> None:
    images = [picture(k) if k not in (4, 5) else BLACK for k in range(COUNT)]
    track = follow(write(tmp_path / "dark.mp4", images), mesh_file, tmp_path / "out")
    seen = [k for k in range(COUNT) if k not in (4, 5)]
    assert not track.visible[[4, 5]].any()
    assert track.visible[seen].all()
    assert off_px(track, seen) < 6


def test_a_start_frame_that_shows_nothing_is_refused(mesh_file: Path, tmp_path: Path) -> None:
    video = write(tmp_path / "fade.mp4", [BLACK, BLACK, *(picture(k) for k in range(4))])
    with pytest.raises(UserError, match=r"of one colour there in frame 0 .*--start-frame"):
        follow(video, mesh_file, tmp_path / "out")


def test_an_object_that_leaves_for_good_is_told_so(mesh_file: Path, tmp_path: Path) -> None:
    gone = [np.clip(GROUND + rng.normal(0, 3, GROUND.shape), 0, 255) for _ in range(8)]
    video = write(tmp_path / "gone.mp4", [*(picture(k) for k in range(6)), *gone])
    track = follow(video, mesh_file, tmp_path / "out")
    assert track.visible[:6].all()
    assert not track.visible[-4:].any()
    assert track.confidence[-4:].max() < 0.5 * track.confidence[:6].min()


def test_a_cut_is_told_with_its_time(mesh_file: Path, tmp_path: Path) -> None:
    video = write(tmp_path / "cut.mp4", [picture(k, GROUND if k < 6 else OTHER) for k in range(12)])
    track = follow(video, mesh_file, tmp_path / "out")
    (cut,) = track.header["video"]["cuts"]
    assert (cut["frame"], cut["time_s"]) == (6, pytest.approx(6 / 25, abs=1e-3))


def test_time_stamps_far_from_zero_and_uneven_are_kept(mesh_file: Path, tmp_path: Path) -> None:
    times_s = [0.0, 0.5, 0.51, 0.512, 3.0, 3.04]
    video = write(tmp_path / "odd.mp4", [picture(k) for k in range(6)], times_s)
    track = follow(video, mesh_file, tmp_path / "out")
    assert track.time_s == pytest.approx(times_s, abs=1e-4)
    assert off_px(track, range(6)) < 5


def test_turned_inside_out_torn_and_fine_meshes_track_alike(clip: Path, tmp_path: Path) -> None:
    whole = wedge()
    inverted = whole.copy()
    inverted.invert()
    torn = whole.copy()
    torn.update_faces(np.arange(len(torn.faces)) % 17 > 0)
    torn.faces = np.vstack([torn.faces, torn.faces[:9, ::-1]])  # doubled walls: edges of three and more faces
    for name, mesh in (("inverted", inverted), ("torn", torn)):
        file = tmp_path / f"{name}.ply"
        mesh.export(file)
        assert off_px(follow(clip, file, tmp_path / name), range(COUNT)) < 5, name


@pytest.mark.slow
def test_a_mesh_of_a_million_faces_is_decimated_and_said_to_be(tmp_path: Path) -> None:
    fine = trimesh.creation.icosphere(subdivisions=8)
    fine.apply_scale((0.05, 0.05, 0.08))
    fine.export(tmp_path / "fine.ply")
    (model,) = candidate_models(ObjectRequest("ball", None, tmp_path / "fine.ply", "m"))
    assert model.header["faces"]["in_file"] == len(fine.faces) > 1_000_000
    assert len(model.mesh.faces) == model.header["faces"]["tracked"] <= 4000
    assert np.ptp(model.mesh.vertices_m, axis=0) == pytest.approx(fine.extents, abs=5e-4)
    assert model.symmetry.order == 0


@pytest.mark.slow
def test_a_recording_for_the_viewer_is_written(clip: Path, mesh_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk")
    follow(clip, mesh_file, tmp_path, rerun=True)
    assert (tmp_path / "extract.rrd").stat().st_size > 10_000


def test_without_the_viewer_s_package_the_way_to_get_it_is_told(
    clip: Path, mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"pip install 'vid2demo\[rerun\]'"):
        follow(clip, mesh_file, tmp_path / "out", rerun=True)
    assert not (tmp_path / "out").exists()


def test_flat_walls_of_many_triangles_stay_flat(tmp_path: Path) -> None:
    fine = wedge()
    while len(fine.faces) < 60_000:
        fine = fine.subdivide()
    fine.export(tmp_path / "flat.ply")
    (model,) = candidate_models(ObjectRequest("wedge", None, tmp_path / "flat.ply", "m"))
    assert len(model.mesh.faces) < 0.3 * len(fine.faces)
    assert np.ptp(model.mesh.vertices_m, axis=0) == pytest.approx(fine.extents, abs=5e-4)


@pytest.mark.parametrize("kind", [pytest.param("4k", marks=pytest.mark.slow), "10 bit"])
def test_large_and_deep_videos_are_followed(kind: str, mesh_file: Path, tmp_path: Path) -> None:
    import av

    factor = 12 if kind == "4k" else 1
    video = tmp_path / "clip.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "12", "preset": "ultrafast"})
        stream.width, stream.height = WIDTH * factor, HEIGHT * factor
        stream.pix_fmt = "yuv420p10le" if kind == "10 bit" else "yuv420p"
        for k in range(4):
            image = cv2.resize(picture(k), None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    x, y, w, h = (v * factor for v in box_at(0))
    fx, fy, cx, cy = (v * factor for v in CAMERA)
    request = ObjectRequest("wedge", (x, y, w, h), mesh_file, "m")
    track = extract(video, [request], out=tmp_path / "out", camera=(fx, fy, cx, cy))["wedge"]
    assert track.header["image_size_px"] == [WIDTH * factor, HEIGHT * factor]
    scaled = np.diag([factor, factor, 1.0]) @ K
    for k in range(4):
        seen = project(track.camera_matrix, track.T_camera_object[k, None, :3, 3])
        assert np.linalg.norm(seen - project(scaled, pose_at(k)[None, :3, 3])) < 5 * factor


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length_of_the_clip(tmp_path: Path) -> None:
    """Peak memory of a process of its own, over a clip and over one eight times as long."""
    wedge().export(tmp_path / "wedge.ply")
    there_and_back = [picture(k) for k in (*range(COUNT), *range(COUNT - 1, -1, -1))]
    program = (
        "import resource, sys; from pathlib import Path; from vid2demo.extract.perceive import ObjectRequest, extract; "
        "box = tuple(float(v) for v in sys.argv[3:7]); mesh = Path(sys.argv[2]); "
        "extract(Path(sys.argv[1]), [ObjectRequest('wedge', box, mesh=mesh, mesh_unit='m')], out=mesh.parent / 'out'); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    peaks_mb = []
    for turns in (3, 24):
        video = write(tmp_path / f"{turns}.mp4", there_and_back * turns)
        words = [sys.executable, "-c", program, str(video), str(tmp_path / "wedge.ply"), *map(str, box_at(0))]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        peaks_mb.append(float(done.stdout.split()[-1]))
    # 420 pictures more would be 97 MB.
    assert peaks_mb[1] < peaks_mb[0] + 30, peaks_mb
