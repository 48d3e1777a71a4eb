"""`vid2demo run` and its parts: the stages between a video and a report, each of which is done only when it must be."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from .extract.errors import UserError
from .extract.files import sha256_of_file, write_json
from .extract.progress import Listener, Progress
from .extract.stages import PACKAGE_ROOT, Stage, StageError, plain, run_stages
from .extract.wording import symmetry_in_words

_ALL = ("extract", "envs", "demos")


@dataclass(frozen=True)
class ObjectSettings:
    """One object to follow.

    name: what it is called and, without a mesh, its category in the vessel library.
    box_xywh_px: its box in the start frame, or None: found by the program.
    mesh, mesh_unit: the user's own mesh file and its unit ("auto", "m", "cm", "mm", "in").
    mask: picture of the object in the start frame, white on black.
    """

    name: str
    box_xywh_px: tuple[float, float, float, float] | None = None
    mesh: Path | None = None
    mesh_unit: str = "auto"
    mask: Path | None = None


@dataclass(frozen=True)
class RunSettings:
    """What `vid2demo run` is told.

    camera: (fx, fy, cx, cy) in px, or None: the focal prior.
    start_frame: the frame that boxes and masks belong to, or None: the first, or the best where none are given.
    rerun: whether to write extract.rrd.
    """

    video: Path
    object: ObjectSettings
    receptacle: ObjectSettings | None = None
    camera: tuple[float, float, float, float] | None = None
    start_frame: int | None = None
    camera_motion: Literal["auto", "static", "moving"] = "auto"
    rerun: bool = False
    scale: float | Literal["auto"] = "auto"
    episodes: int = 10
    seed: int = 0


def video_identity(path: Path) -> dict[str, Any]:
    """What `run.json` keeps of a video. Raises UserError when it cannot be read."""
    from .extract.video import read_video_info

    info = read_video_info(path)
    size = {"width_px": info.width_px, "height_px": info.height_px, "frames": info.frame_count}
    return {"path": str(path), "sha256": info.sha256, **size, "duration_s": info.duration_s}


def settings_record(settings: RunSettings) -> dict[str, Any]:
    """The settings as `run.json` keeps them."""
    return dict(plain(asdict(settings)))


def reference_path(track: Path, folder: Path) -> Path:
    """`folder/kettle.reference.npz` for a track `kettle.track.npz`."""
    return folder / f"{_stem(track)}.reference.npz"


def joints_path(reference: Path, folder: Path) -> Path:
    """`folder/kettle.joints.npz` for a track or a reference of the kettle."""
    return folder / f"{_stem(reference)}.joints.npz"


def synthesize_stage(folder: Path, settings: Mapping[str, Any]) -> Stage:
    """Settings of `extract.synthetic.synthesize` -> a clip with its truth."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .extract.synthetic import synthesize

        clip = synthesize(out=folder, **settings, progress=progress)
        return {"frames": len(clip.truth), "boxes_xywh_px": clip.boxes_xywh_px}

    outputs = ("video.mp4", "truth.track.npz", "receptacle.track.npz", "settings.json")
    return Stage("synthesize", "render a clip with exact truth", work, plain(settings), {}, outputs, ("extract",))


def extract_stage(settings: RunSettings, folder: Path) -> Stage:
    """Video -> NAME.track.npz of each object, and overlay.mp4."""
    objects = [settings.object, *([settings.receptacle] if settings.receptacle else [])]

    def work(progress: Progress) -> Mapping[str, Any]:
        from .extract.perceive import ObjectRequest, extract

        requests = [ObjectRequest(o.name, o.box_xywh_px, o.mesh, o.mesh_unit, o.mask) for o in objects]
        tracks = extract(
            settings.video,
            requests,
            camera=settings.camera,
            start_frame=settings.start_frame,
            camera_motion=settings.camera_motion,
            rerun=settings.rerun,
            out=folder,
            seed=settings.seed,
            progress=progress,
        )
        return {name: _track_figures(track) for name, track in tracks.items()}

    told: dict[str, Any] = {
        "objects": [asdict(o) | {"mesh": None, "mask": None} for o in objects],
        "camera": settings.camera,
    }
    told |= {"start_frame": settings.start_frame, "camera_motion": settings.camera_motion, "seed": settings.seed}
    files = {f"mesh of {o.name}": o.mesh for o in objects if o.mesh is not None}
    files |= {f"mask of {o.name}": o.mask for o in objects if o.mask is not None}
    outputs = [f"{o.name}.{kind}" for o in objects for kind in ("track.npz", "masks.npz", "mask.png")]
    outputs += ["overlay.mp4", *(["extract.rrd"] if settings.rerun else [])]
    return Stage(
        "extract",
        "follow the objects in the video",
        work,
        plain(told),
        {"video": settings.video} | files,
        tuple(outputs),
        ("extract",),
    )


