"""Compiled loops of `FastLiquid`: neighbours, contacts with moving walls, and the projection of both.

Shapes are rows of 16 numbers: centre (3), rotation (9, row by row), half extents (3), 1 for a cylinder about z. They
come in groups that move as one: the held vessel, the receptacle, what stands still. Every loop runs in a fixed order
and nothing is summed in parallel, so equal input gives equal bits.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..extract.geometry import Array

Ints = NDArray[np.int32]
# Shapes, groups, grids, starts, items, as `fast_liquid` makes them; whom and what a contact touches, and its plane.
Walls = tuple[Array, Ints, Array, Ints, Ints]
Contacts = tuple[Ints, Array]
compiled = njit(cache=True, error_model="numpy")

GRAVITY_M_S2 = 9.81
# Pairs that will be nearer than so many radii in the middle of a step are watched through it: faster ones are noticed
# when they overlap a little.
PAIR_REACH_RADII = 2.5
# Contacts are kept ready for what neighbours may push into a wall within a step.
SLACK_RADII = 0.1
# A sphere counts as arrived when it is so near to a wall; and so many strides are made on the way to it.
ARRIVED_RADII, MAX_STRIDES = 0.02, 8
# Overlaps are undone no faster than this, or the particles would be shot apart.
PAIR_RECOVERY_M_S, WALL_RECOVERY_M_S = 0.1, 0.2
# Part of an overlap that one sweep undoes: the engine's contacts give way as much, and a jet leaves a lip as fast.
PAIR_STIFFNESS = 0.7
MAX_PAIRS, MAX_CONTACTS = 24, 12  # each particle
CONTACT_WIDTH = 11


@compiled
def nearest(shapes: Array, k: int, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Signed distance of a point from shape `k`'s surface and the unit vector (3 numbers) that leads away from it."""
    dx, dy, dz = x - shapes[k, 0], y - shapes[k, 1], z - shapes[k, 2]
    a = shapes[k, 3] * dx + shapes[k, 6] * dy + shapes[k, 9] * dz
    b = shapes[k, 4] * dx + shapes[k, 7] * dy + shapes[k, 10] * dz
    c = shapes[k, 5] * dx + shapes[k, 8] * dy + shapes[k, 11] * dz
    beyond_c = abs(c) - shapes[k, 14]
    if shapes[k, 15] > 0.0:
        rho = max(math.sqrt(a * a + b * b), 1e-12)
        beyond = rho - shapes[k, 12]
        if beyond <= 0.0 and beyond_c <= 0.0:
            across, up = (1.0, 0.0) if beyond > beyond_c else (0.0, 1.0)
            distance = max(beyond, beyond_c)
        else:
            across, up = max(beyond, 0.0), max(beyond_c, 0.0)
            distance = math.sqrt(across * across + up * up)
            across, up = across / distance, up / distance
        a, b, c = across * a / rho, across * b / rho, math.copysign(up, c)
    else:
        beyond_a, beyond_b = abs(a) - shapes[k, 12], abs(b) - shapes[k, 13]
        distance = max(beyond_a, beyond_b, beyond_c)
        if distance <= 0.0:
            a = math.copysign(1.0, a) if beyond_a == distance else 0.0
            b = math.copysign(1.0, b) if a == 0.0 and beyond_b == distance else 0.0
            c = math.copysign(1.0, c) if a == 0.0 and b == 0.0 else 0.0
        else:
            a = math.copysign(max(beyond_a, 0.0), a)
            b = math.copysign(max(beyond_b, 0.0), b)
            c = math.copysign(max(beyond_c, 0.0), c)
            distance = math.sqrt(a * a + b * b + c * c)
            a, b, c = a / distance, b / distance, c / distance
    return (
        distance,
        shapes[k, 3] * a + shapes[k, 4] * b + shapes[k, 5] * c,
        shapes[k, 6] * a + shapes[k, 7] * b + shapes[k, 8] * c,
        shapes[k, 9] * a + shapes[k, 10] * b + shapes[k, 11] * c,
    )


