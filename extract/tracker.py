"""Follow one object from frame to frame: predict, refine against the frame, learn its colours, judge the result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .first_pose import share_on_edges
from .geometry import Array, project, transform_points
from .region import ColourModel, Outline, TrackingMesh, colour_bins, edge_strength, extract_outline, measure, refine
from .segment import Mask
from .video import Image

LEARNING_RATE = 0.15
LEARN_ABOVE = 0.35  # a frame the tracker is unsure of teaches it nothing
LOST_BELOW = 0.2
VELOCITY_KEPT = 0.7  # hands accelerate: half-trusting the last velocity beats trusting it or ignoring it
SEARCH_STEPS_PX = (9.0, 7.0, 5.0, 3.0, 2.0, 1.0)


@dataclass(frozen=True)
class Estimate:
    """Pose of the object in one frame, how sure it is in [0, 1], whether the object is in view, and its outline."""

    T_camera_object: Array
    confidence: float
    visible: bool
    outline: Outline | None = None


class ObjectTracker:
    """Tracks one mesh through the frames of one video, starting from a pose and a mask in one frame.

    camera_matrix and all images are at the working resolution.
    """

    def __init__(self, mesh: TrackingMesh, camera_matrix: Array, rgb: Image, mask: Mask, T_camera_object: Array):
        self.mesh, self.camera_matrix = mesh, camera_matrix
        self.colours = ColourModel()
        self._pose = self._before = T_camera_object
        bins = colour_bins(rgb)
        near = cv2.dilate(mask.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
        self.colours.start_global(bins[mask], bins[near & ~mask])
        outline = extract_outline(mesh, T_camera_object, camera_matrix, (mask.shape[0], mask.shape[1]))
        if outline is not None:
            self.colours.update(outline, mesh, bins, 1.0)

    def step(self, rgb: Image, guess: Array | None = None) -> Estimate:
        """Pose in the next frame, refined from `guess` or else from where the motion so far leads."""
        bins = colour_bins(rgb)
        strength = edge_strength(rgb)
        best = self._refined(self._predicted() if guess is None else guess, bins, strength)
        if best.confidence < LOST_BELOW and guess is None:
            # A wider search, from the prediction and from where the object was seen last.
            for start in (self._predicted(), self._pose):
                wide = self._refined(start, bins, strength, SEARCH_STEPS_PX, freedom=3.0)
                best = max(best, wide, key=lambda e: e.confidence)
        if best.confidence >= LOST_BELOW:
            self._before, self._pose = self._pose, best.T_camera_object
        else:
            self._before = self._pose
            best = Estimate(self._pose if guess is None else guess, best.confidence, False)
        if best.confidence >= LEARN_ABOVE and best.outline is not None:
            self.colours.update(best.outline, self.mesh, bins, LEARNING_RATE)
        return replace(best, outline=None)  # a clip's worth of outlines would be kept otherwise

    def _predicted(self) -> Array:
        """Constant velocity, damped."""
        T = self._pose.copy()
        T[:3, 3] += VELOCITY_KEPT * (self._pose[:3, 3] - self._before[:3, 3])
        turn = Rotation.from_matrix(self._pose[:3, :3] @ self._before[:3, :3].T).as_rotvec()
        T[:3, :3] = Rotation.from_rotvec(VELOCITY_KEPT * turn).as_matrix() @ T[:3, :3]
        return T

    def _refined(
        self,
        start: Array,
        bins: NDArray[np.int32],
        strength: NDArray[np.float32],
        steps_px: tuple[float, ...] = (5.0, 3.0, 2.0, 1.0, 1.0),
        freedom: float = 1.0,
    ) -> Estimate:
        result = refine(
            self.mesh, start, self.camera_matrix, bins, self.colours, steps_px=steps_px,
            prior_rotation_rad=0.03 * freedom, prior_spin_rad=0.02 * freedom,
            prior_translation=0.02 * freedom, prior_depth=0.01 * freedom,
            edges=strength,
        )  # fmt: skip
        T = result.T_camera_object
        in_view = self._share_in_view(T, bins.shape[1], bins.shape[0])
        outline = extract_outline(self.mesh, T, self.camera_matrix, (bins.shape[0], bins.shape[1]))
        if in_view < 0.1 or outline is None:
            return Estimate(T, 0.0, False)
        confidence = self._confidence(T, outline, bins, strength) * min(1.0, 2 * in_view)
        return Estimate(T, confidence, True, outline)

    def _confidence(self, T: Array, outline: Outline, bins: NDArray[np.int32], strength: NDArray[np.float32]) -> float:
        """Mean of two shares: lines whose colours put the outline within 2 px of it, and outline on image edges."""
        lines = measure(self.mesh, T, self.camera_matrix, bins, self.colours, 1.0, outline=outline)
        if lines is None:
            return 0.0
        offset_px, _ = lines.residuals(T, self.camera_matrix)
        agree = np.mean((np.abs(offset_px) < 2.0) & (lines.variance_px2 < 9.0))
        return float(0.5 * agree + 0.5 * share_on_edges(outline, strength))

    def _share_in_view(self, T: Array, width: int, height: int) -> float:
        """Share of the mesh's vertices that project into the image."""
        points = transform_points(T, self.mesh.vertices_m)
        if points[:, 2].min() < 1e-3:
            return 0.0
        x, y = project(self.camera_matrix, points).T
        return float(np.mean((x >= 0) & (x < width) & (y >= 0) & (y < height)))
