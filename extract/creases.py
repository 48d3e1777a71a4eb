"""Inner contours of a mesh: where one part of it stands before another, and where its surface bends sharply.

They are drawn with the outline (region.py), but colours say nothing there: both sides are the object. Image edges do,
as in Harris and Stennett's RAPID (1990). An open vessel's rim and the edge of its base show how it leans toward the
camera, which its outline hardly does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, invert_pose, project, transform_points, unproject
from .raster import DepthWindow

JUMP = 0.08  # of the mesh's radius, in depth, that makes an inner contour
BEND = 0.5  # length of the difference of unit normals BEND_PX to either side that makes one: half a radian
BEND_PX = 2
CLEAR_PX = 4  # from the outline, whose edges would be taken for the crease's
MOST = 120  # points sampled
REACH = 3  # steps on either side of a crease that are looked at for an edge, and at least REACH_PX
REACH_PX = 4.0
EDGE_FLOOR, EDGE_WEIGHT = 0.1, 2.0  # a place on a clear edge is (1.1 / 0.1)^2 times likelier than one on none
LEAST_EDGE = 0.3  # of the strongest edge along a line, below which there is nothing to hold on to


@dataclass(frozen=True)
class Creases:
    """Points of inner contours (N, 3) and directions across them (N, 3) in the mesh's frame; which are jumps (N,)."""

    point_object_m: Array
    normal_object: Array
    jump: NDArray[np.bool_]

    def seen(self, T_camera_object: Array, camera_matrix: Array) -> tuple[Array, Array]:
        """Where a pose shows them, (N, 2) px, and which way across, unit (N, 2)."""
        normal = self.normal_object @ T_camera_object[:2, :3].T
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return project(camera_matrix, transform_points(T_camera_object, self.point_object_m)), normal

    def read(
        self,
        T_camera_object: Array,
        camera_matrix: Array,
        edges: NDArray[np.float32],
        step_px: float,
        told: NDArray[np.bool_],
    ) -> tuple[Array, Array, Array, Array]:
        """Points (N, 3), targets (N, 2), normals (N, 2) and variances (N,) in px of those that show as image edges.

        edges: (H, W, 2) from `edge_strength`.  told: (H, W) false where something hides what is there.
        """
        pixel, normal = self.seen(T_camera_object, camera_matrix)
        mean_px, variance = np.zeros(len(pixel)), np.zeros(len(pixel))
        _measure(pixel, normal, edges, told, step_px, mean_px, variance)
        kept = variance > 0
        target = pixel[kept] + mean_px[kept, None] * normal[kept]
        return self.point_object_m[kept], target, normal[kept], variance[kept]


def draw_creases(window: DepthWindow, radius_m: float, T_camera_object: Array, camera_matrix: Array) -> Creases | None:
    """The inner contours of a mesh of that radius, drawn at a pose; None when there are none."""
    at, normal, jump = crease_pixels(window.depth_m, camera_matrix, radius_m)
    if len(at) == 0:
        return None
    z = window.depth_m[at[:, 1], at[:, 0]].astype(float)
    pixel = at + np.array([window.x0_px, window.y0_px]) + 0.5 * normal
    points = transform_points(invert_pose(T_camera_object), unproject(camera_matrix, pixel, z))
    return Creases(points, normal @ T_camera_object[:2, :3], jump)


