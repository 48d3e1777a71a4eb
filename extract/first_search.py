"""Silhouettes of a mesh, drawn small over many rotations, against a small mask: where the first pose is looked for.

One compiled loop over all rotations: each is placed so that it fills the box, drawn, and compared with the mask.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array

PLACINGS = 3  # corrections of distance and aim, after which the projection fills the box


@numba.njit(cache=True, error_model="numpy")
def search_rotations(
    vertices_m: Array, faces: NDArray[np.int32], radius_m: float, rotations: Array, camera_matrix: Array, box: Array,
    mask: NDArray[np.bool_], trust: NDArray[np.float32], centres_m: Array, ious: Array,
) -> None:  # fmt: skip
    """Where the mesh fills the box (x, y, width, height) with every rotation, and how well it agrees there.

    rotations: (N, 3, 3) R_camera_object.  centres_m: (N, 3), written: the object's origin in the camera's frame, from
    size and centre of the projection (FreePose, eq. 2).  ious: (N, 2), written: intersection over union with the mask
    (H, W), pixels counting by `trust` (H, W), and of the bounding box with the box.
    """
    fx, fy, cx, cy = camera_matrix[0, 0], camera_matrix[1, 1], camera_matrix[0, 2], camera_matrix[1, 2]
    target_x, target_y = box[0] + box[2] / 2, box[1] + box[3] / 2
    height, width = mask.shape
    points, pixels = np.empty_like(vertices_m), np.empty((len(vertices_m), 2))
    drawn = np.empty((height, width), np.bool_)
    in_mask = 0.0
    for y in range(height):
        for x in range(width):
            in_mask += trust[y, x] * mask[y, x]
    for n in range(len(rotations)):
        for i in range(len(vertices_m)):
            for row in range(3):
                points[i, row] = (
                    rotations[n, row, 0] * vertices_m[i, 0]
                    + rotations[n, row, 1] * vertices_m[i, 1]
                    + rotations[n, row, 2] * vertices_m[i, 2]
                )
        depth, aim_x, aim_y = 10.0 * radius_m, target_x, target_y
        for placing in range(PLACINGS + 1):
            tx, ty = (aim_x - cx) / fx * depth, (aim_y - cy) / fy * depth
            low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
            for i in range(len(points)):
                inverse = 1.0 / max(points[i, 2] + depth, 1e-6)
                u, v = fx * (points[i, 0] + tx) * inverse + cx, fy * (points[i, 1] + ty) * inverse + cy
                pixels[i, 0], pixels[i, 1] = u, v
                low_x, low_y, high_x, high_y = min(low_x, u), min(low_y, v), max(high_x, u), max(high_y, v)
            if placing == PLACINGS:
                break
            depth *= np.sqrt((high_x - low_x) * (high_y - low_y) / (box[2] * box[3]))
            depth = max(depth, 1.2 * radius_m)
            aim_x += target_x - (low_x + high_x) / 2
            aim_y += target_y - (low_y + high_y) / 2
        centres_m[n, 0], centres_m[n, 1], centres_m[n, 2] = tx, ty, depth
        drawn[:] = False
        for f in range(len(faces)):
            _fill(pixels, faces[f], drawn)
        shared, either = 0.0, in_mask
        left, top, right, bottom = width, height, -1, -1
        for y in range(height):
            for x in range(width):
                if drawn[y, x]:
                    left, top, right, bottom = min(left, x), min(top, y), max(right, x), max(bottom, y)
                    if mask[y, x]:
                        shared += trust[y, x]
                    else:
                        either += trust[y, x]
        ious[n, 0], ious[n, 1] = 0.0, 0.0
        if right >= 0:
            w = min(right + 1, box[0] + box[2]) - max(left, box[0])
            h = min(bottom + 1, box[1] + box[3]) - max(top, box[1])
            both = max(w, 0.0) * max(h, 0.0)
            ious[n, 0] = shared / max(either, 1.0)
            ious[n, 1] = both / ((right + 1 - left) * (bottom + 1 - top) + box[2] * box[3] - both)


@numba.njit(cache=True, error_model="numpy")
def _fill(pixels: Array, corners: NDArray[np.int32], drawn: NDArray[np.bool_]) -> None:
    """Set the pixels (H, W) whose centres lie in a triangle of `pixels` (V, 2)."""
    height, width = drawn.shape
    # From the highest corner to the lowest, so that one long side faces two short ones.
    a, b, c = corners[0], corners[1], corners[2]
    if pixels[b, 1] < pixels[a, 1]:
        a, b = b, a
    if pixels[c, 1] < pixels[b, 1]:
        b, c = c, b
    if pixels[b, 1] < pixels[a, 1]:
        a, b = b, a
    ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
    y_a, y_c = max(int(np.ceil(ay)), 0), min(int(np.floor(cy)), height - 1)
    if y_a > y_c or ay == cy:
        return
    long = (cx - ax) / (cy - ay)
    upper, lower = (bx - ax) / (by - ay), (cx - bx) / (cy - by)
    for y in range(y_a, y_c + 1):
        one = ax + (y - ay) * long
        other = ax + (y - ay) * upper if y < by else (cx + (y - cy) * lower if y > by else bx)
        for x in range(max(int(np.ceil(min(one, other))), 0), min(int(np.floor(max(one, other))), width - 1) + 1):
            drawn[y, x] = True
