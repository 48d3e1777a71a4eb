"""A hand for synthetic pours, made of capsules: enough to hide what a hand hides, in the colour of skin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Grip:
    """Where the hand holds; side: +1 or -1, on which side of the palm the fingers are (the thumb is on the other)."""

    grasp: GraspRegion
    side: int


def grips(rng: np.random.Generator, grasps: Sequence[GraspRegion]) -> list[Grip]:
    """All ways to hold a vessel, best liked first: mostly the handle where there is one, sometimes around the body."""
    handles = [g for g in grasps if g.kind == "handle"][:1]
    bodies = [g for g in grasps if g.kind == "body"][:1]
    liked = handles + bodies if rng.random() < 0.85 else bodies + handles
    side = int(rng.choice([-1, 1]))
    return [Grip(grasp, sign) for grasp in liked for sign in (side, -side)]


def hand_capsules(grip: Grip) -> list[Capsule]:
    """Palm, four fingers and a thumb around a grasp region: capsules (start, end, radius) in the object frame, m."""
    grasp = grip.grasp
    center, into, along = (np.asarray(v, float) for v in (grasp.center_m, grasp.approach, grasp.axis))
    along = along - into * (along @ into)
    along /= np.linalg.norm(along)
    if along[2] < -0.2:
        along = -along
    side = np.cross(along, into) * grip.side
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


def forearm_poses(rng: np.random.Generator, grip: Grip, path: PourPath) -> Array:
    """T_world_forearm (N, 4, 4): origin at the wrist, +z toward a shoulder above and behind, on the vessel's side."""
    grasp = grip.grasp
    wrist = np.asarray(grasp.center_m, float) - _WRIST_BACK_M * np.asarray(grasp.approach, float)
    wrists = np.array([transform_points(T, wrist[None])[0] for T in path.T_world_object])
    shoulder = np.array([-path.side * rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.3), 0.0])
    shoulder[2] = wrists[:, 2].max() + rng.uniform(0.2, 0.4)  # so that the arm leaves the picture at its upper edge
    poses = []
    for at in wrists:
        z = (shoulder - at) / np.linalg.norm(shoulder - at)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        poses.append(make_pose(np.column_stack([x, np.cross(z, x), z]), at))
    return np.asarray(poses)
