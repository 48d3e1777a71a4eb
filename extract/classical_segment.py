"""Objects in a picture and through a video without learned models: regions with clear outlines, GrabCut, and flow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .protocols import Box, Image, Mask, Proposal
from .region_tree import likely_regions
from .segment import mask_box, mask_from_box, mask_from_silhouette

WORK_SIDE_PX = 640
MOST = 10  # proposals of a picture
RECUT_EVERY, RECUT_BAND_PX = 3, 5


@dataclass(frozen=True)
class ClassicalSegmenter:
    """`Segmenter` by GrabCut and dense optical flow."""

    name: str = "classical-2"

    def propose(self, rgb: Image, prompt: str = "objects.") -> list[Proposal]:
        """The regions of `region_tree` that are likeliest objects, likeliest first; the prompt is not read."""
        height, width = rgb.shape[:2]
        scale = min(1.0, WORK_SIDE_PX / max(height, width))
        small = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        found = []
        for region in likely_regions(small, MOST):
            whole = cv2.resize(region.mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
            found.append(Proposal(np.asarray(whole), mask_box(whole), region.score))
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
