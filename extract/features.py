"""Features of crops without learned weights: directions of the outline, of inner edges, and the depth inside.

The grid is like a vision transformer's, so that everything above works with either. A cell holds a histogram of the
directions of the silhouette's edge (the shape), a fainter one of edges inside (handles before the body, rims, spouts),
the share of the object in it, and how deep inside it lies. Directions count modulo 180 degrees, in the spirit of
HOG (Dalal and Triggs, 2005): colours of a stored mesh and of a real object seldom agree, their outlines do.

The summary of a crop is both histograms on a coarser grid, seen along axes that hardly change when something hides a
part of the object or light falls otherwise (`summary_axes.npz`, which bench/summary_axes.py makes).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .protocols import Floats, PatchFeatures, PatchGrid

BINS = 6
CLASSICAL_CROP_PX, CLASSICAL_GRID = 120, 30
# Weights of what a cell holds, and of the edges inside in the summary. Measured by bench/retrieval.py.
OUTLINE, INSIDE, SHARE, DEPTH = 1.0, 0.5, 0.25, 0.25
INSIDE_SUMMARY = 0.6
SUMMARY_CELLS = 8
SUMMARY_AXES = Path(__file__).with_name("summary_axes.npz")
DEPTH_PX = 10.0
BLUR_PX = 1.2


@dataclass(frozen=True)
class ClassicalFeatures:
    """`PatchFeatures` of plain image processing; numbers are small, so it runs at 120 px."""

    name: str = "classical-2"
    crop_px: int = CLASSICAL_CROP_PX
    grid: int = CLASSICAL_GRID

    @property
    def patch_size(self) -> int:
        return 2 * BINS + 2

    @property
    def summary_size(self) -> int:
        return int(_summary_axes()[1].shape[1])

    def encode(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> PatchGrid:
        """Features of crops (B, S, S, 3) and their masks (B, S, S)."""
        patches = np.empty((len(crops), self.grid, self.grid, self.patch_size), np.float32)
        coarse = np.empty((len(crops), 2 * BINS * SUMMARY_CELLS**2), np.float32)
        for k, (rgb, mask) in enumerate(zip(crops, masks, strict=True)):
            patches[k] = crop_cells(rgb, mask, self.grid)
            coarse[k] = pooled(patches[k])
        mean, axes = _summary_axes()
        # Of nothing the summary is zero, not what the mean lacks.
        off = np.where(coarse.any(axis=1, keepdims=True), coarse - mean, np.float32(0))
        # In doubles, so that how many threads share the product does not show.
        return PatchGrid(patches, unit(np.asarray(off.astype(float) @ axes, np.float32)))


def crop_cells(rgb: NDArray[np.uint8], mask: NDArray[np.bool_], grid: int) -> Floats:
    """(G, G, 2 BINS + 2) features of one crop."""
    inside = mask.astype(np.float32)
    soft = cv2.GaussianBlur(inside, (0, 0), BLUR_PX)
    # Blurred over the object alone, so that the black around it makes no edge of its own.
    lit = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) * inside
    grey = cv2.GaussianBlur(lit, (0, 0), BLUR_PX) / np.maximum(soft, 0.05)
    core = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outline = _directions(*_gradient(soft), np.ones(mask.shape, np.float32), grid)
    gx, gy = _gradient(grey)
    strength = np.hypot(gx, gy)
    usual = float(np.percentile(strength[core > 0], 80)) if core.any() else 0.0
    # Strong edges count no more than twice the usual ones: a label must not drown the shape.
    weight = core * np.minimum(strength, 2 * usual + 2) / np.maximum(strength, 1e-6) / (usual + 4)
    inner = _directions(gx, gy, weight.astype(np.float32), grid)
    share = cv2.resize(inside, (grid, grid), interpolation=cv2.INTER_AREA)
    deep = cv2.resize(np.tanh(depth / DEPTH_PX), (grid, grid), interpolation=cv2.INTER_AREA)
    return np.concatenate(
        [OUTLINE * outline, INSIDE * inner, SHARE * share[..., None], DEPTH * deep[..., None]],
        axis=-1,
        dtype=np.float32,
    )


def _gradient(values: NDArray[Any]) -> tuple[Floats, Floats]:
    return np.asarray(cv2.Sobel(values, -1, 1, 0), np.float32), np.asarray(cv2.Sobel(values, -1, 0, 1), np.float32)


def pooled(cells: Floats) -> Floats:
    """(P,) both histograms of cells (G, G, D) on SUMMARY_CELLS x SUMMARY_CELLS, of unit length.

    Of square roots (Hellinger's kernel), so that long straight edges do not outvote a handle's short ones.
    """
    weights = _pooling(cells.shape[0], SUMMARY_CELLS)
    coarse = np.sqrt(np.einsum("ui,vj,ijb->uvb", weights, weights, cells[..., : 2 * BINS], optimize=True))
    outline, inside = unit(coarse[..., :BINS].ravel()), unit(coarse[..., BINS:].ravel())
    return unit(np.concatenate([outline, INSIDE_SUMMARY * inside]))


@functools.cache
def _summary_axes() -> tuple[Floats, NDArray[np.float64]]:
    """Mean (P,) and axes (P, E) of the summary."""
    with np.load(SUMMARY_AXES) as stored:
        return np.asarray(stored["mean"], np.float32), np.asarray(stored["axes"], np.float64)


@functools.lru_cache(maxsize=4)
def _pooling(size: int, count: int) -> Floats:
    """(count, size) weights of fine cells in coarse ones: Gaussians as wide as half a coarse cell."""
    step = size / count
    gap = (np.arange(size) + 0.5)[None, :] - (np.arange(count) + 0.5)[:, None] * step
    weights = np.exp(-0.5 * (gap / (0.6 * step)) ** 2)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)


@numba.njit(cache=True, fastmath=True)
def _directions(gx: Floats, gy: Floats, weight: Floats, grid: int) -> Floats:
    """(grid, grid, BINS) weighted histograms of the direction of a gradient, shared among near cells and bins."""
    height, width = gx.shape
    out = np.zeros((grid, grid, BINS), np.float32)
    scale = grid / height
    for y in range(height):
        v = (y + 0.5) * scale - 0.5
        r = int(np.floor(v))
        fv = v - r
        for x in range(width):
            strength = np.sqrt(gx[y, x] ** 2 + gy[y, x] ** 2) * weight[y, x]
            if strength < 1e-4:
                continue
            at = np.arctan2(gy[y, x], gx[y, x]) / np.pi * BINS
            if at < 0:
                at += BINS
            b = int(at)
            fb = at - b
            b0, b1 = b % BINS, (b + 1) % BINS
            u = (x + 0.5) * scale - 0.5
            c = int(np.floor(u))
            fu = u - c
            for dr in range(2):
                for dc in range(2):
                    row, column = r + dr, c + dc
                    if 0 <= row < grid and 0 <= column < grid:
                        share = strength * (fv if dr else 1 - fv) * (fu if dc else 1 - fu)
                        out[row, column, b0] += share * (1 - fb)
                        out[row, column, b1] += share * fb
    return out


def object_cells(masks: NDArray[np.bool_], grid: int) -> NDArray[np.bool_]:
    """(B, G, G) cells of which masks (B, S, S) cover any part, as the paper's resizing by area has it."""
    count, side = masks.shape[0], masks.shape[1]
    if side % grid == 0:
        step = side // grid
        return np.asarray(masks.reshape(count, grid, step, grid, step).any(axis=(2, 4)))
    shares = [cv2.resize(mask.astype(np.float32), (grid, grid), interpolation=cv2.INTER_AREA) for mask in masks]
    return np.asarray(np.stack(shares) > 0)


def foreground_average(patches: Floats, cells: NDArray[np.bool_]) -> Floats:
    """(B, D) mean of features (B, G, G, D) over the object's cells (B, G, G): FFA (Kotar et al., 2023) of each view."""
    weight = cells.astype(np.float32)
    total = np.einsum("bijd,bij->bd", patches, weight)
    return np.asarray(total / np.maximum(weight.sum(axis=(1, 2)), 1.0)[:, None], np.float32)


def unit(vectors: Floats) -> Floats:
    """Vectors (..., D) of unit length; zero stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12), np.float32)


def make_features(name: str, options: Mapping[str, str] | None = None) -> PatchFeatures:
    """The encoder of a name: "classical", a network for features that `vid2demo models list` shows, or an .onnx file.

    options: of a network: models_dir, device, and block, after which tokens are taken.
    Raises UserError for an unknown name and when weights are missing.
    """
    if name == "classical":
        return ClassicalFeatures()
    if name.endswith(".onnx"):
        from .onnx_models import OnnxPatchFeatures

        if block := (options or {}).get("block"):
            raise UserError(f"--block {block}: the block was chosen when {name} was exported; leave it out")
        return OnnxPatchFeatures(Path(name))
    from .choose import choose
    from .models import cards_for

    if name not in (known := [card.name for card in cards_for("features")]):
        raise UserError(f"unknown patch features {name!r}; there are classical, {', '.join(known)} and .onnx files")
    chosen = dict(options or {})
    models_dir, device = chosen.pop("models_dir", None), chosen.pop("device", "auto")
    made: PatchFeatures = choose(
        "features",
        ClassicalFeatures,
        level="foundation",
        models=(name,),
        models_dir=Path(models_dir) if models_dir else None,
        device=device,
        options={key: int(value) for key, value in chosen.items()},
    ).made
    return made


def features_of(encoder: str, options: Mapping[str, str] | None = None) -> PatchFeatures:
    """The encoder that a database was made with, by the name it wrote there.

    Raises UserError when there is no such encoder here, or only with other weights.
    """
    if encoder == ClassicalFeatures().name:
        return ClassicalFeatures()
    if encoder.endswith("-onnx"):
        return _exported(encoder, (options or {}).get("models_dir"))
    from .models import cards_for

    model = next((card.name for card in cards_for("features") if encoder.startswith(card.name)), None)
    if model is None:
        raise UserError(f"the database's features {encoder!r} are not known to this version; onboard its meshes again")
    block = re.search(r"-block(\d+)-", encoder)
    made = make_features(model, {**(options or {}), **({"block": block[1]} if block else {})})
    if made.name != encoder:
        raise UserError(f"the database was made with {encoder}, here is {made.name}; use those weights and that device")
    return made


def _exported(encoder: str, models_dir: str | None) -> PatchFeatures:
    """The encoder of this name in the .onnx files of the folder of networks."""
    from .model_folder import models_folder
    from .onnx_models import OnnxPatchFeatures, open_network

    folder = models_folder(Path(models_dir) if models_dir else None)
    for path in sorted(folder.glob("*.onnx")):
        _, facts = open_network(path)
        if facts.get("part") == "features" and f"{facts['name']}-onnx" == encoder:
            return OnnxPatchFeatures(path)
    raise UserError(f"the database was made with {encoder}, which no .onnx file in {folder} is; name its --models-dir")


def usual_descriptor(encoder: str) -> str:
    """The column by which objects are found: "summary" for classical features, the paper's average for networks."""
    return "summary" if encoder.startswith("classical") else "average"
