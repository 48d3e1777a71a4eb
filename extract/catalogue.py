"""The library of vessels for a reader: what there is, how one measures, and its mesh as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .errors import UserError
from .files import atomic_path, write_json
from .vessels import CATEGORIES, make_vessel, parameter_space, resolve_category
from .wording import measures_of


def list_categories() -> dict[str, Any]:
    """The measures of every category of the library."""
    return {"categories": {category: measures_of(make_vessel(category)) for category in CATEGORIES}}


def describe(name: str | None, seed: int | None) -> dict[str, Any]:
    """Category, measures and parameters with their ranges; seed: of a variant, None for the nominal vessel.

    Raises UserError for a missing or unknown name.
    """
    if name is None:
        raise UserError(f"a vessel needs a category; the library has {', '.join(CATEGORIES)}")
    vessel = make_vessel(category := resolve_category(name)[0], seed)
    parameters = {
        key: {"value": vessel.params[key], "low": r.low, "high": r.high, "unit": r.unit}
        for key, r in parameter_space(category).items()
    }
    return {"category": category, "measures": measures_of(vessel), "parameters": parameters}


def export(name: str | None, seed: int | None, folder: Path | None, suffix: str) -> dict[str, str]:
    """Write a vessel's mesh, in metres, and its description to `folder`; suffix: of the mesh file, such as "obj".

    Raises UserError for a missing or unknown name, and when no folder is given.
    """
    shown = describe(name, seed)
    if folder is None:
        raise UserError("meshes export needs --out DIR, the folder to write to")
    category = shown["category"]
    file = folder / f"{category if seed is None else f'{category}_{seed}'}.{suffix}"
    with atomic_path(file) as temporary:
        make_vessel(category, seed).mesh.export(temporary)
    write_json(file.with_suffix(".json"), shown)
    return {"mesh": str(file), "description": str(file.with_suffix(".json"))}
