"""Procedural pictures for synthetic scenes: table tops, walls, cloth and printed vessels, all from a seed.

Every surface texture tiles without a seam. Images are (H, W, 3) uint8 RGB.
"""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Grey = NDArray[np.float64]

TABLE_KINDS = ("wood", "planks", "plaster", "cloth", "checks")
WALL_KINDS = ("plaster", "tiles", "gradient", "planks", "shelves")
PRINT_KINDS = ("plain", "label", "stripes", "speckle", "bands")

# The vessel's picture is split by height: the printed outer wall wraps around in the lower part, plain strips for
# inside, handle and lid lie above, so that the wrap never bleeds into them.
PRINT_V = (0.02, 0.66)
_PLAIN_V = (0.70, 1.0)


def random_color(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> Grey:
    """(3,) RGB in [0, 1] with a random hue."""
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value)))


def table_texture(rng: np.random.Generator, size_px: int = 512) -> tuple[str, Image]:
    """A table top: its kind and a tile."""
    kind = str(rng.choice(TABLE_KINDS))
    return kind, _SURFACES[kind](rng, size_px)


def wall_texture(rng: np.random.Generator, size_px: int = 512) -> tuple[str, Image]:
    """A back wall: its kind and a tile."""
    kind = str(rng.choice(WALL_KINDS))
    return kind, _SURFACES[kind](rng, size_px)


def plain_v(count: int) -> Grey:
    """(count,) heights of the middles of the plain strips in a vessel's picture."""
    return _PLAIN_V[0] + (_PLAIN_V[1] - _PLAIN_V[0]) * (np.arange(count) + 0.5) / count


def vessel_texture(
    rng: np.random.Generator, kind: str, color: Grey, plain: list[Grey], size_px: tuple[int, int] = (512, 512)
) -> Image:
    """The wrap of a vessel: azimuth along the width, height along PRINT_V, one strip for each plain colour above."""
    width, height = size_px
    picture = np.ones((height, width, 3)) * color
    rows = slice(round(PRINT_V[0] * height), round(PRINT_V[1] * height))
    picture[rows] = _print(rng, kind, color, rows.stop - rows.start, width)
    edges = np.rint(np.linspace(*_PLAIN_V, len(plain) + 1) * height).astype(int)
    for low, high, flat in zip(edges[:-1], edges[1:], plain, strict=True):
        picture[low:high] = flat
    return _to_uint8(picture)


