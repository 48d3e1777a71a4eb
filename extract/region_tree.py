"""Regions of a picture that may be objects, without learned models.

Colours that the sides of the picture show at the same height are background, and so are darker ones of their hue:
shadows. Superpixels (watershed of the colours' edges) are joined in the order of how weak the edges between them are,
which makes a tree of regions (Arbelaez et al., Contour detection and hierarchical image segmentation, 2011): once all
of them, for objects of the table's colours, and once what is unlike the background alone, for objects of many colours.
A region is likely an object when it is unlike the background, lies on it, and has a clear edge all around.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .geometry import Array
from .protocols import Floats, Image, Mask

CELL_PX = 9  # one superpixel a cell
BANDS, SIDE, END = 8, 0.08, 0.03  # heights with a background of their own; share of a side that counts as background
LEVELS, HUES = 40, 28  # cells of the colour histograms along the logarithm of brightness, and along each chromaticity
LOG_RANGE, HUE_RANGES = (2.4, 5.6), (0.45, 0.6)  # what they span
SHADOW, SHADOW_WEIGHT = 0.45, 0.7  # a shadow leaves so much light at least; how readily a colour is taken for one
UNLIKE = 0.6  # share from which a superpixel is unlike the background
EDGE_PERCENT = 98.0  # of the picture have a weaker edge than the clear ones
SMALLEST, LARGEST = 0.0012, 0.25  # of the picture
TRIED = 150  # regions of both trees that are compared
SHARED = 0.5  # of the smaller of two regions, from which the likelier one alone is proposed
LEAST_SCORE = 0.12


@dataclass(frozen=True)
class Region:
    """mask: (H, W).  score: in [0, 1], how likely it is an object."""

    mask: Mask
    score: float


@dataclass(frozen=True)
class Superpixels:
    """n superpixels and the E pairs of neighbours among them.

    labels: (H, W).  area_px, unlike: (n,), the latter the mean share to which colours are unlike the background.
    pairs: (E, 2).  length_px, strength: (E,) of the common outline, and the sum over it of the edge's strength, in
    [0, 1] a pixel.
    """

    labels: NDArray[np.int32]
    area_px: Array
    unlike: Array
    pairs: NDArray[np.int64]
    length_px: Array
    strength: Array


@dataclass(frozen=True)
class Tree:
    """R regions: a region holds the superpixels at places first to last of `order`, the last exclusive.

    height, parent_height: (R,) strength of the strongest edge inside, and of the one over which it is joined further.
    """

    order: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    height: Array
    parent_height: Array


def likely_regions(rgb: Image, most: int) -> list[Region]:
    """At most `most` regions of a picture (H, W, 3), likeliest first; none is a part of another."""
    if min(rgb.shape[:2]) < 3 * CELL_PX:
        return []
    pixels = superpixels(rgb, np.asarray(cv2.blur(unlike_background(rgb), (3, 3)), np.float32))
    everything = np.ones(len(pixels.area_px), bool)
    held = [_regions_of(pixels, region_tree(pixels, some)) for some in (pixels.unlike > UNLIKE, everything)]
    members, stable = np.concatenate([m for m, _ in held]), np.concatenate([s for _, s in held])
    members = members[np.argsort(-stable, kind="stable")[:TRIED]]
    scores = object_scores(pixels, members)
    area = members @ pixels.area_px
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        common = (members[kept] & members[k]) @ pixels.area_px
        if len(kept) < most and scores[k] > LEAST_SCORE and np.all(common <= SHARED * np.minimum(area[kept], area[k])):
            kept.append(int(k))
    return [Region(np.asarray(members[k][pixels.labels]), float(scores[k])) for k in kept]


def unlike_background(rgb: Image) -> Floats:
    """(H, W) in [0, 1]: how much likelier a colour is inside the picture than at its sides at the same height."""
    height, width = rgb.shape[:2]
    colours = _colours(rgb, 1.0)
    low = np.array([LOG_RANGE[0], -HUE_RANGES[0], -HUE_RANGES[1]])
    high = np.array([LOG_RANGE[1], HUE_RANGES[0], HUE_RANGES[1]])
    shape = (LEVELS, HUES, HUES)
    cells = np.clip(((colours - low) / (high - low) * shape).astype(int), 0, np.array(shape) - 1)
    flat = np.ravel_multi_index(tuple(np.moveaxis(cells, -1, 0)), shape)
    side, end = max(4, round(SIDE * width)), max(3, round(END * height))
    border = np.ones((height, width), bool)
    border[end:-end, side:-side] = False
    inside = _shares(flat[~border], shape)
    darker = int(np.ceil(-np.log(SHADOW) / (LOG_RANGE[1] - LOG_RANGE[0]) * LEVELS))
    found = np.zeros((height, width), np.float32)
    for top, bottom in zip(*_bands(height), strict=True):
        rows = slice(max(0, 2 * top - bottom), min(height, 2 * bottom - top))  # the neighbouring bands as well
        usual = _shares(flat[rows][border[rows]], shape)
        explained = usual.copy()
        for step in range(1, darker + 1):
            np.maximum(explained[:-step], SHADOW_WEIGHT * usual[step:], out=explained[:-step])
        here = flat[top:bottom]
        found[top:bottom] = inside.ravel()[here] / (inside.ravel()[here] + explained.ravel()[here] + 1e-9)
    return found


def superpixels(rgb: Image, unlike: Floats) -> Superpixels:
    """Superpixels of a picture, about one a cell; unlike: (H, W), see `unlike_background`."""
    height, width = rgb.shape[:2]
    shown = (_colours(rgb, 0.8) - [LOG_RANGE[0], -HUE_RANGES[0], -HUE_RANGES[1]]) * (
        # Brightness counts less than hue: it changes over a round body.
        0.6 / (LOG_RANGE[1] - LOG_RANGE[0]), 0.5 / HUE_RANGES[0], 0.5 / HUE_RANGES[1]
    )  # fmt: skip
    picture = np.clip(255 * shown, 0, 255).astype(np.uint8)
    slope = [cv2.Sobel(picture, cv2.CV_32F, *axes) for axes in ((1, 0), (0, 1))]
    edge = np.sqrt(sum((s**2).sum(axis=-1) for s in slope))
    edge = np.minimum(edge / max(float(np.percentile(edge, EDGE_PERCENT)), 1e-6), 1.0)
    rows, columns = height // CELL_PX, width // CELL_PX
    blocks = edge[: rows * CELL_PX, : columns * CELL_PX].reshape(rows, CELL_PX, columns, CELL_PX)
    calmest = blocks.transpose(0, 2, 1, 3).reshape(rows, columns, -1).argmin(axis=-1)
    seeds = np.zeros((height, width), np.int32)
    at = np.arange(rows)[:, None] * CELL_PX + calmest // CELL_PX, np.arange(columns) * CELL_PX + calmest % CELL_PX
    seeds[at] = np.arange(1, calmest.size + 1).reshape(calmest.shape)
    grown = np.maximum(cv2.watershed(picture, seeds), 0).astype(np.float32)
    while not grown.all():  # watershed lines, and the picture's rim, go to a neighbour
        grown = np.where(grown > 0, grown, cv2.dilate(grown, np.ones((3, 3))))
    labels = grown.astype(np.int32) - 1
    count = calmest.size
    area = np.bincount(labels.ravel(), minlength=count).astype(float)
    share = np.bincount(labels.ravel(), unlike.ravel(), minlength=count) / np.maximum(area, 1)
    return Superpixels(labels, area, share, *_neighbours(labels, edge, count))


def region_tree(pixels: Superpixels, chosen: NDArray[np.bool_]) -> Tree:
    """The regions that come of joining the chosen (n,) superpixels, the weakest mean edge first."""
    near: list[dict[int, tuple[float, float]]] = [{} for _ in chosen]
    both = chosen[pixels.pairs].all(axis=1)
    for (i, j), strength, length in zip(
        pixels.pairs[both].tolist(), pixels.strength[both].tolist(), pixels.length_px[both].tolist(), strict=True
    ):
        near[i][j] = near[j][i] = (strength, length)
    heap = [(s / length, i, j) for i, beside in enumerate(near) for j, (s, length) in beside.items() if i < j]
    heapq.heapify(heap)
    there = chosen.tolist()
    height, parent_height, children = [0.0] * len(there), [1.0] * len(there), [(-1, -1)] * len(there)
    while heap:
        weakest, i, j = heapq.heappop(heap)
        if not (there[i] and there[j]):
            continue
        new = len(there)
        there[i] = there[j] = False
        there.append(True)
        children.append((i, j))
        height.append(max(weakest, height[i], height[j]))
        parent_height.append(1.0)
        parent_height[i] = parent_height[j] = height[new]
        joined: dict[int, tuple[float, float]] = {}
        for part, other in ((i, j), (j, i)):
            for k, (strength, length) in near[part].items():
                if k != other:
                    before = joined.get(k, (0.0, 0.0))
                    joined[k] = before[0] + strength, before[1] + length
                    near[k].pop(part, None)
            near[part] = {}
        near.append(joined)
        for k, (strength, length) in joined.items():
            near[k][new] = (strength, length)
            heapq.heappush(heap, (strength / length, min(k, new), max(k, new)))
    return _laid_out(children, chosen, np.array(height), np.array(parent_height))


def object_scores(pixels: Superpixels, members: NDArray[np.bool_]) -> Array:
    """(R,) in [0, 1]: how likely regions, (R, n) of superpixels, are objects."""
    area = members @ pixels.area_px
    unlike = members @ (pixels.unlike * pixels.area_px) / np.maximum(area, 1)
    a, b = members[:, pixels.pairs[:, 0]], members[:, pixels.pairs[:, 1]]
    outline = np.maximum((a != b) @ pixels.length_px, 1)
    edge = (a != b) @ pixels.strength / outline
    beyond = ((a & ~b) @ (pixels.length_px * pixels.unlike[pixels.pairs[:, 1]])) + (
        (b & ~a) @ (pixels.length_px * pixels.unlike[pixels.pairs[:, 0]])
    )
    # A part of a thing has the rest of it beside; and of things that look alike good the larger is rather the whole.
    return np.asarray(unlike * edge * (1 - 0.5 * beyond / outline) * (area / pixels.labels.size) ** 0.25)


def _regions_of(pixels: Superpixels, tree: Tree) -> tuple[NDArray[np.bool_], Array]:
    """(R, n) regions of an object's size, and (R,) how much stronger than inside the edge is that ends them."""
    total = np.concatenate([[0.0], np.cumsum(pixels.area_px[tree.order])]) / pixels.labels.size
    share = total[tree.last] - total[tree.first]
    stable = tree.parent_height - tree.height
    fits = np.flatnonzero((share > SMALLEST) & (share < LARGEST))
    fits = fits[np.argsort(-stable[fits], kind="stable")[:TRIED]]
    place = np.full(len(pixels.area_px), -1)
    place[tree.order] = np.arange(len(tree.order))
    return (place >= tree.first[fits, None]) & (place < tree.last[fits, None]), stable[fits]


