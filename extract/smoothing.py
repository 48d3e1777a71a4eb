"""Smoothing of pose sequences without lag: weighted local quadratic regression on SE(3), as wide as the noise asks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array

WIDEST_S = 0.5
MOST_ASKED = 400  # frames, spread over the clip, that choose the bandwidth
AT_ONCE = 256  # frames, so that memory does not grow with the clip
STEPS = 9  # bandwidths tried, evenly spaced in their logarithm


def smooth_poses(T: Array, time_s: Array, weight: Array, bandwidth_s: float | None = None) -> Array:
    """(N, 4, 4) poses, each replaced by the value at its own time of a local quadratic through its neighbours.

    The neighbours within 3 bandwidths are weighted by `weight` (N,) in [0, 1] and a Gaussian of `bandwidth_s`;
    rotations are regressed as rotation vectors relative to the pose in the middle. A quadratic keeps constant
    velocities and accelerations, so that quick motions are neither delayed nor flattened. Without a bandwidth the
    one is taken that `best_bandwidth_s` reads from the poses, of turns and of places each its own.
    """
    T = np.array(T, float)
    if bandwidth_s is not None:
        return _smoothed(T, time_s, weight, bandwidth_s)
    turn_s, place_s = best_bandwidth_s(T, time_s, weight)
    out = _smoothed(T, time_s, weight, turn_s)
    out[:, :3, 3] = _smoothed(T, time_s, weight, place_s)[:, :3, 3]
    return out


def best_bandwidth_s(T: Array, time_s: Array, weight: Array) -> tuple[float, float]:
    """Bandwidths in s, of rotations and of translations, from which every pose is foretold best by the others.

    Leave-one-out cross-validation: noise asks for wide windows, quick motion for narrow ones. Tried from one frame's
    distance to half a second. Errors are summed robustly: a few frames where the object was lost do not decide.
    """
    if len(T) < 8:
        return 0.0, 0.0
    narrow = float(np.median(np.diff(time_s)))
    tried: Array = np.asarray(np.geomspace(narrow, max(WIDEST_S, narrow), STEPS), float)
    seen = np.flatnonzero(weight > 0.0) if np.any(weight > 0.0) else np.arange(len(T))
    asked = np.unique(seen[np.linspace(0, len(seen) - 1, min(MOST_ASKED, len(seen))).round().astype(int)])
    left_out = [_smoothed(T, time_s, weight, float(b), asked, leave_out=True) for b in tried]
    Rs = Rotation.from_matrix(T[asked, :3, :3]).inv()
    turn = [(Rs * Rotation.from_matrix(L[:, :3, :3])).magnitude() for L in left_out]
    place: list[Array] = [np.linalg.norm(L[:, :3, 3] - T[asked, :3, 3], axis=1) for L in left_out]
    return _cheapest(tried, turn), _cheapest(tried, place)


def _cheapest(tried: Array, errors: list[Array]) -> float:
    """The bandwidth of the least trimmed mean square error; next to none where nothing moves and nothing is noisy."""
    cut = float(np.quantile(np.stack(errors).min(axis=0), 0.95))
    scores = [float(np.mean(np.minimum(e, 3 * cut) ** 2)) for e in errors]
    return float(tried[int(np.argmin(scores))])


def _smoothed(
    T: Array,
    time_s: Array,
    weight: Array,
    bandwidth_s: float,
    asked: NDArray[np.int64] | None = None,
    leave_out: bool = False,
) -> Array:
    """The poses of the frames `asked` (all when None), each from its neighbours, and from itself if not left out."""
    asked = np.arange(len(T)) if asked is None else asked
    out = T[asked]
    if bandwidth_s <= 0 or len(T) < 4:
        return out
    fits = np.concatenate([np.zeros((len(asked), 3)), out[:, :3, 3]], axis=1)
    rotations = Rotation.from_matrix(T[:, :3, :3])
    reach = 3 * bandwidth_s
    first = np.searchsorted(time_s, time_s[asked] - reach)
    last = np.searchsorted(time_s, time_s[asked] + reach, "right")
    for begin in range(0, len(asked), AT_ONCE):
        window = np.s_[begin : begin + AT_ONCE]
        # Two neighbours on each side at least, whatever the bandwidth.
        near = [
            np.arange(max(0, min(a, i - 2)), min(len(T), max(b, i + 3)))
            for i, a, b in zip(asked[window], first[window], last[window], strict=True)
        ]
        if leave_out:
            near = [n[n != i] for i, n in zip(asked[window], near, strict=True)]
        ends = np.cumsum([len(n) for n in near])
        middle, beside = np.repeat(asked[window], np.diff(ends, prepend=0)), np.concatenate(near)
        dt = (time_s[beside] - time_s[middle]) / bandwidth_s
        w = np.sqrt(np.exp(-0.5 * dt**2) * np.maximum(weight[beside], 1e-3))[:, None]
        turns = (rotations[middle].inv() * rotations[beside]).as_rotvec()
        values = w * np.concatenate([turns, T[beside, :3, 3]], axis=1)
        basis = w * np.stack([np.ones_like(dt), dt, dt**2], axis=1)
        for slot, (a, b) in enumerate(zip(ends - np.diff(ends, prepend=0), ends, strict=True), begin):
            if b - a >= 4:
                fits[slot] = np.linalg.lstsq(basis[a:b], values[a:b], rcond=None)[0][0]
    out[:, :3, :3] = (rotations[asked] * Rotation.from_rotvec(fits[:, :3])).as_matrix()
    out[:, :3, 3] = fits[:, 3:]
    return out
