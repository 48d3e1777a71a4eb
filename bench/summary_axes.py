"""What hides and lights an object changes its outline: the statistics behind the summary of classical features.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/summary_axes.py [--out extract/summary_axes.npz]

Views of the library's vessels are spoilt as pictures spoil them: another silhouette covers a part, light falls across,
a shadow's edge runs over the surface, the picture is turned a little. Directions in which their histograms (768
numbers) vary for such reasons alone count less: differences are whitened (Hariharan, Malik and Ramanan, 2012, whiten
HOG by the statistics of natural pictures), and the 512 axes along which views then differ most are kept. The vessels
are of variants that neither the synthetic data set nor its database shows. It takes a minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from vid2demo.extract.features import CLASSICAL_CROP_PX, CLASSICAL_GRID, SUMMARY_AXES, crop_cells, pooled
from vid2demo.extract.files import atomic_path
from vid2demo.extract.mesh_sources import LIBRARY, MeshSource
from vid2demo.extract.onboarding import read_source
from vid2demo.extract.protocols import Floats
from vid2demo.extract.segment import mask_box
from vid2demo.extract.templates import View, ViewSettings, crop_picture, template_view
from vid2demo.extract.vessels import CATEGORIES

VARIANTS = (20, 21)
VIEWS = 130  # of each vessel
SPOILT = 6000
AXES = 512
FLOOR = 0.1  # of the mean variance, added to all: less spoils what is seldom hidden, more changes nothing
COVERED_SHARE, LEAST_SHOWN = 0.6, 0.3


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=SUMMARY_AXES)
    chosen = parser.parse_args()
    rng = np.random.default_rng(0)
    settings = ViewSettings(count=VIEWS)
    views: list[View] = []
    for category in CATEGORIES:
        for variant in VARIANTS:
            mesh = read_source(MeshSource(f"{category}:{variant}", category, f"{LIBRARY}/{category}/{variant}")).mesh
            views += [template_view(mesh, settings, index, CLASSICAL_CROP_PX) for index in range(VIEWS)]
    clean, spoilt = [], []
    while len(spoilt) < SPOILT:
        view, other = (views[k] for k in rng.integers(len(views), size=2))
        found = spoil(rng, view, other.mask)
        if found is not None:
            clean.append(histograms(view))
            spoilt.append(histograms(found))
    mean, axes = whitening(np.stack(clean), np.stack(spoilt))
    with atomic_path(chosen.out) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, mean=mean.astype(np.float32), axes=axes.astype(np.float16))
    print(f"{len(views)} views, {SPOILT} spoilt: {chosen.out}")


def spoil(rng: np.random.Generator, view: View, cover: NDArray[np.bool_]) -> View | None:
    """A view partly covered or a little turned, and lit otherwise; None if too little of it shows."""
    side, mask, rgb = CLASSICAL_CROP_PX, view.mask, view.rgb
    middle = (side / 2, side / 2)
    if rng.random() < COVERED_SHARE:
        warp = cv2.getRotationMatrix2D(middle, rng.uniform(-180, 180), rng.uniform(0.5, 1.5))
        warp[:, 2] += rng.uniform(-2 / 3 * side, 2 / 3 * side, 2)
        mask = mask & ~(cv2.warpAffine(cover.astype(np.uint8), warp, (side, side)) > 0)
        if np.count_nonzero(mask) < LEAST_SHOWN * np.count_nonzero(view.mask):
            return None
    else:
        warp = cv2.getRotationMatrix2D(middle, rng.uniform(-6, 6), 1.0)
        mask = cv2.warpAffine(mask.astype(np.uint8), warp, (side, side)) > 0
        rgb = np.asarray(cv2.warpAffine(rgb, warp, (side, side)), np.uint8)
    across = np.linspace(-1, 1, side)
    light = rng.uniform(0.6, 1.2) + rng.uniform(-0.4, 0.4) * across + rng.uniform(-0.4, 0.4) * across[:, None]
    if rng.random() < 0.5:
        at = rng.uniform(0, 2 * np.pi)
        lit = np.cos(at) * across + np.sin(at) * across[:, None] > rng.uniform(-0.5, 0.5)
        light = light * np.where(lit, 1.0, 0.6)
    lit_rgb = np.clip(rgb * light[..., None], 0, 255).astype(np.uint8)
    return View(*crop_picture(lit_rgb, np.asarray(mask), mask_box(np.asarray(mask)), 0.05, side), view.visible)


def histograms(view: View) -> Floats:
    return pooled(crop_cells(view.rgb, view.mask, CLASSICAL_GRID))


def whitening(clean: Floats, spoilt: Floats) -> tuple[Floats, Floats]:
    """Mean (P,) of clean histograms and axes (P, AXES): their columns weigh by how little spoiling changes them."""
    mean = clean.mean(axis=0, dtype=np.float64)
    change = (spoilt - clean).astype(np.float64)
    change -= change.mean(axis=0)
    variance, directions = np.linalg.eigh(change.T @ change / len(change))
    white = directions / np.sqrt(variance + FLOOR * variance.mean())
    seen = (clean - mean) @ white
    _, principal = np.linalg.eigh(seen.T @ seen / len(seen))
    return np.asarray(mean), np.asarray(white @ principal[:, ::-1][:, :AXES])


if __name__ == "__main__":
    main()
