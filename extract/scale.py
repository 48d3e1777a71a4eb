"""How large the objects of a scene are (FreePose, section 3.3 and appendix A.3): the table says how large such things
usually are, depth says how large they are compared with each other, and the median over the scene reconciles the two.

r_i is the largest side of object i in the depth's own unit, m_i what the table says in metres, rho = median(m_i / r_i),
and s_i = rho r_i. All sizes here are largest FULL extents; the reference code's are halves.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .files import atomic_path
from .geometry import Array
from .protocols import Box, Floats, Image, Mask, TextImageEncoder
from .size_table import SizeTable, own_table, prompt
from .templates import crop_picture

RIM_PX = 8
LEAST_PX = 25
TRIM_SIGMAS = 1.5
NEIGHBOURS = 11  # K
WORD_CROP_PX, WORD_EXTEND = 224, 0.05
LEAST_SIZE_M = 0.01


@dataclass(frozen=True)
class SizeGuess:
    """What the table says of one object: its usual size, and the phrases that it was read from."""

    size_m: float
    phrases: tuple[str, ...]
    source: str


@dataclass(frozen=True)
class SceneSizes:
    """Sizes of K objects.

    sizes_m: (K,) largest full extents [m].  ratio: rho, metres in a unit of the depth; NaN where depth had no say.
    measured: (K,) r_i in the depth's unit, NaN where an object shows too little.
    """

    sizes_m: Array
    ratio: float
    measured: Array


def scene_sizes(
    depth: Floats, masks: Sequence[Mask], camera_matrix: Array, guesses_m: Sequence[float], rim_px: int = RIM_PX
) -> SceneSizes:
    """Sizes of the objects of one frame.

    depth: (H, W) along the camera's z, right up to a factor.  masks: of K objects.  camera_matrix: (3, 3) [px].
    guesses_m: (K,) what the table says. An object alone in the scene, or without depth, has the size of the table.
    rim_px: what is taken off the masks; 0 suits depth without bleeding, such as a sensor's or a renderer's.
    """
    guesses = np.asarray(guesses_m, float)
    measured = np.array([measured_size(depth, mask, camera_matrix, rim_px) for mask in masks])
    seen = np.isfinite(measured)
    if np.count_nonzero(seen) < 2:
        return SceneSizes(np.maximum(guesses, LEAST_SIZE_M), float("nan"), measured)
    ratio = float(np.median(guesses[seen] / measured[seen]))
    sizes = np.where(seen, measured * ratio, guesses)
    return SceneSizes(np.maximum(sizes, LEAST_SIZE_M), ratio, measured)


def measured_size(depth: Floats, mask: Mask, camera_matrix: Array, rim_px: int = RIM_PX) -> float:
    """Largest side, in the depth's unit, of the box along the principal axes of an object's points; NaN if too few."""
    points = object_points(depth, mask, camera_matrix, rim_px)
    return float("nan") if len(points) < LEAST_PX else float(principal_extents(points)[0])


def object_points(depth: Floats, mask: Mask, camera_matrix: Array, rim_px: int = RIM_PX) -> Array:
    """(N, 3) points of an object in the camera frame, without its rim and without what sticks out in depth.

    Of the mask, the largest connected part; its rim is where depth bleeds between object and background. Where fewer
    than LEAST_PX pixels are left there are no points at all.
    """
    rows, columns = np.nonzero(without_rim(largest_part(mask & np.isfinite(depth) & (depth > 0)), rim_px))
    if len(rows) < LEAST_PX:
        return np.zeros((0, 3))
    z = depth[rows, columns].astype(np.float64)
    kept = near_median(z)
    z, rays = z[kept], np.stack([columns, rows, np.ones_like(rows)], axis=1)[kept]
    return np.asarray((rays @ np.linalg.inv(camera_matrix).T) * z[:, None])


def near_median(z: Array) -> NDArray[np.bool_]:
    """(N,) which depths lie within 1.5 standard deviations of the median; at least the LEAST_PX nearest ones do.

    The reference code finds the first depth too far out with an argmax, which is 0 when there is none, and then keeps
    only 25 points of a clean object.
    """
    off = np.abs(z - np.median(z))
    kept = off <= TRIM_SIGMAS * np.std(z)
    if np.count_nonzero(kept) < LEAST_PX:
        kept[np.argsort(off, kind="stable")[:LEAST_PX]] = True
    return np.asarray(kept)


def largest_part(mask: Mask) -> Mask:
    """The connected part of a mask with the most pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if len(stats) < 2:
        return np.zeros_like(mask)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def without_rim(mask: Mask, rim_px: int = RIM_PX) -> Mask:
    """A mask less what lies within `rim_px` of its outline, or half of that, and so on, until over 25 px are left.

    Where the picture's edge cuts the object there is no rim.
    """
    distance = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    radius = rim_px
    while radius >= 1:
        if np.count_nonzero(inner := distance > radius) > LEAST_PX:
            return np.asarray(inner)
        radius //= 2
    return mask


def principal_extents(points: Array) -> Array:
    """(3,) full sides of the box of points (N, 3) along their principal axes, largest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred.T @ centred)[0]
    return np.asarray(np.sort(np.ptp(centred @ axes, axis=0))[::-1])


class SizeReader:
    """Reads the sizes of objects off their pictures: the median size of the K phrases most like each of them."""

    def __init__(
        self,
        encoder: TextImageEncoder,
        table: SizeTable | None = None,
        neighbours: int = NEIGHBOURS,
        cache: Path | None = None,
    ) -> None:
        """cache: a folder that keeps the vectors of the phrases, which take a large network on a CPU minutes."""
        self._encoder, self._table, self._count = encoder, table or own_table(), neighbours
        self._texts = _encoded(encoder, [prompt(phrase) for phrase in self._table.phrases], cache)

    def guess(self, rgb: Image, masks: Sequence[Mask], boxes_xywh_px: Sequence[Box]) -> list[SizeGuess]:
        """What the table says of each object: (H, W, 3) picture, K masks and boxes."""
        crops = [
            crop_picture(rgb, mask, box, WORD_EXTEND, WORD_CROP_PX)[0]
            for mask, box in zip(masks, boxes_xywh_px, strict=True)
        ]
        likeness = self._encoder.encode_images(crops) @ self._texts.T
        typical, phrases = self._table.typical_m, self._table.phrases
        guesses = []
        for row in likeness:
            nearest = np.argsort(-row, kind="stable")[: self._count]
            size = float(np.median(typical[nearest]))
            source = f"the {len(nearest)} phrases of {self._table.name} most like it"
            guesses.append(SizeGuess(size, tuple(phrases[k] for k in nearest), source))
        return guesses


def _encoded(encoder: TextImageEncoder, texts: Sequence[str], cache: Path | None) -> Floats:
    """(N, D) vectors of texts, from the cache where it has those of these texts by this encoder."""
    if cache is None:
        return encoder.encode_texts(texts)
    key = hashlib.sha256("\n".join([encoder.name, *texts]).encode()).hexdigest()[:16]
    path = cache / f"texts-{key}.npy"
    if path.is_file():
        return np.asarray(np.load(path, allow_pickle=False), np.float32)
    vectors = encoder.encode_texts(texts)
    with atomic_path(path) as temporary:
        np.save(temporary, vectors)
    return vectors
