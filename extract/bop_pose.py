"""The method run over a data set in BOP's format, from pictures and masks to a results file.

Masks are the data set's own visible ones, or what a segmenter proposes; meshes are retrieved or the true ones; sizes
are the method's, a constant, or the true ones. These are the rows of the paper's tables.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from .bop import Dataset, ImageKey
from .bop_results import Estimate, write_results
from .errors import UserError
from .geometry import make_pose
from .image_pose import ImagePoser, ObjectPose
from .mesh_store import About
from .neural_segment import FOR_IMAGES, large_enough
from .progress import Progress
from .protocols import Proposal, Segmenter
from .segment import mask_box

Meshes = Literal["retrieved", "true"]
Sizes = Literal["own", "true", "constant"]
CONSTANT_M = 0.1


@dataclass(frozen=True)
class Posed:
    """What was found in one picture. obj_ids: the true object behind each proposal, 0 where it is not known."""

    image: ImageKey
    objects: tuple[ObjectPose, ...]
    obj_ids: tuple[int, ...]
    seconds: float


def pose_dataset(
    dataset: Dataset,
    poser: ImagePoser,
    out: Path,
    *,
    segmenter: Segmenter | None = None,
    prompt: str = "objects.",
    meshes: Meshes = "retrieved",
    sizes: Sizes = "own",
    progress: Progress | None = None,
) -> list[Posed]:
    """Estimate all objects of the pictures that have targets and write the results file `out`.

    segmenter: proposes the objects; None takes the data set's visible masks.  meshes: "true" needs a database of the
    data set's own models, named obj_NNNNNN, and its masks.
    Raises UserError when the data set lacks what is asked for.
    """
    if segmenter is not None and (meshes == "true" or sizes == "true"):
        raise UserError("true meshes and sizes belong to true masks; leave the segmenter out")
    known = {about.name: key for about, key in zip(poser.retriever.abouts, poser.retriever.index.keys, strict=True)}
    found, estimates = [], []
    images = sorted({target.image for target in dataset.targets})
    for done, image in enumerate(images, start=1):
        rgb = dataset.rgb(image)
        start = time.perf_counter()
        if segmenter is None:
            proposals, obj_ids = _true_proposals(dataset, image)
        else:
            proposals = [p for p in segmenter.propose(rgb, prompt) if large_enough(p.mask, FOR_IMAGES)]
            obj_ids = [0] * len(proposals)
        keys = [_key_of(known, obj_id) for obj_id in obj_ids] if meshes == "true" else None
        sizes_m = None
        if sizes != "own":
            models = dataset.models if sizes == "true" else {}
            sizes_m = [max(models[obj_id].extents_m) if models else CONSTANT_M for obj_id in obj_ids]
        poses = poser.pose(rgb, proposals, dataset.camera_matrix(image), keys=keys, sizes_m=sizes_m)
        seconds = time.perf_counter() - start
        found.append(Posed(image, tuple(poses), tuple(obj_ids), seconds))
        for pose, obj_id in zip(poses, obj_ids, strict=True):
            estimates.append(_estimate(image, pose, obj_id if meshes == "true" else 0, seconds))
        if progress is not None:
            progress(done, len(images), f"{len(poses)} objects in scene {image.scene_id}, image {image.im_id}")
    write_results(out, estimates)
    return found


def mesh_word(about: About) -> str:
    """How a results file names a mesh: "library:CATEGORY:SEED", or the path of its file."""
    return about.source.replace("/", ":") if about.source.startswith("library/") else about.source


def _true_proposals(dataset: Dataset, image: ImageKey) -> tuple[list[Proposal], list[int]]:
    proposals, obj_ids = [], []
    for there in dataset.objects(image):
        mask = dataset.mask(image, there.index)
        if mask is None:
            raise UserError(f"{dataset.root}: scene {image.scene_id}, image {image.im_id} has no visible masks")
        if mask.any():
            proposal = Proposal(mask, mask_box(mask), 1.0)
            if large_enough(proposal.mask, FOR_IMAGES):
                proposals.append(proposal)
                obj_ids.append(there.obj_id)
    return proposals, obj_ids


def _key_of(known: dict[str, str], obj_id: int) -> str:
    name = f"obj_{obj_id:06d}"
    if name not in known:
        raise UserError(f"the mesh database has no {name}; onboard the data set's models into a database of their own")
    return known[name]


def _estimate(image: ImageKey, pose: ObjectPose, obj_id: int, seconds: float) -> Estimate:
    estimate = Estimate(image, obj_id, pose.score, pose.T_camera_object, seconds)
    if obj_id == 0:
        return replace(estimate, mesh=mesh_word(pose.hit.about), size_m=pose.size_m)
    # A data set's model has an origin of its own, which need not be the middle of its box.
    about = pose.hit.about
    metres = max(about.extents_m) / (2 * about.half_extent)
    back = make_pose(None, -np.asarray(about.centre) * metres)
    return replace(estimate, T_camera_object=pose.T_camera_object @ back)


def category_ranks(found: Sequence[Posed], categories: dict[int, str]) -> list[int]:
    """Of every object, at which place of the retrieved ones its true category first comes, from 0; -1 for none."""
    ranks = []
    for posed in found:
        for pose, obj_id in zip(posed.objects, posed.obj_ids, strict=True):
            order = list(dict.fromkeys(hit.about.category for hit in (pose.hit, *pose.others)))
            ranks.append(order.index(categories[obj_id]) if categories[obj_id] in order else -1)
    return ranks
