"""Region-based pose refinement: move a mesh until its outline separates object colours from background colours.

The outline of the mesh is sampled by correspondence lines; along each line the colours say where the true outline
probably runs, and one Gauss-Newton step on SE(3) moves all outline points there at once. This is the family of RBOT
(Tjaden et al., 2018) and SRT3D (Stoiber et al., IJCV 2022, equations 10 to 22), with colour statistics kept locally
around points of the mesh, so that a mirror-bright or many-coloured object still separates from its surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .colours import HIDDEN_BIN, LOCAL_CENTRES, ColourModel
from .creases import Creases, draw_creases
from .geometry import Array, invert_pose, make_pose, project, shows_same_side, transform_points, unproject
from .raster import DepthWindow, render_depth
from .region_kernels import free_lengths, learn_lines, measure_lines, solve_pose, strongest_gradient
from .video import Image, softened

CLEAR_EDGE = 24.0  # grey levels per px
SAME_SIDE_RAD, SAME_SIZE = float(np.deg2rad(1.5)), 0.05  # of views that one outline serves
POINT_LIMIT_PX = 3.0
CREASE_WEIGHT = 0.1  # against the outline: a vessel of the library has its creases about there, not just there
NO_EDGES = np.zeros((0, 0, 2), np.float32)


@dataclass(frozen=True)
class TrackingMesh:
    """What the tracker needs of a mesh: vertices (V, 3) in m, faces (F, 3) int32, and spread-out surface centres.

    closed: see `render_depth`.
    """

    vertices_m: Array
    faces: NDArray[np.int32]
    centres_m: Array
    tree: cKDTree = field(repr=False)
    closed: bool = False

    @staticmethod
    def build(vertices_m: Array, faces: NDArray[np.int32], closed: bool = False) -> TrackingMesh:
        vertices = np.ascontiguousarray(vertices_m, float)
        centres = farthest_points(vertices, LOCAL_CENTRES)
        return TrackingMesh(vertices, np.ascontiguousarray(faces, np.int32), centres, cKDTree(centres), closed)

    @cached_property
    def radius_m(self) -> float:
        return float(np.linalg.norm(self.vertices_m, axis=1).max())

    def drawn(self, T_camera_object: Array, camera_matrix: Array, margin_px: int = 2) -> DepthWindow | None:
        """Its depth image at a pose, see `render_depth`."""
        return render_depth(
            self.vertices_m, self.faces, T_camera_object, camera_matrix, margin_px=margin_px, closed=self.closed
        )


@dataclass(frozen=True)
class Outline:
    """Sampled outline of the mesh, drawn at one pose and moved along with poses seen from nearly the same side.

    pixel: (N, 2) image position.  normal: (N, 2) unit, outward.  point_object_m, normal_object: (N, 3).
    inside_px, outside_px: (N,) free length of the line before the silhouette ends or begins again.
    nearest: (N, 3) the mesh's centres nearest to each point.  T_drawn: (4, 4) the pose it was drawn at.
    """

    pixel: Array
    normal: Array
    point_object_m: Array
    normal_object: Array
    inside_px: NDArray[np.float32]
    outside_px: NDArray[np.float32]
    nearest: NDArray[np.int32]
    T_drawn: Array
    creases: Creases | None = None

    def __len__(self) -> int:
        return len(self.pixel)

    def select(self, keep: NDArray[np.bool_]) -> Outline:
        """The lines where `keep` (N,) is true."""
        return Outline(
            self.pixel[keep], self.normal[keep], self.point_object_m[keep], self.normal_object[keep],
            self.inside_px[keep], self.outside_px[keep], self.nearest[keep], self.T_drawn, self.creases,
        )  # fmt: skip

    def inside(self, image_shape: tuple[int, int]) -> Outline | None:
        """The lines whose feet are in an image (height, width); None when fewer than 12 are."""
        x, y = self.pixel.T
        keep = (x >= 2) & (x < image_shape[1] - 2) & (y >= 2) & (y < image_shape[0] - 2)
        count = np.count_nonzero(keep)
        return None if count < 12 else self if count == len(keep) else self.select(keep)

    def teach(self, colours: ColourModel, bins: NDArray[np.int32], rate: float) -> None:
        """Let colours learn from the lines of an outline that fits; `bins` is the (H, W) image of colour bins."""
        learn_lines(
            self.pixel, self.normal, self.inside_px, self.outside_px, self.nearest, bins,
            colours.foreground, colours.background, colours.seen, rate, HIDDEN_BIN,
        )  # fmt: skip

    def serves(self, T_camera_object: Array) -> bool:
        """Whether the object shows nearly the same side and size at a pose as where the outline was drawn."""
        return shows_same_side(T_camera_object, self.T_drawn, SAME_SIDE_RAD, SAME_SIZE)

    def moved(self, T_camera_object: Array, camera_matrix: Array) -> Outline:
        """The same points of the mesh where another pose and camera show them."""
        pixel = project(camera_matrix, transform_points(T_camera_object, self.point_object_m))
        normal = self.normal_object @ T_camera_object[:2, :3].T
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return replace(self, pixel=pixel, normal=normal)


@dataclass(frozen=True)
class Points:
    """Points of the mesh seen at known places: object_m (N, 3), pixel (N, 2), weight (N,) inverse variance in px^-2."""

    object_m: Array
    pixel: Array
    weight: Array

    @staticmethod
    def none() -> Points:
        return Points(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))

    def errors_px(self, T_camera_object: Array, camera_matrix: Array) -> Array:
        """(N,) distances from where a pose puts the points."""
        seen = project(camera_matrix, transform_points(T_camera_object, self.object_m))
        return np.asarray(np.linalg.norm(seen - self.pixel, axis=1))


def edge_strength(rgb: Image, soft: Image | None = None) -> NDArray[np.float32]:
    """(H, W, 2) image gradient, the largest of the three channels, scaled so that a clear edge has length 1.

    soft: the image `softened`, if it is at hand.
    """
    strength = np.empty((*rgb.shape[:2], 2), np.float32)
    strongest_gradient(softened(rgb) if soft is None else soft, 1 / (8 * CLEAR_EDGE), strength)
    return strength


def extract_outline(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    image_shape: tuple[int, int],
    count: int = 300,
    with_creases: bool = True,
) -> Outline | None:
    """Sample the silhouette's outer boundary inside the image; None when the object cannot be drawn."""
    outline = draw_outline(mesh, T_camera_object, camera_matrix, count, with_creases)
    return None if outline is None else outline.inside(image_shape)


