"""FreePose's way through a video (sections 3.1 and 3.3): masks, poses of single frames, points followed, PnP.

The object is found in the start frame and masked all the way. Every frame's view of the mesh is chosen with its
neighbours in mind, for two views may look alike and only one of them moves steadily; it is then fitted among rotations
close by. The frame that agrees best with its drawing is where points are put on the mesh (refine_tracks.py).

What does the seeing comes by the protocols: the paper's networks where their weights are at hand, else classical parts.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .candidates import Model, ObjectRequest, candidate_models, vessel_model
from .choose import Chosen, Level, choose
from .classical_segment import ClassicalSegmenter
from .coarse_pose import PoseGuess, coarse_poses, fine_poses
from .errors import UserError
from .features import ClassicalFeatures
from .geometry import Array, make_pose, rotation_angle_rad, scaled_camera
from .masks import read_mask
from .mesh_sources import LIBRARY, MeshSource
from .mesh_store import MeshStore
from .meshes import METRES_PER_UNIT
from .neural_segment import FOR_VIDEOS, large_enough
from .onboarding import describe_views, read_source
from .overlay import OverlayItem
from .perceive import camera_of_video, video_of_requests, write_tracks
from .point_tracks import ClassicalTracks
from .progress import Progress
from .protocols import Image, Mask, PatchFeatures, PointTracker, Segmenter
from .refine_tracks import Refined, Seen, Translation, refine, with_translation
from .rerun_log import load_rerun
from .retrieval import FRAMES, Look, look_at_object, spread_frames
from .segment import check_box, mask_box
from .smoothing import smooth_poses
from .starting import WORKING_SIDE_PX, resized, scaled
from .templates import ColoredMesh, ViewSettings
from .track import ObjectTrack
from .vessels import make_vessel, resolve_category
from .video import Frame, VideoInfo, iterate_backward, iterate_frames

VIEWS_KEPT = 20  # of every frame, among which the steadiest course is looked for
TURN_COST = 0.3  # of a cosine, for a turn of one radian from one frame to the next; grows with its square
VARIANTS = 3  # of a vessel of the library, where no mesh is given
TEMPLATES_VARIABLE = "VID2DEMO_TEMPLATES"


@dataclass(frozen=True)
class Means:
    """What does the seeing, and how much of a mesh is looked at."""

    features: PatchFeatures
    segmenter: Segmenter
    tracker: PointTracker
    views: ViewSettings = ViewSettings()  # noqa: RUF009 - frozen


@dataclass(frozen=True)
class Subject:
    """A mesh that the object may be.

    model: as it is tracked and drawn.  mesh_m: coloured, in m, its bounding box centred.  centre_m: of the model's own
    bounding box, in the model's frame.
    """

    model: Model
    key: str
    mesh_m: ColoredMesh
    centre_m: Array

    @property
    def size_m(self) -> float:
        return float(self.mesh_m.extents.max())

    def posed(self, T_camera_centred: Array) -> Array:
        """(..., 4, 4) poses of the model from those of the centred mesh."""
        return T_camera_centred @ make_pose(t=-self.centre_m)


@dataclass(frozen=True)
class Posed:
    """An object in every frame, before smoothing.

    coarse: (N, 4, 4) poses of single frames.  score: (N,) cosines with their drawings.  seen: (N,) where it shows.
    key: the frame from which points were followed.  start_mask: (H, W) in the start frame, at working size.
    """

    subject: Subject
    coarse: Array
    score: Array
    seen: NDArray[np.bool_]
    refined: Refined
    key: int
    time_s: Array
    start_mask: Mask

    def translated(self, translation: Translation) -> Array:
        """(N, 4, 4) PnP's poses with the translations asked for; see `refine_tracks.with_translation`."""
        symmetry = self.subject.model.symmetry
        return with_translation(translation, self.coarse, self.refined, self.seen, symmetry)


