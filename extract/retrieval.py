"""Which stored mesh looks like what a crop shows (FreePose, section 3.1 and appendix A.1).

One product of the query with one descriptor per object finds a short list; the views of those are then compared one by
one and the mean of the best of them decides. Several frames of one object vote with the mean of their scores.

The product takes 16 ms for 50,000 objects of 1024 numbers on one core, and grows with their number. From about a
million on (a third of a second, 4 GB) an index library would pay: searching then takes as long as looking.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .features import foreground_average, object_cells, unit, usual_descriptor
from .geometry import Array
from .mesh_store import About, Index, MeshStore
from .protocols import Floats, Image, Mask, PatchFeatures
from .templates import crop_picture, turned_box
from .vessels import resolve_category

SHORT_LIST = 100
BEST_VIEWS = 2
FRAMES = 30
CLASSICAL_TURNS_DEG = (0.0, -8.0, 8.0, -16.0, 16.0)
CACHE_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True)
class Look:
    """One object in F frames, each turned in its plane by T angles, as an encoder sees it.

    turns_rad: (T,) about the viewing ray, the first of them 0.  boxes_px: (F, T, 2) width and height of the box around
    the object after the turn.  patches: (F, T, G, G, D).  summary: (F, T, E).  cells: (F, T, G, G), of the object.
    """

    turns_rad: Array
    boxes_px: Array
    patches: Floats
    summary: Floats
    cells: NDArray[np.bool_]

    def descriptors(self, column: str) -> Floats:
        """(F, T, D) or (F, T, E) unit vectors: "average" over the object's patches, or the "summary"."""
        if column != "average":
            return unit(self.summary)
        frames, turns, grid = self.cells.shape[:3]
        flat = self.patches.reshape(frames * turns, grid, grid, -1), self.cells.reshape(frames * turns, grid, grid)
        return unit(foreground_average(*flat)).reshape(frames, turns, -1)


@dataclass(frozen=True)
class Hit:
    """A stored mesh.

    score: cosine in [-1, 1].  best_view: the view that looks most like the query, -1 if none was looked at.
    """

    key: str
    about: About
    score: float
    best_view: int = -1


def look_at_object(
    features: PatchFeatures,
    extend: float,
    frames: Sequence[tuple[Image, Mask]],
    turns_rad: Sequence[float] | None = None,
) -> Look:
    """Crop, mask and encode an object in one or more frames.

    turns_rad: see `Look`; None takes what suits the encoder (`usual_turns_rad`).
    Raises UserError for an empty mask.
    """
    turns = np.asarray(usual_turns_rad(features.name) if turns_rad is None else turns_rad, np.float64)
    crops, masks, sizes = [], [], []
    for k, (rgb, mask) in enumerate(frames):
        if not mask.any():
            raise UserError(f"the mask of frame {k} is empty; leave out frames in which the object is out of view")
        for angle in turns:
            turn, box = turned_box(mask, float(angle))
            crop, cropped = crop_picture(rgb, mask, box, extend, features.crop_px, turn=turn)
            crops.append(crop)
            masks.append(cropped)
            sizes.append(box[2:])
    stack, shape = np.stack(masks), (len(frames), len(turns))
    grid = features.encode(np.stack(crops), stack)
    return Look(
        turns,
        np.array(sizes, np.float64).reshape(*shape, 2),
        grid.patches.reshape(*shape, *grid.patches.shape[1:]),
        grid.summary.reshape(*shape, -1),
        object_cells(stack, features.grid).reshape(*shape, features.grid, features.grid),
    )


def usual_turns_rad(encoder: str) -> tuple[float, ...]:
    """Turns by which an encoder wants a picture seen: networks bear the spacing of views, histograms do not."""
    return tuple(np.deg2rad(CLASSICAL_TURNS_DEG)) if encoder.startswith("classical") else (0.0,)


def spread_frames(visible: NDArray[np.bool_], count: int = FRAMES) -> NDArray[np.int64]:
    """Indices of at most `count` frames, spread evenly over those (N,) in which the object is visible."""
    shown = np.flatnonzero(visible)
    if len(shown) <= count:
        return np.asarray(shown, np.int64)
    return np.asarray(shown[np.round(np.linspace(0, len(shown) - 1, count)).astype(int)], np.int64)


