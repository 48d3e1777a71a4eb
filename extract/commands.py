"""The commands of this room: follow objects in a video, measure tracks, look at vessels, render clips."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from .bench_commands import BenchPose, BenchTable
from .bop_commands import EvalBop, SynthesizeBop
from .command import Box, Category, Command, Commands, MeshUnit, Receiver, Result, Seed, Staged, told
from .mesh_commands import COMMANDS as MESH_COMMANDS
from .mesh_commands import MeshName
from .models_commands import COMMANDS as MODELS_COMMANDS

if TYPE_CHECKING:
    from .steps import VideoSettings

MeshUp = Annotated[
    Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"], arg(help="Axis of --mesh that points out of its opening.")
]
MeshSeed = Annotated[int | None, told("N", "A seeded variant [integer]. Default: the nominal one.")]


@dataclass(frozen=True, kw_only=True)
class FromVideo(Staged):
    """A command that looks at a video."""

    video: Positional[Annotated[Path, arg(metavar="VIDEO", help="The clip: any file with a video that FFmpeg reads.")]]
    object: Annotated[str, arg(metavar="NAME", help="What is handled: a word such as kettle; see `meshes list`.")]
    receptacle: Annotated[
        str | None,
        told("NAME", "What is poured into, such as mug. Default: not followed; one stands under the lip."),
    ] = None
    box: Annotated[Box | None, told("X Y W H", "The object's box in the start frame [px]. Default: found.")] = None
    receptacle_box: Annotated[Box | None, told("X Y W H", "The receptacle's box there [px]. Default: found.")] = None
    camera: Annotated[Box | None, told("FX FY CX CY", "Intrinsics [px]. Default: f = sqrt(w^2 + h^2), centred.")] = None
    mesh: Annotated[Path | None, told("FILE", "Your mesh: obj, ply, stl, glb. Default: the library's.")] = None
    mesh_unit: MeshUnit = "auto"
    mesh_up: MeshUp = "auto"
    mesh_open_top: Annotated[bool, told(None, "Take a closed --mesh as a hollow that is open at its top.")] = False
    mask: Annotated[Path | None, told("PNG", "The object in the start frame, white on black. Default: cut.")] = None
    start_frame: Annotated[int | None, told("N", "Frame of box and mask; followed both ways. Default: chosen.")] = None
    camera_motion: Annotated[Literal["auto", "static", "moving"], arg(help="Whether the camera moves.")] = "auto"
    depth: Annotated[
        Path | None,
        told("PATH", "Depth pictures aligned to the frames: a folder of 16-bit PNGs, or one .npy. Default: none."),
    ] = None
    depth_scale: Annotated[float, arg(metavar="MM", help="Depth that one step of --depth stands for [mm].")] = 1.0
    rerun: Annotated[bool, told(None, "Write extract.rrd as well, for the Rerun viewer.")] = False
    method: Annotated[
        Literal["region", "freepose"], arg(help="By outline, colour and texture; or the paper's way, by views.")
    ] = "region"
    translation: Annotated[
        Literal["coarse", "pnp", "fused"] | None,
        told(None, "Of --method freepose: by single frames, by point tracks or by both. Default: fused."),
    ] = None
    level: Annotated[
        Literal["auto", "foundation", "classical"],
        arg(help="Of --method freepose: networks where their weights are at hand, or not."),
    ] = "auto"
    models_dir: Annotated[
        Path | None, told("DIR", "Of --method freepose: folder of the networks. Default: as `models list` says.")
    ] = None
    seed: Seed = 0

    def settings(self) -> VideoSettings:
        from .steps import ObjectSettings, VideoSettings

        return VideoSettings(
            self.video,
            ObjectSettings(
                self.object, self.box, self.mesh, self.mesh_unit, self.mask, self.mesh_up, self.mesh_open_top
            ),
            ObjectSettings(self.receptacle, self.receptacle_box) if self.receptacle else None,
            camera=self.camera,
            start_frame=self.start_frame,
            camera_motion=self.camera_motion,
            depth=self.depth,
            depth_scale_mm=self.depth_scale,
            rerun=self.rerun,
            seed=self.seed,
            method=self.method,
            translation=self.translation,
            level=self.level,
            models_dir=self.models_dir,
        )


@dataclass(frozen=True, kw_only=True)
class Extract(FromVideo):
    """Follow the objects in a video: writes NAME.track.npz of each, and overlay.mp4 to look at.

    For example: vid2demo extract coffee.mp4 --object kettle --box 410 120 90 140 --out runs/coffee
    """

    def do(self) -> Result:
        from .steps import extract_stage, settings_record, video_identity

        settings, identity = self.settings(), video_identity(self.video)
        return self.do_stages([extract_stage(settings, self.out)], settings_record(settings), identity)


@dataclass(frozen=True, kw_only=True)
class CompareTrack(Command):
    """Measure a track against the truth: the paper's errors of motion, and errors of single poses.

    For example: vid2demo compare-track runs/coffee/kettle.track.npz truth.npz --mesh kettle.obj --mesh-unit mm
    """

    estimate: Positional[Annotated[Path, arg(metavar="ESTIMATE", help="A *.track.npz, as `extract` writes it.")]]
    truth: Positional[Annotated[Path, arg(metavar="TRUTH", help="A track, or an npz of its arrays; see the README.")]]
    mesh: Annotated[Path | None, told("FILE", "The object's mesh in the truth's frame. Default: no ADD.")] = None
    mesh_unit: MeshUnit = "auto"
    symmetry_order: Annotated[
        int | None, told("N", "Turns about +z that look the same, 0 for any [count]. Default: the truth's own.")
    ] = None
    out: Annotated[Path | None, told("FILE", "Write the figures to this JSON file. Default: only print.")] = None

    def do(self) -> Result:
        from .compare import compare_files

        return compare_files(self.estimate, self.truth, self.mesh, self.mesh_unit, self.symmetry_order, self.out)

    def words(self, result: Result) -> str:
        from .compare import Comparison

        return Comparison.from_json(result).table()


@dataclass(frozen=True, kw_only=True)
class MeshesExport(Command):
    """Write a vessel's mesh, in m, and its description to a folder.

    For example: vid2demo meshes export mug --out meshes --format stl
    """

    name: MeshName = None
    out: Annotated[Path | None, arg(metavar="DIR", help="Folder to export to.")] = None
    format: Annotated[Literal["obj", "stl", "ply", "glb"], arg(help="File format; lengths in m.")] = "obj"
    seed: MeshSeed = None

    def do(self) -> Result:
        from .catalogue import export

        return export(self.name, self.seed, self.out, self.format)


@dataclass(frozen=True, kw_only=True)
class Synthesize(Staged):
    """Render a clip of a pour with exact truth: video.mp4, truth.track.npz, receptacle.track.npz, settings.json.

    For example: vid2demo synthesize --category mug --seed 0 --out runs/clip
    """

    category: Category = "mug"
    receptacle: Receiver = "bowl"
    seconds: Annotated[float, arg(metavar="S", help="Length of the clip [s].")] = 6.0
    fps: Annotated[float, arg(metavar="HZ", help="Frame rate [Hz].")] = 25.0
    size: Annotated[tuple[int, int], arg(metavar="W H", help="Size of the picture [px], even numbers.")] = (640, 480)
    without_hand: Annotated[bool, told(None, "Leave out the hand that hides a part of the vessel.")] = False
    depth: Annotated[bool, told(None, "Write a depth camera's pictures as well: depth/*.png, in mm.")] = False
    camera_path: Annotated[
        Literal["still", "turn", "walk"], arg(help="Stand, turn in place, or be carried around the table.")
    ] = "still"
    seed: Seed = 0

    def do(self) -> Result:
        from .steps import synthesize_stage

        settings = {"category": self.category, "receptacle": self.receptacle, "seed": self.seed, "size": self.size}
        settings |= {"seconds": self.seconds, "fps": self.fps, "occluder": not self.without_hand}
        settings |= {"depth": True} if self.depth else {}
        settings |= {"camera_path": self.camera_path} if self.camera_path != "still" else {}
        return self.do_stages([synthesize_stage(self.out, settings)], settings)


COMMANDS: Commands = {
    "extract": Extract,
    "compare-track": CompareTrack,
    **MESH_COMMANDS,
    "meshes export": MeshesExport,
    "synthesize": Synthesize,
    "synthesize bop": SynthesizeBop,
    "eval-bop": EvalBop,
    "bench pose": BenchPose,
    "bench table": BenchTable,
    **MODELS_COMMANDS,
}
