"""The walls that `FastLiquid` meets: boxes as rows of numbers, and grids that tell which of them are near."""

from __future__ import annotations

import math

import numpy as np

from ..extract.geometry import Array
from .fast_liquid_kernels import Ints, Walls, compiled, nearest
from .vessel_geometry import Box

# How far a particle may move against a vessel in a step and still find its walls in the grid, and the grid's cells.
REACH_M, CELL_M = 0.003, 0.004


def walls_of(groups: list[list[Box]], radius_m: float) -> Walls:
    """The shapes of all groups as the kernels take them, and the grids in which they are looked up.

    Shapes (B, 16); for each group (G, 6) its first shape, the one after its last, where its cells begin in `starts`
    and how many cells it has along each axis; for each group (G, 5) its grid's corner, cell size and reach, all in m;
    `starts` into `items`, the numbers of the shapes near a cell. What stands still, the last group, is few and wide:
    it has no grid, its reach is 0.
    """
    reach_m = radius_m + REACH_M
    shapes = np.array(
        [[*box.center_m, *box.R.ravel(), *box.half_m, float(box.round)] for boxes in groups for box in boxes]
    )
    ends = np.cumsum([len(boxes) for boxes in groups])
    ranges, grids = np.zeros((len(groups), 6), np.int32), np.zeros((len(groups), 5))
    starts: list[Ints] = []
    items: list[Ints] = []
    for g, boxes in enumerate(groups):
        first = ends[g] - len(boxes)
        ranges[g, :2] = first, ends[g]
        if g == len(groups) - 1:
            continue
        spans = np.array([np.linalg.norm(box.half_m) for box in boxes])[:, None] + reach_m
        centers = np.array([box.center_m for box in boxes])
        low, high = (centers - spans).min(axis=0), (centers + spans).max(axis=0)
        size = np.ceil((high - low) / CELL_M).astype(np.int32)
        begin, found = _shapes_by_cell(shapes[first : ends[g]], low, CELL_M, size, reach_m)
        ranges[g, 2], ranges[g, 3:] = sum(map(len, starts)), size
        grids[g] = [*low, CELL_M, REACH_M]
        starts.append(begin + sum(map(len, items)))
        items.append(found + first)
    return shapes, ranges, grids, np.concatenate(starts).astype(np.int32), np.concatenate(items).astype(np.int32)


@compiled
def _shapes_by_cell(shapes: Array, low: Array, cell_m: float, size: Ints, reach_m: float) -> tuple[Ints, Ints]:
    """For each cell of a grid the shapes that come within `reach_m` of it: starts (cells + 1,) into items."""
    starts = np.zeros(size[0] * size[1] * size[2] + 1, np.int32)
    items = np.zeros(0, np.int32)
    far = reach_m + 0.5 * math.sqrt(3.0) * cell_m
    for filling in (False, True):
        if filling:
            for cell in range(len(starts) - 1):
                starts[cell + 1] += starts[cell]
            items = np.zeros(starts[-1], np.int32)
            taken = starts.copy()
        for number in range(len(shapes)):
            first, last = np.zeros(3, np.int32), np.zeros(3, np.int32)
            for axis in range(3):
                row = shapes[number, 3 + 3 * axis : 6 + 3 * axis]
                # A cylinder's second half extent is unused; its first bounds it along both.
                second = shapes[number, 12] if shapes[number, 15] > 0.0 else shapes[number, 13]
                half = (
                    abs(row[0]) * shapes[number, 12] + abs(row[1]) * second + abs(row[2]) * shapes[number, 14] + reach_m
                )
                first[axis] = max(0, math.floor((shapes[number, axis] - half - low[axis]) / cell_m))
                last[axis] = min(size[axis] - 1, math.floor((shapes[number, axis] + half - low[axis]) / cell_m))
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for k in range(first[2], last[2] + 1):
                        x, y, z = low[0] + (i + 0.5) * cell_m, low[1] + (j + 0.5) * cell_m, low[2] + (k + 0.5) * cell_m
                        if nearest(shapes, number, x, y, z)[0] > far:
                            continue
                        cell = (i * size[1] + j) * size[2] + k
                        if filling:
                            items[taken[cell]] = number
                            taken[cell] += 1
                        else:
                            starts[cell + 1] += 1
    return starts, items
