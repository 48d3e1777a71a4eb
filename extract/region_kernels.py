"""The hot loops of the region tracker (region.py): walks along the outline's lines, compiled to machine code.

Every function writes into arrays that the caller made; N lines have their feet at `pixel` (N, 2) in px and run along
the outward unit `normal` (N, 2), `inside` and `outside` (N,) px long.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array

HALF_LINE = 10  # samples on either side of the outline
# An outline on a clear image edge is this much likelier than one on none; steps beyond 2 px would miss edges.
EDGE_WEIGHT, EDGE_FLOOR, EDGE_STEP_PX = 1.0, 0.2, 2.0
AMPLITUDE, SLOPE = 0.40, 1.0  # of the smooth step between inside and outside (SRT3D, eq. 13)
INSIDE_SHARE = 0.5 - AMPLITUDE * np.tanh(np.arange(-2 * HALF_LINE, 2 * HALF_LINE + 1) / (2.0 * SLOPE))


@numba.njit(cache=True)
def free_lengths(
    contour: Array, normal: Array, mask: NDArray[np.uint8], inside: NDArray[np.float32], outside: NDArray[np.float32]
) -> None:
    """Length in px that every line runs inside the silhouette and outside of it before meeting it again, at most 60.

    contour (N, 2), normal (N, 2) in px of `mask` (H, W).  inside, outside: (N,), written.
    """
    h, w = mask.shape
    for i in range(contour.shape[0]):
        for direction in (-1, 1):
            length = 60.0
            for r in range(2, 60):
                x = round(contour[i, 0] + direction * r * normal[i, 0])
                y = round(contour[i, 1] + direction * r * normal[i, 1])
                hit = 0 <= x < w and 0 <= y < h and mask[y, x] > 0
                if hit != (direction < 0):
                    length = float(r)
                    break
            if direction < 0:
                inside[i] = length
            else:
                outside[i] = length


@numba.njit(cache=True)
def collect_lines(
    pixel: Array, normal: Array, inside: NDArray[np.float32], outside: NDArray[np.float32],
    nearest: NDArray[np.int32], bins: NDArray[np.int32],
    fresh_f: NDArray[np.float32], fresh_b: NDArray[np.float32],
) -> None:  # fmt: skip
    """Count the colours on either side of the outline into the histograms of each line's nearest centres.

    The last row of `fresh_f` (inside) and `fresh_b` (outside), (K, BINS), counts the lines of all centres.
    """
    h, w = bins.shape
    last = fresh_f.shape[0] - 1
    for i in range(pixel.shape[0]):
        for direction in (-1, 1):
            reach = min(inside[i] - 1.0, 16.0) if direction < 0 else min(outside[i] - 1.0, 16.0)
            r = 1.5
            while r <= reach:
                x = round(pixel[i, 0] + direction * r * normal[i, 0])
                y = round(pixel[i, 1] + direction * r * normal[i, 1])
                r += 1.0
                if x < 0 or y < 0 or x >= w or y >= h:
                    break
                b = bins[y, x]
                for k in nearest[i]:
                    if direction < 0:
                        fresh_f[k, b] += 1.0
                    else:
                        fresh_b[k, b] += 1.0
                if direction < 0:
                    fresh_f[last, b] += 1.0
                else:
                    fresh_b[last, b] += 1.0


@numba.njit(cache=True)
def measure_lines(
    pixel: Array, normal: Array, inside: NDArray[np.float32], outside: NDArray[np.float32],
    nearest: NDArray[np.int32], bins: NDArray[np.int32],
    hist_f: NDArray[np.float32], hist_b: NDArray[np.float32], seen: NDArray[np.float32], edges: NDArray[np.float32],
    step_px: float, mean_px: Array, variance: Array, gain: Array,
) -> None:  # fmt: skip
    """Posterior mean and variance (px) of the outline's position on every line; variance 0 marks an unusable line."""
    h, w = bins.shape
    last = hist_f.shape[0] - 1
    n = 2 * HALF_LINE + 1
    p_f = np.empty(n)
    log_p = np.empty(n)
    use_edges = edges.shape[0] > 0 and step_px <= EDGE_STEP_PX
    for i in range(pixel.shape[0]):
        variance[i] = 0.0
        # Thin parts (spouts, handles) are only measured at steps fine enough to see both of their sides.
        if inside[i] < 1.5 * step_px or outside[i] < 1.5 * step_px:
            continue
        valid = 0
        for j in range(n):
            r = (j - HALF_LINE) * step_px
            x = round(pixel[i, 0] + r * normal[i, 0])
            y = round(pixel[i, 1] + r * normal[i, 1])
            p_f[j] = 0.5
            # Beyond the far side of a thin part the line says nothing about this outline.
            if r < -inside[i] or r > outside[i] or x < 0 or y < 0 or x >= w or y >= h:
                continue
            b = bins[y, x]
            f, g = 0.15 * hist_f[last, b], 0.15 * hist_b[last, b]
            for k in nearest[i]:
                if seen[k] > 0:
                    f += hist_f[k, b]
                    g += hist_b[k, b]
            p_f[j] = (f + 1e-5) / (f + g + 2e-5)
            valid += 1
        if valid < HALF_LINE:
            continue
        top = -1e30
        for d in range(n):
            # One logarithm of the product: 21 factors above 0.05 are far from underflow.
            product = 1.0
            for j in range(n):
                inside_share = INSIDE_SHARE[j - d + 2 * HALF_LINE]
                product *= inside_share * p_f[j] + (1.0 - inside_share) * (1.0 - p_f[j])
            total = np.log(product)
            if use_edges:
                r = (d - HALF_LINE) * step_px
                x = round(pixel[i, 0] + r * normal[i, 0])
                y = round(pixel[i, 1] + r * normal[i, 1])
                if 0 <= x < w and 0 <= y < h:
                    along = abs(edges[y, x, 0] * normal[i, 0] + edges[y, x, 1] * normal[i, 1])
                    total += EDGE_WEIGHT * np.log(EDGE_FLOOR + min(along, 1.0))
            log_p[d] = total
            top = max(top, total)
        weight = 0.0
        first = 0.0
        second = 0.0
        for d in range(n):
            e = np.exp(log_p[d] - top)
            r = (d - HALF_LINE) * step_px
            weight += e
            first += e * r
            second += e * r * r
        mean = first / weight
        mean_px[i] = mean
        variance[i] = max(second / weight - mean * mean, 0.25 * step_px * step_px)
        gain[i] = (log_p[HALF_LINE] - 0.5 * (log_p[0] + log_p[n - 1])) / n
