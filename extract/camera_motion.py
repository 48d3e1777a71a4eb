"""Does the camera move, and how: read from the background, one frame at a time.

Corners outside the objects are followed from a key frame by sparse optical flow there and back, and a homography is
fitted to them robustly. It is exact for a camera that only turns and for a flat background; a hand-held camera's
small sway is near enough to the first, a moving one in a deep scene is neither, which the quality tells. When a key
frame has lost its corners the present frame takes its place; homographies are chained over key frames, not frames.
Corners that are left keep their numbers, and where each was seen is kept for `camera_path`, which tells how the camera
moved through such a scene: everything in frames that show something new, a few dozen in those between.

While the camera stands, only some frames are looked at. Where one of them shows that it has moved, those before it
that were passed over are gone through after all, so that no motion begins late.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Array, make_pose, scaled_camera
from .segment import Box, Mask
from .video import Image

WORKING_SIDE_PX = 640
MOST_CORNERS = 400
FEWEST_CORNERS = 25
KEPT_SHARE = 0.45  # of a key frame's corners; with fewer the present frame becomes the key frame
ROUND_TRIP_PX = 0.5
INLIER_PX = 1.5
STILL_PX, STILL_SHARE = 0.5, 0.3  # so many corners that have not moved mean a still camera: the others are things
STATIC_SHARE = 0.004  # of the diagonal: background that never strays farther, in its 95th percentile, stands still
OBJECT_MARGIN = 0.15  # of the box, left out around it: hands and shadows move with the object
NEW_VIEW_SHARE = 0.02  # of the longer side, that corners have moved since the last frame of which everything is kept
STANDS_SHARE = 0.9  # of the corners, far and near, that have not moved: then the camera has not
KEPT_BETWEEN = 60  # corners of a frame between those
CALM_SHARE = 0.5  # of the corners that have not moved, in frames in which the camera stands surely
CALM_FRAMES, LOOK_EVERY = 12, 6  # a camera that stood so long is looked at in every sixth frame, until it moves
TURN_SHARE = 0.85  # of the corners that fit a homography: when so many fit a rotation too, it is a rotation


@dataclass(frozen=True)
class CameraMotion:
    """How the camera moved against the first frame.

    H_frame_first: (N, 3, 3) homographies in pixels of the video, from the first frame to each frame, H[2, 2] = 1.
    R_camera_first: (N, 3, 3) the rotations that fit best: directions in the first camera's frame, in each one's.
    quality: (N,) in [0, 1], share of the followed corners that agree with the homography; 0 where none could be
        followed and the last motion was kept.
    turn_quality: (N,) the same share for the rotation: much less for a camera that moves sideways.
    static: the background stays where it was, to 0.4% of the diagonal, in 95% of the frames that could be judged;
        also when none could, for want of anything to see there.
    stray_px: how far the image's corners wander, 95th percentile over those frames, in px of the video.
    rotates_only: not static, and a rotation explains the motion as well as a homography does.
    """

    H_frame_first: Array
    R_camera_first: Array
    quality: Array
    turn_quality: Array
    static: bool
    stray_px: float
    rotates_only: bool

    @property
    def T_first_camera(self) -> Array:
        """(N, 4, 4) pose of each frame's camera in the first frame's, for a camera that turns in place."""
        return np.stack([make_pose(R.T) for R in self.R_camera_first])


@dataclass(frozen=True)
class Sighting:
    """Where corners are in one frame.

    ids: (M,) numbers of the corners, the same in every frame.  pixels: (M, 2) of the frames worked on.
    view: everything was kept, because the frame shows the scene from a new side. While the camera stands, its frames
    share one sighting.
    """

    ids: NDArray[np.int32]
    pixels: NDArray[np.float32]
    view: bool


@dataclass
class _KeyFrame:
    """A frame that corners are followed from: its motion, how many corners it had, those left, then and now."""

    H_key_first: Array
    R_key_first: Array
    grey: Image
    count: int
    ids: NDArray[np.int32]
    start: NDArray[np.float32]
    now: NDArray[np.float32]


@dataclass
class CameraWatch:
    """Watches the background of a clip frame by frame; `result` may be asked for at any time.

    camera_matrix: (3, 3) at the size of the frames given to `step`. Of each frame its homography is kept, and its
    `sightings`: None where no corner could be followed; complete when `result` has been asked for.
    """

    camera_matrix: Array
    sightings: list[Sighting | None] = field(default_factory=list)
    _key: _KeyFrame | None = None
    _before: Image | None = None
    _shape: tuple[int, int] = (0, 0)
    _scale: float = 1.0
    _H: list[Array] = field(default_factory=list)
    _R: list[Array] = field(default_factory=list)
    _quality: list[tuple[float, float]] = field(default_factory=list)
    _view: Sighting | None = None
    _next_id: int = 0
    _calm: int = 0  # frames that it has stood for
    _passed: list[tuple[Image, Mask | None, list[Box]]] = field(default_factory=list)  # over, and the one at hand

    @property
    def working_camera(self) -> Array:
        """(3, 3) at the size of the frames worked on, that of the sightings."""
        return scaled_camera(self.camera_matrix, self._scale)

    def step(self, rgb: Image, leave_out: Mask | None = None, boxes: list[Box] | None = None) -> None:
        """Take the next frame, (H, W, 3).

        leave_out: (H, W) true where moving objects are; boxes: x, y, width, height of such objects, in px.
        """
        self._scale = min(1.0, WORKING_SIDE_PX / max(rgb.shape[:2]))
        self._shape = (rgb.shape[0], rgb.shape[1])
        self._passed.append((rgb, leave_out, boxes or []))
        if self._calm < CALM_FRAMES or len(self._passed) == LOOK_EVERY:
            self._settle()

    def _settle(self) -> None:
        """Look at the last frame, and at those passed over before it if the camera does not stand there any more."""
        passed, self._passed = self._passed, []
        if len(passed) > 1:
            assert self._key is not None
            histories: list[list[Any]] = [self._H, self._R, self._quality, self.sightings]
            known = len(self._H)
            kept = replace(self._key), self._before, self._view, self._next_id
            self._look(*passed[-1])
            if self._calm:
                self._calm += len(passed) - 1
                for history in histories:
                    history += history[known:] * (len(passed) - 1)
                return
            self._key, self._before, self._view, self._next_id = kept
            for history in histories:
                del history[known:]
        for frame in passed:
            self._look(*frame)

    def _look(self, rgb: Image, leave_out: Mask | None, boxes: list[Box]) -> None:
        """What one frame tells, against those before it."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._scale < 1.0:
            grey = cv2.resize(grey, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)
        image = np.asarray(grey, np.uint8)
        background = self._background(image, leave_out, boxes)
        key, seen = self._key, self._view
        H, R, quality, turn_quality = np.eye(3), np.eye(3), 1.0, 1.0
        if self._key is not None and self._before is not None:
            H, R, quality, turn_quality = self._followed(self._key, self._before, image, background)
        if self._key is None or quality == 0.0 or len(self._key.now) < KEPT_SHARE * self._key.count:
            self._renew(H, R, image, background, followed=quality > 0)
        self._note()
        self._before = image
        self._H.append(H)
        self._R.append(R)
        self._quality.append((quality, turn_quality))
        same = key is self._key and self._view is seen
        stands = same and key is not None and H is key.H_key_first and _still_share(key) > CALM_SHARE
        self._calm = self._calm + 1 if stands else 0

    def result(self) -> CameraMotion:
        """The motion so far. Raises ValueError before the first frame."""
        self._settle()
        if not self._H:
            raise ValueError("no frame was watched")
        up = np.diag([1 / self._scale, 1 / self._scale, 1.0])
        H = up @ np.stack(self._H) @ np.linalg.inv(up)
        H /= H[:, 2:, 2:]
        quality, turn_quality = np.array(self._quality).T
        height, width = self._shape
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
        stray = np.stack([np.linalg.norm(_moved(h, corners) - corners, axis=1).mean() for h in H])
        judged = quality > 0
        stray_px = float(np.percentile(stray[judged], 95)) if judged.any() else 0.0
        static = stray_px <= STATIC_SHARE * float(np.hypot(width, height))
        rotates_only = not static and bool(np.median(turn_quality[judged] / quality[judged]) >= TURN_SHARE)
        return CameraMotion(H, np.stack(self._R), quality, turn_quality, static, stray_px, rotates_only)

    def _background(self, image: Image, leave_out: Mask | None, boxes: list[Box]) -> Image:
        """255 where corners may be looked for."""
        height, width = image.shape
        free = np.full((height, width), 255, np.uint8)
        if leave_out is not None:
            mask = cv2.resize(leave_out.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
            radius = max(4, round(0.02 * max(height, width)))
            free[cv2.dilate(mask, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)) > 0] = 0
        for box in boxes:
            x, y, w, h = (v * self._scale for v in box)
            mx, my = OBJECT_MARGIN * w, OBJECT_MARGIN * h
            top, left = max(int(y - my), 0), max(int(x - mx), 0)
            free[top : max(int(y + h + my), 0), left : max(int(x + w + mx), 0)] = 0
        return free

    def _followed(
        self, key: _KeyFrame, before: Image, image: Image, background: Image
    ) -> tuple[Array, Array, float, float]:
        """Homography and rotation from the first frame and their qualities; forgets the corners that were lost."""
        lost = self._H[-1], self._R[-1], 0.0, 0.0
        if len(key.now) < FEWEST_CORNERS // 2:
            return lost
        now, there = _flow(before, image, key.now)
        # The key frame decides, so that nothing drifts from frame to frame.
        settled, back = _flow(image, key.grey, now, key.start)
        height, width = image.shape
        x, y = np.round(np.nan_to_num(now, nan=-1.0)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        free = np.zeros(len(now), bool)
        free[inside] = background[y[inside], x[inside]] > 0
        good = there & back & free & (np.linalg.norm(settled - key.start, axis=1) < ROUND_TRIP_PX)
        if good.sum() < FEWEST_CORNERS // 2:
            return lost
        # What has slid from frame to frame is put back by as much as it misses in the key frame: small slips all lag
        # behind the motion, and would make a path too short.
        key.now = (now - (settled - key.start))[good]
        key.ids, key.start = key.ids[good], key.start[good]
        offset = np.linalg.norm(key.now - key.start, axis=1)
        still = _still_share(key)
        if still > STILL_SHARE and still * len(offset) >= FEWEST_CORNERS // 2:
            share = float(np.mean(offset < INLIER_PX))
            return key.H_key_first, key.R_key_first, share, share
        fit: Any = cv2.findHomography(key.start, key.now, cv2.USAC_MAGSAC, INLIER_PX, maxIters=500, confidence=0.995)
        H, inlier = fit
        if H is None:
            return lost
        K = self.working_camera
        R, off_px = fitted_rotation(key.start.astype(float), key.now.astype(float), K, inlier[:, 0] > 0)
        share = float(np.mean(off_px < INLIER_PX))
        quality = float(np.mean(inlier))
        if share >= TURN_SHARE * quality:
            # Three numbers instead of eight: a homography's perspective is mostly noise when the camera only turns.
            H, quality = K @ R @ np.linalg.inv(K), share
        H = np.asarray(H @ key.H_key_first)
        return H / H[2, 2], R @ key.R_key_first, quality, share

    def _renew(self, H: Array, R: Array, image: Image, background: Image, *, followed: bool) -> None:
        """Make the present frame the key frame: the corners that were followed to it, and new ones away from them."""
        spacing = max(4.0, 0.012 * max(image.shape))
        ids: NDArray[np.int32] = np.zeros(0, np.int32)
        kept: NDArray[np.float32] = np.zeros((0, 2), np.float32)
        if followed and self._key is not None:
            ids, kept = self._key.ids, self._key.now
        free = background.copy()
        for x, y in np.round(kept).astype(int):
            cv2.circle(free, (int(x), int(y)), round(spacing), 0, -1)
        wanted = max(MOST_CORNERS - len(kept), 1)
        corners = cv2.goodFeaturesToTrack(image, wanted, 0.005, spacing, mask=free, blockSize=5)
        found = np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners[:, 0], np.float32)
        fresh = np.arange(self._next_id, self._next_id + len(found), dtype=np.int32)
        self._next_id += len(found)
        start = np.concatenate([kept, found])
        self._key = _KeyFrame(H, R, image, len(start), np.concatenate([ids, fresh]), start, start.copy())

    def _note(self) -> None:
        """Keep where the corners are: all of them in a frame that shows something new, few in others."""
        key = self._key
        if key is None or len(key.now) < FEWEST_CORNERS // 2:
            self.sightings.append(None)
            return
        view = self._view
        if view is not None:
            _, a, b = np.intersect1d(view.ids, key.ids, return_indices=True)
            moved = np.linalg.norm(view.pixels[a] - key.now[b], axis=1)
            common = len(a) >= KEPT_SHARE * len(key.ids)
            if common and np.mean(moved < STILL_PX) > STANDS_SHARE:
                self.sightings.append(view)
                return
            # Near things move more than far ones, and it is the near ones that tell.
            if common and np.percentile(moved, 75) < NEW_VIEW_SHARE * max(self._shape) * self._scale:
                few = np.unique(np.linspace(0, len(key.ids) - 1, KEPT_BETWEEN).astype(int))
                self.sightings.append(Sighting(key.ids[few], key.now[few], False))
                return
        self._view = Sighting(key.ids, key.now, True)
        self.sightings.append(self._view)


