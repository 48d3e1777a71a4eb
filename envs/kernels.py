"""Compiled arithmetic of a control step: where the particles are, how the vessel moves, what the agent sees of it.

NumPy's fixed cost a call, some hundred calls a step, took as long as the arm's physics. Imported when an environment
is made, not when the package is.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..extract.geometry import Array

# Where a particle is; `sort_particles` writes these.
FLYING, HELD, POURED, SPILLED = 0, 1, 2, 3
LOOSE = 1e-9


@njit(cache=True)
def vessel_twist(axes: Array, anchors_m: Array, rates_rad_s: Array, point_m: Array, out: Array) -> None:
    """Twist (6,) [m/s, rad/s] of a body at `point_m` that joints with world `axes` (J, 3), `anchors_m` (J, 3) move."""
    out[:] = 0.0
    for j in range(axes.shape[0]):
        wx, wy, wz = rates_rad_s[j] * axes[j, 0], rates_rad_s[j] * axes[j, 1], rates_rad_s[j] * axes[j, 2]
        x, y, z = point_m[0] - anchors_m[j, 0], point_m[1] - anchors_m[j, 1], point_m[2] - anchors_m[j, 2]
        out[0] += wy * z - wz * y
        out[1] += wz * x - wx * z
        out[2] += wx * y - wy * x
        out[3] += wx
        out[4] += wy
        out[5] += wz


@njit(cache=True)
def count_pairs(
    geoms: NDArray[np.int32], kinds: NDArray[np.int64], first: int, second: int, third: int
) -> tuple[int, int]:
    """How many pairs of geoms (C, 2) have kinds that add up to `first`, and how many to `second` or `third`."""
    one, other = 0, 0
    for c in range(geoms.shape[0]):
        pair = kinds[geoms[c, 0]] + kinds[geoms[c, 1]]
        if pair == first:
            one += 1
        elif pair in (second, third):
            other += 1
    return one, other


@njit(cache=True)
def ramp(
    target: Array,
    rate: Array,
    wanted: Array,
    step_most: Array,
    low: Array,
    high: Array,
    hz: float,
    lead: float,
    out: Array,
) -> float:
    """Move joint targets (7,) toward `wanted`, in place, and write the commands (S, 7) that lead there.

    step_most: (7,) how far a joint may go in a period; low, high: (7,) its limits; lead: periods by which a command is
    ahead of the target. `rate` (7,) becomes the target's velocity. Returns the mean square change of the rate over
    twice the greatest.
    """
    jerk = 0.0
    for j in range(target.shape[0]):
        way = min(max(wanted[j] - target[j], -step_most[j]), step_most[j])
        way = min(max(target[j] + way, low[j]), high[j]) - target[j]
        for i in range(out.shape[0]):
            out[i, j] = target[j] + ((i + 1) / out.shape[0] + lead) * way
        change = (way * hz - rate[j]) / (2.0 * step_most[j] * hz)
        jerk += change * change / target.shape[0]
        target[j] += way
        rate[j] = way * hz
    return jerk


@njit(cache=True)
def _inside(x: float, y: float, z: float, levels_m: Array, support_m: Array, normals: Array, axis_xy_m: Array) -> bool:
    """Whether a point in a vessel's frame lies in its hollow (see `vessel_geometry.Cavity`)."""
    last = levels_m.shape[0] - 1
    if z <= levels_m[0] or z > levels_m[last]:
        return False
    i = 0
    while z > levels_m[i + 1]:
        i += 1
    share = (z - levels_m[i]) / (levels_m[i + 1] - levels_m[i])
    x, y = x - axis_xy_m[0], y - axis_xy_m[1]
    for k in range(normals.shape[0]):
        if x * normals[k, 0] + y * normals[k, 1] > support_m[i, k] * (1.0 - share) + support_m[i + 1, k] * share:
            return False
    return True


