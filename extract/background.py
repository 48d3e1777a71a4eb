"""What a still camera sees behind everything that moves, learned from frames spread over the clip.

Where the background is known, a pixel that looks like it shows no object, and one that looks like it but darker shows
a shadow. This is what tells an object from its shadow, and its thin parts from the clutter behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .geometry import Array
from .video import Image, softened

SAMPLES = 24
RIM = 5  # px, of the square by which what is covered shrinks
SAME_LEVELS = 12.0  # grey levels, of a channel, by which what is the same may differ: noise, compression
SHADOW_LEVELS = 9.0  # by which a shadow may differ from the background made darker
DARKEST = 0.4  # brightness of a shadow, of the background's
FOREGROUND, BACKGROUND, SHADOW = 0, 1, 2
COVERED = (1.0, 0.0, 0.7)  # how likely something is there, by label: grey things pass for shadows
HIDDEN_TRUST, SHADOW_TRUST = 0.05, 0.5
ALWAYS, MOSTLY, SOMETIMES, SELDOM = 0.9, 0.5, 0.1, 0.05  # shares of the frames
NEAR_PX, FADING_PX = 60.0, 8.0  # surroundings that count, the nearer the more
STEP_LEVELS, FEWEST_PX = 24, 8  # between neighbouring pixels of two things; to decide a part by
TEXTURE_LEVELS, STILL_TEXTURE = 30.0, 0.35  # a camera is still when so much of what has edges stays where it is
GAIN_STRIDE, GAIN_LIMITS = 8, (0.6, 1.6)  # pixels looked at for a change of light, and how much of it is believed


@dataclass(frozen=True)
class Background:
    """rgb: (H, W, 3) the scene without what moves in it.  known: (H, W) where that could be seen."""

    rgb: Image
    known: NDArray[np.bool_]

    def labels(self, rgb: Image, soft: Image | None = None) -> NDArray[np.uint8]:
        """(H, W) what every pixel of a frame shows: FOREGROUND, BACKGROUND, or SHADOW: the same but darker.

        FOREGROUND also stands for what cannot be told. A change of the light as a whole is allowed for.
        soft: the frame `softened`, if it is at hand.
        """
        out = np.empty(rgb.shape[:2], np.uint8)
        gain, soft = _gain(rgb, self.rgb, self.known), softened(rgb) if soft is None else soft
        _label(soft, self.rgb, self.known, gain, DARKEST, SAME_LEVELS, SHADOW_LEVELS, out)
        return out

    def part(self, x_a: int, y_a: int, x_b: int, y_b: int) -> Background:
        """The background of the pixels [x_a, x_b) x [y_a, y_b)."""
        window = np.s_[y_a:y_b, x_a:x_b]
        return Background(np.ascontiguousarray(self.rgb[window]), np.ascontiguousarray(self.known[window]))

    def covered(self, rgb: Image, soft: Image | None = None) -> NDArray[np.bool_]:
        """(H, W) where something stands before a background that is known there, surely: not along its rim.

        There colours mix and labels, which are those of a blurred picture, reach too far.  soft: see `labels`.
        """
        covered = self.known & (self.labels(rgb, soft) == FOREGROUND)
        return np.asarray(cv2.erode(covered.astype(np.uint8), np.ones((RIM, RIM), np.uint8)) > 0)


def mask_trust(mask: NDArray[np.bool_], labels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W) in [0, 1] how far a mask of an object is to be believed, by the `labels` of the background.

    Hardly where something else stands before the background, a hand: it may hide the object. Half where it may have
    taken in a shadow, for grey things pass for shadows; hardly where that shadow goes on outside of it.
    """
    shadow = labels == SHADOW
    count, part = cv2.connectedComponents(shadow.astype(np.uint8))
    goes_on = np.bincount(part[~mask], minlength=count) > np.bincount(part[mask], minlength=count)
    trust = np.ones(mask.shape, np.float32)
    trust[~mask & (labels == FOREGROUND)] = HIDDEN_TRUST
    trust[mask & shadow] = SHADOW_TRUST
    trust[mask & shadow & goes_on[part]] = HIDDEN_TRUST
    return trust


