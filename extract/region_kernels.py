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
HIDDEN = 0.01  # of the distance: farther behind the visible surface is another one
AMPLITUDE, SLOPE = 0.40, 1.0  # of the smooth step between inside and outside (SRT3D, eq. 13)
# Of samples from the farthest outside of an outline to the farthest inside of it.
INSIDE_SHARE = 0.5 - AMPLITUDE * np.tanh(np.arange(2 * HALF_LINE, -2 * HALF_LINE - 1, -1) / (2.0 * SLOPE))
OUTSIDE_SHARE = 1.0 - INSIDE_SHARE


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def count_bins(lab: NDArray[np.uint8], bits: int, chroma_step: int, bins: NDArray[np.int32]) -> None:
    """Histogram bin of every pixel of (H, W, 3) in 8-bit Lab, `bits` a channel, into `bins` (H, W).

    Most things are nearly grey, so that hues are told apart finely near grey, a bin per `chroma_step`, and not at all
    where they are vivid.
    """
    shift, side = 8 - bits, 1 << bits
    light, chroma = np.empty(256, np.int32), np.empty(256, np.int32)
    for value in range(256):
        light[value] = (value >> shift) << (2 * bits)
        chroma[value] = min(max((value - 128) // chroma_step + side // 2, 0), side - 1)
    for y in range(lab.shape[0]):
        for x in range(lab.shape[1]):
            bins[y, x] = light[lab[y, x, 0]] + chroma[lab[y, x, 1]] * side + chroma[lab[y, x, 2]]


@numba.njit(cache=True, nogil=True)
def hide_bins(
    bins: NDArray[np.int32], covered: NDArray[np.bool_], alien: NDArray[np.bool_], hidden: int,
    counts: NDArray[np.float32],
) -> None:  # fmt: skip
    """Put `hidden` where `bins` (H, W) are covered and of an alien colour, and count those colours.

    alien: (BINS,) by bin.  counts: (BINS,), added to.
    """
    for y in range(bins.shape[0]):
        for x in range(bins.shape[1]):
            if covered[y, x] and alien[bins[y, x]]:
                counts[bins[y, x]] += np.float32(1.0)
                bins[y, x] = hidden


@numba.njit(cache=True, nogil=True)
def look_up(table: NDArray[np.float32], bins: NDArray[np.int32], out: NDArray[np.float32]) -> None:
    """What a table (BINS,) has for every bin, into `out`, which is of their shape (H, W)."""
    for y in range(bins.shape[0]):
        for x in range(bins.shape[1]):
            out[y, x] = table[bins[y, x]]


@numba.njit(cache=True, nogil=True)
def strongest_gradient(soft: NDArray[np.uint8], scale: float, out: NDArray[np.float32]) -> None:
    """Sobel's gradient times `scale` of the channel where it is longest, (H, W, 2); 0 at the image's border.

    soft: (H, W, 3).
    """
    h, w, _ = soft.shape
    rows, n = soft.reshape(h, 3 * w), 3 * (w - 2)
    gx, gy, square = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    for y in range(1, h - 1):
        a, b, c = rows[y - 1], rows[y - 1, 3:], rows[y - 1, 6:]
        d, e = rows[y], rows[y, 6:]
        f, g, k = rows[y + 1], rows[y + 1, 3:], rows[y + 1, 6:]
        for i in range(n):
            down, up = np.int32(k[i]) - np.int32(a[i]), np.int32(f[i]) - np.int32(c[i])
            gx[i] = down - up + 2 * (np.int32(e[i]) - np.int32(d[i]))
            gy[i] = down + up + 2 * (np.int32(g[i]) - np.int32(b[i]))
            square[i] = gx[i] * gx[i] + gy[i] * gy[i]
        for x in range(w - 2):
            i = 3 * x + (square[3 * x + 1] > square[3 * x])
            i = 3 * x + 2 if square[3 * x + 2] > square[i] else i
            out[y, x + 1, 0], out[y, x + 1, 1] = gx[i] * scale, gy[i] * scale
    out[0], out[-1], out[:, 0], out[:, -1] = 0.0, 0.0, 0.0, 0.0


@numba.njit(cache=True, nogil=True)
def smooth_histogram(histogram: NDArray[np.float32], side: int) -> None:
    """Normalise a histogram of side^3 bins, spread over neighbouring bins so that small samples do not overfit."""
    # Only the box of bins that are taken or next to one that is: few colours are near each other.
    low, high, strides = np.full(3, side), np.full(3, 0), (1, side, side * side)
    for at in range(side**3):
        if histogram[at] > 0.0:
            for axis in range(3):
                k = at // strides[axis] % side
                low[axis], high[axis] = min(low[axis], max(k - 1, 0)), max(high[axis], min(k + 2, side))
    for axis in range(3):
        one, other, stride = (axis + 1) % 3, (axis + 2) % 3, strides[axis]
        for i in range(low[one], high[one]):
            for j in range(low[other], high[other]):
                before = np.float32(0.0)
                for k in range(low[axis], high[axis]):
                    at = i * strides[one] + j * strides[other] + k * stride
                    here = histogram[at]
                    after = histogram[at + stride] if k + 1 < side else np.float32(0.0)
                    histogram[at] = np.float32(0.5) * here + np.float32(0.25) * (before + after)
                    before = here
    total = np.float32(0.0)
    for i in range(low[2], high[2]):
        for j in range(low[1], high[1]):
            for at in range((i * side + j) * side + low[0], (i * side + j) * side + high[0]):
                total += histogram[at]
    histogram /= max(total, np.float32(1e-12))


@numba.njit(cache=True, nogil=True)
def learn_lines(
    pixel: Array, normal: Array, inside: NDArray[np.float32], outside: NDArray[np.float32],
    nearest: NDArray[np.int32], bins: NDArray[np.int32],
    hist_f: NDArray[np.float32], hist_b: NDArray[np.float32], seen: NDArray[np.float32], rate: float, skipped: int,
) -> None:  # fmt: skip
    """Blend the colours on either side of the outline into the histograms (K, BINS) of each line's nearest centres.

    `rate` is the share of what is new; a centre not seen before takes all of it. The last row holds all centres.
    Nothing is learned from the bin `skipped`.
    """
    h, w = bins.shape
    last = hist_f.shape[0] - 1
    side = round(hist_f.shape[1] ** (1 / 3))
    fresh = np.zeros((2, hist_f.shape[0], hist_f.shape[1]), np.float32)
    counts = np.zeros((2, hist_f.shape[0]), np.int64)
    for i in range(pixel.shape[0]):
        for which in range(2):
            direction = -1 if which == 0 else 1
            reach = min((inside[i] if which == 0 else outside[i]) - 1.0, 16.0)
            r = 1.5
            while r <= reach:
                x = round(pixel[i, 0] + direction * r * normal[i, 0])
                y = round(pixel[i, 1] + direction * r * normal[i, 1])
                r += 1.0
                if x < 0 or y < 0 or x >= w or y >= h:
                    break
                b = bins[y, x]
                if b == skipped:
                    continue
                for j in range(3):
                    k = last if j == 2 else np.int64(nearest[i, j])
                    fresh[which, k, b] += 1.0
                    counts[which, k] += 1
    for k in range(last + 1):
        if counts[0, k] <= 20 or counts[1, k] <= 20:
            continue
        a = np.float32(rate if seen[k] > 0 else 1.0)
        smooth_histogram(fresh[0, k], side)
        smooth_histogram(fresh[1, k], side)
        for b in range(hist_f.shape[1]):
            hist_f[k, b] += a * (fresh[0, k, b] - hist_f[k, b])
            hist_b[k, b] += a * (fresh[1, k, b] - hist_b[k, b])
        seen[k] = 1.0


@numba.njit(cache=True, nogil=True)
def measure_lines(
    pixel: Array, normal: Array, inside: NDArray[np.float32], outside: NDArray[np.float32],
    nearest: NDArray[np.int32], bins: NDArray[np.int32],
    hist_f: NDArray[np.float32], hist_b: NDArray[np.float32], seen: NDArray[np.float32], skipped: int,
    edges: NDArray[np.float32], step_px: float, mean_px: Array, variance: Array, gain: Array,
) -> None:  # fmt: skip
    """Posterior mean and variance (px) of the outline's position on every line; variance 0 marks an unusable line.

    Pixels of the bin `skipped` say nothing.
    """
    h, w = bins.shape
    last = hist_f.shape[0] - 1
    n = 2 * HALF_LINE + 1
    p_f = np.empty(n)
    log_p = np.empty(n)
    product = np.empty(n)
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
            if b == skipped:
                continue
            f, g = 0.15 * hist_f[last, b], 0.15 * hist_b[last, b]
            for k in nearest[i]:
                if seen[k] > 0:
                    f += hist_f[k, b]
                    g += hist_b[k, b]
            p_f[j] = (f + 1e-5) / (f + g + 2e-5)
            valid += 1
        if valid < HALF_LINE:
            continue
        # One logarithm of the product: 21 factors above 0.05 are far from underflow.
        product[:] = 1.0
        for j in range(n):
            inside_share, outside_share = INSIDE_SHARE[n - 1 - j :], OUTSIDE_SHARE[n - 1 - j :]
            for d in range(n):
                product[d] *= inside_share[d] * p_f[j] + outside_share[d] * (1.0 - p_f[j])
        top = -1e30
        for d in range(n):
            total = np.log(product[d])
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


@numba.njit(cache=True, nogil=True)
def solve_pose(
    line_point: Array, target: Array, normal: Array, inverse_variance: Array, step_px: float,
    point: Array, pixel: Array, point_weight: Array, point_limit_px: float, camera_matrix: Array,
    T_start: Array, prior: Array, iterations: int, R: Array, t: Array, information: Array,
) -> float:  # fmt: skip
    """Gauss-Newton on SE(3) over lines (N) and points (M); R (3, 3) and t (3,) are moved, turns are about the object.

    Lines that disagree with the rest (occluders, shadows) count less; points off by `point_limit_px` hardly count.
    prior: (6, 6) information of T_start.  information: (6, 6), written, of lines and points, rotation first.
    Returns the lines' own robust cost at the end.
    """
    fx, fy, cx, cy = camera_matrix[0, 0], camera_matrix[1, 1], camera_matrix[0, 2], camera_matrix[1, 2]
    row, gradient = np.empty(6), np.empty(6)
    limit2 = (4.0 * step_px) ** 2
    cost = 0.0
    for iteration in range(iterations + 1):
        information[:] = 0.0
        gradient[:] = 0.0
        cost = 0.0
        for i in range(line_point.shape[0] + 2 * point.shape[0]):
            m = (i - line_point.shape[0]) // 2
            X = line_point[i] if m < 0 else point[m]
            ax = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2]
            ay = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2]
            az = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2]
            x, y, z = ax + t[0], ay + t[1], az + t[2]
            if z < 1e-4:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            if m < 0:
                nx, ny = normal[i, 0], normal[i, 1]
                offset = nx * (target[i, 0] - u) + ny * (target[i, 1] - v)
                square = offset * offset / limit2
                cost += inverse_variance[i] * limit2 * np.log(1.0 + square)
                weight = inverse_variance[i] / (1.0 + square)
            else:
                du, dv = pixel[m, 0] - u, pixel[m, 1] - v
                first = (i - line_point.shape[0]) % 2 == 0
                nx, ny = (1.0, 0.0) if first else (0.0, 1.0)
                offset = du if first else dv
                weight = point_weight[m] / (1.0 + (du * du + dv * dv) / point_limit_px**2) ** 2
            gx, gy = nx * fx / z, ny * fy / z
            gz = -(nx * fx * x + ny * fy * y) / (z * z)
            row[0], row[1], row[2] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
            row[3], row[4], row[5] = gx, gy, gz
            for a in range(6):
                gradient[a] += weight * offset * row[a]
                for b in range(6):
                    information[a, b] += weight * row[a] * row[b]
        if iteration == iterations:
            break
        twist = np.empty(6)
        twist[:3] = _log(R, T_start[:3, :3])
        twist[3:] = t - T_start[:3, 3]
        delta = np.linalg.solve(information + prior, gradient - prior @ twist)
        step = delta[:3]
        R[:] = np.dot(_exp(step[0], step[1], step[2]), R)
        t += delta[3:]
        if np.abs(delta).max() < 1e-6:
            break
    return cost


