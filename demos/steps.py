"""The stages of this room: a track placed before the robot, joints found for it, poured along, and collected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..extract.files import write_json
from ..extract.progress import Progress
from ..extract.stages import Stage, plain

if TYPE_CHECKING:
    from ..envs.reference import Reference

ROOMS = ("extract", "envs", "demos")  # whose code decides what comes out here


def reference_path(track: Path, folder: Path) -> Path:
    """`folder/kettle.reference.npz` for a track `kettle.track.npz`."""
    return folder / f"{_stem(track)}.reference.npz"


def joints_path(reference: Path, folder: Path) -> Path:
    """`folder/kettle.joints.npz` for a track or a reference of the kettle."""
    return folder / f"{_stem(reference)}.joints.npz"


def reference_stage(
    track: Path,
    receptacle_track: Path | None,
    folder: Path,
    *,
    receptacle: str | None = None,
    scale: float | Literal["auto"] = "auto",
    speed: float = 1.0,
    elevation_deg: float = 30.0,
    seed: int = 0,
) -> Stage:
    """NAME.track.npz (and the receptacle's) -> NAME.reference.npz. receptacle: a library vessel to stand there.

    scale: "auto" gives way to a touch of table or receptacle (`without_contact`), then takes what pours best in the
        simulator, if the faithful motion does not pour well; a number changes nothing but the size.
    speed: of the motion over the video's. elevation_deg: how far the camera looks down, where nothing upright tells.
    """
    output = reference_path(track, folder)

    def work(progress: Progress) -> Mapping[str, Any]:
        from ..envs.placement import build_reference
        from ..extract.track import ObjectTrack
        from ..extract.vessels import make_vessel, resolve_category
        from .feasibility import without_contact
        from .scale_search import search_scale

        vessel = make_vessel(resolve_category(receptacle)[0]) if receptacle else None
        seen = ObjectTrack.load(receptacle_track) if receptacle_track else None
        moved = ObjectTrack.load(track)

        def build(wanted: float | Literal["auto"]) -> Reference:
            chosen: dict[str, Any] = {"scale": wanted, "speed": speed, "elevation_deg": elevation_deg, "seed": seed}
            return build_reference(moved, seen, receptacle=vessel, **chosen)

        if scale == "auto":
            reference = search_scale(without_contact(build(scale)), lambda s: without_contact(build(s)), progress)
        else:
            reference = build(scale)
        reference.save(output)
        return {
            "knots": len(reference),
            "duration_s": reference.duration_s,
            "scale": reference.scale,
            "largest_tilt_deg": math.degrees(float(reference.tilt_rad.max())),
        }

    return Stage(
        "reference",
        "place the motion in the robot's workspace",
        work,
        {"scale": scale, "speed": speed, "elevation_deg": elevation_deg, "seed": seed, "receptacle": receptacle},
        {"track": track} | ({"receptacle track": receptacle_track} if receptacle_track else {}),
        (output.name,),
        ROOMS,
    )


def retarget_stage(reference: Path, folder: Path, *, solver: Literal["auto", "torque", "mink"] = "auto") -> Stage:
    """NAME.reference.npz -> NAME.joints.npz and feasibility.json. solver: see `retarget.retarget`."""
    from .optimize import is_available

    output = joints_path(reference, folder)
    # What "auto" means changes with what is installed, and then the stage is to be done again.
    chosen = ("torque" if is_available() else "mink") if solver == "auto" else solver

    def work(progress: Progress) -> Mapping[str, Any]:
        from ..envs.reference import Reference
        from .feasibility import feasibility
        from .retarget import retarget

        wanted = Reference.load(reference)
        joints = retarget(wanted, solver=solver)
        joints.save(output)
        findings = plain(feasibility(wanted, joints))
        write_json(folder / "feasibility.json", findings)
        shown = ("feasible", "solver", "position_error_m", "rotation_error_rad", "words")
        return {name: findings[name] for name in shown if name in findings}

    return Stage(
        "retarget",
        "find the joint motion",
        work,
        {"solver": chosen},
        {"reference": reference},
        (output.name, "feasibility.json"),
        ROOMS,
    )


def simulate_stage(
    reference: Path, joints: Path, video: Path | None, folder: Path, *, grasp: Literal["weld", "friction"] = "weld"
) -> Stage:
    """Reference and joints (and the video) -> simulation.mp4 and series.json. grasp: how the hand holds the vessel."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .simulate import simulate

        film, how = folder / "simulation.mp4", {"grasp": grasp}
        result = plain(simulate(reference, joints, video, film, env_kwargs=how, progress=progress))
        write_json(folder / "series.json", result["series"])
        return {name: value for name, value in result.items() if name != "series"}

    return Stage(
        "simulate",
        "let the robot pour",
        work,
        {"grasp": grasp},
        {"reference": reference, "joints": joints} | ({"video": video} if video else {}),
        ("simulation.mp4", "series.json"),
        ROOMS,
    )


def collect_stage(reference: Path, folder: Path, *, episodes: int, seed: int, replace: bool = False) -> Stage:
    """Reference -> dataset/ of verified episodes. replace: also where a dataset of another reference is."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .collect import collect, useful_workers

        dataset, workers = folder / "dataset", useful_workers(episodes)
        return collect(
            reference, dataset, episodes=episodes, seed=seed, workers=workers, force=replace, progress=progress
        )

    return Stage(
        "collect",
        "collect demonstrations, each replayed before it is kept",
        work,
        {"episodes": episodes, "seed": seed},
        {"reference": reference},
        ("dataset",),
        ROOMS,
    )


def _stem(path: Path) -> str:
    """`kettle` of `runs/coffee/kettle.track.npz`."""
    return path.name.removesuffix(".npz").rpartition(".")[0] or path.stem
