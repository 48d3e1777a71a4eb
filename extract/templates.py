"""Views of a mesh over SO(3), as FreePose renders them (appendix A.1), and square crops, the same for view and picture.

A normalised mesh has its largest half-extent equal to 1. A view shows it, scaled by `size_m`, at `distance_m` on the
axis of a camera of `side_px` pixels. Encoders see crops around the silhouette; they are drawn at their own size at once
instead of being cut from the large picture.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, make_pose, project, super_fibonacci_rotations, transform_points
from .protocols import Box, Image, Mask
from .shading import Picture, render_picture


@dataclass(frozen=True)
class ViewSettings:
    """How the views of a mesh are taken.

    count: rotations, spread over SO(3).  side_px, focal_px: of the square camera.  size_m: half of the mesh's largest
    extent before the camera.  distance_m: of its centre.  extend: what a crop adds on every side of the longer side
    of the box around the silhouette.
    """

    count: int = 600
    side_px: int = 420
    focal_px: float = 600.0
    size_m: float = 0.25
    distance_m: float = 1.1
    extend: float = 0.05

    @property
    def camera_matrix(self) -> Array:
        half = self.side_px / 2
        return np.array([[self.focal_px, 0.0, half], [0.0, self.focal_px, half], [0.0, 0.0, 1.0]])

    @cached_property
    def rotations(self) -> Array:
        """(count, 3, 3) R_camera_object of the views."""
        return super_fibonacci_rotations(self.count)

    def digest(self, encoder: str) -> str:
        """Hex name of everything that changes what is stored of a view: these settings and the encoder."""
        text = json.dumps({"views": asdict(self), "encoder": encoder, "version": 1}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class ColoredMesh:
    """Vertices (V, 3), faces (F, 3) int32 and vertex colours (V, 3) uint8; unit and frame as the holder says."""

    vertices: Array
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8]

    def scaled(self, factor: float) -> ColoredMesh:
        return ColoredMesh(self.vertices * factor, self.faces, self.colors)

    @property
    def extents(self) -> Array:
        """(3,) full sizes along the axes."""
        return np.asarray(np.ptp(self.vertices, axis=0))


@dataclass(frozen=True)
class View:
    """One view as an encoder sees it.

    rgb: (S, S, 3) crop.  mask: (S, S).  visible: (2,) full width and height of the visible surface, in the unit of the
    mesh, along the camera's axes (o_w, o_h of FreePose, equation 2).
    """

    rgb: Image
    mask: Mask
    visible: Array


def square_around(box_xywh_px: Box, extend: float) -> tuple[float, float, float]:
    """Left, top and side in px of the square crop about a box, letter-boxed: the box's longer side decides."""
    x, y, w, h = box_xywh_px
    side = max(w, h) * (1 + 2 * extend)
    return x + w / 2 - side / 2, y + h / 2 - side / 2, side


def crop_matrix(square: tuple[float, float, float], crop_px: int) -> Array:
    """(3, 3) map from pixels of a picture to pixels of the crop.

    Pixel centres lie at integers in both; a box counts whole pixels, so that its edges lie half a pixel off them.
    """
    left, top, side = square
    scale = crop_px / side
    return np.array([[scale, 0, (0.5 - left) * scale - 0.5], [0, scale, (0.5 - top) * scale - 0.5], [0.0, 0.0, 1.0]])


def turned_box(mask: Mask, turn_rad: float) -> tuple[Array, Box]:
    """A turn of the picture about the middle of a mask's box, (3, 3), and the box of the mask turned so."""
    rows, columns = np.nonzero(mask)
    pixels = np.column_stack([columns, rows, np.ones(len(rows))]).astype(np.float64)
    x, y = (pixels.min(axis=0) + pixels.max(axis=0))[:2] / 2
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0.0, 0.0, 1.0]])
    low, high = ((turned := pixels @ turn.T).min(axis=0), turned.max(axis=0))
    return turn, (float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1))


