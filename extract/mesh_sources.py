"""What a folder of meshes holds: which files are objects, what each is called and what it is.

Understood are Objaverse's folders (GLBs named by their uid, LVIS categories in `lvis-annotations.json.gz`), Google
Scanned Objects (NAME/meshes/model.obj, category in `metadata.pbtxt`), folders named by category, flat folders, and
lists (`database.json`: name, category and file of each).
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import UserError
from .files import sha256_of_file
from .vessels import CATEGORIES, resolve_category

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
ANNOTATIONS = ("lvis-annotations.json.gz", "lvis-annotations.json")
LIBRARY = "library"


@dataclass(frozen=True)
class MeshSource:
    """One object to store.

    name, category: for a person; the category may be empty.  path: the mesh file, or LIBRARY/category/seed for a vessel
    of the procedural library.
    """

    name: str
    category: str
    path: str

    @property
    def is_of_library(self) -> bool:
        return self.path.startswith(f"{LIBRARY}/")

    def digest(self, version: str) -> str:
        """Hex hash of the file, the names and sizes of the files beside it that it may draw on, and `version`."""
        digest = hashlib.sha256(version.encode())
        if self.is_of_library:
            digest.update(self.path.encode())
            return digest.hexdigest()
        path = Path(self.path)
        digest.update(sha256_of_file(path).encode())
        if path.suffix.lower() in (".obj", ".gltf"):
            beside = [p for p in path.parent.iterdir() if p.is_file() and p.suffix.lower() not in SUFFIXES]
            textures = path.parent.parent / "materials" / "textures"
            beside += list(textures.iterdir()) if path.parent.name == "meshes" and textures.is_dir() else []
            digest.update(repr(sorted((p.name, p.stat().st_size) for p in beside)).encode())
        return digest.hexdigest()


def find_sources(folder: Path, category: str | None = None) -> list[MeshSource]:
    """Objects of a folder, sorted by path; `category` overrides what the layout says.

    Raises UserError when there is no mesh file in it.
    """
    if (listed := folder / "database.json").is_file():
        return _listed(listed)
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder; give one with {', '.join(SUFFIXES)} files, or the word {LIBRARY!r}")
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if not files:
        raise UserError(f"{folder} holds no mesh file ({', '.join(SUFFIXES)}); give the folder where they are")
    of_uid = _annotations(folder)
    # The collision hulls that Google Scanned Objects and simulators bring are no objects of their own.
    files = [p for p in files if "collision" not in p.stem.lower() or len(files) == 1]
    return [_source(path, folder, of_uid, category) for path in files]


def library_sources(variants: int) -> list[MeshSource]:
    """`variants` seeded vessels of each category of the procedural library."""
    return [MeshSource(f"{c}:{seed}", c, f"{LIBRARY}/{c}/{seed}") for c in CATEGORIES for seed in range(variants)]


def _source(path: Path, root: Path, of_uid: Mapping[str, str], category: str | None) -> MeshSource:
    parents = path.relative_to(root).parts[:-1]
    name, found = path.stem, ""
    if name in of_uid:
        found = of_uid[name]
    elif path.parent.name == "meshes" and (len(parents) > 1 or (path.parents[1] / "metadata.pbtxt").is_file()):
        name = path.parents[1].name  # Google Scanned Objects
        found = _scanned_category(path.parents[1] / "metadata.pbtxt") or _from_name(name)
    elif parents and parents[-1] == path.stem:  # one folder an object, as the paper's own script leaves them
        found = parents[-2] if len(parents) > 1 else of_uid.get(name, _from_name(name))
    elif parents and not re.fullmatch(r"[\d-]+|meshes|models|glbs", parents[-1]):
        found = parents[-1]
    else:
        found = _from_name(name)
    # The whole path: results that name the mesh are read from other folders too.
    return MeshSource(name, category if category is not None else found.replace(" ", "_"), str(path.resolve()))


def _listed(file: Path) -> list[MeshSource]:
    """Objects of a `database.json`, as `vid2demo synthesize bop` writes it beside a data set."""
    try:
        entries = json.loads(file.read_text("utf-8"))
        found = []
        for entry in entries:
            path = str((file.parent / entry["file"]).resolve())
            if vessel := entry.get("library"):
                path = f"{LIBRARY}/{vessel['category']}/{int(vessel['seed'])}"
            found.append(MeshSource(str(entry["name"]), str(entry["category"]), path))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{file} is no list of meshes ({error}); each needs name, category and file") from error
    return found


def _from_name(name: str) -> str:
    """The library's word in a file's name ("red_coffee_mug" is a mug), else the name less its number; none in a uid."""
    if re.fullmatch(r"[0-9a-f]{24,}", name):
        return ""
    words = re.sub(r"[^a-z]+", " ", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()).split()
    for length in range(len(words), 0, -1):
        for first in reversed(range(len(words) - length + 1)):
            try:
                found = resolve_category(" ".join(words[first : first + length]))
            except UserError:
                continue
            if len(found) == 1:
                return found[0]
    return "_".join(words)


def _scanned_category(metadata: Path) -> str:
    if not metadata.is_file():
        return ""
    found = re.search(r'categories\s*\{\s*first:\s*"([^"]*)"', metadata.read_text("utf-8", errors="replace"))
    return found.group(1) if found else ""


def _annotations(folder: Path) -> dict[str, str]:
    """Objaverse uid -> LVIS category, from the file beside or above the meshes."""
    for place in (folder, *folder.resolve().parents[:3]):
        for name in ANNOTATIONS:
            if (place / name).is_file():
                try:
                    data = (place / name).read_bytes()
                    content = json.loads(gzip.decompress(data) if name.endswith(".gz") else data)
                    return {str(uid): str(category) for category, uids in content.items() for uid in uids}
                except (OSError, ValueError, AttributeError, TypeError) as error:
                    raise UserError(f"{place / name} cannot be read as LVIS categories ({error})") from error
    return {}
