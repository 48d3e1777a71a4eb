"""From object tracks in a camera's frame to a `Reference` in the robot's world that the Panda can follow.

Reference = T_init (T_CO(0))^-1 T_CO(t), as in FreePose (appendix A.6), with everything that the paper sets by hand
chosen here: the camera's tilt, scale, place and yaw in the workspace, grasp, start configuration, receptacle, time.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, angle_between_rad, invert_pose, make_pose, rotation_angle_rad
from ..extract.track import ObjectTrack
from .grasps import MAX_WIDTH_M
from .jet import filling_m3, jet_of, tilt_rad
from .placement_search import Placement, Shortfall, Stage, search_placement
from .receptacle import (
    ReceptaclePlacement,
    bottom_m,
    mouth_xy_m,
    place_receptacle,
    receptacle_pose_at_pour,
    shift_sentence,
    surface_points,
)
from .reference import Reference, vessel_from_header, vessel_to_header
from .resampling import ResampledTrack, resample_track
from .retiming import at_speed, slowed

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

MIN_SCALE = 0.3
DEFAULT_RECEPTACLE = "bowl"
_STILL_RAD, _STILL_S = np.deg2rad(5.0), 0.8
_SAME_TABLE_M = 0.08
# The receptacle is taken from where it was while the tilt was above this part of its greatest value.
_POURING_PART = 0.8


@dataclass(frozen=True)
class _Seen:
    """What the video shows, turned upright: poses with z up, camera at the origin.

    T_object: (N, 4, 4); R_up_camera: (3, 3); T_receptacle: (4, 4) or None.
    ray: (3,) the camera's line of sight to the object at its greatest tilt.
    """

    T_object: Array
    R_up_camera: Array
    T_receptacle: Array | None
    ray: Array


def build_reference(
    track: ObjectTrack,
    receptacle_track: ObjectTrack | None = None,
    *,
    control_hz: float = 25.0,
    scale: float | Literal["auto"] = "auto",
    elevation_deg: float = 30.0,
    gravity_tolerance_deg: float = 35.0,
    speed: float = 1.0,
    vessel: Vessel | None = None,
    receptacle: Vessel | None = None,
    seed: int = 0,
) -> Reference:
    """A reference that the Panda can follow, with grasp, start configuration and receptacle.

    scale: factor on the path's lengths about the moment of greatest tilt; "auto" = 1 or the largest below that fits.
    elevation_deg: how far the camera looks down. If the vessel's first, still poses then stand within
    `gravity_tolerance_deg` of upright, they are taken as exactly upright and the camera's tilt is corrected.
    vessel, receptacle: override what the tracks name. Without either a receptacle of the library is used.
    Raises UserError when the track cannot be used or nothing down to scale 0.3 is within reach.
    """
    if scale != "auto" and not 0.0 < float(scale) <= 3.0:
        raise UserError(f"the scale is {scale}; give a number in (0, 3] or 'auto'")
    if not -90.0 <= elevation_deg <= 90.0:
        raise UserError(f"the camera's elevation is {elevation_deg} degrees; give one from -90 to 90")
    if not 0.05 <= speed <= 5.0:
        raise UserError(f"the speed is {speed}; give a number from 0.05 to 5, where 1 is the video's")
    held = vessel or vessel_from_header(track.header.get("mesh", {}), "held vessel")
    target = receptacle or _receptacle_of(receptacle_track)
    track = _in_vessel_frame(track.from_first_camera(), held)
    receptacle_track = receptacle_track and _in_vessel_frame(receptacle_track.from_first_camera(), target)
    resampled = resample_track(track, control_hz)
    notes = list(resampled.notes)
    seen = _upright(track, resampled, receptacle_track, held, elevation_deg, gravity_tolerance_deg, notes)

    def stage_at(factor: float) -> tuple[Stage, list[str], ReceptaclePlacement]:
        return _make_stage(seen, held, target, factor, control_hz)

    def attempt(factor: float, thorough: bool) -> Placement | Shortfall:
        return search_placement(stage_at(factor)[0], np.random.default_rng(seed), thorough=thorough)

    factor, placement = _choose_scale(attempt, scale)
    stage, stage_notes, placed = stage_at(factor)
    notes += stage_notes
    if factor != 1.0:
        why = "as asked" if scale != "auto" else "because the whole of it is out of the arm's reach"
        notes.append(
            f"The path was scaled by {factor:.2f} about the moment of greatest tilt, {why}; rotations were not."
        )
    if not placement.grasp.fits_hand:
        notes.append(
            f"The vessel is {100 * placement.grasp.width_m:.1f} cm wide where it is held, the fingers open to "
            f"{100 * MAX_WIDTH_M:.1f} cm: it can be held in simulation only."
        )
    T_world_object = placement.T_world_stage @ stage.T_object
    T_world_camera = _camera_pose(placement.T_world_stage, stage, seen)
    header: dict[str, Any] = {
        "object": track.name,
        "symmetry": held.symmetry.to_json(),
        "vessel": vessel_to_header(held),
        "receptacle": {
            **vessel_to_header(target),
            "T_world_receptacle": (placement.T_world_stage @ _given(stage.T_receptacle)).tolist(),
            "seen": receptacle_track is not None,
        },
        "T_hand_object": placement.grasp.T_hand_object.tolist(),
        "grasp": placement.grasp.told(),
        "q_start_rad": placement.q_rad[0].tolist(),
        "scale": factor,
        "scale_chosen": "auto" if scale == "auto" else "given",
        "time_stretch": 1.0,
        "T_world_camera": T_world_camera.tolist(),
        "changed": {
            "leaps": [asdict(leap) for leap in resampled.leaps],
            "lifted_over_rim_m": placed.lift_m,
            "receptacle_moved_to_jet_m": float(np.linalg.norm(_moved_m(seen, placed))),
            # By how much gravity, where something upright told it, differs from the assumed elevation's.
            "camera_turned_rad": float(rotation_angle_rad(camera_rotation(elevation_deg), seen.R_up_camera)),
        },
        "settings": {
            "control_hz": control_hz,
            "elevation_deg": elevation_deg,
            "gravity_tolerance_deg": gravity_tolerance_deg,
            "speed": speed,
            "seed": seed,
        },
        "notes": notes,
        "feasibility": {"caught_part_of_jet": placed.caught},
    }
    reference = Reference.from_poses(T_world_object, stage.time_s, header, resampled.confidence, resampled.video_time_s)
    return slowed(*at_speed(reference, placement.q_rad, speed))


def _receptacle_of(track: ObjectTrack | None) -> Vessel:
    from ..extract.vessels import make_vessel

    if track is not None and ("library" in track.header.get("mesh", {}) or "file" in track.header.get("mesh", {})):
        return vessel_from_header(track.header["mesh"], "receptacle")
    return make_vessel(DEFAULT_RECEPTACLE)


def _in_vessel_frame(track: ObjectTrack, vessel: Vessel) -> ObjectTrack:
    """A track of the vessel's own frame: a user's mesh was followed in the axes of its file."""
    source = vessel.source
    if source is None or track.header.get("mesh", {}).get("sha256") != source.sha256:
        return track
    return replace(track, T_camera_object=track.T_camera_object @ source.T_file_vessel)


def _upright(
    track: ObjectTrack,
    resampled: ResampledTrack,
    receptacle_track: ObjectTrack | None,
    vessel: Vessel,
    elevation_deg: float,
    tolerance_deg: float,
    notes: list[str],
) -> _Seen:
    """Turn the camera's frame so that z is up, by the prior elevation and, where it can be trusted, the first poses."""
    T = resampled.T_camera_object
    R_assumed = camera_rotation(elevation_deg)
    R_up_camera, says = _up_from(
        still_axis(T, resampled.video_time_s),
        None if receptacle_track is None else still_axis(receptacle_track.T_camera_object, receptacle_track.time_s),
        R_assumed,
        tolerance_deg,
    )
    notes.append(says.format(is_deg=camera_elevation_deg(R_up_camera), assumed_deg=elevation_deg))
    up_camera = make_pose(R_up_camera)
    T_object = up_camera @ T
    if vessel.symmetry.order == 0:
        T_object = without_spin(T_object)
        notes.append("The vessel looks the same from all sides: its unseen spin about its own axis was left out.")
    T_receptacle = None
    if receptacle_track is not None:
        tilt = tilt_rad(T_object)
        pouring_s = resampled.video_time_s[tilt >= _POURING_PART * tilt.max()]
        T_receptacle = up_camera @ receptacle_pose_at_pour(receptacle_track, pouring_s)
    deepest = int(np.argmax(tilt_rad(T_object)))
    return _Seen(T_object, R_up_camera, T_receptacle, T_object[deepest, :3, 3])


