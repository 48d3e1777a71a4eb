"""What a database knows of one mesh, for a reader."""

from __future__ import annotations

from typing import Any

from .errors import UserError
from .mesh_store import MeshStore
from .retrieval import matches


def describe_stored(store: MeshStore, name: str | None) -> dict[str, Any]:
    """A mesh by its name, the beginning of its key, or a word that only one of them fits.

    Raises UserError when the name is missing or fits none or several.
    """
    index = store.index()
    rows = sorted(zip(index.keys, index.about(), strict=True), key=lambda row: row[1].name)
    if name is None:
        raise UserError(f"name a mesh; `vid2demo meshes list --db {store.root}` lists {len(rows)}")
    found = [(key, about) for key, about in rows if about.name == name]
    found = found or [(key, about) for key, about in rows if len(name) >= 6 and key.startswith(name)]
    found = found or [(key, about) for key, about in rows if matches(about, name)]
    if len(found) != 1:
        several = f"several: {', '.join(about.name for _, about in found[:8])}; name one" if found else "none"
        raise UserError(f"of the meshes of {store.root}, {name!r} fits {several}")
    key, about = found[0]
    stored = store.mesh(key).mesh
    return {
        "name": about.name,
        "category": about.category,
        "key": key,
        "extents_m": list(about.extents_m) if about.unit else None,
        "unit_of_the_file": about.unit or "unknown",
        "centre_in_the_file": list(about.centre),
        "half_extent_in_the_file": about.half_extent,
        "faces": {"in_the_file": about.faces_in_file, "stored": len(stored.faces)},
        "views": {"count": store.settings.count, "encoder": store.encoder},
        "source": about.source,
    }
