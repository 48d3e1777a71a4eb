"""A data set of synthetic table tops in BOP's format, and a database of meshes that are not the ones in it.

As in the wild, what is seen is not in the database: of every category some variants are rendered and others are held
out, and only these are written to `database/CATEGORY/`, listed in `database.json` as {"name", "category", "file"} and,
for a vessel of the library, "library": {"category", "seed"}. `categories.json` tells every object id's category.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .bop import ImageKey, ModelSymmetry, Target, open_dataset
from .bop_eval import CATEGORIES_FILE, DATABASE_FILE
from .bop_write import write_models, write_scene, write_targets
from .errors import UserError
from .files import atomic_path, write_json
from .household import HOUSEHOLD, household_mesh
from .progress import Progress
from .stages import Stage, plain
from .synthetic_look import face_colors, thing_look, vessel_look
from .synthetic_table import Thing, photograph
from .vessels import make_vessel

VESSELS = (
    "mug",
    "bowl",
    "wine_glass",
    "gooseneck_kettle",
    "electric_kettle",
    "teapot",
    "saucepan",
    "watering_can",
    "pitcher",
    "bottle",
    "can",
    "vase",
)
CATEGORIES = (*VESSELS, *HOUSEHOLD)
SPLIT = "test"
RENDERED, HELD_OUT = 2, 3  # variants of each category
LEAST_VISIBLE = 0.1  # of a target's silhouette, as in the benchmark
THINGS = (5, 8)  # in a picture, at least and at most
_STANDS = {*VESSELS, "book"}


def stages(folder: Path, *, scenes: int, images: int, seed: int, size_px: tuple[int, int]) -> list[Stage]:
    """What makes the data set: its models, the database, scene after scene, and the list of targets.

    images: of each scene, whose things stay the same and are put down anew. Raises UserError for an impossible size or
    number.
    """
    for name, value, most in (("scenes", scenes, 100_000), ("images", images, 1000)):
        if not 1 <= value <= most:
            raise UserError(f"--{name} {value} is out of range; give 1 to {most}")
    if not all(64 <= side <= 4096 for side in size_px):
        raise UserError(f"--size {size_px[0]} {size_px[1]} is out of range; give 64 to 4096 px a side")
    room = ("extract",)

    def models(progress: Progress) -> Mapping[str, Any]:
        write_models(folder, {thing.obj_id: _painted(thing) for thing in _things(seed).values()}, _symmetries())
        known = {str(obj_id): category for obj_id, (category, _) in object_variants().items()}
        write_json(folder / CATEGORIES_FILE, known)
        return {"models": len(known), "categories": len(CATEGORIES)}

    def database(progress: Progress) -> Mapping[str, Any]:
        entries = write_database(folder)
        return {"meshes": len(entries)}

    def scene(scene_id: int) -> Stage:
        def work(progress: Progress) -> Mapping[str, Any]:
            rng = np.random.default_rng([seed, scene_id])
            chosen = _choose(rng, _things(seed))
            shown = []
            for k in range(images):
                order = rng.permutation(len(chosen))
                shown.append(photograph(rng, [chosen[n] for n in order], size_px, k))
                progress(k + 1, images, "rendering")
            write_scene(folder, SPLIT, scene_id, [frame for frame, _ in shown])
            return {"objects": len(chosen), **shown[0][1]}

        told = {"seed": seed, "images": images, "size_px": size_px}
        outputs = (f"{SPLIT}/{scene_id:06d}",)
        return Stage(f"scene {scene_id}", f"render scene {scene_id}", work, plain(told), {}, outputs, room)

    def targets(progress: Progress) -> Mapping[str, Any]:
        dataset = open_dataset(folder, SPLIT)
        images = [image for image in dataset.images if image.scene_id < scenes]
        found = [target for image in images for target in _visible(dataset.objects(image), image)]
        write_targets(folder, SPLIT, found)
        return {"targets": len(found)}

    rendered = [scene(k) for k in range(scenes)]
    made = {f"scene {k}": folder / stage.outputs[0] for k, stage in enumerate(rendered)}
    return [
        Stage("models", "build the models", models, {"seed": seed}, {}, ("models", CATEGORIES_FILE), room),
        Stage("database", "build the held-out database", database, {}, {}, ("database", DATABASE_FILE), room),
        *rendered,
        Stage("targets", "list the targets", targets, {}, made, (f"{SPLIT}_targets_bop19.json",), room),
    ]


def object_variants() -> dict[int, tuple[str, int]]:
    """Object id -> category and seed of the variants that are rendered."""
    listed = [(category, seed) for category in CATEGORIES for seed in range(RENDERED)]
    return dict(enumerate(listed, start=1))


def held_out() -> list[dict[str, Any]]:
    """The database's entries: variants that are never rendered."""
    entries = []
    for category in CATEGORIES:
        for seed in range(RENDERED, RENDERED + HELD_OUT):
            name = f"{category}_{seed}"
            file = f"database/{category}/{name}.ply"
            entry: dict[str, Any] = {"name": name, "category": category, "file": file}
            if category in VESSELS:
                entry["library"] = {"category": category, "seed": seed}
            entries.append(entry)
    return entries


