"""A hand for synthetic pours, made of capsules: enough to hide what a hand hides, in the colour of skin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .geometry import Array, make_pose, transform_points

if TYPE_CHECKING:
    from .synthetic_motion import PourPath
    from .vessel_types import GraspRegion

Capsule = tuple[Array, Array, float]
_WRIST_BACK_M = 0.1
# Bare wrist and sleeve along +z of the forearm's frame; long enough to leave the picture.
FOREARM: tuple[Capsule, ...] = (
    (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.08]), 0.024),
    (np.array([0.0, 0.0, 0.07]), np.array([0.0, 0.0, 1.2]), 0.042),
)


def choose_grasp(rng: np.random.Generator, grasps: Sequence[GraspRegion]) -> GraspRegion:
    """Mostly the handle where there is one, sometimes around the body."""
    handles = [g for g in grasps if g.kind == "handle"]
    bodies = [g for g in grasps if g.kind == "body"]
    use_handle = rng.random() < 0.85
    return ((handles or bodies) if use_handle else (bodies or handles))[0]


def hand_capsules(rng: np.random.Generator, grasp: GraspRegion) -> list[Capsule]:
    """Palm, four fingers and a thumb around a grasp region: capsules (start, end, radius) in the object frame, m."""
    center, into, along = (np.asarray(v, float) for v in (grasp.center_m, grasp.approach, grasp.axis))
    along = along - into * (along @ into)
    along /= np.linalg.norm(along)
    if along[2] < -0.2:
        along = -along
    side = np.cross(along, into) * rng.choice([-1.0, 1.0])
    half = 0.5 * float(grasp.width_m) + 0.007
    reach = float(np.clip(half, 0.012, 0.035))

    def point(s: float, a: float, u: float) -> Array:
        return np.asarray(center + side * s + into * a + along * u)

    parts = []
    for k, length in enumerate((0.9, 1.0, 0.95, 0.8)):
        u = (1.5 - k) * 0.019
        knuckle, joint = point(half + 0.006, -0.055, u), point(half, -0.005, u)
        tip = point(half - 0.4 * reach, reach * length + 0.012, u * 0.9)
        parts += [(point(0.012, -0.085, 0.7 * u), knuckle, 0.0115), (knuckle, joint, 0.0095), (joint, tip, 0.0085)]
    root, joint = point(-0.012, -0.08, 0.03), point(-half, -0.04, 0.045)
    parts += [(root, joint, 0.012), (joint, point(-half, 0.004, 0.04), 0.0095)]
    parts += [
        (point(0.0, -0.075, 0.02), point(0.0, -0.075, -0.02), 0.019),
        (point(0.0, -0.08, 0.0), point(0.0, -0.11, 0.0), 0.021),
    ]
    return parts


def forearm_poses(rng: np.random.Generator, grasp: GraspRegion, path: PourPath) -> Array:
    """T_world_forearm (N, 4, 4): origin at the wrist, +z toward a shoulder behind the table on the vessel's side."""
    wrist = np.asarray(grasp.center_m, float) - _WRIST_BACK_M * np.asarray(grasp.approach, float)
    shoulder = np.array([-path.side * rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.45), rng.uniform(0.3, 0.5)])
    poses = []
    for T in path.T_world_object:
        at = transform_points(T, wrist[None])[0]
        z = (shoulder - at) / np.linalg.norm(shoulder - at)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        poses.append(make_pose(np.column_stack([x, np.cross(z, x), z]), at))
    return np.asarray(poses)
