"""Rays through a triangle mesh, compiled to machine code: straight down on a grid, and outward from a vertical axis.

Meshes found in the wild are neither closed nor consistently turned, so nothing here asks which side is inside: every
kernel lists all crossings in order and leaves their meaning to the caller.
"""

from __future__ import annotations

import heapq
import math

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array


@numba.njit(cache=True)
def column_hits(
    vertices: Array, faces: NDArray[np.int64], low: Array, cell_m: float, nx: int, ny: int, most: int
) -> Array:
    """(nx, ny, most) heights at which the vertical through each cell's middle crosses the mesh, highest first.

    low: (2,) corner of the grid; cell_m: its pitch. Unused places hold -inf; where there are more crossings than
    `most`, the lowest are left out.
    """
    hits = np.full((nx, ny, most), -np.inf)
    for f in range(faces.shape[0]):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ax, ay, bx, by, cx, cy = a[0], a[1], b[0], b[1], c[0], c[1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-14:
            continue
        i0 = max(0, math.ceil((min(ax, bx, cx) - low[0]) / cell_m - 0.5))
        i1 = min(nx - 1, math.floor((max(ax, bx, cx) - low[0]) / cell_m - 0.5))
        j0 = max(0, math.ceil((min(ay, by, cy) - low[1]) / cell_m - 0.5))
        j1 = min(ny - 1, math.floor((max(ay, by, cy) - low[1]) / cell_m - 0.5))
        for i in range(i0, i1 + 1):
            x = low[0] + (i + 0.5) * cell_m
            for j in range(j0, j1 + 1):
                y = low[1] + (j + 0.5) * cell_m
                u = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                v = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                # Edges count for both neighbours: a gap would look like a hole, a doubled hit harms nothing.
                if u < -1e-9 or v < -1e-9 or u + v > 1.0 + 1e-9:
                    continue
                z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
                _insert_descending(hits[i, j], z)
    return hits


@numba.njit(cache=True)
def raise_to_edges(top_m: Array, vertices: Array, faces: NDArray[np.int64], low: Array, cell_m: float) -> None:
    """Raise a height map (nx, ny) in place to the mesh's edges: walls of one surface have no width to be hit on."""
    nx, ny = top_m.shape
    for f in range(faces.shape[0]):
        for e in range(3):
            a, b = vertices[faces[f, e]], vertices[faces[f, (e + 1) % 3]]
            steps = 1 + int(2.0 * max(abs(b[0] - a[0]), abs(b[1] - a[1])) / cell_m)
            for k in range(steps + 1):
                t = k / steps
                i = math.floor((a[0] + t * (b[0] - a[0]) - low[0]) / cell_m)
                j = math.floor((a[1] + t * (b[1] - a[1]) - low[1]) / cell_m)
                if 0 <= i < nx and 0 <= j < ny:
                    top_m[i, j] = max(top_m[i, j], a[2] + t * (b[2] - a[2]))


@numba.njit(cache=True)
def _insert_descending(row: Array, value: float) -> None:
    for k in range(row.shape[0]):
        if abs(row[k] - value) < 1e-7:
            return
        if row[k] < value:
            for m in range(row.shape[0] - 1, k, -1):
                row[m] = row[m - 1]
            row[k] = value
            return


@numba.njit(cache=True)
def radial_hits(vertices: Array, faces: NDArray[np.int64], axis_xy: Array, z_m: Array, count: int, most: int) -> Array:
    """(L, count, most) distances from a vertical axis at which horizontal rays cross the mesh, nearest first.

    z_m: (L,) ascending heights; ray k points at the angle 2 pi (k + 1/2) / count. Unused places hold inf.
    """
    levels = z_m.shape[0]
    hits = np.full((levels, count, most), np.inf)
    step = 2.0 * math.pi / count
    p = np.empty((2, 2))
    for f in range(faces.shape[0]):
        lowest = min(vertices[faces[f, 0], 2], vertices[faces[f, 1], 2], vertices[faces[f, 2], 2])
        highest = max(vertices[faces[f, 0], 2], vertices[faces[f, 1], 2], vertices[faces[f, 2], 2])
        first = np.searchsorted(z_m, lowest)
        for level in range(first, levels):
            z = z_m[level]
            if z >= highest:
                break
            found = 0
            for e in range(3):
                a, b = vertices[faces[f, e]], vertices[faces[f, (e + 1) % 3]]
                # Half-open, so that a vertex exactly at this height belongs to one side.
                if (a[2] <= z) != (b[2] <= z) and found < 2:
                    t = (z - a[2]) / (b[2] - a[2])
                    p[found, 0] = a[0] + t * (b[0] - a[0]) - axis_xy[0]
                    p[found, 1] = a[1] + t * (b[1] - a[1]) - axis_xy[1]
                    found += 1
            if found < 2:
                continue
            start = math.atan2(p[0, 1], p[0, 0])
            sweep = math.atan2(p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0], p[0, 0] * p[1, 0] + p[0, 1] * p[1, 1])
            begin, end = (start, start + sweep) if sweep > 0 else (start + sweep, start)
            for k in range(math.ceil(begin / step - 0.5), math.floor(end / step - 0.5) + 1):
                angle = (k + 0.5) * step
                dx, dy = math.cos(angle), math.sin(angle)
                ex, ey = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1]
                denominator = dx * ey - dy * ex
                if abs(denominator) < 1e-15:
                    continue
                r = (p[0, 0] * ey - p[0, 1] * ex) / denominator
                if r <= 0.0:
                    continue
                row = hits[level, k % count]
                for m in range(most):
                    if abs(row[m] - r) < 1e-7:
                        break
                    if r < row[m]:
                        for n in range(most - 1, m, -1):
                            row[n] = row[n - 1]
                        row[m] = r
                        break
    return hits


def first_hit_m(vertices: Array, faces: NDArray[np.int64], origin: Array, direction: Array) -> float:
    """Distance along one ray (unit direction) to the mesh, from whichever side; inf when it is missed."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    p = np.cross(direction, ac)
    det = np.einsum("ij,ij->i", ab, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - a
        u = np.einsum("ij,ij->i", offset, p) / det
        q = np.cross(offset, ab)
        v = q @ direction / det
        t = np.einsum("ij,ij->i", ac, q) / det
        hit = (np.abs(det) > 1e-16) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return float(t[hit].min()) if hit.any() else math.inf


@numba.njit(cache=True)
def flooded(height_m: Array) -> Array:
    """(nx, ny) surface that rain leaves standing on a height map: every pit filled to where it spills.

    Cells of -inf are drains and stay; so does the border, from which everything runs off.
    """
    nx, ny = height_m.shape
    level = np.full((nx, ny), np.inf)
    queue = [(0.0, 0, 0)]
    queue.pop()
    for i in range(nx):
        for j in range(ny):
            if i == 0 or j == 0 or i == nx - 1 or j == ny - 1 or height_m[i, j] == -np.inf:
                level[i, j] = height_m[i, j]
                heapq.heappush(queue, (height_m[i, j], i, j))
    while len(queue) > 0:
        here, i, j = heapq.heappop(queue)
        if here > level[i, j]:
            continue
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            u, v = i + di, j + dj
            if 0 <= u < nx and 0 <= v < ny:
                filled = max(here, height_m[u, v])
                if filled < level[u, v]:
                    level[u, v] = filled
                    heapq.heappush(queue, (filled, u, v))
    return level
