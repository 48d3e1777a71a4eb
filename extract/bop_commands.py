"""The commands that make, read and judge data sets in BOP's format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from .command import Command, Result, Seed, Staged, told
from .progress import Terminal

DatasetFolder = Annotated[Path, arg(metavar="DATASET", help="A data set in BOP's format, models and pictures.")]


@dataclass(frozen=True, kw_only=True)
class SynthesizeBop(Staged):
    """Render cluttered table tops with exact truth as a BOP data set, and a database of meshes that are not in it.

    For example: vid2demo synthesize bop --scenes 20 --seed 0 --out runs/tables
    """

    scenes: Annotated[int, arg(metavar="N", help="Scenes to render, each of its own things [count].")] = 20
    images: Annotated[int, arg(metavar="N", help="Pictures of each, its things put down anew [count].")] = 1
    size: Annotated[tuple[int, int], arg(metavar="W H", help="Size of the pictures [px].")] = (640, 480)
    seed: Seed = 0

    def do(self) -> Result:
        from .synthetic_bop import stages

        chosen = {"scenes": self.scenes, "images": self.images, "seed": self.seed}
        return self.do_stages(stages(self.out, size_px=self.size, **chosen), {**chosen, "size": self.size})

    def words(self, result: Result) -> str:
        counts = {name: result["stages"][name]["figures"] for name in ("models", "database", "targets")}
        return (
            f"{self.scenes} scenes with {counts['targets']['targets']} targets of {counts['models']['models']} models, "
            f"{counts['database']['meshes']} other meshes of their categories in database.json\nwritten to {self.out}"
        )


@dataclass(frozen=True, kw_only=True)
class EvalBop(Command):
    """Judge a results file: average recalls of CoU, CH and pCH as in the paper, and the error of the scale.

    For example: vid2demo eval-bop ycbv results.csv --json
    """

    dataset: Positional[DatasetFolder]
    results: Positional[Annotated[Path, arg(metavar="RESULTS.csv", help="Poses as BOP has them, or the authors'.")]]
    protocol: Annotated[Literal["official", "paper"], arg(help="The authors' code or the paper's text.")] = "official"
    split: Annotated[str | None, told("NAME", "Folder of the pictures. Default: test, val or train.")] = None
    meshes: Annotated[Path | None, told("DIR", "Where the results' meshes lie. Default: beside the results.")] = None

    def do(self) -> Result:
        from .bop_eval import evaluate_files

        with Terminal() as terminal:
            scores = evaluate_files(
                self.dataset,
                self.results,
                split=self.split,
                protocol=self.protocol,
                meshes=self.meshes,
                progress=terminal.progress,
            )
        return scores.to_json()

    def words(self, result: Result) -> str:
        from .bop_eval import Scores

        return Scores.from_json(result).table()
