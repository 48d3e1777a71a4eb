"""How near a track is to the truth: the FreePose paper's velocity errors, pose errors, and what is left of rotation.

The paper (appendix "tracking metrics") compares how two objects move between frames i and j = i + delta, for ten
delta from 1 to N / 2, and divides by delta: its figures are errors per frame, and flatter a track that stands still.
Read them beside the aligned rotation error. Translations in m, rotations in degrees where the name says so.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .errors import UserError
from .geometry import Array, Symmetry, angle_between_rad, invert_pose, project, rotation_angle_rad

Protocol = Literal["paper", "official", "geodesic"]
PROTOCOLS: tuple[str, ...] = get_args(Protocol)
AUC_LIMIT_M = 0.10
# The authors' code: rotations about a symmetry axis, and the size that every true object is taken to have.
_OFFICIAL_TURNS, _OFFICIAL_TRUE_SCALE_M = 101, 0.15
_CONTINUOUS_TURNS = 100


@dataclass(frozen=True)
class VelocityErrors:
    """e_rot in degrees a frame, e_proj in percent of the image diagonal a frame, e_depth in object sizes a frame."""

    e_rot: float
    e_proj: float
    e_depth: float


@dataclass(frozen=True)
class PoseErrors:
    """Errors of single poses, averaged over frames unless said otherwise.

    rotation_deg, translation_m: of the pose itself, rotation up to symmetry. aligned_rotation_deg: rotation after the
    one constant turn of the object's frame that fits best. projected_percent: distance of the projected origins, in
    percent of the diagonal. add_m, adds_m: mean distance of model points, to the same point and to the nearest
    (Hinterstoisser et al. 2012); *_auc_percent: area under their recall up to 10 cm; worst_stretch: most frames in a
    row with ADD-S
    over 5 cm. The last are None without a model.
    """

    rotation_deg: float
    translation_m: float
    aligned_rotation_deg: float
    projected_percent: float
    add_m: float | None = None
    adds_m: float | None = None
    add_auc_percent: float | None = None
    adds_auc_percent: float | None = None
    worst_stretch: int | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def velocity_errors(
    estimate: Array,
    truth: Array,
    *,
    protocol: Protocol = "paper",
    symmetry: Symmetry | None = None,
    camera_estimate: Array,
    camera_truth: Array,
    image_size_px: tuple[int, int],
    scale_estimate_m: float,
    scale_truth_m: float,
) -> VelocityErrors:
    """The paper's three errors of poses (N, 4, 4) against the truth's (N, 4, 4).

    protocol: "paper" follows its equations; "official" its authors' code, which projects both tracks with f = image
        diagonal, takes 15 cm for every true size and half extents for estimated ones, and drops frames from the
        alignment of origins; "geodesic" is "paper" with the angle between the two turns in place of the difference
        of their logarithms, which jumps by a whole turn when they lie on both sides of 180 degrees.
    camera_*: (3, 3) px; scale_*_m: largest full extent of each object. Raises UserError for fewer than 4 frames.
    """
    if protocol not in PROTOCOLS:
        raise UserError(f"protocol is {protocol!r}; choose {', '.join(PROTOCOLS)}")
    estimate, truth = _proper(estimate, truth)
    count = len(estimate)
    if count < 4:
        raise UserError(f"the tracks share {count} frames; velocity errors need 4 or more")
    official = protocol == "official"
    width, height = image_size_px
    diagonal_px = float(np.hypot(width, height))
    if official:
        camera = np.array([[diagonal_px, 0.0, width / 2], [0.0, diagonal_px, height / 2], [0.0, 0.0, 1.0]])
        camera_estimate = camera_truth = camera
        scale_estimate_m, scale_truth_m = scale_estimate_m / 2, _OFFICIAL_TRUE_SCALE_M
    turns = _symmetry_rotations(symmetry or Symmetry(), official)
    origin_m = aligned_origins(estimate, truth, scale_estimate_m, drop_far=official)
    pixel, pixel_truth = project(camera_estimate, origin_m), project(camera_truth, truth[:, :3, 3])
    depth = np.linalg.norm(origin_m, axis=1) / scale_estimate_m
    depth_truth = np.linalg.norm(truth[:, :3, 3], axis=1) / scale_truth_m
    sums = np.zeros(3)
    deltas = frame_distances(count, official)
    for delta in deltas:
        i, j = np.arange(count - delta), np.arange(delta, count)
        rot_rad = _turn_differences(estimate[:, :3, :3], truth[:, :3, :3], i, j, turns, protocol == "geodesic")
        proj_px = np.linalg.norm((pixel[i] - pixel[j]) - (pixel_truth[i] - pixel_truth[j]), axis=1)
        far = np.abs((depth[i] - depth[j]) - (depth_truth[i] - depth_truth[j]))
        sums += np.array([np.rad2deg(rot_rad.mean()), 100 * proj_px.mean() / diagonal_px, far.mean()]) / delta
    e_rot, e_proj, e_depth = (sums / len(deltas)).tolist()
    return VelocityErrors(e_rot, e_proj, e_depth)


def frame_distances(count: int, official: bool = False) -> list[int]:
    """Gamma: ten whole numbers linearly spaced from 1 to floor(N / 2).

    The paper's is a set, so short videos have fewer; the official code truncates and counts repeated ones repeatedly.
    """
    if official:
        return [int(delta) for delta in np.linspace(1, count / 2, 10)]
    return sorted({round(float(delta)) for delta in np.linspace(1, count // 2, 10)})


def aligned_origins(estimate: Array, truth: Array, scale_m: float, *, drop_far: bool = False) -> Array:
    """t* (N, 3): the estimate's translations, had its object frame the origin nearest to the truth's (paper, o*).

    scale_m: of the estimated object; the origin moves by half of it at most. drop_far: leave frames out that would
    move it by more than the whole, as the official code does.
    """
    t, t_truth = estimate[:, :3, 3], truth[:, :3, 3]
    on_ray = t_truth * (np.linalg.norm(t, axis=1) / np.linalg.norm(t_truth, axis=1))[:, None]
    offsets = np.einsum("nji,nj->ni", estimate[:, :3, :3], on_ray - t)
    if drop_far:
        near = offsets[np.linalg.norm(offsets, axis=1) < scale_m]
        offsets = near if len(near) else np.zeros((1, 3))
    origin_m = offsets.mean(axis=0)
    length_m = float(np.linalg.norm(origin_m))
    if length_m > scale_m / 2:
        origin_m = origin_m * (scale_m / 2 / length_m)
    return np.asarray(t + estimate[:, :3, :3] @ origin_m)


def pose_errors(
    estimate: Array,
    truth: Array,
    *,
    symmetry: Symmetry | None = None,
    camera_estimate: Array,
    camera_truth: Array,
    image_size_px: tuple[int, int],
    points_m: Array | None = None,
) -> PoseErrors:
    """Errors of poses (N, 4, 4) against the truth's. points_m: (P, 3) of the model, in the object frame of both."""
    estimate, truth = _proper(estimate, truth)
    symmetry = symmetry or Symmetry()
    off_px = np.linalg.norm(
        project(camera_estimate, estimate[:, :3, 3]) - project(camera_truth, truth[:, :3, 3]), axis=1
    )
    model: dict[str, Any] = {}
    if points_m is not None:
        add_m, adds_m = point_distances(estimate, truth, points_m)
        model = {
            "add_m": float(add_m.mean()),
            "adds_m": float(adds_m.mean()),
            "add_auc_percent": area_under_recall(add_m),
            "adds_auc_percent": area_under_recall(adds_m),
            "worst_stretch": longest_run(adds_m > 0.05),
        }
    return PoseErrors(
        float(np.rad2deg(symmetry.error_rad(estimate[:, :3, :3], truth[:, :3, :3]).mean())),
        float(np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1).mean()),
        float(np.rad2deg(aligned_rotation_rad(estimate, truth, symmetry).mean())),
        float(100 * off_px.mean() / np.hypot(*image_size_px)),
        **model,
    )


