"""The commands that make, read and judge data sets in BOP's format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from .command import Result, Seed, Staged


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
