"""Pots and cans: teapot, moka pot, saucepan, watering can. Each function drafts one category from its parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .geometry import Array
from .vessel_assembly import (
    BLACK,
    CERAMIC_KG_M3,
    PLASTIC_KG_M3,
    STEEL_KG_M3,
    Draft,
    Part,
    beak,
    body_grasp,
    handle_grasp,
    knob,
    lip_outlet,
    loop_handle,
    round_walls,
    spout,
)
from .vessel_shapes import Lip, cumulative_share, lofted, rounded_path, smooth_profile, tube
from .vessel_types import Color, Range

Params = Mapping[str, float]

TEAPOT = {
    "height_m": Range(0.08, 0.15, 0.110),
    "radius_m": Range(0.055, 0.10, 0.075),
    "base_ratio": Range(0.5, 0.85, 0.66, "1"),
    "belly_height": Range(0.4, 0.6, 0.48, "1"),
    "mouth_ratio": Range(0.4, 0.7, 0.52, "1"),
    "wall_m": Range(0.003, 0.006, 0.004),
    "spout_start": Range(0.28, 0.5, 0.38, "1"),
    "spout_out_m": Range(0.05, 0.09, 0.068),
    "spout_radius_m": Range(0.012, 0.02, 0.016),
    "spout_taper": Range(0.4, 0.7, 0.5, "1"),
    "spout_curl": Range(0.0, 1.0, 0.5, "1"),
    "handle_reach_m": Range(0.04, 0.07, 0.054),
    "handle_thickness_m": Range(0.008, 0.014, 0.011),
    "lid_dome_m": Range(0.006, 0.025, 0.014),
    "knob_radius_m": Range(0.007, 0.015, 0.010),
}


def teapot(p: Params, rgba: Color) -> Draft:
    """A globe with an S-shaped tapering spout, an ear of a handle and a domed lid."""
    h, r = p["height_m"], p["radius_m"]
    mouth, base, belly = p["mouth_ratio"] * r, p["base_ratio"] * r, p["belly_height"] * h
    outer = smooth_profile(
        [
            (0.0, base),
            (0.04 * h, base),
            (0.5 * belly, 0.28 * base + 0.72 * r + 0.06 * r),
            (belly, r),
            (0.5 * (belly + h), 0.24 * mouth + 0.76 * r),
            (h, mouth),
        ],
        80,
    )
    walls = round_walls(
        outer, p["wall_m"], 1.4 * p["wall_m"], base_round_m=0.002, inner_fillet_m=0.008, ceiling_m=h - 0.004
    )
    dome = p["lid_dome_m"]
    lid = [(h - 0.002, 0.92 * mouth), (h + 0.002, 0.93 * mouth)]
    lid += [(h + 0.002 + 0.6 * dome, 0.66 * mouth), (h + 0.002 + dome, 0.25 * mouth)]
    root, tip = p["spout_radius_m"], max(p["spout_taper"] * p["spout_radius_m"], 0.8 * p["wall_m"] + 0.0025)
    z0 = max(p["spout_start"] * h, walls.floor_m + root + 0.002)
    wall_x, out, z_tip = walls.outer_radius(z0), p["spout_out_m"], h + 0.004
    polyline = np.array(
        [
            [0.0, z0],
            [wall_x + 0.30 * out, z0 + 0.02 * h],
            [wall_x + 0.58 * out, z0 + 0.72 * (z_tip - z0)],
            [wall_x + 0.82 * out, z_tip],
            [wall_x + out, z_tip + 0.003 - 0.004 * p["spout_curl"]],
        ]
    )
    polyline = np.insert(polyline, 1, [wall_x - 0.2 * root, z0], axis=0)
    path = rounded_path(polyline, [0.5 * root, 2.2 * root, 2.5 * root, 2.0 * tip], steps=8)
    tube_part, channel, outlet = spout(walls, path, root, tip, 0.8 * p["wall_m"], rgba)
    thick = 0.5 * p["handle_thickness_m"]
    z_top, z_low = 0.78 * h, 0.24 * h
    x_out = -(r + p["handle_reach_m"] - thick)
    handle, grip = loop_handle(
        walls,
        [(0.0, z_top), (0.98 * x_out, z_top + 0.10 * h), (x_out, 0.52 * h), (0.82 * x_out, z_low), (0.0, z_low)],
        thick,
        1.25 * thick,
        rgba,
        0.03,
    )
    return Draft(
        walls,
        rgba,
        CERAMIC_KG_M3,
        outlet,
        [grip, body_grasp(walls, 0.3, 0.7, sideways=True)],
        additions=[
            tube_part,
            handle,
            Part(lofted(smooth_profile(lid, 16)), rgba),
            knob(h + 0.002 + dome, p["knob_radius_m"], 1.6 * p["knob_radius_m"], rgba),
        ],
        cuts=[channel],
    )


MOKA_POT = {
    "height_m": Range(0.12, 0.22, 0.160),
    "radius_m": Range(0.036, 0.06, 0.046),
    "waist_ratio": Range(0.66, 0.88, 0.76, "1"),
    "waist_height": Range(0.38, 0.5, 0.44, "1"),
    "top_ratio": Range(0.95, 1.12, 1.04, "1"),
    "wall_m": Range(0.002, 0.004, 0.0028),
    "beak_out_m": Range(0.014, 0.028, 0.020),
    "handle_reach_m": Range(0.04, 0.065, 0.050),
    "handle_drop": Range(0.3, 0.55, 0.42, "1"),
    "handle_radius_m": Range(0.006, 0.010, 0.0075),
    "knob_radius_m": Range(0.006, 0.012, 0.009),
}
# Boiler, funnel and filter below the pot are drawn as one block: this is its density with the air inside.
BOILER_KG_M3 = 700.0


def moka_pot(p: Params, rgba: Color) -> Draft:
    """An eight-sided stove-top coffee maker: boiler below, waist, pot with beak, hinged lid and a hanging handle.

    The interior is that of the pot above the waist, which is the part that pours.
    """
    h, r = p["height_m"], p["radius_m"]
    waist_z, waist, top = p["waist_height"] * h, p["waist_ratio"] * r, p["top_ratio"] * r
    outer = np.array([[0.0, r], [waist_z - 0.004, waist], [waist_z + 0.004, waist], [h, top]])
    walls = round_walls(
        outer,
        p["wall_m"],
        waist_z + 0.006,
        inner_fillet_m=0.003,
        ceiling_m=h - 0.003,
        lip=Lip(p["beak_out_m"], 0.75 * (h - waist_z), 0.36),
        sides=8,
    )
    band = Part(lofted(np.array([[waist_z - 0.006, waist + 0.004], [waist_z + 0.004, waist + 0.004]])), rgba)
    lid = lofted(np.array([[h - 0.001, 0.97 * top], [h + 0.0015, 0.97 * top], [h + 0.09 * h, 0.28 * top]]), sides=8)
    channel, outlet = beak(walls, rgba, 0.2 * p["beak_out_m"])
    grip_r = p["handle_radius_m"]
    z_top = h - grip_r - 0.004
    x_body = -walls.outer_radius(z_top)
    x_out, z_low = x_body - p["handle_reach_m"] + grip_r, z_top - p["handle_drop"] * h
    arm = np.array([[x_body + 0.5 * p["wall_m"], z_top], [x_out + 0.008, z_top + 0.002], [x_out, z_low]])
    arm_path = rounded_path(arm, 0.016, steps=8)
    handle = tube(arm_path, grip_r * (0.8 + 0.25 * cumulative_share(arm_path)), dome=0.4)
    grip = np.array([[x_out + 0.005, z_top - 0.008], [x_out, z_low]])
    return Draft(
        walls,
        rgba,
        BOILER_KG_M3,
        outlet,
        [handle_grasp(grip, 2 * grip_r), body_grasp(walls, 0.5, 0.95, sideways=True)],
        additions=[
            band,
            Part(lid, rgba),
            Part(handle, BLACK, PLASTIC_KG_M3),
            knob(h + 0.088 * h, p["knob_radius_m"], 1.9 * p["knob_radius_m"], BLACK),
        ],
        cuts=[channel],
    )


SAUCEPAN = {
    "height_m": Range(0.06, 0.13, 0.090),
    "radius_m": Range(0.06, 0.11, 0.080),
    "base_ratio": Range(0.85, 1.0, 0.97, "1"),
    "wall_m": Range(0.0015, 0.004, 0.0025),
    "base_round_m": Range(0.004, 0.02, 0.012),
    "lip_reach_m": Range(0.003, 0.010, 0.006),
    "handle_length_m": Range(0.10, 0.20, 0.155),
    "handle_tilt_rad": Range(-0.05, 0.35, 0.14, "rad"),
    "handle_thickness_m": Range(0.008, 0.016, 0.012),
    "handle_width_m": Range(0.014, 0.026, 0.020),
}


def saucepan(p: Params, rgba: Color) -> Draft:
    """A straight-sided pan with one long stick handle and a small pouring lip."""
    h, r = p["height_m"], p["radius_m"]
    outer = np.array([[0.0, p["base_ratio"] * r], [0.93 * h, r], [0.97 * h, r + 0.001], [h, r + 0.002]])
    walls = round_walls(
        outer,
        p["wall_m"],
        1.6 * p["wall_m"],
        base_round_m=p["base_round_m"],
        inner_fillet_m=p["base_round_m"],
        lip=Lip(p["lip_reach_m"], 0.22 * h, 0.30),
    )
    thick, width = 0.5 * p["handle_thickness_m"], 0.5 * p["handle_width_m"]
    z = 0.84 * h - thick
    x_in = -(walls.inner_radius(z) - 0.004)
    x_body = -walls.outer_radius(z)
    along = np.array([-np.cos(p["handle_tilt_rad"]), np.sin(p["handle_tilt_rad"])])
    bend = np.array([x_body - 0.018, z])
    end = bend + along * p["handle_length_m"]
    path = rounded_path(np.array([[x_in, z], bend, end]), 0.05, steps=6)
    share = cumulative_share(path)
    swell: Array = 0.6 + 0.2 * np.sin(0.5 * np.pi * np.clip(share / 0.35, 0, 1))
    metal = tube(path, 0.6 * thick, width * swell)
    grip_path = np.vstack([bend + along * 0.25 * p["handle_length_m"], end])
    sleeve = np.vstack([grip_path[0], grip_path.mean(axis=0), grip_path[1]])
    grip = tube(sleeve, thick * np.array([0.9, 1.0, 1.05]), width * np.array([0.85, 1.0, 1.0]), dome=0.6)
    return Draft(
        walls,
        rgba,
        STEEL_KG_M3,
        lip_outlet(walls),
        [handle_grasp(grip_path, 2 * width)],
        additions=[Part(metal, rgba), Part(grip, BLACK, PLASTIC_KG_M3)],
    )


WATERING_CAN = {
    "height_m": Range(0.13, 0.24, 0.175),
    "radius_m": Range(0.055, 0.10, 0.075),
    "top_ratio": Range(0.75, 1.05, 0.92, "1"),
    "wall_m": Range(0.0012, 0.003, 0.002),
    "spout_start": Range(0.12, 0.3, 0.17, "1"),
    "spout_reach_m": Range(0.10, 0.24, 0.165),
    "spout_rise_m": Range(0.01, 0.08, 0.035),
    "spout_radius_m": Range(0.008, 0.016, 0.012),
    "spout_taper": Range(0.4, 0.9, 0.6, "1"),
    "rose_radius_m": Range(0.012, 0.03, 0.021),
    "handle_reach_m": Range(0.05, 0.09, 0.070),
    "handle_rise_m": Range(0.02, 0.07, 0.045),
    "handle_radius_m": Range(0.005, 0.010, 0.007),
}


def watering_can(p: Params, rgba: Color) -> Draft:
    """An open can with a long straight spout that ends in a rose, and a big loop from rim to back."""
    h, r = p["height_m"], p["radius_m"]
    bead = 0.0015
    top = p["top_ratio"] * r
    outer = np.array([[0.0, r], [h - 0.006, top], [h - 0.004, top + bead], [h, top + bead]])
    walls = round_walls(outer, p["wall_m"], 1.5 * p["wall_m"], base_round_m=0.004, inner_fillet_m=0.004)
    root = p["spout_radius_m"]
    tip = max(p["spout_taper"] * root, p["wall_m"] + 0.002)
    z0 = max(p["spout_start"] * h, walls.floor_m + root + 0.002)
    wall_x = walls.outer_radius(z0)
    neck = np.array([wall_x + p["spout_reach_m"], h + p["spout_rise_m"]])
    foot = np.array([wall_x + 0.2 * root, z0])
    along = (neck - foot) / np.linalg.norm(neck - foot)
    path = rounded_path(np.array([[0.0, z0], foot, neck]), 2.2 * root, steps=6)
    tube_part, channel, outlet = spout(walls, path, root, tip, 0.8 * p["wall_m"], rgba)
    # The rose widens over its length and keeps the channel open through its middle.
    rose_r = max(p["rose_radius_m"], 1.4 * tip)
    rose_path = np.array([neck - along * s for s in (1.15 * rose_r, 0.12 * rose_r, 0.0)])
    rose = tube(rose_path, np.array([0.9 * tip, rose_r, rose_r]))
    grip_r = p["handle_radius_m"]
    x_rim, z_low = -walls.outer_radius(h), 0.28 * h
    x_out = -(r + p["handle_reach_m"] - grip_r)
    rise = p["handle_rise_m"]
    loop = [(0.0, h - grip_r - 0.007), (x_rim - 0.012, h + rise), (x_out, h + 0.3 * rise), (x_out + 0.01, 0.5 * h)]
    handle, grip = loop_handle(
        walls,
        [*loop, (0.0, z_low)],
        grip_r,
        1.2 * grip_r,
        rgba,
        0.035,
    )
    return Draft(
        walls,
        rgba,
        PLASTIC_KG_M3,
        outlet,
        [grip, body_grasp(walls, 0.3, 0.9, sideways=True)],
        additions=[tube_part, Part(rose, rgba), handle],
        cuts=[channel],
    )
