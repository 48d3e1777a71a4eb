"""The paper's way through a video: single frames, and translations by single frames, by point tracks, and by both.

    python bench/video_refinement.py [--clips mustard mug:0 ...] [--level auto] [--shared ../shared] [--json FILE]

Rows: single frames alone; then PnP's rotations with each of the three translations, before smoothing and after. A clip
is `mustard` (a real recording, exact mesh) or CATEGORY:SEED (rendered, the exact vessel as the mesh).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from vid2demo.extract.candidates import ObjectRequest
from vid2demo.extract.compare import Truth, compare_tracks, load_truth
from vid2demo.extract.meshes import load_mesh
from vid2demo.extract.refine_tracks import Translation
from vid2demo.extract.smoothing import smooth_poses
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import make_vessel
from vid2demo.extract.video import read_video_info
from vid2demo.extract.video_pose import Posed, find_means, pose_through_video

KINDS: tuple[Translation, ...] = ("coarse", "pnp", "fused")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", nargs="+", default=["mustard", "mug:0", "pitcher:0"], metavar="CLIP")
    parser.add_argument("--level", default="classical", choices=["auto", "foundation", "classical"])
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    parser.add_argument("--rendered", type=Path, help="folder of clips CATEGORY_SEED that were rendered before")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    means, _ = find_means(chosen.level, None)
    rows: list[dict[str, Any]] = []
    for name in chosen.clips:
        with tempfile.TemporaryDirectory() as folder:
            video, request, truth, model = clip_of(name, chosen, Path(folder))
            begin_s = time.process_time()
            info = read_video_info(video)
            posed = pose_through_video(info, request, truth.camera_matrix, means, 0, lambda *_: None)
            seconds = time.process_time() - begin_s
            for title, poses in poses_of(posed).items():
                rows.append({"clip": name, "poses": title, "seconds": seconds, **errors(poses, posed, truth, model)})
                print(line(rows[-1]), flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n")


def clip_of(name: str, chosen: argparse.Namespace, folder: Path) -> tuple[Path, ObjectRequest, Truth, Any]:
    """Video, what to look for, truth, and the mesh in m."""
    if name == "mustard":
        data = chosen.shared / "data"
        clip, mesh = data / "tracking/mustard_a", data / "meshes/mustard_bottle.obj"
        box = json.loads((clip / "info.json").read_text())["box_first_frame_xywh_px"]
        request = ObjectRequest("mustard", tuple(box), mesh, "m")
        return clip / "video.mp4", request, load_truth(clip / "truth.npz"), load_mesh(mesh, "m")
    category, seed = name.split(":")
    rendered = None if chosen.rendered is None else chosen.rendered / f"{category}_{seed}"
    if rendered is None:
        rendered = folder
        synthesize(category, int(seed), folder)
    library = ObjectTrack.load(rendered / "truth.track.npz").header["mesh"]["library"]
    model = make_vessel(library["category"], None, **library["params"]).mesh
    model.export(folder / "exact.ply")
    box = json.loads((rendered / "settings.json").read_text())["boxes_xywh_px"]["object"]
    request = ObjectRequest(category, tuple(float(v) for v in box), folder / "exact.ply", "m")
    return rendered / "video.mp4", request, load_truth(rendered / "truth.track.npz"), model


def poses_of(posed: Posed) -> dict[str, np.ndarray]:
    """(N, 4, 4) by row."""
    rows = {"single frames": posed.coarse}
    rows |= {f"refined, {kind}": posed.translated(kind) for kind in KINDS}
    weight = np.where(posed.seen, np.maximum(posed.score, 0.05), 0.0)
    smooth = {f"{title}, smoothed": smooth_poses(poses, posed.time_s, weight) for title, poses in rows.items()}
    return rows | smooth


def errors(poses: np.ndarray, posed: Posed, truth: Truth, model: Any) -> dict[str, float]:
    """The paper's errors of motion, and those of single poses."""
    header = {
        "mesh": {"extents_m": [float(v) for v in model.extents]},
        "image_size_px": [round(2 * v) for v in truth.camera_matrix[:2, 2]],
    }
    track = ObjectTrack(poses, posed.time_s, truth.camera_matrix, np.ones(len(poses)), posed.seen, header)
    found = compare_tracks(track, truth, model=model)
    velocity = found.velocity["official"]
    return {
        "e_rot": velocity.e_rot,
        "e_proj": velocity.e_proj,
        "e_depth": velocity.e_depth,
        "rotation_deg": found.pose.rotation_deg,
        "translation_percent": 100 * float(
            np.mean(np.linalg.norm((poses - truth.T_camera_object[: len(poses)])[:, :3, 3], axis=1))
            / max(model.extents)
        ),
        "adds_auc_percent": found.pose.adds_auc_percent or float("nan"),
    }  # fmt: skip


def line(row: dict[str, Any]) -> str:
    return (
        f"{row['clip']:<12}{row['poses']:<28}e_rot {row['e_rot']:.3f}  e_proj {row['e_proj']:.4f}  "
        f"e_depth {row['e_depth']:.4f}  rotation {row['rotation_deg']:.1f} deg  "
        f"translation {row['translation_percent']:.1f} % of size  ADD-S AUC {row['adds_auc_percent']:.1f} %  "
        f"{row['seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
