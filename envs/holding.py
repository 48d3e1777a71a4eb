"""How the hand holds the vessel: as a part of the hand's own tree ("weld"), or by the fingers' friction alone.

Under friction the vessel is a free body. What the pads press on is the convex hull of its surface between them, which
is exact for flat pads, and seen by nothing else. A rack couples the fingers as in the Franka Hand, and they press with
what it can keep up, harder only where the weight asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose, make_pose, transform_points
from .grip import RUBBER
from .kinematics import HAND_BODY, JOINT_COUNT
from .panda import CONTACT_GRIP, CONTACT_ROBOT, FINGER_JOINTS, FINGER_MAX_M, FINGER_N_M, PAD_M, PADS
from .vessel_geometry import gripper_half_width_m

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

Grasp = Literal["weld", "friction"]
# How far beyond the pads the vessel's true shape is kept, so that one that slips a little is still held by it.
MARGIN_M, HULL_VERTICES = 0.003, 64
CLOSING_S = 0.15
# A hundred times what the arm's joints carry: more would spoil the accuracy of the contacts.
_HEAVY_KG_M2 = 1e4
_FINGERS = slice(JOINT_COUNT, JOINT_COUNT + 2)


def set_grasp_options(option: mujoco.MjOption) -> None:
    """Solver options under which friction holds: a chain of stiff contacts is nothing for a few steps of CG."""
    option.solver, option.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 30
    # Friction creeps under load, the less the stiffer it is against the normal force.
    option.impratio = 1000.0


def add_grip(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    vessel: Vessel,
    T_hand_object: Array,
    timestep_s: float,
    pressing_n: float,
) -> None:
    """Make a free body of the spec holdable: rubber on the pads, the hull between them, the rack of the fingers.

    pressing_n: what each finger presses with.
    """
    stiff = [2 * timestep_s, 1.0]
    for name in PADS:
        pad = spec.geom(name)
        pad.conaffinity, pad.priority, pad.condim = CONTACT_ROBOT | CONTACT_GRIP, 1, 4
        pad.friction, pad.solref[:2], pad.solimp = RUBBER, stiff, [0.95, 0.99, 0.001, 0.5, 2.0]
    mesh = spec.add_mesh(name=f"{body.name}_grip", uservert=grip_points(vessel, T_hand_object).ravel())
    mesh.maxhullvert = HULL_VERTICES
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, name=mesh.name, meshname=mesh.name)
    geom.contype, geom.conaffinity, geom.group, geom.mass = CONTACT_GRIP, 0, 3, 0.0
    for name in FINGER_JOINTS:
        spec.actuator(name).forcerange = (-pressing_n, pressing_n)
    rack = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=FINGER_JOINTS[0], name2=FINGER_JOINTS[1])
    rack.data[:5], rack.solref[:2] = (0.0, 1.0, 0.0, 0.0, 0.0), stiff


def grip_points(vessel: Vessel, T_hand_object: Array) -> Array:
    """(N, 3) points of the vessel's surface between the pads, in its own frame; their convex hull is what they touch.

    Raises UserError when the fingers cannot close on it.
    """
    import trimesh

    half_width_m = gripper_half_width_m(vessel, T_hand_object)
    if not 0.0 < half_width_m < FINGER_MAX_M:
        what = "wider than the hand opens" if half_width_m > 0.0 else "not between the fingers"
        raise UserError(
            f"the {vessel.category} is {what} where the reference holds it, so friction cannot hold it; "
            'choose grasp="weld" or a reference with another grasp'
        )
    in_hand: Any = trimesh.Trimesh(
        transform_points(T_hand_object, np.asarray(vessel.mesh.vertices)), vessel.mesh.faces, process=False
    )
    half_x_m, _, half_z_m = PAD_M[1]
    reach_m = (half_x_m + MARGIN_M, half_width_m + 0.0005, half_z_m + MARGIN_M)
    for normal, most_m in zip(np.eye(3), reach_m, strict=True):
        for side in (1.0, -1.0):
            in_hand = in_hand.slice_plane(-side * most_m * normal, side * normal)
    return transform_points(invert_pose(T_hand_object), np.asarray(in_hand.vertices))


class Holding:
    """The held vessel of a scene in motion, seen from the hand.

    free: whether friction holds it. positions, velocities: how many of the engine's numbers are the vessel's; they lie
    between the fingers' and the particles'.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, vessel: Vessel, T_hand_object: Array) -> None:
        self._model, self._data = model, data
        self._hand, self._vessel = (int(model.body(name).id) for name in (HAND_BODY, "vessel"))
        self.free = int(model.body_dofnum[self._vessel]) == 6
        self.positions, self.velocities = (7, 6) if self.free else (0, 0)
        width_m = gripper_half_width_m(vessel, T_hand_object)
        pressing_n = float(model.actuator(FINGER_JOINTS[0]).forcerange[1])
        self._command_m = width_m - pressing_n / FINGER_N_M if self.free else width_m
        # The closed hand: the vessel's pose in it and where the fingers are.
        self._T_closed, self._fingers_m = np.array(T_hand_object, np.float64), np.array([width_m, width_m])

    @property
    def T_hand_object(self) -> Array:
        """(4, 4) pose of the vessel in the hand, as of the last kinematics."""
        return invert_pose(self._pose_of(self._hand)) @ self._pose_of(self._vessel)

    def pose(self, T_hand_object: Array | None = None) -> None:
        """Close fingers and vessel on each other for the posture that the arm has in the engine's memory.

        T_hand_object: (4, 4) where a free vessel is in the hand; as it was when the hand had closed if None.
        """
        model, data = self._model, self._data
        data.qpos[_FINGERS], data.ctrl[_FINGERS] = self._fingers_m, self._command_m
        mujoco.mj_kinematics(model, data)
        if self.free:
            T = self._pose_of(self._hand) @ (self._T_closed if T_hand_object is None else T_hand_object)
            data.qpos[9:12] = T[:3, 3]
            data.qpos[12:16] = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
            mujoco.mj_kinematics(model, data)

    def close(self) -> None:
        """Let the fingers of a posed hand press: first on a vessel without weight, then on one that has it."""
        if self.free:
            gravity = self._model.opt.gravity.copy()
            self._model.opt.gravity[:] = 0.0
            mujoco.mj_step(self._model, self._data, round(CLOSING_S / self._model.opt.timestep))
            self._model.opt.gravity[:] = gravity
            mujoco.mj_step(self._model, self._data, round(CLOSING_S / self._model.opt.timestep))

    def keep(self) -> None:
        """What the hand holds now is what `pose` restores and `slip` compares with."""
        mujoco.mj_kinematics(self._model, self._data)
        if self.free:
            self._T_closed, self._fingers_m = self.T_hand_object, self._data.qpos[_FINGERS].copy()

    def take_over(self, other: Holding) -> None:
        """Hold the vessel as another scene's hand does."""
        self._T_closed, self._fingers_m = other._T_closed, other._fingers_m

    def read_twist(self, out: Array) -> None:
        """Velocity (6,) of a free vessel's origin: linear [m/s] and angular [rad/s], world axes."""
        out[:3] = self._data.qvel[9:12]
        out[3:] = self._data.xmat[self._vessel].reshape(3, 3) @ self._data.qvel[12:15]

    def slip(self) -> tuple[float, float]:
        """How far the vessel has moved in the hand since it had closed: of its origin in m, and in rad."""
        if not self.free:
            return 0.0, 0.0
        T = self.T_hand_object
        turn = Rotation.from_matrix(T[:3, :3] @ self._T_closed[:3, :3].T)
        return float(np.linalg.norm(T[:3, 3] - self._T_closed[:3, 3])), float(turn.magnitude())

    def _pose_of(self, body: int) -> Array:
        return make_pose(self._data.xmat[body].reshape(3, 3), self._data.xpos[body])


@contextmanager
def still_arm(model: mujoco.MjModel) -> Iterator[None]:
    """Makes the arm too heavy to move, whatever its motors do and the vessel weighs."""
    armature = model.dof_armature[:JOINT_COUNT].copy()
    model.dof_armature[:JOINT_COUNT] = _HEAVY_KG_M2
    try:
        yield
    finally:
        model.dof_armature[:JOINT_COUNT] = armature
