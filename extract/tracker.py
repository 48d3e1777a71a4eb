"""Follow one object from frame to frame: predict, refine against the frame, learn from it, judge the result.

The outline against learned colours (region.py), textured points (texture.py) and, where there are any, depth pictures
(depth_term.py) move the pose in one least squares.
Only the part of the frame around the prediction is looked at; the whole of it when the object is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .background import Background
from .colours import HIDDEN_BIN, ColourModel, colour_bins
from .depth_term import LIKENESS, Surface, draw_surface, settle, share_on_surface
from .depth_video import DepthView
from .first_pose import share_on_edges
from .geometry import Array, Symmetry, make_pose, pose_change, project, scaled_camera, transform_points
from .region import Outline, TrackingMesh, draw_outline, edge_strength, measure, refine
from .segment import Mask
from .spin import mirrored, object_evidence
from .texture import NO_MATCHES, Matches, Texture, flattened
from .video import Image, softened

LOGISTIC = (5.26, 2.42, 2.27, -3.29)
ON_SURFACE = 0.9  # least share of the depth readings on a right pose's mesh
LEARNING_RATE = 0.15
LEARN_ABOVE = 0.5  # a frame the tracker is unsure of teaches it nothing
KEY_ABOVE = 0.8
OURS_PX = 7  # over which colours are smoothed that tell where an object shows
LOST_BELOW = 0.25
FOUND_ABOVE = 0.5  # what was lost must be surer to be found than what is held must be to be kept
VELOCITY_KEPT = 0.7  # hands accelerate: half-trusting the last velocity beats trusting it or ignoring it
COARSE_PX, FINE_PX, SEARCH_PX = (5.0, 3.0, 2.0, 1.0, 1.0), (2.0, 1.0, 1.0), (9.0, 7.0, 5.0, 3.0, 2.0, 1.0)
TRUSTED = 0.5  # texture that may start a frame's refinement and tell the spin of a body of revolution
SURE_MATCHES = 20
STILL_SPIN_RAD, HELD_SPIN_RAD = 1e-3, 0.014  # what cannot be seen; what the whole clip has told
TEXTURED_SHARE = 0.3
GUESS_MARGIN = 0.05  # of confidence, by which going on must be better than a guess
APART_RAD, APART_SHARE = 0.07, 0.07  # of the mesh's radius
LOOK_AROUND = 0.3  # of the object's size, and LOOK_AROUND_PX
LOOK_AROUND_PX = 50
SEARCH_EVERY = 3  # frames, for what has been lost for long
SEARCH_SCALE, SEARCH_PLACES, SEARCH_TURNS = 0.25, 3, 8


@dataclass(frozen=True)
class Estimate:
    """Pose of the object in one frame, how sure it is in [0, 1], and whether the object is in view."""

    T_camera_object: Array
    confidence: float
    visible: bool


@dataclass(frozen=True)
class Signs:
    """What tells a good pose from a bad one, all in [0, 1].

    agree: share of the outline's lines, but those across what hides it, whose colours put it within 2 px.
    on_edges: share of the outline on image edges, where it is not hidden.  rigid: share of the textured points that
    move as the pose says, times how far texture is trusted.
    """

    agree: float
    on_edges: float
    rigid: float

    @property
    def confidence(self) -> float:
        """Probability that the pose is right: the mesh within 5 % of its size in the image, turned by under 12 degrees.

        A logistic regression over 525 refinements of poses wrong by up to 15 degrees and 12 % of the distance, in
        synthetic pours of a kettle, a mug and a bottle half hidden by its hand. In 40 whole clips of 8 categories,
        where the mesh is only about that of the object (bench/tracking.py), of frames said to be right with 64, 76,
        86, 93 and 98 % the upright axis was within 12 degrees in 77, 91, 87, 98 and 99 %, the spin about it as well in
        42, 78, 74, 87 and 93 %. What is said with less than 50 % was right mostly: 88 of 6000 frames.
        """
        a, b, c, d = LOGISTIC
        return float(1 / (1 + np.exp(-(a * self.agree + b * self.on_edges + c * self.rigid + d))))


@dataclass(frozen=True)
class _Part:
    """The part of a frame that is looked at, with the camera that sees it so."""

    bins: NDArray[np.int32]
    edges: NDArray[np.float32]
    picture: NDArray[np.uint8]
    camera_matrix: Array

    @property
    def shape(self) -> tuple[int, int]:
        return self.bins.shape[0], self.bins.shape[1]


@dataclass(frozen=True)
class _Fit:
    """A refined pose with all that is learned from."""

    T_camera_object: Array
    confidence: float
    outline: Outline | None = None
    matches: Matches = NO_MATCHES
    strain: float = 0.0
    signs: Signs = Signs(0.0, 0.0, 0.0)
    farther: float = 1.0  # than outline and texture alone would have it, by the depth picture
    on_surface: float = 1.0  # share of the depth readings that lie on the mesh

    @property
    def merit(self) -> float:
        """What fits of one frame are compared by: the confidence, less where depth readings speak against the pose."""
        return self.confidence * min(1.0, self.on_surface / ON_SURFACE)


class ObjectTracker:
    """Tracks one mesh through the frames of one video, starting from a pose and a mask in one frame.

    camera_matrix and all images are at the working resolution.  symmetry: of the mesh; about an axis of revolution
    only texture can tell a turn, without it there is none.  background: of the clip, where it is known: tells what
    may hide the object.  exact: whether the mesh is the object's own, or only like it.
    """

    def __init__(
        self,
        mesh: TrackingMesh,
        camera_matrix: Array,
        rgb: Image,
        mask: Mask,
        T_camera_object: Array,
        symmetry: Symmetry | None = None,
        background: Background | None = None,
        exact: bool = True,
    ):
        self.mesh, self.camera_matrix = mesh, camera_matrix
        self.symmetry = symmetry or Symmetry()
        self.colours, self.texture = ColourModel(), Texture(mesh, exact)
        self.background = background
        self.signs = Signs(0.0, 0.0, 0.0)
        self.textured_frames = 0
        self._depth: DepthView | None = None
        self._surface: Surface | None = None
        self._exact = exact
        self._farther, self._mesh_error_m = 1.0, 0.0 if exact else LIKENESS * mesh.radius_m
        self._pose: Array = T_camera_object
        self._velocity: Array = np.zeros(6)
        self._lost_frames, self._size_px = 0, (rgb.shape[1], rgb.shape[0])
        self._outline = draw_outline(mesh, T_camera_object, camera_matrix)
        bins = colour_bins(rgb)
        near = cv2.dilate(mask.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
        self.colours.start_global(bins[mask], bins[near & ~mask])
        if background is not None:
            self.colours.start_hiding(bins[near & ~mask & background.covered(rgb)])
        inside = None if self._outline is None else self._outline.inside((mask.shape[0], mask.shape[1]))
        if inside is not None:
            inside.teach(self.colours, bins, 1.0)
        self._keep(self._around(rgb, T_camera_object), T_camera_object, key=True)

    def step(self, rgb: Image, guess: Array | None = None, depth: DepthView | None = None) -> Estimate:
        """Pose in the next frame, refined from where the motion so far leads or from `guess`, which is preferred.

        depth: of the same frame, where there is a depth camera.
        """
        self._depth = depth
        ahead = self._predicted()
        start = ahead if guess is None else guess
        part = self._around(rgb, start)
        best = self._fitted(part, start, spin=0.02 if guess is None else HELD_SPIN_RAD)
        beatable = best.merit < 1.0 - GUESS_MARGIN
        if guess is not None and beatable and self._lost_frames == 0 and self._differ(ahead, guess):
            # A guess from a first look that went astray is given up for where the second look has come.
            other_part = self._around(rgb, ahead)
            other = self._fitted(other_part, ahead, spin=HELD_SPIN_RAD)
            if other.merit > best.merit + GUESS_MARGIN:
                part, best = other_part, other
        leapt = False
        if best.on_surface < ON_SURFACE:
            # An outline leans toward the camera as well as away from it: depth knows better.
            other = self._fitted(part, mirrored(best.T_camera_object), spin=HELD_SPIN_RAD)
            if other.merit > best.merit + GUESS_MARGIN:
                best, leapt = other, True
        if best.confidence < LOST_BELOW:
            part = self._part(rgb, 0, 0, rgb.shape[1], rgb.shape[0])
            best = self._searched(part, best, start)
        self.signs = best.signs
        if best.confidence < LOST_BELOW:
            self._lost_frames += 1
            if guess is None:
                self._pose, self._velocity = start, VELOCITY_KEPT * self._velocity
            return Estimate(start, best.confidence, False)
        self._accept(best, part)
        if leapt:
            self._velocity = np.zeros(6)  # it did not move like that
        return Estimate(best.T_camera_object, best.confidence, True)

    def _differ(self, one: Array, other: Array) -> bool:
        """Whether two poses are so far apart that refinement from them may end in different places."""
        turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude()
        shift = np.linalg.norm(one[:3, 3] - other[:3, 3])
        return bool(turn > APART_RAD or shift > APART_SHARE * self.mesh.radius_m)

    def _accept(self, fit: _Fit, part: _Part) -> None:
        """Go on from a fit, and learn from it what it is sure enough to teach."""
        T = fit.T_camera_object
        if self._lost_frames == 0:
            self._velocity = pose_change(self._pose, T)
        else:
            self._velocity = np.zeros(6)
        self._pose, self._lost_frames, self._farther = T, 0, fit.farther
        self.textured_frames += self._tells_spin(fit.matches)
        self.texture.judge(fit.matches, fit.strain)
        if fit.confidence >= LEARN_ABOVE and fit.outline is not None:
            fit.outline.teach(self.colours, part.bins, LEARNING_RATE)
        self._keep(part, T, key=fit.confidence >= KEY_ABOVE)

    def _keep(self, part: _Part, T: Array, key: bool) -> None:
        """Remember the texture of a frame; of a mesh only like the object where its colours are, not the hand's."""
        ours = None
        if not self._exact:
            evidence = object_evidence(part.bins, self.colours)
            evidence[part.bins == HIDDEN_BIN] = -1.0
            ours = np.asarray(cv2.blur(evidence, (OURS_PX, OURS_PX)) > 0)
        self.texture.keep(part.picture, part.camera_matrix, T, ours, key)

    def _predicted(self) -> Array:
        """Constant velocity, damped; of the turn of a body of revolution only what can be seen."""
        turn = self._velocity[:3]
        if self.symmetry.order == 0 and self.texture.trust < TRUSTED:
            axis = self._pose[:3, :3] @ np.asarray(self.symmetry.axis)
            turn = turn - (turn @ axis) * axis
        R = Rotation.from_rotvec(VELOCITY_KEPT * turn).as_matrix() @ self._pose[:3, :3]
        return make_pose(R, self._pose[:3, 3] + VELOCITY_KEPT * self._velocity[3:])

    def spin_source(self, frames: int) -> str:
        """What told the turns about the symmetry axis or the upright axis: "texture", "outline" or "none"."""
        if self.textured_frames > TEXTURED_SHARE * frames:
            return "texture"
        return "none" if self.symmetry.order == 0 else "outline"

    def _tells_spin(self, matches: Matches) -> bool:
        return len(matches) >= SURE_MATCHES and self.texture.trust >= TRUSTED

    def _fitted(
        self, part: _Part, start: Array, steps_px: Sequence[float] = COARSE_PX, freedom: float = 1.0, spin: float = 0.02
    ) -> _Fit:
        matches = self.texture.match(part.picture, part.camera_matrix, start)
        sure = self._tells_spin(matches)
        if sure and matches.T_camera_object is not None:
            start, steps_px = matches.T_camera_object, FINE_PX
        hidden_spin = self.symmetry.order == 0 and not sure
        result = refine(
            self.mesh, start, part.camera_matrix, part.bins, self.colours, steps_px=tuple(steps_px),
            prior_rotation_rad=0.03 * freedom, prior_spin_rad=STILL_SPIN_RAD if hidden_spin else spin * freedom,
            spin_axis=self.symmetry.axis if self.symmetry.order == 0 else (0.0, 0.0, 1.0),
            prior_translation=0.02 * freedom, prior_depth=0.01 * freedom,
            edges=part.edges, points=matches.points, outline=self._outline,
        )  # fmt: skip
        self._outline = result.outline
        T, farther = self._with_depth(
            result.T_camera_object, result.information, STILL_SPIN_RAD if hidden_spin else 0.03
        )
        outline = None if self._outline is None else self._outline.moved(T, part.camera_matrix).inside(part.shape)
        in_view = self._share_in_view(T)
        if in_view < 0.1 or outline is None:
            return _Fit(T, 0.0)
        lines = measure(self.mesh, T, part.camera_matrix, part.bins, self.colours, 1.0, outline=outline)
        if lines is None:
            return _Fit(T, 0.0)
        offset_px, _ = lines.residuals(T, part.camera_matrix)
        agree = float(np.mean((np.abs(offset_px) < 2.0) & (lines.variance_px2 < 9.0)))
        rigid = 0.0
        if matches.keyed.any():
            held = np.mean(matches.points.errors_px(T, part.camera_matrix)[matches.keyed] < 2.0)
            rigid = float(held * matches.rigid_share * self.texture.trust)
        x, y = np.round(outline.pixel).astype(int).T
        told = outline.select(part.bins[y, x] != HIDDEN_BIN)
        signs = Signs(agree, share_on_edges(told, part.edges), rigid)
        confidence = signs.confidence * min(1.0, 2 * in_view)
        return _Fit(T, confidence, outline, matches, result.strain, signs, farther, self._on_surface(T))

    def _with_depth(self, T: Array, information: Array, spin_rad: float) -> tuple[Array, float]:
        """A pose of that information (6, 6) joined with what the depth picture says, and how much farther that is."""
        if self._depth is None:
            return T, 1.0
        if self._surface is None or not self._surface.serves(T):
            self._surface = draw_surface(self.mesh, T, self._depth.camera_matrix)
        # What neither shows stays where it is: a body's spin above all.
        up = T[:3, :3] @ np.asarray(self.symmetry.axis)
        held = np.diag([1 / 0.03**2] * 3 + [1 / (0.02 * T[2, 3]) ** 2] * 3)
        held[:3, :3] += np.outer(up, up) * (1 / spin_rad**2 - 1 / 0.03**2)
        settled = None
        if self._surface is not None:
            settled = settle(self._surface, T, self._depth, information + held, self._mesh_error_m)
        if settled is None:
            # Where nothing was read the outline is as wrong about the distance as it was before.
            return make_pose(T[:3, :3], T[:3, 3] * self._farther), self._farther
        return settled, float(np.linalg.norm(settled[:3, 3]) / np.linalg.norm(T[:3, 3]))

    def _on_surface(self, T: Array) -> float:
        """See `_Fit`; 1 where there is no depth."""
        if self._depth is None or self._surface is None:
            return 1.0
        share = share_on_surface(self._surface, T, self._depth, self._mesh_error_m)
        return 1.0 if share is None else share

    def _searched(self, part: _Part, best: _Fit, predicted: Array) -> _Fit:
        """The best of wider looks: around the prediction at first, then wherever the object's colours are."""
        starts: list[Array] = [predicted] if self._lost_frames < SEARCH_EVERY else []
        if self._lost_frames % SEARCH_EVERY == 0:
            starts += self._places(part)
        fits = [self._fitted(part, start, SEARCH_PX, freedom=3.0) for start in starts]
        found = max(fits, key=lambda fit: fit.confidence, default=best)
        if found.confidence >= (FOUND_ABOVE if self._lost_frames else LOST_BELOW):
            return found
        return best if best.confidence < LOST_BELOW else found

    def _places(self, part: _Part) -> list[Array]:
        """Poses whose silhouettes cover the object's colours best: rotations of key views, where the colours are."""
        evidence = object_evidence(part.bins, self.colours)
        small = cv2.resize(evidence, None, fx=SEARCH_SCALE, fy=SEARCH_SCALE, interpolation=cv2.INTER_AREA)
        camera = scaled_camera(part.camera_matrix, SEARCH_SCALE)
        depth_m = float(self._pose[2, 3])
        reach = max(3, int(self.mesh.radius_m * camera[0, 0] / depth_m))
        heat = cv2.blur(small, (reach, reach), borderType=cv2.BORDER_CONSTANT)
        places: list[Array] = []
        for _ in range(SEARCH_PLACES):
            _, top, _, (x, y) = cv2.minMaxLoc(heat)
            if top <= 0:
                break
            places.append(np.asarray(np.linalg.solve(camera, np.array([x, y, 1.0])) * depth_m, float))
            cv2.circle(heat, (x, y), reach, -1e3, -1)
        views = self.texture.views
        picked = np.unique(np.linspace(0, len(views) - 1, SEARCH_TURNS).round().astype(int)) if views else []
        turns = [self._pose[:3, :3], *(views[k].T_camera_object[:3, :3] for k in picked)]
        scored: list[tuple[float, int, Array]] = []
        for place in places:
            for R in turns:
                T = make_pose(R, place)
                window = self.mesh.drawn(T, camera)
                if window is not None:
                    silhouette = window.mask_in_image(small.shape[1], small.shape[0])
                    scored.append((float(small[silhouette].sum()), len(scored), T))
        return [T for _, _, T in sorted(scored, reverse=True)[:SEARCH_PLACES]]

    def _around(self, rgb: Image, T: Array) -> _Part:
        """What lies around the object at a pose; the whole frame when it would be out of it."""
        height, width = rgb.shape[:2]
        points = transform_points(T, self.mesh.centres_m)
        if points[:, 2].min() > 1e-3:
            pixels = project(self.camera_matrix, points)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            pad = LOOK_AROUND * float((high - low).max()) + LOOK_AROUND_PX
            x_a, y_a = np.clip(np.floor(low - pad), 0, [width, height]).astype(int)
            x_b, y_b = np.clip(np.ceil(high + pad), 0, [width, height]).astype(int)
            if min(x_b - x_a, y_b - y_a) >= LOOK_AROUND_PX:
                return self._part(rgb, x_a, y_a, x_b, y_b)
        return self._part(rgb, 0, 0, width, height)

    def _part(self, rgb: Image, x_a: int, y_a: int, x_b: int, y_b: int) -> _Part:
        image = np.ascontiguousarray(rgb[y_a:y_b, x_a:x_b])
        camera = self.camera_matrix.copy()
        camera[:2, 2] -= (x_a, y_a)
        bins, soft = colour_bins(image), softened(image)
        if self.background is not None:
            self.colours.hide(bins, self.background.part(x_a, y_a, x_b, y_b).covered(image, soft))
        return _Part(bins, edge_strength(image, soft), flattened(image), camera)

    def _share_in_view(self, T: Array) -> float:
        """Share of the mesh's centres that project into the image."""
        points = transform_points(T, self.mesh.centres_m)
        if points[:, 2].min() < 1e-3:
            return 0.0
        x, y = project(self.camera_matrix, points).T
        width, height = self._size_px
        return float(np.mean((x >= 0) & (x < width) & (y >= 0) & (y < height)))
