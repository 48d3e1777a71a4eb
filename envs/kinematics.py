"""Kinematics of the Panda for many configurations at once: forward, Jacobian, damped least-squares inverse.

The chain is read from the compiled model, so that it can never differ from what the simulator moves. Batches cost
little more than single configurations, which is what makes a search over placements and grasps affordable.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose, make_pose
from .panda import ARM_JOINTS, Q_HOME_RAD, Q_MAX_RAD, Q_MIN_RAD, panda_spec

HAND_BODY = "panda_hand_tcp"
JOINT_COUNT = 7


@dataclass(frozen=True)
class Chain:
    """Serial chain of the arm. Joint i turns about z of a frame fixed at `T_parent_joint[i]` in the frame before it.

    T_parent_joint: (7, 4, 4); T_joint_hand: (4, 4) from the last joint to `panda_hand_tcp`.
    """

    T_parent_joint: Array
    T_joint_hand: Array

    def frames(self, q_rad: Array) -> Array:
        """(M, 8, 4, 4) poses in the world of the seven joint frames (turned) and of the hand, for q (M, 7)."""
        q_rad = np.atleast_2d(q_rad)
        cos, sin = np.cos(q_rad), np.sin(q_rad)
        out = np.empty((len(q_rad), JOINT_COUNT + 1, 4, 4))
        T = np.broadcast_to(np.eye(4), (len(q_rad), 4, 4))
        for i in range(JOINT_COUNT):
            fixed = T @ self.T_parent_joint[i]
            c, s = cos[:, i, None], sin[:, i, None]
            out[:, i] = fixed
            # Turning about z mixes the first two columns only.
            out[:, i, :, 0] = c * fixed[:, :, 0] + s * fixed[:, :, 1]
            out[:, i, :, 1] = c * fixed[:, :, 1] - s * fixed[:, :, 0]
            T = out[:, i]
        out[:, JOINT_COUNT] = T @ self.T_joint_hand
        return out

    def hand(self, q_rad: Array) -> Array:
        """(M, 4, 4) poses of the hand."""
        return np.asarray(self.frames(q_rad)[:, JOINT_COUNT])


@cache
def panda_chain() -> Chain:
    """The Panda's arm, from the compiled model."""
    model = panda_spec(visuals=False).compile()
    joints = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in ARM_JOINTS]
    bodies = [int(model.jnt_bodyid[j]) for j in joints]
    for j in joints:
        if not np.allclose(model.jnt_axis[j], [0, 0, 1]) or np.any(model.jnt_pos[j]):
            raise RuntimeError("the Panda's joints are expected to turn about z of their own frames")
    hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, HAND_BODY)

    def between(ancestor: int, body: int) -> Array:
        T = np.eye(4)
        while body != ancestor:
            w, x, y, z = model.body_quat[body]
            T = make_pose(Rotation.from_quat([x, y, z, w]).as_matrix(), model.body_pos[body]) @ T
            body = int(model.body_parentid[body])
        return T

    parents = [0, *bodies[:-1]]
    return Chain(np.stack([between(a, b) for a, b in zip(parents, bodies, strict=True)]), between(bodies[-1], hand))


def hand_jacobian(frames: Array) -> Array:
    """(M, 6, 7) Jacobian of the hand, linear then angular, world axes, from `Chain.frames`."""
    axes = frames[:, :JOINT_COUNT, :3, 2]
    arms = frames[:, JOINT_COUNT, None, :3, 3] - frames[:, :JOINT_COUNT, :3, 3]
    return np.asarray(np.concatenate([np.cross(axes, arms), axes], axis=2).swapaxes(1, 2))


def pose_error(T: Array, T_target: Array) -> Array:
    """(M, 6) world-frame step from poses (M, 4, 4) to targets: translation in m, rotation vector in rad."""
    R = T_target[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2)
    # The rotation vector by hand: SciPy's quaternion detour costs as much as the rest of an iteration.
    axis = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    # Near a half turn `axis` vanishes; its direction is lost, which only slows such a hopeless start down.
    rotation = axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None]
    return np.concatenate([T_target[:, :3, 3] - T[:, :3, 3], rotation], axis=1)


