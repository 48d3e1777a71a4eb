"""Object masks without learned models: GrabCut from a box, and again from a silhouette that is nearly right."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .video import Image

Mask = NDArray[np.bool_]
Box = tuple[float, float, float, float]  # x, y, width, height in px


def check_box(box_xywh_px: Box, width_px: int, height_px: int, source: str = "--box") -> Box:
    """The part of a box inside the image. Raises UserError when less than 8 x 8 px of it are."""
    x, y, w, h = box_xywh_px
    x_a, y_a = max(x, 0.0), max(y, 0.0)
    x_b, y_b = min(x + w, float(width_px)), min(y + h, float(height_px))
    if x_b - x_a < 8 or y_b - y_a < 8:
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
    labels[y : y + h, x : x + w] = cv2.GC_PR_FGD
    mask = _grabcut(rgb, labels, (x, y, w, h), iterations)
    if mask.sum() < 0.02 * w * h:
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
    ys, xs = np.nonzero(outer)
    if len(xs) == 0:
        return silhouette
    box = (int(xs.min()), int(ys.min()), int(np.ptp(xs)) + 1, int(np.ptp(ys)) + 1)
    return _grabcut(rgb, labels, box, iterations)


def mask_box(mask: Mask) -> Box:
    """Bounding box x, y, width, height of a mask that is not empty."""
    ys, xs = np.nonzero(mask)
    return float(xs.min()), float(ys.min()), float(np.ptp(xs) + 1), float(np.ptp(ys) + 1)


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
    image = np.ascontiguousarray(rgb[window][..., ::-1])
    cv2.grabCut(image, part, (0, 0, 1, 1), *models, iterations, cv2.GC_INIT_WITH_MASK)
    result[window] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return result