def extract_by_views(
    video: Path,
    requests: Sequence[ObjectRequest],
    *,
    out: Path,
    translation: Translation = "fused",
    level: Level = "auto",
    models_dir: Path | None = None,
    camera: tuple[float, float, float, float] | None = None,
    start_frame: int | None = None,
    rerun: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, ObjectTrack]:
    """Track objects through a video as the paper does. Writes what `perceive.extract` writes, from the same requests.

    translation: of single frames ("coarse", as the authors' code has it), of point tracks ("pnp"), or both ("fused").
    level, models_dir: which networks do the seeing; see `choose.choose`.
    Raises UserError for a bad video, box, mask, name or mesh, and when an object cannot be found.
    """
    report = progress or (lambda done, total, what: None)
    if rerun:
        load_rerun()
    info = video_of_requests(video, requests, start_frame)
    camera_matrix, camera_source = camera_of_video(info, camera)
    means, chosen = find_means(level, models_dir)
    tracks: dict[str, ObjectTrack] = {}
    items, masks = [], []
    for request in requests:
        posed = pose_through_video(info, request, camera_matrix, means, start_frame or 0, report)
        raw = posed.translated(translation)
        confidence = np.clip(posed.score, 0, 1) * np.where(posed.seen, 0.5 + 0.5 * posed.refined.share, 0.0)
        header = {
            "object": request.name,
            "mesh": {**posed.subject.model.header, "symmetry": posed.subject.model.symmetry.to_json(),
                     "up_axis": [0.0, 0.0, 1.0]},
            "image_size_px": [info.width_px, info.height_px],
            "video": {"file": info.path.name, "sha256": info.sha256},
            "camera": {"source": camera_source, "motion": {"asked": "static", "kind": "static"}},
            "settings": {
                "tracker": "freepose",
                "translation": translation,
                "box_xywh_px": [float(v) for v in scaled(mask_box(posed.start_mask), _scale(info) ** -1)],
                "choice": _how(request),
                "start_frame": start_frame or 0,
                "key_frame": posed.key,
                "seed": seed,
                "means": {one.role: one.header() for one in chosen},
            },
        }  # fmt: skip
        smooth = smooth_poses(raw, posed.time_s, confidence)
        track = ObjectTrack(smooth, posed.time_s, camera_matrix, confidence, posed.seen, header, None, raw)
        tracks[request.name] = track
        items.append(OverlayItem(track, posed.subject.model.mesh))
        masks.append(posed.start_mask)
    write_tracks(info, items, masks, out, rerun=rerun, progress=report)
    return tracks


def find_means(level: Level, models_dir: Path | None) -> tuple[Means, list[Chosen[Any]]]:
    """The parts of the method at a level, and how they were chosen."""
    kind: dict[str, Any] = {"level": level, "models_dir": models_dir}
    features: Chosen[PatchFeatures] = choose("features", ClassicalFeatures, **kind)
    thresholds = {"thresholds": FOR_VIDEOS}
    segmenter: Chosen[Segmenter] = choose("segmenter", ClassicalSegmenter, options=thresholds, **kind)
    tracker: Chosen[PointTracker] = choose("tracks", ClassicalTracks, **kind)
    return Means(features.made, segmenter.made, tracker.made), [features, segmenter, tracker]


def pose_through_video(
    info: VideoInfo,
    request: ObjectRequest,
    camera_matrix: Array,
    means: Means,
    start: int,
    progress: Progress,
    templates: Path | None = None,
) -> Posed:
    """One object in every frame, by single frames and by point tracks. templates: where views of meshes are kept.

    Raises UserError when the mesh or the name is bad, and when the object is not found.
    """
    count = info.frame_count
    progress(0, count, f"drawing the views of {request.name}")
    subjects, store = subjects_of(request, means, templates or templates_folder())
    K = scaled_camera(camera_matrix, _scale(info))
    clip = _Clip(info, start)

    views: dict[int, dict[str, list[PoseGuess]]] = {}
    masks: dict[int, _Packed] = {}
    for frame, mask in clip.masked(lambda rgb: _first_mask(rgb, request, subjects, store, means, K, info), means):
        progress(len(masks), count, f"masking {request.name}")
        masks[frame.index] = _Packed.of(mask)
        if not large_enough(mask, FOR_VIDEOS):
            continue
        look = look_at_object(means.features, store.settings.extend, [(frame.rgb, mask)])
        views[frame.index] = {
            s.key: coarse_poses(
                store, s.key, means.features, look, mask_box(mask), K, s.size_m, top=VIEWS_KEPT, over="union"
            )
            for s in subjects
        }  # fmt: skip
    seen = np.array([k in views for k in range(len(masks))])
    if not seen.any():
        raise UserError(f"object {request.name!r} was not found in {info.path}: give its --box or its --mask")
    voting = spread_frames(seen, FRAMES)
    subject = max(subjects, key=lambda s: float(np.mean([views[k][s.key][0].score for k in voting])))
    course = steady_course({k: found[subject.key] for k, found in views.items()})

    centred, score = np.zeros((len(seen), 4, 4)), np.zeros(len(seen))
    for frame in clip.forward(0):
        progress(frame.index, count, f"posing {request.name} frame by frame")
        if seen[frame.index]:
            mask = masks[frame.index].mask
            look = look_at_object(means.features, store.settings.extend, [(frame.rgb, mask)], (0.0,))
            (best,) = fine_poses(
                subject.mesh_m, means.features, look, mask_box(mask), K, [course[frame.index]],
                store.settings.extend, over="union",
            )  # fmt: skip
            centred[frame.index], score[frame.index] = best.T_camera_object, best.score
    coarse = subject.posed(_filled(centred, seen))

    def frames(at: int) -> Iterator[Seen]:
        along = clip.forward(at) if at >= 0 else clip.backward(~at)
        return (Seen(frame.rgb, masks[frame.index].mask) for frame in along)

    progress(0, count, f"following points on {request.name}")
    key = surest(score)
    refined = refine(frames, coarse, key, subject.model.mesh, K, means.tracker)
    return Posed(subject, coarse, score, seen, refined, key, clip.time_s, masks[start].mask)


