"""A vessel from whatever a user or a file names it by: a category of the library, or a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import UserError
from .meshes import SUFFIXES
from .vessels import CATEGORIES, Vessel, make_vessel


def resolve_vessel(value: Vessel | str | Path | Mapping[str, Any], role: str = "vessel") -> Vessel:
    """A vessel from what a user may name it by; `role` tells in errors which one is meant.

    value: a `Vessel`; a category ("mug") or a seeded variant of one ("mug:3"); the path of a mesh file; or an entry as
        in a file's header: {"library": {"category", "params"}} or {"file", "unit", "up", "open_top"}, of which all but
        the file may be left out.
    """
    if isinstance(value, Vessel):
        return value
    if isinstance(value, Mapping):
        return vessel_of_entry(value, role)
    text = str(value)
    if Path(text).suffix.lower() in SUFFIXES:
        return vessel_of_entry({"file": text}, role)
    category, colon, seed = text.partition(":")
    if category not in CATEGORIES or (colon and not seed.isdecimal()):
        raise UserError(
            f"the {role} is {text!r}; give a category ({', '.join(CATEGORIES)}), a seeded variant of one such as "
            f"mug:3, or a mesh file ({', '.join(SUFFIXES)})"
        )
    return make_vessel(category, int(seed) if colon else None)


def vessel_of_entry(entry: Mapping[str, Any], role: str) -> Vessel:
    """A vessel from a track's `mesh` or a reference's `vessel` entry.

    Raises UserError when the entry names none, or when its mesh file is missing or no longer the same.
    """
    if "library" in entry:
        library = entry["library"]
        return make_vessel(str(library["category"]), None, **{k: float(v) for k, v in library["params"].items()})
    if "file" not in entry:
        raise UserError(f"the {role} names neither a library vessel nor a mesh file; build it with `vid2demo retarget`")
    path = Path(str(entry["file"]))
    if not path.is_file():
        raise UserError(f"the {role} is the mesh file {path}, which does not exist; put it back or name another")
    from .vessel_from_mesh import vessel_from_mesh

    vessel = vessel_from_mesh(
        path, str(entry.get("unit", "auto")), up=str(entry.get("up", "auto")), open_top=bool(entry.get("open_top"))
    )
    assert vessel.source is not None
    if entry.get("sha256", vessel.source.sha256) != vessel.source.sha256:
        raise UserError(
            f"{path}, the {role}'s mesh, has changed since it was used; put the old file back or start anew"
        )
    return vessel
