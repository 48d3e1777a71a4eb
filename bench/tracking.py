"""Tracking accuracy, speed and memory: a real recording with truth, two real clips read by eye, synthetic pours.

    python bench/tracking.py [--rows mustard_exact ...] [--synthetic 5 [--boxes]] [--shared ../shared] [--json FILE]

Every row is a process of its own, so that its memory and its time are its own; set OMP_NUM_THREADS=1 for one core.
Under each row with truth stand three more on the same clip, since the paper's errors a frame flatter a track that
stands still: the truth's first pose for ever, the truth smoothed, and the coarse track that boxes give: OpenCV's box
tracker, with the pose of the first frame moved and scaled as the box is (OpenCV's MIL tracker, or template matching
where OpenCV was built without it), or solved by PnP from the corners of the box.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from vid2demo.extract.compare import Truth, compare_tracks, load_truth
from vid2demo.extract.geometry import Symmetry, project, transform_points
from vid2demo.extract.meshes import load_mesh
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.smoothing import smooth_poses
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import make_vessel
from vid2demo.extract.video import iterate_frames, read_video_info

CATEGORIES = ("mug", "pitcher", "gooseneck_kettle", "bottle", "carton", "teapot", "milk_jug", "saucepan")

# coffee_pour.mp4: frame -> tilt of the kettle's body in the image, from the slopes of its base and rim, +-2 degrees.
TILT_BY_EYE_DEG = {
    0: 0.0, 10: 7.0, 20: 22.5, 32: 33.5, 60: 46.3, 90: 49.5,
    120: 54.5, 150: 55.0, 180: 55.5, 210: 59.5, 240: 58.0, 270: 54.8,
}  # fmt: skip
# Frame -> tip of the kettle's spout in px, read off the frames with a grid, +-5 px.
TIP_BY_EYE_PX = {
    0: (829, 322), 20: (805, 238), 32: (800, 303), 60: (772, 320), 90: (784, 171), 120: (783, 259),
    150: (776, 185), 180: (785, 202), 210: (774, 238), 240: (777, 143), 270: (782, 262), 286: (772, 205),
}  # fmt: skip
KETTLE_BOX_PX = (345.0, 297.0, 488.0, 342.0)
# box_turn.mp4: proportions from six corners in the first frame, +-5%, with the focal prior; the length is a guess.
TURNED_BOX_M = (0.250, 0.197, 0.073)
TURNED_BOX_PX = (292.0, 10.0, 304.0, 232.0)

BANDS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.01)  # of confidence
RIGHT_RAD = np.deg2rad(12)

Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="*", metavar="NAME", help="real rows to measure; all when left out")
    parser.add_argument("--synthetic", type=int, default=5, metavar="N", help="synthetic clips, up to 40")
    parser.add_argument("--boxes", action="store_true", help="give the object's box in the synthetic clips as well")
    parser.add_argument("--depth", action="store_true", help="and the pictures of a depth camera")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", help=argparse.SUPPRESS)  # one row, in this process
    arguments = parser.parse_args()
    data = arguments.shared / "data"
    if arguments.only:
        cv2.setNumThreads(1)
        print(json.dumps(_measured(arguments.only, data)))
        return
    names = list(REAL) if arguments.rows is None else arguments.rows
    if unknown := [name for name in names if name not in REAL]:
        parser.error(f"no row {', '.join(unknown)}; there are {', '.join(REAL)}")
    # By category first: five clips are five categories.
    suffix = (":box" if arguments.boxes else "") + (":depth" if arguments.depth else "")
    names += [f"{c}:{seed}{suffix}" for seed in range(5) for c in CATEGORIES][: arguments.synthetic]
    rows: list[Row] = []
    for name in names:
        command = [sys.executable, __file__, "--only", name, "--shared", str(arguments.shared)]
        done = subprocess.run(command, capture_output=True, text=True)
        failed = {"clip": name, "given": (done.stderr.strip() or "failed").splitlines()[-1][:200]}
        fresh = [failed] if done.returncode else json.loads(done.stdout.splitlines()[-1])
        for row in fresh:
            print(_line(row), flush=True)
        rows += fresh
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=2) + "\n")
    print("\n" + _table(rows))
    if drawn := [row for row in rows if "bands" in row]:
        print("\n" + _summary(drawn))


def _measured(name: str, data: Path) -> list[Row]:
    """The row of one clip, and those that it is to be read beside."""
    with tempfile.TemporaryDirectory() as folder:
        rows = REAL[name](data, Path(folder)) if name in REAL else synthetic(name, Path(folder))
    rows[0]["clip"] = name
    return rows


def mustard(data: Path, folder: Path, *, exact: bool) -> list[Row]:
    clip = data / "tracking/mustard_a"
    truth, model = load_truth(clip / "truth.npz"), load_mesh(data / "meshes/mustard_bottle.obj", "m")
    box = tuple(json.loads((clip / "info.json").read_text())["box_first_frame_xywh_px"])
    request = ObjectRequest("bottle", box)
    if exact:
        request = ObjectRequest("bottle", box, mesh=data / "meshes/mustard_bottle.obj", mesh_unit="m")
    camera = truth.camera_matrix if exact else None
    track, row = _extracted(clip / "video.mp4", request, camera, folder)
    row["given"] = "exact mesh, camera, box" if exact else "the word bottle, box"
    row |= _errors(track, truth, model if exact else None)
    # The rows to read beside it belong to the clip, so once is enough.
    return [row, *_beside(clip / "video.mp4", box, truth, model, True)] if exact else [row]


def coffee(data: Path, folder: Path, *, box: bool) -> list[Row]:
    request = ObjectRequest("kettle", KETTLE_BOX_PX if box else None)
    track, row = _extracted(data / "videos/coffee_pour.mp4", request, None, folder)
    axis = track.T_camera_object[:, :3, 2]
    tilt_deg = np.rad2deg(np.arctan2(axis[:, 0], -axis[:, 1]))
    tilt_error = np.abs([tilt_deg[k] - by_eye for k, by_eye in TILT_BY_EYE_DEG.items()])
    library = track.header["mesh"]["library"]
    tip_m = np.asarray(make_vessel(library["category"], None, **library["params"]).outlet.point_m)
    tips = np.stack([transform_points(T, tip_m[None])[0] for T in track.T_camera_object])
    tip_px = project(track.camera_matrix, tips)
    tip_error = np.array([np.linalg.norm(tip_px[k] - by_eye) for k, by_eye in TIP_BY_EYE_PX.items()])
    row |= {"given": "the word kettle" + ", box" * box, "vessel": library["category"]}
    row |= {"tilt_deg": float(tilt_error.mean()), "tilt_worst_deg": float(tilt_error.max())}
    row |= {"tip_px": float(tip_error.mean()), "tip_worst_px": float(tip_error.max())}
    return [row]


def box_turn(data: Path, folder: Path) -> list[Row]:
    mesh = trimesh.creation.box(TURNED_BOX_M)
    mesh = mesh.subdivide_to_size(0.03)  # the tracker keeps colours around spread-out vertices
    mesh.export(folder / "box.ply")
    request = ObjectRequest("box", TURNED_BOX_PX, mesh=folder / "box.ply", mesh_unit="m")
    _, row = _extracted(data / "videos/box_turn.mp4", request, None, folder)
    row["given"] = "box of its proportions, box"
    return [row]


def synthetic(name: str, folder: Path) -> list[Row]:
    category, seed, *given = name.split(":")
    clip = synthesize(category, int(seed), folder, depth="depth" in given)
    truth = load_truth(clip.truth_path)
    box = tuple(float(v) for v in clip.boxes_xywh_px["object"])
    request = ObjectRequest(category, box if "box" in given else None)
    depth = folder / "depth" if "depth" in given else None
    track, row = _extracted(clip.video, request, truth.camera_matrix, folder, depth)
    row["given"] = ", ".join(["category", "camera", *given])
    row |= _errors(track, truth, None)
    far_m, far_truth_m = (np.linalg.norm(t.T_camera_object[:, :3, 3], axis=1) for t in (track, truth))
    row["distance_mm"] = 1e3 * float(np.mean(np.abs(far_m - far_truth_m)))
    row["bands"] = _bands(track, truth)
    library = clip.truth.header["mesh"]["library"]
    model = make_vessel(library["category"], None, **library["params"]).mesh
    return [row, *_beside(clip.video, box, truth, model, False)]


REAL: dict[str, Callable[[Path, Path], list[Row]]] = {
    "mustard_exact": lambda data, folder: mustard(data, folder, exact=True),
    "mustard_library": lambda data, folder: mustard(data, folder, exact=False),
    "coffee_pour": lambda data, folder: coffee(data, folder, box=True),
    "coffee_found": lambda data, folder: coffee(data, folder, box=False),
    "box_turn": box_turn,
}


def _extracted(
    video: Path, request: ObjectRequest, camera: np.ndarray | None, folder: Path, depth: Path | None = None
) -> tuple[ObjectTrack, Row]:
    """The track, frames a second of following it, and of that with the overlay's writing, and the peak memory.

    Following is all between the start and the overlay: both passes and the fit of the shape. Seconds are of processor
    time, so that what else runs on the machine does not count.
    """
    marks: list[tuple[float, str]] = []

    def mark(done: int, total: int, what: str) -> None:
        if not marks or marks[-1][1] != what:
            marks.append((time.process_time(), what))

    given = (
        None if camera is None else tuple(float(v) for v in (camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]))
    )
    begin_s = time.process_time()
    track = extract(video, [request], out=folder / "out", camera=given, depth=depth, progress=mark)[request.name]
    end_s = time.process_time()
    started_s = next((t for t, what in marks if "looking" not in what), end_s)
    followed_s = next((t for t, what in marks if "overlay" in what), end_s)
    row: Row = {"visible_percent": 100 * float(track.visible.mean())}
    row |= {"confidence": float(track.confidence.mean()), "frames": len(track)}
    row |= {"start_s": started_s - begin_s, "fps": len(track) / max(followed_s - started_s, 1e-9)}
    row |= {"fps_written": len(track) / max(end_s - started_s, 1e-9)}
    row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return track, row


def _errors(track: ObjectTrack, truth: Truth, model: Any | None) -> Row:
    found = compare_tracks(track, truth, model=model)
    poses, velocity = found.pose, found.velocity["paper"]
    row: Row = {"aligned_deg": poses.aligned_rotation_deg, "rotation_deg": poses.rotation_deg}
    row |= {"e_rot": velocity.e_rot, "e_proj": velocity.e_proj, "e_depth": velocity.e_depth}
    row["projected_percent"] = poses.projected_percent
    if poses.adds_auc_percent is not None:
        row |= {"adds_auc_percent": poses.adds_auc_percent, "worst_stretch": poses.worst_stretch}
    return row


def _bands(track: ObjectTrack, truth: Truth) -> list[list[float]]:
    """Of the frames in each band of confidence: number, sum of what was said, upright axis right, all turns right."""
    T, G = track.T_camera_object[:, :3, :3], truth.T_camera_object[:, :3, :3]
    symmetry = truth.symmetry or Symmetry()
    tilt_rad = np.arccos(np.clip(np.sum(T[:, :, 2] * G[:, :, 2], axis=1), -1, 1))
    turn_rad = symmetry.error_rad(T, G)
    bands = []
    for low, high in itertools.pairwise(BANDS):
        here = (track.confidence >= low) & (track.confidence < high)
        right = [int(np.sum(here & (error < RIGHT_RAD))) for error in (tilt_rad, turn_rad)]
        bands.append([int(here.sum()), float(track.confidence[here].sum()), *right])
    return bands


def _summary(rows: list[Row]) -> str:
    """The synthetic clips together, and how often a frame was right that was said to be so with a confidence."""
    turned, moved = (np.array([row[key] for row in rows]) for key in ("aligned_deg", "projected_percent"))
    lines = [
        f"{len(rows)} synthetic clips: aligned rotation error median {np.median(turned):.1f}, mean {turned.mean():.1f} "
        f"deg, {np.sum(turned <= 5)} within 5; projected error mean {moved.mean():.2f} %, {np.sum(moved <= 1)} within "
        f"1; {np.sum([row['visible_percent'] < 100 for row in rows])} lost for a while",
        "",
        f"| confidence | frames | said | axis within {np.rad2deg(RIGHT_RAD):.0f} deg | with the spin |",
        "| --- " * 5 + "|",
    ]
    bands = np.sum([row["bands"] for row in rows], axis=0)
    for (low, high), (count, said, axis, whole) in zip(itertools.pairwise(BANDS), bands, strict=True):
        share = [f"{100 * value / max(count, 1):.0f} %" for value in (said, axis, whole)]
        lines.append(f"| {low:.2f} to {min(high, 1.0):.2f} | {count:.0f} | " + " | ".join(share) + " |")
    return "\n".join(lines)


def _beside(
    video: Path, box: tuple[float, float, float, float], truth: Truth, model: Any, with_model: bool
) -> list[Row]:
    """What a track that never moves, the truth smoothed, and box trackers score against the same truth."""
    info = read_video_info(video)
    size = [info.width_px, info.height_px]
    extents = [float(v) for v in model.extents]
    symmetry = (truth.symmetry or Symmetry()).to_json()
    T, count = truth.T_camera_object, len(truth.time_s)
    smooth = smooth_poses(T, truth.time_s, np.ones(count), 0.1)
    shifted, solved, fps = _box_tracked(video, box, T[0], truth.camera_matrix, np.asarray(model.vertices))
    named = {
        "never moves": np.tile(T[0], (count, 1, 1)),
        "truth smoothed": smooth,
        "coarse: first pose moved with a tracked box": shifted,
        "coarse: PnP on a tracked box": solved,
    }
    rows = []
    for name, poses in named.items():
        n = min(len(poses), count)
        header = {"object": name, "mesh": {"extents_m": extents, "symmetry": symmetry}, "image_size_px": size}
        ones = np.ones(n)
        track = ObjectTrack(poses[:n], truth.time_s[:n], truth.camera_matrix, ones, ones > 0, header)
        rows.append({"clip": "", "given": name, **_errors(track, truth, model if with_model else None)})
        if name.startswith("coarse"):
            rows[-1]["fps"] = fps
    return rows


def _box_tracked(
    video: Path, box: tuple[float, float, float, float], T_first: np.ndarray, K: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """(N, 4, 4) poses twice, from one box tracker, and its frames a second.

    First the true first pose moved and scaled as the box is; then PnP on the four vertices that touch the sides of
    the first box, kept in their places relative to the box.
    """
    frames = iterate_frames(video)
    first = next(frames).rgb
    follow = _box_tracker(first, box)
    uv = project(K, transform_points(T_first, points))
    touching = np.unique([uv[:, 0].argmin(), uv[:, 0].argmax(), uv[:, 1].argmin(), uv[:, 1].argmax()])
    low, high = uv.min(axis=0), uv.max(axis=0)
    share = (uv[touching] - low) / (high - low)
    margin = np.array([box[0], box[1], box[0] + box[2], box[1] + box[3]]) - np.concatenate([low, high])
    rvec, tvec = cv2.Rodrigues(T_first[:3, :3])[0], T_first[:3, 3:].copy()
    shifted, solved = [T_first], [T_first]
    begin_s = time.process_time()
    for frame in frames:
        x, y, w, h = follow(frame.rgb)
        scale = np.sqrt(box[2] * box[3] / max(w * h, 1.0))
        centre = np.array([x + w / 2, y + h / 2]) + project(K, T_first[None, :3, 3])[0]
        centre -= [box[0] + box[2] / 2, box[1] + box[3] / 2]
        T = T_first.copy()
        T[:3, 3] = np.linalg.inv(K) @ np.array([*centre, 1.0]) * (T_first[2, 3] * scale)
        shifted.append(T)
        corner = np.array([x, y, x + w, y + h]) - margin / scale
        pixels = corner[:2] + share * (corner[2:] - corner[:2])
        good, r, t = cv2.solvePnP(
            points[touching], pixels, K, None, rvec.copy(), tvec.copy(), True, cv2.SOLVEPNP_ITERATIVE
        ) if len(touching) >= 3 else (False, rvec, tvec)  # fmt: skip
        T = solved[-1].copy()
        if good and 0.2 * T_first[2, 3] < t[2, 0] < 5 * T_first[2, 3]:
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0], t[:, 0]
        solved.append(T)
    return np.stack(shifted), np.stack(solved), len(shifted) / (time.process_time() - begin_s)


def _box_tracker(
    rgb: np.ndarray, box: tuple[float, float, float, float]
) -> Callable[[np.ndarray], tuple[float, float, float, float]]:
    """A function from the next picture to the object's box in it."""
    x, y, w, h = (round(v) for v in box)
    if hasattr(cv2, "TrackerMIL"):
        cv2.setRNGSeed(0)
        tracker = cv2.TrackerMIL.create()
        tracker.init(rgb[..., ::-1].copy(), (x, y, w, h))
        return lambda picture: tuple(float(v) for v in tracker.update(picture[..., ::-1].copy())[1])
    template = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[max(y, 0) : y + h, max(x, 0) : x + w]

    def match(picture: np.ndarray) -> tuple[float, float, float, float]:
        score = cv2.matchTemplate(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), template, cv2.TM_CCOEFF_NORMED)
        left, top = cv2.minMaxLoc(score)[3]
        return float(left), float(top), float(w), float(h)

    return match


COLUMNS = {
    "clip": "clip", "given": "given", "aligned_deg": "aligned rot., deg", "e_rot": "e_rot", "e_proj": "e_proj",
    "adds_auc_percent": "ADD-S AUC, %", "worst_stretch": "worst stretch", "projected_percent": "projected, %",
    "distance_mm": "distance, mm",
    "tilt_deg": "tilt, deg", "tip_px": "spout tip, px", "visible_percent": "visible, %", "start_s": "start, s",
    "fps": "fps", "fps_written": "with overlay", "peak_mb": "peak, MB",
}  # fmt: skip


def _table(rows: list[Row]) -> str:
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|" + " --- |" * len(COLUMNS)]
    for row in rows:
        lines.append("| " + " | ".join(_cell(key, row.get(key)) for key in COLUMNS) + " |")
    return "\n".join(lines)


def _cell(key: str, value: Any) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    return f"{value:.4f}" if key == "e_proj" else f"{value:.3f}" if key == "e_rot" else f"{value:.1f}"


def _line(row: Row) -> str:
    return ", ".join(f"{COLUMNS[key]} {_cell(key, row[key])}" for key in COLUMNS if key in row)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
