"""report.html: everything a run left behind, on one page that needs no server, no network and no other file."""

from __future__ import annotations

import base64
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from .demos.joints import JointTrajectory
from .demos.page_style import SCRIPT, STYLE
from .demos.plots import Line, Mark, chart, motion_rows, tries_figure
from .envs.reference import Reference
from .extract.errors import UserError
from .extract.files import write_text
from .extract.geometry import Array, angle_between_rad
from .extract.track import ObjectTrack

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_VIDEO_BYTES = 24 << 20
_STAGES = ("extract", "reference", "retarget", "simulate", "collect")
_GOOD_POSITION_MM, _GOOD_ROTATION_DEG = 10.0, 5.0
_CAMERA_AXES, _WORLD_AXES = ("x right", "y down", "z away"), ("x forward", "y left", "z up")


@dataclass
class Found:
    """What was readable in a run's folder; `problems` says in words what was not."""

    folder: Path
    record: dict[str, Any] = field(default_factory=dict)
    tracks: dict[str, ObjectTrack] = field(default_factory=dict)
    reference: Reference | None = None
    joints: JointTrajectory | None = None
    feasibility: dict[str, Any] = field(default_factory=dict)
    series: dict[str, Array] = field(default_factory=dict)
    dataset: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """What the handled object is called."""
        told = _at(self.record, "settings", "object", "name")
        return str(told or next(iter(self.tracks), "object"))

    @property
    def target(self) -> str:
        """What is poured into."""
        told = _at(self.record, "settings", "receptacle", "name")
        return str(told or next((n for n in self.tracks if n != self.name), "receptacle"))

    def last(self, key: str) -> float | None:
        """The final value of a series, None without one."""
        value = self.series.get(key)
        finite = value[np.isfinite(value)] if value is not None and value.ndim == 1 else np.zeros(0)
        return float(finite[-1]) if len(finite) else None


def write_report(run_dir: Path, out: Path | None = None) -> Path:
    """Write the page about a run's folder to `out` (default: report.html in it) and return its path.

    What is missing or damaged is named on the page. Raises UserError when the folder does not exist.
    """
    run_dir = Path(run_dir)
    if not run_dir.is_dir():
        raise UserError(f"run folder {run_dir} does not exist; give the --out folder of `vid2demo run`")
    out = Path(out) if out is not None else run_dir / "report.html"
    write_text(out, page(read(run_dir)))
    return out


def read(folder: Path) -> Found:
    """Read whatever is there."""
    found = Found(folder)

    def attempt[T](path: Path, load: Callable[[Path], T]) -> T | None:
        if not path.exists():
            return None
        try:
            return load(path)
        except (OSError, ValueError, KeyError, TypeError) as error:  # UserError is a ValueError
            found.problems.append(f"{path.name} cannot be read: {error}")
            return None

    found.record = attempt(folder / "run.json", _read_object) or {}
    found.feasibility = attempt(folder / "feasibility.json", _read_object) or {}
    found.series = attempt(folder / "series.json", _read_series) or {}
    found.dataset = attempt(folder / "dataset" / "meta" / "info.json", _read_object) or {}
    for path in sorted(folder.glob("*.track.npz")):
        if (track := attempt(path, ObjectTrack.load)) is not None:
            found.tracks[path.name.removesuffix(".track.npz")] = track
    found.tracks = dict(sorted(found.tracks.items(), key=lambda item: item[0] != found.name))
    for path in _first(folder, found.name, "reference"):
        found.reference = attempt(path, Reference.load)
    for path in _first(folder, found.name, "joints"):
        found.joints = attempt(path, JointTrajectory.load)
    return found


