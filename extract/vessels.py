"""The procedural library of vessels: watertight meshes with walls and interiors, made by code from parameters."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from . import vessel_containers as containers
from . import vessel_cups as cups
from . import vessel_kettles as kettles
from . import vessel_pitchers as pitchers
from . import vessel_pots as pots
from .errors import UserError
from .geometry import Array
from .vessel_assembly import STEEL, Draft, Joined, assemble, joined, outline_surfaces
from .vessel_types import Color, GraspRegion, Outlet, Profile, Range, Section, Vessel

__all__ = [
    "CATEGORIES",
    "GraspRegion",
    "Outlet",
    "Profile",
    "Range",
    "Section",
    "Vessel",
    "make_vessel",
    "outline_mesh",
    "parameter_space",
    "resolve_category",
]

# A seeded variant keeps to this share of the way from the nominal value to the limits, so that vessels drawn at
# random look ordinary and fits still have room.
VARIANT_SHARE = 0.6

Palette = tuple[tuple[float, float, float], ...]
CERAMIC: Palette = ((0.93, 0.92, 0.89), (0.70, 0.16, 0.13), (0.16, 0.30, 0.52), (0.20, 0.42, 0.33), (0.85, 0.66, 0.25))
METAL: Palette = (STEEL[:3], (0.12, 0.12, 0.13), (0.72, 0.45, 0.30), (0.92, 0.92, 0.90))

GLASS: Palette = ((0.78, 0.87, 0.90), (0.62, 0.74, 0.70), (0.80, 0.80, 0.78))
PLASTIC: Palette = ((0.20, 0.45, 0.35), (0.15, 0.32, 0.60), (0.80, 0.24, 0.20), (0.90, 0.88, 0.82), (0.93, 0.72, 0.20))
BOTTLES: Palette = ((0.16, 0.30, 0.18), (0.30, 0.18, 0.09), (0.75, 0.84, 0.86))
CARTONS: Palette = ((0.90, 0.91, 0.93), (0.93, 0.62, 0.20), (0.35, 0.58, 0.80))


@dataclass(frozen=True)
class Entry:
    """One category: its shape parameters, the function that drafts it, its usual colours, words that mean it."""

    ranges: Mapping[str, Range]
    draft: Callable[[Mapping[str, float], Color], Draft]
    palette: Palette
    words: tuple[str, ...] = ()


_LIBRARY: dict[str, Entry] = {
    "mug": Entry(cups.MUG, cups.mug, ((0.10, 0.35, 0.72), *CERAMIC), ("coffee mug", "beaker mug")),
    "cup": Entry(cups.CUP, cups.cup, CERAMIC, ("teacup", "tea cup", "coffee cup")),
    "tumbler": Entry(cups.TUMBLER, cups.tumbler, GLASS, ("glass", "drinking glass", "water glass")),
    "wine_glass": Entry(cups.WINE_GLASS, cups.wine_glass, GLASS, ("glass", "goblet", "wineglass")),
    "bowl": Entry(cups.BOWL, cups.bowl, CERAMIC, ("dish", "ramekin")),
    "gooseneck_kettle": Entry(
        kettles.GOOSENECK_KETTLE, kettles.gooseneck_kettle, METAL, ("kettle", "pour over kettle", "coffee kettle")
    ),
    "stovetop_kettle": Entry(kettles.STOVETOP_KETTLE, kettles.stovetop_kettle, METAL, ("kettle", "tea kettle")),
    "electric_kettle": Entry(kettles.ELECTRIC_KETTLE, kettles.electric_kettle, METAL, ("kettle", "water kettle")),
    "teapot": Entry(pots.TEAPOT, pots.teapot, CERAMIC, ("tea pot", "pot")),
    "moka_pot": Entry(pots.MOKA_POT, pots.moka_pot, METAL, ("moka", "coffee pot", "espresso pot", "pot")),
    "saucepan": Entry(pots.SAUCEPAN, pots.saucepan, METAL, ("pan", "pot", "sauce pan")),
    "watering_can": Entry(pots.WATERING_CAN, pots.watering_can, PLASTIC, ("can",)),
    "jug": Entry(pitchers.JUG, pitchers.jug, CERAMIC, ("ewer", "milk pitcher")),
    "pitcher": Entry(pitchers.PITCHER, pitchers.pitcher, PLASTIC, ("jug", "water jug")),
    "milk_jug": Entry(pitchers.MILK_JUG, pitchers.milk_jug, METAL, ("jug", "creamer", "milk pitcher")),
    "carafe": Entry(pitchers.CARAFE, pitchers.carafe, GLASS, ("decanter",)),
    "measuring_cup": Entry(pitchers.MEASURING_CUP, pitchers.measuring_cup, GLASS, ("measuring jug", "measure")),
    "beaker": Entry(pitchers.BEAKER, pitchers.beaker, GLASS, ("laboratory beaker", "lab beaker")),
    "bottle": Entry(containers.BOTTLE, containers.bottle, BOTTLES, ("wine bottle", "water bottle", "flask")),
    "thermos": Entry(containers.THERMOS, containers.thermos, PLASTIC, ("flask", "vacuum flask", "thermos flask")),
    "can": Entry(containers.CAN, containers.can, (STEEL[:3], (0.80, 0.68, 0.40)), ("tin", "tin can", "food can")),
    "carton": Entry(containers.CARTON, containers.carton, CARTONS, ("milk carton", "juice carton", "box")),
    "vase": Entry(containers.VASE, containers.vase, CERAMIC, ("flower vase",)),
}
_COLOR_RANGES = ("red", "green", "blue")
CATEGORIES: tuple[str, ...] = tuple(_LIBRARY)


def parameter_space(category: str) -> dict[str, Range]:
    """Limits and nominal value of every parameter of a category, its colour (red, green, blue in [0, 1]) included."""
    entry = _entry(category)
    colors = {n: Range(0.0, 1.0, v, "1") for n, v in zip(_COLOR_RANGES, entry.palette[0], strict=True)}
    return {**entry.ranges, **colors}


def make_vessel(category: str, seed: int | None = None, **params: float) -> Vessel:
    """A vessel of the library.

    seed: None for the nominal variant, else a seeded one. params: values for single parameters, over the seed's.
    Raises UserError for an unknown category or parameter and for a value out of range.
    """
    space = parameter_space(category)
    values = {name: r.nominal for name, r in space.items()} if seed is None else _variant(category, seed)
    for name, value in params.items():
        if name not in space:
            raise UserError(f"a {category} has no parameter {name!r}; it has {', '.join(space)}")
        limits = space[name]
        if not limits.low <= value <= limits.high:
            raise UserError(
                f"{name}={value:g} of {category} is out of range; give {limits.low:g} to {limits.high:g}"
                + ("" if limits.unit == "1" else f" {limits.unit}")
            )
        values[name] = float(value)
    vessel = _build(category, tuple(values.items()))
    # The cached mesh stays out of the callers' hands, who may move or scale theirs.
    return replace(vessel, mesh=vessel.mesh.copy(), params=dict(vessel.params))


def outline_mesh(category: str, params: Mapping[str, float]) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) and faces (F, 3) of surfaces with the silhouette of `make_vessel(category, **params)`.

    params: the full set, within the limits. Not watertight, and much faster.
    """
    return outline_surfaces(_draft(category, params))


