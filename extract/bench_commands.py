"""The commands that fill the paper's tables: the method over a data set, and a table of what came out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from .command import Command, Result, told
from .progress import Terminal

DatasetFolder = Positional[Annotated[Path, arg(metavar="DATASET", help="In BOP's format: models and pictures.")]]
Split = Annotated[str | None, told("NAME", "Folder of the pictures. Default: test, val or train.")]
ModelsDir = Annotated[Path | None, told("DIR", "Folder of the networks. Default: as `models list` says.")]


@dataclass(frozen=True, kw_only=True)
class BenchPose(Command):
    """Find the objects of all pictures of a data set, as the paper's tables ask for it.

    Writes poses.csv (BOP's format), figures.json (how often the category is right, where the data set tells it) and,
    with --masks proposed, proposals.json. For true meshes --db holds the data set's models, onboarded with --unit mm.

    For example: vid2demo bench pose runs/tables --db runs/meshes --out runs/tables-ours
    """

    dataset: DatasetFolder
    db: Annotated[Path, arg(metavar="DB", help="A mesh database, as `meshes onboard` makes it.")]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    split: Split = None
    masks: Annotated[Literal["true", "proposed"], arg(help="The data set's visible masks, or what is found.")] = "true"
    meshes: Annotated[Literal["retrieved", "true"], arg(help="Of the database, or each object's own.")] = "retrieved"
    sizes: Annotated[Literal["own", "true", "constant"], arg(help="Found, each object's own, or 10 cm.")] = "own"
    size_table: Annotated[Path | None, told("FILE", "Usual sizes, csv or json. Default: the one that ships.")] = None
    descriptor: Annotated[
        Literal["average", "summary"] | None, told(None, "For retrieval: FFA or CLS. Default: the encoder's usual one.")
    ] = None
    encoder: Annotated[str | None, told("NAME", "Descriptors to use, where the database has several.")] = None
    views: Annotated[int | None, told("N", "Views a mesh, where the database has several [count].")] = None
    level: Annotated[
        Literal["auto", "foundation", "classical"], arg(help="Networks where their weights are at hand, or not.")
    ] = "auto"
    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .bench_pose import bench_pose

        chosen = {name: value for name, value in vars(self).items() if name != "json"}
        with Terminal() as terminal:
            return bench_pose(**chosen, progress=terminal.progress)


@dataclass(frozen=True, kw_only=True)
class BenchTable(Command):
    """Print one of the paper's tables: its own figures, and beside them what results files give.

    A row is named by its key and filled from a BOP csv, proposals or track errors; rows without say what fills them.

    For example: vid2demo bench table --name main --dataset ycbv --results megapose=megapose.csv classical=ours.csv
    """

    name: Annotated[
        Literal["main", "retrieval", "views", "scale", "proposals", "video"], arg(help="Which of the paper's tables.")
    ]
    results: Annotated[tuple[str, ...], told("ROW=FILE", "What fills a row, several for one row too.")] = ()
    dataset: Annotated[Path | None, told("DATASET", "What the results are of, in BOP's format.")] = None
    split: Split = None
    meshes: Annotated[Path | None, told("DIR", "Where the results' meshes lie. Default: beside the results.")] = None
    protocol: Annotated[Literal["official", "paper"], arg(help="The authors' code or the paper's text.")] = "official"

    def do(self) -> Result:
        from .tables import fill_table

        with Terminal() as terminal:
            return fill_table(
                self.name,
                self.results,
                dataset=self.dataset,
                split=self.split,
                protocol=self.protocol,
                meshes=self.meshes,
                progress=terminal.progress,
            )

    def words(self, result: Result) -> str:
        from .tables import as_text

        return as_text(result)
