"""Vessels that pour over a lip: jug, pitcher, carafe, measuring cup, beaker. Each function drafts one category."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .vessel_assembly import (
    CERAMIC_KG_M3,
    GLASS_KG_M3,
    PLASTIC_KG_M3,
    STEEL_KG_M3,
    Draft,
    body_grasp,
    lip_outlet,
    loop_handle,
    round_walls,
)
from .vessel_shapes import Lip, smooth_profile
from .vessel_types import Color, Range

Params = Mapping[str, float]

JUG = {
    "height_m": Range(0.12, 0.24, 0.175),
    "belly_radius_m": Range(0.05, 0.085, 0.064),
    "base_ratio": Range(0.6, 0.9, 0.74, "1"),
    "neck_ratio": Range(0.55, 0.85, 0.68, "1"),
    "mouth_ratio": Range(0.65, 0.95, 0.80, "1"),
    "belly_height": Range(0.28, 0.45, 0.36, "1"),
    "neck_height": Range(0.74, 0.84, 0.79, "1"),
    "wall_m": Range(0.003, 0.006, 0.0042),
    "lip_reach_m": Range(0.010, 0.024, 0.016),
    "handle_reach_m": Range(0.03, 0.055, 0.042),
    "handle_thickness_m": Range(0.009, 0.015, 0.012),
}


def jug(p: Params, rgba: Color) -> Draft:
    """A full-bellied jug with a drawn-in neck, a pouring lip and an ear from neck to belly."""
    h, belly = p["height_m"], p["belly_radius_m"]
    neck, mouth = p["neck_ratio"] * belly, p["mouth_ratio"] * belly
    outer = smooth_profile(
        [
            (0.0, p["base_ratio"] * belly),
            (p["belly_height"] * h, belly),
            (p["neck_height"] * h, min(neck, mouth)),
            (h, mouth),
        ]
    )
    walls = round_walls(
        outer,
        p["wall_m"],
        1.4 * p["wall_m"],
        base_round_m=0.003,
        inner_fillet_m=0.010,
        lip=Lip(p["lip_reach_m"], 0.24 * h, 0.55),
    )
    thick = 0.5 * p["handle_thickness_m"]
    z_top, z_low = 0.90 * h - thick, 0.42 * h
    x_out = -(belly + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls,
        [(0.0, z_top), (0.92 * x_out, z_top + 0.02 * h), (x_out, 0.55 * h), (0.85 * x_out, z_low), (0.0, z_low)],
        0.8 * thick,
        1.2 * thick,
        rgba,
        0.03,
    )
    return Draft(
        walls,
        rgba,
        CERAMIC_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.2, 0.6, sideways=True)],
        additions=[handle],
    )


PITCHER = {
    "height_m": Range(0.17, 0.28, 0.220),
    "base_radius_m": Range(0.045, 0.07, 0.056),
    "top_ratio": Range(0.85, 1.25, 1.05, "1"),
    "waist_ratio": Range(0.85, 1.0, 0.95, "1"),
    "wall_m": Range(0.002, 0.004, 0.003),
    "lip_reach_m": Range(0.014, 0.034, 0.024),
    "handle_reach_m": Range(0.04, 0.065, 0.050),
    "handle_bottom": Range(0.12, 0.4, 0.24, "1"),
    "handle_thickness_m": Range(0.008, 0.016, 0.012),
    "handle_width_m": Range(0.014, 0.026, 0.019),
}


def pitcher(p: Params, rgba: Color) -> Draft:
    """A tall, nearly straight pitcher with a wide lip and a long handle."""
    h, base, top = p["height_m"], p["base_radius_m"], p["top_ratio"] * p["base_radius_m"]
    waist = p["waist_ratio"] * min(base, top)
    outer = smooth_profile([(0.0, base), (0.62 * h, 0.5 * (waist + 0.5 * (base + top))), (0.8 * h, waist), (h, top)])
    walls = round_walls(
        outer,
        p["wall_m"],
        1.5 * p["wall_m"],
        base_round_m=0.006,
        inner_fillet_m=0.006,
        lip=Lip(p["lip_reach_m"], 0.2 * h, 0.62),
    )
    thick, width = 0.5 * p["handle_thickness_m"], 0.5 * p["handle_width_m"]
    z_top, z_low = 0.93 * h - thick, max(p["handle_bottom"] * h, 0.02)
    x_out = -(max(base, top) + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls, [(0.0, z_top), (x_out, z_top), (0.95 * x_out, z_low), (0.0, z_low)], thick, width, rgba, 0.028
    )
    return Draft(
        walls,
        rgba,
        PLASTIC_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.1, 0.8, sideways=True)],
        additions=[handle],
    )


CARAFE = {
    "height_m": Range(0.18, 0.28, 0.230),
    "belly_radius_m": Range(0.045, 0.075, 0.058),
    "neck_ratio": Range(0.36, 0.55, 0.44, "1"),
    "mouth_ratio": Range(0.52, 0.85, 0.66, "1"),
    "belly_height": Range(0.2, 0.36, 0.26, "1"),
    "neck_height": Range(0.66, 0.80, 0.73, "1"),
    "wall_m": Range(0.002, 0.004, 0.003),
}


def carafe(p: Params, rgba: Color) -> Draft:
    """A glass water carafe: wide belly, long narrow neck, flared mouth, no handle."""
    h, belly = p["height_m"], p["belly_radius_m"]
    z_belly, z_neck, neck = p["belly_height"] * h, p["neck_height"] * h, p["neck_ratio"] * belly
    outer = smooth_profile(
        [
            (0.0, 0.86 * belly),
            (z_belly, belly),
            (0.5 * (z_belly + z_neck), 0.5 * (belly + neck) * 0.97),
            (z_neck, neck),
            (h, p["mouth_ratio"] * belly),
        ],
        100,
    )
    walls = round_walls(outer, p["wall_m"], 2.0 * p["wall_m"], base_round_m=0.006, inner_fillet_m=0.012)
    neck_grasp = body_grasp(walls, p["neck_height"] - 0.07, p["neck_height"] + 0.07)
    return Draft(
        walls, rgba, GLASS_KG_M3, lip_outlet(walls), [neck_grasp, body_grasp(walls, 0.1, 0.4)], symmetry_order=0
    )


MEASURING_CUP = {
    "height_m": Range(0.07, 0.14, 0.105),
    "top_radius_m": Range(0.04, 0.07, 0.055),
    "base_ratio": Range(0.68, 0.92, 0.80, "1"),
    "wall_m": Range(0.002, 0.005, 0.0035),
    "lip_reach_m": Range(0.008, 0.02, 0.013),
    "handle_reach_m": Range(0.032, 0.05, 0.040),
    "handle_bottom": Range(0.1, 0.4, 0.22, "1"),
    "handle_thickness_m": Range(0.006, 0.011, 0.0085),
    "handle_width_m": Range(0.014, 0.022, 0.018),
}


def measuring_cup(p: Params, rgba: Color) -> Draft:
    """A conical kitchen measure with a narrow lip, a rim bead and an angular strap handle."""
    h, top = p["height_m"], p["top_radius_m"]
    bead = 0.0018
    outer = np.array([[0.0, p["base_ratio"] * top], [h - 0.007, top], [h - 0.004, top + bead], [h, top + bead]])
    walls = round_walls(
        outer,
        p["wall_m"],
        1.5 * p["wall_m"],
        base_round_m=0.004,
        inner_fillet_m=0.006,
        lip=Lip(p["lip_reach_m"], 0.25 * h, 0.34),
    )
    thick, width = 0.5 * p["handle_thickness_m"], 0.5 * p["handle_width_m"]
    z_top, z_low = h - thick - 0.008, max(p["handle_bottom"] * h, thick + 0.005)
    x_out = -(top + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls, [(0.0, z_top), (x_out, z_top), (0.96 * x_out, z_low), (0.0, z_low)], thick, width, rgba, 0.009
    )
    return Draft(
        walls,
        rgba,
        GLASS_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.2, 0.9, sideways=True)],
        additions=[handle],
    )


BEAKER = {
    "height_m": Range(0.07, 0.16, 0.115),
    "radius_m": Range(0.025, 0.05, 0.038),
    "wall_m": Range(0.0014, 0.003, 0.002),
    "flange_m": Range(0.0015, 0.004, 0.0025),
    "lip_reach_m": Range(0.004, 0.010, 0.007),
}


def beaker(p: Params, rgba: Color) -> Draft:
    """A laboratory beaker: a straight cylinder with a flared rim and a small lip."""
    h, r = p["height_m"], p["radius_m"]
    outer = smooth_profile([(0.0, r), (0.9 * h, r), (h - 0.002, r + p["flange_m"]), (h, r + p["flange_m"])], 120)
    walls = round_walls(
        outer,
        p["wall_m"],
        1.3 * p["wall_m"],
        base_round_m=0.005,
        inner_fillet_m=0.004,
        lip=Lip(p["lip_reach_m"], 0.13 * h, 0.36),
    )
    return Draft(walls, rgba, GLASS_KG_M3, lip_outlet(walls), [body_grasp(walls, 0.1, 0.85)])


MILK_JUG = {
    "height_m": Range(0.06, 0.12, 0.088),
    "base_radius_m": Range(0.032, 0.05, 0.040),
    "neck_ratio": Range(0.65, 0.9, 0.76, "1"),
    "wall_m": Range(0.0008, 0.002, 0.0012),
    "lip_reach_m": Range(0.010, 0.022, 0.015),
    "handle_reach_m": Range(0.026, 0.042, 0.033),
    "handle_width_m": Range(0.008, 0.018, 0.012),
}


def milk_jug(p: Params, rgba: Color) -> Draft:
    """A barista's steel milk jug: wide base, drawn-in shoulder, sharp lip and a strap handle."""
    h, base = p["height_m"], p["base_radius_m"]
    neck = p["neck_ratio"] * base
    outer = smooth_profile([(0.0, base), (0.30 * h, 0.99 * base), (0.78 * h, neck), (h, 1.04 * neck)])
    walls = round_walls(
        outer,
        p["wall_m"],
        1.5 * p["wall_m"],
        base_round_m=0.004,
        inner_fillet_m=0.004,
        lip=Lip(p["lip_reach_m"], 0.45 * h, 0.50),
    )
    thick, width = 0.0016, 0.5 * p["handle_width_m"]
    z_top, z_low = 0.88 * h, 0.22 * h
    x_out = -(base + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls, [(0.0, z_top), (x_out, z_top), (0.94 * x_out, z_low), (0.0, z_low)], thick, width, rgba, 0.016
    )
    return Draft(
        walls,
        rgba,
        STEEL_KG_M3,
        lip_outlet(walls),
        [grip, body_grasp(walls, 0.1, 0.6, sideways=True)],
        additions=[handle],
    )