def _up_from(axis: Array, receptacle_axis: Array | None, R_assumed: Array, tolerance_deg: float) -> tuple[Array, str]:
    """(3, 3) R_up_camera from the axes (3,), in the camera, of what stands; and a sentence about it to fill in.

    Raises UserError when the vessel hangs upside down and nothing tells that it was the camera.
    """
    up = np.array([0.0, 0.0, 1.0])

    # The same camera, turned about its line of sight.
    R_turned_over = R_assumed @ np.diag([-1.0, -1.0, 1.0])

    def off_deg(value: Array, R_up_camera: Array = R_assumed) -> float:
        return float(np.rad2deg(angle_between_rad(R_up_camera @ value, up)))

    if off_deg(axis) <= tolerance_deg:
        says = (
            "The vessel stands upright at first, so the camera looks down by {is_deg:.0f} degrees "
            "(assumed: {assumed_deg:.0f})."
        )
        return _least_rotation(R_assumed @ axis) @ R_assumed, says
    if off_deg(axis, R_turned_over) <= tolerance_deg:
        if receptacle_axis is None or off_deg(receptacle_axis, R_turned_over) > tolerance_deg:
            raise UserError(
                "the vessel stands on its head in its first poses: if the camera was upside down, turn the video by "
                "180 degrees; if not, the tracker took top for bottom: extract it again, with a --box around it"
            )
        says = "Vessel and receptacle stand on their heads, so the camera was upside down: the motion was turned over."
        return _least_rotation(R_turned_over @ axis) @ R_turned_over, says
    if receptacle_axis is not None and off_deg(receptacle_axis) <= tolerance_deg:
        says = (
            "The vessel leans at first, but the receptacle stands upright, so the camera looks down by {is_deg:.0f} "
            "degrees (assumed: {assumed_deg:.0f})."
        )
        return _least_rotation(R_assumed @ receptacle_axis) @ R_assumed, says
    says = (
        f"The vessel's first poses lean by {off_deg(axis):.0f} degrees under the assumed camera elevation of "
        "{assumed_deg:.0f} degrees; they are taken as they are. Give the elevation if the vessel stood upright."
    )
    return R_assumed, says


