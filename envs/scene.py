"""The whole scene as one `MjSpec`: robot, table, held vessel, receptacle, particles, cameras, lights.

Contact pairs: particles touch particles, vessels and furniture; the arm touches itself and furniture; the held vessel
touches furniture with its hull. Nothing else collides: vessels do not touch each other, the arm touches no particles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose, make_pose, transform_points
from .cameras import CameraPose, add_cameras
from .grip import pressing_n, weight_part
from .holding import Grasp, add_grip, set_grasp_options
from .jet import filling_kg
from .kinematics import HAND_BODY
from .liquid import Liquid, add_particles
from .panda import CONTACT_HELD, CONTACT_PARTICLE, CONTACT_ROBOT, CONTACT_VESSEL, panda_spec
from .vessel_geometry import (
    STANDING_WALL_M,
    Box,
    Cavity,
    cavity_of,
    collision_boxes,
    convex_hull,
    gripper_half_width_m,
    visual_parts,
)

if TYPE_CHECKING:
    from ..extract.vessels import Vessel
    from .reference import Reference

VESSEL_BODY, RECEPTACLE_BODY = "vessel", "receptacle"
TABLE_CENTER_XY_M, TABLE_HALF_M, TABLE_THICKNESS_M = (0.35, 0.0), (0.75, 0.75), 0.04
FLOOR_Z_M, FLOOR_THICKNESS_M = -0.72, 0.2
MAX_PICTURE_PX = 1920
WATER_RGBA = [0.42, 0.78, 0.98, 1.0]
# The hull of the held vessel ends this much inside its surface: one that stands on the table is not pushed.
HULL_INSET_M, HULL_VERTICES = 0.002, 40
# The receptacle gets a pedestal when it stands higher than this above the table.
PEDESTAL_FROM_M = 0.004


@dataclass(frozen=True)
class Scene:
    """A compiled scene and what is needed to work with it.

    vessel_cavity, receptacle_cavity: the hollows, each in its vessel's frame. vessel_boxes: collision shapes of the
    held vessel. T_world_receptacle: (4, 4) where the model has the receptacle. radius_m: particle radius. Without a
    receptacle what belongs to it is None, and its body is empty.
    """

    model: mujoco.MjModel
    vessel: Vessel
    receptacle: Vessel | None
    vessel_cavity: Cavity
    receptacle_cavity: Cavity | None
    vessel_boxes: list[Box]
    T_world_receptacle: Array
    num_particles: int
    radius_m: float
    liquid: Liquid


def build_scene(
    reference: Reference,
    num_particles: int,
    liquid: Liquid,
    timestep_s: float,
    *,
    actuation: Literal["servo", "torque"] = "servo",
    grasp: Grasp = "weld",
    cameras: Sequence[CameraPose] = (),
) -> Scene:
    """Build and compile the scene of a reference, with `cameras` beside the built-in ones.

    grasp: "weld" makes the vessel a part of the hand, "friction" a free body that the fingers hold.
    Raises UserError when the receptacle would stand in the table, or when the fingers cannot close on the vessel.
    """
    vessel, vessel_cavity = reference.vessel(), cavity_of(reference.vessel())
    receptacle = reference.receptacle() if reference.has_receptacle else None
    receptacle_cavity = None if receptacle is None else cavity_of(receptacle)
    if num_particles and receptacle is None:
        raise UserError(
            f"the reference has no receptacle to pour {num_particles} particles into; choose num_particles=0 "
            "(PandaTrack-v0), name a receptacle, or build it with `vid2demo retarget --receptacle NAME`"
        )
    throat_m = vessel_cavity.throat_m if vessel.outlet.kind == "lip" else math.inf
    room_m3 = math.inf if receptacle_cavity is None else receptacle_cavity.volume_m3
    radius_m = liquid.radius_for(num_particles, vessel_cavity.volume_m3, room_m3, throat_m)
    T_world_receptacle = np.eye(4) if receptacle is None else reference.T_world_receptacle

    spec = panda_spec(actuation=actuation)
    spec.modelname = "vid2demo_pouring"
    _set_options(spec, timestep_s)
    # As stiff as the step allows. The impedance is a little below MuJoCo's default: with it eight solver iterations
    # settle a pile that is shaken, where at 0.9 one particle in two thousand was squeezed through a wall.
    contact: dict[str, Any] = {
        "condim": 3 if liquid.friction > 0.0 else 1,
        "friction": [liquid.friction, 0.0, 0.0],
        "solref": [2 * timestep_s, 1.0],
        "solimp": [0.8, 0.9, 0.001, 0.5, 2.0],
    }
    _add_furniture(spec, contact)
    vessel_contact = {**contact, "contype": CONTACT_VESSEL, "conaffinity": CONTACT_PARTICLE}
    vessel_boxes = collision_boxes(vessel, vessel_cavity)
    if grasp == "weld":
        # A part of the hand's own tree, not a free body tied by a weld constraint: it cannot slip or lag, and it costs
        # the contact solver nothing. What a hand of rubber and steel would give way is left out.
        held = spec.body(HAND_BODY).add_body(name=VESSEL_BODY, gravcomp=1.0, **_placed(reference.T_hand_object))
    else:
        held = spec.worldbody.add_body(name=VESSEL_BODY, **_placed(reference.T_world_object[0]))
        held.add_freejoint()
        add_grip(spec, held, vessel, reference.T_hand_object, timestep_s, _pressing_n(reference, vessel, receptacle))
        set_grasp_options(spec.option)
    _add_vessel(spec, held, vessel, vessel_boxes, vessel_contact)
    _add_hull(spec, held, vessel, contact)
    standing = spec.worldbody.add_body(name=RECEPTACLE_BODY, **_placed(T_world_receptacle))
    if receptacle is not None and receptacle_cavity is not None:
        standing_boxes = collision_boxes(receptacle, receptacle_cavity, STANDING_WALL_M)
        _add_vessel(spec, standing, receptacle, standing_boxes, vessel_contact)
        _add_pedestal(spec, standing, receptacle, T_world_receptacle, vessel_contact)
    particle_contact = {**contact, "contype": CONTACT_PARTICLE, "conaffinity": CONTACT_PARTICLE | CONTACT_VESSEL}
    if liquid.solver == "engine":
        add_particles(spec, num_particles, radius_m, liquid, particle_contact, WATER_RGBA)
    add_cameras(spec, reference, vessel, cameras)
    model = spec.compile()
    return Scene(
        model,
        vessel,
        receptacle,
        vessel_cavity,
        receptacle_cavity,
        vessel_boxes,
        T_world_receptacle,
        num_particles,
        radius_m,
        liquid,
    )


def _pressing_n(reference: Reference, vessel: Vessel, receptacle: Vessel | None) -> float:
    """What each finger presses with on the vessel, filled as usual, along the reference."""
    T, width_m = reference.T_hand_object, 2.0 * gripper_half_width_m(vessel, reference.T_hand_object)
    contents_kg, flat = filling_kg(vessel, receptacle), reference.header.get("grasp", {}).get("kind") == "body"
    return pressing_n(weight_part(vessel, contents_kg, reference.T_world_object, T, width_m, flat))


def particle_obstacles(model: mujoco.MjModel, body: str) -> list[Box]:
    """What particles bounce off of a body (`VESSEL_BODY`, `RECEPTACLE_BODY` or "world"), in the body's frame."""
    boxes = []
    for i in np.flatnonzero(model.geom_bodyid == model.body(body).id):
        if not (model.geom_contype[i] & CONTACT_VESSEL or model.geom_conaffinity[i] & CONTACT_PARTICLE):
            continue
        R = Rotation.from_quat(model.geom_quat[i], scalar_first=True).as_matrix()
        size, center = model.geom_size[i].copy(), model.geom_pos[i].copy()
        kind = int(model.geom_type[i])
        if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
            size[:] = size[0], size[0], size[1]
        elif kind == int(mujoco.mjtGeom.mjGEOM_PLANE):
            # As thick as it takes for nothing to fall through it.
            size[2] = FLOOR_THICKNESS_M / 2
            center -= R[:, 2] * size[2]
        boxes.append(Box(center, R, size, kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER)))
    return boxes


