"""What a clip's camera did, told to the tracks of its objects: it stood, it turned, or it moved through the room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .camera_motion import CameraWatch
from .geometry import Array, make_pose
from .track import ObjectTrack

SURE_OF_CAMERA = 0.5  # median share of the background that agrees on how the camera turned


def with_camera(tracks: Mapping[str, ObjectTrack], watch: CameraWatch | None, asked: str) -> dict[str, ObjectTrack]:
    """The tracks with their camera's motion, and header["camera"]["motion"] that tells how it was found.

    watch: None for a camera that was not watched.  asked: "auto", "static" or "moving".
    """
    T_first_camera, words = _camera(watch, asked)
    told = {}
    for name, track in tracks.items():
        header = {**track.header, "camera": {**track.header["camera"], "motion": words}}
        told[name] = replace(track, T_first_camera=T_first_camera, header=header)
    return told


def _camera(watch: CameraWatch | None, asked: str) -> tuple[Array | None, dict[str, Any]]:
    if watch is None:
        return None, {"asked": asked, "kind": "static"}
    motion = watch.result()
    quality = round(float(np.median(motion.quality)), 3)
    told = {"asked": asked, "stray_px": round(motion.stray_px, 2), "quality": quality}
    # A rotation is a poor account of a camera that moves sideways, but better than none for one said to move.
    turns = (motion.rotates_only and quality > SURE_OF_CAMERA) if asked == "auto" else not motion.static
    if turns:
        return np.stack([make_pose(R) for R in motion.R_first_camera]), {**told, "kind": "turning"}
    return None, {**told, "kind": "static" if motion.static else "moving, not compensated"}
