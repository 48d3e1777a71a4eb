"""Plain pictures of a mesh on the CPU, in a few milliseconds: vertex colours under a lamp at the camera.

They are what a stored view shows an encoder. For pictures of whole scenes, with shadows, MuJoCo draws.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, project, transform_points

AMBIENT = 0.45  # share of a colour that is seen edge-on; the rest goes with the cosine to the viewing ray


@dataclass(frozen=True)
class Picture:
    """What a pinhole camera sees of one mesh: rgb (H, W, 3) uint8, black around it; depth_m (H, W) float32, 0 there.

    Depth is in the unit of the vertices.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]

    @property
    def mask(self) -> NDArray[np.bool_]:
        return np.asarray(self.depth_m > 0)


def render_picture(
    vertices_m: Array,
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    T_camera_object: Array,
    camera_matrix: Array,
    size_px: tuple[int, int],
) -> Picture:
    """Draw a mesh (V, 3), (F, 3) with vertex colours (V, 3) into a picture of (width, height).

    Both sides of a face show. Empty when any part of the mesh lies behind the camera.
    """
    points = transform_points(T_camera_object, vertices_m)
    rgb = np.zeros((size_px[1], size_px[0], 3), np.uint8)
    depth = np.zeros((size_px[1], size_px[0]), np.float32)
    if points[:, 2].min() > 1e-4:
        _draw(points, project(camera_matrix, points), faces, colors, AMBIENT, rgb, depth)
    return Picture(rgb, depth)


@numba.njit(cache=True, fastmath=True)
def _draw(
    points: Array,
    uv: Array,
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    ambient: float,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
) -> None:
    """Z-buffer with 1/z linear on the image plane; only what is seen in the end is coloured."""
    h, w = depth.shape
    owner = np.full((h, w), -1, np.int32)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by, cx, cy = uv[a, 0], uv[a, 1], uv[b, 0], uv[b, 1], uv[c, 0], uv[c, 1]
        x_a, x_b = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(np.floor(max(ax, bx, cx))), w - 1)
        y_a, y_b = max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), h - 1)
        if x_a > x_b or y_a > y_b:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-12:
            continue
        ia, ib, ic, inverse = 1.0 / points[a, 2], 1.0 / points[b, 2], 1.0 / points[c, 2], 1.0 / area
        du, dv = (by - cy) * inverse, (cy - ay) * inverse
        for y in range(y_a, y_b + 1):
            u0 = ((bx - x_a) * (cy - y) - (by - y) * (cx - x_a)) * inverse
            v0 = ((cx - x_a) * (ay - y) - (cy - y) * (ax - x_a)) * inverse
            for x in range(x_a, x_b + 1):
                u, v = u0 + du * (x - x_a), v0 + dv * (x - x_a)
                s = 1.0 - u - v
                if u >= -1e-9 and v >= -1e-9 and s >= -1e-9:
                    near = np.float32(u * ia + v * ib + s * ic)
                    if near > depth[y, x]:
                        depth[y, x] = near
                        owner[y, x] = f
    for y in range(h):
        for x in range(w):
            f = owner[y, x]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, bx, by, cx, cy = uv[a, 0], uv[a, 1], uv[b, 0], uv[b, 1], uv[c, 0], uv[c, 1]
            inverse = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
            u = max(((bx - x) * (cy - y) - (by - y) * (cx - x)) * inverse, 0.0)
            v = max(((cx - x) * (ay - y) - (cy - y) * (ax - x)) * inverse, 0.0)
            s = max(1.0 - u - v, 0.0)
            d = 1.0 / depth[y, x]
            px, py, pz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            qx, qy, qz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
            nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
            toward = abs(nx * points[a, 0] + ny * points[a, 1] + nz * points[a, 2])
            r = points[a, 0] ** 2 + points[a, 1] ** 2 + points[a, 2] ** 2
            shade = ambient + (1.0 - ambient) * toward / max(np.sqrt((nx * nx + ny * ny + nz * nz) * r), 1e-30)
            for k in range(3):
                value = shade * (u * colors[a, k] + v * colors[b, k] + s * colors[c, k])
                rgb[y, x, k] = np.uint8(min(value, 255.0))
            depth[y, x] = d
