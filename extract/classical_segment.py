"""Objects in a picture and through a video without learned models: what differs in colour from the border, and flow.

Good for things that stand apart on a table. Things that touch come out as one; boxes by hand or a network part them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .protocols import Box, Image, Mask, Proposal
from .segment import mask_box, mask_from_box, mask_from_silhouette

BORDER, SMALLEST, LARGEST = 0.04, 0.001, 0.3  # of a side; of the picture's area
WORK_SIDE_PX = 640
RECUT_EVERY, RECUT_BAND_PX = 3, 5


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
        small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        h, w = small.shape[:2]
        inner = (BORDER * w, BORDER * h, (1 - 2 * BORDER) * w, (1 - 2 * BORDER) * h)
        if min(inner[2:]) < 8:
            return []
        unlike = mask_from_box(np.asarray(small, np.uint8), inner, iterations=3)
        blobs = cv2.morphologyEx(unlike.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        _, parts, stats, _ = cv2.connectedComponentsWithStats(blobs)
        areas = stats[:, cv2.CC_STAT_AREA] / (h * w)
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


def _solidity(mask: Mask) -> float:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.contourArea(cv2.convexHull(np.concatenate(contours)))
    return float(min(np.count_nonzero(mask) / max(hull, 1.0), 1.0))