def write_database(folder: Path) -> list[dict[str, Any]]:
    """Write the held-out meshes, in m and in their usual colours, and the list of them. Returns the list."""
    entries = held_out()
    for entry in entries:
        with atomic_path(folder / entry["file"]) as temporary:
            _mesh(entry["category"], int(entry["name"].rpartition("_")[2])).export(temporary)
    write_json(folder / DATABASE_FILE, entries)
    return entries


def _mesh(category: str, seed: int) -> Any:
    return make_vessel(category, seed).mesh if category in VESSELS else household_mesh(category, seed)


@lru_cache(maxsize=1)
def _things(seed: int) -> dict[int, Thing]:
    """Object id -> what is rendered, each with one look for the whole data set."""
    found = {}
    for obj_id, (category, variant) in object_variants().items():
        rng = np.random.default_rng([seed, obj_id, 1])
        mesh = _mesh(category, variant)
        look = vessel_look(rng, make_vessel(category, variant)) if category in VESSELS else thing_look(rng, mesh)
        found[obj_id] = Thing(obj_id, mesh, look, category in _STANDS)
    return found


def _symmetries() -> dict[int, ModelSymmetry]:
    """Of the shapes; a print may tell their turns apart all the same."""
    found = {}
    for obj_id, (category, variant) in object_variants().items():
        if category == "ball":
            found[obj_id] = ModelSymmetry(axes=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
        elif category == "book":
            found[obj_id] = ModelSymmetry(np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])]))
        elif category in VESSELS:
            own = make_vessel(category, variant).symmetry
            turns = own.rotations() if own.order else np.eye(3)[None]
            found[obj_id] = ModelSymmetry(turns, (own.axis,) if own.order == 0 else ())
    return found


def _painted(thing: Thing) -> Any:
    """The mesh in the colours of its look, each face in one."""
    mesh = thing.mesh.copy()
    mesh.visual.face_colors = face_colors(thing.look)
    return mesh


def _choose(rng: np.random.Generator, things: Mapping[int, Thing]) -> list[Thing]:
    """Things of different categories."""
    count = int(rng.integers(THINGS[0], THINGS[1] + 1))
    categories = rng.choice(len(CATEGORIES), count, replace=False)
    return [things[int(k) * RENDERED + int(rng.integers(RENDERED)) + 1] for k in categories]


def _visible(objects: Sequence[Any], image: ImageKey) -> list[Target]:
    counted: dict[int, int] = {}
    for there in objects:
        if (there.visible_fraction or 0.0) >= LEAST_VISIBLE:
            counted[there.obj_id] = counted.get(there.obj_id, 0) + 1
    return [Target(image, obj_id, count) for obj_id, count in sorted(counted.items())]
