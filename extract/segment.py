"""Object masks without learned models: GrabCut from a box, and again from a silhouette that is nearly right."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .errors import UserError
from .video import Image

LAB_WEIGHTS = (0.7, 3.0, 3.0)
CLOSING = 0.02  # of the box: gaps that highlights cut into shiny objects

Mask = NDArray[np.bool_]
Box = tuple[float, float, float, float]  # x, y, width, height in px


def check_box(box_xywh_px: Box, width_px: int, height_px: int, source: str = "--box") -> Box:
    """The part of a box inside the image. Raises UserError when less than 8 x 8 px of it are."""
    x, y, w, h = box_xywh_px
    x_a, y_a = max(x, 0.0), max(y, 0.0)
    x_b, y_b = min(x + w, float(width_px)), min(y + h, float(height_px))
    if not (x_b - x_a >= 8 and y_b - y_a >= 8):  # written so that what is no number is refused as well
        raise UserError(
            f"{source} {x:g} {y:g} {w:g} {h:g} has less than 8 x 8 px inside the {width_px} x {height_px} image; "
            "give it as X Y WIDTH HEIGHT in pixels of the first frame"
        )
    return x_a, y_a, x_b - x_a, y_b - y_a


def mask_from_box(rgb: Image, box_xywh_px: Box, iterations: int = 5) -> Mask:
    """(H, W) mask of what differs in colour from the surroundings of the box.

    Everything outside the box is background. When GrabCut finds nothing, the box's inscribed ellipse is returned.
    """
    height, width = rgb.shape[:2]
    x, y, w, h = (round(v) for v in check_box(box_xywh_px, width, height))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    inner = labels[y : y + h, x : x + w]
    inner[:] = np.where(_rare_outside(rgb, (x, y, w, h)), cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    mask = _grabcut(rgb, labels, (x, y, w, h), iterations)
    mask = _largest_part(_closed(mask, max(1, round(CLOSING * max(w, h)))))
    if mask.sum() < 0.05 * w * h:
        ellipse = np.zeros((height, width), np.uint8)
        cv2.ellipse(ellipse, (x + w // 2, y + h // 2), (w // 2, h // 2), 0, 0, 360, 1, -1)
        mask = ellipse > 0
    return mask


def mask_from_silhouette(rgb: Image, silhouette: Mask, band_px: int, iterations: int = 3) -> Mask:
    """Re-cut a mask near a silhouette: sure inside and outside, undecided within `band_px` of its outline.

    Thin parts have no sure inside, so that they may be found to lie elsewhere in the band.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band_px + 1, 2 * band_px + 1))
    filled = silhouette.astype(np.uint8)
    inner, outer = cv2.erode(filled, kernel), cv2.dilate(filled, kernel)
    labels = np.full(rgb.shape[:2], cv2.GC_BGD, np.uint8)
    labels[outer > 0] = cv2.GC_PR_BGD
    labels[silhouette] = cv2.GC_PR_FGD
    labels[inner > 0] = cv2.GC_FGD
    if not silhouette.any():
        return silhouette
    x, y, w, h = (int(side) for side in mask_box(outer > 0))
    return _grabcut(rgb, labels, (x, y, w, h), iterations)


def mask_box(mask: Mask) -> Box:
    """Bounding box x, y, width, height of a mask that is not empty."""
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return float(xs[0]), float(ys[0]), float(np.ptp(xs) + 1), float(np.ptp(ys) + 1)


def box_iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes, in [0, 1]."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / (a[2] * a[3] + b[2] * b[3] - shared)


def _rare_outside(rgb: Image, box: tuple[int, int, int, int]) -> Mask:
    """(h, w) pixels of the box whose colours are rare in the ring around it, by smoothed Lab histograms."""
    height, width = rgb.shape[:2]
    x, y, w, h = box
    margin = max(w, h) // 3 + 4
    x_a, y_a = max(x - margin, 0), max(y - margin, 0)
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)[y_a : min(y + h + margin, height), x_a : min(x + w + margin, width)]
    inside = np.zeros(lab.shape[:2], bool)
    inside[y - y_a : y - y_a + h, x - x_a : x - x_a + w] = True
    sides, limits = [24, 24, 24], [0.0, 256.0] * 3
    histograms = []
    for part in (inside, ~inside):
        counts = cv2.calcHist([lab], [0, 1, 2], part.astype(np.uint8), sides, limits)
        histograms.append(gaussian_filter(counts, 0.7) / max(int(part.sum()), 1))
    if inside.all():
        return np.ones((h, w), bool)
    share = histograms[0] / (histograms[0] + histograms[1] + 1e-9)
    cell = tuple((lab[inside].reshape(h, w, 3) * (24 / 256)).astype(int).transpose(2, 0, 1))
    return np.asarray(share[cell] > 0.6)


def _closed(mask: Mask, radius_px: int) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))
    padded = np.pad(mask.astype(np.uint8), radius_px)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)
    return np.asarray(closed[radius_px:-radius_px, radius_px:-radius_px] > 0)


def _largest_part(mask: Mask) -> Mask:
    """The largest connected part of a mask, with every other part at least a fiftieth as large; small holes filled."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return mask
    areas = stats[1:, cv2.CC_STAT_AREA]
    kept = np.isin(parts, 1 + np.flatnonzero(areas >= 0.02 * areas.max()))
    _, holes, hole_stats, _ = cv2.connectedComponentsWithStats((~kept).astype(np.uint8))
    small = np.flatnonzero(hole_stats[:, cv2.CC_STAT_AREA] < 0.02 * areas.max())
    return np.asarray(kept | (np.isin(holes, small) & ~kept))


def _grabcut(rgb: Image, labels: NDArray[np.uint8], box: tuple[int, int, int, int], iterations: int) -> Mask:
    """GrabCut in the box and a surrounding margin; colours far away say nothing about this object."""
    height, width = labels.shape
    x, y, w, h = box
    margin = max(w, h) // 3 + 4
    window = np.s_[max(y - margin, 0) : min(y + h + margin, height), max(x - margin, 0) : min(x + w + margin, width)]
    part = np.ascontiguousarray(labels[window])
    probable = (part == cv2.GC_PR_FGD) | (part == cv2.GC_FGD)
    result = np.zeros((height, width), bool)
    if not probable.any() or probable.all():
        result[window] = probable
        return result
    cv2.setRNGSeed(0)  # GrabCut seeds its colour clusters from OpenCV's global generator
    models = np.zeros((1, 65)), np.zeros((1, 65))
    # Hues count more than brightness, which shading and shadows change.
    lab = cv2.cvtColor(np.ascontiguousarray(rgb[window]), cv2.COLOR_RGB2LAB).astype(np.float32)
    lab = np.clip((lab - [0, 128, 128]) * LAB_WEIGHTS + [0, 128, 128], 0, 255)
    image = np.ascontiguousarray(lab, np.uint8)
    cv2.grabCut(image, part, (0, 0, 1, 1), *models, iterations, cv2.GC_INIT_WITH_MASK)
    result[window] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return result