def verdict(found: Found) -> tuple[str, bool]:
    """One sentence about the run, and whether all is well."""
    done = [stage for stage in _STAGES if stage in found.record.get("stages", {})]
    poured, spilled = found.last("poured_fraction"), found.last("spilled_fraction")
    said, well = [], True
    if poured is not None:
        spill = f" and spills {spilled:.0%}" if spilled is not None else ""
        said.append(f"pours {poured:.0%} of the {found.name}'s contents into the {found.target}{spill}")
        well &= poured >= 0.6
    if (position := found.series.get("position_error_m")) is not None and np.isfinite(position).any():
        mean_mm, worst_mm = 1000 * float(np.nanmean(position)), 1000 * float(np.nanmax(position))
        said.append(
            f"keeps the {found.name} within {mean_mm:.1f} mm of the reference on average ({worst_mm:.1f} at worst)"
        )
        well &= mean_mm <= _GOOD_POSITION_MM
    if "feasible" in found.feasibility:
        well &= bool(found.feasibility["feasible"])
        if not found.feasibility["feasible"]:
            said.append("cannot follow the motion everywhere")
    episodes = found.dataset.get("total_episodes")
    so_far = f"The {found.name} was followed in the video" if found.tracks else "There is nothing to show yet"
    sentence = f"The robot {_join(said)}" if said else so_far
    if episodes:
        sentence += f"; {episodes} verified demonstration{'s are' if episodes != 1 else ' is'} in the dataset"
    if missing := [stage for stage in _STAGES if stage not in done]:
        sentence += f". Not done: {', '.join(missing)}"
        well = False
    return sentence + ".", well


def page(found: Found) -> str:
    """The whole page."""
    text, well = verdict(found)
    video = Path(str(_at(found.record, "video", "path") or "")).name
    title = f"{found.name} to {found.target}" if len(found.tracks) > 1 else found.name
    body = [
        f'<header><p class="from">vid2demo{f" · {escape(video)}" if video else ""}</p><h1>{escape(title)}</h1>'
        f'<p class="verdict {"well" if well else "ill"}">{escape(text)}</p>{_tiles(found)}</header>',
        "".join(f'<p class="missing">{escape(problem)}</p>' for problem in found.problems),
        f'<section><h2>See it</h2><div class="videos">{_videos(found)}</div></section>',
        f'<section><h2>In the video</h2><div class="plots">{_track_plots(found)}</div></section>',
        f'<section><h2>On the robot</h2><div class="plots">{_robot_plots(found)}</div></section>',
        f"<section><h2>Can the arm do it?</h2>{_feasibility(found)}</section>",
        f"<section><h2>Go on</h2>{_commands(found)}</section>",
        f'<section><h2>How it was made</h2><div class="tables">{_tables(found)}</div></section>',
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} · vid2demo</title><style>{STYLE}</style></head><body><main>"
        f"{''.join(body)}</main><script>{SCRIPT}</script></body></html>\n"
    )


def _tiles(found: Found) -> str:
    tiles: list[tuple[str, str]] = []
    if found.reference is not None:
        tiles.append((f"{np.rad2deg(found.reference.tilt_rad.max()):.0f}°", "greatest tilt"))
        tiles.append((f"{found.reference.scale:.2f}", "scale of the motion"))
    for key, factor, unit, label in (
        ("position_error_m", 1000.0, "mm", "position error, mean"),
        ("rotation_error_rad", 180 / math.pi, "°", "rotation error, mean"),
    ):
        if (value := found.series.get(key)) is not None and np.isfinite(value).any():
            tiles.append((f"{factor * np.nanmean(value):.1f}{' ' if unit == 'mm' else ''}{unit}", label))
    for key, label in (("poured_fraction", "poured"), ("spilled_fraction", "spilled")):
        if (part := found.last(key)) is not None:
            tiles.append((f"{part:.0%}", label))
    if "total_episodes" in found.dataset:
        tiles.append((str(found.dataset["total_episodes"]), "episodes in the dataset"))
    if timings := _timings(found):
        tiles.append((_duration(sum(timings.values())), "of computing"))
    items = "".join(f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for value, label in tiles)
    return f"<dl>{items}</dl>" if tiles else ""


