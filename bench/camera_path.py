"""How well a moving camera's path is told, on synthetic clips with exact truth: carried, turning in place, still.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/camera_path.py [--clips walk:mug:0 turn:mug:0 ...] [--extract]
        [--size 640 480] [--seconds 6] [--out runs/camera_path] [--json FILE]

Each clip is rendered once. Its background is watched with both vessels left out, and the scale told by the true tracks:
that is the camera's part alone. With --extract the whole of extraction follows both vessels from their boxes, and the
handled one's track is compared in the first frame's camera, as it comes and with the camera taken to stand still.
Times are of the processor.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from vid2demo.extract.camera_motion import CameraWatch
from vid2demo.extract.camera_of_tracks import with_camera
from vid2demo.extract.compare import compare_tracks, load_truth
from vid2demo.extract.files import write_json
from vid2demo.extract.geometry import projected_box, rotation_angle_rad
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import make_vessel
from vid2demo.extract.video import iterate_frames

CLIPS = ("walk:mug:0", "walk:gooseneck_kettle:1", "walk:pitcher:2", "turn:mug:0", "still:mug:0")
COLUMNS = {
    "kind": "told",
    "path_percent": "path %",
    "rotation_deg": "rot deg",
    "scale_percent": "scale %",
    "scale_std_percent": "said +-",
    "parallax_deg": "parallax",
    "watch_ms": "ms/frame",
    "path_s": "path s",
    "before_deg": "before deg",
    "after_deg": "after deg",
    "before_mm": "before mm",
    "after_mm": "after mm",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", nargs="*", default=list(CLIPS), metavar="PATH:CATEGORY:SEED")
    parser.add_argument("--extract", action="store_true", help="follow the vessels as well: minutes a clip")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--out", type=Path, default=Path("runs/camera_path"))
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    rows = []
    for name in chosen.clips:
        folder = rendered(name, chosen.out, tuple(chosen.size), chosen.seconds)
        row = camera_alone(folder) | (followed(folder) if chosen.extract else {})
        rows.append({"clip": name, **row})
        print(table(rows[-1:], header=len(rows) == 1), flush=True)
    if chosen.json:
        write_json(chosen.json, {"rows": rows})


def rendered(name: str, out: Path, size: tuple[int, int], seconds: float) -> Path:
    """The clip's folder."""
    path, category, seed = name.split(":")
    folder = out / f"{path}_{category}_{seed}_{size[0]}x{size[1]}_{seconds:g}s"
    if not (folder / "settings.json").exists():
        synthesize(category, int(seed), folder, camera_path=path, size=size, seconds=seconds)
    return folder


def camera_alone(folder: Path) -> dict[str, Any]:
    """Errors of the camera's path, by the true tracks."""
    truth = [ObjectTrack.load(folder / f"{name}.track.npz") for name in ("truth", "receptacle")]
    corners = [_vertices(track) for track in truth]
    K, spent, count = truth[0].camera_matrix, 0.0, len(truth[0])
    watch = CameraWatch(K)
    for frame in iterate_frames(folder / "video.mp4"):
        found = (projected_box(K, t.T_camera_object[frame.index], c) for t, c in zip(truth, corners, strict=True))
        boxes = [box for box in found if box is not None]
        start = time.process_time()
        watch.step(frame.rgb, boxes=boxes)
        spent += time.process_time() - start
    start = time.process_time()
    tracks = {str(k): replace(track, T_first_camera=None) for k, track in enumerate(truth)}
    track = with_camera(tracks, watch, "auto")["0"]
    path_s = time.process_time() - start
    words = track.header["camera"]["motion"]
    row = {"kind": words["kind"], "watch_ms": 1000 * spent / count, "path_s": path_s}
    still = np.tile(np.eye(4), (count, 1, 1))
    T, T_true = (still if t.T_first_camera is None else t.T_first_camera for t in (track, truth[0]))
    row["rotation_deg"] = float(np.rad2deg(rotation_angle_rad(T[:, :3, :3], T_true[:, :3, :3])).mean())
    length_m = float(np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1).sum())
    if length_m > 0 and words["kind"] == "moving":
        found, true = T[:, :3, 3], T_true[:, :3, 3]
        row["path_percent"] = 100 * float(np.linalg.norm(found - true, axis=1).mean()) / length_m
        row["scale_percent"] = 100 * float(np.sum(found * true) / np.sum(true**2) - 1)
        row |= {"scale_std_percent": 100 * words["scale_std"], "parallax_deg": words["parallax_deg"]}
    return row


def followed(folder: Path) -> dict[str, Any]:
    """Errors of the handled vessel's track in the first frame's camera: turn up to one constant, and place."""
    told = json.loads((folder / "settings.json").read_text())
    K = told["camera_matrix"]
    names = [told["category"], told["receptacle"]]
    boxes = [tuple(told["boxes_xywh_px"][role]) for role in ("object", "receptacle")]
    requests = [ObjectRequest(name, box_xywh_px=box) for name, box in zip(names, boxes, strict=True)]
    camera = (K[0][0], K[1][1], K[0][2], K[1][2])
    track = extract(folder / "video.mp4", requests, out=folder / "extract", camera=camera)[names[0]]
    truth = load_truth(folder / "truth.track.npz")
    if truth.T_first_camera is None:
        truth = replace(truth, T_first_camera=np.tile(np.eye(4), (len(truth.time_s), 1, 1)))
    row = {}
    for when, seen in (("before", replace(track, T_first_camera=None)), ("after", track)):
        errors = compare_tracks(seen, truth).first_camera
        assert errors is not None
        row |= {f"{when}_deg": errors.aligned_rotation_deg, f"{when}_mm": 1000 * errors.translation_m}
    return row


def _vertices(track: ObjectTrack) -> np.ndarray:
    library = track.header["mesh"]["library"]
    return np.asarray(make_vessel(library["category"], **library["params"]).mesh.vertices)


def table(rows: list[dict[str, Any]], *, header: bool = True) -> str:
    """The rows for a reader."""
    lines = [f"{'clip':<26}" + "".join(f"{words:>12}" for words in COLUMNS.values())] if header else []
    for row in rows:
        cells = (row.get(key, "") for key in COLUMNS)
        shown = (f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells)
        lines.append(f"{row['clip']:<26}" + "".join(f"{cell[:11]:>12}" for cell in shown))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
