"""Meshes into the database: read, cleaned, normalised, seen from all sides, described, stored; each once.

Work is by mesh, in processes of their own; what one has written is complete, so that a killed command goes on where it
was. A mesh that cannot be read is told about and left out.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError
from .features import foreground_average, make_features, object_cells, unit
from .files import write_json
from .mesh_sources import MeshSource
from .mesh_store import About, MeshStore, StoredMesh
from .meshes import METRES_PER_UNIT, guess_unit, load_mesh_of_unknown_size
from .parallel import in_processes, on_cluster
from .progress import Progress
from .protocols import PatchFeatures
from .templates import ColoredMesh, ViewSettings, template_view
from .vessels import make_vessel

MAX_FACES = 20_000
BATCH = 30
VERSION = "1"


@dataclass
class Onboarded:
    """What came of a folder: meshes stored now, those stored before, and (name, reason) of those left out.

    same: names of meshes that another one of the folder equals.
    """

    stored: list[str] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    same: list[str] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Job:
    """Everything a worker needs to know; it makes the rest itself."""

    source: MeshSource
    root: Path
    settings: ViewSettings
    encoder: str
    unit: str
    options: tuple[tuple[str, str], ...] = ()


def read_source(source: MeshSource, unit_name: str = "auto") -> StoredMesh:
    """A source's mesh, decimated to MAX_FACES, its bounding box centred, its largest half-extent brought to 1.

    unit_name: of the file's numbers; "auto" guesses it, or leaves the size open where no unit makes sense of it.
    Raises UserError for what cannot be read.
    """
    if source.is_of_library:
        _, category, seed = source.path.split("/")
        raw = make_vessel(category, int(seed)).mesh
        found: str | None = "m"
    else:
        raw = load_mesh_of_unknown_size(source.path, max_faces=MAX_FACES)
        found = guess_unit(float(np.max(raw.extents))) if unit_name == "auto" else unit_name
    vertices, faces = np.asarray(raw.vertices, np.float64), np.asarray(raw.faces, np.int32)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre, half = (low + high) / 2, float((high - low).max() / 2)
    if not math.isfinite(half) or half <= 0:
        raise UserError(f"{source.path} has an extent of {2 * half:g}; export the object's surface again")
    size_m = (high - low) * METRES_PER_UNIT[found] if found else np.zeros(3)
    about = About(
        source.name,
        source.category,
        source.path,
        (float(centre[0]), float(centre[1]), float(centre[2])),
        half,
        found or "",
        (float(size_m[0]), float(size_m[1]), float(size_m[2])),
        int(raw.metadata.get("faces_in_file", len(faces))),
    )
    # Rounded as it is stored, so that the key of what is read back is the same.
    normalised = ((vertices - centre) / half).astype(np.float32).astype(np.float64)
    return StoredMesh(ColoredMesh(normalised, faces, _colors(raw)), about)


def describe_views(store: MeshStore, key: str, mesh: ColoredMesh, features: PatchFeatures) -> None:
    """Draw and encode all views of a normalised mesh and store what they say."""
    count, settings = store.settings.count, store.settings
    average = np.empty((count, features.patch_size), np.float32)
    summary = np.empty((count, features.summary_size), np.float32)
    visible = np.empty((count, 2))
    for first in range(0, count, BATCH):
        rows = range(first, min(first + BATCH, count))
        views = [template_view(mesh, settings, index, features.crop_px) for index in rows]
        masks = np.stack([view.mask for view in views])
        encoded = features.encode(np.stack([view.rgb for view in views]), masks)
        at = slice(rows.start, rows.stop)
        average[at] = unit(foreground_average(encoded.patches, object_cells(masks, features.grid)))
        summary[at] = unit(encoded.summary)
        visible[at] = [view.visible for view in views]
    store.write_views(key, average, summary, visible)


def onboard_one(job: Job) -> tuple[str, str]:
    """Store one mesh and its views unless they are there: ("stored" | "before" | "failed", key or reason)."""
    features = _features(job.encoder, job.options)
    store = MeshStore.create(job.root, job.settings, features)
    try:
        note = store.source_file(job.source.digest(f"{VERSION} {MAX_FACES} {job.unit}"))
        key = _noted(note, store)
        if key is not None and store.has_views(key):
            return "before", key
        stored = read_source(job.source, job.unit) if key is None else store.mesh(key)
        key = store.write_mesh(stored)
        fresh = not store.has_views(key)
        if fresh:
            describe_views(store, key, stored.mesh, features)
        write_json(note, {"mesh": key, "source": job.source.path})
        return ("stored" if fresh else "same"), key
    except (UserError, ValueError, ArithmeticError, MemoryError, OSError) as error:
        return "failed", str(error)


def onboard(
    sources: Sequence[MeshSource],
    root: Path | str,
    *,
    settings: ViewSettings = ViewSettings(),  # noqa: B008 - frozen
    encoder: str = "classical",
    options: tuple[tuple[str, str], ...] = (),
    unit_name: str = "auto",
    workers: int = 1,
    ray: bool = False,
    gpus: float = 0.0,
    progress: Progress | None = None,
) -> Onboarded:
    """Bring meshes into the database at `root`, which is made when missing.

    encoder: a name that `features.make_features` knows, `options` for it.  workers: processes.  ray: work on a cluster
    (`parallel.on_cluster`) whose machines all see `root` and the meshes under the same paths, each task with `gpus`.
    Raises UserError for a folder that is no database, or that another process writes to.
    """
    store = MeshStore.create(root, settings, make_features(encoder, dict(options)))
    jobs = [Job(source, Path(root).absolute(), settings, encoder, unit_name, options) for source in sources]
    result = Onboarded()
    done: list[tuple[str, str, str]] = []
    with store.only_writer():
        ends = on_cluster(onboard_one, jobs, workers, gpus) if ray else in_processes(onboard_one, jobs, workers)
        for count, (job, end) in enumerate(ends, start=1):
            state, found = end or ("failed", "the process at work on it died; it may need more memory than there is")
            if state == "failed":
                result.failed.append((job.source.name, found))
            else:
                done.append((job.source.name, state, found))
            if progress is not None:
                progress(count, len(jobs), job.source.name)
        store.index()
    owners: dict[str, int] = {}  # of equal meshes the one that was stored, whichever ended first
    for place in sorted(range(len(done)), key=lambda k: done[k][1] == "same"):
        owners.setdefault(done[place][2], place)
    for place, (name, state, key) in enumerate(done):
        if owners[key] != place:
            result.same.append(name)
        else:
            # Views without a note of their source are of a command that was killed between the two.
            (result.stored if state == "stored" else result.before).append(name)
    return result


@functools.lru_cache(maxsize=1)
def _features(encoder: str, options: tuple[tuple[str, str], ...]) -> PatchFeatures:
    """A worker's encoder: a network is loaded once, not for every mesh."""
    return make_features(encoder, dict(options))


def _noted(note: Path, store: MeshStore) -> str | None:
    """The key of the mesh that a file became, when both note and mesh are there."""
    try:
        key = str(json.loads(note.read_text("utf-8"))["mesh"])
    except (OSError, ValueError, KeyError):
        return None
    return key if store.has_mesh(key) else None


def _colors(mesh: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(V, 3) vertex colours; those of faces go to their corners."""
    if getattr(mesh.visual, "kind", None) == "face":
        colors = np.zeros((len(mesh.vertices), 3), np.uint8)
        colors[np.asarray(mesh.faces).ravel()] = np.repeat(np.asarray(mesh.visual.face_colors)[:, :3], 3, axis=0)
        return colors
    return np.array(np.asarray(mesh.visual.vertex_colors)[:, :3], np.uint8)
