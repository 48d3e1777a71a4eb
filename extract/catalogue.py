"""The library of vessels for a reader: what there is, how one measures, and its mesh as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .errors import UserError
from .files import atomic_path, write_json
from .vessels import CATEGORIES, make_vessel, parameter_space, resolve_category
from .wording import measures_of


def catalogue(action: str, name: str | None, seed: int | None, folder: Path | None, suffix: str) -> dict[str, Any]:
    """What `vid2demo meshes` does: "list" all categories, "show" one, or "export" its mesh, in m, to a folder.

    seed: of a variant; None for the nominal vessel.  suffix: of the mesh file, such as "obj".
    Raises UserError when the name or the folder is missing, and for an unknown name.
    """
    if action == "list":
        return _list()
    if name is None:
        raise UserError(f"meshes {action} needs a category; the library has {', '.join(CATEGORIES)}")
    if action == "show":
        return _description(name, seed)
    if folder is None:
        raise UserError("meshes export needs --out DIR, the folder to write to")
    return _exported(name, seed, folder, suffix)


def _list() -> dict[str, Any]:
    """The measures of every category of the library."""
    return {"categories": {category: measures_of(make_vessel(category)) for category in CATEGORIES}}


def _description(name: str, seed: int | None) -> dict[str, Any]:
    """Category, measures and parameters with their ranges. Raises UserError for an unknown name."""
    vessel = make_vessel(category := resolve_category(name)[0], seed)
    parameters = {
        key: {"value": vessel.params[key], "low": r.low, "high": r.high, "unit": r.unit}
        for key, r in parameter_space(category).items()
    }
    return {"category": category, "measures": measures_of(vessel), "parameters": parameters}


def _exported(name: str, seed: int | None, folder: Path, suffix: str) -> dict[str, str]:
    """Write a vessel's mesh, in metres, and its description to `folder`. Raises UserError for an unknown name."""
    shown = _description(name, seed)
    category = shown["category"]
    file = folder / f"{category if seed is None else f'{category}_{seed}'}.{suffix}"
    with atomic_path(file) as temporary:
        make_vessel(category, seed).mesh.export(temporary)
    write_json(file.with_suffix(".json"), shown)
    return {"mesh": str(file), "description": str(file.with_suffix(".json"))}
