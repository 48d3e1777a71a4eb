"""The rotational symmetry of a mesh, found by turning its surface and measuring how far it then lies from itself.

Works on any triangles, watertight or not, inside-out or not: only the surface's place counts, not its colours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .geometry import Array, Symmetry

SURFACE_SAMPLES = 60_000  # that a turned point may lie on
TURNED_SAMPLES = 2_000  # turned points
NEIGHBOURS = 4
PROBES, PROBES_ASTRAY = 200, 0.04  # most wrong turns show in a few points
TOLERANCE = 0.045  # of the largest distance from the axis: scans and twelve-sided cylinders are round
STRAY_SHARE = 0.002  # of the points that may lie farther, less than the smallest lip
ORDERS = (12, 10, 9, 8, 6, 5, 4, 3, 2)
SWEEP_DEG = (7.0, 17.0, 29.0, 41.0, 61.0, 101.0, 137.5, 163.0)  # no n-fold body stands all of these
DISTINCT_DEG = 8.0


def estimate_symmetry(mesh: Any, *, seed: int = 0) -> Symmetry:
    """Rotational symmetry of a mesh's shape: continuous (order 0), n-fold, or none (order 1).

    mesh: `trimesh.Trimesh` with at least one face of some area, in any unit. The axis goes through the centroid of
    the surface (`surface_centroid`), which need not be the origin of the mesh's frame.
    Of several symmetry axes the one of the highest order is given, +z before the others: a square box has order 4
    about its axis, a box of three different sides order 2 about z; no second axis is reported.
    Texture is not looked at: a symmetric shape with a label may still show its spin.
    """
    rng = np.random.default_rng(seed)
    points, normals = _sampled(mesh, SURFACE_SAMPLES, rng)
    centroid = surface_centroid(mesh)
    centred = points - centroid
    tree = cKDTree(centred)
    moved = centred[rng.permutation(len(centred))[:TURNED_SAMPLES]]
    best = Symmetry()
    for axis in _candidate_axes(mesh, centroid):
        order = _order_about(axis, moved, centred, normals, tree)
        if _rank(order) > _rank(best.order):
            x, y, z = (float(v) for v in axis)
            best = Symmetry((x, y, z), order)
        if best.order == 0:
            break
    return best


def surface_centroid(mesh: Any) -> Array:
    """(3,) centroid of the surface, weighted by area: every symmetry axis goes through it."""
    weight = np.asarray(mesh.area_faces, float)
    return np.asarray((np.asarray(mesh.triangles_center) * weight[:, None]).sum(axis=0) / weight.sum())


def _rank(order: int) -> float:
    return np.inf if order == 0 else float(order)


def _sampled(mesh: Any, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """(count, 3) points spread evenly over the surface and the unit normals of their faces."""
    area = np.asarray(mesh.area_faces, float)
    # Stratified draws spread more evenly than independent ones do.
    at = (np.arange(count) + rng.uniform(size=count)) / count * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    corners = np.asarray(mesh.triangles, float)[face]
    share = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.einsum("nk,nkd->nd", share, corners), normal / np.maximum(length, 1e-30)


def _candidate_axes(mesh: Any, centroid: Array) -> list[Array]:
    """+z, +y, +x and the principal axes of the surface, near copies left out: an n-fold axis is always principal."""
    corners = np.asarray(mesh.triangles, float) - centroid
    middle, area = corners.mean(axis=1), np.asarray(mesh.area_faces, float)
    # Exact second moments of triangles: those of samples turn the axis by a degree.
    moments = np.einsum("f,fi,fj->ij", 9 * area, middle, middle) + np.einsum("f,fki,fkj->ij", area, corners, corners)
    axes: list[Array] = []
    for axis in (*np.eye(3)[::-1], *np.linalg.eigh(moments)[1].T):
        if all(abs(float(axis @ other)) < np.cos(np.deg2rad(DISTINCT_DEG)) for other in axes):
            axes.append(np.asarray(axis if axis[np.argmax(np.abs(axis))] > 0 else -axis))
    return axes


def _order_about(axis: Array, moved: Array, surface: Array, normals: Array, tree: cKDTree) -> int:
    """Order of the symmetry about one axis through the origin."""
    reach = float(np.linalg.norm(surface - np.outer(surface @ axis, axis), axis=1).max())
    tolerance = TOLERANCE * reach

    across = np.linalg.svd(axis[None])[2][1:]

    def returns(angle_rad: float) -> bool:
        turned = moved @ Rotation.from_rotvec(angle_rad * axis).as_matrix().T
        few = tree.query(turned[:PROBES], distance_upper_bound=4 * tolerance)[0]
        if np.mean(np.isinf(few)) > PROBES_ASTRAY:
            return False
        for step in range(3):
            far, nearest = tree.query(turned, k=NEIGHBOURS, distance_upper_bound=4 * tolerance)
            found = nearest < len(surface)
            nearest = np.where(found, nearest, 0)
            # To the plane of the nearest samples: the distance to a sample itself says how dense the samples are.
            signed = np.einsum("nkd,nkd->nk", turned[:, None] - surface[nearest], normals[nearest])
            if step == 2:
                break
            # A label drawn twice pulls the centroid off the axis: let the surface slide across it into place.
            rows = normals[nearest[:, 0]] @ across.T
            weight = found[:, 0] / (1 + (signed[:, 0] / tolerance) ** 2)
            shift = np.linalg.lstsq((rows * weight[:, None]).T @ rows, -rows.T @ (weight * signed[:, 0]), rcond=1e-6)[0]
            turned = turned + np.clip(shift, -4 * tolerance, 4 * tolerance) @ across
        gap = np.where(found, np.abs(signed), np.inf).min(axis=1)
        return bool(np.mean(np.minimum(gap, far[:, 0]) > tolerance) < STRAY_SHARE)

    if all(returns(np.deg2rad(angle)) for angle in SWEEP_DEG):
        return 0
    # Turned by one step, a lip still lies on itself in part; turned to the other side it does not.
    return next((n for n in ORDERS if returns(2 * np.pi / n) and returns(2 * np.pi * (n // 2) / n)), 1)