@compiled
def within(shapes: Array, k: int, x: float, y: float, z: float, reach_m: float) -> bool:
    """Whether a point may lie within `reach_m` of shape `k`: cheaper than `nearest`, generous at edges and corners."""
    dx, dy, dz = x - shapes[k, 0], y - shapes[k, 1], z - shapes[k, 2]
    if abs(shapes[k, 5] * dx + shapes[k, 8] * dy + shapes[k, 11] * dz) > shapes[k, 14] + reach_m:
        return False
    if abs(shapes[k, 3] * dx + shapes[k, 6] * dy + shapes[k, 9] * dz) > shapes[k, 12] + reach_m:
        return False
    second = shapes[k, 12] if shapes[k, 15] > 0.0 else shapes[k, 13]
    return bool(abs(shapes[k, 4] * dx + shapes[k, 7] * dy + shapes[k, 10] * dz) <= second + reach_m)


@compiled
def find_pairs(x: Array, radius_m: float, pairs: Ints, cells: Ints, starts: Ints, order: Ints) -> int:
    """Fill `pairs` (M, 2) with all particles near each other, by a hashed grid (Teschner et al. 2003); their number.

    cells: (N, 4) room for cell and bucket; starts: (B + 1,), B a power of two; order: (N,).
    """
    reach = PAIR_REACH_RADII * radius_m
    mask = len(starts) - 2
    starts[:] = 0
    for i in range(len(x)):
        for axis in range(3):
            cells[i, axis] = math.floor(x[i, axis] / reach)
        cells[i, 3] = _bucket(cells[i, 0], cells[i, 1], cells[i, 2], mask)
        starts[cells[i, 3] + 1] += 1
    for bucket in range(len(starts) - 1):
        starts[bucket + 1] += starts[bucket]
    for i in range(len(x) - 1, -1, -1):
        # Counting down turns the ends into starts again, one bucket on.
        starts[cells[i, 3] + 1] -= 1
        order[starts[cells[i, 3] + 1]] = i
    found = 0
    for i in range(len(x)):
        # This cell and half of its neighbours: the other half looks here.
        for dx in range(2):
            for dy in range(-dx, 2):
                for dz in range(-1 if dx or dy > 0 else 0, 2):
                    a, b, c = cells[i, 0] + dx, cells[i, 1] + dy, cells[i, 2] + dz
                    bucket = _bucket(a, b, c, mask)
                    end = starts[bucket + 2] if bucket + 2 < len(starts) else len(x)
                    here = dx == 0 and dy == 0 and dz == 0
                    for place in range(starts[bucket + 1], end):
                        j = order[place]
                        if cells[j, 0] != a or cells[j, 1] != b or cells[j, 2] != c or (here and j <= i):
                            continue
                        u, v, w = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
                        if u * u + v * v + w * w < reach * reach and found < len(pairs):
                            pairs[found, 0], pairs[found, 1] = i, j
                            found += 1
    return found


@compiled
def _bucket(a: int, b: int, c: int, mask: int) -> int:
    return ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & mask


