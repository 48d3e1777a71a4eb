"""Kettles: gooseneck, stovetop, electric. Each function drafts one category from its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .geometry import Array
from .vessel_assembly import (
    BLACK,
    PLASTIC_KG_M3,
    STEEL,
    STEEL_KG_M3,
    Draft,
    Part,
    beak,
    body_grasp,
    handle_grasp,
    knob,
    loop_handle,
    round_walls,
    spout,
)
from .vessel_shapes import Lip, cumulative_share, lofted, rounded_path, smooth_profile, tube
from .vessel_types import Color, GraspRegion, Range

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
    reach = max(p["spout_reach_m"], wall_x + 0.025 + 1.2 * radius)
    rise = max(p["spout_height_m"] - z0, 0.03)
    # Shorter than this the bend would be tighter than the tube is wide.
    tip_m = max(p["spout_tip_m"], 1.2 * radius)
    tip_x = reach - tip_m
    run = tip_x - wall_x
    neck_out = max(p["spout_neck_out"], p["spout_foot"])
    polyline = np.array(
        [
            [0.0, z0],
            [wall_x + 0.12 * p["spout_foot"] * run, z0],
            [wall_x + p["spout_foot"] * run, z0 + 0.055 * rise],
            [wall_x + neck_out * run, z0 + p["spout_neck_up"] * rise],
            [tip_x, z0 + rise],
            [reach, z0 + rise - 0.2 * tip_m],
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
    grip = tube(grip_path, grip_r * (1.05 - 0.2 * cumulative_share(grip_path)), dome=0.35)
    x_in = -(walls.inner_radius(z_stub) - 0.004)
    x_metal = x_body - 0.3 * p["handle_gap_m"]
    stub = Part(tube(np.array([[x_in, z_stub], [x_metal - 0.002, z_stub]]), 0.9 * grip_r), STEEL)
    # To the middle of the stick, whose rounded bend stays short of its corner.
    x_stick = float(np.interp(-z_stub, -grip_path[:, 1], grip_path[:, 0]))
    arm = tube(np.array([[x_metal, z_stub], [x_stick, z_stub]]), np.array([0.95 * grip_r, grip_r]))
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


STOVETOP_KETTLE = {
    "height_m": Range(0.09, 0.17, 0.120),
    "radius_m": Range(0.07, 0.12, 0.095),
    "base_ratio": Range(0.75, 1.0, 0.90, "1"),
    "belly_height": Range(0.15, 0.4, 0.25, "1"),
    "lid_ratio": Range(0.35, 0.6, 0.46, "1"),
    "wall_m": Range(0.0006, 0.002, 0.001),
    "spout_height": Range(0.35, 0.6, 0.48, "1"),
    "spout_length_m": Range(0.035, 0.08, 0.055),
    "spout_tilt_rad": Range(0.5, 1.1, 0.80, "rad"),
    "spout_radius_m": Range(0.010, 0.02, 0.015),
    "spout_taper": Range(0.55, 1.0, 0.75, "1"),
    "handle_height_m": Range(0.06, 0.12, 0.085),
    "handle_radius_m": Range(0.005, 0.011, 0.008),
    "knob_radius_m": Range(0.01, 0.02, 0.015),
}


def stovetop_kettle(p: Params, rgba: Color) -> Draft:
    """A squat dome with a short stout spout, a lid with a knob and a handle arched over the top."""
    h, r, top = p["height_m"], p["radius_m"], p["lid_ratio"] * p["radius_m"]
    belly = p["belly_height"]
    shoulder = 0.5 * (r + top)
    outer = smooth_profile(
        [(0.0, p["base_ratio"] * r), (belly * h, r), ((0.62 + 0.25 * belly) * h, 0.55 * shoulder + 0.45 * r), (h, top)],
        60,
    )
    walls = round_walls(
        outer, p["wall_m"], 1.5 * p["wall_m"], base_round_m=0.006, inner_fillet_m=0.005, ceiling_m=h - 0.003
    )
    lid = smooth_profile([(h - 0.001, 0.94 * top), (h + 0.006, 0.85 * top), (h + 0.010, 0.35 * top)], 12)
    root = p["spout_radius_m"]
    z0 = p["spout_height"] * h
    wall_x = walls.outer_radius(z0)
    tilt, length = p["spout_tilt_rad"], p["spout_length_m"]
    along = np.array([np.cos(tilt), np.sin(tilt)])
    corner = np.array([wall_x, z0])
    # Straight through the wall, and inside level from the axis, where there is room for it.
    inside = corner - along * min(3.0 * root, max(0.0, z0 - walls.floor_m - 1.2 * root) / along[1])
    tip = corner + length * along
    path = rounded_path(np.array([[0.0, inside[1]], inside, tip]), 1.3 * root, steps=6)
    tube_part, channel, outlet = spout(walls, path, root, p["spout_taper"] * root, max(p["wall_m"], 0.001), rgba)

    grip_r = p["handle_radius_m"]
    z_foot = 0.80 * h
    x_foot = walls.outer_radius(z_foot) - 0.4 * grip_r
    z_top = h + p["handle_height_m"]
    arch = rounded_path(
        np.array([[-x_foot, z_foot], [-1.02 * x_foot, z_top], [1.02 * x_foot, z_top], [x_foot, z_foot]]),
        0.55 * r,
        steps=12,
    )
    flat = 0.5 + 0.5 * np.clip((arch[:, 1] - z_foot) / (z_top - z_foot), 0, 1)
    handle = tube(arch, 0.6 * grip_r * flat + 0.1 * grip_r, grip_r * flat)
    grip = arch[np.abs(arch[:, 0]) < 0.6 * x_foot]
    sleeve = tube(_line(grip[0], grip[-1]), 0.95 * grip_r, 1.2 * grip_r, dome=0.3)
    over = GraspRegion(
        "handle",
        np.array([0.0, 0.0, float(grip[:, 1].mean())]),
        np.array([1.0, 0.0, 0.0]),
        float(np.ptp(grip[:, 0])),
        2.4 * grip_r,
        np.array([0.0, 0.0, -1.0]),
    )
    return Draft(
        walls,
        rgba,
        STEEL_KG_M3,
        outlet,
        [over, body_grasp(walls, 0.1, 0.5, sideways=True)],
        additions=[
            tube_part,
            Part(lofted(lid), rgba),
            knob(h + 0.009, p["knob_radius_m"], 0.020, BLACK),
            Part(handle, STEEL),
            Part(sleeve, BLACK, PLASTIC_KG_M3),
        ],
        cuts=[channel],
    )


def _line(start: Array, end: Array, count: int = 8) -> Array:
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.asarray((1 - share) * start + share * end)


ELECTRIC_KETTLE = {
    "height_m": Range(0.16, 0.25, 0.205),
    "base_radius_m": Range(0.06, 0.095, 0.078),
    "top_ratio": Range(0.6, 0.95, 0.76, "1"),
    "wall_m": Range(0.0008, 0.002, 0.0012),
    "beak_out_m": Range(0.018, 0.034, 0.026),
    "beak_depth": Range(0.2, 0.45, 0.32, "1"),
    "handle_reach_m": Range(0.045, 0.075, 0.058),
    "handle_bottom": Range(0.08, 0.4, 0.18, "1"),
    "handle_thickness_m": Range(0.016, 0.028, 0.022),
    "foot_m": Range(0.012, 0.03, 0.020),
}


def electric_kettle(p: Params, rgba: Color) -> Draft:
    """A tall tapered body on a dark foot, a beak at the rim, a large loop handle and a flat lid."""
    h, base, top = p["height_m"], p["base_radius_m"], p["top_ratio"] * p["base_radius_m"]
    foot = p["foot_m"]
    outer = smooth_profile([(0.9 * foot, base), (0.5 * h, 0.45 * base + 0.55 * top), (h, top)], 50)
    walls = round_walls(
        outer,
        p["wall_m"],
        foot + p["wall_m"],
        inner_fillet_m=0.004,
        ceiling_m=h - 0.002,
        lip=Lip(p["beak_out_m"], p["beak_depth"] * h, 0.40),
    )
    lid = [(h - 0.002, 0.93 * top), (h + 0.008, 0.90 * top), (h + 0.012, 0.7 * top)]
    stand, hollow = (lofted(np.array([[z, k * base], [foot, k * base]])) for z, k in ((0.0, 1.01), (-0.001, 0.94)))
    channel, outlet = beak(walls, BLACK, 0.2 * p["beak_out_m"])
    thick = 0.5 * p["handle_thickness_m"]
    z_top, z_low = h - thick - 0.006, max(p["handle_bottom"] * h, foot + thick)
    x_out = -(base + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls, [(0.0, z_top), (0.97 * x_out, z_top), (x_out, z_low), (0.0, z_low)], 0.62 * thick, thick, BLACK, 0.03
    )
    dark = [
        Part(part, BLACK, PLASTIC_KG_M3) for part in (stand - hollow, handle.shape, lofted(smooth_profile(lid, 10)))
    ]
    return Draft(
        walls,
        rgba,
        STEEL_KG_M3,
        outlet,
        [grip, body_grasp(walls, 0.4, 0.9, sideways=True)],
        additions=dark,
        cuts=[channel],
    )
