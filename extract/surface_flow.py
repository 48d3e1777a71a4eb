"""How far a vessel spun between two frames, told by points of its surface that optical flow carries along.

From frame to frame a mesh that is only like the object turns away from it unseen: outline and texture disagree a
little, and every frame adds to that. Over some frames at once, with the body where its outline puts it, the points tell
the spin alone, and that to half a degree, whatever the mesh is like in detail.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array, unproject
from .point_tracks import moved_points
from .raster import DepthWindow
from .region import TrackingMesh

CORNERS, APART_PX, PATCH_PX = 80, 5, 5
LEAST_CORNER = 2e-3  # smaller eigenvalue; shadows, rims and reflections do not turn with a vessel and have weaker ones
INNER_PX = 3  # from the silhouette's outline, least
FLOW_PX = 48  # most that a point moves between frames
LEAST_POINTS, LEAST_SHARE = 8, 0.5  # that agree about a spin
AGREE_PX = 3.0
TRIED_RAD = np.deg2rad(np.arange(-40.0, 41.0))
TURNS = Rotation.from_rotvec(np.outer(TRIED_RAD, [0.0, 0.0, 1.0])).as_matrix()

Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class SurfaceFlow:
    """Where points (N, 2) px of one frame are in another, which is `frames` later, or earlier if that is negative."""

    frames: int
    before_px: Array
    after_px: Array

    @property
    def moved_px(self) -> float:
        """How far the points went, in the median."""
        return float(np.median(np.linalg.norm(self.after_px - self.before_px, axis=1)))


class CarriedPoints:
    """Corners inside the silhouette (H, W) of one frame on their way through those that follow, forward or backward."""

    def __init__(self, grey: Grey, silhouette: NDArray[np.bool_]):
        self._grey, self._frames = grey, 0
        inner = cv2.erode(silhouette.astype(np.uint8), np.ones((2 * INNER_PX + 1,) * 2, np.uint8))
        found = cv2.goodFeaturesToTrack(grey, CORNERS, 0.02, APART_PX, mask=inner, blockSize=PATCH_PX)
        corners = np.zeros((0, 2), np.float32) if found is None else found[:, 0]
        if len(corners):
            strength = cv2.dilate(cv2.cornerMinEigenVal(grey, PATCH_PX), np.ones((3, 3)))
            x, y = np.round(corners).astype(int).T
            corners = corners[strength[y, x] >= LEAST_CORNER]
        self._start = self._now = corners

    def step(self, grey: Grey) -> None:
        """Take the next frame; points whose way back does not end where they came from are dropped."""
        self._frames += 1
        if len(self._now) < LEAST_POINTS:
            return
        low = np.maximum(np.floor(self._now.min(axis=0)).astype(int) - FLOW_PX, 0)
        high = np.ceil(self._now.max(axis=0)).astype(int) + FLOW_PX
        around = np.s_[low[1] : high[1], low[0] : high[0]]
        before, after = np.ascontiguousarray(self._grey[around]), np.ascontiguousarray(grey[around])
        there, sure = moved_points(before, after, self._now - low.astype(np.float32))
        self._start, self._now = self._start[sure > 0], (there + low.astype(np.float32))[sure > 0]
        self._grey = grey

    def flow(self) -> SurfaceFlow | None:
        """From the first frame to the last that was taken; None where too little was carried."""
        if len(self._now) < LEAST_POINTS or self._frames == 0:
            return None
        return SurfaceFlow(self._frames, self._start.astype(float), self._now.astype(float))


def spin_by_flow(
    mesh: TrackingMesh, T_before: Array, T_after: Array, camera_matrix: Array, flow: SurfaceFlow,
    axis_xy_m: tuple[float, float] = (0.0, 0.0),
) -> tuple[float, float]:  # fmt: skip
    """By how much in rad the vessel is spun more than its poses say from the flow's one frame to its other.

    And the share of the points in [0, 1] that agree about that; 0 where too few do (LEAST_SHARE).
    """
    points_m, seen = _lifted(mesh, T_before, camera_matrix, flow.before_px)
    after_px = flow.after_px[seen]
    if len(points_m) < LEAST_POINTS:
        return 0.0, 0.0
    axis_m = np.array([*axis_xy_m, 0.0])
    spun_m = np.einsum("kij,nj->kni", TURNS, points_m - axis_m) + axis_m
    seen_m = spun_m @ T_after[:3, :3].T + T_after[:3, 3]
    pixels = seen_m[..., :2] / seen_m[..., 2:] * np.diag(camera_matrix)[:2] + camera_matrix[:2, 2]
    error_px = np.linalg.norm(pixels - after_px, axis=-1)
    agree = np.maximum(0.0, 1.0 - (error_px / AGREE_PX) ** 2).sum(axis=1)
    best = int(np.argmax(agree))
    if agree[best] < max(LEAST_POINTS, LEAST_SHARE * len(points_m)):
        return 0.0, 0.0
    return float(TRIED_RAD[best]), float(agree[best] / len(points_m))


def _lifted(mesh: TrackingMesh, T: Array, camera_matrix: Array, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points (M, 3) of the mesh, in its own frame, that pixels (N, 2) show, and (N,) which of them show any."""
    window: DepthWindow | None = mesh.drawn(T, camera_matrix)
    if window is None:
        return np.zeros((0, 3)), np.zeros(len(pixels), bool)
    height, width = window.depth_m.shape
    x, y = (np.round(pixels).astype(int) - [window.x0_px, window.y0_px]).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    z = np.where(inside, window.depth_m[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)], 0.0).astype(float)
    seen = z > 0
    return (unproject(camera_matrix, pixels[seen], z[seen]) - T[:3, 3]) @ T[:3, :3], seen
