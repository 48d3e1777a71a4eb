"""The command `vid2demo`: parses, calls, prints. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import difflib
import json
import os
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from . import __version__
from .extract.errors import UserError
from .extract.progress import Terminal
from .extract.stages import Stage, plain, run_stages
from .extract.wording import as_lines

Box = tuple[float, float, float, float]
Result = Mapping[str, Any]


def told(metavar: str | None, text: str) -> Any:
    """An option whose help tells its default in words, or a flag."""
    return arg(metavar=metavar, help=text, help_behavior_hint="")


ReferenceFile = Annotated[Path, arg(metavar="REFERENCE", help="A *.reference.npz, as `retarget` writes it.")]
MeshUnit = Annotated[Literal["auto", "m", "cm", "mm", "in"], arg(help="Unit of length of --mesh.")]
Out = Annotated[Path, arg(metavar="DIR", help="Folder for the results; an interrupted command goes on in it.")]
Seed = Annotated[int, arg(metavar="N", help="Seed of every random draw [integer].")]
Episodes = Annotated[int, arg(metavar="N", help="Successful demonstrations to collect [count].")]
Scale = Annotated[
    Literal["auto"] | float,
    arg(metavar="auto|FLOAT", help="Robot's motion over the video's [ratio]; auto takes what the arm can reach."),
]
Category = Annotated[str, arg(metavar="NAME", help="What is poured from: a word or category of `meshes list`.")]
Receiver = Annotated[str, arg(metavar="NAME", help="What is poured into: a word or category of `meshes list`.")]


@dataclass(frozen=True, kw_only=True)
class Command:
    """What all commands have."""

    json: Annotated[bool, told(None, "Print the result as JSON on standard output.")] = False

    def do(self) -> Result:
        raise AssertionError("a command without work")

    def words(self, result: Result) -> str:
        """The result for a person."""
        return "\n".join(as_lines(result))

    def status(self, result: Result) -> int:
        """The exit status: 0 when all is well, 1 when the work is done and its finding is bad."""
        return 0


@dataclass(frozen=True, kw_only=True)
class Staged(Command):
    """A command that writes a folder stage by stage."""

    out: Out
    force: Annotated[bool, told(None, "Do every stage again, even what has not changed.")] = False

    def do_stages(
        self, stages: Sequence[Stage], settings: Mapping[str, Any], video: Mapping[str, Any] | None = None
    ) -> Result:
        command, told = type(self).__name__.lower(), plain(settings)
        record = run_stages(
            self.out, stages, command=command, settings=told, video=video, force=self.force, listener=Terminal()
        )
        return record | {"stages": {stage.name: record["stages"][stage.name] for stage in stages}}

    def words(self, result: Result) -> str:
        text = [line for stage in result["stages"].values() for line in as_lines(stage["figures"])]
        written = [name for stage in result["stages"].values() for name in stage["outputs"]]
        text.append(f"written to {self.out}: {', '.join(written)}")
        return "\n".join([*text, *(f"open {self.out / name}" for name in written if name == "report.html")])


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
    mask: Annotated[Path | None, told("PNG", "The object in the start frame, white on black. Default: cut.")] = None
    start_frame: Annotated[int | None, told("N", "Frame of box and mask; followed both ways. Default: chosen.")] = None
    camera_motion: Annotated[Literal["auto", "static", "moving"], arg(help="Whether the camera moves.")] = "auto"
    rerun: Annotated[bool, told(None, "Write extract.rrd as well, for the Rerun viewer.")] = False
    seed: Seed = 0

    def settings(self, scale: float | Literal["auto"] = "auto", episodes: int = 0) -> Any:
        from .run import ObjectSettings, RunSettings

        return RunSettings(
            self.video,
            ObjectSettings(self.object, self.box, self.mesh, self.mesh_unit, self.mask),
            ObjectSettings(self.receptacle, self.receptacle_box) if self.receptacle else None,
            camera=self.camera,
            start_frame=self.start_frame,
            camera_motion=self.camera_motion,
            rerun=self.rerun,
            scale=scale,
            episodes=episodes,
            seed=self.seed,
        )


@dataclass(frozen=True, kw_only=True)
class Run(FromVideo):
    """Do the whole way: a video in; tracks, a robot motion, a dataset and a report out.

    What has not changed is not done again, so the same command goes on where it was interrupted. It ends by naming
    the report to open.

    For example: vid2demo run coffee.mp4 --object kettle --receptacle mug --out runs/coffee --episodes 10
    """

    scale: Scale = "auto"
    episodes: Episodes = 10

    def do(self) -> Result:
        from .run import run

        return run(self.settings(self.scale, self.episodes), self.out, force=self.force, listener=Terminal())


@dataclass(frozen=True, kw_only=True)
class Extract(FromVideo):
    """Follow the objects in a video: writes NAME.track.npz of each, and overlay.mp4 to look at.

    For example: vid2demo extract coffee.mp4 --object kettle --box 410 120 90 140 --out runs/coffee
    """

    def do(self) -> Result:
        from .run import extract_stage, settings_record, video_identity

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
        from .extract.compare import compare_files

        return compare_files(self.estimate, self.truth, self.mesh, self.mesh_unit, self.symmetry_order, self.out)

    def words(self, result: Result) -> str:
        from .extract.compare import Comparison

        return Comparison.from_json(result).table()


@dataclass(frozen=True, kw_only=True)
class Retarget(Staged):
    """Move a track into the robot's world: writes NAME.reference.npz, NAME.joints.npz and feasibility.json.

    For example: vid2demo retarget runs/coffee/kettle.track.npz --scale 0.8 --out runs/smaller
    """

    track: Positional[Annotated[Path, arg(metavar="TRACK", help="The object's *.track.npz, as `extract` writes it.")]]
    receptacle_track: Annotated[
        Path | None, told("FILE", "The receptacle's *.track.npz. Default: one stands under the lip.")
    ] = None
    receptacle: Annotated[
        str | None, told("NAME", "Stand this vessel of the library under the lip. Default: what the track shows.")
    ] = None
    scale: Scale = "auto"
    seed: Seed = 0

    def do(self) -> Result:
        from .run import reference_path, reference_stage, retarget_stage

        chosen: dict[str, Any] = {"receptacle": self.receptacle, "scale": self.scale, "seed": self.seed}
        first = reference_stage(self.track, self.receptacle_track, self.out, **chosen)
        second = retarget_stage(reference_path(self.track, self.out), self.out)
        chosen |= {"track": self.track, "receptacle_track": self.receptacle_track}
        return self.do_stages([first, second], chosen)


@dataclass(frozen=True, kw_only=True)
class Simulate(Staged):
    """Let the simulated robot pour along a reference: writes simulation.mp4 and series.json.

    For example: vid2demo simulate runs/coffee/kettle.reference.npz --video coffee.mp4 --out runs/coffee
    """

    reference: Positional[ReferenceFile]
    joints: Annotated[Path | None, told("FILE", "The *.joints.npz to play. Default: the one beside the reference.")] = (
        None
    )
    video: Annotated[Path | None, told("VIDEO", "The clip to show beside the robot. Default: the robot alone.")] = None

    def do(self) -> Result:
        from .run import joints_path, simulate_stage

        joints = self.joints or joints_path(self.reference, self.reference.parent)
        stage = simulate_stage(self.reference, joints, self.video, self.out)
        return self.do_stages([stage], {"reference": self.reference, "joints": joints, "video": self.video})


@dataclass(frozen=True, kw_only=True)
class Collect(Staged):
    """Collect demonstrations with varied start and receptacle: writes a LeRobot v3.0 dataset to DIR/dataset.

    Only successful episodes are kept, each replayed to the same end, bit for bit, before it is written.

    For example: vid2demo collect runs/coffee/kettle.reference.npz --episodes 50 --out runs/coffee50
    """

    reference: Positional[ReferenceFile]
    episodes: Episodes = 10
    seed: Seed = 0

    def do(self) -> Result:
        from .run import collect_stage

        chosen = {"episodes": self.episodes, "seed": self.seed}
        stage = collect_stage(self.reference, self.out, episodes=self.episodes, seed=self.seed, replace=self.force)
        return self.do_stages([stage], {"reference": self.reference, **chosen})


@dataclass(frozen=True, kw_only=True)
class Replay(Command):
    """Play every episode of a dataset again from its stored seed and actions; tell how many end the same.

    The exit status is 1 when an episode ends otherwise.

    For example: vid2demo replay runs/coffee/dataset
    """

    dataset: Positional[Annotated[Path, arg(metavar="DATASET", help="A dataset folder that `collect` wrote.")]]

    def do(self) -> Result:
        from .demos.replay import replay

        with Terminal() as terminal:
            return replay(self.dataset, progress=terminal.progress)

    def words(self, result: Result) -> str:
        from .demos.replay import as_text

        return as_text(result)

    def status(self, result: Result) -> int:
        return 0 if result["same_end"] == result["episodes"] else 1


@dataclass(frozen=True, kw_only=True)
class Play(Command):
    """Watch the simulated robot pour, and the reference as a ghost: in MuJoCo's window, or without a screen in an mp4.

    For example: vid2demo play --vessel bottle, vid2demo play runs/coffee/kettle.reference.npz --out coffee.mp4
    """

    reference: Positional[Annotated[Path | None, told("REFERENCE", "A *.reference.npz. Default: built in.")]] = None
    joints: Annotated[Path | None, told("FILE", "The *.joints.npz to play. Default: solved for here.")] = None
    vessel: Annotated[str | None, told("NAME", "Pour from this: mug, mug:3, ... Default: the reference's.")] = None
    receptacle: Annotated[str | None, told("NAME", "Pour into this. Default: the reference's.")] = None
    particles: Annotated[int, arg(metavar="N", help="How many particles are poured [count].")] = 100
    randomization: Annotated[Literal["none", "low", "high"], arg(help="What the seed may change.")] = "none"
    camera: Annotated[Literal["front", "side", "wrist"], arg(help="Where the mp4 is taken from.")] = "front"
    size: Annotated[tuple[int, int], arg(metavar="W H", help="Size of the mp4's picture [px].")] = (640, 480)
    out: Annotated[Path | None, told("FILE", "The mp4. Default: a window; without a screen runs/play.mp4.")] = None
    seed: Seed = 0

    def do(self) -> Result:
        from .demos.joints import JointTrajectory
        from .envs.play import play

        arguments: dict[str, Any] = {"num_particles": self.particles, "randomization": self.randomization}
        arguments |= {"vessel": self.vessel, "receptacle": self.receptacle}
        arguments |= {"render_camera": self.camera, "render_size": self.size[::-1]}
        q_rad = None if self.joints is None else JointTrajectory.load(self.joints).q_rad
        with Terminal() as terminal:
            return play(self.reference, q_rad, self.out, self.seed, arguments, terminal.progress)


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Write report.html of a run's folder anew: one page with videos, plots, findings and the next commands.

    For example: vid2demo report runs/coffee
    """

    folder: Positional[Annotated[Path, arg(metavar="DIR", help="Folder of a run, with its run.json.")]]

    def do(self) -> Result:
        from .report import write_report

        return {"report": str(write_report(self.folder))}