@njit(cache=True)
def sort_particles(
    points_m: Array,
    vessel: tuple[Array, Array, Array, Array],
    vessel_m: Array,
    vessel_R: Array,
    receptacle: tuple[Array, Array, Array, Array],
    receptacle_m: Array,
    receptacle_R: Array,
    where: NDArray[np.uint8],
    share: Array,
) -> None:
    """Sort particles at `points_m` (N, 3): `where` (N,) gets their places, `share` (3,) held, poured and spilled ones.

    vessel, receptacle: `Cavity.arrays`, at the positions (3,) and attitudes (3, 3) that follow each.
    Held: inside the vessel's hollow. Poured: otherwise, inside the receptacle's. Spilled: in neither and below the
    receptacle's rim, from where nothing finds back. The rest is in flight.
    """
    rim_z = receptacle_m[2] + receptacle_R[2, 2] * receptacle[0][-1]
    rim_z += receptacle_R[2, 0] * receptacle[3][0] + receptacle_R[2, 1] * receptacle[3][1]
    share[:] = 0.0
    for n in range(points_m.shape[0]):
        x, y, z = points_m[n, 0] - vessel_m[0], points_m[n, 1] - vessel_m[1], points_m[n, 2] - vessel_m[2]
        R = vessel_R
        if _inside(
            R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
            R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
            R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
            vessel[0],
            vessel[1],
            vessel[2],
            vessel[3],
        ):
            where[n] = HELD
            share[0] += 1.0
            continue
        x, y, z = points_m[n, 0] - receptacle_m[0], points_m[n, 1] - receptacle_m[1], points_m[n, 2] - receptacle_m[2]
        R = receptacle_R
        if _inside(
            R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
            R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
            R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
            receptacle[0],
            receptacle[1],
            receptacle[2],
            receptacle[3],
        ):
            where[n] = POURED
            share[1] += 1.0
        elif points_m[n, 2] < rim_z:
            where[n] = SPILLED
            share[2] += 1.0
        else:
            where[n] = FLYING
    if points_m.shape[0] > 0:
        share /= points_m.shape[0]


