"""Follow an object through a clip twice: once to see it from all sides, once knowing its shape and its turns.

The first pass goes from frame to frame. Then, with glimpses from the whole clip at hand, the spin about the vessel's
own axis is settled (spin.py) and the vessel's shape is fitted to several frames at once (shape_fit.py). The second
pass refines every frame from the corrected pose, so that nothing is chained and nothing drifts. A mesh that is known
exactly needs no second look, except in frames that the first was unsure of: those are tried again from between their
sure neighbours, with all that the clip has taught by then.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from .background import Background
from .colours import ColourModel, colour_bins, spilled_share
from .depth_size import scaled_vessel, size_of_clip
from .depth_video import DepthView
from .first_pose import edge_score
from .geometry import Array, Symmetry, invert_pose
from .region import TrackingMesh, edge_strength
from .segment import Mask
from .shape_fit import View, fit_shape, tracking_mesh
from .spin import HIDDEN_EVIDENCE, SURELY_OURS, best_turns, object_evidence, turn_scores, turned
from .surface_flow import CarriedPoints, SurfaceFlow, spin_by_flow
from .tracker import Estimate, ObjectTracker
from .vessels import Vessel
from .video import Image, softened

GLIMPSES = 30  # frames kept for the spin
FIT_VIEWS = 6  # frames that the shape is fitted to
FIT_STEPS_PX = (3.0, 1.5, 1.0, 1.0, 1.0, 1.0)
WHOLE_EVERY = max(1, GLIMPSES // (2 * FIT_VIEWS))
SECOND_LOOK_RAD = np.deg2rad(60)  # most that a second look at the spin may change: it mends, it does not turn round
MOVED_PX = 5.0  # of the points of a surface from glimpse to glimpse, that tell something
SURE = 0.5  # least confidence of a frame that the shape may be fitted to


@dataclass(frozen=True)
class Glimpse:
    """What is kept of a frame: at half size how object-coloured it is and where it has edges, (H, W) both, see
    `turn_scores`; where points of the surface came from, if they could be followed here from the glimpse before; and,
    of some frames, all that a shape fit needs, and the depth if there is any."""

    index: int
    evidence: NDArray[np.float32]
    near_edge: NDArray[np.float32]
    flow: SurfaceFlow | None = None
    bins: NDArray[np.int32] | None = None
    edges: NDArray[np.float32] | None = None
    colours: ColourModel | None = None
    depth: DepthView | None = None

    def reversed(self, start_index: int) -> Glimpse:
        """The same, of one that counted frames backward from a start frame."""
        flow = None if self.flow is None else replace(self.flow, frames=-self.flow.frames)
        return replace(self, index=start_index - self.index, flow=flow)


@dataclass
class Followed:
    """One object on its way through the clip."""

    mesh: TrackingMesh
    vessel: Vessel | None
    camera_matrix: Array
    first_mask: Mask
    tracker: ObjectTracker
    guesses: Array | None = None
    first_look: list[Estimate] | None = None
    estimates: list[Estimate] = field(default_factory=list)
    glimpses: list[Glimpse] = field(default_factory=list)
    carried: CarriedPoints | None = None

    @staticmethod
    def start(
        mesh: TrackingMesh,
        vessel: Vessel | None,
        camera_matrix: Array,
        rgb: Image,
        mask: Mask,
        T_camera_object: Array,
        guesses: Array | None = None,
        symmetry: Symmetry | None = None,
        background: Background | None = None,
    ) -> Followed:
        """Ready for the first frame, in which the object has the mask and the pose given.

        symmetry: of the mesh, where it is not a vessel's.  background: of the clip, where it is known.
        """
        symmetry = symmetry if vessel is None else vessel.symmetry
        exact = vessel is None
        tracker = ObjectTracker(mesh, camera_matrix, rgb, mask, T_camera_object, symmetry, background, exact)
        return Followed(mesh, vessel, camera_matrix, mask, tracker, guesses)

    def step(self, rgb: Image, index: int, frame_count: int, depth: DepthView | None = None) -> None:
        """Take the next frame, and its depth where there is a depth camera."""
        before = None if self.first_look is None else self.first_look[min(index, len(self.first_look) - 1)]
        if before is not None and before.confidence >= SURE:
            self.estimates.append(before)
            return
        guess = None if self.guesses is None else self.guesses[min(index, len(self.guesses) - 1)]
        now = self.tracker.step(rgb, guess, depth)
        self.estimates.append(now if before is None or now.confidence > before.confidence else before)
        if self.guesses is None and self.vessel is not None:
            self._look(rgb, index, frame_count, depth)

    def _look(self, rgb: Image, index: int, frame_count: int, depth: DepthView | None) -> None:
        """Carry points of the surface on, and keep a glimpse of every so many frames."""
        if self.carried is not None:
            self.carried.step(_grey(rgb))
        if index % max(1, frame_count // GLIMPSES) == 0:
            glimpse = self._glimpse(rgb, index, depth, whole=len(self.glimpses) % WHOLE_EVERY == 0)
            self.glimpses.append(replace(glimpse, flow=None if self.carried is None else self.carried.flow()))
            self.carried = self._points_to_carry(rgb)

    def _points_to_carry(self, rgb: Image) -> CarriedPoints | None:
        """Those of the frame that was just followed, of a vessel."""
        now = self.estimates[-1]
        if self.vessel is None or not now.visible:
            return None
        seen = self.mesh.drawn(now.T_camera_object, self.camera_matrix)
        return None if seen is None else CarriedPoints(_grey(rgb), seen.mask_in_image(rgb.shape[1], rgb.shape[0]))

    def _glimpse(self, rgb: Image, index: int, depth: DepthView | None, whole: bool) -> Glimpse:
        bins, soft, colours = colour_bins(rgb), softened(rgb), self.tracker.colours
        edges = edge_strength(rgb, soft)
        evidence = object_evidence(bins, colours)
        strength = np.minimum(np.sqrt(edges[..., 0] ** 2 + edges[..., 1] ** 2), 1.0)
        near_edge = np.asarray(cv2.dilate(strength, np.ones((5, 5), np.uint8)), np.float32)
        if self.tracker.background is not None:
            covered = self.tracker.background.covered(rgb, soft)
            hidden = colours.hides(bins, covered, SURELY_OURS)
            evidence[hidden], near_edge[hidden] = HIDDEN_EVIDENCE, -1.0
            colours.hide(bins, covered)
        evidence, near_edge = evidence[::2, ::2], near_edge[::2, ::2]
        if not whole:
            return Glimpse(index, evidence, near_edge)
        return Glimpse(index, evidence, near_edge, None, bins, edges, colours.copy(), depth)

    def second_pass(self, first_rgb: Image) -> Followed:
        """The same object before the first frame again, with spin and shape settled."""
        poses = np.stack([e.T_camera_object for e in self.estimates])
        mesh, vessel = self.mesh, self.vessel
        if vessel is None:
            guesses = _between_sure(poses, np.array([e.confidence >= SURE for e in self.estimates]))
            return Followed(
                mesh, None, self.camera_matrix, self.first_mask, self.tracker, guesses, first_look=self.estimates
            )
        poses = _between_sure(poses, np.array([e.visible for e in self.estimates]))
        poses = self._with_settled_spin(poses, vessel)
        vessel, poses = self._fitted(poses, vessel)
        vessel, poses = self._sized(poses, vessel)
        if vessel is not self.vessel:
            # A handle of the right size shows its side in frames where one of the wrong size did not.
            mesh, poses = tracking_mesh(vessel), self._with_settled_spin(poses, vessel, SECOND_LOOK_RAD)
        return self._begun(mesh, vessel, first_rgb, poses, 0)

    def again(self, first_rgb: Image, index: int = 0) -> Followed:
        """The same before frame `index`, whose mask it has: what `second_pass` settled can be followed both ways."""
        if self.first_look is not None:
            return replace(self, estimates=[], glimpses=[])
        assert self.guesses is not None
        return self._begun(self.mesh, self.vessel, first_rgb, self.guesses, index)

    def _begun(self, mesh: TrackingMesh, vessel: Vessel | None, first_rgb: Image, poses: Array, index: int) -> Followed:
        return Followed.start(
            mesh, vessel, self.camera_matrix, first_rgb, self.first_mask, poses[index], poses,
            background=self.tracker.background,
        )  # fmt: skip

    @property
    def sure(self) -> float:
        """Mean confidence over the clip, nothing where it is not in view."""
        return float(np.mean([e.confidence * e.visible for e in self.estimates]))

    @property
    def flow_share(self) -> float:
        """Share in [0, 1] of the points of a printed surface that move as the poses say; 0 where nothing is printed."""
        if self.vessel is None or len(self.glimpses) < 2:
            return 0.0
        poses = np.stack([e.T_camera_object for e in self.estimates])
        shares = self._flow_spins(poses, self.glimpses, self.vessel.interior.axis_xy_m)[1]
        # What stands still agrees with any pose.
        told = [m for m in range(1, len(shares)) if (flow := self.glimpses[m].flow) is None or flow.moved_px > MOVED_PX]
        return float(np.mean(shares[told])) if told else 0.0

    @property
    def spilled(self) -> float:
        """How much of the object's colours goes on beyond the mesh, as a share of its silhouette.

        A mesh that is only part of the object may be followed as surely as the right one, but not without this.
        In the median of the glimpses: it may pass other things of its colours.
        """
        half = np.diag([0.5, 0.5, 1.0]) @ self.camera_matrix
        shares = []
        for glimpse in self.glimpses:
            now = self.estimates[glimpse.index]
            window = self.mesh.drawn(now.T_camera_object, half)
            if now.visible and window is not None:
                silhouette = window.mask_in_image(glimpse.evidence.shape[1], glimpse.evidence.shape[0])
                shares.append(spilled_share(silhouette, glimpse.evidence, glimpse.near_edge < 0))
        return float(np.median(shares)) if shares else 0.0

    @property
    def spin_source(self) -> str:
        """What told the object's turns about its own axis: "texture", "outline" or "none"."""
        return self.tracker.spin_source(len(self.estimates))

    def _with_settled_spin(self, poses: Array, vessel: Vessel, within_rad: float = np.pi) -> Array:
        if vessel.symmetry.order == 0:
            return poses
        axis = vessel.interior.axis_xy_m
        camera = np.diag([0.5, 0.5, 1.0]) @ self.camera_matrix
        light = tracking_mesh(vessel, 1200)
        glimpses = [g for g in self.glimpses if self.estimates[g.index].visible]
        if len(glimpses) < 2:
            return poses
        at = np.array([g.index for g in glimpses])
        poses, told = self._spun_with_flow(poses, glimpses, axis)
        scores = [
            turn_scores(light, poses[g.index], camera, g.evidence, g.near_edge, axis, within_rad) for g in glimpses
        ]
        return turned(poses, at, best_turns(poses[at], np.stack(scores), told), axis)

    def _spun_with_flow(
        self, poses: Array, glimpses: list[Glimpse], axis_xy_m: tuple[float, float]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """The poses spun from glimpse to glimpse as the flow between them says; and whether it says so, by glimpse."""
        spins, shares = self._flow_spins(poses, glimpses, axis_xy_m)
        told = shares > 0
        if not told.any():
            return poses, told
        at = np.array([g.index for g in glimpses])
        turns = Rotation.from_rotvec(np.outer(np.cumsum(spins), [0.0, 0.0, 1.0])).as_matrix()
        return turned(poses, at, turns, axis_xy_m), told

    def _flow_spins(self, poses: Array, glimpses: list[Glimpse], axis_xy_m: tuple[float, float]) -> tuple[Array, Array]:
        """(M,) rad that the flow from each glimpse's predecessor to it says more than the poses, and (M,) how surely.

        See `spin_by_flow`; nothing where there is no flow, and for the first.
        """
        spins, shares = np.zeros(len(glimpses)), np.zeros(len(glimpses))
        for m, (before, after) in enumerate(pairwise(glimpses), start=1):
            apart = after.index - before.index
            for flow, one, other in ((after.flow, before, after), (before.flow, after, before)):
                if flow is None or flow.frames != other.index - one.index:
                    continue
                spin, share = spin_by_flow(
                    self.mesh, poses[one.index], poses[other.index], self.camera_matrix, flow, axis_xy_m
                )
                if share > shares[m]:
                    spins[m], shares[m] = np.sign(apart * flow.frames) * spin, share
        return spins, shares

    def _fitted(self, poses: Array, vessel: Vessel) -> tuple[Vessel, Array]:
        """The vessel fitted to several frames, and its poses in all; unchanged if that is no better."""
        kept = [g for g in self.glimpses if g.bins is not None and self.estimates[g.index].confidence > SURE]
        if not kept:
            return vessel, poses
        chosen = [kept[k] for k in np.unique(np.linspace(0, len(kept) - 1, FIT_VIEWS).round().astype(int))]
        views = [
            # Local colours were learned along the outline that is to be mended, and belong to its mesh.
            View(g.bins, g.colours.everywhere(), poses[g.index], None, g.edges)
            for g in chosen
            if g.bins is not None and g.colours is not None
        ]
        fitted, fitted_poses = fit_shape(vessel, views, self.camera_matrix, FIT_STEPS_PX)
        before = self._merit(tracking_mesh(vessel), [v.T_camera_object for v in views], chosen)
        after = self._merit(tracking_mesh(fitted), fitted_poses, chosen)
        if after <= before:
            return vessel, poses
        shifts = np.stack([invert_pose(v.T_camera_object) @ T for v, T in zip(views, fitted_poses, strict=True)])
        # Single frames know how far off they stand, but all together know better how the vessel is turned.
        turns = Rotation.from_matrix(shifts[:, :3, :3]).as_rotvec()
        turns[:, 2] = np.median(turns[:, 2])
        shifts[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
        return fitted, poses @ _between(shifts, np.array([g.index for g in chosen]), len(poses))

    def _sized(self, poses: Array, vessel: Vessel) -> tuple[Vessel, Array]:
        """The vessel as large as the depth pictures say, and its poses as far away; unchanged without any."""
        sure = [g for g in self.glimpses if self.estimates[g.index].confidence > SURE]
        seen = [(poses[g.index], g.depth) for g in sure if g.depth is not None]
        ratio = size_of_clip(tracking_mesh(vessel), seen) if seen else None
        if ratio is None:
            return vessel, poses
        poses = poses.copy()
        poses[:, :3, 3] *= ratio
        return scaled_vessel(vessel, ratio), poses

    def _merit(self, mesh: TrackingMesh, poses: list[Array], glimpses: list[Glimpse]) -> float:
        """Mean over the views of the share of object colours covered and of the outline on image edges."""
        total = 0.0
        half = np.diag([0.5, 0.5, 1.0]) @ self.camera_matrix
        for T, glimpse in zip(poses, glimpses, strict=True):
            if glimpse.edges is None:
                continue
            total += edge_score(mesh, T, self.camera_matrix, glimpse.edges)
            window = mesh.drawn(T, half)
            if window is not None:
                silhouette = window.mask_in_image(glimpse.evidence.shape[1], glimpse.evidence.shape[0])
                most = float(np.maximum(glimpse.evidence, 0)[silhouette].sum())
                total += float(glimpse.evidence[silhouette].sum()) / max(most, 1.0)
        return total / len(glimpses)


def _grey(rgb: Image) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _between_sure(poses: Array, sure: NDArray[np.bool_]) -> Array:
    """The poses (N, 4, 4), those that are not sure replaced by what lies between their sure neighbours."""
    at = np.flatnonzero(sure)
    if len(at) < 2:
        return poses
    out = _between(poses[at], at, len(poses))
    out[sure] = poses[sure]
    return out


def _between(poses: Array, at: NDArray[np.int_], count: int) -> Array:
    """(count, 4, 4) poses of which those at some frames are known; before the first and after the last as there."""
    if len(at) == 1:
        return np.repeat(poses, count, axis=0)
    where = np.clip(np.arange(count), at[0], at[-1])
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Slerp(at, Rotation.from_matrix(poses[:, :3, :3]))(where).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(where, at, poses[:, axis, 3])
    return out
