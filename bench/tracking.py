"""Tracking accuracy: synthetic pours with exact truth, and the real pour against tilts read off its frames by eye.

    python bench/tracking.py [--clips mug:0 pitcher:1 ...] [--video ../shared/data/videos/coffee_pour.mp4] [--json FILE]

Rotation errors are up to the object's symmetry; the position error is the projected distance between the estimated and
the true origin, in percent of the image diagonal. A track that never moves is printed beside every clip.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from vid2demo.extract.geometry import project
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack

CLIPS = ("mug:0", "pitcher:1", "gooseneck_kettle:2", "mug:3", "bottle:4")

# coffee_pour.mp4: frame -> tilt of the kettle's body in the image, from the slopes of its base and rim, +-2 degrees.
TILT_BY_EYE_DEG = {
    0: 0.0, 10: 7.0, 20: 22.5, 32: 33.5, 60: 46.3, 90: 49.5,
    120: 54.5, 150: 55.0, 180: 55.5, 210: 59.5, 240: 58.0, 270: 54.8,
}  # fmt: skip
KETTLE_BOX_PX = (345.0, 297.0, 488.0, 342.0)


def image_tilt_deg(track: ObjectTrack) -> np.ndarray:
    """Angle of the object's +z axis from the image's vertical, clockwise, for every frame."""
    axis = track.T_camera_object[:, :3, 2]
    return np.rad2deg(np.arctan2(axis[:, 0], -axis[:, 1]))


def against_truth(estimate: ObjectTrack, truth: ObjectTrack) -> dict[str, float]:
    """Mean and 95th percentile errors over the frames of both tracks; the object frames must be the same."""
    n = min(len(estimate), len(truth))
    error_deg = np.rad2deg(
        truth.symmetry.error_rad(truth.T_camera_object[:n, :3, :3], estimate.T_camera_object[:n, :3, :3])
    )
    diagonal_px = float(np.hypot(*truth.header["image_size_px"]))
    pixels = [project(t.camera_matrix, t.T_camera_object[:n, :3, 3]) for t in (estimate, truth)]
    error_percent = 100 * np.linalg.norm(pixels[0] - pixels[1], axis=1) / diagonal_px
    return {
        "rotation_mean_deg": float(error_deg.mean()),
        "rotation_p95_deg": float(np.percentile(error_deg, 95)),
        "projected_mean_percent": float(error_percent.mean()),
        "visible_percent": 100 * float(estimate.visible[:n].mean()),
    }


def still(track: ObjectTrack) -> ObjectTrack:
    """The track that never moves from its first pose."""
    poses = np.tile(track.T_camera_object[0], (len(track), 1, 1))
    return ObjectTrack(poses, track.time_s, track.camera_matrix, track.confidence, track.visible, track.header)


def synthetic_row(name: str, folder: Path) -> dict[str, float | str]:
    category, seed = name.split(":")
    clip = folder / name.replace(":", "_")
    synthesize(category, int(seed), clip)
    truth = ObjectTrack.load(clip / "truth.track.npz")
    box = json.loads((clip / "settings.json").read_text())["boxes_xywh_px"]["object"]
    fx, fy, cx, cy = truth.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    start_s = time.perf_counter()
    request = ObjectRequest(category, tuple(box))
    track = extract(clip / "video.mp4", [request], out=clip / "out", camera=(fx, fy, cx, cy))[category]
    seconds = time.perf_counter() - start_s
    row: dict[str, float | str] = {"clip": name, **against_truth(track, truth)}
    row["never_moves_deg"] = against_truth(still(truth), truth)["rotation_mean_deg"]
    row["fps"] = len(track) / seconds
    return row


def coffee_row(video: Path, folder: Path) -> dict[str, float | str]:
    start_s = time.perf_counter()
    track = extract(video, [ObjectRequest("kettle", KETTLE_BOX_PX)], out=folder / "coffee")["kettle"]
    seconds = time.perf_counter() - start_s
    tilt = image_tilt_deg(track)
    errors = np.array([tilt[k] - by_eye for k, by_eye in TILT_BY_EYE_DEG.items()])
    return {
        "clip": video.name,
        "tilt_mean_error_deg": float(np.abs(errors).mean()),
        "tilt_worst_error_deg": float(np.abs(errors).max()),
        "visible_percent": 100 * float(track.visible.mean()),
        "fps": len(track) / seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="*", default=list(CLIPS), metavar="CATEGORY:SEED")
    parser.add_argument("--video", type=Path, help="coffee_pour.mp4")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.clips:
            rows.append(synthetic_row(name, Path(folder)))
            print(rows[-1], flush=True)
        if arguments.video:
            rows.append(coffee_row(arguments.video, Path(folder)))
            print(rows[-1], flush=True)
    print("\n| clip | figures |\n|---|---|")
    for row in rows:
        figures = ", ".join(f"{k} {v:.2f}" for k, v in row.items() if isinstance(v, float))
        print(f"| {row['clip']} | {figures} |")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
