"""What is held at the end of an arm: what moves, less the arm by its colours where it comes in, less the hand.

Nothing is learned beforehand: the colours of the sleeve are those of what moves at the picture's border, and the hand's
those met first beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .background import FOREGROUND
from .segment import Mask
from .video import Image

SIDE_PX = 320
LEVELS = 24
SLEEVE_REACH = 0.45  # of the way to the farthest point: sleeve, whatever is held
HAND_BAND = 0.06  # of the picture's longer side, beyond the sleeve's end: hand
ALIKE = 0.6  # how much likelier a colour must be the arm's than the rest's
LEAST_PART, LEAST_SHARE, MOST_SHARE = 0.08, 0.002, 0.3  # of the largest part; of the picture


@dataclass(frozen=True)
class Handled:
    """Masks (H, W) of what is held, without what the hand hides of it, and of hand and arm."""

    thing: Mask
    arm: Mask


def find_handled(rgb: Image, labels: NDArray[np.uint8]) -> Handled | None:
    """What is held in a picture whose `labels` come from a `Background`; None when no arm comes in or holds nothing."""
    scale = min(1.0, SIDE_PX / max(rgb.shape[:2]))
    size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    moving = cv2.resize((labels == FOREGROUND).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    moving = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    reach = reach_from_border(moving)
    joined = (reach > 0) & (reach < reach.max()) if reach.any() else reach > 0
    if not joined.any():
        return None
    code = _codes(np.asarray(small, np.uint8))
    far = float(np.percentile(reach[joined], 99))
    sleeve = _grown(joined & (reach < SLEEVE_REACH * far), moving, code)
    band = cv2.dilate(sleeve.astype(np.uint8), _disc(HAND_BAND * max(size))) > 0
    hand = _grown(moving & band & ~sleeve, moving & ~sleeve, code)
    arm = sleeve | hand
    thing = _parts(moving & ~arm)
    share = float(thing.mean())
    if not LEAST_SHARE < share < MOST_SHARE:
        return None
    full = (rgb.shape[1], rgb.shape[0])
    return Handled(
        *(cv2.resize(m.astype(np.float32), full, interpolation=cv2.INTER_LINEAR) > 0.5 for m in (thing, arm))
    )


def reach_from_border(moving: Mask) -> NDArray[np.int32]:
    """(H, W) how far into the picture moving things reach: steps from its border through what moves, 0 elsewhere.

    What touches nothing that comes in from the border counts as farther than all that does.
    """
    inside = moving.astype(np.uint8)
    front = np.zeros_like(inside)
    front[:2], front[-2:], front[:, :2], front[:, -2:] = inside[:2], inside[-2:], inside[:, :2], inside[:, -2:]
    reach, seen, step = np.zeros(moving.shape, np.int32), front.copy(), 1
    while front.any():
        reach[front > 0] = step
        step += 1
        grown = np.asarray(cv2.dilate(seen, np.ones((3, 3), np.uint8)), np.uint8) & inside
        front, seen = grown & ~seen, grown
    reach[(inside > 0) & (reach == 0)] = step
    return reach


def _grown(seed: Mask, within: Mask, code: NDArray[np.int32]) -> Mask:
    """The seed and all of `within` that joins it and is coloured more as the seed than as the rest."""
    if not seed.any():
        return seed
    ours, rest = (_histogram(code[m]) for m in (seed, within & ~seed))
    alike = within & ((ours / (ours + rest + 1e-9))[code] > ALIKE)
    closed = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    alike = (np.asarray(closed) > 0) & within
    _, part = cv2.connectedComponents((alike | seed).astype(np.uint8), connectivity=4)
    joined = np.unique(part[seed & alike])
    return np.asarray(np.isin(part, joined[joined > 0]) & alike)


def _parts(mask: Mask) -> Mask:
    """The largest part of a mask and those that are not much smaller: a hand may divide what it holds."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, part, stats, _ = cv2.connectedComponentsWithStats(opened)
    if count < 2:
        return np.zeros_like(mask)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(part, 1 + np.flatnonzero(areas >= LEAST_PART * areas.max()))


def _codes(rgb: Image) -> NDArray[np.int32]:
    cells = (cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.int32) * LEVELS) // 256
    return np.asarray((cells[..., 0] * LEVELS + cells[..., 1]) * LEVELS + cells[..., 2], np.int32)


def _histogram(code: NDArray[np.int32]) -> NDArray[np.float64]:
    counts = np.bincount(code, minlength=LEVELS**3).astype(float).reshape(LEVELS, LEVELS, LEVELS)
    smooth = gaussian_filter(counts, 0.7).ravel()
    return np.asarray(smooth / max(smooth.sum(), 1e-9))


def _disc(radius_px: float) -> NDArray[np.uint8]:
    side = 2 * max(1, round(radius_px)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