def _videos(found: Found) -> str:
    parts = []
    for name, says, stage in (
        ("overlay", "The objects found in the video, drawn over it", "extract"),
        ("simulation", "The video and the robot on one clock", "simulate"),
    ):
        path = found.folder / f"{name}.mp4"
        if not path.is_file():
            parts.append(_missing(f"{name}.mp4", stage))
            continue
        try:
            data = base64.b64encode(_small_enough(path)).decode()
        except (OSError, UserError) as error:
            parts.append(f'<p class="missing">{escape(f"{name}.mp4 cannot be read: {error}")}</p>')
            continue
        parts.append(
            f'<figure><video id="{name}" controls muted loop playsinline preload="metadata" '
            f'src="data:video/mp4;base64,{data}"></video><figcaption>{says}</figcaption></figure>'
        )
    return "".join(parts)


def _small_enough(path: Path) -> bytes:
    """A video's bytes; one too large for a page is encoded anew, smaller. Raises UserError when it is no video."""
    from .extract.video import VideoWriter, iterate_frames, read_video_info

    info = read_video_info(path)
    if path.stat().st_size <= MAX_VIDEO_BYTES:
        return path.read_bytes()
    with TemporaryDirectory() as folder:
        small = Path(folder) / path.name
        with VideoWriter(small, info.fps, crf=30) as writer:
            for frame in iterate_frames(path, max_side_px=854):
                writer.write(frame.rgb, frame.time_s)
        return small.read_bytes()


def _track_plots(found: Found) -> str:
    track = found.tracks.get(found.name)
    if track is None:
        return _missing(f"{found.name}.track.npz", "extract")
    T, time_s = track.from_first_camera().T_camera_object, track.time_s
    where = "the camera frame" if track.T_first_camera is None else "the first frame's camera"
    axis = T[:, :3, :3] @ np.asarray(track.symmetry.axis)
    lean_deg = np.rad2deg(angle_between_rad(axis, np.broadcast_to(axis[0], axis.shape)))
    hidden = ~track.visible
    position = [Line(label, T[:, k, 3], k + 1) for k, label in enumerate(_CAMERA_AXES)]
    trust = [
        Line(name, t.confidence, k + 1) for k, (name, t) in enumerate(found.tracks.items()) if len(t) == len(track)
    ]
    return "".join(
        (
            chart(f"{found.name}: position in {where}", "m", time_s, position, hidden=hidden, clock="overlay"),
            chart(f"{found.name}: tilt since the first frame", "°", time_s, [Line("tilt", lean_deg)], hidden=hidden,
                  limits=(0.0, None), clock="overlay"),
            chart("confidence", "0 to 1", time_s, trust, hidden=hidden, limits=(0.0, 1.0), clock="overlay"),
        )
    )  # fmt: skip


def _robot_plots(found: Found) -> str:
    parts, clock = [], "simulation"
    series, time_s = found.series, found.series.get("time_s")
    if found.reference is not None:
        at, T = found.reference.time_s, found.reference.T_world_object
        position = [Line(label, T[:, k, 3], k + 1) for k, label in enumerate(_WORLD_AXES)]
        parts.append(chart(f"{found.name}: position asked of the robot", "m", at, position, clock=clock))
        if time_s is None:
            wanted = [Line("asked", np.rad2deg(found.reference.tilt_rad))]
            parts.append(chart("tilt", "°", at, wanted, limits=(0.0, None), clock=clock))
    else:
        parts.append(_missing(f"{found.name}.reference.npz", "reference"))
    if time_s is None or len(time_s) < 2:
        parts.append(_missing("series.json", "simulate"))
    else:
        if _fits(series, "tilt_rad"):
            tilts = [Line("reached", np.rad2deg(series["tilt_rad"]))]
            if _fits(series, "reference_tilt_rad"):
                tilts.append(Line("asked", np.rad2deg(series["reference_tilt_rad"]), 2, dashed=True))
            parts.append(chart(f"{found.name}: tilt", "°", time_s, tilts, limits=(0.0, None), clock=clock))
        for key, label, unit, factor, good in (
            ("position_error_m", "position error", "mm", 1000.0, _GOOD_POSITION_MM),
            ("rotation_error_rad", "rotation error", "°", 180 / math.pi, _GOOD_ROTATION_DEG),
        ):
            if _fits(series, key):
                mark = (Mark(good, f"good: up to {good:g}{'' if unit == '°' else ' '}{unit}"),)
                parts.append(chart(f"tracking: {label}", unit, time_s, [Line(label, factor * series[key])],
                                   marks=mark, limits=(0.0, None), clock=clock))  # fmt: skip
        flows = [
            Line(label, 100 * series[key], color)
            for key, label, color in (("poured_fraction", "poured", 1), ("spilled_fraction", "spilled", 2))
            if _fits(series, key)
        ]
        if flows:
            parts.append(chart(f"contents of the {found.name}", "%", time_s, flows, limits=(0.0, 100.0), clock=clock))
    if found.joints is not None:
        parts.append(motion_rows(found.joints, clock=clock))
    else:
        parts.append(_missing(f"{found.name}.joints.npz", "retarget"))
    return "".join(parts)


