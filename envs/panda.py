"""The Franka Panda as an `MjSpec`: kinematics, inertia and limits from example-robot-data, light visuals, actuators.

World frame = `panda_link0`, z up. The spec holds seven arm joints `panda_joint1..7`, two finger joints
`panda_finger_joint1..2`, one actuator per joint (same names) and the site `tcp` at `panda_hand_tcp`, midway between
the finger pads: z along the approach direction, y along which the fingers close. Links collide as capsules and boxes.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
from functools import cache
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.files import atomic_path
from ..extract.geometry import Array

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
PADS = ("panda_leftfinger_pad", "panda_rightfinger_pad")
LINKS = (*(f"panda_link{i}" for i in range(8)), "panda_hand", "panda_leftfinger", "panda_rightfinger")
TCP_SITE = "tcp"

# Limits of the joints, in one place. Position, speed and torque are the URDF's (a test holds them against the compiled
# model) and the datasheet's; acceleration, jerk and rate of torque are the datasheet's alone: Franka Control Interface
# documentation, "Robot and interface specifications", limits for the Panda in joint space.
Q_MIN_RAD: Array = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
Q_MAX_RAD: Array = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
DQ_MAX_RAD_S: Array = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
TAU_MAX_NM: Array = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
DDQ_MAX_RAD_S2: Array = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
DDDQ_MAX_RAD_S3: Array = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])
DTAU_MAX_NM_S = 1000.0
# What the hand may carry, fingers not counted.
PAYLOAD_MAX_KG = 3.0
Q_HOME_RAD: Array = np.array([0.0, -0.785398, 0.0, -2.35619, 0.0, 1.5707, 0.785398])
FINGER_MAX_M = 0.04
# From the second joint's axis to the flange (datasheet: maximum reach 855 mm); the tcp lies further along its axis.
REACH_MAX_M, FLANGE_TO_TCP_M = 0.855, 0.1034
# What the Franka Hand can press with for as long as one likes, and at most (datasheet: continuous force 70 N, maximum
# force 140 N, of which no duration is stated: a hold that needs it is reported as such); the stiffness of its servos
# here.
FINGER_MAX_N, FINGER_PEAK_N, FINGER_N_M = 70.0, 140.0, 1000.0

# Stiffness and damping of the joint servos. Natural frequencies lie near 9 Hz at the shoulder and 14 Hz at the wrist
# with damping ratio about 1: fast enough to follow 25 Hz targets, slow enough that a step between two targets
# does not ring. `SERVO_LEAD_S` = damping / stiffness is the time by which such a servo lags a moving target; adding
# it times the target's speed to the target cancels the lag (`joint_command`).
ARMATURE_KG_M2 = 0.1
SERVO_LEAD_S = 0.035
STIFFNESS_NM_RAD: Array = np.array([6000.0, 6000.0, 4500.0, 4500.0, 1200.0, 900.0, 600.0])
DAMPING_NM_S_RAD: Array = SERVO_LEAD_S * STIFFNESS_NM_RAD

# Contact bits of the whole scene, in one place: see `scene.py` for the pairs they allow.
CONTACT_PARTICLE, CONTACT_VESSEL, CONTACT_ROBOT, CONTACT_HELD, CONTACT_GRIP = 1, 2, 4, 8, 16

# One capsule a link: both ends of its middle line in the link's frame and its radius, in m. They were fitted to the
# hulls of the collision meshes, stay within 2 cm of them both ways, and cost next to nothing.
CAPSULES_M: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    "panda_link0": ((-0.067, 0.0, 0.05), (0.004, 0.0, 0.05), 0.085),
    "panda_link1": ((0.0, -0.055, 0.0), (0.0, 0.0, -0.138), 0.0665),
    "panda_link2": ((0.0, -0.141, 0.0), (0.0, 0.0, 0.0545), 0.0665),
    "panda_link3": ((0.0815, 0.043, -0.001), (0.0, 0.001, -0.0745), 0.066),
    "panda_link4": ((-0.0815, 0.076, 0.001), (-0.001, 0.002, 0.0435), 0.065),
    "panda_link5": ((0.001, 0.068, -0.007), (0.001, 0.0035, -0.211), 0.063),
    "panda_link6": ((0.019, 0.005, 0.0145), (0.088, 0.01, 0.0), 0.06),
    "panda_link7": ((-0.0065, -0.0065, 0.078), (0.0315, 0.031, 0.079), 0.0415),
}
# Boxes (centre, half extents) in m: the palm, and of each finger the pad that grips and the knuckle that carries it.
PALM_M = ((0.0, 0.0, 0.021), (0.03, 0.102, 0.045))
PAD_M = ((0.0, 0.0072, 0.0448), (0.0088, 0.0072, 0.0088))
KNUCKLE_M = ((0.0, 0.0175, 0.018), (0.0105, 0.0085, 0.018))
# Fixed to each other or so near that their hulls overlap in every configuration.
NEIGHBOURS = (
    ("panda_link0", "panda_link1"),
    ("panda_link5", "panda_link7"),
    ("panda_link5", "panda_hand"),
    ("panda_link6", "panda_hand"),
    ("panda_leftfinger", "panda_rightfinger"),
)

_COLORS = {"white": (0.93, 0.94, 0.95, 1.0), "dark": (0.24, 0.25, 0.27, 1.0), "blue": (0.04, 0.54, 0.78, 1.0)}
_FACES_PER_LINK = 2000
_CACHE_VERSION = 2


def joint_command(target_rad: Array, target_rad_s: Array) -> Array:
    """Control signal (7,) that makes the arm servos follow a target (7,) moving at `target_rad_s` without lag."""
    return target_rad + SERVO_LEAD_S * target_rad_s


def panda_spec(visuals: bool = True, actuation: Literal["servo", "torque"] = "servo") -> mujoco.MjSpec:
    """A fresh `MjSpec` of the Panda with its base at the world's origin.

    visuals: False leaves the decimated visual meshes out (kinematics only: faster to compile).
    actuation: of the arm. "servo" takes joint positions in rad, "torque" joint torques in Nm beyond what gravity needs,
        as libfranka does. The fingers are position servos in m either way.
    Joint torques, gravity compensation included, are limited to the URDF's efforts.
    """
    spec = mujoco.MjSpec.from_file(str(urdf_path()))
    spec.modelname = "panda"
    # Without this, hand and tcp would melt into link 7 and their names would be gone.
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    for geom in [geom for body in spec.bodies for geom in body.geoms]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for body in spec.bodies:
        if body.name == "world":
            continue
        # The compensation goes through the motors, so that it counts against their limits as it does on the robot.
        body.gravcomp = 1.0
        for joint in body.joints:
            joint.actgravcomp = True
    _add_collision_shapes(spec)
    for name, stiffness, damping, limit in zip(ARM_JOINTS, STIFFNESS_NM_RAD, DAMPING_NM_S_RAD, TAU_MAX_NM, strict=True):
        joint = spec.joint(name)
        joint.armature, joint.damping = ARMATURE_KG_M2, np.array([0.5, 0.0, 0.0])
        if actuation == "servo":
            _add_servo(spec, name, float(stiffness), float(damping))
        else:
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.ctrllimited, motor.ctrlrange = mujoco.mjtLimited.mjLIMITED_TRUE, (-float(limit), float(limit))
    for name in FINGER_JOINTS:
        joint = spec.joint(name)
        joint.armature, joint.damping = 0.1, np.array([1.0, 0.0, 0.0])
        # A hand that has lost what it held presses on the stop.
        joint.solref_limit[:2], joint.solimp_limit[:2] = (0.004, 1.0), (0.99, 0.999)
        servo = _add_servo(spec, name, FINGER_N_M, 20.0)
        servo.forcelimited, servo.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, (-FINGER_MAX_N, FINGER_MAX_N)
    spec.body("panda_hand_tcp").add_site(name=TCP_SITE, size=[0.005, 0.005, 0.005], group=4)
    if visuals:
        _add_visuals(spec)
    return spec


def _add_collision_shapes(spec: mujoco.MjSpec) -> None:
    """Capsules and boxes, named after their link; a finger's pad is `LINK_pad`."""
    for link, (start, end, radius) in CAPSULES_M.items():
        _solid(spec.body(link), type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[radius, 0.0, 0.0])
    _solid(spec.body("panda_hand"), pos=PALM_M[0], size=PALM_M[1])
    for side, finger in ((1.0, "panda_leftfinger"), (-1.0, "panda_rightfinger")):
        for name, ((x, y, z), half) in (("pad", PAD_M), ("knuckle", KNUCKLE_M)):
            _solid(spec.body(finger), name=f"{finger}_{name}", pos=[x, side * y, z], size=half)
    for first, second in NEIGHBOURS:
        spec.add_exclude(bodyname1=first, bodyname2=second)


