"""What a small depth camera makes of exact depth: noise that grows with distance, holes, whole millimetres."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

NOISE_M, NOISE_PER_M = 0.0010, 0.0019  # standard deviation near by, and with distance squared (Khoshelham 2012)
PATCH_PX = 2.0  # over which errors are alike
FARTHEST_M = 5.0
JUMP_M = 0.02  # beside which one of the two eyes is blind
BLIND_SHARE = 0.6  # of the pixels there
BLOTCHES, BLOTCH_PX = 12, (3, 14)  # without reading, in every picture, and their size


def sensed_depth(exact_m: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
    """(H, W) depth in mm as a sensor gives it, 0 where it sees nothing, from exact depth (H, W) in m."""
    noise = cv2.GaussianBlur(rng.standard_normal(exact_m.shape).astype(np.float32), (0, 0), PATCH_PX)
    sigma_m = NOISE_M + NOISE_PER_M * exact_m**2
    depth = exact_m + sigma_m * noise / max(float(noise.std()), 1e-9)
    kernel = np.ones((3, 3), np.uint8)
    jump = np.asarray(cv2.dilate(exact_m, kernel) - cv2.erode(exact_m, kernel)) > JUMP_M
    patchy = np.asarray(cv2.GaussianBlur(rng.random(exact_m.shape).astype(np.float32), (0, 0), 1.0), float)
    near_jump = np.asarray(cv2.dilate(jump.astype(np.uint8), kernel)) > 0
    hole = near_jump & (patchy < float(np.quantile(patchy, BLIND_SHARE)))
    blotch = np.zeros(exact_m.shape, np.uint8)
    height, width = exact_m.shape
    for x, y, radius in rng.integers([0, 0, BLOTCH_PX[0]], [width, height, BLOTCH_PX[1]], (BLOTCHES, 3)):
        cv2.circle(blotch, (int(x), int(y)), int(radius), 1, -1)
    hole |= (blotch > 0) | (exact_m <= 0) | (exact_m > FARTHEST_M)
    return np.where(hole, 0, np.rint(depth * 1000)).astype(np.uint16)
