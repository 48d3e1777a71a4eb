"""How well an object was found in one picture when the mesh at hand is not the object's own (paper, appendix A.5.1).

Three errors compare the truth's mesh at the true pose with the estimate's at the estimated pose: CoU by their
silhouettes, CH by their surfaces in space, pCH by their surfaces in the picture. Text and published code of the paper
differ, and `protocol` chooses. "official" is the code: distances, between all vertices. "paper" is the text: squared
distances, between points sampled on the surfaces, compared with squared limits, so that both have one unit. CoU is
1 - IoU in both: the text calls it the IoU, of which a recall would fall the better the estimate is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .errors import UserError
from .geometry import Array, project, transform_points
from .protocols import Mask
from .raster import render_depth

Protocol = Literal["official", "paper"]
PROTOCOLS: tuple[str, ...] = get_args(Protocol)
METRICS = ("cou", "ch", "pch")
# An object counts as found when its error is below the limit; average recall is the mean over these.
LIMITS: dict[str, Array] = {
    "cou": np.arange(5, 55, 5) / 100,
    "ch": np.arange(5, 55, 5) / 100,  # of the true model's diameter
    "pch": np.arange(5, 55, 5) / 1,  # px of a picture 640 px wide
}
REFERENCE_WIDTH_PX = 640
SAMPLES = 2000


@dataclass(frozen=True)
class Shape:
    """A mesh as the metrics need it: vertices_m (V, 3), faces (F, 3), points_m (SAMPLES, 3) spread over its surface.

    size_m: its largest full extent.
    """

    vertices_m: Array
    faces: NDArray[np.int32]
    points_m: Array
    size_m: float

    @staticmethod
    def of(mesh: Any, size_m: float | None = None) -> Shape:
        """The shape of a trimesh.Trimesh; with a size, centred on its bounding box and scaled to that size."""
        import trimesh

        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        if size_m is not None:
            vertices = (vertices - (low + high) / 2) * (size_m / float((high - low).max()))
        plain = trimesh.Trimesh(vertices, faces, process=False)
        points = trimesh.sample.sample_surface(plain, SAMPLES, seed=0)[0]
        return Shape(vertices, faces, np.asarray(points, float), float(np.ptp(vertices, axis=0).max()))


class Placed:
    """A shape at a pose before a camera; what the metrics ask of it is worked out once.

    T_camera_object: (4, 4), m. camera_matrix: (3, 3), px. size_px: (width, height) of the picture.
    """

    def __init__(
        self, shape: Shape, T_camera_object: Array, camera_matrix: Array, size_px: tuple[int, int], protocol: Protocol
    ) -> None:
        if protocol not in PROTOCOLS:
            raise UserError(f"protocol is {protocol!r}; choose {', '.join(PROTOCOLS)}")
        self.shape, self.T_camera_object, self.protocol = shape, T_camera_object, protocol
        self._camera_matrix, self._size_px = camera_matrix, size_px

    @cached_property
    def points_m(self) -> Array:
        """(P, 3) in the camera frame: all vertices, or the sampled points in the paper's protocol."""
        own = self.shape.points_m if self.protocol == "paper" else self.shape.vertices_m
        return transform_points(self.T_camera_object, own)

    @cached_property
    def pixels(self) -> Array | None:
        """(P, 2) their projections in px of a picture 640 px wide; None when some lie behind the camera."""
        if self.points_m[:, 2].min() <= 0:
            return None
        return project(self._camera_matrix, self.points_m) * (REFERENCE_WIDTH_PX / self._size_px[0])

    @cached_property
    def cloud(self) -> Cloud:
        """The points in space."""
        return Cloud.of(self.points_m)

    @cached_property
    def flat_cloud(self) -> Cloud | None:
        """The points in the picture."""
        return None if self.pixels is None else Cloud.of(self.pixels)

    @cached_property
    def silhouette(self) -> tuple[Mask, int, int, int]:
        """The part of its silhouette inside the picture: the window, the window's column and row, and its area."""
        width, height = self._size_px
        window = render_depth(self.shape.vertices_m, self.shape.faces, self.T_camera_object, self._camera_matrix)
        if window is None:
            return np.zeros((0, 0), bool), 0, 0, 0
        x, y, (rows, columns) = window.x0_px, window.y0_px, window.depth_m.shape
        left, top = max(x, 0), max(y, 0)
        right, bottom = max(min(x + columns, width), left), max(min(y + rows, height), top)
        mask = window.mask[top - y : bottom - y, left - x : right - x]
        return mask, left, top, int(np.count_nonzero(mask))