def draw_outline(
    mesh: TrackingMesh, T_camera_object: Array, camera_matrix: Array, count: int = 300, with_creases: bool = True
) -> Outline | None:
    """Sample the whole boundary of the silhouette, in the image or not; None when the object cannot be drawn."""
    window = draw_window(mesh, T_camera_object, camera_matrix)
    return None if window is None else trace_outline(window, mesh, T_camera_object, camera_matrix, count, with_creases)


def draw_window(mesh: TrackingMesh, T_camera_object: Array, camera_matrix: Array) -> DepthWindow | None:
    """The mesh drawn at a pose, with as much around it as `trace_outline` needs; None when it cannot be drawn."""
    return mesh.drawn(T_camera_object, camera_matrix, margin_px=24)


def trace_outline(
    window: DepthWindow,
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    count: int = 300,
    with_creases: bool = True,
) -> Outline | None:
    """`draw_outline` of what `draw_window` drew."""
    mask = window.mask.astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [c for c in contours if len(c) >= 8]
    if not contours:
        return None
    contour = np.concatenate(contours)[:, 0, :]
    contour = contour[window.depth_m[contour[:, 1], contour[:, 0]] > 0]  # holes are traced along their outside
    if len(contour) < 12:
        return None
    contour = contour[np.linspace(0, len(contour) - 1, min(count, len(contour))).round().astype(int)]
    # A blurred silhouette gives stable normals where the pixel outline is ragged.
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0)
    cx, cy = contour[:, 0], contour[:, 1]
    normal = np.stack([soft[cy, cx - 1] - soft[cy, cx + 1], soft[cy - 1, cx] - soft[cy + 1, cx]], axis=1).astype(float)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    good = length[:, 0] > 1e-3
    contour, normal = contour[good], normal[good] / length[good]
    cx, cy = contour[:, 0], contour[:, 1]
    z = window.depth_m[cy, cx].astype(float)
    # The outline runs half a pixel outside the last pixel of the silhouette.
    pixel = np.stack([cx + window.x0_px, cy + window.y0_px], axis=1) + 0.5 * normal
    points = transform_points(invert_pose(T_camera_object), unproject(camera_matrix, pixel, z))
    inside, outside = np.zeros(len(z), np.float32), np.zeros(len(z), np.float32)
    free_lengths(contour.astype(np.float64), normal, mask, inside, outside)
    nearest = mesh.tree.query(points, k=3)[1].astype(np.int32)
    normal_object = normal @ T_camera_object[:2, :3]
    creases = draw_creases(window, mesh.radius_m, T_camera_object, camera_matrix) if with_creases else None
    return Outline(pixel, normal, points, normal_object, inside, outside, nearest, T_camera_object, creases)