@dataclass(frozen=True, kw_only=True)
class Meshes(Command):
    """The library of vessels: list the categories, show one's measures and parameters, or export its mesh.

    For example: vid2demo meshes list, vid2demo meshes show mug --seed 3,
    vid2demo meshes export mug --out meshes --format stl
    """

    action: Positional[Annotated[Literal["list", "show", "export"], arg(help="What to do.")]]
    name: Positional[Annotated[str | None, arg(metavar="NAME", help="Category, for show and export.")]] = None
    out: Annotated[Path | None, arg(metavar="DIR", help="Folder to export to.")] = None
    format: Annotated[Literal["obj", "stl", "ply", "glb"], arg(help="File format of export; lengths in m.")] = "obj"
    seed: Annotated[int | None, told("N", "A seeded variant [integer]. Default: the nominal one.")] = None

    def do(self) -> Result:
        from .extract.catalogue import catalogue

        return catalogue(self.action, self.name, self.seed, self.out, self.format)


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
    seed: Seed = 0

    def do(self) -> Result:
        from .run import synthesize_stage

        settings = {"category": self.category, "receptacle": self.receptacle, "seed": self.seed, "size": self.size}
        settings |= {"seconds": self.seconds, "fps": self.fps, "occluder": not self.without_hand}
        return self.do_stages([synthesize_stage(self.out, settings)], settings)


