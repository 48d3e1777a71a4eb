"""Draw tracks over the video they came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, invert_pose, project, scaled_camera, transform_points
from .region import TrackingMesh
from .track import ObjectTrack
from .video import Image, VideoWriter, iterate_frames, read_video_info

COLOURS = ((64, 220, 110), (255, 160, 40), (90, 170, 255), (240, 90, 160))
TRAIL_S = 2.0


@dataclass(frozen=True)
class OverlayItem:
    """A track and the mesh it is about."""

    track: ObjectTrack
    mesh: TrackingMesh


def write_overlay(video: Path, items: Sequence[OverlayItem], out: Path, max_side_px: int = 960) -> None:
    """Write a video with the outline, axes, trail and confidence of every track drawn over the frames."""
    info = read_video_info(video)
    shrink = min(1.0, max_side_px / max(info.width_px, info.height_px))
    size = round(shrink * info.width_px), round(shrink * info.height_px)
    scale = size[0] / info.width_px
    with VideoWriter(out, info.fps, preset="ultrafast") as writer:
        for frame in iterate_frames(video, info=info):
            # Not by averaging areas, which takes five times as long: nothing is measured in these pictures.
            image = np.asarray(cv2.resize(frame.rgb, size), np.uint8)
            for colour, item in zip(COLOURS * len(items), items, strict=False):
                if frame.index < len(item.track):
                    draw_track(image, item, frame.index, scale, colour)
            writer.write(image, frame.time_s)


def draw_track(image: Image, item: OverlayItem, index: int, scale: float, colour: tuple[int, int, int]) -> None:
    """Draw one track at frame `index` onto an image that is `scale` times the track's image size, in place."""
    track, T = item.track, item.track.T_camera_object[index]
    K = scaled_camera(track.camera_matrix, scale)
    height, width = image.shape[:2]
    visible = bool(track.visible[index])
    window = item.mesh.drawn(T, K)
    if window is not None and visible:
        silhouette = window.mask_in_image(width, height).astype(np.uint8)
        contours, _ = cv2.findContours(silhouette, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
        cv2.drawContours(image, contours, -1, (255, 255, 255), 3, cv2.LINE_AA)
        cv2.drawContours(image, contours, -1, colour, 2, cv2.LINE_AA)
        _draw_axes(image, T, K, 0.6 * item.mesh.radius_m)
    past = (track.time_s <= track.time_s[index]) & (track.time_s > track.time_s[index] - TRAIL_S) & track.visible
    trail = project(K, where_it_was(track, past, index))
    if len(trail) > 1:
        cv2.polylines(image, [np.round(trail).astype(np.int32)], False, colour, 2, cv2.LINE_AA)
    state = f"{track.confidence[index]:.0%}" if visible else "not in view"
    at = np.round(project(K, T[None, :3, 3])[0] + 8).astype(int)
    x, y = int(np.clip(at[0], 4, width - 120)), int(np.clip(at[1], 16, height - 6))
    for shade, thickness in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(
            image, f"{track.name} {state}", (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, shade, thickness, cv2.LINE_AA
        )


def where_it_was(track: ObjectTrack, past: NDArray[np.bool_], index: int) -> Array:
    """(M, 3) places of the object in past frames, in the camera of this one, before which they lie."""
    if track.T_first_camera is None:
        return np.asarray(track.T_camera_object[past, :3, 3])
    first = track.from_first_camera().T_camera_object[past, :3, 3]
    here = transform_points(invert_pose(track.T_first_camera[index]), first)
    return np.asarray(here[here[:, 2] > 1e-3])


def _draw_axes(image: Image, T: Array, K: Array, length_m: float) -> None:
    tips = transform_points(T, length_m * np.vstack([np.zeros(3), np.eye(3)]))
    if tips[:, 2].min() < 1e-3:
        return
    pixels = [tuple(int(v) for v in np.round(p)) for p in project(K, tips)]
    for tip, colour in zip(pixels[1:], ((235, 60, 60), (60, 200, 60), (70, 110, 255)), strict=True):
        cv2.arrowedLine(image, pixels[0], tip, colour, 2, cv2.LINE_AA, tipLength=0.18)