def crop_picture(
    rgb: Image,
    mask: Mask,
    box_xywh_px: Box,
    extend: float,
    crop_px: int,
    *,
    turn: Array | None = None,
    masked: bool = True,
) -> tuple[Image, Mask]:
    """Square crops (S, S, 3) and (S, S) of a picture and a mask; black beyond the picture and, if masked, the mask.

    turn: (3, 3) of the picture before it is cropped; the box is then one of the turned picture.
    """
    square = square_around(box_xywh_px, extend)
    shrink = max(1, round(square[2] / crop_px / 1.5))
    size = crop_px * shrink
    warp = (crop_matrix(square, size) @ (np.eye(3) if turn is None else turn))[:2]
    shown = np.where(mask[..., None], rgb, 0).astype(np.uint8) if masked else rgb
    picture = cv2.warpAffine(shown, warp, (size, size), flags=cv2.INTER_LINEAR)
    share = cv2.warpAffine(mask.astype(np.uint8) * 255, warp, (size, size), flags=cv2.INTER_LINEAR)
    if shrink > 1:  # drawn larger and averaged: no pixel of the picture is passed over
        picture = cv2.resize(picture, (crop_px, crop_px), interpolation=cv2.INTER_AREA)
        share = cv2.resize(share, (crop_px, crop_px), interpolation=cv2.INTER_AREA)
    return np.asarray(picture, np.uint8), np.asarray(share > 127)


def box_of_points(pixels: Array) -> Box:
    """The box that the silhouette of projected points (N, 2) has."""
    low, high = pixels.min(axis=0) + 0.5, pixels.max(axis=0) + 0.5
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def view_crop(mesh: ColoredMesh, T_camera_object: Array, camera_matrix: Array, extend: float, crop_px: int) -> View:
    """The crop about a posed mesh, drawn at the encoder's size."""
    points = transform_points(T_camera_object, mesh.vertices)
    square = square_around(box_of_points(project(camera_matrix, points)), extend)
    crop_camera = crop_matrix(square, crop_px) @ camera_matrix
    picture = render_picture(mesh.vertices, mesh.faces, mesh.colors, T_camera_object, crop_camera, (crop_px, crop_px))
    return View(picture.rgb, picture.mask, visible_extents(picture, crop_camera))


def template_pose(settings: ViewSettings, index: int) -> Array:
    """(4, 4) T_camera_object of view `index`, for a mesh scaled to `size_m`."""
    return make_pose(settings.rotations[index], (0.0, 0.0, settings.distance_m))


def template_view(normalised: ColoredMesh, settings: ViewSettings, index: int, crop_px: int) -> View:
    """View `index` of a normalised mesh; `visible` is in units of its largest half-extent."""
    mesh = normalised.scaled(settings.size_m)
    view = view_crop(mesh, template_pose(settings, index), settings.camera_matrix, settings.extend, crop_px)
    return View(view.rgb, view.mask, view.visible / settings.size_m)


def template_picture(normalised: ColoredMesh, settings: ViewSettings, index: int) -> Picture:
    """View `index` as the whole picture of the paper, 420 x 420 by default."""
    mesh, size = normalised.scaled(settings.size_m), (settings.side_px, settings.side_px)
    pose = template_pose(settings, index)
    return render_picture(mesh.vertices, mesh.faces, mesh.colors, pose, settings.camera_matrix, size)


def visible_extents(picture: Picture, camera_matrix: Array) -> Array:
    """(2,) width and height of the points that a depth picture shows, along the camera's axes."""
    rows, columns = np.nonzero(picture.depth_m)
    if not len(rows):
        return np.zeros(2)
    z = picture.depth_m[rows, columns].astype(np.float64)
    x = (columns - camera_matrix[0, 2]) / camera_matrix[0, 0] * z
    y = (rows - camera_matrix[1, 2]) / camera_matrix[1, 1] * z
    return np.array([np.ptp(x), np.ptp(y)])