def camera_rotation(elevation_deg: float) -> Array:
    """(3, 3) R_world_camera of a camera in front of the robot that looks at it, down by `elevation_deg`."""
    e = np.deg2rad(elevation_deg)
    forward = np.array([-np.cos(e), 0.0, -np.sin(e)])
    right = np.array([0.0, 1.0, 0.0])
    return np.column_stack([right, np.cross(forward, right), forward])


def camera_elevation_deg(R_world_camera: Array) -> float:
    """How far a camera looks below the horizontal."""
    return float(np.rad2deg(np.arcsin(np.clip(-R_world_camera[2, 2], -1.0, 1.0))))


def still_axis(T: Array, time_s: Array) -> Array:
    """(3,) mean direction of the object's +z over the first 0.8 s, as long as it has not turned by 5 degrees."""
    axes = T[time_s <= time_s[0] + _STILL_S, :3, 2]
    turned = np.flatnonzero(angle_between_rad(axes, axes[0]) > _STILL_RAD)
    mean = axes[: max(1, int(turned[0]) if len(turned) else len(axes))].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def without_spin(T: Array) -> Array:
    """Poses with the same axis +z but no rotation about it, and +x where the liquid leaves at the greatest tilt."""
    out = T.copy()
    R = np.asarray(T[0, :3, :3])
    for k in range(len(T)):
        R = _least_rotation(R[:, 2], T[k, :3, 2]) @ R
        out[k, :3, :3] = R
    deepest = int(np.argmax(tilt_rad(T)))
    down = invert_pose(out[deepest])[:3, 2] * -1.0
    angle_rad = float(np.arctan2(down[1], down[0])) if np.hypot(down[0], down[1]) > 1e-3 else 0.0
    out[:, :3, :3] = out[:, :3, :3] @ Rotation.from_euler("z", angle_rad).as_matrix()
    return out


def _least_rotation(a: Array, b: Array | None = None) -> Array:
    """(3, 3) smallest rotation from unit vector a to b (+z by default)."""
    b = np.array([0.0, 0.0, 1.0]) if b is None else b
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if a @ b > 0 else Rotation.from_rotvec([np.pi, 0.0, 0.0]).as_matrix()
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, a @ b)).as_matrix())


