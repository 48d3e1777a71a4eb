"""Synthetic videos of a person pouring, with the exact pose of every object: the demo's clip and the tests' oracle.

The camera matrix is OpenCV's: the centre of the first pixel is (0, 0), and the renderer's principal point, in the
middle of the picture, ((width - 1) / 2, (height - 1) / 2).
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .files import atomic_path, write_json
from .geometry import Array, invert_pose
from .offscreen import load_mujoco
from .progress import Progress
from .synthetic_camera import CAMERA_PATHS, CameraPath, move_camera
from .synthetic_depth import sensed_depth
from .synthetic_hand import Grip, grips
from .synthetic_motion import Camera, PourPath, PourShape, place_camera, plan_pour
from .synthetic_scene import OBJECT, RECEPTACLE, Scene
from .synthetic_studio import Sensor
from .track import ObjectTrack
from .vessel_types import Vessel
from .vessels import make_vessel, resolve_category
from .video import VideoWriter, read_video_info

SCHEMA = "vid2demo/synthetic-clip"
VISIBLE_FRACTION = 0.1
ENOUGH_VISIBLE = 0.5
DEPTH_FOLDER = "depth"
MAX_FRAMES = 3000
MAX_SIDE_PX = 1920
MIN_SIDE_PX = 64


@dataclass(frozen=True)
class SyntheticClip:
    """What `synthesize` wrote.

    truth, receptacle: exact tracks, poses in the camera frame.  boxes_xywh_px: first-frame boxes by role.
    visible_fraction: (N,) share of the vessel's pixels that nothing hides (1 = all of it, 0 = out of view).
    """

    video: Path
    truth_path: Path
    receptacle_path: Path
    settings_path: Path
    truth: ObjectTrack
    receptacle: ObjectTrack
    settings: Mapping[str, Any]
    visible_fraction: Array

    @property
    def boxes_xywh_px(self) -> dict[str, tuple[int, int, int, int]]:
        boxes: dict[str, tuple[int, int, int, int]] = self.settings["boxes_xywh_px"]
        return boxes


def synthesize(
    category: str = "mug",
    seed: int = 0,
    out: Path | str = Path("runs/synthetic"),
    *,
    receptacle: str = "bowl",
    seconds: float = 6.0,
    fps: float = 25.0,
    size: tuple[int, int] = (640, 480),
    occluder: bool = True,
    noise: bool = True,
    depth: bool = False,
    camera_path: CameraPath = "still",
    progress: Progress | None = None,
) -> SyntheticClip:
    """Render a seeded pour into `out`: video.mp4, truth.track.npz, receptacle.track.npz and settings.json.

    category, receptacle: library vessels (a word that names several, such as "kettle", draws one of them).
    size: (width, height) in px, even.  occluder: a hand and forearm.  noise: sensor noise, blur and white balance;
    the video is compressed either way.  depth: also write the pictures of a depth camera at the same place, in mm, with
    its noise and holes, to the folder `depth`.  camera_path: the camera stands still, turns in place by a few degrees
    (pan, tilt and roll), or is carried around the table; the tracks then hold its exact T_first_camera. Equal
    arguments give equal poses and equal pictures on one machine.
    Raises UserError for an unknown category or camera path, an impossible size, length or rate.
    """
    _check(seconds, fps, size, camera_path)
    out = Path(out)
    rng = np.random.default_rng(seed)
    names = {"object": _choose(rng, category), "receptacle": _choose(rng, receptacle)}
    vessel, bowl = (make_vessel(name, int(rng.integers(1 << 31))) for name in names.values())
    shape = PourShape(
        points_m=np.asarray(vessel.mesh.vertices, float),
        outlet_m=np.asarray(vessel.outlet.point_m, float),
        outlet_kind=vessel.outlet.kind,
        receptacle_points_m=np.asarray(bowl.mesh.vertices, float),
        rim_radius_m=float(bowl.interior.radius_m[-1]),
    )
    path = plan_pour(rng, shape, seconds, fps)
    camera, height_share = place_camera(rng, path, shape, size)
    # Drawn apart, so that a clip is the same whether or not its camera could move.
    camera, T_world_camera = move_camera(np.random.default_rng([seed, 2]), camera, path, shape, size, camera_path)
    sensor = Sensor(rng, size) if noise else None
    video, count = out / "video.mp4", len(path.time_s)
    visible = np.zeros(count)
    boxes: dict[str, list[int] | None] = {}
    scene_seed = int(rng.integers(1 << 31))
    depth_rng = np.random.default_rng([seed, 1])  # its own, so that the pictures are the same without it
    if depth:
        shutil.rmtree(out / DEPTH_FOLDER, ignore_errors=True)  # of a longer clip
    choices: list[Grip | None] = [*grips(rng, vessel.grasps)] if occluder else [None]
    scene = _scene(scene_seed, vessel, bowl, path, camera, T_world_camera, size, choices)
    with scene, VideoWriter(video, fps) as writer:
        notes = scene.notes
        for k in range(count):
            picture = scene.render(k)
            writer.write(sensor.expose(picture, rng) if sensor else picture)
            if depth:
                _write_depth(out / DEPTH_FOLDER / f"{k:06d}.png", sensed_depth(scene.depth(k), depth_rng))
            visible[k] = scene.visible_fraction(k)
            if k == 0:
                labels = scene.labels(k)
                boxes = {"object": _box_of(labels == OBJECT), "receptacle": _box_of(labels == RECEPTACLE)}
            if progress is not None:
                progress(k + 1, count, "rendering")

    info = read_video_info(video)
    if info.frame_count != count:
        raise RuntimeError(f"{video} holds {info.frame_count} frames, {count} were written")
    settings: dict[str, Any] = {
        "schema": SCHEMA,
        "version": 1,
        "category": category,
        "receptacle": receptacle,
        "seed": seed,
        "seconds": seconds,
        "fps": fps,
        "image_size_px": list(size),
        "occluder": occluder,
        "noise": noise,
        "depth": depth,
        "camera_path": camera_path,
        "versions": {"mujoco": load_mujoco().__version__, "numpy": np.__version__, "opencv": cv2.__version__},
        "boxes_xywh_px": boxes,
        "camera_matrix": camera.camera_matrix.tolist(),
        "camera": {
            "fovy_deg": round(float(np.rad2deg(camera.fovy_rad)), 4),
            "elevation_deg": round(float(np.rad2deg(camera.elevation_rad)), 4),
            "azimuth_deg": round(float(np.rad2deg(camera.azimuth_rad)), 4),
            "T_world_camera": camera.T_world_camera.tolist(),
        },
        "motion": {
            "tilt_max_deg": round(float(np.rad2deg(path.tilt_max_rad)), 3),
            "toward": "+x" if path.side > 0 else "-x",
            "rest_s": round(path.rest_s, 4),
            "height_share": round(height_share, 4),
        },
        "vessels": {role: _library(v) for role, v in (("object", vessel), ("receptacle", bowl))},
        "look": notes,
        "visible_fraction": [round(float(v), 4) for v in visible],
        "video_sha256": info.sha256,
    }
    common = {
        "image_size_px": list(size),
        "video": {"file": video.name, "sha256": info.sha256, "frames": count},
        "camera": {
            "source": "given",
            "pixel_convention": "centre of the first pixel is (0, 0)",
            "motion": {"kind": {"still": "static", "turn": "turning", "walk": "moving"}[camera_path]},
        },
        "settings": {"made_by": "synthesize", "seed": seed, "exact": True},
    }
    T_receptacle = np.tile(path.T_world_receptacle, (count, 1, 1))
    tracks = {
        "truth": _track(
            vessel, names["object"], camera, T_world_camera, path.T_world_object, info.time_s, visible, common
        ),
        "receptacle": _track(
            bowl,
            names["receptacle"] if names["receptacle"] != names["object"] else "receptacle",
            camera,
            T_world_camera,
            T_receptacle,
            info.time_s,
            np.ones(count),
            common,
        ),
    }
    for name, track in tracks.items():
        track.save(out / f"{name}.track.npz")
    write_json(out / "settings.json", settings)  # last: its presence says that the clip is complete
    return SyntheticClip(
        video=video,
        truth_path=out / "truth.track.npz",
        receptacle_path=out / "receptacle.track.npz",
        settings_path=out / "settings.json",
        truth=tracks["truth"],
        receptacle=tracks["receptacle"],
        settings=settings,
        visible_fraction=visible,
    )


def _check(seconds: float, fps: float, size: tuple[int, int], camera_path: str) -> None:
    if camera_path not in CAMERA_PATHS:
        raise UserError(f"camera_path is {camera_path!r}; give one of {', '.join(CAMERA_PATHS)}")
    if not 1 <= fps <= 240:
        raise UserError(f"fps is {fps:g}; give a frame rate between 1 and 240")
    if not 0.5 < seconds * fps <= MAX_FRAMES:
        raise UserError(
            f"seconds is {seconds:g}, which makes {seconds * fps:g} frames at {fps:g} fps; "
            f"give a length between 1 and {MAX_FRAMES} frames"
        )
    if any(side % 2 or not MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in size):
        raise UserError(
            f"size is {size[0]}x{size[1]}; width and height must be even and between {MIN_SIDE_PX} and {MAX_SIDE_PX} px"
        )


def _scene(
    seed: int,
    vessel: Vessel,
    receptacle: Vessel,
    path: PourPath,
    camera: Camera,
    T_world_camera: Array,
    size_px: tuple[int, int],
    choices: Sequence[Grip | None],
) -> Scene:
    """The scene with the first hand that leaves enough of the vessel to see, else with the one that leaves most."""
    frames = np.linspace(0, len(path.time_s) - 1, 6).astype(int)

    def built(grip: Grip | None) -> Scene:
        return Scene(np.random.default_rng(seed), vessel, receptacle, path, camera, size_px, grip, T_world_camera)

    least = []
    for grip in choices:
        scene = built(grip)
        least.append(min(scene.visible_fraction(int(k)) for k in frames))
        if least[-1] >= ENOUGH_VISIBLE:
            return scene
        scene.close()
    return built(choices[int(np.argmax(least))])


def _choose(rng: np.random.Generator, word: str) -> str:
    return str(rng.choice(sorted(resolve_category(word))))


def _library(vessel: Vessel) -> dict[str, Any]:
    return {"category": vessel.category, "params": {k: float(v) for k, v in vessel.params.items()}}


def _track(
    vessel: Vessel,
    name: str,
    camera: Camera,
    T_world_camera: Array,
    T_world_object: Array,
    time_s: Array,
    visible_fraction: Array,
    common: Mapping[str, Any],
) -> ObjectTrack:
    digest = hashlib.sha256(np.asarray(vessel.mesh.vertices, np.float64).tobytes())
    digest.update(np.asarray(vessel.mesh.faces, np.int64).tobytes())
    mesh = {
        "name": vessel.category,
        "sha256": digest.hexdigest(),
        "extents_m": [float(v) for v in vessel.mesh.extents],
        "symmetry": vessel.symmetry.to_json(),
        "up_axis": [0.0, 0.0, 1.0],
        "library": _library(vessel),
    }
    moves = np.ptp(T_world_camera, axis=0).max() > 0
    T_first_camera = np.asarray(invert_pose(T_world_camera[0]) @ T_world_camera) if moves else None
    return ObjectTrack(
        T_camera_object=np.asarray(invert_pose(T_world_camera) @ T_world_object),
        time_s=time_s,
        camera_matrix=camera.camera_matrix,
        confidence=np.ones(len(time_s)),
        visible=visible_fraction > VISIBLE_FRACTION,
        header={"object": name, "mesh": mesh, **common},
        T_first_camera=T_first_camera,
    )


def _write_depth(path: Path, depth_mm: NDArray[np.uint16]) -> None:
    with atomic_path(path) as temporary:
        cv2.imwrite(str(temporary), depth_mm)


def _box_of(mask: NDArray[np.bool_]) -> list[int] | None:
    """[x, y, width, height] in px around the True pixels, None when there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return None
    return [int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)]
