"""Colours of an object and of what lies around it: histogram bins of pixels, and which of them speak for what.

One bin, HIDDEN_BIN, is of pixels that say nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .region_kernels import count_bins, hide_bins, smooth_histogram
from .video import Image

BITS = 4  # colour resolution per channel of the local histograms
CHROMA_STEP = 4  # of Lab's a and b, in a bin
BINS = 1 << (3 * BITS)
HIDDEN_BIN = BINS - 1  # bright, red and yellow at once: no colour is; of pixels that say nothing
LEAST_ODDS = 0.4  # of the object's colours against those of a hand, of what is not taken for a hand
HIDING_RATE = 0.1
LOCAL_CENTRES = 48
MASK_LEVELS = 11  # of trust in a mask
OURS_ODDS, SPILL_REACH = 0.7, 0.5  # log-odds of the object's colours; how far from a silhouette, of its root area


class ColourModel:
    """Foreground and background colour histograms, global and around every centre of the mesh."""

    def __init__(self) -> None:
        self.foreground = np.zeros((LOCAL_CENTRES + 1, BINS), np.float32)
        self.background = np.zeros((LOCAL_CENTRES + 1, BINS), np.float32)
        self.seen = np.zeros(LOCAL_CENTRES + 1, np.float32)
        self.hiding: NDArray[np.float32] = np.zeros(BINS, np.float32)

    def copy(self) -> ColourModel:
        """The model as it is now."""
        twin = ColourModel()
        twin.foreground, twin.background, twin.seen = self.foreground.copy(), self.background.copy(), self.seen.copy()
        twin.hiding = self.hiding.copy()
        return twin

    def everywhere(self) -> ColourModel:
        """The colours of the object as a whole, without those around points of one mesh."""
        whole = ColourModel()
        whole.foreground[-1], whole.background[-1] = self.foreground[-1], self.background[-1]
        whole.seen[-1], whole.hiding = 1.0, self.hiding
        return whole

    def start_global(self, foreground: NDArray[np.int32], background: NDArray[np.int32]) -> None:
        """Set the global histograms (row LOCAL_CENTRES) from colour bins of labelled pixels."""
        for histogram, bins in ((self.foreground, foreground), (self.background, background)):
            histogram[-1] = np.bincount(bins, minlength=BINS)
            smooth_histogram(histogram[-1], 1 << BITS)
        self.seen[-1] = 1.0

    def start_hiding(self, bins: NDArray[np.int32]) -> None:
        """Set the colours of what may hide the object, a hand, from colour bins of pixels that show it."""
        if len(bins):
            self.hiding = np.bincount(bins, minlength=BINS).astype(np.float32)
            smooth_histogram(self.hiding, 1 << BITS)

    def hides(self, bins: NDArray[np.int32], covered: NDArray[np.bool_], odds: float) -> NDArray[np.bool_]:
        """(H, W) which of the pixels that stand before the background show something else than the object.

        That is, whose colours are less than `odds` times as likely the object's as those of what may hide it.
        """
        return np.asarray(covered & self._alien(odds)[bins])

    def _alien(self, odds: float) -> NDArray[np.bool_]:
        """(BINS,) which colours are less than `odds` times as likely the object's as those of what may hide it."""
        return np.asarray(self.foreground[-1] + 1e-5 < odds * (self.hiding + 1e-5))

    def hide(self, bins: NDArray[np.int32], covered: NDArray[np.bool_]) -> None:
        """Blank in `bins` (H, W) what hides the object.

        Whether the object goes on behind it is not known, so that it must not speak for the background.
        """
        fresh = np.zeros(BINS, np.float32)
        hide_bins(bins, covered, self._alien(LEAST_ODDS), HIDDEN_BIN, fresh)
        if fresh.any():
            smooth_histogram(fresh, 1 << BITS)
            self.hiding += HIDING_RATE * (fresh - self.hiding)


def spilled_share(silhouette: NDArray[np.bool_], evidence: NDArray[np.float32], hidden: NDArray[np.bool_]) -> float:
    """How much of the object's colours goes on beyond a silhouette without a gap, as a share of the silhouette.

    All are (H, W).  evidence: log-odds that a pixel shows the object.  hidden: where something stands before it.
    """
    ours = (evidence > OURS_ODDS) & ~hidden
    reach_px = round(SPILL_REACH * float(np.sqrt(silhouette.sum())))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1, 2 * reach_px + 1))
    ours &= cv2.dilate(silhouette.astype(np.uint8), disc) > 0
    _, part = cv2.connectedComponents((ours | silhouette).astype(np.uint8))
    beyond = ours & np.isin(part, np.unique(part[silhouette]))
    beyond &= cv2.dilate(silhouette.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0  # colours mix along the rim
    return float(beyond.sum() / max(silhouette.sum(), 1))


def mask_evidence(
    mask: NDArray[np.bool_], trust: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.int32], ColourModel]:
    """A mask in the form of an image of few colours and their model, so that poses can be refined against it.

    The model trusts the mask to four in five at most, so that a wrong stretch of it does not outvote the rest, and
    less where `trust` (H, W), in [0, 1], is less.
    """
    levels = np.linspace(0, 1, MASK_LEVELS)
    share = np.concatenate([0.5 - 0.3 * levels, 0.5 + 0.3 * levels])
    colours = ColourModel()
    colours.foreground[-1, : len(share)], colours.background[-1, : len(share)] = share, 1 - share
    colours.seen[-1] = 1.0
    level = MASK_LEVELS - 1 if trust is None else np.round(trust * (MASK_LEVELS - 1)).astype(np.int32)
    return np.asarray(mask * MASK_LEVELS + level, np.int32), colours


def colour_bins(rgb: Image) -> NDArray[np.int32]:
    """(H, W) histogram bin of every pixel."""
    bins = np.empty(rgb.shape[:2], np.int32)
    count_bins(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.uint8), BITS, CHROMA_STEP, bins)
    return bins