def _laid_out(
    children: Sequence[tuple[int, int]], chosen: NDArray[np.bool_], height: Array, parent_height: Array
) -> Tree:
    """Put the superpixels in an order in which every region is one stretch."""
    count, total = len(chosen), len(children)
    size = np.zeros(total, np.int64)
    size[:count] = chosen
    child = np.zeros(total, bool)
    for k in range(count, total):
        i, j = children[k]
        size[k] = size[i] + size[j]
        child[[i, j]] = True
    first = np.zeros(total, np.int64)
    roots = np.flatnonzero(~child & (size > 0))
    first[roots] = np.cumsum(size[roots]) - size[roots]
    for k in reversed(range(count, total)):
        i, j = children[k]
        first[i], first[j] = first[k], first[k] + size[i]
    order = np.empty(int(size[roots].sum()), np.int64)
    order[first[:count][chosen]] = np.flatnonzero(chosen)
    return Tree(order, first, first + size, height, parent_height)


def _neighbours(labels: NDArray[np.int32], edge: Array, count: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Pairs (E, 2) of labels that touch, length (E,) of their common outline, and the sum (E,) of edges along it."""
    ends, strength = [], []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        ends.append(np.stack([labels[one].ravel(), labels[other].ravel()]).astype(np.int64))
        strength.append(np.maximum(edge[one], edge[other]).ravel())
    (a, b), along = np.concatenate(ends, axis=1), np.concatenate(strength)
    apart = a != b
    pair = np.minimum(a, b)[apart] * count + np.maximum(a, b)[apart]
    known, which = np.unique(pair, return_inverse=True)
    pairs = np.stack([known // count, known % count], axis=1)
    return pairs, np.bincount(which).astype(float), np.bincount(which, along[apart]).astype(float)


def _bands(height: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    edges = np.linspace(0, height, BANDS + 1).astype(np.int64)
    return edges[:-1], edges[1:]


def _shares(cells: NDArray[np.int64], shape: tuple[int, int, int]) -> Floats:
    """Smoothed histogram of cells, its sum 1."""
    counts = np.bincount(cells.ravel(), minlength=int(np.prod(shape))).reshape(shape).astype(np.float32)
    return np.asarray(gaussian_filter(counts, (1.0, 0.75, 0.75)) / max(cells.size, 1), np.float32)


def _colours(rgb: Image, blur_px: float) -> Floats:
    """(H, W, 3) logarithm of the brightness, and two chromaticities: light that changes moves the first alone."""
    lifted = cv2.GaussianBlur(rgb, (0, 0), blur_px).astype(np.float32) + 12  # so that noise gives black no hue
    total = lifted.sum(axis=-1)
    red, green, blue = np.moveaxis(lifted, -1, 0)
    return np.stack([np.log(total / 3), (red - green) / total, (0.5 * (red + green) - blue) / total], axis=-1)
