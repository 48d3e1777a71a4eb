"""What can be drawn over a picture of the scene: the reference as a ghost, the lip's trail, and figures (HUD).

All of it is drawing only: nothing here is in the model, and nothing of it reaches the observations.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from .scene import VESSEL_BODY

OVERLAYS = ("ghost", "trail", "hud")
TRAIL_S = 1.0
GHOST_RGBA = (0.25, 0.95, 0.45, 0.35)
# A ghost of the vessel's own size would flicker where the two coincide.
GHOST_SCALE = 1.02
TRAIL_RGB, TRAIL_WIDTH_PX = (1.0, 0.45, 0.1), 3.0
# A picture lower than this has no room for words, only for the bar.
WORDS_FROM_PX = 160
_TEXT, _BACK, _EMPTY, _POURED, _SPILLED = (240, 242, 245), (24, 26, 30), (70, 75, 84), (74, 163, 255), (255, 107, 87)


@dataclass(frozen=True)
class Hud:
    """The figures of one moment: s, fractions of the particles, m, rad."""

    time_s: float
    poured_fraction: float
    spilled_fraction: float
    position_error_m: float
    rotation_error_rad: float

    def lines(self) -> tuple[tuple[str, str], ...]:
        """Names and values in the units a person reads."""
        return (
            ("time", f"{self.time_s:.2f} s"),
            ("poured", f"{100 * self.poured_fraction:.0f} %"),
            ("spilled", f"{100 * self.spilled_fraction:.0f} %"),
            ("error", f"{1000 * self.position_error_m:.1f} mm  {np.rad2deg(self.rotation_error_rad):.1f} deg"),
        )


@dataclass(frozen=True)
class Overlay:
    """What is drawn over one picture; None leaves a thing out.

    T_world_ghost: (4, 4) pose at which the held vessel is drawn once more, translucent. trail_m: (K, 3) places of the
    lip in the world, the oldest first. hud: the figures.
    """

    T_world_ghost: Array | None = None
    trail_m: Array | None = None
    hud: Hud | None = None


class Overlays:
    """The overlays that were asked for, with the memory that the trail needs."""

    def __init__(self, names: Sequence[str], control_hz: float) -> None:
        """Raises UserError for names that are not in `OVERLAYS`."""
        self.names = overlay_names(names)
        self._trail: deque[Array] = deque(maxlen=round(TRAIL_S * control_hz) + 1)

    def restart(self) -> None:
        """Forget the trail: a new episode, or a restored state, begins."""
        self._trail.clear()

    def record(self, lip_m: Array) -> None:
        """Remember where the lip (3,) is in the world; called when an episode begins and after every step."""
        if "trail" in self.names:
            self._trail.append(np.array(lip_m, float))

    def at(self, T_world_reference: Array, hud: Hud) -> Overlay | None:
        """What to draw now, with the reference's pose (4, 4) and the figures of this moment; None for nothing."""
        if not self.names:
            return None
        return Overlay(
            T_world_reference if "ghost" in self.names else None,
            np.array(self._trail).reshape(-1, 3) if "trail" in self.names else None,
            hud if "hud" in self.names else None,
        )


def overlay_names(names: Sequence[str]) -> tuple[str, ...]:
    """Known and different names of overlays. Raises UserError otherwise."""
    if isinstance(names, str) or len(set(names)) != len(names) or set(names) - set(OVERLAYS):
        raise UserError(f"overlays is {names!r}; give a tuple of different names out of {', '.join(OVERLAYS)}, or ()")
    return tuple(names)


def add_overlay(scene: mujoco.MjvScene, model: mujoco.MjModel, overlay: Overlay) -> None:
    """Append ghost and trail to a scene that `mjv_updateScene` has just filled, or to a viewer's own."""
    if overlay.T_world_ghost is not None:
        _add_ghost(scene, model, overlay.T_world_ghost)
    if overlay.trail_m is not None and len(overlay.trail_m) > 1:
        _add_trail(scene, overlay.trail_m)


def _add_ghost(scene: mujoco.MjvScene, model: mujoco.MjModel, T_world_object: Array) -> None:
    R, rotation = GHOST_SCALE * T_world_object[:3, :3], np.empty(9)
    for number in drawn_meshes(model):
        # The compiler has moved each mesh into its own principal axes.
        mujoco.mju_quat2Mat(rotation, model.geom_quat[number])
        position = R @ model.geom_pos[number] + T_world_object[:3, 3]
        geom = _next_geom(scene)
        size, turned = np.zeros(3), (R @ rotation.reshape(3, 3)).ravel()
        rgba = np.array(GHOST_RGBA, np.float32)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_MESH, size, position, turned, rgba)
        # Twice: the odd numbers stand for the meshes' convex hulls.
        geom.dataid = 2 * int(model.geom_dataid[number])
        geom.transparent = 1


def drawn_meshes(model: mujoco.MjModel) -> list[int]:
    """The geoms that show the held vessel."""
    body = int(model.body(VESSEL_BODY).id)
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    mesh = int(mujoco.mjtGeom.mjGEOM_MESH)
    return [g for g in range(first, first + count) if int(model.geom_type[g]) == mesh and int(model.geom_group[g]) < 3]


def _add_trail(scene: mujoco.MjvScene, points_m: Array) -> None:
    upright = np.eye(3).ravel()
    for number, (start, end) in enumerate(pairwise(points_m)):
        geom = _next_geom(scene)
        alpha = (number + 1) / (len(points_m) - 1)
        rgba = np.array([*TRAIL_RGB, 0.15 + 0.85 * alpha], np.float32)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3), np.zeros(3), upright, rgba)
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, TRAIL_WIDTH_PX, start, end)
        geom.emission = 1.0


def _next_geom(scene: mujoco.MjvScene) -> mujoco.MjvGeom:
    if scene.ngeom >= scene.maxgeom:
        raise ValueError(f"the scene has no room for more than {scene.maxgeom} shapes")
    scene.ngeom += 1
    return scene.geoms[scene.ngeom - 1]


def write_hud(picture: NDArray[np.uint8], hud: Hud) -> None:
    """Write the figures into the upper left corner of a picture (H, W, 3), in place, at a size that fits it."""
    import cv2

    height, width = picture.shape[:2]
    scale = max(0.3, min(height / 480, width / 480))
    margin, bar = round(8 * scale) + 2, max(2, round(7 * scale))
    if height >= WORDS_FROM_PX and width >= WORDS_FROM_PX:
        font, size, pitch = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, round(20 * scale)
        right, bottom = margin + round(230 * scale), margin + 4 * pitch + 2 * margin + bar
        panel = picture[margin // 2 : bottom, margin // 2 : right]
        panel[:] = panel // 3 + np.array(_BACK, np.uint8) // 2
        for line, (name, value) in enumerate(hud.lines()):
            y = margin + (line + 1) * pitch - round(4 * scale)
            cv2.putText(picture, name, (2 * margin, y), font, size, _TEXT, 1, cv2.LINE_AA)
            cv2.putText(picture, value, (2 * margin + round(70 * scale), y), font, size, _TEXT, 1, cv2.LINE_AA)
        left, top, length = 2 * margin, margin + 4 * pitch + margin, right - 3 * margin
    else:
        left, top, length = margin, margin, width - 2 * margin
    ends = [left, left + round(length * hud.poured_fraction)]
    ends.append(left + round(length * min(1.0, hud.poured_fraction + hud.spilled_fraction)))
    picture[top : top + bar, left : left + length] = _EMPTY
    picture[top : top + bar, ends[0] : ends[1]] = _POURED
    picture[top : top + bar, ends[1] : ends[2]] = _SPILLED
