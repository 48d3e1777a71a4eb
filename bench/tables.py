"""The paper's tables with every row filled that runs without downloads, on the synthetic BOP set.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/tables.py [DATASET] [--out runs/rows] [--workers 2]
        [--rows own oracle ...] [--names main retrieval ...] [--results TABLE:ROW=FILE ...]

DATASET is what `vid2demo synthesize bop` wrote; without one it is rendered to runs/tables first. Its held-out meshes
(600, 1200 and 1800 views) and its own models are onboarded, `vid2demo bench pose` runs once for every row, and the
tables are printed. What is there already is not done again. The rows of networks and of other
methods say what fills them; give that with --results, tracks for the table video too.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vid2demo.extract.bench_pose import bench_pose
from vid2demo.extract.bop import open_dataset
from vid2demo.extract.bop_commands import SynthesizeBop
from vid2demo.extract.bop_eval import evaluate
from vid2demo.extract.bop_results import read_results
from vid2demo.extract.files import write_json
from vid2demo.extract.mesh_sources import find_sources
from vid2demo.extract.onboarding import onboard
from vid2demo.extract.paper_tables import TABLES
from vid2demo.extract.tables import as_text, fill_table
from vid2demo.extract.templates import ViewSettings


@dataclass(frozen=True)
class Run:
    """One run over the data set.

    fills: (table, row) that show it.  options: of `bench_pose`.  views: of the database.  models: take the set's own.
    """

    fills: tuple[tuple[str, str], ...]
    options: dict[str, Any] = field(default_factory=dict)
    views: int = 600
    models: bool = False


RUNS = {
    "own": Run(
        (
            ("main", "classical"),
            ("retrieval", "classical-cls"),
            ("views", "views-600"),
            ("scale", "ours"),
            ("proposals", "truth"),
        )
    ),
    "oracle": Run(
        (("main", "classical-oracle"), ("retrieval", "classical-oracle"), ("scale", "oracle")),
        {"meshes": "true", "sizes": "true"},
        models=True,
    ),
    "proposed": Run((("main", "classical-proposed"), ("proposals", "classical")), {"masks": "proposed"}),
    "average": Run((("retrieval", "classical-ffa"),), {"descriptor": "average"}),
    "constant": Run((("scale", "constant"),), {"sizes": "constant"}),
    "sized": Run((("scale", "true-sizes"),), {"sizes": "true"}),
    "views-1200": Run((("views", "views-1200"),), views=1200),
    "views-1800": Run((("views", "views-1800"),), views=1800),
}
MOMENTS = "moments"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, default=Path("runs/rows"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rows", nargs="*", default=[*RUNS, MOMENTS], choices=[*RUNS, MOMENTS])
    parser.add_argument("--names", nargs="*", default=list(TABLES), choices=list(TABLES))
    parser.add_argument("--results", nargs="*", default=[], metavar="TABLE:ROW=FILE")
    chosen = parser.parse_args()
    dataset: Path = chosen.dataset or Path("runs/tables")
    if chosen.dataset is None:
        SynthesizeBop(out=dataset).do()
    for name in chosen.rows:
        folder = chosen.out / name
        if name == MOMENTS:
            if not (folder / "figures.json").exists():
                script = [sys.executable, str(Path(__file__).with_name("retrieval_baselines.py")), str(dataset)]
                subprocess.run([*script, "--out", str(folder / "figures.json")], check=True)
        elif not (folder / "scores.json").exists():
            run(RUNS[name], dataset, chosen.out, folder, chosen.workers)
        print(f"{name}: {folder}", flush=True)
    given = [text.partition(":")[::2] for text in chosen.results]
    for name in chosen.names:
        results = [text for table, text in given if table == name] + found(name, chosen.out)
        print(f"\n{as_text(fill_table(name, results, dataset=dataset))}", flush=True)


def run(row: Run, dataset: Path, out: Path, folder: Path, workers: int) -> None:
    """Fill a folder with a row's poses, figures and scores."""
    meshes, db, unit = (
        (dataset / "models", out / "models-db", "mm") if row.models else (dataset / "database", out / "db", "m")
    )
    settings = ViewSettings(count=row.views)
    onboard(find_sources(meshes), db, settings=settings, unit_name=unit, workers=workers)
    bench_pose(dataset, db, folder, level="classical", views=row.views, **row.options)
    scores = evaluate(open_dataset(dataset), read_results(folder / "poses.csv"), folders=(folder, dataset))
    write_json(folder / "scores.json", scores.to_json())


def found(table: str, out: Path) -> list[str]:
    """ROW=FILE for all files of runs that a table shows."""
    listed = [(row, out / name) for name, run in RUNS.items() for of, row in run.fills if of == table]
    if table == "retrieval":
        listed.append((MOMENTS, out / MOMENTS))
    files = ("scores.json", "figures.json", "proposals.json")
    return [f"{row}={folder / name}" for row, folder in listed for name in files if (folder / name).exists()]


if __name__ == "__main__":
    main()