def _feasibility(found: Found) -> str:
    words = found.feasibility.get("words")
    if not isinstance(words, list):
        return _missing("feasibility.json", "retarget")
    kind = "well" if found.feasibility.get("feasible", True) else "ill"
    rest = "".join(f"<li>{escape(str(word))}</li>" for word in words[1:])
    first = f'<p class="finding {kind}">{escape(str(words[0]))}</p>' if words else ""
    tries = found.feasibility.get("scale_search") or []
    curve = tries_figure(tries) if len(tries) > 1 else ""
    return f'{first}<ul class="words">{rest}</ul>{curve}'


def _commands(found: Found) -> str:
    folder = shlex.quote(str(found.folder))
    reference = f"{found.folder}/{found.name}.reference.npz"
    steps = [
        ("Replay every episode and see how many end the same", f"vid2demo replay {folder}/dataset"),
        (
            "Train a policy on the demonstrations",
            f"lerobot-train --dataset.repo_id=local/{shlex.quote(found.name)} \\\n"
            f"  --dataset.root={folder}/dataset \\\n"
            f"  --policy.type=act --policy.push_to_hub=false \\\n  --wandb.enable=false --output_dir={folder}/act",
        ),
        (
            "Use the environment from Python",
            "import gymnasium as gym\n\n"
            f'env = gym.make("vid2demo:PandaPour-v0", reference={json.dumps(reference, ensure_ascii=False)})\n'
            "observation, info = env.reset(seed=0)",
        ),
    ]
    if again := _again(found):
        steps.insert(0, ("Go on where the run was interrupted", again))
    return "".join(
        f"<div class=command><p>{escape(says)}</p><pre><code>{escape(text)}</code></pre></div>" for says, text in steps
    )


def _again(found: Found) -> str | None:
    """The command that finishes an unfinished run."""
    settings = found.record.get("settings") or {}
    if not settings.get("video") or all(stage in found.record.get("stages", {}) for stage in _STAGES):
        return None
    words = ["vid2demo", "run", str(settings["video"]), "--object", found.name]
    for role in ("object", "receptacle"):
        given = settings.get(role) or {}
        words += ["--receptacle", str(given.get("name"))] if role == "receptacle" and given else []
        if box := given.get("box_xywh_px"):
            words += ["--box" if role == "object" else "--receptacle-box", *(f"{v:g}" for v in box)]
    if settings.get("camera"):
        words += ["--camera", *(f"{v:g}" for v in settings["camera"])]
    if mesh := _at(settings, "object", "mesh"):
        words += ["--mesh", str(mesh), "--mesh-unit", str(_at(settings, "object", "mesh_unit") or "auto")]
        words += ["--mesh-up", str(_at(settings, "object", "mesh_up") or "auto")]
        words += ["--mesh-open-top"] if _at(settings, "object", "mesh_open_top") else []
    words += ["--scale", str(settings.get("scale", "auto")), "--episodes", str(settings.get("episodes", 10))]
    return shlex.join([*words, "--seed", str(settings.get("seed", 0)), "--out", str(found.folder)])


