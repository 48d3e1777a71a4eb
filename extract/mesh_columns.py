"""Vertical rays through a mesh: where rain would stand in it, which way is up, what it stands on.

Works on vertices (V, 3) in m and faces (F, 3) of any mesh, watertight or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .errors import UserError
from .geometry import Array
from .mesh_rays import column_hits, flooded, raise_to_edges

Faces = NDArray[np.int64]

UPS: dict[str, tuple[int, int, int]] = {
    "+z": (0, 0, 1), "+y": (0, 1, 0), "-z": (0, 0, -1), "-y": (0, -1, 0), "+x": (1, 0, 0), "-x": (-1, 0, 0),
}  # fmt: skip
MOST_HITS, GRID = 8, 140
# A pit counts as the mouth of a vessel when it is so deep, as a share of the height, so large, and takes up so much of
# the bounding box; a column of air over a bottle's neck takes up 5% of it.
MIN_DEPTH, MIN_DEPTH_M, MIN_MOUTH_M2, MIN_SHARE = 0.28, 0.01, 8e-5, 0.015


@dataclass(frozen=True)
class Pit:
    """What rain would leave standing: volume, depth, area and height of its surface, middle of its deep part (2,)."""

    volume_m3: float
    depth_m: float
    area_m2: float
    spill_m: float
    center_xy_m: Array


def rotation_to_up(up: str) -> Array:
    """(3, 3) rotation that turns the file's axis `up` to +z and keeps as many other axes in place as it can."""
    z = np.array(UPS[up], float)
    x = np.array([1.0, 0.0, 0.0]) if z[0] == 0 else np.array([0.0, 1.0, 0.0])
    return np.stack([x, np.cross(z, x), z])


class Columns:
    """Vertical rays through a mesh on a square grid: all heights hit, highest first."""

    def __init__(self, vertices: Array, faces: Faces) -> None:
        self.cell_m = float(np.ptp(vertices, axis=0).max()) / GRID
        self.low = vertices[:, :2].min(axis=0) - 2 * self.cell_m
        nx, ny = (int(n) for n in np.ceil((vertices[:, :2].max(axis=0) - self.low) / self.cell_m) + 2)
        self.hits = column_hits(vertices, faces, self.low, self.cell_m, nx, ny, MOST_HITS)
        self.top_m = self.hits[..., 0].copy()
        raise_to_edges(self.top_m, vertices, faces, self.low, self.cell_m)
        self._mend_gaps(float(vertices[:, 2].min()))
        self.height_m = float(np.ptp(vertices[:, 2]))
        self.box_m3 = float(np.prod(np.ptp(vertices, axis=0)))

    def _mend_gaps(self, bottom_m: float) -> None:
        """Close small holes that go all the way through the mesh: gaps between its faces, not openings."""
        labels, _ = ndimage.label(~np.isfinite(self.top_m))
        areas = np.bincount(labels.ravel()) * self.cell_m**2
        self.top_m[(labels > 0) & (areas < MIN_MOUTH_M2)[labels]] = bottom_m

    def xy(self, mask: NDArray[np.bool_]) -> Array:
        """(N, 2) middles of the cells in a mask."""
        return np.asarray(self.low + (np.argwhere(mask) + 0.5) * self.cell_m)

    def disc(self, center_xy: Array, radius_m: float) -> NDArray[np.bool_]:
        """Cells whose middle lies within a circle; the one under its centre at least."""
        nx, ny = self.hits.shape[:2]
        x = self.low[0] + (np.arange(nx) + 0.5) * self.cell_m - center_xy[0]
        y = self.low[1] + (np.arange(ny) + 0.5) * self.cell_m - center_xy[1]
        return np.asarray(np.hypot(x[:, None], y[None]) <= max(radius_m, 0.75 * self.cell_m))

    def base_m2(self) -> float:
        """Area on which it stands: what lies lowest, and all that is enclosed by it."""
        bottom = np.where(np.isfinite(self.hits), self.hits, np.inf).min(axis=2)
        lowest = bottom < bottom.min() + 0.02 * self.height_m
        return float(np.count_nonzero(ndimage.binary_fill_holes(lowest))) * self.cell_m**2

    def fullness(self) -> float:
        """Share of the bounding box between the mesh's lowest and highest surfaces."""
        solid = np.isfinite(self.hits[..., 0])
        bottom = np.where(np.isfinite(self.hits), self.hits, np.inf).min(axis=2)
        return float(np.sum(self.hits[..., 0][solid] - bottom[solid])) * self.cell_m**2 / self.box_m3

    def pits(self, least_m: float = 0.003) -> list[Pit]:
        """Pits at least so deep, the largest first."""
        top = self.top_m
        drop = np.zeros_like(top)
        solid = np.isfinite(top)
        level = flooded(top)
        drop[solid] = level[solid] - top[solid]
        labels, _ = ndimage.label(drop > least_m)
        found = []
        for number, place in enumerate(ndimage.find_objects(labels), start=1):
            mask = np.zeros_like(solid)
            mask[place] = labels[place] == number
            depth = float(drop[mask].max())
            deep = mask & (drop > 0.5 * depth)
            volume = float(drop[mask].sum()) * self.cell_m**2
            area = float(mask.sum()) * self.cell_m**2
            found.append(Pit(volume, depth, area, float(level[mask].max()), self.xy(deep).mean(axis=0)))
        return sorted(found, key=lambda pit: -pit.volume_m3)

    def mouth(self) -> Pit | None:
        """The pit that makes this a vessel, if there is one."""
        for pit in self.pits():
            deep = pit.depth_m > max(MIN_DEPTH * self.height_m, MIN_DEPTH_M)
            if deep and pit.area_m2 > MIN_MOUTH_M2 and pit.volume_m3 > MIN_SHARE * self.box_m3:
                return pit
        return None


def find_up(vertices: Array, faces: Faces) -> str | None:
    """Which of the six axis directions of a mesh points out of its opening; None if none does.

    Raises UserError when two do about as well.
    """
    found = []
    for up in UPS:
        mouth = Columns(np.ascontiguousarray(vertices @ rotation_to_up(up).T), faces).mouth()
        if mouth is not None:
            found.append((mouth.volume_m3, up))
    found.sort(reverse=True)
    if len(found) > 1 and found[1][0] > 0.6 * found[0][0]:
        raise UserError(
            f"the mesh is open toward {found[0][1]} and toward {found[1][1]}; say which is up with --mesh-up"
        )
    return found[0][1] if found else None
