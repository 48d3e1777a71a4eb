"""What perception asks of its parts, whoever does the work: the seams between the method and its models.

Each part has a classical implementation, which needs no download, and a foundation one, which needs weights. Both are
plain classes that fit these protocols; nothing inherits. Pictures are (H, W, 3) uint8 RGB, pixel centres lie at integer
coordinates, boxes are (x, y, width, height) in px, masks are (H, W) bool.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Box = tuple[float, float, float, float]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Proposal:
    """Something in a picture that may be an object.

    mask: (H, W) bool, its visible pixels.  box_xywh_px: around it (the detector's, which may reach beyond the mask).
    score: in [0, 1].  label: what the detector calls it; empty when it does not say.
    """

    mask: Mask
    box_xywh_px: Box
    score: float
    label: str = ""


@dataclass(frozen=True)
class PatchGrid:
    """Features of B crops.

    patches: (B, G, G, D) float32, rows first, not normalised.  summary: (B, E) float32, one descriptor of the whole
    crop (a class token or its like), not normalised.
    """

    patches: Floats
    summary: Floats


@runtime_checkable
class PatchFeatures(Protocol):
    """Turns square crops into a grid of features and one summary.

    name: model, layer and whatever else changes the numbers; it is a part of the address of everything stored.
    crop_px: side S of the crops it takes.  grid: G, patches along a side.  patch_size: D.  summary_size: E.
    """

    @property
    def name(self) -> str: ...

    @property
    def crop_px(self) -> int: ...

    @property
    def grid(self) -> int: ...

    @property
    def patch_size(self) -> int: ...

    @property
    def summary_size(self) -> int: ...

    def encode(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> PatchGrid:
        """Features of crops (B, S, S, 3) uint8 RGB, whose background is black where the caller wants it masked.

        masks: (B, S, S) bool, the object; a neural encoder need not look at it.
        """
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Finds objects in a picture, cuts them out, and carries masks through a video."""

    @property
    def name(self) -> str: ...

    def propose(self, rgb: Image, prompt: str = "objects.") -> list[Proposal]:
        """Objects of a picture, best first. `prompt` is for detectors that read; others ignore it."""
        ...

    def segment(self, rgb: Image, boxes_xywh_px: Sequence[Box]) -> list[Mask]:
        """(H, W) mask of the object in each box."""
        ...

    def propagate(self, frames: Iterable[Image], masks: Sequence[Mask]) -> Iterator[NDArray[np.bool_]]:
        """(K, H, W) masks of K objects in every frame, the first one included; `masks` are those of the first.

        An object that is out of view has an empty mask there and is kept.
        """
        ...


@runtime_checkable
class DepthEstimator(Protocol):
    """Depth from one picture."""

    @property
    def name(self) -> str: ...

    def estimate(self, rgb: Image, camera_matrix: NDArray[np.float64] | None = None) -> Floats:
        """(H, W) depth along the camera's z in m, finite and positive; right up to a common factor is enough."""
        ...


@runtime_checkable
class TextImageEncoder(Protocol):
    """Puts words and pictures into one space."""

    @property
    def name(self) -> str: ...

    @property
    def size(self) -> int: ...

    def encode_texts(self, texts: Sequence[str]) -> Floats:
        """(N, size) unit vectors."""
        ...

    def encode_images(self, images: Sequence[Image]) -> Floats:
        """(N, size) unit vectors of pictures of any size; background is black where the caller wants it masked."""
        ...


@dataclass(frozen=True)
class PointTracks:
    """Points followed through N frames.

    pixels_px: (N, P, 2) float32, x and y.  visible: (N, P) bool.  confidence: (N, P) float32 in [0, 1].
    """

    pixels_px: Floats
    visible: NDArray[np.bool_]
    confidence: Floats


@runtime_checkable
class PointTracker(Protocol):
    """Follows points through a video."""

    @property
    def name(self) -> str: ...

    def track(self, frames: NDArray[np.uint8], frame_index: NDArray[np.int64], pixels_px: Floats) -> PointTracks:
        """Follow points (P, 2), each given in the frame `frame_index` (P,), through frames (N, H, W, 3), both ways."""
        ...
