"""Rigid-body geometry shared by all rooms: poses, symmetry, projection, rotation grids.

`T_a_b` is a (4, 4) matrix, the pose of frame b in frame a. Lengths in m, angles in rad. Camera frames are
OpenCV's: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Symmetry:
    """Rotational symmetry of an object about one axis of its own frame through its origin.

    axis: unit vector in the object frame.
    order: 1 = none, n >= 2 = n-fold, 0 = continuous (a body of revolution).
    """

    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    order: int = 1

    def __post_init__(self) -> None:
        if self.order < 0:
            raise ValueError(f"symmetry order must be 0 (continuous) or positive, got {self.order}")
        if not math.isclose(float(np.linalg.norm(self.axis)), 1.0, abs_tol=1e-6):
            raise ValueError(f"symmetry axis must be a unit vector, got {self.axis}")

    def rotations(self, continuous_samples: int = 72) -> Array:
        """(K, 3, 3) rotations that leave the object unchanged; a continuous symmetry is sampled."""
        count = self.order or continuous_samples
        angles_rad = 2 * np.pi * np.arange(count) / count
        return np.asarray(Rotation.from_rotvec(angles_rad[:, None] * np.asarray(self.axis)).as_matrix())

    def error_rad(self, R_a: Array, R_b: Array) -> Array:
        """Smallest geodesic angle between rotations (..., 3, 3) over the symmetry group, in [0, pi].

        For a continuous symmetry this is the angle between the two axes, exactly.
        """
        R_a, R_b = np.asarray(R_a, float), np.asarray(R_b, float)
        if self.order == 0:
            axis = np.asarray(self.axis)
            return angle_between_rad(R_a @ axis, R_b @ axis)
        errors = [rotation_angle_rad(R_a @ S, R_b) for S in self.rotations()]
        return np.asarray(np.min(errors, axis=0))

    def to_json(self) -> dict[str, Any]:
        return {"axis": list(self.axis), "order": self.order}

    @staticmethod
    def from_json(value: dict[str, Any]) -> Symmetry:
        x, y, z = (float(v) for v in value["axis"])
        return Symmetry((x, y, z), int(value["order"]))


def angle_between_rad(a: Array, b: Array) -> Array:
    """Angle between unit vectors (..., 3), accurate near 0 and pi."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def rotation_angle_rad(R_a: Array, R_b: Array) -> Array:
    """Geodesic angle between rotation matrices (..., 3, 3), in [0, pi].

    From chord length |R_a - R_b|_F = 2 sqrt(2) sin(angle / 2), which keeps its accuracy near zero.
    """
    chord = np.linalg.norm(np.asarray(R_a) - np.asarray(R_b), axis=(-2, -1))
    return np.asarray(2 * np.arcsin(np.clip(chord / (2 * np.sqrt(2)), 0.0, 1.0)))


def make_pose(R: Array | None = None, t: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    """(4, 4) pose from a rotation (identity if None) and a translation in m."""
    T = np.eye(4)
    if R is not None:
        T[:3, :3] = R
    T[:3, 3] = t
    return T


def invert_pose(T: Array) -> Array:
    """Inverse of rigid poses (..., 4, 4)."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = R_t
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", R_t, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T: Array, points: Array) -> Array:
    """Apply a pose (4, 4) to points (N, 3)."""
    return points @ T[:3, :3].T + T[:3, 3]


def project(camera_matrix: Array, points_camera_m: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in the camera frame; points must lie in front of the camera."""
    uvw = points_camera_m @ camera_matrix.T
    return uvw[..., :2] / uvw[..., 2:]


def unproject(camera_matrix: Array, pixels: Array, depth_m: Array) -> Array:
    """Points (N, 3) in the camera frame that are seen in pixels (N, 2) at depths (N,) along the camera's z."""
    rays = np.column_stack([(pixels - camera_matrix[:2, 2]) / np.diag(camera_matrix)[:2], np.ones(len(depth_m))])
    return np.asarray(rays * depth_m[:, None])


def extent(points: Array) -> tuple[Array, Array]:
    """Lowest and highest corner (D,) of the box around points (N, D)."""
    # Column by column, which NumPy is ten times faster at than along the first axis of a narrow array.
    columns = points.T
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def scaled_camera(camera_matrix: Array, scale: float, scale_y: float | None = None) -> Array:
    """(3, 3) intrinsics in px of the same picture made `scale` times as large by averaging or interpolation.

    scale_y: how many times as high, where that differs. Centres of pixels lie at integers (OpenCV), so that a picture
    begins half a pixel before 0 at any size.
    """
    sx, sy = scale, scale if scale_y is None else scale_y
    return np.asarray(np.array([[sx, 0.0, (sx - 1) / 2], [0.0, sy, (sy - 1) / 2], [0.0, 0.0, 1.0]]) @ camera_matrix)


def shows_same_side(T_a: Array, T_b: Array, side_rad: float, size: float) -> bool:
    """Whether an object shows nearly the same side at two poses T_camera_object (4, 4), and as large.

    side_rad: most between the directions from which the camera sees it.  size: most change of distance, as a share.
    """
    a, b = (T[:3, :3].T @ T[:3, 3] for T in (T_a, T_b))
    far_a, far_b = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    return bool(a @ b > np.cos(side_rad) * far_a * far_b and abs(far_a / far_b - 1) < size)


def pose_change(T_from: Array, T_to: Array) -> Array:
    """(6,) change from one pose to another about the object: rotation vector in the camera's axes, then shift in m."""
    turn = Rotation.from_matrix(T_to[:3, :3] @ T_from[:3, :3].T).as_rotvec()
    return np.concatenate([turn, T_to[:3, 3] - T_from[:3, 3]])


def projected_box(
    camera_matrix: Array, T_camera_object: Array, points_m: Array
) -> tuple[float, float, float, float] | None:
    """Box x, y, width, height in px around points (N, 3) of an object; None when one is not before the camera."""
    points = transform_points(T_camera_object, points_m)
    if points[:, 2].min() < 1e-3:
        return None
    low, high = extent(project(camera_matrix, points))
    (x, y), (width, height) = low, high - low
    return float(x), float(y), float(width), float(height)


def look_at(eye_m: Array, target_m: Array, up: Array) -> Array:
    """T_world_camera (OpenCV axes) of a camera at `eye_m` that looks at `target_m` with `up` upward in the image."""
    z = np.asarray(target_m, float) - eye_m
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), np.asarray(eye_m, float))


def super_fibonacci_rotations(count: int) -> Array:
    """(count, 3, 3) rotations spread evenly over SO(3) (Alexa, Super-Fibonacci Spirals, CVPR 2022)."""
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    xyzw = np.stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], axis=1)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def focal_prior_camera_matrix(width_px: int, height_px: int) -> Array:
    """Camera matrix for an unknown camera: f = sqrt(w^2 + h^2), centred (FreePose, appendix A.4)."""
    f = math.hypot(width_px, height_px)
    return np.array([[f, 0.0, width_px / 2], [0.0, f, height_px / 2], [0.0, 0.0, 1.0]])
