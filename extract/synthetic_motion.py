"""The motion of a synthetic pour and the camera that films it: closed-form curves, so that the truth is exact.

World frame: z up, table top at z = 0, the camera on the -y side. Everything is minimum-jerk pieces plus a few slow
sines for the unsteady hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .geometry import Array, invert_pose, look_at, make_pose, project, transform_points

_LIP_TILT_DEG = (85.0, 115.0)
_SPOUT_TILT_DEG = (70.0, 85.0)
_CLEARANCE_M = 0.006
_MARGIN = 0.05
_MAX_HEIGHT_SHARE = 0.34


@dataclass(frozen=True)
class PourShape:
    """What the motion needs to know of the two vessels.

    points_m: (V, 3) vertices of the vessel, object frame, z up.  outlet_m: (3,) where the liquid leaves.
    outlet_kind: "lip" or "spout".  receptacle_points_m: (W, 3) vertices of the receptacle in its own frame.
    rim_radius_m: inner radius of the receptacle at its rim.
    """

    points_m: Array
    outlet_m: Array
    outlet_kind: str
    receptacle_points_m: Array
    rim_radius_m: float


@dataclass(frozen=True)
class PourPath:
    """T_world_object (N, 4, 4), T_world_receptacle (4, 4), time_s (N,), greatest tilt in rad, handedness (+1: the
    vessel moves toward +x, -1: toward -x), rest_s: how long the vessel stands before it is lifted.
    """

    T_world_object: Array
    T_world_receptacle: Array
    time_s: Array
    tilt_max_rad: float
    side: int
    rest_s: float


@dataclass(frozen=True)
class Camera:
    """T_world_camera (4, 4) in OpenCV axes, camera_matrix (3, 3) in px, vertical field of view, viewing angles."""

    T_world_camera: Array
    camera_matrix: Array
    fovy_rad: float
    elevation_rad: float
    azimuth_rad: float


def minimum_jerk(tau: Array) -> Array:
    """Smooth step from 0 (tau <= 0) to 1 (tau >= 1) with zero velocity and acceleration at both ends."""
    t = np.clip(tau, 0.0, 1.0)
    return np.asarray(t**3 * (10 - 15 * t + 6 * t * t))


def plan_pour(rng: np.random.Generator, shape: PourShape, seconds: float, fps: float) -> PourPath:
    """A seeded pour: stand, lift, carry over the receptacle, tilt the outlet down toward it, hold, turn back a bit.

    The outlet is led along the path and the body follows, as a person does. The carrying height is raised until the
    vessel clears table and receptacle in every frame.
    """
    time_s = np.arange(max(1, round(seconds * fps))) / fps
    rest_s = min(0.4, 0.1 * seconds)
    u = (time_s - rest_s) / max(seconds - rest_s, 1e-6)
    side = int(rng.choice([-1, 1]))
    heading = (0.0 if side > 0 else np.pi) + np.deg2rad(rng.uniform(-25, 25))
    yaw_start = heading + np.deg2rad(rng.uniform(-40, 40))
    tilt_max = np.deg2rad(rng.uniform(*(_SPOUT_TILT_DEG if shape.outlet_kind == "spout" else _LIP_TILT_DEG)))
    late = rng.uniform(-0.02, 0.02, 4)

    lift = minimum_jerk(u / 0.22)
    carry = minimum_jerk((u - 0.06 - late[0]) / 0.32)
    tilt_in = minimum_jerk((u - 0.27 - late[1]) / 0.36)
    lower = minimum_jerk((u - 0.36 - late[2]) / 0.26)
    back = minimum_jerk((u - 0.78 - late[3]) / 0.24)

    sway = unsteady(rng, time_s, 6) * minimum_jerk(u / 0.15)
    yaw = yaw_start + (heading - yaw_start) * carry + sway[0] * np.deg2rad(1.0)
    tilt = tilt_max * (tilt_in - rng.uniform(0.3, 0.6) * back) + sway[1] * np.deg2rad(0.8)
    roll = sway[2] * np.deg2rad(1.2) + np.deg2rad(rng.uniform(-5, 5)) * tilt_in
    azimuth = np.arctan2(shape.outlet_m[1], shape.outlet_m[0])
    R = _rot_z(yaw) @ _rot_y(tilt) @ _rot_x(roll) @ _rot_z(np.full_like(yaw, -azimuth))

    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-forward[1], forward[0], 0.0])
    reach = float(np.linalg.norm(shape.points_m[:, :2], axis=1).max())
    receptacle_reach = float(np.linalg.norm(shape.receptacle_points_m[:, :2], axis=1).max())
    gap = reach + receptacle_reach + rng.uniform(0.03, 0.08)
    bottom, receptacle_bottom = (float(p[:, 2].min()) for p in (shape.points_m, shape.receptacle_points_m))
    rim = float(np.ptp(shape.receptacle_points_m[:, 2]))

    start = -gap * forward + across * rng.uniform(-0.03, 0.03) + [0.0, 0.0, -bottom]
    outlet_start = start + R[0] @ shape.outlet_m
    outlet_end = -forward * shape.rim_radius_m * rng.uniform(0.0, 0.4) + [0.0, 0.0, rim + rng.uniform(0.015, 0.04)]
    z_upright = rim + float(shape.outlet_m[2]) - bottom
    wobble = sway[3:].T * 0.0012
    keep = shape.points_m[:: max(1, len(shape.points_m) // 1500)]
    T = np.tile(np.eye(4), (len(u), 1, 1))
    for extra in np.arange(0.0, 0.3, 0.01):
        outlet = outlet_start + (outlet_end - outlet_start) * carry[:, None]
        z_carry = max(outlet_start[2] + 0.03, z_upright - 0.06) + extra
        raised = 0.02 + 0.5 * extra
        outlet[:, 2] = (
            outlet_start[2]
            + (z_carry - outlet_start[2]) * lift
            + (outlet_end[2] + 0.5 * extra - z_carry) * lower
            + raised * back
        )
        T[:, :3, :3] = R
        T[:, :3, 3] = outlet + wobble - np.einsum("nij,j->ni", R, shape.outlet_m)
        if not _collides(T, keep, receptacle_reach, rim):
            break
    T_receptacle = make_pose(_rot_z(np.array([rng.uniform(-np.pi, np.pi)]))[0], (0.0, 0.0, -receptacle_bottom))
    return PourPath(T, T_receptacle, time_s, float(tilt_max), side, rest_s)


def place_camera(
    rng: np.random.Generator, path: PourPath, shape: PourShape, size_px: tuple[int, int]
) -> tuple[Camera, float]:
    """A fixed camera in front that keeps the whole motion in the picture.

    Returns the camera and the vessel's share of the image height when it stands on the table.
    """
    width, height = size_px
    elevation, azimuth = np.deg2rad(rng.uniform(15, 35)), np.deg2rad(rng.uniform(-25, 25))
    fovy = np.deg2rad(rng.uniform(30, 46))
    focal = height / 2 / np.tan(fovy / 2)
    camera_matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    backward = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])

    few = shape.points_m[:: max(1, len(shape.points_m) // 400)]
    frames = path.T_world_object[:: max(1, len(path.T_world_object) // 40)]
    standing = transform_points(path.T_world_object[0], few)
    swept = np.concatenate([transform_points(T, few) for T in frames])
    everything = np.concatenate([swept, transform_points(path.T_world_receptacle, shape.receptacle_points_m)])
    target = (everything.min(axis=0) + everything.max(axis=0)) / 2
    room = np.array([width, height]) * (0.5 - _MARGIN)

    for distance in 0.3 * 1.02 ** np.arange(200):
        for _ in range(3):
            T = look_at(target + distance * backward, target, np.array([0.0, 0.0, 1.0]))
            inside = transform_points(invert_pose(T), everything)
            if inside[:, 2].min() < 0.1:
                break
            pixels = project(camera_matrix, inside)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            off = (low + high) / 2 - camera_matrix[:2, 2]
            target = target + (T[:3, 0] * off[0] + T[:3, 1] * off[1]) * distance / focal
        else:
            share = _height_share(camera_matrix, T, standing, height)
            if np.all(high - low <= 2 * room) and share <= _MAX_HEIGHT_SHARE:
                break
    return Camera(T, camera_matrix, float(fovy), float(elevation), float(azimuth)), share


def _height_share(camera_matrix: Array, T_world_camera: Array, points: Array, height: int) -> float:
    rows = project(camera_matrix, transform_points(invert_pose(T_world_camera), points))[:, 1]
    return float(np.ptp(rows)) / height


def _collides(T: Array, points: Array, receptacle_reach_m: float, rim_m: float) -> bool:
    for pose in T[:: max(1, len(T) // 50)]:
        world = transform_points(pose, points)
        low = world[:, 2] < rim_m + _CLEARANCE_M
        near = np.linalg.norm(world[:, :2], axis=1) < receptacle_reach_m + _CLEARANCE_M
        if np.any(low & near) or world[:, 2].min() < -1e-9:
            return True
    return False


def unsteady(rng: np.random.Generator, time_s: Array, channels: int) -> Array:
    """(channels, N) unsteadiness of about unit size: three sines between 0.4 and 3 Hz, slow ones larger."""
    hz = rng.uniform([0.4, 0.8, 1.6], [0.8, 1.6, 3.0], (channels, 3))
    phase = rng.uniform(0, 2 * np.pi, (channels, 3))
    waves = np.sin(2 * np.pi * hz[..., None] * time_s + phase[..., None])
    return np.asarray(np.einsum("k,ckn->cn", np.array([0.8, 0.4, 0.15]), waves))


def _rot(angle: Array, i: int, j: int) -> Array:
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -np.sin(angle)
    return R


def _rot_x(angle: Array) -> Array:
    return _rot(angle, 1, 2)


def _rot_y(angle: Array) -> Array:
    return _rot(angle, 2, 0)


def _rot_z(angle: Array) -> Array:
    return _rot(angle, 0, 1)