@dataclass(frozen=True)
class Cloud:
    """Points (P, D) that nearest neighbours are asked of; middle (D,) and radius bound them, mean is their mean."""

    points: Array
    tree: cKDTree
    middle: Array
    radius: float
    mean: Array

    @staticmethod
    def of(points: Array) -> Cloud:
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        return Cloud(points, cKDTree(points), middle, radius, points.mean(axis=0))


def complement_over_union(a: Placed, b: Placed) -> float:
    """1 - IoU of the two silhouettes in the picture; 1 when neither is in it."""
    mask_a, x_a, y_a, area_a = a.silhouette
    mask_b, x_b, y_b, area_b = b.silhouette
    left, top = max(x_a, x_b), max(y_a, y_b)
    right = min(x_a + mask_a.shape[1], x_b + mask_b.shape[1])
    bottom = min(y_a + mask_a.shape[0], y_b + mask_b.shape[0])
    common = 0
    if left < right and top < bottom:
        part_a = mask_a[top - y_a : bottom - y_a, left - x_a : right - x_a]
        part_b = mask_b[top - y_b : bottom - y_b, left - x_b : right - x_b]
        common = int(np.count_nonzero(part_a & part_b))
    union = area_a + area_b - common
    return 1.0 - common / union if union else 1.0


def chamfer(a: Cloud, b: Cloud, *, squared: bool, limit: float = np.inf) -> float:
    """Mean distance of a's points to b's nearest and of b's to a's, added; of squared distances if asked.

    Where it is certainly above `limit` the result is infinite, which saves most of the work.
    """
    # A point's distance to a cloud is at least that to a ball around it, a convex function: no mean of it is below
    # its value at the mean point (Jensen). Squared distances: a mean of squares is no less than the mean, squared.
    least = [max(float(np.linalg.norm(p.mean - q.middle)) - q.radius, 0.0) for p, q in ((a, b), (b, a))]
    if sum(v * v if squared else v for v in least) > limit:
        return np.inf
    total = 0.0
    for p, q in ((a, b), (b, a)):
        distance = q.tree.query(p.points)[0]
        total += float(np.mean(distance**2 if squared else distance))
        if total > limit:
            return np.inf
    return total


def pose_error(metric: str, estimate: Placed, truth: Placed, diameter_m: float, enough: float = np.inf) -> float:
    """One of the three errors; CH in diameters of the true model, pCH in px of a picture 640 px wide.

    In the paper's protocol CH and pCH are squared. CH and pCH are infinite where they are above the largest limit, or
    above `enough`: whoever only wants the best of several gives the best so far.
    """
    squared = truth.protocol == "paper"
    if metric == "cou":
        return complement_over_union(estimate, truth)
    if metric not in METRICS:
        raise UserError(f"unknown metric {metric!r}; there are {', '.join(METRICS)}")
    limit = min(float(limits(metric, truth.protocol)[-1]), enough)
    if metric == "ch":
        unit = diameter_m**2 if squared else diameter_m
        return chamfer(estimate.cloud, truth.cloud, squared=squared, limit=limit * unit) / unit
    if estimate.flat_cloud is None or truth.flat_cloud is None:
        return np.inf
    return chamfer(estimate.flat_cloud, truth.flat_cloud, squared=squared, limit=limit)


def limits(metric: str, protocol: Protocol) -> Array:
    """(10,) the limits that the errors of a protocol are compared with."""
    return LIMITS[metric] ** 2 if protocol == "paper" and metric != "cou" else LIMITS[metric]


def recalls(errors: Array, metric: str, protocol: Protocol, scores: Array, obj_ids: Sequence[int]) -> NDArray[np.bool_]:
    """(10, T) which true objects are found at each limit, from errors (E, T) of E estimates of T true objects.

    The surest estimates choose first (`scores` (E,)), each the nearest object that is left, and serves that one alone.
    The official code does so for each kind of object by itself (`obj_ids`, T of them), and offers it all estimates: one
    may find several objects of different kinds, and spurious ones cost nothing.
    """
    found = np.zeros((10, errors.shape[1]), bool)
    ids = np.zeros(len(obj_ids), int) if protocol == "paper" else np.asarray(obj_ids)
    order = np.argsort(-scores, kind="stable")
    for n, limit in enumerate(limits(metric, protocol)):
        for kind in np.unique(ids):
            of_kind = errors[:, ids == kind]
            left = np.ones(of_kind.shape[1], bool)
            for k in order:
                candidates = np.where(left & (of_kind[k] < limit), of_kind[k], np.inf)
                best = int(np.argmin(candidates))
                if candidates[best] < np.inf:
                    left[best] = False
            found[n, ids == kind] = ~left
    return found