def vote(matrix: Floats, descriptors: Floats) -> Floats:
    """(N,) mean over frames of the cosines of objects (N, D) with queries (F, D); all of unit length.

    The mean of products is the product with the mean, so that thirty frames cost what one does.
    """
    return np.asarray(matrix @ np.ascontiguousarray(descriptors.mean(axis=0, dtype=np.float32)))


class Retriever:
    """Searches one store. The views of small databases are kept in memory between queries."""

    def __init__(self, store: MeshStore, column: str | None = None) -> None:
        """column: by which descriptor, "average" or "summary"; None takes the encoder's usual one."""
        self.store = store
        self.column = column or usual_descriptor(store.encoder)
        self.index: Index = store.index()

    @functools.cached_property
    def abouts(self) -> list[About]:
        """What is known of every row of the index."""
        return self.index.about()

    def retrieve(
        self,
        look: Look,
        *,
        top: int = 5,
        text: str | None = None,
        short_list: int = SHORT_LIST,
        best_views: int = BEST_VIEWS,
    ) -> list[Hit]:
        """The `top` meshes most like an object, best first.

        text: keep only meshes with this word in name or category.  best_views: how many of an object's views vote; 0
        leaves the order of the short list, by one descriptor an object.
        Raises UserError when the database is empty or nothing fits the text.
        """
        rows = self._rows(text)
        descriptors = look.descriptors(self.column)
        matrix = self.index.summary if self.column == "summary" else self.index.average
        scores = vote(matrix, descriptors[:, 0])
        order = rows[np.argsort(-scores[rows], kind="stable")][:short_list]
        if best_views == 0:
            return [self._hit(int(row), float(scores[row]), -1) for row in order[:top]]
        hits = []
        for row in order:
            similar = np.einsum("vd,ftd->vft", self._views(int(row)), descriptors, optimize=True).max(axis=2)
            count = min(best_views, len(similar))
            best = np.partition(similar, len(similar) - count, axis=0)[len(similar) - count :]
            hits.append(self._hit(int(row), float(best.mean()), int(np.argmax(similar.mean(axis=1)))))
        return sorted(hits, key=lambda hit: -hit.score)[:top]

    def _hit(self, row: int, score: float, view: int) -> Hit:
        return Hit(self.index.keys[row], self.index.about_row(row), score, view)

    def _rows(self, text: str | None) -> NDArray[np.int64]:
        if len(self.index) == 0:
            raise UserError(f"the mesh database {self.store.root} is empty; fill it with `vid2demo meshes onboard`")
        if text is None:
            return np.arange(len(self.index), dtype=np.int64)
        rows = np.array([row for row, about in enumerate(self.abouts) if matches(about, text)], np.int64)
        if not len(rows):
            known = sorted({about.category for about in self.abouts if about.category})
            rest = f" and {len(known) - 20} more" if len(known) > 20 else ""
            raise UserError(
                f"no mesh of the database is called {text!r}; its categories are {', '.join(known[:20])}{rest}"
            )
        return rows

    @functools.cached_property
    def _kept(self) -> dict[int, Floats]:
        return {}

    def _views(self, row: int) -> Floats:
        """(M, D) descriptors of an object's views."""
        if row not in self._kept:
            record = self.store.views(self.index.keys[row])
            views = np.asarray(record["view_summary" if self.column == "summary" else "view_average"], np.float32)
            if (len(self._kept) + 1) * views.nbytes > CACHE_BYTES:
                return views
            self._kept[row] = views
        return self._kept[row]


def matches(about: About, text: str) -> bool:
    """Whether a person's word means this mesh: part of its name or category, or a word of the library for it."""
    plain, known = _plain(text), f" {_plain(about.category)} {_plain(about.name)} "
    if f" {plain} " in known:
        return True
    try:
        return about.category in resolve_category(text)
    except UserError:
        return False


def _plain(text: str) -> str:
    return " ".join(re.sub(r"[^a-z0-9]+", " ", text.lower()).split())