@dataclass(frozen=True, kw_only=True)
class Demo(Staged):
    """Show the whole way without a video of yours: render a clip to DIR/clip, then do `run` on it.

    For example: vid2demo demo --out runs/demo
    """

    out: Out = Path("runs/demo")
    category: Category = "mug"
    receptacle: Receiver = "bowl"
    seconds: Annotated[float, arg(metavar="S", help="Length of the clip [s].")] = 6.0
    episodes: Episodes = 3
    seed: Seed = 0

    def do(self) -> Result:
        from .run import demo

        chosen: dict[str, Any] = {"category": self.category, "receptacle": self.receptacle, "seed": self.seed}
        clip = self.out / "clip"
        Synthesize(out=clip, force=self.force, seconds=self.seconds, **chosen).do()
        return demo(clip, self.out, **chosen, episodes=self.episodes, force=self.force, listener=Terminal())


COMMANDS: dict[str, type[Command]] = {
    re.sub(r"(?<!^)(?=[A-Z])", "-", c.__name__).lower(): c
    for c in (Run, Extract, CompareTrack, Retarget, Simulate, Play, Collect, Replay, Report, Meshes, Synthesize, Demo)
}


def usage() -> str:
    """What `vid2demo --help` prints."""
    commands = "\n".join(f"  {name:<13} {(c.__doc__ or '').splitlines()[0]}" for name, c in COMMANDS.items())
    return f"""usage: vid2demo COMMAND [options]

A video of a person pouring in; a robot environment, verified robot demonstrations and a report out.

Begin with one of
  vid2demo demo
  vid2demo run VIDEO --object kettle --receptacle mug --out runs/coffee

commands:
{commands}

  vid2demo COMMAND --help tells a command's options, with an example;  vid2demo --version tells the version"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit status: 0 good, 1 not all well, 2 bad input, 130 interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # no screen is needed
    try:
        status = _dispatch(words)
        sys.stdout.flush()
        return status
    except UserError as error:
        print(f"vid2demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nvid2demo: interrupted; to go on, type again:", shlex.join(["vid2demo", *words]), file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _dispatch(words: list[str]) -> int:
    name = words[0] if words else "--help"
    if name in ("-h", "--help", "help"):
        print(usage())
        return 0 if words else 2
    if name == "--version":
        print(f"vid2demo {__version__}")
        return 0
    if name not in COMMANDS:
        hint = "".join(f" (did you mean {close}?)" for close in difflib.get_close_matches(name, COMMANDS, n=1))
        raise UserError(f"unknown command {name!r}{hint}; there are {', '.join(COMMANDS)}")
    command = tyro.cli(COMMANDS[name], prog=f"vid2demo {name}", args=words[1:], config=(tyro.conf.FlagCreatePairsOff,))
    result = plain(command.do())
    print(json.dumps(result, indent=2, allow_nan=False) if command.json else command.words(result))
    return command.status(result)
