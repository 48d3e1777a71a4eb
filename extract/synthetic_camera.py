"""How the camera of a synthetic clip moves: it stands, turns in place, or is carried around the table by a walker."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from .geometry import Array, invert_pose, look_at, make_pose, project, transform_points
from .synthetic_motion import Camera, PourPath, PourShape, minimum_jerk, unsteady

CameraPath = Literal["still", "turn", "walk"]
CAMERA_PATHS: tuple[CameraPath, ...] = ("still", "turn", "walk")
_EDGE = 0.03  # of the picture, that stays free around everything that moves
_TURN_DEG = (6.0, 2.0, 3.0)  # largest pan, tilt and roll
_WALK_DEG = (25.0, 45.0)  # around the table
_STEP_M, _STEP_HZ = 0.008, 1.8  # how far a walker's hand goes up and down


def move_camera(
    rng: np.random.Generator,
    camera: Camera,
    path: PourPath,
    shape: PourShape,
    size_px: tuple[int, int],
    kind: CameraPath,
) -> tuple[Camera, Array]:
    """The camera as it stands in the first frame, and T_world_camera (N, 4, 4) in every one.

    A moving camera begins farther back than `camera`, as far as it must to keep the whole motion in the picture.
    """
    time_s = path.time_s
    if kind == "still":
        return camera, np.tile(camera.T_world_camera, (len(time_s), 1, 1))
    u = minimum_jerk((time_s + 0.1) / (time_s[-1] + 0.2)) if len(time_s) > 1 else np.zeros(1)
    shake = unsteady(rng, time_s, 7)
    swing = float(np.deg2rad(rng.uniform(*_WALK_DEG))) * float(rng.choice([-1, 1]))
    turns = np.deg2rad(_TURN_DEG) * rng.choice([-1, 1], 3) * np.sin(np.pi * (u[:, None] * [1.0, 1.5, 2.0]))
    nearer = rng.uniform(-0.08, 0.08)
    R, eye = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    seen, up = _everything(path, shape), np.array([0.0, 0.0, 1.0])
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    # On the line of sight, at the height of what is seen: what a walker keeps in the middle of the picture.
    target = eye + R[:, 2] * float((middle - eye) @ R[:, 2])
    for back in 1.04 ** np.arange(60):
        away = (eye - target) * back
        if kind == "turn":
            rotations = Rotation.from_rotvec(turns + np.deg2rad(0.15) * shake[:3].T).as_matrix()
            T = np.stack([make_pose(R @ turn, target + away) for turn in rotations])
        else:
            step = _STEP_M * np.abs(np.sin(np.pi * _STEP_HZ * time_s))
            around = (
                Rotation.from_rotvec((swing * (u - 0.5))[:, None] * up).apply(away) * (1 + nearer * (u - 0.5))[:, None]
            )
            eyes = target + around + 0.006 * shake[:3].T + step[:, None] * up
            looked_at = target + 0.008 * shake[3:6].T
            roll = Rotation.from_rotvec(np.deg2rad(0.8) * shake[6][:, None] * up).as_matrix()
            T = np.stack([look_at(e, a, up) @ make_pose(r) for e, a, r in zip(eyes, looked_at, roll, strict=True)])
        if _in_picture(camera.camera_matrix, T, seen, size_px):
            break
    return replace(camera, T_world_camera=T[0]), T


def _everything(path: PourPath, shape: PourShape) -> Array:
    """(M, 3) points in m that both vessels sweep."""
    few = shape.points_m[:: max(1, len(shape.points_m) // 100)]
    frames = path.T_world_object[:: max(1, len(path.T_world_object) // 20)]
    swept = [transform_points(T, few) for T in frames]
    return np.concatenate([*swept, transform_points(path.T_world_receptacle, shape.receptacle_points_m)])


def _in_picture(camera_matrix: Array, T_world_camera: Array, points_m: Array, size_px: tuple[int, int]) -> bool:
    width, height = size_px
    room = np.array([width, height]) * (0.5 - _EDGE)
    for T in T_world_camera[:: max(1, len(T_world_camera) // 40)]:
        inside = transform_points(invert_pose(T), points_m)
        if inside[:, 2].min() < 0.1 or np.any(np.abs(project(camera_matrix, inside) - camera_matrix[:2, 2]) > room):
            return False
    return True
