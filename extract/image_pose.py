"""All objects of one picture: which stored mesh each looks like, how large it is, where it is and how it is turned.

FreePose's way through a single image (section 3): proposals, retrieval, scale, pose. What does the seeing comes by the
protocols, so classical parts and networks mix as they are at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .coarse_pose import Over, PoseGuess, coarse_poses, fine_poses
from .geometry import Array
from .mesh_store import About, MeshStore, StoredMesh
from .protocols import Box, DepthEstimator, Image, Mask, PatchFeatures, Proposal
from .retrieval import BEST_VIEWS, SHORT_LIST, Hit, Look, Retriever, look_at_object
from .scale import SizeReader, scene_sizes
from .segment import mask_box
from .size_table import SizeTable, own_table

ANY_SIZE_M = 0.15  # of things of which nothing is known
SCORES_TOGETHER = 0.5  # weight of the retrieval's score beside that of the pose when meshes compete


@dataclass(frozen=True)
class PoseSettings:
    """How thoroughly poses are looked for.

    meshes: retrieved ones that compete by their poses.  views: of each, by equation 1.  fine: rotations near the best
    views are drawn too.  over: the cells that equation 1 counts.  best_views, short_list: see `Retriever.retrieve`.
    """

    meshes: int = 1
    views: int = 3
    fine: bool = True
    over: Over = "union"
    best_views: int = BEST_VIEWS
    short_list: int = SHORT_LIST


@dataclass(frozen=True)
class ObjectPose:
    """One object of a picture.

    box_xywh_px: around its mask.  hit: the mesh taken for it.  size_m: largest full extent that its pose is of.
    T_camera_object: (4, 4), of the mesh with the centre of its bounding box at the origin.  score: of the pose, in
    [-1, 1].  others: the other meshes that were retrieved, best first.
    """

    proposal: Proposal
    box_xywh_px: Box
    hit: Hit
    size_m: float
    size_source: str
    T_camera_object: Array
    score: float
    others: tuple[Hit, ...] = field(default=())


class ImagePoser:
    """Poses of objects by one database; templates once used are kept for the next picture."""

    def __init__(
        self,
        store: MeshStore,
        features: PatchFeatures,
        settings: PoseSettings = PoseSettings(),
        *,
        column: str | None = None,
        depth: DepthEstimator | None = None,
        table: SizeTable | None = None,
        words: SizeReader | None = None,
    ) -> None:
        """column: descriptor for retrieval.  depth: compares the objects' sizes, where there are several.

        words: reads usual sizes off the pictures, as the paper does; without it the retrieved mesh tells them.
        """
        self.store, self.features, self.settings = store, features, settings
        self.retriever = Retriever(store, column)
        self._depth, self._table, self._words = depth, table or own_table(), words
        self._meshes: dict[str, StoredMesh] = {}

    def pose(
        self,
        rgb: Image,
        proposals: Sequence[Proposal],
        camera_matrix: Array,
        *,
        text: str | None = None,
        keys: Sequence[str] | None = None,
        sizes_m: Sequence[float] | None = None,
    ) -> list[ObjectPose]:
        """Every proposal with a mask as an object, in their order.

        text: a word that narrows the search and tells usual sizes.  keys: the mesh of each proposal, when it is known.
        sizes_m: their largest extents, when these are known.
        """
        shown = [k for k, proposal in enumerate(proposals) if proposal.mask.any()]
        looks = [look_at_object(self.features, self.store.settings.extend, [(rgb, proposals[k].mask)]) for k in shown]
        hits = [
            self._hits(look, text) if keys is None else [self._known(keys[k])]
            for k, look in zip(shown, looks, strict=True)
        ]
        masks = [proposals[k].mask for k in shown]
        if sizes_m is not None:
            sizes = [(float(sizes_m[k]), "given") for k in shown]
        else:
            sizes = self._reconciled(rgb, masks, camera_matrix, self._guessed(rgb, masks, hits, text))
        return [
            self._best(proposals[k], look, found, size, camera_matrix)
            for k, look, found, size in zip(shown, looks, hits, sizes, strict=True)
        ]

    def mesh(self, key: str) -> StoredMesh:
        """A stored mesh, read once."""
        if key not in self._meshes:
            self._meshes[key] = self.store.mesh(key)
        return self._meshes[key]

    def size_of(self, about: About, word: str | None = None) -> tuple[float, str]:
        """A mesh's usual largest extent [m] and who says so.

        Its own, where its file told the unit and the size table does not contradict; else the table's. The entry is
        that of a person's word for the object, or of the mesh's category.
        """
        entry = (self._table.find(word) if word else None) or self._table.find(about.category or about.name)
        own_m = max(about.extents_m)
        if own_m > 0 and (entry is None or entry.holds(own_m)):
            return own_m, "the mesh"
        return (entry.typical_m, f"the size table: {entry.phrase}") if entry else (ANY_SIZE_M, "nothing known")

    def _hits(self, look: Look, text: str | None) -> list[Hit]:
        chosen = self.settings
        top = max(chosen.meshes, 5)
        return self.retriever.retrieve(
            look, top=top, text=text, short_list=chosen.short_list, best_views=chosen.best_views
        )

    def _known(self, key: str) -> Hit:
        return Hit(key, self.mesh(key).about, 1.0)

    def _guessed(
        self, rgb: Image, masks: Sequence[Mask], hits: Sequence[Sequence[Hit]], word: str | None
    ) -> list[tuple[float, str]]:
        """What such things usually measure [m], and who says so, object by object."""
        if self._words is None or not masks:
            return [self.size_of(found[0].about, word) for found in hits]
        read = self._words.guess(rgb, masks, [mask_box(mask) for mask in masks])
        return [(guess.size_m, guess.source) for guess in read]

    def _reconciled(
        self, rgb: Image, masks: Sequence[Mask], camera_matrix: Array, guessed: Sequence[tuple[float, str]]
    ) -> list[tuple[float, str]]:
        if self._depth is None or len(masks) < 2:
            return list(guessed)
        found = scene_sizes(
            self._depth.estimate(rgb, camera_matrix), masks, camera_matrix, [size for size, _ in guessed]
        )
        return [
            (float(size), "depth and the scene" if np.isfinite(measured) else source)
            for size, measured, (_, source) in zip(found.sizes_m, found.measured, guessed, strict=True)
        ]

    def _best(
        self, proposal: Proposal, look: Look, hits: Sequence[Hit], size: tuple[float, str], camera_matrix: Array
    ) -> ObjectPose:
        """The mesh and the pose that together explain a proposal best."""
        box = mask_box(proposal.mask)
        tried: list[tuple[float, Hit, PoseGuess]] = []
        for hit in hits[: self.settings.meshes]:
            guess = self._posed(hit, look, box, size[0], camera_matrix)
            tried.append((guess.score + SCORES_TOGETHER * hit.score, hit, guess))
        _, hit, guess = max(tried, key=lambda entry: entry[0])
        others = tuple(other for other in hits if other is not hit)
        return ObjectPose(proposal, box, hit, *size, guess.T_camera_object, guess.score, others)

    def _posed(self, hit: Hit, look: Look, box: Box, size_m: float, camera_matrix: Array) -> PoseGuess:
        chosen = self.settings
        guesses = coarse_poses(
            self.store, hit.key, self.features, look, box, camera_matrix, size_m, top=chosen.views, over=chosen.over
        )
        if not chosen.fine:
            return guesses[0]
        mesh = self.mesh(hit.key).mesh.scaled(size_m / 2)
        extend = self.store.settings.extend
        return fine_poses(mesh, self.features, look, box, camera_matrix, guesses, extend, over=chosen.over)[0]
