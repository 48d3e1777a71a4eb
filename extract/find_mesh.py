"""Which stored mesh a video shows, and how large that is (FreePose, section 3.1 and appendices A.1 and A.3).

The object is masked all the way; thirty frames vote for the mesh, and the median over them is the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, tee
from pathlib import Path

import cv2
import numpy as np

from .errors import UserError
from .geometry import Array, focal_prior_camera_matrix
from .masks import read_mask
from .neural_segment import FOR_VIDEOS, large_enough
from .protocols import Box, DepthEstimator, Image, Mask, PatchFeatures, Segmenter
from .retrieval import FRAMES, Hit, Retriever, look_at_object, spread_frames
from .scale import SizeReader, scene_sizes
from .segment import check_box, mask_box
from .video import iterate_frames, read_video_info

WORK_SIDE_PX = 640
OTHER_OVERLAP = 0.5  # of the smaller one: a proposal that shares more with the object is the object, or a part of it


@dataclass(frozen=True)
class SizeMeans:
    """What reads sizes off pictures: the usual ones by words, and how objects of a frame compare by depth."""

    words: SizeReader
    depth: DepthEstimator


@dataclass(frozen=True)
class Found:
    """The meshes most like an object, best first.

    frames: that voted: those of the chosen in which it shows.  size_m: largest full extent; None where nothing reads
    it.
    """

    hits: tuple[Hit, ...]
    frames: tuple[int, ...]
    size_m: float | None = None


def find_in_video(
    video: Path,
    retriever: Retriever,
    features: PatchFeatures,
    segmenter: Segmenter,
    *,
    box_xywh_px: Box | None = None,
    mask_file: Path | None = None,
    text: str | None = None,
    frames: int = FRAMES,
    top: int = 5,
    sizes: SizeMeans | None = None,
) -> Found:
    """Search for the object that a box or a mask shows in the first frame, in pixels of the video.

    frames: at most so many, spread over the video, vote.  sizes: without these the size is left open.
    Raises UserError when neither or both of box and mask are given, or nothing shows there.
    """
    if (box_xywh_px is None) == (mask_file is None):
        raise UserError("point at the object in the first frame with either --box X Y W H or --mask PNG")
    info = read_video_info(video)
    chosen = set(spread_frames(np.ones(info.frame_count, bool), max(frames, 1)).tolist())
    scale = min(1.0, WORK_SIDE_PX / max(info.width_px, info.height_px))
    stream = iterate_frames(video, WORK_SIDE_PX, info)
    first = next(stream)
    if mask_file is not None:
        whole = read_mask(mask_file, info.width_px, info.height_px).astype(np.uint8)
        start = cv2.resize(whole, first.rgb.shape[1::-1], interpolation=cv2.INTER_AREA) > 0
    else:
        assert box_xywh_px is not None
        box = check_box(box_xywh_px, info.width_px, info.height_px)
        x, y, w, h = (scale * v for v in box)
        (start,) = segmenter.segment(first.rgb, [(x, y, w, h)])
    shown: list[tuple[Image, Mask]] = []
    voted: list[int] = []
    # Whoever carries the masks may read ahead; the pictures must not get out of step with them.
    seen, carried = tee(frame.rgb for frame in chain([first], stream))
    for index, (rgb, (mask,)) in enumerate(zip(seen, segmenter.propagate(carried, [np.asarray(start)]), strict=False)):
        if index in chosen and large_enough(mask, FOR_VIDEOS):
            shown.append((rgb, mask))
            voted.append(index)
    if not shown:
        raise UserError(f"nothing that could be told apart shows in {video} there; give a --mask instead")
    look = look_at_object(features, retriever.store.settings.extend, shown)
    hits = tuple(retriever.retrieve(look, top=top, text=text))
    return Found(hits, tuple(voted), None if sizes is None else size_over_frames(shown, segmenter, sizes))


def size_over_frames(shown: Sequence[tuple[Image, Mask]], segmenter: Segmenter, means: SizeMeans) -> float:
    """Largest full extent [m] of the object of frames and masks: the median of what each frame says by itself.

    In every frame the object is compared with whatever else is found there; alone it has the size of the table.
    """
    height, width = shown[0][1].shape
    camera_matrix: Array = focal_prior_camera_matrix(width, height)
    found = []
    for rgb, mask in shown:
        proposed = [p.mask for p in segmenter.propose(rgb, "objects.") if large_enough(p.mask, FOR_VIDEOS)]
        masks = [mask, *(other for other in proposed if _overlap(other, mask) < OTHER_OVERLAP)]
        guesses = means.words.guess(rgb, masks, [mask_box(one) for one in masks])
        depth = means.depth.estimate(rgb, camera_matrix)
        found.append(scene_sizes(depth, masks, camera_matrix, [guess.size_m for guess in guesses]).sizes_m[0])
    return float(np.median(found))


def _overlap(one: Mask, other: Mask) -> float:
    """What two masks share, of the smaller one."""
    return float(np.count_nonzero(one & other) / min(np.count_nonzero(one), np.count_nonzero(other)))