def _track_figures(track: Any) -> dict[str, Any]:
    """What a person wants to know of an ObjectTrack at once."""
    mesh, how = track.header.get("mesh", {}), track.header["settings"]
    figures = {
        "frames": len(track),
        "visible_fraction": float(track.visible.mean()),
        "mean_confidence": float(track.confidence.mean()),
        "mesh": mesh.get("name"),
        "place": f"{how['choice']}, box {' '.join(f'{v:g}' for v in how['box_xywh_px'])} in frame {how['start_frame']}",
        "symmetry": symmetry_in_words(mesh["symmetry"]["order"]),
    }
    if cuts := track.header["video"].get("cuts"):
        times = ", ".join(f"{cut['time_s']:.2f} s" for cut in cuts)
        figures["cuts"] = f"the video jumps to another shot at {times}"
    if (camera := track.header["camera"]["motion"]["kind"]) != "static":
        figures["camera"] = camera
    faces = mesh.get("faces", {})
    if faces and faces["tracked"] < faces["in_file"]:
        figures["decimated"] = f"{faces['in_file']} faces in the file, {faces['tracked']} tracked"
    return figures


def reference_stage(
    track: Path,
    receptacle_track: Path | None,
    folder: Path,
    *,
    receptacle: str | None = None,
    scale: float | Literal["auto"] = "auto",
    seed: int = 0,
) -> Stage:
    """NAME.track.npz (and the receptacle's) -> NAME.reference.npz. receptacle: a library vessel to stand there."""
    output = reference_path(track, folder)

    def work(progress: Progress) -> Mapping[str, Any]:
        from .envs.placement import build_reference
        from .extract.track import ObjectTrack
        from .extract.vessels import make_vessel, resolve_category

        vessel = make_vessel(resolve_category(receptacle)[0]) if receptacle else None
        seen = ObjectTrack.load(receptacle_track) if receptacle_track else None
        reference = build_reference(ObjectTrack.load(track), seen, scale=scale, receptacle=vessel, seed=seed)
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
        {"scale": scale, "seed": seed, "receptacle": receptacle},
        {"track": track} | ({"receptacle track": receptacle_track} if receptacle_track else {}),
        (output.name,),
        ("extract", "envs"),
    )


def retarget_stage(reference: Path, folder: Path) -> Stage:
    """NAME.reference.npz -> NAME.joints.npz and feasibility.json."""
    output = joints_path(reference, folder)

    def work(progress: Progress) -> Mapping[str, Any]:
        from .demos.feasibility import feasibility
        from .demos.retarget import retarget
        from .envs.reference import Reference

        wanted = Reference.load(reference)
        joints = retarget(wanted)
        joints.save(output)
        findings = plain(feasibility(wanted, joints))
        write_json(folder / "feasibility.json", findings)
        shown = ("feasible", "position_error_m", "rotation_error_rad", "words")
        return {name: findings[name] for name in shown if name in findings}

    return Stage(
        "retarget",
        "find the joint motion",
        work,
        {},
        {"reference": reference},
        (output.name, "feasibility.json"),
        _ALL,
    )


