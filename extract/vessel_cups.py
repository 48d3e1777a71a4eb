"""Vessels to drink from: mug, cup, tumbler, wine glass, bowl. Each function drafts one category from its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .vessel_assembly import (
    CERAMIC_KG_M3,
    GLASS_KG_M3,
    Draft,
    body_grasp,
    lip_outlet,
    loop_handle,
    round_walls,
)
from .vessel_shapes import smooth_profile
from .vessel_types import Color, Range

Params = Mapping[str, float]

MUG = {
    "height_m": Range(0.07, 0.13, 0.090),
    "top_radius_m": Range(0.030, 0.055, 0.0445),
    "base_ratio": Range(0.75, 1.08, 0.88, "1"),
    "wall_m": Range(0.0025, 0.006, 0.004),
    "base_round_m": Range(0.001, 0.012, 0.006),
    "handle_reach_m": Range(0.022, 0.05, 0.033),
    "handle_top": Range(0.65, 0.92, 0.83, "1"),
    "handle_bottom": Range(0.12, 0.45, 0.28, "1"),
    "handle_thickness_m": Range(0.006, 0.013, 0.009),
    "handle_width_m": Range(0.008, 0.018, 0.013),
    "handle_roundness": Range(0.2, 1.0, 0.7, "1"),
}


def mug(p: Params, rgba: Color) -> Draft:
    """A slightly tapered cylinder with a C-shaped handle."""
    h, top = p["height_m"], p["top_radius_m"]
    outer = np.array([[0.0, p["base_ratio"] * top], [h, top]])
    walls = round_walls(
        outer, p["wall_m"], 1.3 * p["wall_m"], base_round_m=p["base_round_m"], inner_fillet_m=p["base_round_m"]
    )
    thick, width = 0.5 * p["handle_thickness_m"], 0.5 * p["handle_width_m"]
    z_top = min(p["handle_top"] * h, h - thick - 0.003)
    z_low = max(p["handle_bottom"] * h, thick + p["base_round_m"])
    x_out = -(walls.outer_radius(0.5 * h) + p["handle_reach_m"] - thick)
    fillet = p["handle_roundness"] * 0.5 * (z_top - z_low)
    handle, grip = loop_handle(
        walls,
        [(0.0, z_top), (x_out, z_top), (x_out + 0.15 * p["handle_reach_m"], z_low), (0.0, z_low)],
        thick,
        width,
        rgba,
        max(fillet, 1.2 * thick),
    )
    return Draft(
        walls,
        rgba,
        CERAMIC_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.3, 0.9, sideways=True)],
        additions=[handle],
    )


CUP = {
    "height_m": Range(0.05, 0.08, 0.062),
    "top_radius_m": Range(0.036, 0.055, 0.046),
    "base_ratio": Range(0.38, 0.62, 0.46, "1"),
    "belly": Range(0.0, 1.0, 0.6, "1"),
    "wall_m": Range(0.002, 0.0045, 0.003),
    "handle_reach_m": Range(0.018, 0.032, 0.024),
    "handle_thickness_m": Range(0.0045, 0.008, 0.006),
}


def cup(p: Params, rgba: Color) -> Draft:
    """A tea cup: a small flared bowl on a foot ring, with a finger-sized ear."""
    h, top = p["height_m"], p["top_radius_m"]
    base = p["base_ratio"] * top
    foot = 0.006
    full = p["belly"]
    outer = smooth_profile(
        [
            (0.0, base),
            (foot, base),
            (foot + 0.03 * (h - foot), base + (top - base) * 0.05),
            (foot + 0.25 * (h - foot), base + (top - base) * (0.42 + 0.24 * full)),
            (foot + 0.60 * (h - foot), base + (top - base) * (0.74 + 0.17 * full)),
            (h, top),
        ]
    )
    walls = round_walls(outer, p["wall_m"], foot + 0.3 * p["wall_m"], base_round_m=0.001, inner_fillet_m=0.010)
    thick = 0.5 * p["handle_thickness_m"]
    z_top, z_low = 0.84 * h, 0.34 * h
    x_out = -(walls.outer_radius(z_top) + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls,
        [(0.0, z_top), (x_out, z_top + 0.04 * h), (0.93 * x_out, z_low + 0.03 * h), (0.0, z_low)],
        thick,
        1.3 * thick,
        rgba,
        0.013,
    )
    return Draft(
        walls,
        rgba,
        CERAMIC_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.5, 0.95, sideways=True)],
        additions=[handle],
    )


TUMBLER = {
    "height_m": Range(0.08, 0.16, 0.120),
    "top_radius_m": Range(0.030, 0.045, 0.037),
    "base_ratio": Range(0.68, 1.0, 0.82, "1"),
    "wall_m": Range(0.0015, 0.004, 0.0025),
    "floor_m": Range(0.004, 0.016, 0.009),
}


def tumbler(p: Params, rgba: Color) -> Draft:
    """A plain drinking glass with a thick floor."""
    h, top = p["height_m"], p["top_radius_m"]
    walls = round_walls(
        np.array([[0.0, p["base_ratio"] * top], [h, top]]),
        p["wall_m"],
        p["floor_m"],
        base_round_m=0.003,
        inner_fillet_m=0.005,
    )
    return Draft(walls, rgba, GLASS_KG_M3, lip_outlet(walls), [body_grasp(walls, 0.2, 0.9)], symmetry_order=0)


WINE_GLASS = {
    "height_m": Range(0.15, 0.25, 0.205),
    "belly_radius_m": Range(0.032, 0.05, 0.041),
    "mouth_ratio": Range(0.68, 0.98, 0.80, "1"),
    "stem_share": Range(0.35, 0.55, 0.45, "1"),
    "stem_radius_m": Range(0.0035, 0.006, 0.0045),
    "foot_ratio": Range(0.8, 1.0, 0.9, "1"),
    "belly_height": Range(0.28, 0.5, 0.38, "1"),
    "wall_m": Range(0.0012, 0.0022, 0.0016),
}


def wine_glass(p: Params, rgba: Color) -> Draft:
    """A tulip-shaped bowl on a stem and a round foot."""
    h, belly, stem_r = p["height_m"], p["belly_radius_m"], p["stem_radius_m"]
    foot, stem = p["foot_ratio"] * belly, p["stem_share"] * h
    bowl = h - stem
    z_belly = stem + p["belly_height"] * bowl
    outer = smooth_profile(
        [
            (0.0, foot),
            (0.0022, foot),
            (0.006, 0.42 * foot),
            (0.013, 1.5 * stem_r),
            (0.035, stem_r),
            (stem - 0.012, stem_r),
            (stem, 1.7 * stem_r),
            (stem + 0.10 * (z_belly - stem), 0.40 * belly),
            (stem + 0.45 * (z_belly - stem), 0.82 * belly),
            (z_belly, belly),
            (h, p["mouth_ratio"] * belly),
        ],
        220,
    )
    walls = round_walls(outer, p["wall_m"], stem + 0.10 * (z_belly - stem), inner_fillet_m=0.008)
    grasp_bowl = body_grasp(walls, (stem + 0.2 * bowl) / h, (stem + 0.7 * bowl) / h)
    grasp_stem = body_grasp(walls, 0.04 / h, (stem - 0.012) / h)
    return Draft(walls, rgba, GLASS_KG_M3, lip_outlet(walls), [grasp_bowl, grasp_stem], symmetry_order=0)


BOWL = {
    "height_m": Range(0.04, 0.10, 0.065),
    "radius_m": Range(0.05, 0.12, 0.075),
    "foot_ratio": Range(0.35, 0.65, 0.46, "1"),
    "fullness": Range(0.4, 1.0, 0.75, "1"),
    "wall_m": Range(0.003, 0.006, 0.004),
}


def bowl(p: Params, rgba: Color) -> Draft:
    """A round bowl on a foot ring."""
    h, top = p["height_m"], p["radius_m"]
    base, foot = p["foot_ratio"] * top, 0.006
    t = np.linspace(0.0, 1.0, 40)
    # Between a cone (0) and a quarter ellipse (1).
    rise = p["fullness"] * np.sqrt(1 - (1 - t) ** 2) + (1 - p["fullness"]) * t
    side = np.column_stack([foot + t * (h - foot), base + (top - base) * rise])
    outer = np.vstack([[[0.0, base], [foot - 0.001, 0.98 * base]], side])
    walls = round_walls(outer, p["wall_m"], foot + 0.002, base_round_m=0.0012, inner_fillet_m=0.012)
    return Draft(walls, rgba, CERAMIC_KG_M3, lip_outlet(walls), [body_grasp(walls, 0.5, 1.0)], symmetry_order=0)