@compiled
def find_contacts(
    first: Array,
    goal: Array,
    chosen: Ints,
    chosen_count: int,
    radius_m: float,
    walls: Walls,
    poses: Array,
    out: Contacts,
) -> int:
    """Planes that hold the chosen particles back from the walls on their ways from `first` to `goal`; their number.

    Each way is followed in the frame of each group, where the walls stand still, up to the first shape that it runs
    into (conservative advancement), so nothing is jumped over. Every shape that the rest of the way might reach from
    there gives a contact: the plane through its nearest point. A row of it: the plane's normal and offset before the
    step and their change, and the way of its foot, in the world.
    """
    shapes, groups, lows, starts, items = walls
    which, contacts = out
    found, room = 0, len(which)
    slack, arrived = SLACK_RADII * radius_m, ARRIVED_RADII * radius_m
    for g in range(len(groups)):
        before, after = poses[g, 0], poses[g, 1]
        cell_m, reach_m = lows[g, 3], lows[g, 4]
        for n in range(chosen_count):
            i = chosen[n]
            ax, ay, az = _inside(before, first[i, 0], first[i, 1], first[i, 2])
            bx, by, bz = _inside(after, goal[i, 0], goal[i, 1], goal[i, 2])
            bx, by, bz = bx - ax, by - ay, bz - az
            way = math.sqrt(bx * bx + by * by + bz * bz)
            low, high = groups[g, 0], groups[g, 1]
            # Looked up in the middle of the way, from where half of it reaches everything.
            listed = 0.5 * way < reach_m - slack
            if listed:
                cx = math.floor((ax + 0.5 * bx - lows[g, 0]) / cell_m)
                cy = math.floor((ay + 0.5 * by - lows[g, 1]) / cell_m)
                cz = math.floor((az + 0.5 * bz - lows[g, 2]) / cell_m)
                if not (0 <= cx < groups[g, 3] and 0 <= cy < groups[g, 4] and 0 <= cz < groups[g, 5]):
                    continue
                cell = groups[g, 2] + (cx * groups[g, 4] + cy) * groups[g, 5] + cz
                low, high = starts[cell], starts[cell + 1]
            # Ways shorter than the slack need no following: all that they could reach is looked at from their start.
            end = 1.0 if way > slack else 0.0
            for place in range(low, high if end > 0.0 else low):
                k = items[place] if listed else place
                if not within(shapes, k, ax, ay, az, radius_m + way + arrived):
                    continue
                t = 0.0
                for _ in range(MAX_STRIDES):
                    distance, nx, ny, nz = nearest(shapes, k, ax + t * bx, ay + t * by, az + t * bz)
                    gap = distance - radius_m
                    if gap <= arrived or t >= end:
                        break
                    t += gap / way
                if t < end and nx * bx + ny * by + nz * bz < 0.0:
                    end = t
                    if t == 0.0:
                        break
            rest = (1.0 - end) * way + slack
            ax, ay, az = ax + end * bx, ay + end * by, az + end * bz
            for place in range(low, high):
                k = items[place] if listed else place
                if not within(shapes, k, ax, ay, az, radius_m + rest):
                    continue
                distance, nx, ny, nz = nearest(shapes, k, ax, ay, az)
                if distance - radius_m > rest or found == room:
                    continue
                px, py, pz = ax - distance * nx, ay - distance * ny, az - distance * nz
                ux, uy, uz = _turned(before, nx, ny, nz)
                wx, wy, wz = _turned(after, nx, ny, nz)
                fx, fy, fz = _outside(before, px, py, pz)
                hx, hy, hz = _outside(after, px, py, pz)
                offset = ux * fx + uy * fy + uz * fz + radius_m
                which[found, 0], which[found, 1] = i, g
                row = contacts[found]
                row[0], row[1], row[2], row[3] = ux, uy, uz, offset
                row[4], row[5], row[6] = wx - ux, wy - uy, wz - uz
                row[7] = wx * hx + wy * hy + wz * hz + radius_m - offset
                row[8], row[9], row[10] = hx - fx, hy - fy, hz - fz
                found += 1
    return found


