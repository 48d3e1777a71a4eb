"""Silhouettes of a mesh, drawn small over many rotations, against a small mask: where the first pose is looked for."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array
from .segment import Box, Mask

PLACINGS = 3  # corrections of distance and aim, after which the projection fills the box
AT_ONCE = 32  # rotations whose points stay in the processor's cache


def place_in_box(vertices_m: Array, rotations: Array, camera_matrix: Array, box_xywh_px: Box) -> Array:
    """(N, 3) origins in the camera's frame, in m, of a mesh that fills a box with each of the rotations (N, 3, 3).

    From size and centre of its projection (FreePose, eq. 2).
    """
    x, y, w, h = box_xywh_px
    target, inverse = np.array([x + w / 2, y + h / 2]), np.linalg.inv(camera_matrix)
    radius_m = float(np.linalg.norm(vertices_m, axis=1).max())

    def seen_at(aim: Array, depth: Array) -> Array:
        return (inverse @ np.column_stack([aim, np.ones(len(aim))])[..., None])[..., 0] * depth[:, None]

    origins_m = []
    for begin in range(0, len(rotations), AT_ONCE):
        turned = rotations[begin : begin + AT_ONCE] @ vertices_m.T
        depth, aim = np.full(len(turned), 10.0 * radius_m), np.tile(target, (len(turned), 1))
        for _ in range(PLACINGS):
            points = turned + seen_at(aim, depth)[..., None]
            pixels = (camera_matrix @ points)[:, :2] / np.maximum(points[:, 2:], 1e-6)
            low, high = pixels.min(axis=2), pixels.max(axis=2)
            depth = np.maximum(depth * np.sqrt(np.prod(high - low, axis=1) / (w * h)), 1.2 * radius_m)
            aim += target - (low + high) / 2
        origins_m.append(seen_at(aim, depth))
    return np.concatenate(origins_m)


def silhouettes_agree(
    vertices_m: Array, faces: NDArray[np.int32], rotations: Array, origins_m: Array, camera_matrix: Array, mask: Mask,
    trust: NDArray[np.float32], box_xywh_px: Box,
) -> Array:  # fmt: skip
    """(N, 2) how well a mesh agrees with a mask and a box at each of the poses, as `first_pose.silhouette_ious` says.

    rotations: (N, 3, 3).  origins_m: (N, 3).  mask, trust: (H, W).
    """
    ious = np.zeros((len(rotations), 2))
    _compare(vertices_m, faces, rotations, origins_m, camera_matrix, mask, trust, np.array(box_xywh_px, float), ious)
    return ious


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    vertices_m: Array, faces: NDArray[np.int32], rotations: Array, origins_m: Array, camera_matrix: Array, mask: Mask,
    trust: NDArray[np.float32], box: Array, ious: Array,
) -> None:  # fmt: skip
    fx, fy, cx, cy = camera_matrix[0, 0], camera_matrix[1, 1], camera_matrix[0, 2], camera_matrix[1, 2]
    height, width = mask.shape
    pixels, drawn = np.empty((len(vertices_m), 2)), np.empty((height, width), np.bool_)
    in_mask = 0.0
    for y in range(height):
        for x in range(width):
            in_mask += trust[y, x] * mask[y, x]
    for n in range(len(rotations)):
        R, t = rotations[n], origins_m[n]
        for i in range(len(vertices_m)):
            a, b, c = vertices_m[i, 0], vertices_m[i, 1], vertices_m[i, 2]
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            pixels[i, 0] = fx * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]) / z + cx
            pixels[i, 1] = fy * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]) / z + cy
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
        if right < 0:
            continue
        w = min(right + 1, box[0] + box[2]) - max(left, box[0])
        h = min(bottom + 1, box[1] + box[3]) - max(top, box[1])
        both = max(w, 0.0) * max(h, 0.0)
        ious[n, 0] = shared / max(either, 1.0)
        ious[n, 1] = both / ((right + 1 - left) * (bottom + 1 - top) + box[2] * box[3] - both)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
