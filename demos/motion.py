"""The motion between the knots: one curve whose speed, acceleration and jerk exist everywhere, at rest at both ends."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from ..extract.geometry import Array


class JointCurve:
    """The quintic spline through q (N, 7) at times (N,), without speed and acceleration at its ends.

    Its jerk is continuous too, which a controller at 1 kHz asks for and knots at 25 Hz alone do not tell.
    """

    def __init__(self, time_s: Array, q_rad: Array) -> None:
        still = [(1, np.zeros(q_rad.shape[1])), (2, np.zeros(q_rad.shape[1]))]
        self._spline = make_interp_spline(time_s, q_rad, k=5, bc_type=(still, still))
        self.start_s, self.end_s = float(time_s[0]), float(time_s[-1])

    def at(self, time_s: Array, order: int = 0) -> Array:
        """(M, 7) position in rad at times (M,), or its derivative of an order: 1 speed, 2 acceleration, 3 jerk.

        Before and after the motion the arm stands where it begins and ends.
        """
        value = np.asarray(self._spline(np.clip(time_s, self.start_s, self.end_s), nu=order), np.float64)
        if order > 0:
            value[(time_s < self.start_s) | (time_s > self.end_s)] = 0.0
        return value

    def clock(self, rate_hz: float) -> Array:
        """(M,) times in steps of 1 / rate_hz from the start to the end, or the first step after it."""
        steps = int(np.ceil((self.end_s - self.start_s) * rate_hz - 1e-6))
        return np.asarray(self.start_s + np.arange(steps + 1) / rate_hz)
