"""What retrieval has to beat on the synthetic BOP set: a blind guess, and the moments of silhouettes alone.

    python bench/retrieval_baselines.py [DATASET] [--views 200] [--out runs/moments.json]

DATASET is what `vid2demo synthesize bop` wrote; without one it is rendered to runs/tables first. Each mesh of its
database is drawn in VIEWS silhouettes; a mask takes the mesh with the most alike one, by Hu's seven moments and the
share of its least rectangle that it fills. The file fills a row:
vid2demo bench table --name retrieval --dataset DATASET --results moments=runs/moments.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from vid2demo.extract.bop import open_dataset
from vid2demo.extract.bop_commands import SynthesizeBop
from vid2demo.extract.bop_eval import CATEGORIES_FILE, DATABASE_FILE, find_mesh, targets_of
from vid2demo.extract.files import write_json
from vid2demo.extract.geometry import Array, make_pose, super_fibonacci_rotations
from vid2demo.extract.raster import render_depth

SIDE_PX = 96


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("runs/moments.json"))
    arguments = parser.parse_args()
    folder = arguments.dataset or Path("runs/tables")
    if arguments.dataset is None:
        SynthesizeBop(out=folder).do()
    dataset = open_dataset(folder)
    true = json.loads((folder / CATEGORIES_FILE).read_text())
    begin_s = time.perf_counter()
    names, score = by_moments(folder, arguments.views)
    print(f"{len(names)} meshes in {arguments.views} views: {time.perf_counter() - begin_s:.1f} s")
    categories = np.array([entry["category"] for entry in json.loads((folder / DATABASE_FILE).read_text())])
    first, fifth = [], []
    for image, truths in targets_of(dataset).items():
        for truth in truths:
            mask = dataset.mask(image, truth.index)
            assert mask is not None
            best = categories[np.argsort(-score(mask))[:5]]
            first.append(best[0] == true[str(truth.obj_id)])
            fifth.append(true[str(truth.obj_id)] in best)
    figures = {"category_percent": 100 * np.mean(first), "category_top5_percent": 100 * np.mean(fifth)}
    print(
        f"{len(first)} objects: top-1 {figures['category_percent']:.1f}%, top-5 {figures['category_top5_percent']:.1f}%"
    )
    write_json(arguments.out, {"figures": {name: float(value) for name, value in figures.items()}})


def by_moments(folder: Path, count: int = 200) -> tuple[list[str], Callable[[NDArray[np.bool_]], Array]]:
    """Names of the meshes of a data set's database, and what scores them all by a mask's most alike silhouette."""
    entries = json.loads((folder / DATABASE_FILE).read_text())
    views = np.stack([described(folder, entry["file"], count) for entry in entries])
    spread = views.reshape(-1, views.shape[-1]).std(axis=0)
    names = [entry["name"] for entry in entries]
    return names, lambda mask: -np.linalg.norm((views - moments(mask)) / spread, axis=-1).min(axis=1)


def described(folder: Path, file: str, count: int) -> Array:
    """(views, 8) moments of a mesh's silhouettes."""
    mesh = find_mesh(file, (folder,))
    vertices = np.asarray(mesh.vertices) / np.linalg.norm(mesh.extents)
    faces = np.asarray(mesh.faces, np.int32)
    camera = np.array([[4.0 * SIDE_PX, 0, 0], [0, 4.0 * SIDE_PX, 0], [0, 0, 1.0]])
    found = []
    for R in super_fibonacci_rotations(count):
        window = render_depth(vertices, faces, make_pose(R, (0.0, 0.0, 4.0)), camera)
        assert window is not None
        found.append(moments(window.mask))
    return np.stack(found)


def moments(mask: NDArray[np.bool_]) -> Array:
    """(8,) what a silhouette keeps when it is moved, turned in the picture and scaled."""
    hu = cv2.HuMoments(cv2.moments(mask.astype(np.uint8), binaryImage=True)).ravel()
    # The seven span many powers of ten; mirrored silhouettes differ in the sign of the last.
    logs = np.sign(hu) * np.maximum(np.log10(np.abs(hu) + 1e-12) + 12, 0)
    points = cv2.findNonZero(mask.astype(np.uint8))
    _, (width, height), _ = cv2.minAreaRect(points)
    return np.append(logs, 10 * np.count_nonzero(mask) / ((width + 1) * (height + 1)))


if __name__ == "__main__":
    main()
