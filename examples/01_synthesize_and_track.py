"""Render a clip with exact truth, follow its vessel and print how far off the track is.

python examples/01_synthesize_and_track.py [OUT]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack

out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
synthesize("mug", seed=3, out=out / "clip")
truth = ObjectTrack.load(out / "clip" / "truth.track.npz")
box = json.loads((out / "clip" / "settings.json").read_text())["boxes_xywh_px"]["object"]

K = truth.camera_matrix
camera = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
track = extract(out / "clip" / "video.mp4", [ObjectRequest("mug", tuple(box))], out=out, camera=camera)["mug"]

error_rad = truth.symmetry.error_rad(truth.T_camera_object[:, :3, :3], track.T_camera_object[:, :3, :3])
print(f"{len(track)} frames, rotation error {np.rad2deg(error_rad).mean():.1f} degrees on average")
print(f"look at {out / 'overlay.mp4'}")