def crease_pixels(
    depth_m: NDArray[np.float32], camera_matrix: Array, radius_m: float
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of a depth image on inner contours, unit directions (N, 2) across, and which are jumps (N,)."""
    focal_px = float(camera_matrix[0, 0]), float(camera_matrix[1, 1])
    across, jumps = find_creases(depth_m, *focal_px, JUMP * radius_m, CLEAR_PX)
    ys, xs = np.nonzero((across[..., 0] != 0) | (across[..., 1] != 0))
    picked = np.linspace(0, len(xs) - 1, min(MOST, len(xs))).round().astype(int)
    xs, ys = xs[picked], ys[picked]
    return np.stack([xs, ys], axis=1), across[ys, xs].astype(float), jumps[ys, xs]


@numba.njit(cache=True, nogil=True)
def find_creases(
    depth: NDArray[np.float32], fx: float, fy: float, jump_m: float, clear_px: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(h, w, 2) unit direction across the inner contour at each pixel of a depth image in m, 0 where there is none.

    And (h, w) whether it is a jump in depth: other contours are bends of the surface.
    fx, fy: focal lengths in px.  clear_px: pixels so near the outline are left out.
    """
    h, w = depth.shape
    normal = np.zeros((h, w, 3), np.float32)
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            d = depth[y, x]
            west, east, north, south = depth[y, x - 1], depth[y, x + 1], depth[y - 1, x], depth[y + 1, x]
            if d == 0.0 or west == 0.0 or east == 0.0 or north == 0.0 or south == 0.0:
                continue
            dx, dy = 0.5 * (east - west), 0.5 * (south - north)
            if max(abs(east - d), abs(west - d), abs(south - d), abs(north - d)) > jump_m:
                continue
            # The normal of the surface z(x, y) seen from afar, where a pixel is z / f wide.
            nx, ny = -dx * fx / d, -dy * fy / d
            length = np.sqrt(nx * nx + ny * ny + 1.0)
            normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = nx / length, ny / length, 1.0 / length
    across = np.zeros((h, w, 2), np.float32)
    bend = np.zeros((h, w), np.float32)
    jumps = np.zeros((h, w), np.bool_)
    s = BEND_PX
    for y in range(clear_px + s, h - clear_px - s):
        for x in range(clear_px + s, w - clear_px - s):
            d = depth[y, x]
            if d == 0.0 or depth[y, x - clear_px] == 0.0 or depth[y, x + clear_px] == 0.0:
                continue
            if depth[y - clear_px, x] == 0.0 or depth[y + clear_px, x] == 0.0:
                continue
            east, west = depth[y, x + 1] - d, depth[y, x - 1] - d
            south, north = depth[y + 1, x] - d, depth[y - 1, x] - d
            if max(max(east, west), max(south, north)) > jump_m:
                gx, gy = east - west, south - north
                length = np.sqrt(gx * gx + gy * gy)
                if length > 0.0:
                    across[y, x, 0], across[y, x, 1] = gx / length, gy / length
                    jumps[y, x] = True
                continue
            xx, xy, yy, known = 0.0, 0.0, 0.0, True
            for c in range(3):
                a, b = normal[y, x + s, c] - normal[y, x - s, c], normal[y + s, x, c] - normal[y - s, x, c]
                xx += a * a
                xy += a * b
                yy += b * b
            for v, u in ((y, x + s), (y, x - s), (y + s, x), (y - s, x)):
                known = known and normal[v, u, 2] > 0.0
            if not known or xx + yy < BEND * BEND:
                continue
            half = 0.5 * (xx - yy)
            root = np.sqrt(half * half + xy * xy)
            if 0.5 * (xx + yy) + root < BEND * BEND:
                continue
            angle = 0.5 * np.arctan2(xy, half)
            across[y, x, 0], across[y, x, 1] = np.cos(angle), np.sin(angle)
            bend[y, x] = 0.5 * (xx + yy) + root
    # Bends are wider than a pixel: only where they are sharpest across themselves.
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            if bend[y, x] > 0.0:
                i, j = round(across[y, x, 0]), round(across[y, x, 1])
                if bend[y + j, x + i] > bend[y, x] or bend[y - j, x - i] >= bend[y, x]:
                    across[y, x] = 0.0
    return across, jumps


@numba.njit(cache=True, nogil=True)
def _measure(
    pixel: Array, normal: Array, edges: NDArray[np.float32], told: NDArray[np.bool_], step_px: float,
    mean_px: Array, variance: Array,
) -> None:  # fmt: skip
    """Posterior mean and variance (N,) in px of each crease along its line, by the image edges (H, W, 2) there.

    variance 0 marks a line without a clear edge, or where `told` (H, W) is false.
    """
    h, w = edges.shape[:2]
    count = int(max(REACH * step_px, REACH_PX))
    for i in range(pixel.shape[0]):
        variance[i] = 0.0
        if not told[min(max(round(pixel[i, 1]), 0), h - 1), min(max(round(pixel[i, 0]), 0), w - 1)]:
            continue
        weight, first, second, strongest = 0.0, 0.0, 0.0, 0.0
        for d in range(-count, count + 1):
            x = round(pixel[i, 0] + d * normal[i, 0])
            y = round(pixel[i, 1] + d * normal[i, 1])
            if x < 0 or y < 0 or x >= w or y >= h:
                continue
            along = min(abs(edges[y, x, 0] * normal[i, 0] + edges[y, x, 1] * normal[i, 1]), 1.0)
            strongest = max(strongest, along)
            p = (EDGE_FLOOR + along) ** EDGE_WEIGHT
            weight += p
            first += p * d
            second += p * d * d
        if strongest < LEAST_EDGE:
            continue
        mean = first / weight
        mean_px[i] = mean
        variance[i] = max(second / weight - mean * mean, 0.25 * step_px * step_px)
