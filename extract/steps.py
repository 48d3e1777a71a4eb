"""The stages of this room: a clip rendered, the objects of a video followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from .errors import UserError
from .progress import Progress
from .stages import Stage, plain
from .wording import motion_in_words, symmetry_in_words, unseen_in_words

if TYPE_CHECKING:
    from .choose import Level
    from .refine_tracks import Translation


@dataclass(frozen=True)
class ObjectSettings:
    """One object to follow.

    name: what it is called and, without a mesh, its category in the vessel library.
    box_xywh_px: its box in the start frame, or None: found by the program.
    mesh, mesh_unit: the user's own mesh file and its unit ("auto", "m", "cm", "mm", "in").
    mask: picture of the object in the start frame, white on black.
    mesh_up: axis of the mesh file that points out of the opening, or "auto"; mesh_open_top: cut a closed one open.
    """

    name: str
    box_xywh_px: tuple[float, float, float, float] | None = None
    mesh: Path | None = None
    mesh_unit: str = "auto"
    mask: Path | None = None
    mesh_up: str = "auto"
    mesh_open_top: bool = False

    def __post_init__(self) -> None:
        if self.box_xywh_px is not None and self.mask is not None:
            raise UserError(f"--box and --mask {self.mask} both say where the object is; give one of them")


@dataclass(frozen=True)
class VideoSettings:
    """What decides the tracks of a video's objects.

    camera: (fx, fy, cx, cy) in px, or None: the focal prior.
    start_frame: the frame that boxes and masks belong to, or None: the first, or the best where none are given.
    depth: folder or array of depth pictures, a step of which is depth_scale_mm; None without a depth camera.
    rerun: whether to write extract.rrd.
    method: "region" follows outline, colour and texture; "freepose" goes the paper's way. Of that: translation, one of
    "coarse", "pnp" and "fused", None for the last; level and models_dir, which networks do the seeing.
    """

    video: Path
    object: ObjectSettings
    receptacle: ObjectSettings | None = None
    camera: tuple[float, float, float, float] | None = None
    start_frame: int | None = None
    camera_motion: Literal["auto", "static", "moving"] = "auto"
    depth: Path | None = None
    depth_scale_mm: float = 1.0
    rerun: bool = False
    seed: int = 0
    method: Literal["region", "freepose"] = "region"
    translation: Translation | None = None
    level: Level = "auto"
    models_dir: Path | None = None

    def __post_init__(self) -> None:
        if self.method == "region" and (self.translation or self.models_dir or self.level != "auto"):
            raise UserError("--translation, --level and --models-dir belong to --method freepose; add that")
        if self.method == "freepose" and self.camera_motion == "moving":
            raise UserError("--method freepose takes the camera to stand still; leave out --camera-motion moving")
        if self.method == "freepose" and self.depth is not None:
            raise UserError("--method freepose reads no depth pictures; leave out --depth or --method freepose")
        if self.depth is None and self.depth_scale_mm != 1.0:
            raise UserError(f"--depth-scale {self.depth_scale_mm:g} belongs to --depth PATH; add that")


def video_identity(path: Path) -> dict[str, Any]:
    """What `run.json` keeps of a video. Raises UserError when it cannot be read."""
    from .video import read_video_info

    info = read_video_info(path)
    size = {"width_px": info.width_px, "height_px": info.height_px, "frames": info.frame_count}
    return {"path": str(path), "sha256": info.sha256, **size, "duration_s": info.duration_s}


def settings_record(settings: VideoSettings) -> dict[str, Any]:
    """The settings as `run.json` keeps them."""
    return dict(plain(asdict(settings)))


def synthesize_stage(folder: Path, settings: Mapping[str, Any]) -> Stage:
    """Settings of `extract.synthetic.synthesize` -> a clip with its truth."""

    def work(progress: Progress) -> Mapping[str, Any]:
        from .synthetic import synthesize

        clip = synthesize(out=folder, **settings, progress=progress)
        return {"frames": len(clip.truth), "boxes_xywh_px": clip.boxes_xywh_px}

    outputs = ("video.mp4", "truth.track.npz", "receptacle.track.npz", "settings.json")
    depth = ("depth",) if settings.get("depth") else ()
    return Stage(
        "synthesize", "render a clip with exact truth", work, plain(settings), {}, (*outputs, *depth), ("extract",)
    )


def extract_stage(settings: VideoSettings, folder: Path) -> Stage:
    """Video -> NAME.track.npz of each object, and overlay.mp4."""
    objects = [settings.object, *([settings.receptacle] if settings.receptacle else [])]

    def work(progress: Progress) -> Mapping[str, Any]:
        from .candidates import ObjectRequest

        requests = [ObjectRequest(**vars(o)) for o in objects]
        shared: dict[str, Any] = {name: getattr(settings, name) for name in ("camera", "start_frame", "rerun", "seed")}
        shared |= {"out": folder, "progress": progress}
        if settings.method == "freepose":
            from .video_pose import extract_by_views

            shared |= {"level": settings.level, "models_dir": settings.models_dir}
            shared["translation"] = settings.translation or "fused"
            tracks = extract_by_views(settings.video, requests, **shared)
        else:
            from .perceive import extract

            shared |= {"depth": settings.depth, "depth_scale_mm": settings.depth_scale_mm}
            tracks = extract(settings.video, requests, camera_motion=settings.camera_motion, **shared)
        return {name: _track_figures(track) for name, track in tracks.items()}

    told: dict[str, Any] = {
        "objects": [asdict(o) | {"mesh": None, "mask": None} for o in objects],
        "camera": settings.camera,
    }
    told |= {"start_frame": settings.start_frame, "camera_motion": settings.camera_motion, "seed": settings.seed}
    if settings.method != "region":
        told |= {name: getattr(settings, name) for name in ("method", "translation", "level", "models_dir")}
    if settings.depth is not None:
        told["depth_scale_mm"] = settings.depth_scale_mm
    files = {f"mesh of {o.name}": o.mesh for o in objects if o.mesh is not None}
    files |= {f"mask of {o.name}": o.mask for o in objects if o.mask is not None}
    files |= {"depth": settings.depth} if settings.depth is not None else {}
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
    if unseen := unseen_in_words(track.time_s, track.visible):
        figures["not_seen"] = unseen
    camera = track.header["camera"]
    if camera["motion"]["kind"] != "static":
        figures["camera"] = motion_in_words(camera["motion"])
    if "depth" in how:
        sized = "sizes and distances" if how["depth"]["size_source"] == "depth" else "distances"
        figures["depth"] = f"{sized} measured by {how['depth']['file']}"
    if camera.get("source") == "estimated":
        figures["focal_length"] = f"{camera['focal_px']:g} px, give or take {camera['std_px']:g}, told by the clip"
    faces = mesh.get("faces", {})
    if faces and faces["tracked"] < faces["in_file"]:
        figures["decimated"] = f"{faces['in_file']} faces in the file, {faces['tracked']} tracked"
    return figures