def _make_stage(
    seen: _Seen, vessel: Vessel, receptacle: Vessel, factor: float, control_hz: float
) -> tuple[Stage, list[str], ReceptaclePlacement]:
    """Scale the path, put it on the table, stand the receptacle under the outlet."""
    notes: list[str] = []
    T = seen.T_object.copy()
    deepest = int(np.argmax(tilt_rad(T)))
    seen_start_m = float(T[0, 2, 3]) - bottom_m(vessel)
    T[:, :3, 3] = T[deepest, :3, 3] + factor * (T[:, :3, 3] - T[deepest, :3, 3])
    tracked = seen.T_receptacle
    base_m = 0.0
    if tracked is not None:
        tracked = _along_ray(tracked, T, vessel, receptacle, control_hz)
        # Heights mean something only once the receptacle is at the depth of the jet.
        held_high_m = seen_start_m - (float(tracked[2, 3]) - bottom_m(receptacle))
        base_m = held_high_m if held_high_m > _SAME_TABLE_M else 0.0
    lowest = _lowest_m(T, vessel)
    # The path's lowest point stands on the table, or the start as high above it as it was seen.
    rise = max(-lowest.min(), base_m - float(lowest[0]) if base_m > 0 else -np.inf)
    T[:, 2, 3] += rise
    if tracked is not None:
        tracked = make_pose(tracked[:3, :3], tracked[:3, 3] + [0.0, 0.0, rise])
    placed = place_receptacle(T, vessel, receptacle, tracked, control_hz)
    T[:, 2, 3] += placed.lift_m
    start_m = float(_lowest_m(T[:1], vessel)[0])
    if start_m > 0.005:
        reasons = []
        if base_m > 0:
            reasons.append("it was seen so")
        if placed.lift_m > 0.002:
            reasons.append(f"the vessel must be {100 * placed.lift_m:.1f} cm higher to pass over the receptacle's rim")
        if not reasons:
            reasons.append("the path goes lower later")
        notes.append(f"The vessel starts {100 * start_m:.1f} cm above the table: {' and '.join(reasons)}.")
    if tracked is not None:
        notes.append(shift_sentence(_moved_m(seen, placed), seen.ray))
    notes += placed.notes
    time_s = np.arange(len(T)) / control_hz
    return Stage(T, time_s, vessel, receptacle, placed.T_receptacle), notes, placed


def _moved_m(seen: _Seen, placed: ReceptaclePlacement) -> Array:
    """(2,) how far over the table the receptacle stands from where it was seen, if it was."""
    if seen.T_receptacle is None:
        return np.zeros(2)
    return np.asarray(placed.T_receptacle[:2, 3] - seen.T_receptacle[:2, 3])


def _along_ray(tracked: Array, T: Array, vessel: Vessel, receptacle: Vessel, control_hz: float) -> Array:
    """The receptacle slid along its own line of sight to the depth at which it is nearest to the jet."""
    jet = jet_of(T, vessel, filling_m3(vessel, receptacle), control_hz)
    landing = jet.share @ jet.landing_m(float(tracked[2, 3]) + bottom_m(receptacle))
    position = tracked[:3, 3]
    flat = position[:2]
    factor = float((landing - (mouth_xy_m(receptacle, tracked) - flat)) @ flat) / max(float(flat @ flat), 1e-9)
    # Far outside this range the track is wrong, not just its depth.
    return make_pose(tracked[:3, :3], position * float(np.clip(factor, 0.5, 2.0)))


def _lowest_m(T: Array, vessel: Vessel) -> Array:
    """(N,) height of the vessel's lowest point."""
    points = surface_points(vessel, 300)
    return np.asarray((T[:, 2, :3] @ points.T).min(axis=1) + T[:, 2, 3])


def _choose_scale(attempt: Any, scale: float | Literal["auto"]) -> tuple[float, Placement]:
    """The asked scale, or the largest up to 1 that fits to 0.05; UserError with the part out of reach otherwise."""
    wanted = 1.0 if scale == "auto" else float(scale)
    found = attempt(wanted, True)
    if isinstance(found, Placement):
        return wanted, found
    fitting = _largest_fitting(attempt, wanted)
    where = (
        f"the motion from {found.from_s:.1f} s to {found.to_s:.1f} s is out of the arm's reach by "
        f"{found.missing_m:.2f} m at scale {wanted:.2f}"
    )
    if fitting is None:
        raise UserError(f"{where}, and at every scale down to {MIN_SCALE}; check the track's units and the mesh's size")
    if scale != "auto":
        raise UserError(f"{where}; scale {fitting[0]:.2f} would fit")
    return fitting


def _largest_fitting(attempt: Any, wanted: float) -> tuple[float, Placement] | None:
    low, high = min(MIN_SCALE, wanted), wanted
    if isinstance(attempt(low, False), Shortfall):
        return None
    while high - low > 0.05:
        middle = round(0.5 * (low + high), 3)
        if isinstance(attempt(middle, False), Placement):
            low = middle
        else:
            high = middle
    # The quick look does not refine; the thorough one cannot do worse, except in collisions, which it reports.
    found = attempt(low, True)
    return (low, found) if isinstance(found, Placement) else None


def _camera_pose(T_world_stage: Array, stage: Stage, seen: _Seen) -> Array:
    """(4, 4) T_world_camera that shows the object at the greatest tilt where the video does."""
    deepest = int(np.argmax(tilt_rad(stage.T_object)))
    up_camera = make_pose(seen.R_up_camera, stage.T_object[deepest, :3, 3] - seen.T_object[deepest, :3, 3])
    return np.asarray(T_world_stage @ up_camera)


def _given(value: Array | None) -> Array:
    if value is None:
        raise RuntimeError("a stage built here always has a receptacle")
    return value
