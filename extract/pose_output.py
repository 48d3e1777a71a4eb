"""What `vid2demo pose` leaves: poses as BOP csv and JSON, the meshes in metres, and a picture to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image as Pictures

from .bop import ImageKey
from .bop_pose import mesh_word
from .bop_results import Estimate, write_results
from .files import atomic_path, write_json
from .geometry import Array, project, transform_points
from .image_pose import ImagePoser, ObjectPose
from .overlay import COLOURS
from .protocols import Image
from .raster import render_depth
from .stages import plain

FILES = ("poses.csv", "poses.json", "overlay.png")


def write_poses(
    out: Path,
    rgb: Image,
    camera_matrix: Array,
    poser: ImagePoser,
    poses: Sequence[ObjectPose],
    seconds: float,
    header: dict[str, Any],
) -> dict[str, Any]:
    """Write the files of FILES and one `NAME.ply` an object; returns what poses.json holds.

    The meshes are in metres, in a frame whose origin is the centre of their bounding box; `T_camera_object` places
    them. poses.csv is in BOP's units (t in mm), as scene 0, image 0.
    """
    entries = []
    for number, pose in enumerate(poses):
        about = pose.hit.about
        stored = poser.mesh(pose.hit.key).mesh.scaled(pose.size_m / 2)
        name = f"{number}_{about.name.replace(':', '_').replace('/', '_')}.ply"
        import trimesh

        solid = trimesh.Trimesh(stored.vertices, stored.faces, vertex_colors=stored.colors, process=False)
        with atomic_path(out / name) as temporary:
            solid.export(temporary)
        entries.append(
            {
                "name": about.name,
                "category": about.category,
                "mesh": name,
                "source": about.source,
                "score": round(pose.score, 4),
                "retrieval_score": round(pose.hit.score, 4),
                "size_m": round(pose.size_m, 4),
                "size_from": pose.size_source,
                "extents_m": np.round(stored.extents, 4),
                "box_xywh_px": pose.box_xywh_px,
                "T_camera_object": pose.T_camera_object,
                "others": [{"name": h.about.name, "score": round(h.score, 4)} for h in pose.others],
            }
        )
    estimates = [
        Estimate(ImageKey(0, 0), 0, p.score, p.T_camera_object, seconds, mesh_word(p.hit.about), p.size_m)
        for p in poses
    ]
    write_results(out / "poses.csv", estimates)
    with atomic_path(out / "overlay.png") as temporary:
        Pictures.fromarray(draw_poses(rgb, camera_matrix, poser, poses)).save(temporary)
    record = {**header, "camera_matrix": camera_matrix, "seconds": round(seconds, 3), "objects": entries}
    result: dict[str, Any] = plain(record)
    write_json(out / "poses.json", result)
    return result


def draw_poses(rgb: Image, camera_matrix: Array, poser: ImagePoser, poses: Sequence[ObjectPose]) -> Image:
    """The picture with the outline, axes and name of every object."""
    image = rgb.copy()
    height, width = image.shape[:2]
    for number, pose in enumerate(poses):
        colour = COLOURS[number % len(COLOURS)]
        mesh, T = poser.mesh(pose.hit.key).mesh.scaled(pose.size_m / 2), pose.T_camera_object
        window = render_depth(mesh.vertices, mesh.faces, T, camera_matrix)
        if window is not None:
            shape = window.mask_in_image(width, height)
            image[shape] = (0.65 * image[shape] + 0.35 * np.array(colour)).astype(np.uint8)
            lines, _ = cv2.findContours(shape.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, lines, -1, colour, 2, cv2.LINE_AA)
        tips = transform_points(T, 0.3 * pose.size_m * np.vstack([np.zeros(3), np.eye(3)]))
        if tips[:, 2].min() > 1e-3:
            ends = [tuple(int(v) for v in np.round(p)) for p in project(camera_matrix, tips)]
            for tip, shade in zip(ends[1:], ((235, 60, 60), (60, 200, 60), (70, 110, 255)), strict=True):
                cv2.arrowedLine(image, ends[0], tip, shade, 2, cv2.LINE_AA, tipLength=0.18)
        text = f"{pose.hit.about.category or pose.hit.about.name} {100 * pose.size_m:.0f} cm"
        at = (int(np.clip(pose.box_xywh_px[0], 2, width - 90)), int(np.clip(pose.box_xywh_px[1] - 5, 12, height - 4)))
        for shade, thickness in (((0, 0, 0), 3), (colour, 1)):
            cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, shade, thickness, cv2.LINE_AA)
    return image