@numba.njit(cache=True, nogil=True)
def _exp(x: float, y: float, z: float) -> Array:
    """Rotation (3, 3) by a rotation vector."""
    angle = np.sqrt(x * x + y * y + z * z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        small: Array = np.eye(3) + K
        return small
    whole: Array = np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / (angle * angle) * (K @ K)
    return whole


@numba.njit(cache=True, nogil=True)
def _log(R: Array, R_from: Array) -> Array:
    """Rotation vector (3,) of the turn from one rotation to another, by less than half a turn."""
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                turn[i, j] += R[i, k] * R_from[j, k]
    axis: Array = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = np.sqrt(np.sum(axis * axis))
    if sine > 1e-8:
        axis *= np.arctan2(sine, 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)) / sine
    return axis


@numba.njit(cache=True, nogil=True)
def draw_view(
    depth: NDArray[np.float32], x0: int, y0: int, camera_matrix: Array, T_key_camera: Array,
    key_depth: NDArray[np.float32], key_x0: int, key_y0: int, key_picture: NDArray[np.uint8], key_camera: Array,
    drawn: NDArray[np.uint8], covered: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Carry a key view's picture over the mesh into another view: `drawn` (H, W), `covered` 255 where it was.

    depth, key_depth: of the mesh in windows of either picture.  T_key_camera: (4, 4) this camera in the key's frame.
    What the key view did not see, because it lay behind something or out of the picture, stays as it was.
    """
    h, w = drawn.shape
    kh, kw = key_picture.shape
    fx, fy, cx, cy = camera_matrix[0, 0], camera_matrix[1, 1], camera_matrix[0, 2], camera_matrix[1, 2]
    key_fx, key_fy, key_cx, key_cy = key_camera[0, 0], key_camera[1, 1], key_camera[0, 2], key_camera[1, 2]
    # Numbers of its own each: those in arrays would be read again for every pixel.
    xx, xy, xz, tx = T_key_camera[0, 0], T_key_camera[0, 1], T_key_camera[0, 2], T_key_camera[0, 3]
    yx, yy, yz, ty = T_key_camera[1, 0], T_key_camera[1, 1], T_key_camera[1, 2], T_key_camera[1, 3]
    zx, zy, zz, tz = T_key_camera[2, 0], T_key_camera[2, 1], T_key_camera[2, 2], T_key_camera[2, 3]
    across = np.empty(depth.shape[1])
    for i in range(depth.shape[1]):
        across[i] = (i + x0 - cx) / fx
    for j in range(max(0, -y0), min(depth.shape[0], h - y0)):
        y = j + y0
        down = (y - cy) / fy
        for i in range(max(0, -x0), min(depth.shape[1], w - x0)):
            x, z = i + x0, float(depth[j, i])
            if z <= 0.0:
                continue
            px, py = across[i] * z, down * z
            qz = zx * px + zy * py + zz * z + tz
            if qz < 1e-4:
                continue
            u = key_fx * (xx * px + xy * py + xz * z + tx) / qz + key_cx
            v = key_fy * (yx * px + yy * py + yz * z + ty) / qz + key_cy
            a, b = int(np.floor(u)), int(np.floor(v))
            if a < 0 or b < 0 or a + 1 >= kw or b + 1 >= kh:
                continue
            c, d = int(np.floor(u + 0.5)) - key_x0, int(np.floor(v + 0.5)) - key_y0
            if c < 0 or d < 0 or c >= key_depth.shape[1] or d >= key_depth.shape[0]:
                continue
            if abs(key_depth[d, c] - qz) > HIDDEN * qz:
                continue
            s, t = u - a, v - b
            top = (1.0 - s) * key_picture[b, a] + s * key_picture[b, a + 1]
            bottom = (1.0 - s) * key_picture[b + 1, a] + s * key_picture[b + 1, a + 1]
            drawn[y, x] = np.uint8((1.0 - t) * top + t * bottom + 0.5)
            covered[y, x] = 255