def aligned_rotation_rad(estimate: Array, truth: Array, symmetry: Symmetry | None = None) -> Array:
    """(N,) angles that remain after the one constant turn of the estimate's object frame that fits best.

    Up to the truth's symmetry; best in the sense of least squares of the chords (the rotations' mean).
    """
    R, R_truth = estimate[:, :3, :3], truth[:, :3, :3]
    symmetry = symmetry or Symmetry()
    if symmetry.order == 0:
        # Only the axis can be seen: the one fixed in the estimate's frame that stays nearest to the truth's.
        seen = np.einsum("nji,nj->ni", R, R_truth @ np.asarray(symmetry.axis))
        axis = seen.mean(axis=0)
        axis = seen[0] if np.linalg.norm(axis) < 1e-9 else axis / np.linalg.norm(axis)
        return angle_between_rad(seen, axis)
    group = symmetry.rotations()
    images = np.einsum("nji,njk,skl->nsil", R, R_truth, group)
    best = None
    # Which image of a symmetric object is meant differs from frame to frame; start from that of a few frames.
    for start in np.linspace(0, len(images) - 1, 1 if len(group) == 1 else 5).astype(int):
        offset = images[start, 0]
        for _ in range(20 if len(group) > 1 else 1):
            nearest = images[np.arange(len(images)), np.argmin(rotation_angle_rad(images, offset), axis=1)]
            offset = Rotation.from_matrix(nearest).mean().as_matrix()
        angles = symmetry.error_rad(R @ offset, R_truth)
        best = angles if best is None or angles.sum() < best.sum() else best
    assert best is not None
    return best