def subjects_of(request: ObjectRequest, means: Means, folder: Path) -> tuple[list[Subject], MeshStore]:
    """The user's mesh, or variants of the vessels that the name may mean, with their views in a store."""
    if request.mesh is not None:
        (model,) = candidate_models(request)
        named = [(model, MeshSource(request.name, "", str(request.mesh)), str(model.header["unit"]))]
    else:
        named = [
            (vessel_model(make_vessel(c, k)), MeshSource(f"{c}:{k}", c, f"{LIBRARY}/{c}/{k}"), "m")
            for c in resolve_category(request.name)
            for k in range(VARIANTS)
        ]
    store = MeshStore.create(folder, means.views, means.features)
    subjects = []
    for model, source, unit in named:
        stored = read_source(source, unit)
        key = store.write_mesh(stored)
        if not store.has_views(key):
            describe_views(store, key, stored.mesh, means.features)
        metres = METRES_PER_UNIT[unit]
        mesh_m = stored.mesh.scaled(stored.about.half_extent * metres)
        subjects.append(Subject(model, key, mesh_m, np.array(stored.about.centre) * metres))
    return subjects, store


def templates_folder() -> Path:
    """Where views of meshes are kept between calls: $VID2DEMO_TEMPLATES, else ~/.cache/vid2demo/templates."""
    return Path(os.environ.get(TEMPLATES_VARIABLE) or Path.home() / ".cache" / "vid2demo" / "templates")


def steady_course(views: dict[int, list[PoseGuess]]) -> dict[int, PoseGuess]:
    """Of the views kept for each frame the ones that score best with the least turning, over the whole clip (Viterbi).

    views: guesses by frame; frames without are passed over.
    """
    order = sorted(views)
    total = np.array([guess.score for guess in views[order[0]]])
    came: list[NDArray[np.int64]] = []
    for before, now in pairwise(order):
        R = [np.stack([guess.T_camera_object[:3, :3] for guess in views[k]]) for k in (before, now)]
        reached = total[:, None] - TURN_COST * rotation_angle_rad(R[0][:, None], R[1][None]) ** 2
        came.append(np.argmax(reached, axis=0))
        total = reached.max(axis=0) + np.array([guess.score for guess in views[now]])
    state = int(np.argmax(total))
    course = {order[-1]: views[order[-1]][state]}
    for frame, back in zip(reversed(order[:-1]), reversed(came), strict=True):
        state = int(back[state])
        course[frame] = views[frame][state]
    return course


def surest(score: Array) -> int:
    """The frame that agrees best with its drawing, as its neighbours do: one alone may be chance."""
    if len(score) < 3:
        return int(np.argmax(score))
    around = np.stack([np.roll(score, 1), score, np.roll(score, -1)])[:, 1:-1]
    return 1 + int(np.argmax(around.min(axis=0)))


