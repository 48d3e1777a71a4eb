"""Where the scene is seen from: cameras that keep the whole motion and the pour in view."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array, look_at, transform_points

if TYPE_CHECKING:
    from ..extract.vessels import Vessel
    from .reference import Reference

CAMERAS = ("front", "wrist", "side")


def add_cameras(spec: mujoco.MjSpec, reference: Reference, vessel: Vessel, T_world_receptacle: Array) -> None:
    """Cameras from which the whole motion and the receptacle can be seen."""
    path = reference.T_world_object[:, :3, 3]
    points = np.vstack([path, T_world_receptacle[:3, 3]])
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
