"""Textured points: what the object showed in a few key views, drawn anew at the predicted pose and matched there.

A key view is a frame whose pose is known well. Its picture is carried over the mesh to the pose that is predicted, so
that little motion is left for pyramidal Lucas-Kanade flow whatever the turn since, and every match ties a pixel of the
new frame to a point of the mesh as the key view has it. Flow forth and back must agree, and RANSAC over poses must
agree with the rest. With the object's own mesh nothing is chained from frame to frame. A mesh that is only like the
object puts its points at depths that are a little wrong, which shows the more the farther the object has turned since
the key view: there such views count less, and the frame before is a view as well.

A mirror-bright object shows its surroundings, which move otherwise than it does. `trust` learns from every frame
whether the matches are rigid and whether they contradict the outline; what is not trusted is measured but not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, angle_between_rad, invert_pose, make_pose, unproject
from .raster import DepthWindow
from .region import Points, TrackingMesh
from .region_kernels import draw_view, solve_pose
from .segment import Mask
from .video import Image

FLATTEN_PX = 8.0  # shading and exposure, wider than this, are taken out of the pictures
CORNERS = 70  # a view
ERODE_PX, PATCH_PX = 3, 15
FORTH_AND_BACK_PX = 0.7
ALIKE = 0.5  # mean difference of two patches, in their mean contrast
RANSAC_PX, RANSAC_ROUNDS = 2.5, 40
POINT_STD_PX = 0.5
UNLIKE = 0.15  # of its radius, by which points of a mesh that is only like the object are off in depth
CHAIN_STD_PX = 1.0  # more for the frame before: what is chained drifts, which outline and key views must mend
ENOUGH = 12  # inliers that say something
VIEWS_APART_RAD = np.deg2rad(12)
VIEWS_REACH_RAD = np.deg2rad(35)
MOST_VIEWS = 48
FIRST_TRUST, TRUST_RATE = 0.4, 0.15
MANY, BEYOND_DOUBT = 30, (0.85, 0.95)
RIGID_SHARE = (0.45, 0.85)  # of the matches that RANSAC keeps: not trusted below, fully above
STRAIN = (0.05, 0.4)  # squared standard deviations a line that the points cost the outline: trusted below, not above


@dataclass(frozen=True)
class KeyView:
    """A frame that others are matched to: flattened grey picture, its camera, the pose and the mesh's depth there.

    side: (3,) which side of the object it shows, see `_towards`.
    """

    picture: NDArray[np.uint8]
    camera_matrix: Array
    T_camera_object: Array
    depth: DepthWindow
    side: Array


@dataclass(frozen=True)
class Matches:
    """Points found in a frame that agree with one pose, the share of all matches that did, and that pose.

    keyed: (N,) which of the points a key view had; those of the frame before agree with wrong poses as well.
    """

    points: Points
    rigid_share: float
    T_camera_object: Array | None
    keyed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.points.weight)


NO_MATCHES = Matches(Points.none(), 0.0, None, np.zeros(0, bool))


class Texture:
    """The key views of one object and how far its texture is trusted, in [0, 1].

    exact: whether the mesh is the object's own, or only like it.
    """

    def __init__(self, mesh: TrackingMesh, exact: bool = True):
        self.mesh, self.trust = mesh, FIRST_TRUST
        self.views: list[KeyView] = []
        self._before: KeyView | None = None
        self._off_m = 0.0 if exact else UNLIKE * mesh.radius_m

    def match(self, picture: NDArray[np.uint8], camera_matrix: Array, T_predicted: Array) -> Matches:
        """Match a flattened picture against the nearest key view, the oldest near enough and the frame before."""
        views = self._views_for(T_predicted)
        if self._before is not None:
            views.append(self._before)
        depth = self.mesh.drawn(T_predicted, camera_matrix) if views else None
        if depth is None:
            return NO_MATCHES
        found = [_matched(view, picture, camera_matrix, T_predicted, depth) for view in views]
        object_m = np.concatenate([points for points, _ in found])
        pixel = np.concatenate([pixels for _, pixels in found])
        std_px = np.repeat(self._std_px(views, T_predicted, camera_matrix), [len(f[1]) for f in found])
        if len(pixel) < ENOUGH:
            return NO_MATCHES
        cv2.setRNGSeed(0)  # RANSAC draws from OpenCV's global generator
        try:
            good, _, _, kept = cv2.solvePnPRansac(
                object_m, pixel, camera_matrix, None, iterationsCount=RANSAC_ROUNDS, reprojectionError=RANSAC_PX,
                flags=cv2.SOLVEPNP_AP3P,
            )  # fmt: skip
        except cv2.error:
            return NO_MATCHES
        if not good or kept is None or len(kept) < ENOUGH:
            return replace(NO_MATCHES, rigid_share=0.0 if kept is None else len(kept) / len(pixel))
        kept = kept[:, 0]
        points = Points(object_m[kept], pixel[kept], (self.trust / std_px[kept]) ** 2)
        keyed = np.repeat([view is not self._before for view in views], [len(f[1]) for f in found])[kept]
        return Matches(points, len(kept) / len(pixel), _pose_from(points, camera_matrix, T_predicted), keyed)

    def judge(self, matches: Matches, strain: float) -> None:
        """Learn from a frame: were there matches, did they move like one rigid body, did the outline object?"""
        if matches.rigid_share == 0.0:
            return
        rigid = np.interp(matches.rigid_share, RIGID_SHARE, (0.0, 1.0))
        calm = np.interp(strain, STRAIN, (1.0, 0.0))
        if len(matches) >= MANY:
            # So many points that move as one are no reflections: it is the outline that is hidden, or the mesh rough.
            calm = max(calm, np.interp(matches.rigid_share, BEYOND_DOUBT, (0.0, 1.0)))
        self.trust += TRUST_RATE * float(rigid * calm - self.trust)

    def keep(
        self,
        picture: NDArray[np.uint8],
        camera_matrix: Array,
        T_camera_object: Array,
        ours: Mask | None = None,
        key: bool = True,
    ) -> None:
        """Keep a frame to match the next one to, and as a key view if no other shows the object from nearly that side.

        ours: (H, W) where it shows the object, and nothing that hides it; all of the silhouette when not given.
        """
        apart = _apart(T_camera_object, self.views)
        key = key and len(self.views) < MOST_VIEWS and bool((apart >= VIEWS_APART_RAD).all())
        if not (key or self._off_m > 0.0):
            return
        depth = self.mesh.drawn(T_camera_object, camera_matrix)
        if depth is None:
            return
        depth = depth if ours is None else depth.only(ours)
        view = KeyView(picture, camera_matrix, T_camera_object, depth, _towards(T_camera_object))
        if key:
            self.views.append(view)
        if self._off_m > 0.0:
            self._before = view

    def _std_px(self, views: Sequence[KeyView], T: Array, camera_matrix: Array) -> Array:
        """(N,) standard deviation of where each view's points are in a frame, whose pose is about T."""
        off_px = self._off_m * np.sin(_apart(T, views)) * camera_matrix[0, 0] / T[2, 3]
        chained = [CHAIN_STD_PX if view is self._before else 0.0 for view in views]
        return np.asarray(np.hypot(np.hypot(POINT_STD_PX, off_px), chained))

    def _views_for(self, T: Array) -> list[KeyView]:
        """The oldest of the views that show nearly the same side as a pose does, and the nearest."""
        angles = _apart(T, self.views)
        near = np.flatnonzero(angles < VIEWS_REACH_RAD)
        if len(near) == 0:
            return []
        return [self.views[k] for k in sorted({int(near[0]), int(np.argmin(angles))})]


