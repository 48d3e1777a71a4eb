"""The method over a data set, with everything beside the poses that a table of the paper wants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .bop import Dataset, open_dataset, read_json
from .bop_eval import CATEGORIES_FILE
from .bop_pose import Meshes, Posed, Sizes, category_ranks, pose_dataset
from .choose import Level, choose
from .classical_segment import ClassicalSegmenter
from .features import features_of
from .files import write_json
from .image_pose import ImagePoser
from .mesh_store import MeshStore
from .model_folder import models_folder
from .progress import Progress
from .proposal_metrics import ProposedMask, write_proposals
from .scale import SizeReader
from .size_table import load_size_table, own_table


def bench_pose(
    dataset: Path,
    db: Path,
    out: Path,
    *,
    split: str | None = None,
    masks: str = "true",
    meshes: Meshes = "retrieved",
    sizes: Sizes = "own",
    descriptor: str | None = None,
    encoder: str | None = None,
    views: int | None = None,
    level: Level = "auto",
    models_dir: Path | None = None,
    size_table: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Find the objects of a data set by a mesh database; see the options of `vid2demo bench pose`.

    Writes poses.csv, figures.json and, for proposed masks, proposals.json to `out`, and returns the figures.
    """
    opened, store = open_dataset(dataset, split), MeshStore.open(db, encoder, views)
    options = {"models_dir": str(models_dir)} if models_dir else {}
    kind: dict[str, Any] = {"level": level, "models_dir": models_dir}
    depth, words = choose("depth", lambda: None, **kind).made, choose("words", lambda: None, **kind).made
    proposed = masks == "proposed"
    table = own_table() if size_table is None else load_size_table(size_table)
    reader = None if words is None else SizeReader(words, table, cache=models_folder(models_dir))
    features = features_of(store.encoder, options)
    found = pose_dataset(
        opened,
        ImagePoser(store, features, column=descriptor, depth=depth, table=table, words=reader),
        out / "poses.csv",
        segmenter=choose("segmenter", ClassicalSegmenter, **kind).made if proposed else None,
        meshes=meshes,
        sizes=sizes,
        progress=progress,
    )
    figures = _figures(opened, found, judge_categories=not proposed and meshes == "retrieved")
    write_json(out / "figures.json", {"figures": figures})
    files = ["poses.csv", "figures.json"]
    if proposed:
        listed = {p.image: [ProposedMask(o.proposal.mask, o.proposal.score) for o in p.objects] for p in found}
        write_proposals(out / "proposals.json", listed)
        files.append("proposals.json")
    counts = {"images": len(found), "objects": sum(len(posed.objects) for posed in found)}
    return {**counts, **figures, "written": [str(out / name) for name in files]}


def _figures(dataset: Dataset, found: Sequence[Posed], *, judge_categories: bool) -> dict[str, float]:
    # The median: of a mesh's first picture it draws the views, which are kept.
    figures = {"seconds_per_image": float(np.median([posed.seconds for posed in found]))} if found else {}
    known = dataset.root / CATEGORIES_FILE
    if judge_categories and known.is_file():
        categories = {int(obj_id): str(category) for obj_id, category in read_json(known).items()}
        ranks = np.array(category_ranks(found, categories))
        for name, most in (("category_percent", 1), ("category_top5_percent", 5)):
            figures[name] = float(100 * np.mean((ranks >= 0) & (ranks < most)))
    return figures
