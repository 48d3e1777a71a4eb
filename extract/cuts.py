"""Where a video jumps to another shot, found while it is read.

A cut changes the picture everywhere at once and for good. Motion changes it where things move, a flash changes it and
changes it back. So a frame is compared with the one before it after the best shift of every tile, on edges and on
colours, and the measure is judged against what was usual in the clip so far.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Array
from .video import Image

TILES, TILE_PX = 8, (12, 16)  # small pictures show cuts as well, and no noise
ALIKE = 0.6  # correlation of a tile with what it was
REACH_PX = 5  # a tile may shift this far between frames, in the small picture
CHANGED, ALL_CHANGED = 0.3, 0.8  # share of the tiles that look like nothing near them
COLOUR_CHANGED = 0.05  # distance of the colour histograms, in [0, 1]
USUAL_FRAMES = 12
ABOVE_USUAL = 3.0
FLAT_LEVELS = 3.0  # standard deviation in grey levels below which a tile shows nothing to compare


@dataclass(frozen=True)
class Cut:
    """The first frame of a new shot: its index, its time in s, and how different it is, in [0, 1]."""

    index: int
    time_s: float
    change: float


@dataclass
class CutWatch:
    """Takes the frames of a clip in order; `cuts` are those found so far.

    A cut is confirmed with the frame after it, so one in the very last frame is not reported; a flash of one frame is
    none. Fades and wipes, which have no frame at which they happen, are not looked for.
    """

    cuts: list[Cut] = field(default_factory=list)
    _before: _Look | None = None
    _suspect: tuple[Cut, _Look] | None = None
    _usual: deque[float] = field(default_factory=lambda: deque(maxlen=USUAL_FRAMES))
    _count: int = 0

    def step(self, rgb: Image, time_s: float) -> Cut | None:
        """Take the next frame (H, W, 3); the cut that this frame confirms, or None."""
        look = _Look.of(rgb)
        index, self._count = self._count, self._count + 1
        confirmed = None
        if self._suspect is not None:
            cut, old = self._suspect
            self._suspect = None
            if _is_cut(*_difference(old, look), self._usual):
                confirmed = cut
                self.cuts.append(cut)
                self._usual.clear()
            else:
                self._before = old  # a flash: what was seen before it counts
        if self._before is not None:
            tiles, colours = _difference(self._before, look)
            if _is_cut(tiles, colours, self._usual):
                self._suspect = (Cut(index, time_s, tiles), self._before)
            else:
                self._usual.append(tiles)
        self._before = look
        return confirmed


@dataclass(frozen=True)
class _Look:
    """A frame made small: blurred grey (96, 128) and the histogram of its colours."""

    grey: NDArray[np.float32]
    colours: Array

    @staticmethod
    def of(rgb: Image) -> _Look:
        small = cv2.resize(rgb, (TILES * TILE_PX[1], TILES * TILE_PX[0]), interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
        lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
        counts = cv2.calcHist([lab], [0, 1, 2], None, [8, 12, 12], [0, 256, 0, 256, 0, 256])
        counts = cv2.GaussianBlur(counts.reshape(8, 144), (1, 3), 0.8)  # exposure drifts across the bins
        return _Look(grey, np.asarray(counts, float).ravel() / counts.sum())


def _is_cut(tiles: float, colours: float, usual: deque[float]) -> bool:
    # Violent motion changes much in every frame; a cut comes out of calm.
    quiet = float(np.median(usual)) if usual else 0.0
    return tiles > ALL_CHANGED or (colours > COLOUR_CHANGED and tiles > max(CHANGED, ABOVE_USUAL * quiet))


def _difference(a: _Look, b: _Look) -> tuple[float, float]:
    """Share of tiles of b that correlate with nothing near them in a, and the distance of the colours."""
    colours = 1.0 - float(np.sqrt(a.colours * b.colours).sum())
    tiles_a, tiles_b = _tiles(a.grey), _tiles(b.grey)
    flat_a, flat_b = (tiles.std(axis=1) < FLAT_LEVELS for tiles in (tiles_a, tiles_b))
    compared = ~(flat_a & flat_b)
    if compared.sum() < TILES:  # black or blank pictures: only colours can tell
        return float(colours > 0.5), colours
    centred = [tiles - tiles.mean(axis=1, keepdims=True) for tiles in (tiles_a, tiles_b)]
    both = np.linalg.norm(centred[0], axis=1) * np.linalg.norm(centred[1], axis=1)
    alike = (centred[0] * centred[1]).sum(axis=1) > ALIKE * np.maximum(both, 1e-6)
    around = cv2.copyMakeBorder(a.grey, REACH_PX, REACH_PX, REACH_PX, REACH_PX, cv2.BORDER_REPLICATE)
    for k in np.flatnonzero(compared & ~alike & ~flat_b):
        top, left = k // TILES * TILE_PX[0], k % TILES * TILE_PX[1]
        window = around[top : top + TILE_PX[0] + 2 * REACH_PX, left : left + TILE_PX[1] + 2 * REACH_PX]
        tile = np.ascontiguousarray(b.grey[top : top + TILE_PX[0], left : left + TILE_PX[1]])
        alike[k] = float(cv2.matchTemplate(window, tile, cv2.TM_CCOEFF_NORMED).max()) > ALIKE
    return float(np.mean(~alike[compared])), colours


def _tiles(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """(TILES^2, pixels of a tile)."""
    height, width = TILE_PX
    return grey.reshape(TILES, height, TILES, width).transpose(0, 2, 1, 3).reshape(TILES * TILES, -1)
