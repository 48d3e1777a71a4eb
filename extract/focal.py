"""The focal length that a clip itself tells: how much nearer parts of an object look larger than farther ones.

With a wrong focal length the outline of an exactly known mesh still fits in place and size, the object only being put
nearer or farther, but not in perspective: what juts towards the camera comes out too large or too small. One frame
says little of that and is easily misled, so the poses of several frames, seen from different sides and distances, and
one focal length are fitted together: Gauss-Newton on the outlines of all, in which every pose is eliminated (Schur
complement). Stretches of the clip are also the measure of the uncertainty: what each would have the focal length be
scatters, whatever the reason, and that scatter is what is reported (clustered sandwich estimator; White, Econometrica
1980), with what no clip shows of itself added: 3 clips of the synthetic ones were 1, 8 and 9 % off.

What it cannot know is whether the poses it began with were right: an object that is nearly the same turned round, taken
for its other side, gives a sharp and wrong answer. So who uses it follows the object again with what was found and asks
a second time (`agree`), and takes nothing that no ordinary camera has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .colours import ColourModel, colour_bins
from .follow import Followed
from .geometry import Array, make_pose, project, transform_points
from .region import Lines, TrackingMesh, edge_strength, measure, refine
from .video import Frame, VideoInfo, sample_frames

FRAMES = 20  # looked at
ROUNDS = 8
STEPS_PX = (3.0, 2.0, 1.0)
LONGEST_STEP = 0.25  # of log f in a round: beyond, a pose carried along is no good start
CONVERGED = 0.3  # standard deviations: measuring anew, the lines tremble by less
PRIOR_STD = 0.35  # of log f about sqrt(w^2 + h^2): lenses from very wide to short tele
AGREE_PX, AGREEING_SHARE = 2.0, 0.75  # a view whose outline does not fit tells nothing
FEWEST_VIEWS = 5
STRETCHES = 5  # of the clip, whose disagreement is the uncertainty
SURE_VIEW = 0.8  # least confidence of a frame that is asked
SHARED_STD = 0.06  # of log f, what errs alike in all frames: colours learned along a wrong outline, a hand, a shadow
TRUSTED_STD = 0.12  # of log f, a third of the prior's
BELIEVABLE = (0.45, 2.5)  # times the prior: 96 to 23 degrees over the diagonal
CONTRADICTED_STD = 2.0
AGREE_STD = 2.5  # standard deviations of their difference that two estimates may lie apart
MARGIN_PX = 40  # around the object, of what is kept of a frame


@dataclass(frozen=True)
class FocalView:
    """What is kept of a frame around the object: colour bins (H, W), edges (H, W, 2), the pixel of their corner in the
    frame, and the object's pose."""

    bins: NDArray[np.int32]
    edges: NDArray[np.float32]
    corner_px: tuple[int, int]
    T_camera_object: Array

    @staticmethod
    def of(frame: Frame, mesh: TrackingMesh, camera_matrix: Array, T_camera_object: Array) -> FocalView | None:
        """A frame with the pose of the mesh in it; None when that is not before the camera and in the picture."""
        points = transform_points(T_camera_object, mesh.centres_m)
        if points[:, 2].min() < 1e-3:
            return None
        pixel = project(camera_matrix, points)
        height, width = frame.rgb.shape[:2]
        x_a, y_a = np.clip(pixel.min(axis=0) - MARGIN_PX, 0, (width, height)).astype(int)
        x_b, y_b = np.clip(pixel.max(axis=0) + MARGIN_PX, 0, (width, height)).astype(int)
        if min(x_b - x_a, y_b - y_a) < MARGIN_PX:
            return None
        part = np.ascontiguousarray(frame.rgb[y_a:y_b, x_a:x_b])
        return FocalView(colour_bins(part), edge_strength(part), (int(x_a), int(y_a)), T_camera_object)


@dataclass(frozen=True)
class FocalEstimate:
    """A focal length as `factor` times that of the camera it began with; log_std: the standard deviation of its
    logarithm; views: how many frames told it."""

    factor: float
    log_std: float
    views: int

    @property
    def std(self) -> float:
        """The standard deviation in the unit of `factor`."""
        return self.factor * self.log_std

    def trusted(self, of_prior: float) -> bool:
        """Whether it is sure enough and a focal length that cameras have. of_prior: the focal length over the prior."""
        return self.log_std < TRUSTED_STD and BELIEVABLE[0] < of_prior < BELIEVABLE[1]

    @property
    def contradicts(self) -> bool:
        """Whether the camera that it began with is hardly the right one."""
        return bool(abs(np.log(self.factor)) > CONTRADICTED_STD * self.log_std)

    def agree(self, again: FocalEstimate) -> bool:
        """Whether an estimate that began with this one's result stays there."""
        return bool(abs(np.log(again.factor)) < AGREE_STD * np.hypot(self.log_std, again.log_std))


def with_focal(T_camera_object: Array, factor: float) -> Array:
    """The pose that shows an object in the same place, size and from the same side when the focal length is `factor`
    times as long: farther away by it, and turned with the ray to it."""
    t = T_camera_object[:3, 3]
    moved = t * [1.0, 1.0, factor]
    turn, _ = Rotation.align_vectors(moved / np.linalg.norm(moved), t / np.linalg.norm(t))
    return make_pose(turn.as_matrix() @ T_camera_object[:3, :3], moved)


