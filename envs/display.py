"""What an environment's `render()` shows: a picture, or MuJoCo's window, with the overlays that were asked for."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from .overlays import Hud, Overlays
from .rendering import Cameras, Particles, Viewer, has_screen, require_screen

RENDER_MODES = ("human", "rgb_array")


def render_modes() -> list[str]:
    """The render modes that can work here: there is no window without a screen."""
    return [mode for mode in RENDER_MODES if mode != "human" or has_screen()]


class Display:
    """A render mode with its camera, picture size and overlays; it remembers the lip's trail."""

    def __init__(
        self,
        mode: str | None,
        camera: str,
        size: tuple[int, int],
        overlays: Sequence[str],
        fps: float,
    ) -> None:
        """mode: None, "human" or "rgb_array"; size: (height, width) in px.

        Raises UserError for an unknown mode or overlay, and for "human" where there is no screen.
        """
        if mode is not None and mode not in RENDER_MODES:
            raise UserError(f"render_mode is {mode!r}; choose {', '.join(RENDER_MODES)}, or None")
        if mode == "human":
            require_screen()
        self._mode, self._camera, self._size, self._fps = mode, camera, size, fps
        self._overlays = Overlays(overlays, fps)
        self._viewer: Viewer | None = None

    def twin(self) -> Display:
        """An equal one that has shown nothing yet."""
        return Display(self._mode, self._camera, self._size, self._overlays.names, self._fps)

    @property
    def is_window(self) -> bool:
        """Whether a person watches: then every step and reset is shown, without being asked."""
        return self._mode == "human"

    @property
    def is_open(self) -> bool:
        """False once the person has closed the window."""
        return self._viewer is None or self._viewer.is_open

    def restart(self) -> None:
        """A new episode, or a restored state, begins."""
        self._overlays.restart()

    @property
    def has_trail(self) -> bool:
        """Whether the lip's places are wanted."""
        return "trail" in self._overlays.names

    def record(self, lip_m: Array) -> None:
        """Remember where the lip (3,) is in the world; called when an episode begins and after every step."""
        self._overlays.record(lip_m)

    def show(
        self,
        cameras: Cameras,
        data: mujoco.MjData,
        T_world_reference: Array,
        hud: Hud,
        particles: Particles | None = None,
    ) -> NDArray[np.uint8] | None:
        """The picture (H, W, 3) of this moment; None when it went to the window, or nowhere.

        particles: those that are not in the model.
        """
        if self._mode is None:
            return None
        overlay = self._overlays.at(T_world_reference, hud)
        if self._mode == "rgb_array":
            return cameras.picture(data, self._camera, self._size, particles, overlay)
        if self._viewer is None or self._viewer.data is not data:
            # Another geometry is another model, which a window cannot change to.
            self.close()
            self._viewer = Viewer(cameras.model, data, self._camera, self._fps)
        self._viewer.show(particles, overlay)
        return None

    def close(self) -> None:
        """Close the window."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