def learn_background(frames: Sequence[Image]) -> Background | None:
    """The background of a clip, from some of its frames (H, W, 3) in order; None when the camera does not stand still.

    A pixel that shows one colour nearly always shows the background. One that shows two for long was left or taken by
    something: which of the two is background is told by what lies around the place, where nothing changed.
    """
    if len(frames) < 4:
        return None
    first = softened(frames[0])
    everywhere = np.ones(first.shape[:2], bool)
    stack = [first]
    for rgb in frames[1:]:
        soft = softened(rgb)
        stack.append(np.asarray(np.clip(soft / _gain(soft, first, everywhere), 0, 255), np.uint8))
    modes, share, when = _two_modes(np.stack(stack), SAME_LEVELS)
    edges = cv2.Sobel(modes[0], cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(modes[0], cv2.CV_32F, 0, 1) ** 2
    textured = edges.max(axis=-1) > TEXTURE_LEVELS**2
    if not textured.any() or np.mean(share[0][textured] > MOSTLY) < STILL_TEXTURE:
        return None
    settled = (share[0] > ALWAYS) | ((share[0] > MOSTLY) & (share[1] < SELDOM))
    second = _second_is_background(modes, settled, when)
    rgb = np.where(second[..., None], modes[1], modes[0])
    known = settled | (np.where(second, share[1], share[0]) > SOMETIMES)
    return Background(np.ascontiguousarray(rgb), known)


def _second_is_background(modes: Image, settled: NDArray[np.bool_], when: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) where the second of the two modes (2, H, W, 3) goes on into the settled surroundings, not the first.

    Places that were left and places that were taken are told apart by the order of their modes, `when` (2, H, W).
    """
    out = np.zeros(settled.shape, bool)
    if not settled.any() or settled.all():
        return out
    distance, nearest = cv2.distanceTransformWithLabels(
        (~settled).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(nearest.max()) + 1, int)
    place[nearest[settled]] = np.flatnonzero(settled)
    around = modes[0].reshape(-1, 3)[place[nearest]]
    misfit = [np.abs(mode.astype(np.int16) - around).max(axis=-1) for mode in modes]
    rim = ~settled & (distance <= NEAR_PX)
    nearness = np.exp(-distance / FADING_PX)
    # A thing and its shadow are decided each for itself: parts end where either mode's colour changes.
    even = ~settled
    for mode in modes:
        steps = cv2.morphologyEx(mode, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).max(axis=-1)
        even &= steps < STEP_LEVELS
    for order in (when[0] <= when[1], when[0] > when[1]):
        here = ~settled & order
        count, part = cv2.connectedComponents((even & order).astype(np.uint8))
        decided = np.bincount(part[rim], minlength=count) >= FEWEST_PX
        decided[0] = False
        if not decided.any():
            continue
        weight = [np.bincount(part[rim], (m * nearness)[rim], count) for m in misfit]
        second = weight[1] < weight[0]
        # What touches nothing settled goes with the nearest part that does.
        sure = decided[part]
        _, near = cv2.distanceTransformWithLabels(
            (~sure).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        verdict = np.zeros(int(near.max()) + 1, bool)
        verdict[near[sure]] = second[part[sure]]
        out |= verdict[near] & here
    return out


def _gain(rgb: Image, reference: Image, known: NDArray[np.bool_]) -> Array:
    """(3,) by how much brighter each channel of a picture is than the same place of another, most places agreeing."""
    ratios = np.empty((3, -(-rgb.shape[0] // GAIN_STRIDE) * -(-rgb.shape[1] // GAIN_STRIDE)))
    count = _ratios(rgb, reference, known, GAIN_STRIDE, ratios)
    if count < 50:
        return np.ones(3)
    return np.asarray(np.clip(np.median(ratios[:, :count], axis=1), *GAIN_LIMITS))


@numba.njit(cache=True)
def _ratios(
    rgb: NDArray[np.uint8], reference: NDArray[np.uint8], known: NDArray[np.bool_], stride: int, ratios: Array
) -> int:
    """How many of the known pixels, `stride` apart, are neither dark nor white, and their ratios into (3, N)."""
    count = 0
    for y in range(0, rgb.shape[0], stride):
        for x in range(0, rgb.shape[1], stride):
            usable = known[y, x]
            for c in range(3):
                usable &= 16 < rgb[y, x, c] < 245 and 16 < reference[y, x, c] < 245
            if usable:
                for c in range(3):
                    ratios[c, count] = rgb[y, x, c] / reference[y, x, c]
                count += 1
    return count


@numba.njit(cache=True)
def _near(colour: NDArray[np.int32], k: int, j: int, same: float) -> bool:
    """Whether two of the colours (K, 3) differ by less than `same` in every channel."""
    red, green, blue = colour[k, 0] - colour[j, 0], colour[k, 1] - colour[j, 1], colour[k, 2] - colour[j, 2]
    return bool(max(abs(red), abs(green), abs(blue)) < same)


@numba.njit(cache=True)
def _two_modes(
    stack: NDArray[np.uint8], same: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """The two colours that each pixel of (K, H, W, 3) shows most often: (2, H, W, 3), shares and mean k (2, H, W)."""
    count, h, w, _ = stack.shape
    modes = np.zeros((2, h, w, 3), np.uint8)
    share, when = np.zeros((2, h, w), np.float32), np.zeros((2, h, w), np.float32)
    colour, index = np.empty((count, 3), np.int32), np.empty(count, np.int32)  # of what belongs to no mode yet
    near, total = np.empty(count, np.bool_), np.empty(3, np.int32)
    for y in range(h):
        for x in range(w):
            left = count
            for k in range(count):
                index[k] = k
                for c in range(3):
                    colour[k, c] = stack[k, y, x, c]
            for m in range(2):
                best, best_k = 0, -1
                for k in range(left):
                    agree = 0
                    for j in range(left):
                        agree += _near(colour, k, j, same)
                    if agree > best:
                        best, best_k = agree, k
                    if best == left:
                        break  # as nearly everywhere: what stands still shows one colour
                if best == 0:
                    break
                total[:] = 0
                at, rest = 0, 0
                for j in range(left):
                    near[j] = _near(colour, best_k, j, same)
                for j in range(left):
                    if near[j]:
                        at += index[j]
                    else:
                        index[rest] = index[j]
                    for c in range(3):
                        if near[j]:
                            total[c] += colour[j, c]
                        else:
                            colour[rest, c] = colour[j, c]
                    rest += not near[j]
                for c in range(3):
                    modes[m, y, x, c] = np.uint8(total[c] / best + 0.5)
                share[m, y, x], when[m, y, x] = best / count, at / best
                left = rest
    return modes, share, when


@numba.njit(cache=True)
def _label(
    rgb: NDArray[np.uint8], background: NDArray[np.uint8], known: NDArray[np.bool_], gain: Array, darkest: float,
    same: float, shadow_same: float, out: NDArray[np.uint8],
) -> None:  # fmt: skip
    h, w, _ = rgb.shape
    off_by, gains = np.empty(3 * w), np.empty(3 * w)
    for i in range(3 * w):
        gains[i] = gain[i % 3]
    for y in range(h):
        seen_row, expected_row = rgb[y].reshape(3 * w), background[y].reshape(3 * w)
        for i in range(3 * w):
            off_by[i] = abs(seen_row[i] - gains[i] * expected_row[i])
        for x in range(w):
            out[y, x] = FOREGROUND
            if not known[y, x]:
                continue
            if max(off_by[3 * x], off_by[3 * x + 1], off_by[3 * x + 2]) < same:
                out[y, x] = BACKGROUND
                continue
            seen, expected = 0.0, 0.0
            for c in range(3):
                seen += rgb[y, x, c]
                expected += gain[c] * background[y, x, c]
            ratio = seen / max(expected, 1.0)
            if ratio >= 1.0 or ratio < darkest:
                continue
            off = 0.0
            for c in range(3):
                off = max(off, abs(rgb[y, x, c] - ratio * gain[c] * background[y, x, c]))
            if off < shadow_same:
                out[y, x] = SHADOW
