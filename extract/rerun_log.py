"""Tracks as a recording for the Rerun viewer: the camera with its pictures, the meshes as they move, confidence.

The world is the first frame's camera; one that moves takes its pictures and the objects in them along.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import UserError
from .files import atomic_path
from .geometry import Array, scaled_camera
from .overlay import OverlayItem
from .video import iterate_frames

PICTURE_SIDE_PX = 640


def load_rerun() -> Any:
    """The module `rerun`. Raises UserError with the command that installs it when it is missing."""
    try:
        import rerun
    except ImportError as error:
        raise UserError("--rerun needs rerun-sdk, which is missing; run `pip install 'vid2demo[rerun]'`") from error
    return rerun


def write_rerun(video: Path, items: Sequence[OverlayItem], out: Path) -> None:
    """Write an .rrd file. All items have one camera and one time base. Raises UserError without rerun-sdk."""
    rr = load_rerun()
    track = items[0].track
    with atomic_path(out) as temporary:
        recording = rr.RecordingStream("vid2demo_extract")
        recording.save(str(temporary))
        recording.log("camera", rr.ViewCoordinates.RDF, static=True)
        for item in items:
            place = f"camera/{item.track.name}"
            mesh = rr.Mesh3D(vertex_positions=item.mesh.vertices_m, triangle_indices=item.mesh.faces)
            recording.log(f"{place}/mesh", mesh, static=True)
            path = item.track.from_first_camera().T_camera_object[item.track.visible, :3, 3]
            recording.log(f"path/{item.track.name}", rr.LineStrips3D([path]), static=True)
        if track.T_first_camera is not None:
            recording.log("path/camera", rr.LineStrips3D([track.T_first_camera[:, :3, 3]]), static=True)
        for frame in iterate_frames(video, PICTURE_SIDE_PX):
            if frame.index >= len(track):
                break
            recording.set_time("video", duration=frame.time_s)
            if track.T_first_camera is not None:
                recording.log("camera", _transform(rr, track.T_first_camera[frame.index]))
            height, width = frame.rgb.shape[:2]
            scale = width / track.header["image_size_px"][0]
            camera = scaled_camera(track.camera_matrix, scale)
            if frame.index == 0:
                recording.log("camera/image", rr.Pinhole(image_from_camera=camera, width=width, height=height))
            recording.log("camera/image", rr.Image(frame.rgb).compress(jpeg_quality=80))
            for item in items:
                T = item.track.T_camera_object[frame.index]
                place = f"camera/{item.track.name}"
                recording.log(place, _transform(rr, T))
                confidence = float(item.track.confidence[frame.index])
                recording.log(f"confidence/{item.track.name}", rr.Scalars(confidence))
        recording.flush()
        recording.disconnect()


def _transform(rr: Any, T: Array) -> Any:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
