"""The paper's tables with measured figures in them, from results files.

A row is filled from poses (a BOP csv, or what `eval-bop --json` printed), from proposals (JSON of BOP's segmentation
task) or tracks (what `compare-track --out` wrote, of one video or several), or any JSON with an object `figures`, from
a column's name to its value. A row without any says what would fill it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from .bop import Dataset, open_dataset, read_json
from .bop_eval import DATABASE_FILE, evaluate
from .bop_results import read_results
from .errors import UserError
from .geometry import rotation_angle_rad, super_fibonacci_rotations
from .paper_tables import TABLES, Row
from .pose_metrics import Protocol
from .progress import Progress
from .proposal_metrics import judge_proposals, read_proposals


def fill_table(
    name: str,
    results: Sequence[str] = (),
    *,
    dataset: Path | None = None,
    split: str | None = None,
    protocol: Protocol = "official",
    meshes: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """A table as JSON: title, source, columns, and rows with their `measured` and the `paper`'s figures.

    results: "KEY=FILE", one file or several for a row. dataset: what csv and proposals are of; meshes: folder of the
    meshes that a csv names, if not beside it. Raises UserError for an unknown table or row and for unreadable files.
    """
    if name not in TABLES:
        raise UserError(f"there is no table {name!r}; there are {', '.join(TABLES)}")
    table = TABLES[name]
    files = _by_row(results, table.rows, name)
    opened = open_dataset(dataset, split) if dataset is not None else None
    rows = []
    for row in table.rows:
        found = _own_figures(row, opened)
        if row.key in files:
            found |= _measured(files[row.key], opened, protocol, meshes, progress)
        rows.append(
            {
                "key": row.key,
                "title": row.title,
                "how": row.how,
                "measured": {column: found.get(column) for column in table.columns},
                "files": [str(path) for path in files.get(row.key, ())],
                "paper": {where: dict(zip(table.columns, values, strict=False)) for where, values in row.paper.items()},
            }
        )
    return {
        "name": name,
        "title": table.title,
        "source": table.source,
        "dataset": None if dataset is None else str(dataset),
        "protocol": protocol,
        "columns": dict(table.columns),
        "rows": rows,
    }


def as_text(table: Mapping[str, Any]) -> str:
    """A filled table for a person: of every row what was measured here, and what the paper prints."""
    columns = table["columns"]
    width = max(len(heading) for heading in columns.values()) + 2
    where = f"measured on {table['dataset']}" if table["dataset"] else "measured"
    margin = max(44, len(where) + 4)
    lines = [
        f"{table['title']} ({table['source']})",
        "",
        " " * margin + "".join(f"{h:>{width}}" for h in columns.values()),
    ]
    for row in table["rows"]:
        lines.append(row["title"])
        for data, figures in row["paper"].items():
            lines.append(_line(f"  paper, {data}", figures, columns, margin, width))
        if any(value is not None for value in row["measured"].values()):
            lines.append(_line(f"  {where}", row["measured"], columns, margin, width))
        if row["how"] and not row["files"]:
            lines.append(f"  not measured; to fill it: {row['how']}; then --results {row['key']}=FILE")
    return "\n".join(lines)


def _line(title: str, figures: Mapping[str, float | None], columns: Mapping[str, str], margin: int, width: int) -> str:
    cells = []
    for column in columns:
        value = figures.get(column)
        digits = 4 if column.startswith("e_") else 2
        told = "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"
        cells.append(f"{told:>{width}}")
    return f"{title:<{margin}}" + "".join(cells)


def _by_row(results: Sequence[str], rows: Sequence[Row], name: str) -> dict[str, list[Path]]:
    files: dict[str, list[Path]] = defaultdict(list)
    known = [row.key for row in rows]
    for text in results:
        key, equals, path = text.partition("=")
        if not equals or key not in known:
            raise UserError(
                f"--results {text!r} names no row of the table {name}; give ROW=FILE with {', '.join(known)}"
            )
        files[key].append(Path(path))
    return dict(files)


def _own_figures(row: Row, dataset: Dataset | None) -> dict[str, float]:
    """What can be told of a row without running anything: how far apart its views are, what a blind guess finds."""
    kind, _, count = row.key.partition("-")
    if kind == "chance" and dataset is not None and (dataset.root / DATABASE_FILE).is_file():
        of_category = Counter(entry["category"] for entry in read_json(dataset.root / DATABASE_FILE))
        meshes = of_category.total()
        percent = []
        for drawn in (1, min(5, meshes)):
            missed = [comb(meshes - own, drawn) / comb(meshes, drawn) for own in of_category.values()]
            percent.append(100 * (1 - float(np.mean(missed))))
        return {"category_percent": percent[0], "category_top5_percent": percent[1]}
    if kind != "views":
        return {}
    R = super_fibonacci_rotations(int(count))
    # Each view's nearest other one; the matrix of all is small enough for some thousand views.
    traces = np.einsum("aij,bij->ab", R, R)
    np.fill_diagonal(traces, -np.inf)
    nearest = np.argmax(traces, axis=1)
    return {"spacing_deg": float(np.rad2deg(rotation_angle_rad(R, R[nearest]).mean()))}


def _measured(
    paths: Sequence[Path], dataset: Dataset | None, protocol: Protocol, meshes: Path | None, progress: Progress | None
) -> dict[str, Any]:
    """The figures of one row's files, by name."""
    found: dict[str, Any] = {}
    motions: list[Mapping[str, float]] = []
    for path in paths:
        if path.suffix == ".csv":
            folders = (*([meshes] if meshes else []), path.parent, _needed(dataset, path).root)
            estimates = read_results(path)
            scores = evaluate(_needed(dataset, path), estimates, protocol=protocol, folders=folders, progress=progress)
            found |= scores.to_json()
            continue
        content = read_json(path)
        if isinstance(content, list):
            found |= judge_proposals(_needed(dataset, path), read_proposals(path)).to_json()
        elif "ar_cou" in content:
            found |= content
        elif isinstance(content.get("figures"), dict):
            found |= content["figures"]
        elif protocol in content.get("velocity", {}):
            motions.append(content["velocity"][protocol])
        else:
            raise UserError(
                f"{path} holds neither poses, proposals nor errors of a track; give a BOP csv, a list of proposals, or "
                "what `eval-bop --json` or `compare-track --out` wrote"
            )
    if motions:
        found |= {name: float(np.mean([m[name] for m in motions])) for name in ("e_rot", "e_proj", "e_depth")}
    return found


def _needed(dataset: Dataset | None, path: Path) -> Dataset:
    if dataset is None:
        raise UserError(f"{path} can only be judged beside its data set; name it with --dataset DIR")
    return dataset
