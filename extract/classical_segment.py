"""Objects in a picture and through a video without learned models: what differs in colour from the border, and flow.

Good for things that stand apart on a table. Things that touch come out as one; boxes by hand or a network part them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .protocols import Box, Image, Mask, Proposal
from .segment import mask_box, mask_from_box, mask_from_silhouette

BORDER, SMALLEST, LARGEST = 0.04, 0.001, 0.5  # of a side; of the picture's area
BINS, RARE = 24, 0.9  # of Lab's axes; share of the pixels of a colour, evened out for area, that lie inside
WORK_SIDE_PX = 640
RECUT_EVERY, RECUT_BAND_PX = 3, 5
GAP_PX = 3  # between parts of one object, such as where a thin handle was lost


@dataclass(frozen=True)
class ClassicalSegmenter:
    """`Segmenter` by GrabCut and dense optical flow."""

    name: str = "classical-1"

    def propose(self, rgb: Image, prompt: str = "objects.") -> list[Proposal]:
        """Blobs that the colours of the picture's border do not explain, largest first; the prompt is not read.

        score: the share of a blob's convex hull that it fills, for shadows and leftovers are ragged.
        """
        height, width = rgb.shape[:2]
        scale = min(1.0, WORK_SIDE_PX / max(height, width))
        small = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        if min(small.shape[:2]) < 16:
            return []
        unlike = _unlike_border(small)
        if unlike.any():
            unlike = mask_from_silhouette(small, unlike, RECUT_BAND_PX)
        blobs = cv2.morphologyEx(unlike.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
        _, parts, stats, _ = cv2.connectedComponentsWithStats(blobs)
        areas = stats[:, cv2.CC_STAT_AREA] / blobs.size
        found = []
        for part in 1 + np.argsort(-areas[1:], kind="stable"):
            if not SMALLEST < areas[part] < LARGEST:
                continue
            mask = np.asarray(parts == part)
            whole = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR) > 0
            found.append(Proposal(np.asarray(whole), mask_box(whole), _solidity(mask)))
        return found

    def segment(self, rgb: Image, boxes_xywh_px: Sequence[Box]) -> list[Mask]:
        """What differs in each box from the surroundings of the box."""
        return [mask_from_box(rgb, box) for box in boxes_xywh_px]

    def propagate(self, frames: Iterable[Image], masks: Sequence[Mask]) -> Iterator[NDArray[np.bool_]]:
        """Masks carried by optical flow and cut anew every few frames; one that has gone stays empty."""
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        current, before = np.stack(masks), None
        for index, rgb in enumerate(frames):
            grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
            if before is not None:
                back = flow.calc(grey, before, np.zeros((*grey.shape, 2), np.float32))
                rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float32)
                at = columns + back[..., 0], rows + back[..., 1]
                moved = [cv2.remap(mask.astype(np.uint8), *at, cv2.INTER_NEAREST) > 0 for mask in current]
                if index % RECUT_EVERY == 0:
                    moved = [mask_from_silhouette(rgb, m, RECUT_BAND_PX) if m.any() else m for m in moved]
                current = np.stack(moved)
            before = grey
            yield current.copy()


def _unlike_border(rgb: Image) -> Mask:
    """(H, W) what has colours that are RARE in the picture's border, by smoothed histograms, without specks."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    edge = min(max(2, round(BORDER * max(rgb.shape[:2]))), min(rgb.shape[:2]) // 4)
    inside = np.zeros(rgb.shape[:2], np.uint8)
    inside[edge:-edge, edge:-edge] = 1
    shares = []
    for part in (inside, 1 - inside):
        counts = cv2.calcHist([lab], [0, 1, 2], part, [BINS] * 3, [0.0, 256.0] * 3)
        shares.append(gaussian_filter(counts, 0.7) / int(part.sum()))
    cell = tuple((lab * (BINS / 256)).astype(int).transpose(2, 0, 1))
    rare = (shares[0] / (shares[0] + shares[1] + 1e-9))[cell] > RARE
    return np.asarray(cv2.medianBlur(rare.astype(np.uint8) & inside, 3) > 0)


def _solidity(mask: Mask) -> float:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.contourArea(cv2.convexHull(np.concatenate(contours)))
    return float(min(np.count_nonzero(mask) / max(hull, 1.0), 1.0))