def resolve_category(word: str) -> tuple[str, ...]:
    """Categories that a user's word may mean: "kettle" gives every kettle, a category's name gives itself.

    Raises UserError, listing what is known, for a word that means none.
    """
    plain = " ".join(word.strip().lower().replace("_", " ").replace("-", " ").split())
    name = plain.replace(" ", "_")
    if name in _LIBRARY:
        return (name,)
    found = tuple(c for c, entry in _LIBRARY.items() if plain in (w.replace("-", " ") for w in entry.words))
    if found:
        return found
    raise UserError(_unknown(word))


def _entry(category: str) -> Entry:
    if category not in _LIBRARY:
        raise UserError(_unknown(category))
    return _LIBRARY[category]


def _unknown(word: str) -> str:
    close = difflib.get_close_matches(word.lower().replace(" ", "_"), CATEGORIES, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown vessel category {word!r}{hint}; the library has {', '.join(CATEGORIES)}"


def _variant(category: str, seed: int) -> dict[str, float]:
    """Parameter values of a seeded variant."""
    entry = _entry(category)
    rng = np.random.default_rng([seed, *category.encode()])
    values = {}
    for name, r in entry.ranges.items():
        u = VARIANT_SHARE * rng.uniform(-1, 1)
        values[name] = r.nominal + u * (r.high - r.nominal if u > 0 else r.nominal - r.low)
    color = entry.palette[int(rng.integers(len(entry.palette)))]
    return {**values, **dict(zip(_COLOR_RANGES, color, strict=True))}


@lru_cache(maxsize=64)
def _build(category: str, items: tuple[tuple[str, float], ...]) -> Vessel:
    values = dict(items)
    shape = tuple((name, value) for name, value in items if name not in _COLOR_RANGES)
    return assemble(category, values, _draft(category, values), _joined(category, shape))


@lru_cache(maxsize=64)
def _joined(category: str, shape: tuple[tuple[str, float], ...]) -> Joined:
    return joined(_draft(category, {**dict(shape), **dict.fromkeys(_COLOR_RANGES, 0.5)}))


def _draft(category: str, values: Mapping[str, float]) -> Draft:
    return _entry(category).draft(values, (values["red"], values["green"], values["blue"], 1.0))
