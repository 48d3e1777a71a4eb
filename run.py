"""`vid2demo run`: the stages between a video and a report, each of which is done only when it must be."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from .demos.steps import (
    ROOMS,
    collect_stage,
    joints_path,
    reference_path,
    reference_stage,
    retarget_stage,
    simulate_stage,
)
from .extract.errors import UserError
from .extract.files import sha256_of_file
from .extract.progress import Listener, Progress
from .extract.stages import PACKAGE_ROOT, Stage, StageError, run_stages
from .extract.steps import ObjectSettings, VideoSettings, extract_stage, settings_record, video_identity


@dataclass(frozen=True)
class RunSettings(VideoSettings):
    """What `vid2demo run` is told: of the video, the scale of the robot's motion and the demonstrations to collect."""

    scale: float | Literal["auto"] = "auto"
    episodes: int = 10


def report_stage(folder: Path, stages: Sequence[Stage]) -> Stage:
    """All that the stages before wrote -> report.html."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .report import write_report

        write_report(folder)
        return {}

    written = {f"{stage.name} output {name}": folder / name for stage in stages for name in stage.outputs}
    code = sha256_of_file(PACKAGE_ROOT / "report.py")
    return Stage("report", "write the report", work, {"report.py": code}, written, ("report.html",), ROOMS)


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
    camera, boxes = truth["camera_matrix"], {k: tuple(box) for k, box in truth["boxes_xywh_px"].items()}
    settings = RunSettings(
        clip / "video.mp4",
        ObjectSettings(category, boxes["object"]),
        ObjectSettings(receptacle, boxes["receptacle"]),
        camera=(camera[0][0], camera[1][1], camera[0][2], camera[1][2]),
        episodes=episodes,
        seed=seed,
    )
    return run(settings, folder, force=force, listener=listener)