def solve_ik(
    T_world_hand: Array,
    q_init_rad: Array,
    *,
    iterations: int,
    q_rest_rad: Array | None = None,
    rest_gain: float = 0.05,
    damping: float = 0.02,
    margin_rad: float = 0.02,
    until: float = 0.0,
) -> tuple[Array, Array]:
    """Damped least squares from q (M, 7) to hand poses (M, 4, 4), inside the joint limits less `margin_rad`.

    The redundancy is spent on drawing near `q_rest_rad` ((7,) or (M, 7); the initial q if None).
    It ends early when no error, in m or rad, is above `until`. Returns q (M, 7) and the errors left (M, 6) [m, rad].
    """
    chain = panda_chain()
    q = np.clip(q_init_rad, Q_MIN_RAD + margin_rad, Q_MAX_RAD - margin_rad)
    rest = q if q_rest_rad is None else np.broadcast_to(q_rest_rad, q.shape)
    regular = damping**2 * np.eye(6)
    for _ in range(iterations):
        frames = chain.frames(q)
        error = pose_error(frames[:, JOINT_COUNT], T_world_hand)
        if np.abs(error).max() <= until:
            return q, error
        J = hand_jacobian(frames)
        Jt = J.swapaxes(1, 2)
        pull = rest_gain * (rest - q)
        # J^+ (e - J pull) + pull: the task first, the pull in what remains.
        residual = error - np.einsum("mij,mj->mi", J, pull)
        step = np.einsum("mij,mj->mi", Jt, np.linalg.solve(J @ Jt + regular, residual[..., None])[..., 0]) + pull
        size = np.abs(step).max(axis=1, keepdims=True)
        q = np.clip(
            q + step * np.minimum(1.0, 0.4 / np.maximum(size, 1e-9)), Q_MIN_RAD + margin_rad, Q_MAX_RAD - margin_rad
        )
    return q, pose_error(chain.hand(q), T_world_hand)


def manipulability(q_rad: Array) -> Array:
    """(M,) Yoshikawa's measure sqrt(det(J J^T)) [m^3 rad^3 in mixed units]; 0 in a singular configuration."""
    J = hand_jacobian(panda_chain().frames(q_rad))
    return np.asarray(np.sqrt(np.maximum(np.linalg.det(J @ J.swapaxes(1, 2)), 0.0)))


def limit_margin_rad(q_rad: Array) -> Array:
    """(..., 7) distance of each joint to its nearer limit; negative outside."""
    return np.minimum(q_rad - Q_MIN_RAD, Q_MAX_RAD - q_rad)


def arm_seeds(T_world_hand: Array) -> Array:
    """(S, M, 7) starts for IK toward hand poses (M, 4, 4): turned toward the target, elbow and wrist varied."""
    azimuth_rad = np.arctan2(T_world_hand[:, 1, 3], T_world_hand[:, 0, 3])
    base = np.tile(Q_HOME_RAD, (len(T_world_hand), 1))
    base[:, 0] = azimuth_rad
    variants = []
    for elbow_rad, wrist_rad in ((0.0, 0.0), (0.9, -0.9), (-0.9, 0.9), (0.0, -1.6), (0.0, 1.6)):
        q = base.copy()
        q[:, 2] += elbow_rad
        q[:, 0] -= 0.6 * elbow_rad
        q[:, 6] += wrist_rad
        variants.append(np.clip(q, Q_MIN_RAD + 0.05, Q_MAX_RAD - 0.05))
    return np.stack(variants)


def configuration_near(T_world_object: Array, T_hand_object: Array, q_near_rad: Array) -> Array:
    """(7,) configuration that holds the object at `T_world_object`, close to `q_near_rad`.

    Raises UserError when the pose cannot be held within 1 mm and 0.5 degrees.
    """
    T_hand = (T_world_object @ invert_pose(T_hand_object))[None]
    q, error = solve_ik(
        T_hand,
        np.asarray(q_near_rad, float)[None],
        iterations=60,
        rest_gain=0.0,
        damping=0.005,
        margin_rad=0.0,
        until=1e-9,
    )
    off_m, off_rad = float(np.linalg.norm(error[0, :3])), float(np.linalg.norm(error[0, 3:]))
    if off_m > 1e-3 or off_rad > np.deg2rad(0.5):
        x, y, z = T_world_object[:3, 3]
        raise UserError(
            f"the start pose at ({x:.2f}, {y:.2f}, {z:.2f}) m is out of the arm's reach by {1000 * off_m:.0f} mm and "
            f"{np.rad2deg(off_rad):.1f} degrees; choose a smaller start offset"
        )
    return np.asarray(q[0])
