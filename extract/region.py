"""Region-based pose refinement: move a mesh until its outline separates object colours from background colours.

The outline of the mesh is sampled by correspondence lines; along each line the colours say where the true outline
probably runs, and one Gauss-Newton step on SE(3) moves all outline points there at once. This is the family of RBOT
(Tjaden et al., 2018) and SRT3D (Stoiber et al., IJCV 2022, equations 10 to 22), with colour statistics kept locally
around points of the mesh, so that a mirror-bright or many-coloured object still separates from its surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .geometry import Array, invert_pose, transform_points
from .raster import render_depth
from .region_kernels import collect_lines, free_lengths, measure_lines
from .video import Image

BITS = 4  # colour resolution per channel of the local histograms
BINS = 1 << (3 * BITS)
LOCAL_CENTRES = 48
CLEAR_EDGE = 24.0  # grey levels per px
NO_EDGES = np.zeros((0, 0, 2), np.float32)


@dataclass(frozen=True)
class TrackingMesh:
    """What the tracker needs of a mesh: vertices (V, 3) in m, faces (F, 3) int32, and spread-out surface centres."""

    vertices_m: Array
    faces: NDArray[np.int32]
    centres_m: Array
    tree: cKDTree = field(repr=False)

    @staticmethod
    def build(vertices_m: Array, faces: NDArray[np.int32]) -> TrackingMesh:
        vertices = np.ascontiguousarray(vertices_m, float)
        centres = farthest_points(vertices, LOCAL_CENTRES)
        return TrackingMesh(vertices, np.ascontiguousarray(faces, np.int32), centres, cKDTree(centres))

    @property
    def radius_m(self) -> float:
        return float(np.linalg.norm(self.vertices_m, axis=1).max())


@dataclass(frozen=True)
class Outline:
    """Sampled outline of the mesh at one pose.

    pixel: (N, 2) image position.  normal: (N, 2) unit, outward.  point_object_m: (N, 3).
    inside_px, outside_px: (N,) free length of the line before the silhouette ends or begins again.
    """

    pixel: Array
    normal: Array
    point_object_m: Array
    inside_px: NDArray[np.float32]
    outside_px: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixel)

    def select(self, keep: NDArray[np.bool_]) -> Outline:
        """The lines where `keep` (N,) is true."""
        return Outline(
            self.pixel[keep], self.normal[keep], self.point_object_m[keep], self.inside_px[keep], self.outside_px[keep]
        )


class ColourModel:
    """Foreground and background colour histograms, global and around every centre of the mesh."""

    def __init__(self) -> None:
        self.foreground = np.zeros((LOCAL_CENTRES + 1, BINS), np.float32)
        self.background = np.zeros((LOCAL_CENTRES + 1, BINS), np.float32)
        self.seen = np.zeros(LOCAL_CENTRES + 1, np.float32)

    def copy(self) -> ColourModel:
        """The model as it is now."""
        twin = ColourModel()
        twin.foreground, twin.background, twin.seen = self.foreground.copy(), self.background.copy(), self.seen.copy()
        return twin

    def start_global(self, foreground: NDArray[np.int32], background: NDArray[np.int32]) -> None:
        """Set the global histograms (row LOCAL_CENTRES) from colour bins of labelled pixels."""
        for histogram, bins in ((self.foreground, foreground), (self.background, background)):
            histogram[-1] = _smooth(np.bincount(bins, minlength=BINS).astype(np.float32))
        self.seen[-1] = 1.0

    def update(self, outline: Outline, mesh: TrackingMesh, bins: NDArray[np.int32], rate: float) -> None:
        """Learn from the lines of a converged outline; `bins` is the (H, W) image of colour bins."""
        if len(outline) == 0:
            return
        nearest = mesh.tree.query(outline.point_object_m, k=2)[1].astype(np.int32)
        fresh_f = np.zeros_like(self.foreground)
        fresh_b = np.zeros_like(self.background)
        collect_lines(
            outline.pixel, outline.normal, outline.inside_px, outline.outside_px, nearest, bins, fresh_f, fresh_b
        )
        touched = (fresh_f.sum(axis=1) > 20) & (fresh_b.sum(axis=1) > 20)
        for k in np.flatnonzero(touched):
            f, b = _smooth(fresh_f[k]), _smooth(fresh_b[k])
            a = rate if self.seen[k] else 1.0
            self.foreground[k] = (1 - a) * self.foreground[k] + a * f
            self.background[k] = (1 - a) * self.background[k] + a * b
            self.seen[k] = 1.0


def edge_strength(rgb: Image) -> NDArray[np.float32]:
    """(H, W, 2) image gradient, the largest of the three channels, scaled so that a clear edge has length 1."""
    blurred = cv2.GaussianBlur(rgb, (0, 0), 1.0)
    x, y = (cv2.split(cv2.Sobel(blurred, cv2.CV_32F, *order, scale=1 / 8)) for order in ((1, 0), (0, 1)))
    best_x, best_y = x[0], y[0]
    best = best_x * best_x + best_y * best_y
    for gx, gy in zip(x[1:], y[1:], strict=True):
        square = gx * gx + gy * gy
        stronger = square > best
        best = np.where(stronger, square, best)
        best_x, best_y = np.where(stronger, gx, best_x), np.where(stronger, gy, best_y)
    strongest = np.stack([best_x, best_y], axis=-1)
    return np.asarray(strongest / CLEAR_EDGE, np.float32)


def mask_evidence(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], ColourModel]:
    """A mask in the form of an image of two colours and their model, so that poses can be refined against it.

    The model trusts the mask to four in five, so that a wrong stretch of it does not outvote the rest.
    """
    colours = ColourModel()
    colours.foreground[-1, :2], colours.background[-1, :2] = (0.2, 0.8), (0.8, 0.2)
    colours.seen[-1] = 1.0
    return mask.astype(np.int32), colours


def colour_bins(rgb: Image) -> NDArray[np.int32]:
    """(H, W) histogram bin of every pixel."""
    shift = 8 - BITS
    r, g, b = (rgb[..., k].astype(np.int32) >> shift for k in range(3))
    return (r << (2 * BITS)) | (g << BITS) | b


def extract_outline(
    mesh: TrackingMesh,
    T_camera_object: Array,
    camera_matrix: Array,
    image_shape: tuple[int, int],
    count: int = 300,
) -> Outline | None:
    """Sample the silhouette's outer boundary inside the image; None when the object cannot be drawn."""
    window = render_depth(mesh.vertices_m, mesh.faces, T_camera_object, camera_matrix, margin_px=24)
    if window is None:
        return None
    mask = window.mask.astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [c for c in contours if len(c) >= 8]
    if not contours:
        return None
    # A smooth signed distance gives stable normals where the pixel outline is ragged.
    signed = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5) - cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    signed = cv2.GaussianBlur(np.asarray(signed, np.float32), (0, 0), 1.2)
    grad_x, grad_y = cv2.Sobel(signed, cv2.CV_32F, 1, 0), cv2.Sobel(signed, cv2.CV_32F, 0, 1)
    contour = np.concatenate(contours)[:, 0, :]
    height, width = image_shape
    x, y = contour[:, 0] + window.x0_px, contour[:, 1] + window.y0_px
    keep = (x >= 2) & (x < width - 2) & (y >= 2) & (y < height - 2) & (window.depth_m[contour[:, 1], contour[:, 0]] > 0)
    contour = contour[keep]
    if len(contour) < 12:
        return None
    contour = contour[np.linspace(0, len(contour) - 1, min(count, len(contour))).round().astype(int)]
    cx, cy = contour[:, 0], contour[:, 1]
    normal = np.stack([grad_x[cy, cx], grad_y[cy, cx]], axis=1).astype(float)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    good = length[:, 0] > 1e-3
    contour, normal = contour[good], normal[good] / length[good]
    cx, cy = contour[:, 0], contour[:, 1]
    z = window.depth_m[cy, cx].astype(float)
    # The outline runs half a pixel outside the last pixel of the silhouette.
    pixel = np.stack([cx + window.x0_px, cy + window.y0_px], axis=1) + 0.5 * normal
    rays = np.column_stack([(pixel - camera_matrix[:2, 2]) / np.diag(camera_matrix)[:2], np.ones(len(z))])
    points = transform_points(invert_pose(T_camera_object), rays * z[:, None])
    inside, outside = np.zeros(len(z), np.float32), np.zeros(len(z), np.float32)
    free_lengths(contour.astype(np.float64), normal, mask, inside, outside)
    return Outline(pixel, normal, points, inside, outside)


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
    outline = outline or extract_outline(mesh, T_camera_object, camera_matrix, (bins.shape[0], bins.shape[1]))
    if outline is None:
        return None
    nearest = mesh.tree.query(outline.point_object_m, k=3)[1].astype(np.int32)
    mean_px, variance, gain = np.zeros(len(outline)), np.zeros(len(outline)), np.zeros(len(outline))
    measure_lines(
        outline.pixel, outline.normal, outline.inside_px, outline.outside_px, nearest, bins,
        colours.foreground, colours.background, colours.seen, NO_EDGES if edges is None else edges,
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
    """Result of `refine`: the pose, the mean log-likelihood ratio per line (higher is better) and lines used."""

    T_camera_object: Array
    score: float
    lines: int
    information: Array  # (6, 6) Gauss-Newton information in px^-2, rotation first


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
    edges: NDArray[np.float32] | None = None,
) -> Refinement:
    """Refine a pose against one image.

    bins: (H, W) from `colour_bins`.  steps_px: sample spacing along the lines for each outer pass, coarse to fine.
    prior_*: standard deviation of the start pose, rotation in rad, translation as a fraction of the distance,
    sideways and along the viewing ray: directions the outline does not show stay where they were.
    prior_spin_rad: the same for turns about the object's own +z, where it differs.
    edges: (H, W, 2) from `edge_strength`, to weigh image edges in with the colours; None for colours alone.
    """
    T_start: Array = T_camera_object.copy()
    T: Array = T_camera_object.copy()
    score, count = -np.inf, 0
    information: Array = np.zeros((6, 6))
    distance = float(np.linalg.norm(T_start[:3, 3]))
    ray = T_start[:3, 3] / distance
    weight_t: Array = np.eye(3) / (prior_translation * distance) ** 2
    weight_t += np.outer(ray, ray) * (1 / (prior_depth * distance) ** 2 - 1 / (prior_translation * distance) ** 2)
    prior: Array = np.zeros((6, 6))
    prior[:3, :3] = np.eye(3) / prior_rotation_rad**2
    if prior_spin_rad is not None:
        up = T_start[:3, 2]
        prior[:3, :3] += np.outer(up, up) * (1 / prior_spin_rad**2 - 1 / prior_rotation_rad**2)
    prior[3:, 3:] = weight_t
    for step_px in steps_px:
        lines = measure(mesh, T, camera_matrix, bins, colours, step_px, edges)
        if lines is None:
            break
        score, count = float(np.mean(lines.gain)), len(lines.gain)
        for _ in range(iterations):
            offset_px, jacobian = lines.residuals(T, camera_matrix)
            w = lines.weights(offset_px)
            information = (jacobian * w[:, None]).T @ jacobian
            gradient = jacobian.T @ (w * offset_px) - prior @ _twist(T_start, T)
            delta = np.linalg.solve(information + prior, gradient)
            T = T.copy()
            T[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
            T[:3, 3] += delta[3:]
            if np.abs(delta).max() < 1e-6:
                break
        T[:3, :3] = Rotation.from_matrix(T[:3, :3]).as_matrix()
    return Refinement(T, score, count, information)


def farthest_points(points: Array, count: int) -> Array:
    """`count` points of (N, 3) spread out greedily, starting from the one farthest from the mean."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.asarray(points[chosen])


def _twist(T_a: Array, T_b: Array) -> Array:
    """Rotation vector and translation from pose a to pose b, both in the camera frame, about the object's origin."""
    rotation = Rotation.from_matrix(T_b[:3, :3] @ T_a[:3, :3].T).as_rotvec()
    return np.concatenate([rotation, T_b[:3, 3] - T_a[:3, 3]])


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


def _smooth(histogram: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normalised histogram spread over neighbouring bins, so that small samples do not overfit."""
    side = 1 << BITS
    cube = histogram.reshape(side, side, side)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        low, high = (padded.take(range(s, s + side), axis=axis) for s in (0, 2))
        cube = 0.5 * cube + 0.25 * (low + high)
    flat = cube.reshape(-1)
    return np.asarray(flat / max(float(flat.sum()), 1e-12), np.float32)
