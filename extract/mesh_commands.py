"""The commands about databases of meshes, and the poses of what a picture shows by one of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from .command import Box, Command, Commands, Result, told
from .progress import Terminal

if TYPE_CHECKING:
    from .mesh_store import MeshStore

Database = Annotated[Path | None, told("DB", "A mesh database, as `meshes onboard` makes it. Default: the library.")]
Encoder = Annotated[str | None, told("NAME", "Descriptors to use, where a database has several.")]
Views = Annotated[int | None, told("N", "Views an object, where a database has several [count].")]
ModelsDir = Annotated[Path | None, told("DIR", "Folder of the networks. Default: as `models list` says.")]
MeshName = Positional[Annotated[str | None, arg(metavar="NAME", help="A category, a mesh's name, or a word for one.")]]


@dataclass(frozen=True, kw_only=True)
class MeshesOnboard(Command):
    """Take meshes into a database: cleaned, normalised, seen from all sides, described. Goes on where it was stopped.

    FOLDER holds GLB, OBJ, PLY or STL files: Objaverse's folders (its own package, our extra `objaverse`, fetches them),
    those of Google Scanned Objects, folders named by category, or anything flat. The word "library" stands for seeded
    variants of the vessels that ship.

    For example: vid2demo meshes onboard scans --out runs/meshes --workers 8
    """

    folder: Positional[Annotated[Path, arg(metavar="FOLDER", help="Where the meshes are, or the word library.")]]
    out: Annotated[Path, arg(metavar="DB", help="The database; made when missing, added to when not.")] = Path(
        "runs/meshes"
    )
    category: Annotated[str | None, told("NAME", "What all of them are. Default: what the folders say.")] = None
    unit: Annotated[Literal["auto", "m", "cm", "mm", "in"], arg(help="Unit of length of the files.")] = "auto"
    views: Annotated[int, arg(metavar="N", help="Views of each mesh [count].")] = 600
    features: Annotated[str, arg(metavar="NAME", help="classical, or a network of `models list`.")] = "classical"
    block: Annotated[int | None, told("N", "Block whose tokens are taken. Default: as in the paper.")] = None
    models_dir: ModelsDir = None
    variants: Annotated[int, arg(metavar="N", help="Of each category of the library [count].")] = 3
    workers: Annotated[int, arg(metavar="N", help="Processes, or CPUs of a Ray started here [count].")] = 1
    ray: Annotated[bool, told(None, "Work on the Ray cluster at RAY_ADDRESS, or on one started here.")] = False
    gpus: Annotated[float, arg(metavar="N", help="Of a Ray task, for networks; may be a share [count].")] = 0.0

    def do(self) -> Result:
        from .errors import UserError
        from .mesh_sources import LIBRARY, find_sources, library_sources
        from .onboarding import onboard
        from .templates import ViewSettings

        for name, value, most in (("views", self.views, 20_000), ("workers", self.workers, 1024)):
            if not 1 <= value <= most:
                raise UserError(f"--{name} {value} is out of range; give 1 to {most}")
        of_library = str(self.folder) == LIBRARY and not self.folder.is_dir()
        sources = library_sources(self.variants) if of_library else find_sources(self.folder, self.category)
        options = {"models_dir": self.models_dir, "block": self.block}
        with Terminal() as terminal:
            result = onboard(
                sources,
                self.out,
                settings=ViewSettings(count=self.views),
                encoder=self.features,
                options=tuple((k, str(v)) for k, v in options.items() if v is not None),
                unit_name=self.unit,
                workers=self.workers,
                ray=self.ray,
                gpus=self.gpus,
                progress=terminal.progress,
            )
        return {
            "database": str(self.out),
            "stored": len(result.stored),
            "there_before": len(result.before),
            "equal_to_others": result.same,
            "left_out": [{"name": name, "reason": reason} for name, reason in result.failed],
        }

    def words(self, result: Result) -> str:
        lines = [
            f"{result['stored']} meshes stored in {result['database']}, {result['there_before']} were there before",
            *(f"same as another: {name}" for name in result["equal_to_others"]),
            *(f"left out: {entry['name']}: {entry['reason']}" for entry in result["left_out"]),
        ]
        return "\n".join(lines)

    def status(self, result: Result) -> int:
        return 1 if result["left_out"] else 0


@dataclass(frozen=True, kw_only=True)
class MeshesList(Command):
    """List the meshes of a database, or without one the categories of the library with the measures of each.

    For example: vid2demo meshes list, vid2demo meshes list --db runs/meshes
    """

    db: Database = None
    encoder: Encoder = None
    views: Views = None

    def do(self) -> Result:
        if self.db is None:
            from .catalogue import list_categories

            return list_categories()
        store = _opened(self.db, self.encoder, self.views)
        rows = [
            {
                "name": about.name,
                "category": about.category,
                "extents_m": [round(v, 4) for v in about.extents_m] if about.unit else None,
                "views": store.settings.count,
                "source": about.source,
            }
            for about in store.index().about()
        ]
        return {"meshes": sorted(rows, key=lambda row: (row["category"], row["name"]))}

    def words(self, result: Result) -> str:
        if "meshes" not in result:
            return super().words(result)
        lines = []
        for row in result["meshes"]:
            extents = " x ".join(f"{v:.3f}" for v in row["extents_m"]) + " m" if row["extents_m"] else "size unknown"
            named = f"{row['name']:<28} {row['category'] or '-':<20}"
            lines.append(f"{named} {extents:<25} {row['views']} views  {row['source']}")
        return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class MeshesShow(Command):
    """Show what is known of a mesh of a database, or without one a vessel's measures and parameters.

    For example: vid2demo meshes show mug --seed 3, vid2demo meshes show red_mug --db runs/meshes
    """

    name: MeshName = None
    seed: Annotated[int | None, told("N", "A seeded variant [integer]. Default: the nominal one.")] = None
    db: Database = None
    encoder: Encoder = None
    views: Views = None

    def do(self) -> Result:
        if self.db is None:
            from .catalogue import describe

            return describe(self.name, self.seed)
        from .mesh_show import describe_stored

        return describe_stored(_opened(self.db, self.encoder, self.views), self.name)


@dataclass(frozen=True, kw_only=True)
class MeshesFind(Command):
    """Find the meshes most like an object that a video shows: it is masked all the way, and its frames vote.

    Where networks for depth and words are at hand they read its size too, frame by frame; the median counts.

    For example: vid2demo meshes find coffee.mp4 --box 345 297 488 342 --db runs/meshes
    """

    video: Positional[Annotated[Path, arg(metavar="VIDEO", help="The clip.")]]
    db: Database = None
    encoder: Encoder = None
    views: Views = None
    box: Annotated[Box | None, told("X Y W H", "The object's box in the first frame [px].")] = None
    mask: Annotated[Path | None, told("PNG", "The object in the first frame, white on black.")] = None
    object: Annotated[str | None, told("WORD", "Look only among meshes that this names.")] = None
    frames: Annotated[int, arg(metavar="N", help="Frames that vote, spread over the video [count].")] = 30
    level: Annotated[
        Literal["auto", "foundation", "classical"], arg(help="Networks where their weights are at hand, or not.")
    ] = "auto"
    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .choose import Chosen, choose
        from .classical_segment import ClassicalSegmenter
        from .features import features_of
        from .find_mesh import SizeMeans, find_in_video
        from .model_folder import models_folder
        from .retrieval import Retriever
        from .scale import SizeReader
        from .video import read_video_info

        read_video_info(self.video)  # as for a picture, see `Pose`
        with Terminal() as terminal:
            store = _opened(self.db, self.encoder, self.views) if self.db else _library(terminal)
        kind: dict[str, Any] = {"level": self.level, "models_dir": self.models_dir}
        segmenter = choose("segmenter", ClassicalSegmenter, **kind)
        depth: Chosen[Any] = choose("depth", lambda: None, **kind)
        words: Chosen[Any] = choose("words", lambda: None, **kind)
        sizes = None
        if depth.made is not None and words.made is not None:
            sizes = SizeMeans(SizeReader(words.made, cache=models_folder(self.models_dir)), depth.made)
        options = {"models_dir": str(self.models_dir)} if self.models_dir else {}
        found = find_in_video(
            self.video,
            Retriever(store),
            features_of(store.encoder, options),
            segmenter.made,
            box_xywh_px=self.box,
            mask_file=self.mask,
            text=self.object,
            frames=self.frames,
            sizes=sizes,
        )
        meshes = [
            {"name": hit.about.name, "category": hit.about.category, "score": round(hit.score, 4), "key": hit.key}
            for hit in found.hits
        ]
        told = {"segmenter": segmenter.line(), "frames": list(found.frames), "meshes": meshes, "size_m": found.size_m}
        return told | {"size": f"{depth.line()}, {words.line()}"}

    def words(self, result: Result) -> str:
        rows = [f"{m['score']:.3f}  {m['name']:<28} {m['category']}" for m in result["meshes"]]
        voted = f"{len(result['frames'])} frames voted"
        if result["size_m"] is not None:
            voted += f"; largest extent {result['size_m']:.3f} m ({result['size']})"
        return "\n".join([result["segmenter"], voted, *rows])


@dataclass(frozen=True, kw_only=True)
class MeshesCheck(Command):
    """Check that every mesh, every record of views and every row of a database is what its name says.

    The exit status is 1 when something is not.

    For example: vid2demo meshes check --db runs/meshes
    """

    db: Annotated[Path, arg(metavar="DB", help="A mesh database, as `meshes onboard` makes it.")]
    encoder: Encoder = None
    views: Views = None

    def do(self) -> Result:
        store = _opened(self.db, self.encoder, self.views)
        problems = store.check()
        return {"meshes": len(store.keys()), "problems": problems}

    def words(self, result: Result) -> str:
        return "\n".join(result["problems"]) or f"{result['meshes']} meshes, each under its own name"

    def status(self, result: Result) -> int:
        return 1 if result["problems"] else 0


@dataclass(frozen=True, kw_only=True)
class Pose(Command):
    """Find the objects of a picture: which mesh each is like, how large, where and how it lies.

    Writes poses.csv (BOP's format), poses.json, overlay.png to look at, and each mesh in metres. Without --db the
    vessels that ship are the database; it is made at the first call, in a few minutes.

    For example: vid2demo pose table.jpg --box 210 80 140 190 --out runs/table
    """

    image: Positional[Annotated[Path, arg(metavar="IMAGE", help="A picture: PNG, JPEG, ...")]]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    db: Database = None
    encoder: Encoder = None
    views: Views = None
    box: Annotated[
        UseAppendAction[tuple[Box, ...]], told("X Y W H", "An object's box [px]; may be given again. Default: found.")
    ] = ()
    mask: Annotated[
        UseAppendAction[tuple[Path, ...]], told("PNG", "An object, white on black; may be given again.")
    ] = ()
    camera: Annotated[Box | None, told("FX FY CX CY", "Intrinsics [px]. Default: f = sqrt(w^2 + h^2), centred.")] = None
    object: Annotated[str | None, told("WORD", "Look only among meshes that this names.")] = None
    prompt: Annotated[str, arg(metavar="TEXT", help="What a detector that reads looks for.")] = "objects."
    meshes: Annotated[int, arg(metavar="N", help="Retrieved meshes that compete by their poses [count].")] = 1
    level: Annotated[
        Literal["auto", "foundation", "classical"], arg(help="Networks where their weights are at hand, or not.")
    ] = "auto"
    models_dir: ModelsDir = None

    def do(self) -> Result:
        from .pose_image import PictureSettings, pose_picture, read_picture

        read_picture(self.image)  # told at once when it cannot be: the library may take minutes to make
        settings = PictureSettings(
            self.image, self.box, self.mask, self.camera, self.object, self.prompt, self.meshes, self.level,
            self.models_dir,
        )  # fmt: skip
        with Terminal() as terminal:
            store = _opened(self.db, self.encoder, self.views) if self.db else _library(terminal)
            return pose_picture(settings, store, self.out)

    def words(self, result: Result) -> str:
        lines = [result["segmenter"], result["size"]]
        for found in result["objects"]:
            x, y, z = (row[3] for row in found["T_camera_object"][:3])
            others = ", ".join(other["name"] for other in found["others"][:3])
            lines.append(
                f"{found['name']}: {100 * found['size_m']:.1f} cm ({found['size_from']}) at {x:.3f} {y:.3f} {z:.3f} m, "
                f"score {found['score']:.2f}; next: {others}"
            )
        return "\n".join([*lines, f"written to {self.out}; open {self.out / 'overlay.png'}"])


def _opened(db: Path, encoder: str | None, views: int | None) -> MeshStore:
    from .mesh_store import MeshStore

    return MeshStore.open(db, encoder, views)


def _library(terminal: Terminal) -> MeshStore:
    """The vessels that ship as a database, made in the user's cache when it is not there yet."""
    from .features import ClassicalFeatures
    from .mesh_sources import library_sources
    from .mesh_store import MeshStore
    from .onboarding import onboard
    from .templates import ViewSettings

    root = Path(os.environ.get("VID2DEMO_LIBRARY") or Path.home() / ".cache" / "vid2demo" / "library")
    sources = library_sources(3)
    store = MeshStore.create(root, ViewSettings(), ClassicalFeatures())
    if len(store.keys()) < len(sources):
        onboard(sources, root, workers=os.cpu_count() or 1, progress=terminal.progress)
    return store


COMMANDS: Commands = {
    "meshes onboard": MeshesOnboard,
    "meshes list": MeshesList,
    "meshes show": MeshesShow,
    "meshes find": MeshesFind,
    "meshes check": MeshesCheck,
    "pose": Pose,
}