@dataclass(frozen=True)
class Lines:
    """Where the colours put the outline, for every usable line of one outline.

    outline: the lines' feet.  target_px: (N, 2).  variance_px2: (N,).  gain: (N,) log-likelihood per sample by which
    the outline where it stands beats an outline at either end of the line.  step_px: sample spacing.
    """

    outline: Outline
    target_px: Array
    variance_px2: Array
    gain: Array
    step_px: float

    def residuals(self, T_camera_object: Array, camera_matrix: Array) -> tuple[Array, Array]:
        """Signed distance to the target along the normal (N,) in px and its Jacobian (N, 6), rotation first."""
        points = transform_points(T_camera_object, self.outline.point_object_m)
        return _normal_residuals(points, T_camera_object[:3, 3], camera_matrix, self.target_px, self.outline.normal)

    def weights(self, offset_px: Array) -> Array:
        """Inverse variance, less for lines that disagree with the rest: occluders, shadows."""
        return np.asarray(1.0 / self.variance_px2 / (1.0 + (offset_px / (4.0 * self.step_px)) ** 2))


def measure(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    bins: NDArray[np.int32],
    colours: ColourModel,
    step_px: float,
    edges: NDArray[np.float32] | None = None,
    outline: Outline | None = None,
) -> Lines | None:
    """Read every line of the outline at one pose, drawn anew if not given; None when fewer than 12 are usable."""
    shape = (bins.shape[0], bins.shape[1])
    outline = outline or extract_outline(mesh, T_camera_object, camera_matrix, shape, with_creases=False)
    if outline is None:
        return None
    mean_px, variance, gain = np.zeros(len(outline)), np.zeros(len(outline)), np.zeros(len(outline))
    measure_lines(
        outline.pixel, outline.normal, outline.inside_px, outline.outside_px, outline.nearest, bins,
        colours.foreground, colours.background, colours.seen, HIDDEN_BIN, NO_EDGES if edges is None else edges,
        step_px, mean_px, variance, gain,
    )  # fmt: skip
    usable = variance > 0
    if usable.sum() < 12:
        return None
    outline = outline.select(usable)
    target = outline.pixel + mean_px[usable, None] * outline.normal
    return Lines(outline, target, variance[usable], gain[usable], step_px)


@dataclass(frozen=True)
class Refinement:
    """Result of `refine`: the pose, the mean log-likelihood ratio per line (higher is better) and lines used.

    information: (6, 6) Gauss-Newton information in px^-2, rotation first.  outline: the last one drawn, uncut.
    strain: by how much the points made the lines fit worse, in squared standard deviations a line: more than noise
    when points and outline contradict each other.
    """

    T_camera_object: Array
    score: float
    lines: int
    information: Array
    outline: Outline | None = None
    strain: float = 0.0


