"""Vessels to drink from: mug, cup, tumbler, wine glass. Each function drafts one category from its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .vessel_assembly import (
    CERAMIC_KG_M3,
    Draft,
    body_grasp,
    lip_outlet,
    loop_handle,
    round_walls,
)
from .vessel_types import Color, Range

Params = Mapping[str, float]

MUG = {
    "height_m": Range(0.07, 0.13, 0.100),
    "top_radius_m": Range(0.030, 0.055, 0.0415),
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
