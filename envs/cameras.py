"""Where the scene is seen from: cameras that keep the whole motion and the pour in view."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, look_at, transform_points

if TYPE_CHECKING:
    from ..extract.vessels import Vessel
    from .reference import Reference

CAMERAS = ("front", "wrist", "side")
MIN_FOVY_DEG, MAX_FOVY_DEG = 1.0, 170.0


@dataclass(frozen=True, eq=False)
class CameraPose:
    """A camera of one's own that stands still in the world.

    name: letters, digits and underscores. T_world_camera: (4, 4) pose in m, with OpenCV's axes: x right, y down, z
    forward. fovy_deg: vertical field of view.
    Raises UserError for what is no such pose.
    """

    name: str
    T_world_camera: Array
    fovy_deg: float = 45.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"\w+", self.name, re.ASCII):
            raise UserError(f"a camera is called {self.name!r}; use letters, digits and underscores")
        if self.name in CAMERAS:
            raise UserError(f"a camera of your own is called {self.name!r} like a built-in one; choose another name")
        try:
            T = np.array(self.T_world_camera, np.float64)
        except (TypeError, ValueError) as error:
            raise UserError(f"T_world_camera of camera {self.name} is no array of numbers ({error})") from error
        rigid = T.shape == (4, 4) and np.all(np.isfinite(T)) and np.allclose(T[3], (0.0, 0.0, 0.0, 1.0))
        if not rigid or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4) or np.linalg.det(T[:3, :3]) < 0:
            raise UserError(
                f"T_world_camera of camera {self.name} is no pose; give a (4, 4) rigid transform, with the rotation's "
                "columns x right, y down, z forward"
            )
        if not isinstance(self.fovy_deg, int | float) or not MIN_FOVY_DEG <= self.fovy_deg <= MAX_FOVY_DEG:
            raise UserError(
                f"fovy_deg of camera {self.name} is {self.fovy_deg!r}; give {MIN_FOVY_DEG:g} to {MAX_FOVY_DEG:g}"
            )
        object.__setattr__(self, "T_world_camera", T)


def chosen_cameras(
    cameras: Sequence[str | CameraPose | Mapping[str, Any]],
) -> tuple[tuple[str, ...], tuple[CameraPose, ...]]:
    """Names of the cameras that were asked for, in order, and those among them that are one's own.

    Each is a built-in name, a `CameraPose`, or a mapping of its fields (so that it can stand in a JSON file).
    Raises UserError for anything else, for no camera at all and for two of one name.
    """
    if isinstance(cameras, str) or len(cameras) == 0:
        raise UserError(f"cameras is {cameras!r}; give a tuple of names out of {', '.join(CAMERAS)}, or of CameraPose")
    names, own = [], []
    for camera in cameras:
        if isinstance(camera, Mapping):
            if set(camera) - {"name", "T_world_camera", "fovy_deg"} or not {"name", "T_world_camera"} <= set(camera):
                raise UserError(f"a camera has the fields {sorted(camera)}; give name, T_world_camera and fovy_deg")
            camera = CameraPose(**camera)
        if isinstance(camera, CameraPose):
            own.append(camera)
            names.append(camera.name)
        elif camera in CAMERAS:
            names.append(str(camera))
        else:
            raise UserError(f"camera is {camera!r}; choose {', '.join(CAMERAS)}, or give a CameraPose")
    if len(set(names)) != len(names):
        raise UserError(f"cameras names {', '.join(names)}; give each of them once")
    return tuple(names), tuple(own)


def add_cameras(
    spec: mujoco.MjSpec,
    reference: Reference,
    vessel: Vessel,
    own: Sequence[CameraPose] = (),
) -> None:
    """Cameras from which the whole motion and the receptacle can be seen, and one's own."""
    for camera in own:
        _add_camera(spec.worldbody, camera.name, camera.T_world_camera, camera.fovy_deg)
    path = reference.T_world_object[:, :3, 3]
    points = np.vstack([path, reference.receptacle_m]) if reference.has_receptacle else path
    low, high = points.min(0), points.max(0)
    target = (low + high) / 2
    size_m = float(np.linalg.norm(high - low)) / 2 + 0.75 * float(np.linalg.norm(vessel.extents_m))
    fovy_deg = 45.0
    distance_m = max(0.5, 0.85 * size_m / math.sin(math.radians(fovy_deg / 2)))
    # The stream lies in the vertical plane into which the vessel tilts: the side camera looks across it, or where the
    # front camera does so already, against it; never from behind the robot.
    upright = reference.T_world_object[reference.pour_index, :3, 2]
    heading = math.atan2(float(upright[1]), float(upright[0]))
    front = 0.35
    choices = [heading + turn for turn in (-math.pi / 2, math.pi / 2, 0.0) if math.cos(heading + turn) > -0.4]
    across = min(choices, key=lambda azimuth: math.cos(azimuth - front))
    for name, azimuth, elevation_deg, reach in (("front", front, 22.0, 1.0), ("side", across, 16.0, 0.9)):
        rise = math.radians(elevation_deg)
        away = np.array([math.cos(azimuth) * math.cos(rise), math.sin(azimuth) * math.cos(rise), math.sin(rise)])
        _add_camera(
            spec.worldbody, name, look_at(target + reach * distance_m * away, target, np.array([0, 0, 1.0])), fovy_deg
        )

    # On the wrist: beside the hand on the side to which the vessel opens, or, when the hand holds it from above, on
    # the side of its outlet; looking between mouth and outlet.
    T = reference.T_hand_object
    sideways = np.array([1.0, 1.0, 0.0])
    upward = sideways * (T[:3, 2] if np.linalg.norm(T[:2, 2]) > 0.3 else T[:3, 0])
    upward = upward / np.linalg.norm(upward)
    mouth, lip = transform_points(T, np.array([[0.0, 0.0, vessel.extents_m[2] / 2], vessel.outlet.point_m]))
    middle, spread_m = (mouth + lip) / 2, float(np.linalg.norm(mouth - lip))
    eye = np.array([0.0, 0.0, -0.09]) + upward * (max(float(mouth @ upward), float(lip @ upward), 0.0) + 0.11)
    _add_camera(spec.body("panda_hand_tcp"), "wrist", look_at(eye, middle, upward), 60.0 + 60.0 * min(spread_m, 0.2))


def _add_camera(body: mujoco.MjsBody, name: str, T: Array, fovy_deg: float) -> None:
    # MuJoCo's cameras look along -z with y up; OpenCV's along +z with y down.
    R = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    body.add_camera(
        name=name,
        pos=T[:3, 3].tolist(),
        quat=Rotation.from_matrix(R).as_quat(scalar_first=True).tolist(),
        fovy=fovy_deg,
    )
