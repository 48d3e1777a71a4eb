"""Vessels to keep things in: bottle, thermos, can, carton, vase. Each function drafts one category."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .geometry import Array
from .vessel_assembly import (
    BLACK,
    CARD_KG_M3,
    CERAMIC_KG_M3,
    GLASS_KG_M3,
    PLASTIC_KG_M3,
    STEEL,
    STEEL_KG_M3,
    Draft,
    Part,
    body_grasp,
    lip_outlet,
    round_walls,
)
from .vessel_shapes import lofted, rounded_path, smooth_profile
from .vessel_types import Color, Range

Params = Mapping[str, float]

BOTTLE = {
    "height_m": Range(0.18, 0.33, 0.260),
    "radius_m": Range(0.028, 0.045, 0.036),
    "neck_radius_m": Range(0.012, 0.018, 0.0145),
    "shoulder_height": Range(0.5, 0.72, 0.60, "1"),
    "neck_height": Range(0.76, 0.88, 0.80, "1"),
    "wall_m": Range(0.0015, 0.0035, 0.0025),
}


def bottle(p: Params, rgba: Color) -> Draft:
    """A bottle with rounded shoulders, a slim neck and a ring below the mouth."""
    h, r, neck = p["height_m"], p["radius_m"], p["neck_radius_m"]
    corners = np.array([[0.0, r], [p["shoulder_height"] * h, r], [p["neck_height"] * h, neck], [h, neck]])
    body = rounded_path(corners, [0.06, 0.04], steps=14)
    ring = np.array([[h - 0.014, neck], [h - 0.012, neck + 0.0022], [h - 0.003, neck + 0.0022], [h, neck + 0.001]])
    outer = np.vstack([body[body[:, 0] < h - 0.0145], ring])
    walls = round_walls(outer, p["wall_m"], 1.6 * p["wall_m"], base_round_m=0.005, inner_fillet_m=0.006)
    low, high = p["shoulder_height"], p["neck_height"]
    return Draft(
        walls,
        rgba,
        GLASS_KG_M3,
        lip_outlet(walls),
        [body_grasp(walls, 0.1, low - 0.05), body_grasp(walls, high + 0.01, 0.94)],
        symmetry_order=0,
    )


THERMOS = {
    "height_m": Range(0.19, 0.32, 0.250),
    "radius_m": Range(0.032, 0.046, 0.0375),
    "neck_ratio": Range(0.58, 0.8, 0.68, "1"),
    "shoulder_height": Range(0.72, 0.84, 0.78, "1"),
    "wall_m": Range(0.003, 0.006, 0.0045),
}


def thermos(p: Params, rgba: Color) -> Draft:
    """A vacuum flask: painted cylinder on a dark base, short shoulder, bare steel neck."""
    h, r, neck = p["height_m"], p["radius_m"], p["neck_ratio"] * p["radius_m"]
    z_neck = h - 0.028
    z_shoulder = min(p["shoulder_height"] * h, z_neck - 0.9 * (r - neck))
    corners = np.array([[0.0, r], [z_shoulder, r], [z_neck, neck], [h, neck]])
    walls = round_walls(
        rounded_path(corners, [0.014, 0.004], steps=10),
        p["wall_m"],
        2 * p["wall_m"],
        base_round_m=0.003,
        inner_fillet_m=0.006,
    )
    sleeve = [(z_neck + 0.002, neck + 0.0008), (h - 0.004, neck + 0.0008)]
    foot = [(0.003, r + 0.0008), (0.022, r + 0.0008)]
    return Draft(
        walls,
        rgba,
        # Two thin steel walls with nothing in between, drawn as one.
        0.3 * STEEL_KG_M3,
        lip_outlet(walls),
        [body_grasp(walls, 0.15, z_shoulder / h - 0.05)],
        additions=[
            Part(lofted(np.array(sleeve)), STEEL),
            Part(lofted(np.array(foot)), BLACK, PLASTIC_KG_M3),
        ],
        symmetry_order=0,
        inside_rgba=STEEL,
    )


CAN = {
    "height_m": Range(0.08, 0.14, 0.110),
    "radius_m": Range(0.030, 0.055, 0.0375),
    "wall_m": Range(0.0005, 0.0012, 0.0008),
    "ribs": Range(0.0, 12.0, 7.0, "1"),
    "rib_depth_m": Range(0.0004, 0.0012, 0.0008),
}


def can(p: Params, rgba: Color) -> Draft:
    """An opened food tin with ribbed sides and rolled rims."""
    h, r = p["height_m"], p["radius_m"]
    ribs = round(p["ribs"])
    bead, edge = 0.0014, 0.18 * h
    z = np.unique(np.concatenate([np.linspace(edge, h - edge, 16 * max(ribs, 1) + 1), [0.006, h - 0.006]]))
    inside = np.clip((z - edge) / (h - 2 * edge), 0, 1)
    wave = 0.5 * (1 - np.cos(2 * np.pi * ribs * inside)) if ribs else np.zeros_like(z)
    side = np.column_stack([z, r - p["rib_depth_m"] * wave])
    outer = np.vstack(
        [[[0.0, r + bead], [0.0035, r + bead], [0.005, r]], side, [[h - 0.005, r], [h - 0.0035, r + bead]]]
    )
    outer = np.vstack([outer, [h, r + bead]])
    walls = round_walls(outer, p["wall_m"], 0.003 + p["wall_m"], base_round_m=0.001, inner_fillet_m=0.001)
    return Draft(walls, rgba, STEEL_KG_M3, lip_outlet(walls), [body_grasp(walls, 0.1, 0.9)], symmetry_order=0)


CARTON = {
    "height_m": Range(0.14, 0.26, 0.200),
    "half_width_m": Range(0.030, 0.05, 0.0355),
    "corner": Range(0.06, 0.35, 0.14, "1"),
    "shoulder_height": Range(0.68, 0.84, 0.76, "1"),
    "neck_radius_m": Range(0.014, 0.024, 0.0185),
    "wall_m": Range(0.0012, 0.003, 0.0018),
}


def carton(p: Params, rgba: Color) -> Draft:
    """A square drinks carton whose sloping top runs into a round mouth, cap taken off."""
    h, half, neck = p["height_m"], p["half_width_m"], p["neck_radius_m"]
    z_neck = h - 0.020
    z_shoulder = min(p["shoulder_height"] * h, z_neck - 0.02)
    corners = np.array([[0.0, half], [z_shoulder, half], [z_neck, neck], [h, neck]])
    outer = rounded_path(corners, [0.006, 0.004], steps=6)
    walls = round_walls(outer, p["wall_m"], 1.5 * p["wall_m"], base_round_m=0.001, inner_fillet_m=0.002)
    # The square turns into a circle over the slope; more levels there keep the loft smooth.
    levels = np.linspace(z_shoulder, z_neck, 16)

    def square(profile: Array) -> tuple[Array, Array]:
        z = np.union1d(profile[:, 0], levels[(levels > profile[0, 0]) & (levels < profile[-1, 0])])
        share = np.clip((z - z_shoulder) / (z_neck - z_shoulder), 0, 1)
        dense = np.column_stack([z, np.interp(z, profile[:, 0], profile[:, 1])])
        return dense, p["corner"] + (1 - p["corner"]) * share

    outer_dense, corner_outer = square(walls.outer)
    inner_dense, corner_inner = square(walls.inner)
    walls = replace(walls, outer=outer_dense, inner=inner_dense, corner_outer=corner_outer, corner_inner=corner_inner)
    ring = lofted(np.array([[z_neck - 0.001, neck + 0.0015], [h - 0.003, neck + 0.0015]]))
    return Draft(
        walls,
        rgba,
        CARD_KG_M3,
        lip_outlet(walls),
        [body_grasp(walls, 0.1, 0.7)],
        additions=[Part(ring, (0.9, 0.9, 0.9, 1.0))],
        symmetry_order=4,
    )


VASE = {
    "height_m": Range(0.15, 0.30, 0.220),
    "belly_radius_m": Range(0.04, 0.075, 0.055),
    "base_ratio": Range(0.45, 0.8, 0.60, "1"),
    "neck_ratio": Range(0.3, 0.6, 0.42, "1"),
    "mouth_ratio": Range(0.5, 0.95, 0.70, "1"),
    "belly_height": Range(0.3, 0.62, 0.46, "1"),
    "neck_height": Range(0.78, 0.9, 0.84, "1"),
    "wall_m": Range(0.003, 0.006, 0.004),
}


def vase(p: Params, rgba: Color) -> Draft:
    """A flower vase: slim foot, swelling belly, drawn-in neck, flared mouth."""
    h, belly = p["height_m"], p["belly_radius_m"]
    outer = smooth_profile(
        [
            (0.0, p["base_ratio"] * belly),
            (0.03 * h, p["base_ratio"] * belly),
            (p["belly_height"] * h, belly),
            (p["neck_height"] * h, p["neck_ratio"] * belly),
            (h, p["mouth_ratio"] * belly),
        ],
        100,
    )
    walls = round_walls(outer, p["wall_m"], 2 * p["wall_m"], base_round_m=0.002, inner_fillet_m=0.008)
    neck_grasp = body_grasp(walls, p["neck_height"] - 0.05, p["neck_height"] + 0.05)
    return Draft(
        walls, rgba, CERAMIC_KG_M3, lip_outlet(walls), [neck_grasp, body_grasp(walls, 0.1, 0.9)], symmetry_order=0
    )