def _solid(body: mujoco.MjsBody, **shape: Any) -> None:
    geom = body.add_geom(**{"type": mujoco.mjtGeom.mjGEOM_BOX, "name": f"{body.name}_shape", **shape})
    geom.group, geom.contype, geom.conaffinity = 3, CONTACT_ROBOT, CONTACT_ROBOT
    geom.mass, geom.condim = 0.0, 3


def _add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float) -> mujoco.MjsActuator:
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = stiffness
    actuator.biasprm[:3] = (0.0, -stiffness, -damping)
    return actuator


def urdf_path() -> Path:
    """The Panda's description, of which every model of it here is made. Raises UserError when it is missing."""
    return _description_folder() / "urdf" / "panda.urdf"


def _description_folder() -> Path:
    # The data are a distribution of their own; the module `example_robot_data` is another one, which imports pinocchio,
    # so that only its place is of use, where a package manager other than pip brought both.
    roots = []
    try:
        roots.append(Path(str(importlib.metadata.distribution("example-robot-data").locate_file("cmeel.prefix"))))
    except importlib.metadata.PackageNotFoundError:
        found = importlib.util.find_spec("example_robot_data")
        roots += Path(found.origin).parents if found is not None and found.origin is not None else []
    for root in roots:
        folder = root / "share" / "example-robot-data" / "robots" / "panda_description"
        if folder.is_dir():
            return folder
    raise UserError("the Panda's description is missing; install it with `pip install 'example-robot-data>=5,<6'`")


