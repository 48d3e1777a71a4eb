"""A pour that needs no video: lift, move and tilt along minimum-jerk curves, as a `Reference`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose, make_pose
from .kinematics import arm_seeds, limit_margin_rad, solve_ik
from .panda import FINGER_MAX_M
from .reference import Reference, minimum_jerk, vessel_to_header

if TYPE_CHECKING:
    from ..extract.vessels import GraspRegion, Vessel

LIFT_S, MOVE_S, TILT_S, HOLD_S = 1.0, 1.4, 2.4, 1.0


def builtin_reference(
    control_hz: float = 25.0, vessel: Vessel | None = None, receptacle: Vessel | None = None
) -> Reference:
    """A vessel, by default a mug, is lifted off the table and emptied into a bowl or another receptacle."""
    from ..extract.vessels import make_vessel

    return pour_reference(vessel or make_vessel("mug"), receptacle or make_vessel("bowl"), control_hz=control_hz)


def grasp_pose(grasp: GraspRegion, pitch_rad: float = 0.0, upside: bool = False) -> Array:
    """T_hand_object (4, 4) of a hand that closes on the middle of a grasp region.

    The hand's z is the approach, its x lies along the region, y across it. `pitch_rad` turns the approach about the
    closing direction, positive from above; `upside` turns the hand half round.
    """
    z = np.asarray(grasp.approach, float)
    x = np.asarray(grasp.axis, float)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    z = math.cos(pitch_rad) * z - math.sin(pitch_rad) * x
    x = np.cross(np.cross(z, x), z) * (-1.0 if upside else 1.0)
    x /= np.linalg.norm(x)
    return invert_pose(make_pose(np.column_stack([x, np.cross(z, x), z]), np.asarray(grasp.center_m, float)))


def pour_reference(
    vessel: Vessel,
    receptacle: Vessel,
    *,
    tilt_deg: float = 110.0,
    control_hz: float = 25.0,
    start_xy_m: tuple[float, float] = (0.5, -0.25),
    receptacle_xy_m: tuple[float, float] = (0.5, 0.1),
    heading_deg: float = 90.0,
    clearance_m: float = 0.03,
) -> Reference:
    """Lift `vessel` off the table, bring its outlet over `receptacle` and tilt it about the outlet.

    heading_deg: toward where the vessel's +x points all along, from world +x (90 pours to the robot's left).
    clearance_m: height of the outlet above the receptacle's rim while pouring.
    Raises UserError when no arm configuration reaches the whole motion.
    """
    outlet, direction = np.asarray(vessel.outlet.point_m, float), np.asarray(vessel.outlet.direction, float)
    start = np.array([*start_xy_m, vessel.extents_m[2] / 2])
    T_receptacle = make_pose(None, (*receptacle_xy_m, receptacle.extents_m[2] / 2))
    rim = np.array([*receptacle.interior.axis_xy_m, receptacle.interior.z_m[-1]]) + T_receptacle[:3, 3]

    time_s = np.arange(round((LIFT_S + MOVE_S + TILT_S + HOLD_S) * control_hz) + 1) / control_hz
    tilt_rad = np.deg2rad(tilt_deg) * minimum_jerk((time_s - LIFT_S - 0.6 * MOVE_S) / (TILT_S + 0.4 * MOVE_S))
    heading = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(heading_deg)])
    R = (heading * Rotation.from_rotvec(tilt_rad[:, None] * np.array([0.0, 1.0, 0.0]))).as_matrix()
    # The stream flies on from the outlet, so the outlet stays a little short of the receptacle's middle.
    short_m = 0.35 * float(receptacle.interior.radius_m[-1])
    over = rim - short_m * heading.apply([direction[0], direction[1], 0.0]) + [0.0, 0.0, clearance_m]
    tilting = over - R @ outlet
    tilting[:, 2] += _rise_over_rim_m(vessel, receptacle, R, tilting - rim, tilt_rad)
    rise_m = max(float(tilting[0, 2] - start[2]), 0.05)
    lift = minimum_jerk(time_s / (LIFT_S + 0.3 * MOVE_S))
    move = minimum_jerk((time_s - 0.7 * LIFT_S) / (MOVE_S + 0.3 * LIFT_S))
    position = start + move[:, None] * (tilting - start)
    position[:, 2] = start[2] + (1 - move) * lift * rise_m + move * (tilting[:, 2] - start[2])
    T = np.tile(np.eye(4), (len(time_s), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, position

    T_hand_object, q_start_rad = reachable_grasp(vessel, T)
    header = {
        "symmetry": vessel.symmetry.to_json(),
        "vessel": vessel_to_header(vessel),
        "receptacle": {**vessel_to_header(receptacle), "T_world_receptacle": T_receptacle.tolist()},
        "T_hand_object": T_hand_object.tolist(),
        "q_start_rad": q_start_rad.tolist(),
        "scale": 1.0,
        "notes": ["built-in motion, not from a video"],
    }
    return Reference.from_poses(T, time_s, header)


def _rise_over_rim_m(vessel: Vessel, receptacle: Vessel, R: Array, above_rim_m: Array, tilt_rad: Array) -> Array:
    """(N,) extra height that keeps the held body off the receptacle while it tilts, fading as the tilt grows.

    R: (N, 3, 3) attitudes; above_rim_m: (N, 3) the vessel's origin seen from the middle of the receptacle's rim.
    """
    body = vessel.mesh.vertices[:: max(1, len(vessel.mesh.vertices) // 500)]
    points = np.einsum("nij,kj->nki", R, body) + above_rim_m[:, None]
    over = np.linalg.norm(points[..., :2], axis=2) < float(receptacle.exterior.radius_m[-1]) + 0.02
    lowest_m = np.where(over, points[..., 2], np.inf).min(axis=1)
    left = 1.0 - tilt_rad / tilt_rad[-1]
    needed = np.maximum(0.012 - lowest_m, 0.0)
    # Near the end of the tilt only the outlet itself is over the receptacle, and that is where it should be.
    scale = float(np.max(needed[left > 0.25] / left[left > 0.25]))
    return np.asarray(scale * left)


def reachable_grasp(vessel: Vessel, T_world_object: Array) -> tuple[Array, Array]:
    """The grasp (4, 4) and start posture (7,) that carry the vessel along the path with the widest joint margins."""
    grasps = [
        grasp_pose(grasp, pitch_rad, upside)
        for grasp in vessel.grasps
        if grasp.width_m <= 2 * FINGER_MAX_M
        for pitch_rad in (0.0, 0.5)
        for upside in (False, True)
    ]
    if not grasps:
        raise UserError(
            f"no part of the {vessel.category} is narrower than the {200 * FINGER_MAX_M:.0f} cm of the hand"
        )
    T_object_hand = np.stack([invert_pose(T) for T in grasps])
    seeds = arm_seeds(T_world_object[0] @ T_object_hand)
    T_object_hand = np.tile(T_object_hand, (len(seeds), 1, 1))
    q, _ = solve_ik(T_world_object[0] @ T_object_hand, seeds.reshape(-1, 7), iterations=60, rest_gain=0.02)
    q_start, worst, margin = q, np.zeros(len(q)), np.full(len(q), np.inf)
    for T in T_world_object[:: max(1, len(T_world_object) // 40)]:
        q_next, error = solve_ik(T @ T_object_hand, q, iterations=8, rest_gain=0.01, damping=0.01)
        worst = np.maximum(worst, np.abs(error).max(axis=1))
        margin = np.minimum(margin, limit_margin_rad(q_next).min(axis=1) - 0.5 * np.abs(q_next - q).max(axis=1))
        q = q_next
    margin[worst > 2e-3] = -np.inf
    best = int(np.argmax(margin))
    if not np.isfinite(margin[best]):
        raise UserError(
            f"the arm cannot carry the {vessel.category} along this pour; move start_xy_m and receptacle_xy_m "
            "nearer to (0.5, 0), tilt less, or turn heading_deg toward 90"
        )
    return invert_pose(T_object_hand[best]), q_start[best]


def arm_trajectory(reference: Reference) -> Array:
    """(N, 7) joint positions in rad that carry the object along a reference, whatever the speed."""
    q, out = reference.q_start_rad[None], []
    for T in reference.T_world_object @ invert_pose(reference.T_hand_object):
        q, _ = solve_ik(T[None], q, iterations=8, rest_gain=0.01, damping=0.01)
        out.append(q[0])
    return np.array(out)
