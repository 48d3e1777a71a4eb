"""Points followed without a network: pyramidal Lucas-Kanade flow, from frame to frame, checked by going back again.

A point whose way back does not end where it came from is lost, and stays so (Kalal et al., 2010).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .protocols import Floats, PointTracks

BACK_AND_FORTH_PX = 0.7
FLOW: dict[str, Any] = {
    "winSize": (17, 17),
    "maxLevel": 3,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
}


@dataclass(frozen=True)
class ClassicalTracks:
    """`PointTracker` by OpenCV."""

    name: str = "classical-1"

    def track(self, frames: NDArray[np.uint8], frame_index: NDArray[np.int64], pixels_px: Floats) -> PointTracks:
        """Follow points (P, 2), each given in frame `frame_index` (P,), through frames (N, H, W, 3), both ways."""
        count, points = len(frames), len(pixels_px)
        pixels = np.zeros((count, points, 2), np.float32)
        confidence = np.zeros((count, points), np.float32)
        greys = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
        own = np.arange(points)
        pixels[frame_index, own] = pixels_px
        confidence[frame_index, own] = 1.0
        for step in (1, -1):
            order = range(count - 1) if step > 0 else range(count - 1, 0, -1)
            for k in order:
                begun = frame_index <= k if step > 0 else frame_index >= k
                at = np.flatnonzero(begun)
                if not len(at):
                    continue
                there, sure = moved_points(greys[k], greys[k + step], pixels[k, at])
                pixels[k + step, at] = there
                confidence[k + step, at] = np.minimum(confidence[k, at], sure)
        return PointTracks(pixels, confidence > 0, confidence)


def moved_points(before: NDArray[Any], after: NDArray[Any], pixels: Floats) -> tuple[Floats, Floats]:
    """Where points (P, 2) went, and how sure that is, (P,): 1 where the way back ends at its start."""
    start = np.ascontiguousarray(pixels[:, None])
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start.copy(), **FLOW)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy(), **FLOW)
    gap = np.linalg.norm((back - start)[:, 0], axis=1)
    height, width = before.shape
    inside = np.all((there[:, 0] >= 0) & (there[:, 0] <= (width - 1, height - 1)), axis=1)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0) & inside
    sure = np.where(good, np.maximum(0.0, 1.0 - gap / BACK_AND_FORTH_PX), 0.0)
    return np.asarray(there[:, 0], np.float32), sure.astype(np.float32)
