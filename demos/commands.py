"""The commands of this room: move a track to the robot, let it pour, collect demonstrations, replay them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..extract.command import Command, Commands, Episodes, Result, Scale, Seed, Staged, told
from ..extract.progress import Terminal

ReferenceFile = Annotated[Path, arg(metavar="REFERENCE", help="A *.reference.npz, as `retarget` writes it.")]

JointsFile = Annotated[Path, arg(metavar="JOINTS", help="A *.joints.npz, as `retarget` writes it.")]
SolverName = Annotated[
    Literal["auto", "torque", "mink"],
    arg(help="Joint motion by optimal torques, or by inverse kinematics alone; auto: torques where installed."),
]


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
    speed: Annotated[float, arg(metavar="FLOAT", help="Robot's speed over the video's, at most [ratio].")] = 1.0
    elevation: Annotated[
        float, arg(metavar="DEG", help="How far the camera looks down, unless something upright tells it [deg].")
    ] = 30.0
    solver: SolverName = "auto"
    seed: Seed = 0

    def do(self) -> Result:
        from .steps import reference_path, reference_stage, retarget_stage

        chosen: dict[str, Any] = {
            "receptacle": self.receptacle,
            "scale": self.scale,
            "speed": self.speed,
            "elevation_deg": self.elevation,
            "seed": self.seed,
        }
        first = reference_stage(self.track, self.receptacle_track, self.out, **chosen)
        second = retarget_stage(reference_path(self.track, self.out), self.out, solver=self.solver)
        chosen |= {"track": self.track, "receptacle_track": self.receptacle_track, "solver": self.solver}
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
    grasp: Annotated[
        Literal["weld", "friction"], arg(help="The vessel is a part of the hand, or held by the fingers' friction.")
    ] = "weld"
    video: Annotated[Path | None, told("VIDEO", "The clip to show beside the robot. Default: the robot alone.")] = None

    def do(self) -> Result:
        from .steps import joints_path, simulate_stage

        joints = self.joints or joints_path(self.reference, self.reference.parent)
        stage = simulate_stage(self.reference, joints, self.video, self.out, grasp=self.grasp)
        chosen = {"reference": self.reference, "joints": joints, "video": self.video, "grasp": self.grasp}
        return self.do_stages([stage], chosen)


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
        from ..envs.play import play
        from .joints import JointTrajectory

        arguments: dict[str, Any] = {"num_particles": self.particles, "randomization": self.randomization}
        arguments |= {"vessel": self.vessel, "receptacle": self.receptacle}
        arguments |= {"render_camera": self.camera, "render_size": self.size[::-1]}
        q_rad = None if self.joints is None else JointTrajectory.load(self.joints).q_rad
        with Terminal() as terminal:
            return play(self.reference, q_rad, self.out, self.seed, arguments, terminal.progress)


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
        from .steps import collect_stage

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
        from .replay import replay

        with Terminal() as terminal:
            return replay(self.dataset, progress=terminal.progress)

    def words(self, result: Result) -> str:
        from .replay import as_text

        return as_text(result)

    def status(self, result: Result) -> int:
        return 0 if result["same_end"] == result["episodes"] else 1


@dataclass(frozen=True, kw_only=True)
class ExportTrajectory(Command):
    """Write a joint motion for a real arm: commands at 1 kHz as CSV, or a ROS JointTrajectory as JSON.

    What the Panda's datasheet forbids is not written; the error names joint, time, value and limit.

    For example: vid2demo export-trajectory runs/coffee/kettle.joints.npz --format ros
    """

    joints: Positional[JointsFile]
    format: Annotated[Literal["csv", "ros"], arg(help="csv: 1 kHz rows of time, q, dq, tau, gripper; ros: JSON.")] = (
        "csv"
    )
    out: Annotated[
        Path | None, told("FILE", "The file to write. Default: beside JOINTS, its name with the format's.")
    ] = None

    def do(self) -> Result:
        from .check_trajectory import export_file

        return export_file(self.joints, self.format, self.out)


@dataclass(frozen=True, kw_only=True)
class CheckTrajectory(Command):
    """Check that a Panda would take a trajectory: position, speed, acceleration, jerk, torque and their continuity.

    Takes what `export-trajectory` writes, or a *.joints.npz. The exit status is 1 when a limit is broken.

    For example: vid2demo check-trajectory runs/coffee/kettle.csv
    """

    file: Positional[Annotated[Path, arg(metavar="FILE", help="A .csv or .json of `export-trajectory`, or joints.")]]

    def do(self) -> Result:
        from .check_trajectory import check_file

        return check_file(self.file)

    def words(self, result: Result) -> str:
        from .check_trajectory import as_text

        return as_text(result)

    def status(self, result: Result) -> int:
        return 0 if result["ok"] else 1


@dataclass(frozen=True, kw_only=True)
class Figure(Command):
    """Draw a run: figure.png with rows input, prediction and simulation, and joints.png with all limits.

    For example: vid2demo figure runs/coffee --times 0.5 2 3.5
    """

    folder: Positional[Annotated[Path, arg(metavar="DIR", help="Folder of a run, with its films.")]]
    times: Annotated[tuple[float, ...] | None, told("S ...", "Moments of the video [s]. Default: evenly over it.")] = (
        None
    )
    columns: Annotated[int, arg(metavar="N", help="How many moments, where no times are given [count].")] = 5

    def do(self) -> Result:
        from .figure import figure

        return figure(self.folder, self.times, self.columns)


COMMANDS: Commands = {
    "retarget": Retarget,
    "figure": Figure,
    "export-trajectory": ExportTrajectory,
    "check-trajectory": CheckTrajectory,
    "simulate": Simulate,
    "play": Play,
    "collect": Collect,
    "replay": Replay,
}
