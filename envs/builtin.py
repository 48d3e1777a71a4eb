"""A pour that needs no video: lift, move and tilt along minimum-jerk curves, as a `Reference`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose, make_pose
from .collision import CollisionChecker
from .grasps import MAX_WIDTH_M, Grasp, held_grasps, wide_grasps
from .grip import HOLDS, weight_part
from .jet import filling_kg, filling_m3, jet_of
from .kinematics import arm_seeds, limit_margin_rad, solve_ik
from .placement_search import Placement, Stage, search_placement
from .receptacle import mouth_radius_m
from .reference import Reference, minimum_jerk, vessel_to_header
from .vessel_geometry import cavity_of, gripper_half_width_m

if TYPE_CHECKING:
    from ..extract.vessels import GraspRegion, Vessel

LIFT_S, MOVE_S, TILT_S, HOLD_S = 1.0, 1.4, 2.4, 1.0
# A spout lets only so much through at a time.
SPOUT_HOLD_S = 2.5
# Where the vessel and the receptacle stand, and where +x of the vessel points, unless that is out of the arm's reach.
START_XY_M, RECEPTACLE_XY_M, HEADING_DEG = (0.5, -0.25), (0.5, 0.1), 90.0
# The least and the greatest tilt that empties an open or a spouted vessel; grains slide off a wall that slopes so much.
LIP_TILT_DEG, SPOUT_TILT_DEG, SLIDE_DEG = (110.0, 150.0), (85.0, 120.0), 10.0
# What may stay in a vessel of its filling; shares of the mouth within which the stream is to land.
LEFT_SHARE, SAFE_SHARE = 0.03, 0.5
# Grasps that are followed along the whole motion, the most comfortable at its start.
_FOLLOWED = 160


@dataclass(frozen=True)
class Plan:
    """How to pour: greatest tilt, how long it is held, where the vessel starts and the receptacle stands (world, m).

    heading_deg: toward where the vessel's +x points all along, from world +x (90 pours to the robot's left).
    clearance_m: height of the outlet above the receptacle's rim while pouring.
    """

    tilt_deg: float
    hold_s: float
    start_xy_m: tuple[float, float]
    receptacle_xy_m: tuple[float, float]
    heading_deg: float
    clearance_m: float


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
    tilt_deg: float | None = None,
    control_hz: float = 25.0,
    start_xy_m: tuple[float, float] | None = None,
    receptacle_xy_m: tuple[float, float] | None = None,
    heading_deg: float | None = None,
    clearance_m: float = 0.03,
) -> Reference:
    """Lift `vessel` off the table, bring its outlet over `receptacle` and tilt it about the outlet.

    tilt_deg: None for what empties the vessel. start_xy_m, receptacle_xy_m: places in the world; heading_deg, toward
        where the vessel's +x points all along, from world +x. Where all three are None and the usual places do not
        serve, the whole pour is moved to where the arm reaches it.
    clearance_m: height of the outlet above the receptacle's rim while pouring.
    Raises UserError when no arm configuration reaches the whole motion.
    """
    plan = Plan(
        tilt_deg=emptying_tilt_deg(vessel, receptacle) if tilt_deg is None else tilt_deg,
        hold_s=HOLD_S if vessel.outlet.kind == "lip" else SPOUT_HOLD_S,
        start_xy_m=start_xy_m or START_XY_M,
        receptacle_xy_m=receptacle_xy_m or RECEPTACLE_XY_M,
        heading_deg=HEADING_DEG if heading_deg is None else heading_deg,
        clearance_m=clearance_m,
    )
    T, time_s, T_receptacle = pour_motion(vessel, receptacle, plan, control_hz)
    movable = start_xy_m is None and receptacle_xy_m is None and heading_deg is None
    notes = ["built-in motion, not from a video"]
    try:
        grasp, q_start_rad = reachable_grasp(vessel, T, filling_kg(vessel, receptacle))
        clear = not movable or _is_clear(vessel, grasp.T_hand_object, receptacle, T_receptacle, T, q_start_rad)
    except UserError:
        if not movable:
            raise
        clear = False
    if not clear:
        found = _placed(Stage(T, time_s, vessel, receptacle, T_receptacle))
        T, T_receptacle = found.T_world_stage @ T, found.T_world_stage @ T_receptacle
        grasp, q_start_rad = found.grasp, found.q_rad[0]
        if not found.grasp.fits_hand:
            notes.append(
                f"The vessel is {100 * found.grasp.width_m:.1f} cm wide where it is held, the fingers open to "
                f"{100 * MAX_WIDTH_M:.1f} cm: it can be held in simulation only."
            )
        notes += [f"The {c.first} touches the {c.second} ({1000 * c.depth_m:.0f} mm deep)." for c in found.collisions]
    header = {
        "symmetry": vessel.symmetry.to_json(),
        "vessel": vessel_to_header(vessel),
        "receptacle": {**vessel_to_header(receptacle), "T_world_receptacle": T_receptacle.tolist()},
        "T_hand_object": grasp.T_hand_object.tolist(),
        "grasp": grasp.told(),
        "q_start_rad": q_start_rad.tolist(),
        "scale": 1.0,
        "notes": notes,
    }
    return Reference.from_poses(T, time_s, header)


def _placed(stage: Stage) -> Placement:
    """Where the arm can do a pour and how it holds the vessel; by what is too wide for the fingers if it must be.

    Raises UserError when it is out of reach everywhere.
    """
    found = search_placement(stage, np.random.default_rng(0))
    if not isinstance(found, Placement) or found.collisions:
        # Held by its rim, a vessel that is turned far over brings the hand down to the table.
        wide = wide_grasps(stage.vessel)
        other = search_placement(stage, np.random.default_rng(0), grasps=wide) if wide else found
        if isinstance(other, Placement) and (not isinstance(found, Placement) or not other.collisions):
            found = other
    if isinstance(found, Placement):
        return found
    raise UserError(
        f"the arm cannot carry the {stage.vessel.category} along this pour: {100 * found.missing_m:.0f} cm are "
        "missing; tilt less, or take a smaller vessel or receptacle"
    )


def emptying_tilt_deg(vessel: Vessel, receptacle: Vessel) -> float:
    """The tilt at which next to nothing of the usual filling stays in a vessel."""
    cavity = cavity_of(vessel)
    points = cavity.sample(2000)
    spouted = vessel.outlet.kind == "spout"
    gates = [vessel.outlet.point_m] if vessel.outlet.entry_m is None else [vessel.outlet.point_m, vessel.outlet.entry_m]
    left = LEFT_SHARE * filling_m3(vessel, receptacle) / cavity.volume_m3
    tilt_deg, most_deg = SPOUT_TILT_DEG if spouted else LIP_TILT_DEG
    if not spouted:
        # A shoulder that narrows toward the rim must slope down as well.
        narrowing = np.arctan2(-np.diff(cavity.support_m[:, 0]), np.diff(cavity.z_m))
        tilt_deg = max(tilt_deg, 90.0 + SLIDE_DEG + float(np.rad2deg(narrowing.max())))
    while tilt_deg < most_deg:
        up = np.array([-math.sin(math.radians(tilt_deg)), 0.0, math.cos(math.radians(tilt_deg))])
        gate = max(float(point @ up) for point in gates)
        if np.mean(points @ up < gate) <= left:
            break
        tilt_deg += 5.0
    return min(tilt_deg, most_deg)


def pour_motion(vessel: Vessel, receptacle: Vessel, plan: Plan, control_hz: float) -> tuple[Array, Array, Array]:
    """Poses (N, 4, 4) of the vessel, their times (N,) and the receptacle's pose (4, 4).

    The outlet stays a little short of the receptacle's middle, since the stream flies on; where that would not do, as
    far as the stream flies.
    """
    T_receptacle = make_pose(None, (*plan.receptacle_xy_m, receptacle.extents_m[2] / 2))
    rim = np.array([*receptacle.interior.axis_xy_m, receptacle.interior.z_m[-1]]) + T_receptacle[:3, 3]
    mouth_m = mouth_radius_m(receptacle)
    heading = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(plan.heading_deg)])
    outward = heading.apply([*np.asarray(vessel.outlet.direction, float)[:2], 0.0])
    outward /= max(float(np.linalg.norm(outward)), 1e-9)
    filled_m3 = filling_m3(vessel, receptacle)
    short_m = 0.35 * float(receptacle.interior.radius_m[-1])
    for _ in range(3):
        T, time_s = _carried(vessel, receptacle, plan, heading, rim, rim - short_m * outward, control_hz)
        jet = jet_of(T, vessel, filled_m3, control_hz)
        along = (jet.landing_m(float(rim[2])) - rim[:2]) @ outward[:2]
        order = np.argsort(along)
        nearest, farthest = np.interp([0.03, 0.97], np.cumsum(jet.share[order]), along[order])
        if max(-nearest, farthest) < SAFE_SHARE * mouth_m:
            break
        short_m += 0.5 * float(nearest + farthest)
    return T, time_s, T_receptacle


def _carried(
    vessel: Vessel, receptacle: Vessel, plan: Plan, heading: Rotation, rim: Array, over: Array, control_hz: float
) -> tuple[Array, Array]:
    """Poses and times of a vessel that is carried to where its outlet is above `over` (3,) and tilted there."""
    outlet = np.asarray(vessel.outlet.point_m, float)
    start = np.array([*plan.start_xy_m, vessel.extents_m[2] / 2])
    duration_s = LIFT_S + MOVE_S + TILT_S + plan.hold_s
    time_s = np.arange(round(duration_s * control_hz) + 1) / control_hz
    tilt_rad = np.deg2rad(plan.tilt_deg) * minimum_jerk((time_s - LIFT_S - 0.6 * MOVE_S) / (TILT_S + 0.4 * MOVE_S))
    R = (heading * Rotation.from_rotvec(tilt_rad[:, None] * np.array([0.0, 1.0, 0.0]))).as_matrix()
    tilting = over + np.array([0.0, 0.0, plan.clearance_m]) - R @ outlet
    tilting[:, 2] += _rise_over_rim_m(vessel, receptacle, R, tilting - rim, tilt_rad)
    rise_m = max(float(tilting[0, 2] - start[2]), 0.05)
    lift = minimum_jerk(time_s / (LIFT_S + 0.3 * MOVE_S))
    move = minimum_jerk((time_s - 0.7 * LIFT_S) / (MOVE_S + 0.3 * LIFT_S))
    position = start + move[:, None] * (tilting - start)
    position[:, 2] = start[2] + (1 - move) * lift * rise_m + move * (tilting[:, 2] - start[2])
    T = np.tile(np.eye(4), (len(time_s), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, position
    return T, time_s


def _rise_over_rim_m(vessel: Vessel, receptacle: Vessel, R: Array, above_rim_m: Array, tilt_rad: Array) -> Array:
    """(N,) extra height that keeps the held body off receptacle and table while it tilts, fading as the tilt grows.

    R: (N, 3, 3) attitudes; above_rim_m: (N, 3) the vessel's origin seen from the middle of the receptacle's rim.
    """
    body = vessel.mesh.vertices[:: max(1, len(vessel.mesh.vertices) // 500)]
    points = np.einsum("nij,kj->nki", R, body) + above_rim_m[:, None]
    over = np.linalg.norm(points[..., :2], axis=2) < float(receptacle.exterior.radius_m[-1]) + 0.02
    lowest_m = np.where(over, points[..., 2], np.inf).min(axis=1)
    left = 1.0 - tilt_rad / tilt_rad[-1]
    # Near the end of the tilt only the outlet itself is over the receptacle, and that is where it should be.
    early = left > 0.25
    below_rim_m = 0.5 * float(receptacle.extents_m[2]) + float(receptacle.interior.z_m[-1])
    off_table = np.maximum(0.012 - below_rim_m - points[..., 2].min(axis=1), 0.0)
    base = float(off_table[~early].max())
    needed = np.maximum(np.maximum(0.012 - lowest_m, 0.0), off_table) - base
    scale = max(float(np.max(needed[early] / left[early])), 0.0)
    return np.asarray(base + scale * left)


def reachable_grasp(vessel: Vessel, T_world_object: Array, contents_kg: float) -> tuple[Grasp, Array]:
    """The grasp and start posture (7,) that carry the vessel along the path with the widest joint margins.

    What friction could hold comes first, then what it nearly could; among these the middles of the vessel's grasp
    regions before every other way. Raises UserError when nothing serves.
    """
    plain = [
        Grasp(invert_pose(grasp_pose(region, pitch_rad, upside)), region.kind, region.width_m, 0.0)
        for region in vessel.grasps
        if region.width_m <= MAX_WIDTH_M
        for pitch_rad in (0.0, 0.5)
        for upside in (False, True)
    ]
    others = [grasp for grasp in held_grasps(vessel, contents_kg, T_world_object) if grasp.fits_hand]
    if not plain + others:
        raise UserError(
            f"no part of the {vessel.category} is narrower than the {100 * MAX_WIDTH_M:.1f} cm that the hand spans"
        )

    def part(g: Grasp) -> float:
        return weight_part(vessel, contents_kg, T_world_object, g.T_hand_object, g.width_m, g.is_flat)

    tried = 0.0
    for most in (*(HOLDS * np.array([1.0, 1.2, 1.4, 1.6, 1.75, 1.9])), np.inf):
        for ways in (plain, others):
            chosen = [grasp for grasp in ways if tried < part(grasp) <= most]
            if chosen and (found := _carrying(chosen, T_world_object)) is not None:
                return found
        tried = most
    raise UserError(
        f"the arm cannot carry the {vessel.category} along this pour; move start_xy_m and receptacle_xy_m nearer to "
        "(0.5, 0), tilt less, or turn heading_deg toward 90"
    )


def _carrying(grasps: list[Grasp], T_world_object: Array) -> tuple[Grasp, Array] | None:
    """The grasp that goes all the way most comfortably, and its start posture (7,)."""
    T_object_hand = np.stack([grasp.T_object_hand for grasp in grasps])
    seeds = arm_seeds(T_world_object[0] @ T_object_hand)
    of_grasp = np.tile(np.arange(len(grasps)), len(seeds))
    T_object_hand = T_object_hand[of_grasp]
    q, error = solve_ik(T_world_object[0] @ T_object_hand, seeds.reshape(-1, 7), iterations=60, rest_gain=0.02)
    if len(q) > _FOLLOWED:
        ease = limit_margin_rad(q).min(axis=1) - 100.0 * np.maximum(np.abs(error).max(axis=1) - 2e-3, 0.0)
        kept = np.argsort(-ease)[:_FOLLOWED]
        q, T_object_hand, of_grasp = q[kept], T_object_hand[kept], of_grasp[kept]
    q_start, worst, margin = q, np.zeros(len(q)), np.full(len(q), np.inf)
    for T in T_world_object[:: max(1, len(T_world_object) // 40)]:
        q_next, error = solve_ik(T @ T_object_hand, q, iterations=8, rest_gain=0.01, damping=0.01)
        worst = np.maximum(worst, np.abs(error).max(axis=1))
        margin = np.minimum(margin, limit_margin_rad(q_next).min(axis=1) - 0.5 * np.abs(q_next - q).max(axis=1))
        q = q_next
    margin[worst > 2e-3] = -np.inf
    best = int(np.argmax(margin))
    return (grasps[of_grasp[best]], q_start[best]) if np.isfinite(margin[best]) else None


def _is_clear(
    vessel: Vessel, T_hand_object: Array, receptacle: Vessel, T_receptacle: Array, T: Array, q_start_rad: Array
) -> bool:
    """Whether the arm touches neither itself nor table or receptacle along the motion."""
    checker = CollisionChecker(
        vessel, T_hand_object, 2 * gripper_half_width_m(vessel, T_hand_object), receptacle, T_receptacle
    )
    return not checker.check(_followed(T[:: max(1, len(T) // 40)], T_hand_object, q_start_rad))


def arm_trajectory(reference: Reference) -> Array:
    """(N, 7) joint positions in rad that carry the object along a reference, whatever the speed."""
    return _followed(reference.T_world_object, reference.T_hand_object, reference.q_start_rad)


def _followed(T_world_object: Array, T_hand_object: Array, q_start_rad: Array) -> Array:
    q, out = q_start_rad[None], []
    for T in T_world_object @ invert_pose(T_hand_object):
        q, _ = solve_ik(T[None], q, iterations=8, rest_gain=0.01, damping=0.01)
        out.append(q[0])
    return np.array(out)
