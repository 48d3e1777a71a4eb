"""The commands about neural networks: which there are, fetching them, where they lie, writing them as ONNX files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from .command import Command, Commands, Result, told

ModelName = Positional[Annotated[str, arg(metavar="NAME", help="A network of `models list`.")]]
ModelsDir = Annotated[
    Path | None, told("DIR", "Folder of the networks. Default: $VID2DEMO_MODELS, else ~/.cache/vid2demo/models.")
]


@dataclass(frozen=True, kw_only=True)
class ModelsList(Command):
    """List the neural networks that perception can use, and which are on this machine.

    For example: vid2demo models list
    """

    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .model_folder import find_folder, models_folder
        from .models import MODELS

        def row(name: str) -> dict[str, object]:
            card = MODELS[name]
            folder, _ = find_folder(card, self.models_dir)
            return {
                "part": card.part,
                "size_mb": card.size_mb,
                "licence": card.licence,
                "non_commercial": card.non_commercial,
                "used_for": card.used_for,
                "repository": card.repository,
                "revision": card.revision,
                "folder": None if folder is None else str(folder),
            }

        return {"folder": str(models_folder(self.models_dir)), "models": {name: row(name) for name in MODELS}}

    def words(self, result: Result) -> str:
        rows = [("name", "part", "MB", "licence", "here", "used for")]
        for name, row in result["models"].items():
            here = "yes" if row["folder"] else "no"
            licence = row["licence"] + (" (non-commercial)" if row["non_commercial"] else "")
            rows.append((name, row["part"], str(row["size_mb"]), licence, here, row["used_for"]))
        widths = [max(len(row[k]) for row in rows) for k in range(5)]
        lines = ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[5]]) for row in rows]
        return "\n".join([*lines, f"kept in {result['folder']}; fetch one with `vid2demo models pull NAME`"])


@dataclass(frozen=True, kw_only=True)
class ModelsPull(Command):
    """Fetch a network from the Hugging Face hub, at its pinned revision.

    For example: vid2demo models pull dinov2-small
    """

    name: ModelName
    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .model_folder import pull
        from .models import model_card

        card = model_card(self.name)
        folder = pull(card, self.models_dir)
        return {
            "model": card.name,
            "folder": str(folder),
            "revision": card.revision,
            "licence": card.licence,
        }


@dataclass(frozen=True, kw_only=True)
class ModelsPath(Command):
    """Print where a network lies, or where networks are kept.

    For example: vid2demo models path dinov2-small
    """

    name: Positional[Annotated[str | None, arg(metavar="NAME", help="A network of `models list`.")]] = None
    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .model_folder import models_folder, require_folder
        from .models import model_card

        if self.name is None:
            return {"folder": str(models_folder(self.models_dir))}
        return {"folder": str(require_folder(model_card(self.name), self.models_dir))}

    def words(self, result: Result) -> str:
        return str(result["folder"])


@dataclass(frozen=True, kw_only=True)
class ModelsExport(Command):
    """Write a patch encoder or a depth network as an ONNX file, which runs without torch.

    For example: vid2demo models export dinov2-small --out dinov2-small.onnx
    """

    name: ModelName
    out: Annotated[Path, arg(metavar="FILE", help="The file to write, ending in .onnx.")]
    models_dir: ModelsDir = None
    block: Annotated[int | None, told("N", "Patch encoders: the block to stop after. Default: the paper's.")] = None
    picture: Annotated[tuple[int, int], arg(metavar="W H", help="Depth: size of the pictures it will see [px].")] = (
        640,
        480,
    )

    def do(self) -> Result:
        from .onnx_export import export_model

        facts = export_model(self.name, self.out, models_dir=self.models_dir, block=self.block, picture_px=self.picture)
        return {"file": str(self.out), "size_mb": round(self.out.stat().st_size / 1e6, 1), **facts}


COMMANDS: Commands = {
    "models list": ModelsList,
    "models pull": ModelsPull,
    "models path": ModelsPath,
    "models export": ModelsExport,
}