def refine(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    bins: NDArray[np.int32],
    colours: ColourModel,
    *,
    steps_px: tuple[float, ...] = (5.0, 3.0, 2.0, 1.0, 1.0),
    iterations: int = 3,
    prior_rotation_rad: float = 0.15,
    prior_translation: float = 0.02,
    prior_depth: float = 0.01,
    prior_spin_rad: float | None = None,
    spin_axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    edges: NDArray[np.float32] | None = None,
    points: Points | None = None,
    outline: Outline | None = None,
) -> Refinement:
    """Refine a pose against one image.

    bins: (H, W) from `colour_bins`.  steps_px: sample spacing along the lines for each outer pass, coarse to fine.
    prior_*: standard deviation of the start pose, rotation in rad, translation as a fraction of the distance,
    sideways and along the viewing ray: directions the outline does not show stay where they were.
    prior_spin_rad: the same for turns about the object's own `spin_axis`, where it differs.
    edges: (H, W, 2) from `edge_strength`, to weigh image edges in with the colours; None for colours alone.
    points: what else must fit, in the same least squares.  outline: drawn before, used while it serves.
    """
    T_start: Array = T_camera_object.copy()
    T: Array = T_camera_object.copy()
    points = points or Points.none()
    score, count, strain = -np.inf, 0, 0.0
    information: Array = np.zeros((6, 6))
    told = bins != HIDDEN_BIN
    up = T_start[:3, :3] @ np.asarray(spin_axis)
    prior = _prior(T_start, up, prior_rotation_rad, prior_spin_rad, prior_translation, prior_depth)

    def solved(lines: Lines, weight: Array) -> tuple[Array, Array, float]:
        inverse_variance, turn, shift = 1.0 / lines.variance_px2, T[:3, :3].copy(), T[:3, 3].copy()
        found = np.zeros((6, 6))
        point, target, normal = lines.outline.point_object_m, lines.target_px, lines.outline.normal
        if edges is not None and outline is not None and outline.creases is not None:
            inner = outline.creases.read(T, camera_matrix, edges, lines.step_px, told)
            point, target, normal = (np.concatenate(pair) for pair in zip((point, target, normal), inner, strict=False))
            inverse_variance = np.concatenate([inverse_variance, CREASE_WEIGHT / inner[3]])
        cost = solve_pose(
            point, target, normal, inverse_variance, lines.step_px,
            points.object_m, points.pixel, weight, POINT_LIMIT_PX, camera_matrix, T_start, prior, iterations,
            turn, shift, found,
        )  # fmt: skip
        return make_pose(Rotation.from_matrix(turn, assume_valid=True).as_matrix(), shift), found, float(cost)

    for number, step_px in enumerate(steps_px):
        if outline is None or not outline.serves(T):
            outline = draw_outline(mesh, T, camera_matrix, with_creases=edges is not None)
        here = None if outline is None else outline.moved(T, camera_matrix).inside((bins.shape[0], bins.shape[1]))
        lines = None if here is None else measure(mesh, T, camera_matrix, bins, colours, step_px, edges, here)
        if lines is None:
            break
        score, count = float(np.mean(lines.gain)), len(lines.gain)
        last = number == len(steps_px) - 1
        alone = solved(lines, np.zeros_like(points.weight))[2] if last and len(points.weight) else 0.0
        T, information, cost = solved(lines, points.weight)
        strain = (cost - alone) / count if alone else 0.0
    return Refinement(T, score, count, information, outline, strain)


def _prior(T: Array, up: Array, rotation_rad: float, spin_rad: float | None, sideways: float, depth: float) -> Array:
    """(6, 6) information of a start pose whose spin is about `up`, see `refine`."""
    distance = float(np.linalg.norm(T[:3, 3]))
    ray = T[:3, 3] / distance
    prior: Array = np.zeros((6, 6))
    prior[:3, :3] = np.eye(3) / rotation_rad**2
    if spin_rad is not None:
        prior[:3, :3] += np.outer(up, up) * (1 / spin_rad**2 - 1 / rotation_rad**2)
    prior[3:, 3:] = np.eye(3) / (sideways * distance) ** 2
    prior[3:, 3:] += np.outer(ray, ray) * (1 / (depth * distance) ** 2 - 1 / (sideways * distance) ** 2)
    return prior


def farthest_points(points: Array, count: int) -> Array:
    """`count` points of (N, 3) spread out greedily, starting from the one farthest from the mean."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.asarray(points[chosen])


def _normal_residuals(
    camera_points: Array, centre: Array, camera_matrix: Array, target: Array, normal: Array
) -> tuple[Array, Array]:
    """Signed distance to the target along the normal (N,) in px and its Jacobian (N, 6), rotation first."""
    fx, fy = camera_matrix[0, 0], camera_matrix[1, 1]
    x, y, z = camera_points.T
    u, v = fx * x / z + camera_matrix[0, 2], fy * y / z + camera_matrix[1, 2]
    gradient = np.stack(
        [normal[:, 0] * fx / z, normal[:, 1] * fy / z, -(normal[:, 0] * fx * x + normal[:, 1] * fy * y) / z**2], axis=1
    )
    jacobian = np.concatenate([np.cross(camera_points - centre, gradient), gradient], axis=1)
    offset = np.sum(normal * (target - np.stack([u, v], axis=1)), axis=1)
    return offset, jacobian
