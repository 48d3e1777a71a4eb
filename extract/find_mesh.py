"""Which stored mesh a video shows (FreePose, appendix A.1): the object is masked all the way, thirty frames vote."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, tee
from pathlib import Path

import cv2
import numpy as np

from .errors import UserError
from .masks import read_mask
from .neural_segment import FOR_VIDEOS, large_enough
from .protocols import Box, Image, Mask, PatchFeatures, Segmenter
from .retrieval import FRAMES, Hit, Retriever, look_at_object, spread_frames
from .segment import check_box
from .video import iterate_frames, read_video_info

WORK_SIDE_PX = 640


@dataclass(frozen=True)
class Found:
    """The meshes most like an object, best first, and the frames that voted: those of the chosen in which it shows."""

    hits: tuple[Hit, ...]
    frames: tuple[int, ...]


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
) -> Found:
    """Search for the object that a box or a mask shows in the first frame, in pixels of the video.

    frames: at most so many, spread over the video, vote.
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
    return Found(tuple(retriever.retrieve(look, top=top, text=text)), tuple(voted))
