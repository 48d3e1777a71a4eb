"""A database of meshes and their views on disk: addressed by content, safe to interrupt, mapped instead of loaded.

    DB/meshes/ab/KEY.npz            a normalised mesh (largest half-extent 1) and, as JSON, what it is and was
    DB/sources/ab/HASH.json         file seen -> key of its mesh
    DB/views/SETTINGS/settings.json how views were taken and encoded
    DB/views/SETTINGS/ab/KEY.npy    what is stored of its views: one record, see `record_dtype`
    DB/views/SETTINGS/index/HASH/   columns over all objects, rebuilt from the records when their set has changed

Every file is written under a temporary name and renamed. The index is a copy: its folder is named by the hash of the
keys it holds, its rows are in the order of the keys, so that a row cannot come to mean another mesh.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .files import atomic_path, write_json
from .geometry import Array
from .protocols import Floats, PatchFeatures
from .templates import ColoredMesh, ViewSettings

SCHEMA, SCHEMA_VERSION = "vid2demo/mesh-database", 1
COLUMNS = ("average", "summary")


@dataclass(frozen=True)
class About:
    """What is known of a mesh.

    name, category: for a person and for the text filter; the category may be empty.  source: where it came from.
    centre, half_extent: of the bounding box in the file's unit: vertex_file = vertex * half_extent + centre.
    unit: of the file, "" when its size is no clue.  extents_m: (3,) full sizes along the file's axes; all zero when
    the unit is unknown.  faces_in_file: before decimation.
    """

    name: str
    category: str
    source: str
    centre: tuple[float, float, float]
    half_extent: float
    unit: str
    extents_m: tuple[float, float, float]
    faces_in_file: int

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> About:
        triples = {key: tuple(float(v) for v in value[key]) for key in ("centre", "extents_m")}
        return About(**{**value, **triples})


@dataclass(frozen=True)
class StoredMesh:
    """A normalised mesh and what is known of it."""

    mesh: ColoredMesh
    about: About


def record_dtype(views: int, patch_size: int, summary_size: int) -> np.dtype[Any]:
    """What is stored of an object's views.

    key: the mesh's.  average, summary: descriptors over all views, of unit length.  view_average, view_summary: of
    each view, of unit length, half precision.  visible: full width and height of the visible surface over the largest
    half-extent, for FreePose's equation 2.
    """
    return np.dtype(
        [
            ("key", "S64"),
            ("average", "<f4", (patch_size,)),
            ("summary", "<f4", (summary_size,)),
            ("view_average", "<f2", (views, patch_size)),
            ("view_summary", "<f2", (views, summary_size)),
            ("visible", "<f4", (views, 2)),
        ]
    )


@dataclass(frozen=True)
class Index:
    """Columns over all objects, rows in the order of `keys`; the descriptors are mapped from disk.

    average: (N, D), summary: (N, E) float32.
    """

    keys: tuple[str, ...]
    average: Floats
    summary: Floats
    folder: Path

    def __len__(self) -> int:
        return len(self.keys)

    def about(self) -> list[About]:
        """What is known of every row."""
        return [self.about_row(row) for row in range(len(self))]

    def about_row(self, row: int) -> About:
        """What is known of one row; the first call reads the list, which takes a moment in a large database."""
        return About.from_json(self._entries[row])

    @functools.cached_property
    def _entries(self) -> list[dict[str, Any]]:
        entries: list[dict[str, Any]] = json.loads((self.folder / "about.json").read_text("utf-8"))
        return entries


class MeshStore:
    """The views of one encoder and one set of view settings in a database folder, and the meshes they are of."""

    def __init__(self, root: Path | str, settings: ViewSettings, encoder: str, patch_size: int, summary_size: int):
        self.root, self.settings, self.encoder = Path(root), settings, encoder
        self.patch_size, self.summary_size = patch_size, summary_size
        self.views_folder = self.root / "views" / settings.digest(encoder)
        self.dtype = record_dtype(settings.count, patch_size, summary_size)

    @staticmethod
    def create(root: Path | str, settings: ViewSettings, features: PatchFeatures) -> MeshStore:
        """A store that is made where there is none. Raises UserError when the folder holds something else."""
        store = MeshStore(root, settings, features.name, features.patch_size, features.summary_size)
        manifest = store.root / "database.json"
        if not manifest.exists():
            if store.root.exists() and any(store.root.iterdir()):
                raise UserError(f"--out {root} holds files but no mesh database; give a new folder")
            write_json(manifest, {"schema": SCHEMA, "version": SCHEMA_VERSION})
        _check_manifest(store.root)
        entry: dict[str, Any] = {"views": asdict(settings), "encoder": features.name}
        entry |= {"patch_size": features.patch_size, "summary_size": features.summary_size}
        if not (store.views_folder / "settings.json").exists():
            write_json(store.views_folder / "settings.json", entry)
        return store

    @staticmethod
    def open(root: Path | str, encoder: str | None = None, views: int | None = None) -> MeshStore:
        """The store of an existing folder; the beginning of the encoder's name and the views choose among several.

        Raises UserError when the folder is no database, or the choice fits none or several.
        """
        _check_manifest(Path(root))
        found = []
        for file in sorted(Path(root).glob("views/*/settings.json")):
            entry = json.loads(file.read_text("utf-8"))
            store = MeshStore(
                root, ViewSettings(**entry["views"]), entry["encoder"], entry["patch_size"], entry["summary_size"]
            )
            if store.encoder.startswith(encoder or "") and views in (None, store.settings.count):
                found.append(store)
        if len(found) != 1:
            all_of = [f"{s.encoder} with {s.settings.count} views" for s in found]
            told = f"several that fit: {', '.join(all_of)}; name the encoder or the views" if found else "none that fit"
            raise UserError(f"the mesh database {root} has descriptors of {told}; `meshes onboard` makes more")
        return found[0]

    @contextmanager
    def only_writer(self) -> Iterator[None]:
        """Hold the database for this process, and clear away what a killed one left unfinished."""
        handle = os.open(self.root, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UserError(f"another vid2demo is at work in {self.root}; wait for it") from error
            for rest in self.root.glob("**/.*.part*"):
                shutil.rmtree(rest) if rest.is_dir() else rest.unlink(missing_ok=True)
            yield
        finally:
            os.close(handle)

    def keys(self) -> list[str]:
        """Keys of all objects whose views are stored, in order: what is there, not what an index says."""
        found = []
        for folder in _folders(self.views_folder):
            with os.scandir(folder) as entries:
                found += [e.name[:-4] for e in entries if e.name.endswith(".npy") and not e.name.startswith(".")]
        return sorted(found)

    def has_views(self, key: str) -> bool:
        return self._views_file(key).exists()

    def has_mesh(self, key: str) -> bool:
        return self._mesh_file(key).exists()

    def write_mesh(self, stored: StoredMesh) -> str:
        """Store a mesh and return its key; nothing is written when it is there already."""
        key = mesh_key(stored)
        if not self.has_mesh(key):
            with atomic_path(self._mesh_file(key)) as temporary, open(temporary, "wb") as stream:
                mesh = stored.mesh
                np.savez(
                    stream,
                    vertices=mesh.vertices.astype("<f4"),
                    faces=mesh.faces.astype("<i4"),
                    colors=mesh.colors,
                    about=np.array(json.dumps(asdict(stored.about))),
                )
        return key

    def mesh(self, key: str) -> StoredMesh:
        """A stored mesh. Raises UserError when it is missing or damaged."""
        try:
            with np.load(self._mesh_file(key), allow_pickle=False) as arrays:
                about = About.from_json(json.loads(str(arrays["about"])))
                mesh = ColoredMesh(arrays["vertices"].astype(np.float64), arrays["faces"], arrays["colors"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"the mesh {key[:12]} of {self.root} cannot be read ({error}); onboard it again") from error
        return StoredMesh(mesh, about)

    def write_views(self, key: str, view_average: Floats, view_summary: Floats, visible: Array) -> None:
        """Store what was measured in the views of a mesh: (M, D), (M, E) and (M, 2); descriptors of unit length."""
        record = np.zeros(1, self.dtype)
        row = record[0]
        row["key"] = key.encode()
        row["view_average"], row["view_summary"], row["visible"] = view_average, view_summary, visible
        row["average"], row["summary"] = _mean_direction(row["view_average"]), _mean_direction(row["view_summary"])
        with atomic_path(self._views_file(key)) as temporary:
            np.save(temporary, record, allow_pickle=False)

    def views(self, key: str) -> Any:
        """The record of an object, mapped from disk (see `record_dtype`). Raises UserError when missing or damaged."""
        try:
            record = np.load(self._views_file(key), mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise UserError(f"the views of {key[:12]} in {self.root} cannot be read ({error})") from error
        if record.dtype != self.dtype or record.shape != (1,) or record["key"][0] != key.encode():
            raise UserError(f"the views of {key[:12]} in {self.root} are not of that mesh or of other settings")
        return record[0]

    def index(self) -> Index:
        """The index over what is stored now; rebuilt first when objects have come or gone."""
        keys = self.keys()
        folder = self.index_folder(keys)
        if not folder.is_dir():
            self._build_index(keys, folder)
        columns = {name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in COLUMNS}
        return Index(tuple(keys), columns["average"], columns["summary"], folder)

    def patches(self, key: str) -> Path:
        """Where the patch features of all views of a mesh are kept once they were asked for."""
        return self.views_folder / "patches" / key[:2] / f"{key}.npy"

    def source_file(self, digest: str) -> Path:
        """Where it is noted which mesh a file, known by its hash, became."""
        return self.root / "sources" / digest[:2] / f"{digest}.json"

    def check(self) -> list[str]:
        """What is wrong with the database, in words; empty when every mesh, record and row is what its name says."""
        problems, index = [], self.index()
        entries = index.about()
        for row, key in enumerate(index.keys):
            try:
                stored, record = self.mesh(key), self.views(key)
            except UserError as error:
                problems.append(str(error))
                continue
            name = f"{stored.about.name} ({key[:12]})"
            if mesh_key(stored) != key:
                problems.append(f"{name}: the mesh has changed since it was stored")
            if entries[row] != stored.about:
                problems.append(f"{name}: row {row} of the index names {entries[row].name}")
            for column, views in (("average", "view_average"), ("summary", "view_summary")):
                if not np.all(np.isfinite(record[views].astype(np.float32))):
                    problems.append(f"{name}: its {column} descriptors are not finite")
                elif not np.allclose(record[column], _mean_direction(record[views]), atol=1e-5):
                    problems.append(f"{name}: its {column} descriptor is not that of its views")
                elif not np.array_equal(record[column], getattr(index, column)[row]):
                    problems.append(f"{name}: row {row} of the index holds another {column} descriptor")
        return problems

    def _mesh_file(self, key: str) -> Path:
        return self.root / "meshes" / key[:2] / f"{key}.npz"

    def _views_file(self, key: str) -> Path:
        return self.views_folder / key[:2] / f"{key}.npy"

    def index_folder(self, keys: Sequence[str]) -> Path:
        """Where the columns over exactly these keys, which are in order, belong."""
        digest = hashlib.sha256("\n".join(keys).encode()).hexdigest()[:32]
        return self.views_folder / "index" / digest

    def _build_index(self, keys: Sequence[str], folder: Path) -> None:
        """Write the columns beside and rename the folder; older indices are then of no use."""
        known = self._rows_of_newest_index()
        temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        widths = dict(zip(COLUMNS, (self.patch_size, self.summary_size), strict=True))
        columns = {name: np.zeros((len(keys), width), np.float32) for name, width in widths.items()}
        entries = []
        for row, key in enumerate(keys):
            if key in known:
                values, entry = known[key]
            else:
                values, entry = self.views(key), asdict(self.mesh(key).about)
            for name, column in columns.items():
                column[row] = values[name]
            entries.append(entry)
        for name, column in columns.items():
            np.save(temporary / f"{name}.npy", column, allow_pickle=False)
        (temporary / "keys.json").write_text(json.dumps(list(keys)), "utf-8")
        (temporary / "about.json").write_text(json.dumps(entries), "utf-8")
        try:
            os.replace(temporary, folder)
        except OSError:  # another process has just built the same
            shutil.rmtree(temporary, ignore_errors=True)
        for other in folder.parent.iterdir():
            if other != folder and not other.name.startswith("."):
                shutil.rmtree(other, ignore_errors=True)

    def _rows_of_newest_index(self) -> dict[str, tuple[Mapping[str, Any], dict[str, Any]]]:
        folders = [f for f in (self.views_folder / "index").glob("*") if not f.name.startswith(".")]
        if not folders:
            return {}
        newest = max(folders, key=lambda f: f.stat().st_mtime)
        columns = {name: np.load(newest / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in COLUMNS}
        keys, entries = (json.loads((newest / f"{n}.json").read_text("utf-8")) for n in ("keys", "about"))
        return {
            key: ({name: column[row] for name, column in columns.items()}, entry)
            for row, (key, entry) in enumerate(zip(keys, entries, strict=True))
        }


def mesh_key(stored: StoredMesh) -> str:
    """Hex SHA-256 of a normalised mesh, its colours and its size."""
    mesh, about = stored.mesh, stored.about
    digest = hashlib.sha256(np.ascontiguousarray(mesh.vertices, "<f4").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, "<i4").tobytes())
    digest.update(np.ascontiguousarray(mesh.colors, np.uint8).tobytes())
    digest.update(json.dumps([about.half_extent, about.unit]).encode())
    return digest.hexdigest()


def _mean_direction(views: NDArray[np.float16]) -> Floats:
    mean = np.asarray(views, np.float32).mean(axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12), np.float32)


def _folders(root: Path) -> list[str]:
    """Folders of two hexadecimal digits."""
    if not root.is_dir():
        return []
    with os.scandir(root) as entries:
        return [entry.path for entry in entries if len(entry.name) == 2 and entry.is_dir()]


def _check_manifest(root: Path) -> None:
    manifest = root / "database.json"
    if not manifest.is_file():
        raise UserError(f"{root} is no mesh database: it has no database.json; `vid2demo meshes onboard` makes one")
    try:
        found = json.loads(manifest.read_text("utf-8"))
    except ValueError as error:
        raise UserError(f"{manifest} cannot be read ({error}); take the database from its copy") from error
    if found.get("schema") != SCHEMA or found.get("version") != SCHEMA_VERSION:
        raise UserError(f"{manifest} tells of {found}; this program reads {SCHEMA} version {SCHEMA_VERSION}")
