"""Vessels that pour through a spout: kettles, pots, cans. Each function drafts one category from its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .vessel_assembly import (
    BLACK,
    PLASTIC_KG_M3,
    STEEL,
    STEEL_KG_M3,
    Draft,
    Part,
    body_grasp,
    handle_grasp,
    knob,
    round_walls,
    spout,
)
from .vessel_shapes import lofted, rounded_path, tube
from .vessel_types import Color, Range

Params = Mapping[str, float]

GOOSENECK_KETTLE = {
    "height_m": Range(0.10, 0.24, 0.155),
    "base_radius_m": Range(0.045, 0.10, 0.067),
    "top_radius_m": Range(0.03, 0.08, 0.0436),
    "flare_height": Range(0.4, 1.0, 0.70, "1"),
    "wall_m": Range(0.0006, 0.002, 0.001),
    "spout_start": Range(0.10, 0.40, 0.185, "1"),
    "spout_reach_m": Range(0.10, 0.24, 0.1375),
    "spout_height_m": Range(0.10, 0.26, 0.158),
    "spout_radius_m": Range(0.003, 0.009, 0.0039),
    "spout_taper": Range(0.6, 1.0, 0.82, "1"),
    "spout_foot": Range(0.08, 0.6, 0.37, "1"),
    "spout_neck_out": Range(0.15, 0.85, 0.625, "1"),
    "spout_neck_up": Range(0.4, 0.9, 0.725, "1"),
    "spout_tip_m": Range(0.004, 0.03, 0.0085),
    "handle_height": Range(0.5, 0.92, 0.765, "1"),
    "handle_gap_m": Range(0.02, 0.06, 0.0365),
    "handle_lean_m": Range(-0.01, 0.06, 0.039),
    "handle_drop_m": Range(0.05, 0.13, 0.080),
    "handle_horn_m": Range(0.0, 0.05, 0.023),
    "handle_radius_m": Range(0.007, 0.014, 0.0090),
    "lid_radius": Range(0.6, 0.93, 0.90, "1"),
    "lid_height_m": Range(0.002, 0.04, 0.008),
}


def gooseneck_kettle(p: Params, rgba: Color) -> Draft:
    """A pour-over kettle: flared body, sunk lid with a knob, swan neck from low on the body, stick handle."""
    h, base, top = p["height_m"], p["base_radius_m"], p["top_radius_m"]
    foot = 0.04 * h
    corner_z = foot + p["flare_height"] * (h - foot)
    corners = [(foot * 0.6, base), (foot, base), (corner_z, top)]
    if corner_z < h - 1e-4:
        corners.append((h, top))
    outer = rounded_path(np.array(corners), [0.05 * h] + [1.3 * h] * (len(corners) - 3), steps=14)
    recess = 0.006
    walls = round_walls(
        outer,
        p["wall_m"],
        outer[0, 0] + 1.5 * p["wall_m"],
        base_round_m=0.002,
        inner_fillet_m=0.004,
        ceiling_m=h - recess - 0.003,
    )
    lid_r = p["lid_radius"] * top
    recess_profile = np.array([[h - recess, 0.8 * lid_r], [h - 0.4 * recess, 0.95 * lid_r], [h, lid_r]])
    recess_profile = np.vstack([recess_profile, [h + 0.001, lid_r]])
    foot_disc, foot_hole = (
        lofted(np.array([[z, k * base], [foot, k * base]])) for z, k in ((0.0, 0.955), (-0.001, 0.85))
    )
    foot_ring = Part(foot_disc - foot_hole, BLACK, PLASTIC_KG_M3)

    radius = max(p["spout_radius_m"], p["wall_m"] + 0.0015)
    z0 = max(p["spout_start"] * h, walls.floor_m + radius + 0.002)
    wall_x = walls.outer_radius(z0)
    reach = max(p["spout_reach_m"], wall_x + 0.03)
    rise = max(p["spout_height_m"] - z0, 0.03)
    tip_x = reach - p["spout_tip_m"]
    run = tip_x - wall_x
    neck_out = max(p["spout_neck_out"], p["spout_foot"])
    polyline = np.array(
        [
            [0.0, z0],
            [wall_x + 0.12 * p["spout_foot"] * run, z0],
            [wall_x + p["spout_foot"] * run, z0 + 0.055 * rise],
            [wall_x + neck_out * run, z0 + p["spout_neck_up"] * rise],
            [tip_x, z0 + rise],
            [reach, z0 + rise - 0.2 * p["spout_tip_m"]],
        ]
    )
    path = rounded_path(polyline, [0.01, max(0.016, 2.2 * radius), 0.045, max(0.008, 1.5 * radius)], steps=8)
    tube_part, channel, outlet = spout(
        walls, path, radius, max(p["spout_taper"] * radius, 0.8 * p["wall_m"] + 0.0012), 0.8 * p["wall_m"], rgba
    )
    # Where the tube meets the body the metal is drawn out into a small cone.
    flange_x = np.array([[wall_x - 3 * radius, z0], [wall_x + 0.5 * radius, z0]])
    flange = Part(tube(flange_x, np.array([min(2.2 * radius, z0 - 0.001), 1.2 * radius])), rgba)

    grip_r = p["handle_radius_m"]
    z_stub = min(p["handle_height"] * h, h - 1.1 * grip_r)
    x_body = -walls.outer_radius(z_stub)
    x_bend = x_body - p["handle_gap_m"]
    x_low = x_bend - p["handle_lean_m"]
    z_low = max(z_stub - p["handle_drop_m"], grip_r)
    horn = p["handle_horn_m"]
    stick = [(x_bend - 0.45 * horn, z_stub + horn), (x_bend, z_stub)] if horn > 0.004 else [(x_bend, z_stub)]
    stick_path = np.array([*stick, (x_low, z_low)])
    grip_path = rounded_path(stick_path, 0.03, steps=8) if len(stick_path) > 2 else stick_path
    share = np.linspace(0, 1, len(grip_path))
    grip = tube(grip_path, grip_r * (1.05 - 0.2 * share), dome=0.35)
    x_in = -(walls.inner_radius(z_stub) - 0.004)
    x_metal = x_body - 0.3 * p["handle_gap_m"]
    stub = Part(tube(np.array([[x_in, z_stub], [x_metal - 0.002, z_stub]]), 0.9 * grip_r), STEEL)
    arm = tube(np.array([[x_metal, z_stub], [x_bend, z_stub]]), np.array([0.95 * grip_r, grip_r]))
    hold = np.array([[x_bend, z_stub], [x_low, z_low]])

    return Draft(
        walls,
        rgba,
        STEEL_KG_M3,
        outlet,
        [
            handle_grasp(hold + 0.12 * (hold[::-1] - hold), 2 * grip_r),
            body_grasp(walls, 0.55, 0.9, sideways=True),
        ],
        additions=[
            foot_ring,
            tube_part,
            flange,
            stub,
            Part(arm + grip, BLACK, PLASTIC_KG_M3),
            knob(h - recess, 0.42 * lid_r, recess + p["lid_height_m"], BLACK),
        ],
        dents=[Part(lofted(recess_profile), BLACK)],
        cuts=[channel],
    )
