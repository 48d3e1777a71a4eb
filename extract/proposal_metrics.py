"""How good proposals of objects are before anybody knows what they are: average precision and recall, as COCO has them.

One class for all objects. A proposal finds an object when their masks overlap enough, the surest choose first, and
figures are means over ten overlaps from 0.50 to 0.95 (Lin et al., Microsoft COCO, 2014; paper, appendix A.4.2).
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bop import Dataset, ImageKey, mask_from_rle, read_json, rle_from_mask
from .errors import UserError
from .files import write_text
from .geometry import Array
from .protocols import Mask

OVERLAPS = np.linspace(0.5, 0.95, 10)
LEAST_VISIBLE = 0.1  # of its silhouette; objects less visible neither need to be found nor count as wrong
MOST_PROPOSALS = 100  # of a picture, the surest
_RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class ProposalScores:
    """ap, ar_at_10: in percent. per_image: proposals in a picture, on average."""

    ap: float
    ar_at_10: float
    per_image: float
    objects: int

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class ProposedMask:
    """A proposal in a file: mask (H, W), and how sure its maker is."""

    mask: Mask
    score: float


def judge_proposals(dataset: Dataset, proposals: Mapping[ImageKey, Sequence[ProposedMask]]) -> ProposalScores:
    """Average precision, and average recall of the ten surest proposals of each picture that has targets.

    Raises UserError when the data set stores no masks, or a proposal's is of another size.
    """
    images = sorted({t.image for t in dataset.targets})
    tables = []
    counted = 0
    for image in images:
        true, ignored = _true_masks(dataset, image)
        chosen = sorted(proposals.get(image, ()), key=lambda p: -p.score)[:MOST_PROPOSALS]
        for proposal in chosen:
            if true and proposal.mask.shape != true[0].shape:
                raise UserError(
                    f"a proposal for scene {image.scene_id}, image {image.im_id} has a mask of {proposal.mask.shape}, "
                    f"the picture {true[0].shape}; give masks of the picture's size"
                )
        counted += len(chosen)
        tables.append((np.array([p.score for p in chosen]), overlaps([p.mask for p in chosen], true), ignored))
    objects = sum(int(np.count_nonzero(~ignored)) for _, _, ignored in tables)
    return ProposalScores(
        float(100 * np.mean([average_precision(tables, overlap) for overlap in OVERLAPS])),
        float(100 * np.mean([recall_of_surest(tables, overlap, 10) for overlap in OVERLAPS])),
        counted / max(len(images), 1),
        objects,
    )


Table = tuple[Array, Array, NDArray[np.bool_]]
"""Of one picture: scores (P,), the surest first; overlaps (P, T) with its objects; which objects (T,) do not count."""


def overlaps(proposed: Sequence[Mask], true: Sequence[Mask]) -> Array:
    """(P, T) intersection over union of masks."""
    if not proposed or not true:
        return np.zeros((len(proposed), len(true)))
    a = np.stack([m.ravel() for m in proposed]).astype(np.float32)
    b = np.stack([m.ravel() for m in true]).astype(np.float32)
    common = a @ b.T
    union = a.sum(axis=1)[:, None] + b.sum(axis=1)[None] - common
    return np.asarray(common / np.maximum(union, 1), float)


def matched(table: Table, overlap: float, most: int = MOST_PROPOSALS) -> NDArray[np.int8]:
    """(P,) 1 for a proposal that finds an object, 0 for a spurious one, -1 for one of an object that does not count."""
    _, iou, ignored = table
    left = np.ones(iou.shape[1], bool)
    kinds = np.zeros(min(len(iou), most), np.int8)
    for k in range(len(kinds)):
        # What counts is chosen before what does not, however well the latter fits.
        for group in (left & ~ignored, left & ignored):
            fits = np.where(group, iou[k], -1.0)
            if len(fits) and fits.max() >= overlap - 1e-10:
                best = int(np.argmax(fits))
                left[best] = False
                kinds[k] = -1 if ignored[best] else 1
                break
    return kinds


def average_precision(tables: Sequence[Table], overlap: float) -> float:
    """Mean of the precision at 101 recalls, each the best at that recall or a higher one; 0 without objects."""
    objects = sum(int(np.count_nonzero(~ignored)) for _, _, ignored in tables)
    if objects == 0:
        return 0.0
    scores = np.concatenate([scores for scores, _, _ in tables])
    kinds = np.concatenate([matched(table, overlap) for table in tables])
    counts = kinds >= 0
    order = np.argsort(-scores[counts], kind="stable")
    right = np.cumsum(kinds[counts][order] == 1)
    recall, precision = right / objects, right / np.arange(1, len(right) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, _RECALLS, side="left")
    return float(np.mean(np.append(best, 0.0)[at]))


def recall_of_surest(tables: Sequence[Table], overlap: float, most: int) -> float:
    """Share of the objects that the `most` surest proposals of each picture find."""
    objects = sum(int(np.count_nonzero(~ignored)) for _, _, ignored in tables)
    found = sum(int(np.count_nonzero(matched(table, overlap, most) == 1)) for table in tables)
    return found / max(objects, 1)


def read_proposals(path: Path) -> dict[ImageKey, list[ProposedMask]]:
    """Proposals as the BOP benchmark's segmentation task has them: a JSON list of {scene_id, image_id, score,
    segmentation: {counts, size}}. Raises UserError naming the file and the entry.
    """
    entries = read_json(path)
    if not isinstance(entries, list):
        raise UserError(f"{path} is not a list of proposals")
    found: dict[ImageKey, list[ProposedMask]] = defaultdict(list)
    for number, entry in enumerate(entries):
        where = f"{path}, entry {number}"
        try:
            image, score = ImageKey(int(entry["scene_id"]), int(entry["image_id"])), float(entry["score"])
            coded = entry["segmentation"]
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{where} lacks or garbles {error}; give scene_id, image_id, score, segmentation"
            ) from error
        found[image].append(ProposedMask(mask_from_rle(coded, where), score))
    return dict(found)


def write_proposals(path: Path, proposals: Mapping[ImageKey, Sequence[ProposedMask]]) -> None:
    """Write proposals as `read_proposals` reads them."""
    entries = [
        {
            "scene_id": image.scene_id,
            "image_id": image.im_id,
            "category_id": 1,
            "score": float(p.score),
            "segmentation": rle_from_mask(p.mask),
        }
        for image, listed in sorted(proposals.items())
        for p in listed
    ]
    write_text(path, json.dumps(entries, allow_nan=False))


def _true_masks(dataset: Dataset, image: ImageKey) -> tuple[list[Mask], NDArray[np.bool_]]:
    masks, ignored = [], []
    for there in dataset.objects(image):
        mask = dataset.mask(image, there.index)
        if mask is None:
            raise UserError(f"{dataset.root} stores no visible masks, so proposals cannot be judged on it")
        masks.append(mask)
        ignored.append((1.0 if there.visible_fraction is None else there.visible_fraction) < LEAST_VISIBLE)
    return masks, np.asarray(ignored, bool)