def flattened(rgb: Image) -> NDArray[np.uint8]:
    """(H, W) grey picture without slow shading."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.addWeighted(grey, 1.0, cv2.blur(grey, (int(2 * FLATTEN_PX) + 1,) * 2), -1.0, 128.0))


def _matched(
    view: KeyView, picture: NDArray[np.uint8], camera_matrix: Array, T: Array, depth: DepthWindow
) -> tuple[Array, Array]:
    """Points of the mesh (N, 3) and their pixels (N, 2) in the picture, found with one key view."""
    drawn, covered = np.full(picture.shape, 128, np.uint8), np.zeros(picture.shape, np.uint8)
    draw_view(
        depth.depth_m, depth.x0_px, depth.y0_px, camera_matrix, view.T_camera_object @ invert_pose(T),
        view.depth.depth_m, view.depth.x0_px, view.depth.y0_px, view.picture, view.camera_matrix, drawn, covered,
    )  # fmt: skip
    if not covered.any():
        return np.zeros((0, 3)), np.zeros((0, 2))
    # Corners and contrast are looked for where something was drawn, and as far around it as they are told by.
    h, w = depth.depth_m.shape
    x0, y0 = max(depth.x0_px - PATCH_PX, 0), max(depth.y0_px - PATCH_PX, 0)
    around = np.s_[y0 : max(depth.y0_px + h + PATCH_PX, 0), x0 : max(depth.x0_px + w + PATCH_PX, 0)]
    inner = cv2.erode(covered[around], np.ones((2 * ERODE_PX + 1,) * 2, np.uint8))
    found: NDArray[Any] | None = cv2.goodFeaturesToTrack(drawn[around], CORNERS, 0.02, 4, mask=inner, blockSize=5)
    if found is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    corners = found + np.array([x0, y0], np.float32)
    there, ok, unlike = _flow(drawn, picture, corners)
    # Sensor noise has corners as well, and flow that stays where it is: only patches that look alike are matches.
    x, y = np.round(corners[:, 0]).astype(int).T
    contrast = cv2.blur(np.abs(drawn[around].astype(np.float32) - 128), (PATCH_PX, PATCH_PX))[y - y0, x - x0]
    good = (ok[:, 0] > 0) & (unlike[:, 0] < ALIKE * contrast)
    if not good.any():
        return np.zeros((0, 3)), np.zeros((0, 2))
    corners, there, x, y = corners[good], there[good], x[good], y[good]
    back, ok, _ = _flow(picture, drawn, there)
    good = (ok[:, 0] > 0) & (np.linalg.norm(back - corners, axis=2)[:, 0] < FORTH_AND_BACK_PX)
    corners, there, x, y = corners[good, 0].astype(float), there[good, 0].astype(float), x[good], y[good]
    z = depth.depth_m[y - depth.y0_px, x - depth.x0_px].astype(float)
    return (unproject(camera_matrix, corners, z) - T[:3, 3]) @ T[:3, :3], there


def _flow(
    one: NDArray[np.uint8], other: NDArray[np.uint8], corners: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Where corners (N, 1, 2) of one picture are in the other, (N, 1) whether found, and mean difference there."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03)
    start = corners.copy()
    return cv2.calcOpticalFlowPyrLK(
        one, other, corners, start, winSize=(PATCH_PX, PATCH_PX), maxLevel=2, criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip


def _pose_from(points: Points, camera_matrix: Array, T_near: Array) -> Array:
    """The pose that fits the points, held to one nearby in what they do not say."""
    turn, shift, information = T_near[:3, :3].copy(), T_near[:3, 3].copy(), np.zeros((6, 6))
    distance = float(np.linalg.norm(shift))
    prior = np.diag([1 / 0.3**2] * 3 + [1 / (0.05 * distance) ** 2] * 3)
    no_line, none = np.zeros((0, 3)), np.zeros((0, 2))
    solve_pose(
        no_line, none, none, np.zeros(0), 1.0, points.object_m, points.pixel, np.ones(len(points.weight)),
        10 * RANSAC_PX + 40.0, camera_matrix, T_near, prior, 6, turn, shift, information,
    )  # fmt: skip
    return make_pose(turn, shift)


def _apart(T: Array, views: Sequence[KeyView]) -> Array:
    """(N,) angles in rad between the side of the object that a pose shows and those that views show."""
    return angle_between_rad(_towards(T), np.array([view.side for view in views]).reshape(-1, 3))


def _towards(T: Array) -> Array:
    """Unit direction (3,) from the camera to the object's origin, in the object's frame: the side that is seen."""
    direction = T[:3, :3].T @ T[:3, 3]
    return np.asarray(direction / np.linalg.norm(direction))