def _tables(found: Found) -> str:
    timings = _timings(found)
    names = dict.fromkeys((*_STAGES, *timings)) if found.record else timings
    stages = {name: _duration(timings[name]) if name in timings else "not done" for name in names}
    if timings:
        stages["together"] = _duration(sum(timings.values()))
    dataset = {
        name.removeprefix("total_"): found.dataset[name]
        for name in ("total_episodes", "total_frames", "fps", "robot_type", "codebase_version")
        if name in found.dataset
    }
    meshes = {name: _mesh_words(track.header.get("mesh") or {}) for name, track in found.tracks.items()}
    tables = (
        ("Stages", stages),
        ("Objects", meshes),
        ("Pours tried", {str(k + 1): _try_words(t) for k, t in enumerate(found.feasibility.get("scale_search") or [])}),
        ("Dataset", dataset),
        ("Settings", _flat(found.record.get("settings") or {})),
        ("Video", _flat(found.record.get("video") or {})),
        ("Versions", _flat(found.record.get("versions") or {})),
        ("Machine", _flat(found.record.get("machine") or {})),
    )
    parts = [] if found.record else [_missing("run.json", "run")]
    for caption, rows in tables:
        cells = "".join(f"<tr><th>{escape(k)}</th><td>{escape(_text(v))}</td></tr>" for k, v in rows.items())
        parts.append(f"<table><caption>{caption}</caption>{cells}</table>" if cells else "")
    return "".join(parts)


def _try_words(tried: Mapping[str, Any]) -> str:
    moved_cm = 100 * math.hypot(tried["along_m"], tried["across_m"])
    what = f"scale {tried['scale']:.2f}, receptacle moved {moved_cm:.0f} cm, tipped {tried['tip_deg']:.0f}° further"
    came = f"{100 * tried['poured']:.0f}% poured, {100 * tried['spilled']:.0f}% spilled"
    return f"{what}: {came}{' (chosen)' if tried['chosen'] else ''}"


def _missing(what: str, stage: str) -> str:
    how = "`vid2demo run` writes it." if stage == "run" else f"The stage “{stage}” writes it."
    return f'<p class="missing"><b>{escape(what)}</b> is not there (yet). {escape(how)}</p>'


def _mesh_words(mesh: Mapping[str, Any]) -> str:
    extents = mesh.get("extents_m") or []
    size = " × ".join(f"{100 * float(e):.1f}" for e in extents)
    return f"{mesh.get('name', 'mesh')}{f', {size} cm' if size else ''}"


def _timings(found: Found) -> dict[str, float]:
    stages = found.record.get("stages") or {}
    return {name: float(s["seconds"]) for name, s in stages.items() if isinstance(s, dict) and "seconds" in s}


def _read_object(path: Path) -> dict[str, Any]:
    value = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(value, dict):
        raise ValueError("it does not hold a JSON object")
    return value


def _read_series(path: Path) -> dict[str, Array]:
    series = {name: np.array(v, dtype=float) for name, v in _read_object(path).items() if isinstance(v, list)}
    return {name: value for name, value in series.items() if value.size}


def _fits(series: Mapping[str, Array], key: str) -> bool:
    return key in series and series[key].shape == series["time_s"].shape


def _first(folder: Path, name: str, kind: str) -> list[Path]:
    named = folder / f"{name}.{kind}.npz"
    return [named] if named.exists() else sorted(folder.glob(f"*.{kind}.npz"))[:1]


def _at(value: Any, *keys: str) -> Any:
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, entry in value.items():
        out |= _flat(entry, f"{prefix}{key} ") if isinstance(entry, Mapping) else {f"{prefix}{key}": entry}
    return out


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(v) for v in value)
    return str(value)


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{round(seconds) // 60}:{round(seconds) % 60:02d} min"


def _join(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