@dataclass(frozen=True)
class _Packed:
    """A mask in an eighth of the memory."""

    bits: NDArray[np.uint8]
    shape: tuple[int, int]

    @staticmethod
    def of(mask: Mask) -> _Packed:
        return _Packed(np.packbits(mask), (mask.shape[0], mask.shape[1]))

    @property
    def mask(self) -> Mask:
        count = self.shape[0] * self.shape[1]
        return np.asarray(np.unpackbits(self.bits, count=count).reshape(self.shape) > 0)


class _Clip:
    """The frames of a video at working size, from anywhere to either end."""

    def __init__(self, info: VideoInfo, start: int) -> None:
        self.info, self.start = info, start
        self._times: dict[int, float] = {}

    @property
    def time_s(self) -> Array:
        """(N,) of the frames that were read."""
        return np.array([self._times[k] for k in sorted(self._times)])

    def forward(self, at: int) -> Iterator[Frame]:
        for frame in iterate_frames(self.info.path, WORKING_SIDE_PX, self.info):
            self._times[frame.index] = frame.time_s
            if frame.index >= at:
                yield frame

    def backward(self, at: int) -> Iterator[Frame]:
        return iterate_backward(self.info.path, self.time_s[: at + 1].tolist(), WORKING_SIDE_PX)

    def masked(self, cut: Any, means: Means) -> Iterator[tuple[Frame, Mask]]:
        """Every frame with the mask of the object that `cut` finds in the start frame: on to the end, then back."""
        stream = self.forward(self.start)
        first = next(stream, None)
        if first is None:
            raise UserError(f"--start-frame {self.start}: that frame of {self.info.path} cannot be decoded")
        mask = cut(first.rgb)
        yield from _carried(means.segmenter, chain([first], stream), mask)
        if self.start > 0:
            back = _carried(means.segmenter, self.backward(self.start), mask)
            next(back)
            yield from back


def _carried(segmenter: Segmenter, frames: Iterable[Frame], mask: Mask) -> Iterator[tuple[Frame, Mask]]:
    waiting: list[Frame] = []

    def pictures() -> Iterator[Image]:
        for frame in frames:
            waiting.append(frame)
            yield frame.rgb

    # Whoever carries the masks may read ahead; the pictures must not get out of step with them.
    for (carried,) in segmenter.propagate(pictures(), [mask]):
        yield waiting.pop(0), carried


def _first_mask(
    rgb: Image,
    request: ObjectRequest,
    subjects: Sequence[Subject],
    store: MeshStore,
    means: Means,
    K: Array,
    info: VideoInfo,
) -> Mask:
    """The object in the start frame: by its mask, by its box, or as the proposal that looks most like its mesh."""
    if request.mask is not None:
        return resized(read_mask(request.mask, info.width_px, info.height_px), rgb)
    if request.box_xywh_px is not None:
        box = check_box(request.box_xywh_px, info.width_px, info.height_px)
        (mask,) = means.segmenter.segment(rgb, [scaled(box, _scale(info))])
        return mask
    found = [p.mask for p in means.segmenter.propose(rgb, request.name) if large_enough(p.mask, FOR_VIDEOS)]

    def like(mask: Mask) -> float:
        look: Look = look_at_object(means.features, store.settings.extend, [(rgb, mask)])
        guesses = [
            coarse_poses(store, s.key, means.features, look, mask_box(mask), K, s.size_m, top=1, over="union")
            for s in subjects
        ]
        return max(guess.score for (guess,) in guesses)

    if not found:
        raise UserError(
            f"object {request.name!r} was not found in {info.path}; give its box with --box X Y WIDTH HEIGHT, and "
            "another frame with --start-frame where that shows it better"
        )
    return max(found, key=like)


def _filled(T: Array, seen: NDArray[np.bool_]) -> Array:
    """The poses, where the object is out of view those of the nearest frame in which it shows."""
    shown = np.flatnonzero(seen)
    nearest = shown[np.abs(np.arange(len(T))[:, None] - shown).argmin(axis=1)]
    return np.asarray(T[nearest])


def _scale(info: VideoInfo) -> float:
    return min(1.0, WORKING_SIDE_PX / max(info.width_px, info.height_px))


def _how(request: ObjectRequest) -> str:
    if request.mask is not None:
        return "the mask that was given"
    return "the box that was given" if request.box_xywh_px is not None else "found: looks most like its mesh"