def _flow(
    a: Image, b: Image, points: NDArray[np.float32], guess: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points (M, 2) of image a are in image b, and whether they were found there."""
    begin = (points if guess is None else guess).reshape(-1, 1, 2).copy()
    flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        a, b, points.reshape(-1, 1, 2), begin, winSize=(15, 15), maxLevel=3, flags=flags
    )
    return np.asarray(moved[:, 0], np.float32), np.asarray(status[:, 0] > 0)


def _still_share(key: _KeyFrame) -> float:
    """Of the corners that are left, those that are where they were in the key frame."""
    return float(np.mean(np.linalg.norm(key.now - key.start, axis=1) < STILL_PX))


def _moved(H: Array, pixels: Array) -> Array:
    uvw = np.column_stack([pixels, np.ones(len(pixels))]) @ H.T
    return np.asarray(uvw[:, :2] / uvw[:, 2:])


def fitted_rotation(
    start: Array, now: Array, K: Array, inlier: NDArray[np.bool_], bound_px: float = INLIER_PX
) -> tuple[Array, Array]:
    """Rotation between two views (M, 2) px of far points, robust, and (M,) how far off in px it leaves each point.

    inlier: those to begin with.  bound_px: off by more, a point counts little.
    """
    rays = [np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(K).T for p in (start, now)]
    a, b = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays)
    weight, off_px = inlier.astype(float), np.zeros(len(start))
    R = np.eye(3)
    for _ in range(8):
        U, _, Vt = np.linalg.svd((b * weight[:, None]).T @ a)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        off_px = np.linalg.norm(_moved(K @ R @ np.linalg.inv(K), start) - now, axis=1)
        weight = 1.0 / (1.0 + (off_px / bound_px) ** 2) ** 2
    return R, off_px
