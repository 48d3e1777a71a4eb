"""Smoothing of pose sequences without lag: weighted local quadratic regression on SE(3)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .geometry import Array


def smooth_poses(T: Array, time_s: Array, weight: Array, bandwidth_s: float) -> Array:
    """(N, 4, 4) poses, each replaced by the value at its own time of a local quadratic through its neighbours.

    The neighbours within 3 bandwidths are weighted by `weight` (N,) in [0, 1] and a Gaussian of `bandwidth_s`;
    rotations are regressed as rotation vectors relative to the pose in the middle. A quadratic keeps constant
    velocities and accelerations, so that quick motions are neither delayed nor flattened.
    """
    out = np.array(T, float)
    if bandwidth_s <= 0 or len(T) < 4:
        return out
    rotations = Rotation.from_matrix(out[:, :3, :3])
    for i, t in enumerate(time_s):
        near = np.flatnonzero(np.abs(time_s - t) <= 3 * bandwidth_s)
        if len(near) < 4:
            continue
        dt = (time_s[near] - t) / bandwidth_s
        w = np.sqrt(np.exp(-0.5 * dt**2) * np.maximum(weight[near], 1e-3))
        basis = np.stack([np.ones_like(dt), dt, dt**2], axis=1)
        turns = (rotations[i].inv() * rotations[near]).as_rotvec()
        values = np.concatenate([turns, T[near, :3, 3]], axis=1)
        fit = np.linalg.lstsq(basis * w[:, None], values * w[:, None], rcond=None)[0][0]
        out[i, :3, :3] = (rotations[i] * Rotation.from_rotvec(fit[:3])).as_matrix()
        out[i, :3, 3] = fit[3:]
    return out
