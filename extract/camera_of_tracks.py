"""What a clip's camera did, told to the tracks of its objects: it stood, it turned, or it moved through the room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .camera_motion import CameraWatch
from .camera_path import camera_path
from .camera_scale import path_scale
from .geometry import Array
from .track import ObjectTrack

SURE_OF_CAMERA = 0.5  # median share of the background that agrees on how the camera turned or moved
LEAST_PARALLAX_DEG = 1.5  # with less, a path is mostly noise
LEAST_FRAMES = 0.8  # share that the path must place
SLIP_PX = 1.0  # how far corners slide while they are followed: read off synthetic clips, at the size worked on


def with_camera(tracks: Mapping[str, ObjectTrack], watch: CameraWatch | None, asked: str) -> dict[str, ObjectTrack]:
    """The tracks with their camera's motion, and header["camera"]["motion"] that tells how it was found.

    `kind` there is static, turning, moving, or "moving, not compensated" with `why_not`; of a moving camera `path_m`
    is the length of its path, `scale_std` how uncertain that is, as a share. watch: None for a camera that was not
    watched.  asked: "auto", "static" or "moving".
    """
    T_first_camera, words = _camera(list(tracks.values()), watch, asked)
    told = {}
    for name, track in tracks.items():
        header = {**track.header, "camera": {**track.header["camera"], "motion": words}}
        told[name] = replace(track, T_first_camera=T_first_camera, header=header)
    return told


def _camera(
    tracks: Sequence[ObjectTrack], watch: CameraWatch | None, asked: str
) -> tuple[Array | None, dict[str, Any]]:
    if watch is None:
        return None, {"asked": asked, "kind": "static"}
    motion = watch.result()
    quality = round(float(np.median(motion.quality)), 3)
    told = {"asked": asked, "stray_px": round(motion.stray_px, 2), "quality": quality}
    if motion.static:
        return None, {**told, "kind": "static"}
    T_first_camera, words = _moved(tracks, watch)
    if T_first_camera is not None:
        return T_first_camera, {**told, **words, "kind": "moving"}
    if motion.rotates_only and quality > SURE_OF_CAMERA:
        return motion.T_first_camera, {**told, "kind": "turning"}
    if asked == "moving":
        # A rotation is a poor account of a camera that moves sideways, but better than none for one said to move.
        return motion.T_first_camera, {**told, **words, "kind": "turning"}
    return None, {**told, **words, "kind": "moving, not compensated"}


def _moved(tracks: Sequence[ObjectTrack], watch: CameraWatch) -> tuple[Array | None, dict[str, Any]]:
    """The camera's path in m and what tells how good it is, or None and why there is none."""
    path = camera_path(watch.sightings, watch.working_camera)
    if path is None or path.parallax_deg < LEAST_PARALLAX_DEG:
        return None, {"why_not": "the background shows too little parallax, or too few corners, to tell a path"}
    quality = float(np.median(path.quality))
    words: dict[str, Any] = {
        "quality": round(quality, 3),
        "parallax_deg": round(path.parallax_deg, 2),
        "error_px": round(path.error_px, 3),
        "points": path.points,
    }
    if quality < SURE_OF_CAMERA or np.mean(path.quality > 0) < LEAST_FRAMES:
        return None, {**words, "why_not": "the background could not be followed through enough of the clip"}
    scale = path_scale(tracks, path.T_first_camera)
    if scale.why_not:
        return None, {**words, "why_not": scale.why_not}
    T = path.T_first_camera.copy()
    T[:, :3, 3] *= scale.m
    # What slides alike is taken for motion: the path comes out longer or shorter by as much as that is of the parallax.
    slip = SLIP_PX / (watch.working_camera[0, 0] * np.deg2rad(path.parallax_deg))
    std = float(np.hypot(scale.std / scale.m, slip))
    length_m = float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())
    return T, {**words, "path_m": round(length_m, 4), "scale_std": round(std, 4)}