def point_distances(estimate: Array, truth: Array, points_m: Array) -> tuple[Array, Array]:
    """ADD and ADD-S (N,), (N,) in m of model points (P, 3)."""
    add, adds = np.empty(len(estimate)), np.empty(len(estimate))
    tree = cKDTree(points_m)
    for n, (T, T_truth) in enumerate(zip(estimate, truth, strict=True)):
        moved = points_m @ T[:3, :3].T + T[:3, 3]
        add[n] = np.linalg.norm(moved - (points_m @ T_truth[:3, :3].T + T_truth[:3, 3]), axis=1).mean()
        back = invert_pose(T_truth)
        adds[n] = tree.query(moved @ back[:3, :3].T + back[:3, 3])[0].mean()
    return add, adds


def area_under_recall(distance_m: Array, limit_m: float = AUC_LIMIT_M) -> float:
    """Area under recall over threshold from 0 to `limit_m`, in percent: exact, since recall is a step function."""
    return float(100 * np.clip(1.0 - np.asarray(distance_m) / limit_m, 0.0, 1.0).mean())


def longest_run(flags: NDArray[np.bool_]) -> int:
    """Most true values in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, np.int8), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _proper(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """Both with true rotations.

    Annotations are often stored as matrices that are a little off; the angle of such a matrix by its trace jitters by
    degrees where the object stands still.
    """
    if estimate.shape != truth.shape or estimate.ndim != 3 or estimate.shape[1:] != (4, 4) or len(estimate) == 0:
        raise UserError(
            f"the estimate has poses of shape {estimate.shape}, the truth of {truth.shape}; give both as (N, 4, 4)"
        )
    estimate, truth = estimate.copy(), truth.copy()
    for T in (estimate, truth):
        T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    return estimate, truth


def _symmetry_rotations(symmetry: Symmetry, official: bool) -> Array:
    if official and symmetry.order != 1:
        # Whatever the order, about the axis in steps of 3.6 degrees, both ends included.
        angles_rad = np.linspace(-np.pi, np.pi, _OFFICIAL_TURNS)
        return np.asarray(Rotation.from_rotvec(angles_rad[:, None] * np.asarray(symmetry.axis)).as_matrix())
    return symmetry.rotations(_CONTINUOUS_TURNS)


def _turn_differences(
    R: Array, R_truth: Array, i: NDArray[np.int64], j: NDArray[np.int64], turns: Array, geodesic: bool
) -> Array:
    """(P,) difference in rad between the turns of both objects from frames j to frames i, least over the symmetry."""
    turn = R[i] @ np.swapaxes(R[j], 1, 2)
    log = Rotation.from_matrix(turn).as_rotvec()
    least = np.full(len(i), np.inf)
    for S in turns:
        turn_truth = R_truth[i] @ S @ np.swapaxes(R_truth[j], 1, 2)
        if geodesic:
            off = rotation_angle_rad(turn, turn_truth)
        else:
            off = np.linalg.norm(log - Rotation.from_matrix(turn_truth).as_rotvec(), axis=1)
        least = np.minimum(least, off)
    return least