def wxyz(R: Array) -> list[float]:
    """Quaternion of a rotation matrix in MuJoCo's order."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(R, float).ravel())
    return [float(v) for v in quat]


def _placed(T: Array) -> dict[str, Any]:
    return {"pos": T[:3, 3].tolist(), "quat": wxyz(T[:3, :3])}


def _set_options(spec: mujoco.MjSpec, timestep_s: float) -> None:
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Eight iterations of CG are what 100 contacts need to stay tight; leaks and jitter were measured at these values.
    option.solver, option.iterations = mujoco.mjtSolver.mjSOL_CG, 8
    # Pyramids leak with so few iterations.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # A diverged state must be seen, not silently replaced by the initial one.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    visual = spec.visual
    # Software rendering: no shadow maps, no multisampling, coarse spheres.
    visual.quality.shadowsize, visual.quality.offsamples = 0, 0
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 10, 7, 1
    visual.map.znear, visual.map.zfar = 0.01, 40.0
    visual.headlight.active = True
    visual.headlight.ambient, visual.headlight.diffuse = [0.42, 0.42, 0.44], [0.25, 0.25, 0.25]
    visual.headlight.specular = [0.0, 0.0, 0.0]
    visual.global_.offwidth, visual.global_.offheight = MAX_PICTURE_PX, MAX_PICTURE_PX
    spec.stat.center, spec.stat.extent = [0.4, 0.0, 0.3], 1.2
    down = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    for direction, diffuse, specular in (([-0.4, 0.5, -1.0], 0.45, 0.35), ([-0.6, -0.7, -0.5], 0.2, 0.0)):
        light = spec.worldbody.add_light(type=down, dir=direction, diffuse=[diffuse] * 3, specular=[specular] * 3)
        light.castshadow = False
        light.ambient = [0.0, 0.0, 0.0]
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=384)
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    sky.rgb1, sky.rgb2 = [0.62, 0.74, 0.88], [0.93, 0.95, 0.97]


@cache
def _wood(size: int = 256) -> bytes:
    """RGB bytes of planks with a fine grain, the same at every call."""
    v, u = np.mgrid[0:size, 0:size] / size
    plank = np.floor(v * 6)
    shade = 0.05 * np.sin(12.9898 * plank + 4.1) + 0.02 * np.sin(2 * np.pi * 3 * u + 5 * plank)
    grain = 0.035 * np.sin(2 * np.pi * (v * 46 + 0.9 * np.sin(2 * np.pi * (u + 0.37 * plank)) + 0.15 * plank))
    groove = np.where((v * 6) % 1.0 < 0.03, -0.18, 0.0)
    tone = 0.86 + shade + grain + groove
    rgb = tone[..., None] * np.array([0.86, 0.70, 0.52])
    return bytes((np.clip(rgb, 0, 1) * 255).astype(np.uint8).tobytes())


def _textured(spec: mujoco.MjSpec, name: str, repeat: float, **texture: Any) -> None:
    data = texture.pop("data", None)
    added = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, **texture)
    if data is not None:
        added.data = data
    material = spec.add_material(name=name, texrepeat=[repeat, repeat], specular=0.1, shininess=0.2)
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    material.textures = textures


def _add_furniture(spec: mujoco.MjSpec, contact: dict[str, Any]) -> None:
    _textured(spec, "wood", 1.0, width=256, height=256, nchannel=3, data=_wood())
    _textured(
        spec,
        "tiles",
        8.0,
        width=128,
        height=128,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.80, 0.82],
        rgb2=[0.72, 0.74, 0.77],
    )
    solid = {**contact, "contype": 0, "conaffinity": CONTACT_PARTICLE | CONTACT_ROBOT | CONTACT_HELD}
    half = [*TABLE_HALF_M, TABLE_THICKNESS_M / 2]
    x, y = TABLE_CENTER_XY_M
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=half,
        pos=[x, y, -half[2]],
        material="wood",
        **solid,
    )
    floor_size = [4.0, 4.0, 0.1]
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=floor_size,
        pos=[x, y, FLOOR_Z_M],
        material="tiles",
        **solid,
    )
    leg_m = (-FLOOR_Z_M - TABLE_THICKNESS_M) / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[0.025, 0.025, leg_m],
                pos=[x + sx * (half[0] - 0.06), y + sy * (half[1] - 0.06), FLOOR_Z_M + leg_m],
                rgba=[0.30, 0.31, 0.33, 1.0],
                contype=0,
                conaffinity=0,
            )


def _add_vessel(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, vessel: Vessel, boxes: list[Box], contact: dict[str, Any]
) -> None:
    """Drawn parts, invisible collision shapes and inertia of a vessel."""
    name = body.name
    for number, (rgba, vertices, faces) in enumerate(visual_parts(vessel.mesh)):
        mesh = spec.add_mesh(name=f"{name}_{number}", uservert=vertices.ravel(), userface=faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.add_material(name=f"{name}_{number}", rgba=list(rgba), specular=0.6, shininess=0.6)
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, material=f"{name}_{number}")
        geom.group, geom.contype, geom.conaffinity, geom.mass = 1, 0, 0, 0.0
    for box in boxes:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if box.round else mujoco.mjtGeom.mjGEOM_BOX
        size = [box.half_m[0], box.half_m[2], 0.0] if box.round else box.half_m.tolist()
        geom = body.add_geom(type=kind, size=size, pos=box.center_m.tolist(), quat=wxyz(box.R), **contact)
        geom.group, geom.mass = 3, 0.0
    body.mass, body.explicitinertial = vessel.mass_kg, True
    body.ipos, body.fullinertia = _shell_inertia(vessel)


def _shell_inertia(vessel: Vessel) -> tuple[Array, Array]:
    """Centre of mass (3,) and inertia about it (xx, yy, zz, xy, xz, yz), of walls that are equally thick all over."""
    points, share = np.asarray(vessel.mesh.triangles_center), np.asarray(vessel.mesh.area_faces)
    share = share / share.sum()
    center = share @ points
    away = points - center
    second = vessel.mass_kg * (away * share[:, None]).T @ away
    full = np.trace(second) * np.eye(3) - second
    return center, full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _add_hull(spec: mujoco.MjSpec, body: mujoco.MjsBody, vessel: Vessel, contact: dict[str, Any]) -> None:
    """What the held vessel touches the table with: the walls for particles reach too far out for that."""
    hull = convex_hull(vessel.mesh)
    # The vessel's frame has its origin in the middle of the bounding box.
    shrunk = np.asarray(hull.vertices) * (1.0 - 2.0 * HULL_INSET_M / np.asarray(vessel.extents_m))
    mesh = spec.add_mesh(name=f"{body.name}_hull", uservert=shrunk.ravel(), userface=np.asarray(hull.faces).ravel())
    mesh.maxhullvert = HULL_VERTICES
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, name=mesh.name, meshname=mesh.name)
    geom.contype, geom.conaffinity, geom.condim = CONTACT_HELD, 0, 3
    geom.solref[:2], geom.solimp, geom.group, geom.mass = contact["solref"], contact["solimp"], 3, 0.0


def _add_pedestal(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, receptacle: Vessel, T_world: Array, contact: dict[str, Any]
) -> None:
    corners = transform_points(T_world, np.asarray(receptacle.mesh.vertices))
    bottom_m = float(corners[:, 2].min())
    if bottom_m < -0.01:
        raise UserError(
            f"the receptacle's lowest point lies {-1000 * bottom_m:.0f} mm below the table; "
            "move T_world_receptacle up or build the reference again"
        )
    if bottom_m < PEDESTAL_FROM_M:
        return
    # Only the foot must be carried: the part of the vessel within 5 mm of its lowest point.
    foot = corners[corners[:, 2] < bottom_m + 0.005]
    center = (foot[:, :2].min(0) + foot[:, :2].max(0)) / 2
    radius = max(0.03, float(np.linalg.norm(foot[:, :2] - center, axis=1).max()) + 0.012)
    T = invert_pose(T_world) @ make_pose(None, (float(center[0]), float(center[1]), bottom_m / 2))
    geom = body.add_geom(
        name="pedestal",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius, bottom_m / 2, 0],
        rgba=[0.55, 0.58, 0.62, 1.0],
        **_placed(T),
        **contact,
    )
    geom.group, geom.mass = 1, 0.0