@compiled
def _inside(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    x, y, z = x - T[0, 3], y - T[1, 3], z - T[2, 3]
    return (
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )


@compiled
def _turned(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@compiled
def _outside(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    x, y, z = _turned(T, x, y, z)
    return x + T[0, 3], y + T[1, 3], z + T[2, 3]


@compiled
def project_pairs(x: Array, last: Array, pairs: Ints, count: int, radius_m: float, friction: float, h: float) -> None:
    """Push overlapping particles apart, half each (PBD, Müller et al. 2007, eq. 10)."""
    touch = 2.0 * radius_m
    for p in range(count):
        i, j = pairs[p, 0], pairs[p, 1]
        dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        square = dx * dx + dy * dy + dz * dz
        if square >= touch * touch:
            continue
        distance = math.sqrt(square)
        if distance < 1e-9:
            dx, dy, dz, distance = 0.0, 0.0, 1e-9, 1e-9
        ox, oy, oz = last[i, 0] - last[j, 0], last[i, 1] - last[j, 1], last[i, 2] - last[j, 2]
        old = touch - math.sqrt(ox * ox + oy * oy + oz * oz)
        depth = PAIR_STIFFNESS * (touch - distance - max(0.0, old - PAIR_RECOVERY_M_S * h))
        if depth <= 0.0:
            continue
        nx, ny, nz = dx / distance, dy / distance, dz / distance
        mx, my, mz = 0.5 * depth * nx, 0.5 * depth * ny, 0.5 * depth * nz
        if friction > 0.0:
            fx, fy, fz = _friction(dx - ox, dy - oy, dz - oz, nx, ny, nz, friction * depth)
            mx, my, mz = mx + 0.5 * fx, my + 0.5 * fy, mz + 0.5 * fz
        x[i, 0] += mx
        x[i, 1] += my
        x[i, 2] += mz
        x[j, 0] -= mx
        x[j, 1] -= my
        x[j, 2] -= mz


@compiled
def _friction(
    dx: float, dy: float, dz: float, nx: float, ny: float, nz: float, most: float
) -> tuple[float, float, float]:
    """What takes back the part of a relative way (dx, dy, dz) across the normal, at most `most` long (Coulomb)."""
    normal = dx * nx + dy * ny + dz * nz
    dx, dy, dz = dx - normal * nx, dy - normal * ny, dz - normal * nz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    part = 1.0 if length <= most else most / length
    return -part * dx, -part * dy, -part * dz


@compiled
def project_contacts(
    x: Array,
    last: Array,
    out: Contacts,
    count: int,
    share: float,
    step: float,
    friction: float,
    h: float,
    origin: Array,
    moved: Array,
) -> None:
    """Push particles out of walls as they stand when `share` of the step has passed, `step` more than last time.

    Adds what group 0 gave them to `moved` (6,): the sum of their ways and of its moment about `origin`.
    """
    which, contacts = out
    for k in range(count):
        i, c = which[k, 0], contacts[k]
        nx, ny, nz = c[0] + share * c[4], c[1] + share * c[5], c[2] + share * c[6]
        depth = c[3] + share * c[7] - (nx * x[i, 0] + ny * x[i, 1] + nz * x[i, 2])
        if depth <= 0.0:
            continue
        ago = share - step
        old = c[3] + ago * c[7]
        old -= (c[0] + ago * c[4]) * last[i, 0] + (c[1] + ago * c[5]) * last[i, 1] + (c[2] + ago * c[6]) * last[i, 2]
        depth -= max(0.0, old - WALL_RECOVERY_M_S * h)
        if depth <= 0.0:
            continue
        mx, my, mz = depth * nx, depth * ny, depth * nz
        if friction > 0.0:
            fx, fy, fz = _friction(
                x[i, 0] - last[i, 0] - step * c[8],
                x[i, 1] - last[i, 1] - step * c[9],
                x[i, 2] - last[i, 2] - step * c[10],
                nx,
                ny,
                nz,
                friction * depth,
            )
            mx, my, mz = mx + fx, my + fy, mz + fz
        x[i, 0] += mx
        x[i, 1] += my
        x[i, 2] += mz
        if which[k, 1] == 0:
            _felt(x, i, origin, mx, my, mz, moved)


@compiled
def catch(
    x: Array, v: Array, out: Contacts, count: int, timestep_s: float, h: float, origin: Array, moved: Array
) -> None:
    """At the end of a step, put particles back in front of walls and take from them the speed into the wall."""
    which, contacts = out
    for _ in range(2):
        for k in range(count):
            i, c = which[k, 0], contacts[k]
            nx, ny, nz = c[0] + c[4], c[1] + c[5], c[2] + c[6]
            depth = c[3] + c[7] - (nx * x[i, 0] + ny * x[i, 1] + nz * x[i, 2])
            if depth <= 0.0:
                continue
            x[i, 0] += depth * nx
            x[i, 1] += depth * ny
            x[i, 2] += depth * nz
            into = (nx * c[8] + ny * c[9] + nz * c[10]) / timestep_s - (nx * v[i, 0] + ny * v[i, 1] + nz * v[i, 2])
            if into <= 0.0:
                continue
            v[i, 0] += into * nx
            v[i, 1] += into * ny
            v[i, 2] += into * nz
            if which[k, 1] == 0:
                _felt(x, i, origin, h * into * nx, h * into * ny, h * into * nz, moved)


@compiled
def _felt(x: Array, i: int, origin: Array, mx: float, my: float, mz: float, moved: Array) -> None:
    """Add a way (3 numbers) that a wall gave particle i, and its moment about `origin`, to `moved` (6,)."""
    ax, ay, az = x[i, 0] - origin[0], x[i, 1] - origin[1], x[i, 2] - origin[2]
    moved[0] += mx
    moved[1] += my
    moved[2] += mz
    moved[3] += ay * mz - az * my
    moved[4] += az * mx - ax * mz
    moved[5] += ax * my - ay * mx


@compiled
def advance(
    x: Array,
    v: Array,
    room: tuple[Array, Array, Array, Ints],
    poses: Array,
    walls: Walls,
    pairs: Ints,
    grid: tuple[Ints, Ints, Ints],
    out: Contacts,
    wrench: Array,
    numbers: tuple[float, float, float, float, float, float, int],
) -> None:
    """One step in small substeps, each with one sweep over all constraints (Macklin et al. 2019).

    numbers: radius, time step, mass, friction, drag, part of a new push that `wrench` takes on, substeps.
    """
    radius_m, timestep_s, mass_kg, friction, drag_1_s, taken, substeps = numbers
    first, goal, last, chosen = room
    fall = 0.5 * GRAVITY_M_S2 * timestep_s * timestep_s
    for i in range(len(x)):
        chosen[i] = i
        for axis in range(3):
            first[i, axis] = x[i, axis]
            last[i, axis] = x[i, axis] + 0.5 * timestep_s * v[i, axis]
            goal[i, axis] = x[i, axis] + timestep_s * v[i, axis]
        goal[i, 2] -= fall
    pair_count = find_pairs(last, radius_m, pairs, grid[0], grid[1], grid[2])
    count = find_contacts(first, goal, chosen, len(x), radius_m, walls, poses, out)
    h = timestep_s / substeps
    kept = 1.0 / (1.0 + drag_1_s * h)
    moved = np.zeros(6)
    origin = poses[0, 1, :3, 3]
    # All coordinates in one row, which compiles to faster loops.
    x_row, v_row, last_row = x.reshape(-1), v.reshape(-1), last.reshape(-1)
    rate_hz = 1.0 / h
    for s in range(substeps):
        for i in range(len(x)):
            v[i, 2] -= GRAVITY_M_S2 * h
        for a in range(len(x_row)):
            v_row[a] *= kept
            last_row[a] = x_row[a]
            x_row[a] += h * v_row[a]
        project_pairs(x, last, pairs, pair_count, radius_m, friction, h)
        share, part = (s + 1) / substeps, 1 / substeps
        project_contacts(x, last, out, count, share, part, friction, h, origin, moved)
        for a in range(len(x_row)):
            v_row[a] = rate_hz * (x_row[a] - last_row[a])
    # Who was knocked off the foreseen way may have met walls that nobody looked for.
    strayed = 0
    far = SLACK_RADII * radius_m
    for i in range(len(x)):
        dx, dy, dz = x[i, 0] - goal[i, 0], x[i, 1] - goal[i, 1], x[i, 2] - goal[i, 2]
        if dx * dx + dy * dy + dz * dz > far * far:
            chosen[strayed] = i
            strayed += 1
    count = find_contacts(first, x, chosen, strayed, radius_m, walls, poses, out)
    catch(x, v, out, count, timestep_s, h, origin, moved)
    for axis in range(6):
        push = -mass_kg / h / timestep_s * moved[axis]
        wrench[axis] += taken * (push - wrench[axis])