def _add_visuals(spec: mujoco.MjSpec) -> None:
    for name, (vertices, faces) in _visual_meshes().items():
        mesh = spec.add_mesh(name=f"visual_{name}", uservert=vertices.ravel(), userface=faces.ravel())
        # The parts are open shells: their volume means nothing, and no inertia is taken from them.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for link in LINKS:
        part = link.removeprefix("panda_").removeprefix("left").removeprefix("right")
        for color, rgba in _COLORS.items():
            if f"{part}_{color}" not in _visual_meshes():
                continue
            geom = spec.body(link).add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"visual_{part}_{color}", rgba=list(rgba)
            )
            geom.group, geom.contype, geom.conaffinity, geom.mass = 2, 0, 0, 0.0
            if link == "panda_rightfinger":
                geom.quat = [0.0, 0.0, 0.0, 1.0]


@cache
def _visual_meshes() -> dict[str, tuple[NDArray[np.float32], NDArray[np.int32]]]:
    """Vertices and faces by `part_color`, from the user's cache or decimated now (about 10 s, once per machine)."""
    path = cache_folder() / f"panda_visuals_v{_CACHE_VERSION}.npz"
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError):
        arrays = _decimated_visuals()
        try:
            with atomic_path(path) as temporary, open(temporary, "wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)
        except OSError:
            pass  # an unwritable home costs time at every start, nothing else
    names = sorted(name.removesuffix(".vertices") for name in arrays if name.endswith(".vertices"))
    return {name: (arrays[f"{name}.vertices"], arrays[f"{name}.faces"]) for name in names}


def cache_folder() -> Path:
    """Where derived files that can always be made again are kept."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vid2demo"


def _decimated_visuals() -> dict[str, NDArray[Any]]:
    import trimesh

    folder = _description_folder() / "meshes" / "visual"
    arrays: dict[str, NDArray[Any]] = {}
    for source in sorted(folder.glob("*.dae")):
        scene: Any = trimesh.load(source, force="scene")
        by_color: dict[str, list[Any]] = {}
        for node in scene.graph.nodes_geometry:
            T_scene_part, name = scene.graph[node]
            part = scene.geometry[name].copy()
            part.apply_transform(T_scene_part)
            if len(part.faces) > 20:  # smaller ones are labels and LEDs
                by_color.setdefault(_color_name(part), []).append(part)
        total = sum(len(part.faces) for parts in by_color.values() for part in parts)
        for color, parts in by_color.items():
            mesh: Any = trimesh.util.concatenate([trimesh.Trimesh(p.vertices, p.faces) for p in parts])
            mesh.merge_vertices(digits_vertex=5)
            keep = max(60, round(_FACES_PER_LINK * len(mesh.faces) / total))
            if len(mesh.faces) > keep:
                mesh = mesh.simplify_quadric_decimation(face_count=keep)
            arrays[f"{source.stem}_{color}.vertices"] = np.asarray(mesh.vertices, np.float32)
            arrays[f"{source.stem}_{color}.faces"] = np.asarray(mesh.faces, np.int32)
    return arrays


def _color_name(part: Any) -> str:
    red, _, blue = (int(v) for v in part.visual.material.main_color[:3])
    if red > 128:
        return "white"
    return "blue" if blue > 128 else "dark"