@njit(cache=True)
def _quaternion(R: Array, q: Array) -> None:
    """Unit quaternion wxyz of a rotation matrix, by the largest of its four components (Shepperd 1978)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        q[0], q[1], q[2], q[3] = 0.25 * s, (R[2, 1] - R[1, 2]) / s, (R[0, 2] - R[2, 0]) / s, (R[1, 0] - R[0, 1]) / s
        return
    i = 0
    if R[1, 1] > R[0, 0]:
        i = 1
    if R[2, 2] > R[i, i]:
        i = 2
    j, k = (i + 1) % 3, (i + 2) % 3
    s = 2.0 * math.sqrt(max(1.0 + R[i, i] - R[j, j] - R[k, k], 1e-12))
    q[0] = (R[k, j] - R[j, k]) / s
    q[1 + i] = 0.25 * s
    q[1 + j] = (R[j, i] + R[i, j]) / s
    q[1 + k] = (R[k, i] + R[i, k]) / s


@njit(cache=True)
def turn_vector(R: Array, images: Array, axis: Array, axis_target: Array, continuous: bool, out: Array) -> None:
    """Shortest rotation vector (3,), world axes, that turns R (3, 3) into an attitude that counts as the target.

    images: (K, 4) quaternions wxyz of the attitudes that are equal under a discrete symmetry. continuous: only
    `axis` (3,), fixed in the object, must come to point along `axis_target` (3,) in the world.
    """
    if continuous:
        ax = R[0, 0] * axis[0] + R[0, 1] * axis[1] + R[0, 2] * axis[2]
        ay = R[1, 0] * axis[0] + R[1, 1] * axis[1] + R[1, 2] * axis[2]
        az = R[2, 0] * axis[0] + R[2, 1] * axis[1] + R[2, 2] * axis[2]
        bx, by, bz = axis_target[0], axis_target[1], axis_target[2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        sine = math.sqrt(cx * cx + cy * cy + cz * cz)
        angle = math.atan2(sine, ax * bx + ay * by + az * bz)
        if sine > LOOSE:
            out[0], out[1], out[2] = cx * angle / sine, cy * angle / sine, cz * angle / sine
            return
        out[:] = 0.0
        if angle > 1.0:
            # Opposite: every axis across will do; the one farthest from the object's own is well defined.
            i = 0
            if abs(ay) < abs(ax):
                i = 1
            if abs(az) < min(abs(ax), abs(ay)):
                i = 2
            e0, e1, e2 = (1.0 if i == 0 else 0.0), (1.0 if i == 1 else 0.0), (1.0 if i == 2 else 0.0)
            cx, cy, cz = ay * e2 - az * e1, az * e0 - ax * e2, ax * e1 - ay * e0
            length = math.sqrt(cx * cx + cy * cy + cz * cz)
            out[0], out[1], out[2] = math.pi * cx / length, math.pi * cy / length, math.pi * cz / length
        return
    q = np.empty(4)
    _quaternion(R, q)
    best, at = -1.0, 0
    for k in range(images.shape[0]):
        dot = abs(images[k, 0] * q[0] + images[k, 1] * q[1] + images[k, 2] * q[2] + images[k, 3] * q[3])
        if dot > best:
            best, at = dot, k
    p = images[at]
    # p times the conjugate of q: the turn in world axes.
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = -p[0] * q[1] + p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = -p[0] * q[2] + p[2] * q[0] - p[3] * q[1] + p[1] * q[3]
    z = -p[0] * q[3] + p[3] * q[0] - p[1] * q[2] + p[2] * q[1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < LOOSE else 2.0 * math.atan2(sine, w) / sine
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@njit(cache=True)
def tracking_errors(
    index: int,
    position_m: Array,
    R: Array,
    twist: Array,
    reference_m: Array,
    reference_twist: Array,
    images: Array,
    axis: Array,
    axes: Array,
    continuous: bool,
    out: Array,
) -> None:
    """Errors (4,) at knot `index`: position in m, rotation in rad, linear in m/s and angular velocity in rad/s.

    reference_m (N, 3), reference_twist (N, 6), images (N, K, 4) and axes (N, 3) are the reference's; see
    `turn_vector`. After the last knot the object should stand still.
    """
    turn, total = np.empty(3), 0.0
    for i in range(3):
        total += (position_m[i] - reference_m[index, i]) ** 2
    out[0] = math.sqrt(total)
    turn_vector(R, images[index], axis, axes[index], continuous, turn)
    out[1] = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    moving = 1.0 if index < reference_m.shape[0] - 1 else 0.0
    linear, along = 0.0, 0.0
    for i in range(3):
        linear += (twist[i] - moving * reference_twist[index, i]) ** 2
    out[2] = math.sqrt(linear)
    for i in range(3):
        turn[i] = twist[3 + i] - moving * reference_twist[index, 3 + i]
    if continuous:
        # The turn about a symmetry axis cannot be seen.
        for i in range(3):
            along += turn[i] * (R[i, 0] * axis[0] + R[i, 1] * axis[1] + R[i, 2] * axis[2])
        for i in range(3):
            turn[i] -= along * (R[i, 0] * axis[0] + R[i, 1] * axis[1] + R[i, 2] * axis[2])
    out[3] = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)


@njit(cache=True)
def environment_vector(
    index: int,
    ahead: NDArray[np.int64],
    position_m: Array,
    R: Array,
    twist: Array,
    receptacle_m: Array,
    share: Array,
    reference_m: Array,
    images: Array,
    axis: Array,
    axes: Array,
    continuous: bool,
    reference_R: Array,
    out: NDArray[np.float32],
) -> None:
    """Fill `out` with what `observations.ENVIRONMENT_ENTRIES` names, in that order.

    ahead: (A,) how many knots ahead the reference is looked at; the rest as in `tracking_errors`.
    """
    turn = np.empty(3)
    last = reference_m.shape[0] - 1
    at = 0
    for i in range(3):
        out[at + i], out[at + 3 + i], out[at + 6 + i] = position_m[i], R[i, 0], R[i, 2]
    at += 9
    for i in range(6):
        out[at + i] = twist[i]
    at += 6
    # The object's pose in the frame of the reference's pose now.
    turn_vector(R, images[index], axis, axes[index], continuous, turn)
    for i in range(3):
        offset, back = 0.0, 0.0
        for j in range(3):
            offset += reference_R[index, j, i] * (position_m[j] - reference_m[index, j])
            back -= reference_R[index, j, i] * turn[j]
        out[at + i], out[at + 3 + i] = offset, back
    at += 6
    for a in range(ahead.shape[0]):
        k = min(index + ahead[a], last)
        turn_vector(R, images[k], axis, axes[k], continuous, turn)
        for i in range(3):
            out[at + i], out[at + 3 + i] = reference_m[k, i] - position_m[i], turn[i]
        at += 6
    out[at] = math.atan2(math.hypot(R[0, 2], R[1, 2]), R[2, 2])
    for i in range(3):
        out[at + 1 + i], out[at + 4 + i] = share[i], receptacle_m[i]
    out[at + 7] = index / last