def noise(rng: np.random.Generator, size_px: int, cells: tuple[int, int], octaves: int = 4) -> Grey:
    """Tileable value noise (size, size) of mean 0 and deviation 1; `cells`: coarsest grid along rows and columns."""
    total = np.zeros((size_px, size_px))
    for octave in range(octaves):
        rows, columns = (min(size_px, cell << octave) for cell in cells)
        grid = np.pad(rng.standard_normal((rows, columns)), 2, mode="wrap")
        wide = cv2.resize(
            grid, (size_px * (columns + 4) // columns, size_px * (rows + 4) // rows), interpolation=cv2.INTER_CUBIC
        )
        top, left = 2 * size_px // rows, 2 * size_px // columns
        total += wide[top : top + size_px, left : left + size_px] / 2**octave
    return total / max(float(total.std()), 1e-9)


def _to_uint8(picture: Grey) -> Image:
    return np.asarray(np.clip(np.rint(picture * 255), 0, 255), np.uint8)


def _shade(base: Grey, amount: Grey) -> Grey:
    return np.asarray(base * (1 + amount[..., None]))


def _wood(rng: np.random.Generator, size_px: int) -> Image:
    base = np.array(colorsys.hsv_to_rgb(rng.uniform(0.05, 0.11), rng.uniform(0.3, 0.65), rng.uniform(0.45, 0.85)))
    warp = noise(rng, size_px, (2, 2), 2)
    rings = np.sin(2 * np.pi * (rng.integers(5, 11) * np.arange(size_px)[:, None] / size_px + 0.12 * warp))
    grain = noise(rng, size_px, (96, 3), 2)
    return _to_uint8(_shade(base, 0.07 * rings + 0.05 * grain + 0.03 * warp))


def _planks(rng: np.random.Generator, size_px: int) -> Image:
    wood = _wood(rng, size_px).astype(float) / 255
    count = int(rng.integers(3, 6))
    rows = np.arange(size_px) * count // size_px
    wood *= (1 + 0.12 * rng.uniform(-1, 1, count))[rows][:, None, None]
    shift = rng.integers(0, size_px, count)
    wood = np.stack([np.roll(wood[row], shift[rows[row]], axis=0) for row in range(size_px)])
    wood[np.flatnonzero(np.diff(rows, prepend=-1) != 0)] *= 0.45
    return _to_uint8(wood)


def _plaster(rng: np.random.Generator, size_px: int) -> Image:
    base = random_color(rng, (0.03, 0.3), (0.55, 0.95))
    return _to_uint8(_shade(base, 0.05 * noise(rng, size_px, (4, 4), 5) + 0.02 * noise(rng, size_px, (128, 128), 1)))


def _cloth(rng: np.random.Generator, size_px: int) -> Image:
    first, second = random_color(rng, (0.15, 0.55), (0.4, 0.9)), random_color(rng, (0.0, 0.3), (0.6, 0.95))
    count = int(rng.integers(4, 10))
    phase = np.arange(size_px) * count / size_px % 1
    across, along = phase[None, :] < 0.45, phase[:, None] < (0.45 if rng.random() < 0.6 else 0.0)
    weight = 0.5 * across + 0.5 * along
    picture = weight[..., None] * first + (1 - weight[..., None]) * second
    weave = np.sin(np.arange(size_px) * np.pi / 2)
    return _to_uint8(
        picture * (1 + 0.04 * weave[:, None, None] * weave[None, :, None])
        + 0.015 * noise(rng, size_px, (64, 64), 2)[..., None]
    )


def _checks(rng: np.random.Generator, size_px: int) -> Image:
    first, second = random_color(rng, (0.05, 0.6), (0.3, 0.6)), random_color(rng, (0.0, 0.25), (0.75, 0.95))
    count = 2 * int(rng.integers(2, 5))
    cell = np.arange(size_px) * count // size_px
    odd = (cell[:, None] + cell[None, :]) % 2 == 1
    picture = np.where(odd[..., None], first, second)
    return _to_uint8(_shade(picture, 0.04 * noise(rng, size_px, (8, 8), 4)))


def _tiles(rng: np.random.Generator, size_px: int) -> Image:
    base, grout = random_color(rng, (0.03, 0.3), (0.6, 0.95)), random_color(rng, (0.0, 0.1), (0.35, 0.8))
    rows_count, columns_count = int(rng.integers(4, 8)), int(rng.integers(2, 5))
    y, x = np.mgrid[0:size_px, 0:size_px] / size_px
    row = np.floor(y * rows_count).astype(int)
    shifted = x * columns_count + 0.5 * (row % 2) * (rows_count % 2 == 0)
    column = np.floor(shifted).astype(int) % columns_count
    tint = 1 + 0.06 * rng.uniform(-1, 1, (rows_count, columns_count))
    joint = (y * rows_count % 1 < 0.05) | (shifted % 1 < 0.03)
    picture = np.where(joint[..., None], grout, base * tint[row, column][..., None])
    return _to_uint8(_shade(picture, 0.03 * noise(rng, size_px, (6, 6), 4)))


def _gradient(rng: np.random.Generator, size_px: int) -> Image:
    first, second = random_color(rng, (0.05, 0.4), (0.5, 0.9)), random_color(rng, (0.05, 0.4), (0.5, 0.9))
    weight = 0.5 + 0.5 * np.cos(2 * np.pi * (np.arange(size_px) / size_px))[:, None, None]
    picture = weight * first + (1 - weight) * second
    return _to_uint8(np.broadcast_to(picture, (size_px, size_px, 3)) + 0.02 * noise(rng, size_px, (5, 5), 4)[..., None])


def _shelves(rng: np.random.Generator, size_px: int) -> Image:
    picture = _plaster(rng, size_px).astype(float) / 255
    board = random_color(rng, (0.3, 0.6), (0.3, 0.6))
    for shelf in (0.05, 0.52):
        top, depth = round(shelf * size_px), round(0.035 * size_px)
        x = round(0.02 * size_px)
        while x < 0.96 * size_px:
            wide = int(rng.integers(size_px // 40, size_px // 12))
            tall = int(rng.integers(size_px // 6, size_px // 3))
            if rng.random() < 0.75:
                picture[top + depth : top + depth + tall, x : x + wide] = random_color(rng, (0.1, 0.8), (0.2, 0.9))
            x += wide + int(rng.integers(1, 6))
        picture[top : top + depth] = board
    return _to_uint8(np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0), np.float64))


_SURFACES = {
    "wood": _wood,
    "planks": _planks,
    "plaster": _plaster,
    "cloth": _cloth,
    "checks": _checks,
    "tiles": _tiles,
    "gradient": _gradient,
    "shelves": _shelves,
}


def _print(rng: np.random.Generator, kind: str, color: Grey, height: int, width: int) -> Grey:
    picture = np.ones((height, width, 3)) * color
    ink = random_color(rng, (0.3, 0.9), (0.15, 0.95))
    if kind == "label":
        left, wide = int(rng.integers(0, width)), round(width * rng.uniform(0.25, 0.4))
        low, high = round(0.2 * height), round(rng.uniform(0.65, 0.85) * height)
        label = np.ones((high - low, wide, 3)) * ink
        label[4:-4, 4:-4] = random_color(rng, (0.0, 0.2), (0.8, 1.0))
        for _ in range(7):
            a, b = sorted(rng.integers(8, high - low - 8, 2))
            c, d = sorted(rng.integers(8, wide - 8, 2))
            label[a : max(b, a + 8), c : max(d, c + 8)] = random_color(rng, (0.3, 0.9), (0.1, 0.9))
        picture[low:high] = np.roll(picture[low:high], -left, axis=1)
        picture[low:high, :wide] = label
        picture[low:high] = np.roll(picture[low:high], left, axis=1)
    elif kind == "stripes":
        count = int(rng.integers(3, 9))
        share = np.cumsum(rng.dirichlet(np.full(2 * count, 4.0)))
        # Stripes of unequal width: the spin about the axis can be seen without a repeat.
        band = np.searchsorted(share, (np.arange(width) + 0.5) / width) % 2 == 1
        picture[:, band] = ink
    elif kind == "speckle":
        spots = noise(rng, width, (48, 48), 2)[:height] > 1.6
        picture[spots] = ink
    elif kind == "bands":
        for _ in range(int(rng.integers(1, 4))):
            low = int(rng.integers(0, round(0.9 * height)))
            picture[low : low + int(rng.integers(6, height // 5))] = ink
    return picture
