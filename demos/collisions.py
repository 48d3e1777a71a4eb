"""What touches what along a joint motion: the arm, itself, table, receptacle and the vessel in the hand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.clearance import overlaps_m
from ..envs.collision import TOLERANCE_M, Collision, CollisionChecker
from ..envs.kinematics import panda_chain
from ..extract.geometry import Array

if TYPE_CHECKING:
    from ..envs.reference import Reference


def collisions_of(reference: Reference, q_rad: Array, every: int = 1) -> list[Collision]:
    """Collisions along joint positions (N, 7) at the reference's knots, each pair at its deepest.

    Every `every`-th knot is looked at. Nothing is known of a reference that names no vessel.
    """
    if not reference.header.get("vessel"):
        return []
    vessel = reference.vessel()
    receptacle = reference.receptacle() if reference.has_receptacle else None
    T_receptacle = reference.T_world_receptacle if reference.has_receptacle else None
    width_m = float(reference.header.get("grasp", {}).get("width_m", 0.0))
    checker = CollisionChecker(vessel, reference.T_hand_object, width_m, receptacle, T_receptacle)
    found = checker.check(q_rad, every)
    if receptacle is not None and T_receptacle is not None:
        T = panda_chain().hand(q_rad[::every]) @ reference.T_hand_object
        depth_m = overlaps_m(vessel, receptacle, T, T_receptacle)
        deepest = int(np.argmax(depth_m))
        if depth_m[deepest] > TOLERANCE_M:
            found.append(Collision("vessel", "receptacle", every * deepest, float(depth_m[deepest])))
    return found


def told(reference: Reference, collision: Collision) -> dict[str, Any]:
    """A collision (JSON-like) with its moment on the robot's clock and on the video's."""
    return {
        "first": collision.first,
        "second": collision.second,
        "time_s": float(reference.time_s[collision.knot]),
        "video_time_s": float(reference.video_time_s[collision.knot]),
        "depth_m": collision.depth_m,
    }
