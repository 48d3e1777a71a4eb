"""Depth images of a mesh on the CPU, in about a millisecond: the only renderer the tracker needs.

MuJoCo draws pretty pictures; this draws silhouettes. Depth is linear in the camera's z, pixel centres lie at integer
coordinates, and the window may reach beyond the image so that an object half out of view keeps its true outline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array

NEAREST_M = 1e-3  # that a vertex may be before the camera
FAR_M = np.float32(1e30)  # of pixels where nothing was drawn yet
WAITING = 2048  # rows of triangles that are listed before they are drawn
LEAST_SLOPE = 1e-12  # of a barycentric weight along a row: what changes less does not change


@dataclass(frozen=True)
class DepthWindow:
    """Depth of a mesh in a window of the (unbounded) image plane.

    depth_m: (h, w) float32, 0 where nothing was hit.  x0_px, y0_px: image coordinates of pixel (0, 0).
    """

    depth_m: NDArray[np.float32]
    x0_px: int
    y0_px: int

    @property
    def mask(self) -> NDArray[np.bool_]:
        return np.asarray(self.depth_m > 0)

    def mask_in_image(self, width_px: int, height_px: int) -> NDArray[np.bool_]:
        """The silhouette cut to the image, (height, width) bool."""
        return np.asarray(self.depth_in_image(width_px, height_px) > 0)

    def depth_in_image(self, width_px: int, height_px: int) -> NDArray[np.float32]:
        """The depth in m cut to the image, (height, width) float32, 0 where nothing was hit."""
        full = np.zeros((height_px, width_px), np.float32)
        inner, place = self._cut(width_px, height_px)
        full[place] = self.depth_m[inner]
        return full

    def part_in_image(self, width_px: int, height_px: int) -> tuple[NDArray[np.bool_], tuple[slice, slice]]:
        """The silhouette in the part of the image that the window covers, and that part's rows and columns."""
        inner, place = self._cut(width_px, height_px)
        return np.asarray(self.depth_m[inner] > 0), place

    def only(self, mask: NDArray[np.bool_]) -> DepthWindow:
        """The same with nothing hit where a mask (H, W) of the image is false."""
        depth = self.depth_m.copy()
        inner, place = self._cut(mask.shape[1], mask.shape[0])
        depth[inner][~mask[place]] = 0.0
        return replace(self, depth_m=depth)

    def _cut(self, width_px: int, height_px: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Rows and columns that window and image share, in the window and in the image; empty if they share none."""
        h, w = self.depth_m.shape
        x_a, y_a = max(self.x0_px, 0), max(self.y0_px, 0)
        x_b, y_b = max(min(self.x0_px + w, width_px), x_a), max(min(self.y0_px + h, height_px), y_a)
        inner = slice(y_a - self.y0_px, y_b - self.y0_px), slice(x_a - self.x0_px, x_b - self.x0_px)
        return inner, (slice(y_a, y_b), slice(x_a, x_b))


def render_depth(
    vertices_m: Array,
    faces: NDArray[np.int32],
    T_camera_object: Array,
    camera_matrix: Array,
    *,
    margin_px: int = 2,
    max_side_px: int = 2000,
    closed: bool = False,
) -> DepthWindow | None:
    """Depth of a triangle mesh seen by a pinhole camera; None when it is behind the camera or absurdly large.

    vertices_m: (V, 3) in the object frame.  faces: (F, 3).  The window fits the projection plus `margin_px`.
    closed: the faces are known to be closed surfaces, counter-clockwise seen from outside, so that those that look
    away need not be drawn.
    """
    pixels, inverse = np.empty((len(vertices_m), 2)), np.empty(len(vertices_m))
    left, top, right, bottom = _place(vertices_m, T_camera_object, camera_matrix, pixels, inverse)
    if left > right:
        return None
    x0_px, y0_px = math.floor(left) - margin_px, math.floor(top) - margin_px
    width, height = math.ceil(right) + margin_px + 1 - x0_px, math.ceil(bottom) + margin_px + 1 - y0_px
    if max(width, height) > max_side_px:
        return None
    depth = np.empty((height, width), np.float32)
    _fill(pixels, inverse, x0_px, y0_px, faces, closed, depth)
    return DepthWindow(depth, x0_px, y0_px)


@numba.njit(cache=True, nogil=True)
def _place(
    vertices_m: Array, T: Array, camera_matrix: Array, pixels: Array, inverse: Array
) -> tuple[float, float, float, float]:
    """Where a pose shows vertices, into (V, 2), and one over their depths, into (V,).

    Returns left, top, right and bottom end of that; right before left when one is not before the camera.
    """
    fx, fy, cx, cy = camera_matrix[0, 0], camera_matrix[1, 1], camera_matrix[0, 2], camera_matrix[1, 2]
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for i in range(vertices_m.shape[0]):
        a, b, c = vertices_m[i, 0], vertices_m[i, 1], vertices_m[i, 2]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if z < NEAREST_M:
            return 0.0, 0.0, -1.0, -1.0
        u = (fx * (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]) + cx * z) / z
        v = (fy * (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]) + cy * z) / z
        pixels[i, 0], pixels[i, 1], inverse[i] = u, v, 1.0 / z
        left, top, right, bottom = min(left, u), min(top, v), max(right, u), max(bottom, v)
    return left, top, right, bottom


@numba.njit(cache=True, nogil=True, fastmath=True)
def _fill(
    pixels: Array, inverse: Array, x0: int, y0: int, faces: NDArray[np.int32], closed: bool, depth: NDArray[np.float32]
) -> None:
    """Z-buffer with 1/z interpolated linearly on the image plane, which is exact for planes in perspective.

    pixels (V, 2), inverse (V,): from `_place`.  x0, y0: where the window `depth` begins.

    Triangles are small: rows of them are listed first and drawn later, because a processor that waits for every row's
    ends before it knows how many pixels to draw spends most of its time waiting.
    """
    h, w = depth.shape
    depth[:] = FAR_M
    flat = depth.reshape(h * w)
    place, count = np.empty(WAITING + h, np.int64), np.empty(WAITING + h, np.int64)
    begin, along = np.empty(WAITING + h), np.empty(WAITING + h)
    rows = 0
    for f in range(faces.shape[0]):
        if rows > WAITING:
            _draw_rows(place[:rows], count, begin, along, flat)
            rows = 0
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx = pixels[a, 0] - x0, pixels[a, 1] - y0, pixels[b, 0] - x0
        by, cx, cy = pixels[b, 1] - y0, pixels[c, 0] - x0, pixels[c, 1] - y0
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        x_a = max(int(np.ceil(min(ax, bx, cx))), 0)
        x_b = min(int(np.floor(max(ax, bx, cx))), w - 1)
        y_a = max(int(np.ceil(min(ay, by, cy))), 0)
        y_b = min(int(np.floor(max(ay, by, cy))), h - 1)
        if (x_a > x_b) | (y_a > y_b) | (abs(area) < 1e-12) | (closed & (area > 0.0)):
            continue
        # Barycentric weights of a, b and c change by these from pixel to pixel, and 1/z by the last.
        scale = 1.0 / area
        slope_u, slope_v = (by - cy) * scale, (cy - ay) * scale
        slope_s = -slope_u - slope_v
        rise_a, rise_b = inverse[a] - inverse[c], inverse[b] - inverse[c]
        slope = slope_u * rise_a + slope_v * rise_b
        slope_u = slope_u if abs(slope_u) > LEAST_SLOPE else LEAST_SLOPE
        slope_v = slope_v if abs(slope_v) > LEAST_SLOPE else LEAST_SLOPE
        slope_s = slope_s if abs(slope_s) > LEAST_SLOPE else LEAST_SLOPE
        per_u, per_v, per_s = 1.0 / slope_u, 1.0 / slope_v, 1.0 / slope_s
        longest = float(x_b - x_a)
        for y in range(y_a, y_b + 1):
            u = ((bx - x_a) * (cy - y) - (by - y) * (cx - x_a)) * scale
            v = ((cx - x_a) * (ay - y) - (cy - y) * (ax - x_a)) * scale
            # Where the weights pass zero: those that rise begin the row, those that fall end it.
            at_u, at_v, at_s = (-1e-9 - u) * per_u, (-1e-9 - v) * per_v, (u + v - 1.0 - 1e-9) * per_s
            first = max(at_u if slope_u > 0.0 else 0.0, at_v if slope_v > 0.0 else 0.0)
            first = np.ceil(max(first, at_s if slope_s > 0.0 else 0.0, 0.0))
            last = min(at_u if slope_u < 0.0 else longest, at_v if slope_v < 0.0 else longest)
            last = np.floor(min(last, at_s if slope_s < 0.0 else longest, longest))
            place[rows] = y * w + x_a + int(first)
            count[rows] = int(last - first) + 1
            begin[rows] = inverse[c] + u * rise_a + v * rise_b + first * slope
            along[rows] = slope
            rows += last >= first
    _draw_rows(place[:rows], count, begin, along, flat)
    for i in range(h * w):
        if flat[i] == FAR_M:
            flat[i] = 0.0


@numba.njit(cache=True, nogil=True, fastmath=True)
def _draw_rows(
    place: NDArray[np.int64], count: NDArray[np.int64], begin: Array, along: Array, pixels: NDArray[np.float32]
) -> None:
    """Draw rows of `count` pixels (N,) from `place` in flat `pixels` on; 1/z begins with `begin`, changes `along`."""
    for k in range(place.shape[0]):
        for i in range(count[k]):
            at = place[k] + i
            pixels[at] = min(pixels[at], np.float32(1.0 / (begin[k] + i * along[k])))