def simulate_stage(reference: Path, joints: Path, video: Path | None, folder: Path) -> Stage:
    """Reference and joints (and the video) -> simulation.mp4 and series.json."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .demos.simulate import simulate

        result = plain(simulate(reference, joints, video, folder / "simulation.mp4", progress=progress))
        write_json(folder / "series.json", result["series"])
        return {name: value for name, value in result.items() if name != "series"}

    return Stage(
        "simulate",
        "let the robot pour",
        work,
        {},
        {"reference": reference, "joints": joints} | ({"video": video} if video else {}),
        ("simulation.mp4", "series.json"),
        _ALL,
    )


def collect_stage(reference: Path, folder: Path, *, episodes: int, seed: int, replace: bool = False) -> Stage:
    """Reference -> dataset/ of verified episodes. replace: also where a dataset of another reference is."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .demos.collect import collect, useful_workers

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
        _ALL,
    )


def report_stage(folder: Path, stages: Sequence[Stage]) -> Stage:
    """All that the stages before wrote -> report.html."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .report import write_report

        write_report(folder)
        return {}

    written = {f"{stage.name} output {name}": folder / name for stage in stages for name in stage.outputs}
    code = sha256_of_file(PACKAGE_ROOT / "report.py")
    return Stage("report", "write the report", work, {"report.py": code}, written, ("report.html",), _ALL)


def stages_of(settings: RunSettings, folder: Path) -> list[Stage]:
    """All stages from the video to the report, in order."""
    names = [o.name for o in (settings.object, settings.receptacle) if o is not None]
    for name in names:
        if not name.strip() or Path(name).name != name or name.startswith("."):
            raise UserError(
                f"{name!r} cannot name an object, because its files bear that name; use a word such as kettle"
            )
    if len(set(names)) < len(names):
        raise UserError(f"object and receptacle are both called {names[0]!r}; call one by another word, such as cup")
    track = folder / f"{settings.object.name}.track.npz"
    receptacle = folder / f"{settings.receptacle.name}.track.npz" if settings.receptacle else None
    reference = reference_path(track, folder)
    stages = [
        extract_stage(settings, folder),
        reference_stage(track, receptacle, folder, scale=settings.scale, seed=settings.seed),
        retarget_stage(reference, folder),
        simulate_stage(reference, joints_path(track, folder), settings.video, folder),
        # The folder is this video's, so an older dataset in it is of an older motion of the same.
        collect_stage(reference, folder, episodes=settings.episodes, seed=settings.seed, replace=True),
    ]
    return [*stages, report_stage(folder, stages)]


def run(
    settings: RunSettings, folder: Path, *, force: bool = False, listener: Listener | None = None
) -> dict[str, Any]:
    """The whole way from a video to a dataset and a report. Returns the content of `run.json`.

    Raises UserError for bad input. When the robot cannot do what the video shows, the report is written all the same.
    """
    try:
        return run_stages(
            folder,
            stages_of(settings, folder),
            command="run",
            settings=settings_record(settings),
            video=video_identity(settings.video),
            force=force,
            listener=listener,
        )
    except StageError as error:
        if error.stage in ("extract", "report"):
            raise
        # What was done shows why it went no further, better than a sentence can.
        from .report import write_report

        raise UserError(f"{error}; what was done so far is in {write_report(folder)}") from error


def demo(
    clip: Path,
    folder: Path,
    *,
    category: str,
    receptacle: str,
    seed: int,
    episodes: int,
    force: bool = False,
    listener: Listener | None = None,
) -> dict[str, Any]:
    """`run` on a clip that `synthesize` wrote, told no more of it than a person could tell."""
    truth = json.loads((clip / "settings.json").read_text(encoding="utf-8"))
    camera, box = truth["camera_matrix"], truth["boxes_xywh_px"]["receptacle"]
    settings = RunSettings(
        clip / "video.mp4",
        ObjectSettings(category),
        ObjectSettings(receptacle, (box[0], box[1], box[2], box[3])),
        camera=(camera[0][0], camera[1][1], camera[0][2], camera[1][2]),
        episodes=episodes,
        seed=seed,
    )
    return run(settings, folder, force=force, listener=listener)


def _stem(path: Path) -> str:
    """`kettle` of `runs/coffee/kettle.track.npz`."""
    return path.name.removesuffix(".npz").rpartition(".")[0] or path.stem