def scaled_focal(camera_matrix: Array, factor: float) -> Array:
    """The camera (3, 3) with a focal length `factor` times as long."""
    return np.asarray(camera_matrix * [[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])


def focal_of_clip(info: VideoInfo, followed: Followed, side_px: int, of_prior: float = 1.0) -> FocalEstimate | None:
    """What frames spread over a clip tell of its focal length, where an object was followed with an exact mesh.

    side_px: longer side of the pictures that it was followed in; of_prior: its focal length over the prior.
    """
    views = []
    for frame in sample_frames(info, FRAMES, side_px):
        if frame.index >= len(followed.estimates):
            continue
        found = followed.estimates[frame.index]
        if found.visible and found.confidence >= SURE_VIEW:
            views.append(FocalView.of(frame, followed.mesh, followed.camera_matrix, found.T_camera_object))
    kept = [view for view in views if view is not None]
    colours, log_prior = followed.tracker.colours, -float(np.log(of_prior))
    return estimate_focal(followed.mesh, colours, kept, followed.camera_matrix, log_prior)


def estimate_focal(
    mesh: TrackingMesh,
    colours: ColourModel,
    views: Sequence[FocalView],
    camera_matrix: Array,
    log_prior: float = 0.0,
) -> FocalEstimate | None:
    """The focal length that fits the outlines in all views best; None when fewer than FEWEST_VIEWS can be used.

    camera_matrix: (3, 3) px, what the views' poses belong to.  log_prior: the logarithm of the focal length expected,
    over that of the camera.
    """
    log_f, poses = 0.0, [view.T_camera_object for view in views]
    for number in range(ROUNDS):
        camera = scaled_focal(camera_matrix, float(np.exp(log_f)))
        told = [_told(mesh, colours, view, T, camera) for view, T in zip(views, poses, strict=True)]
        if sum(t is not None for t in told) < FEWEST_VIEWS:
            return None
        terms = np.array([t[:2] for t in told if t is not None])
        g, h = (terms * _weights(terms)[:, None]).T
        step = float((g.sum() + (log_prior - log_f) / PRIOR_STD**2) / (h.sum() + 1 / PRIOR_STD**2))
        # Neighbouring frames err alike: the same fingers hide the same side.
        stretches = np.array_split(g - h * g.sum() / h.sum(), STRETCHES)
        scatter = np.array([stretch.sum() for stretch in stretches])
        variance = (scatter @ scatter) / h.sum() ** 2 * STRETCHES / (STRETCHES - 1) + 1 / h.sum()
        if abs(step) < CONVERGED * np.sqrt(variance) and number > 0:
            break
        step = float(np.clip(step, -LONGEST_STEP, LONGEST_STEP))
        poses = [with_focal(T if t is None else t[2], float(np.exp(step))) for T, t in zip(poses, told, strict=True)]
        log_f += step
    return FocalEstimate(float(np.exp(log_f)), float(np.hypot(np.sqrt(variance), SHARED_STD)), len(terms))


def _told(
    mesh: TrackingMesh, colours: ColourModel, view: FocalView, T: Array, camera_matrix: Array
) -> tuple[float, float, Array] | None:
    """What a view says of log f, its pose being free: gradient and information; and the pose refined at the camera.

    None when the outline does not fit.
    """
    camera = camera_matrix.copy()
    camera[:2, 2] -= view.corner_px
    T = refine(
        mesh, T, camera, view.bins, colours, steps_px=STEPS_PX, edges=view.edges,
        prior_rotation_rad=0.5, prior_translation=0.5, prior_depth=0.5,
    ).T_camera_object  # fmt: skip
    lines = measure(mesh, T, camera, view.bins, colours, STEPS_PX[-1], view.edges)
    if lines is None:
        return None
    offset_px, _ = lines.residuals(T, camera)
    if np.mean(np.abs(offset_px) < AGREE_PX) < AGREEING_SHARE:
        return None
    return *_free_of_pose(lines, T, camera), T


def _free_of_pose(lines: Lines, T: Array, camera_matrix: Array) -> tuple[float, float]:
    """Gradient and information of log f over lines, of what no change of the pose can imitate."""
    offset_px, by_pose = lines.residuals(T, camera_matrix)
    weight = lines.weights(offset_px)
    pixel = project(camera_matrix, transform_points(T, lines.outline.point_object_m))
    by_focal = np.sum(lines.outline.normal * (pixel - camera_matrix[:2, 2]), axis=1)
    root = np.sqrt(weight)[:, None]
    unit = by_pose * root
    unit /= np.maximum(np.linalg.norm(unit, axis=0), 1e-12)
    imitated = np.linalg.lstsq(unit, by_focal * root[:, 0], rcond=1e-6)[0]
    rest = by_focal * root[:, 0] - unit @ imitated
    return float(rest @ (root[:, 0] * offset_px)), float(max(rest @ rest, 1e-9))


def _weights(terms: Array) -> Array:
    """(N,) in [0, 1]: less for a view far from what most say, and for one that would outweigh all the others."""
    change, information = terms[:, 0] / terms[:, 1], terms[:, 1]
    off = np.abs(change - np.median(change))
    spread = 1.48 * float(np.median(off)) + 1 / np.sqrt(information)
    return np.asarray(np.minimum(1.0, 3 * np.median(information) / information) / (1 + (off / (2 * spread)) ** 2))
