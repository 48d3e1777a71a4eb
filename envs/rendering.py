"""Pictures of the scene without a screen, fast enough for software rendering."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.offscreen import load_mujoco


class Cameras:
    """The scene's cameras; a rendering context per picture size is made when first needed."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._renderers: dict[tuple[int, int], Any] = {}

    def picture(self, data: mujoco.MjData, camera: str, size: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 picture by a named camera; size is (height, width) in px."""
        if size not in self._renderers:
            self._renderers[size] = self._make(size)
        renderer = self._renderers[size]
        # The physics step leaves camera and light poses one step behind.
        mujoco.mj_camlight(self._model, data)
        renderer.update_scene(data, camera)
        return np.asarray(renderer.render())

    def _make(self, size: tuple[int, int]) -> Any:
        load_mujoco()  # without a screen MuJoCo's own choice of back end would end the process
        try:
            renderer = mujoco.Renderer(self._model, *size)
        except Exception as error:  # MuJoCo raises whatever its GL backend raises
            raise UserError(
                f"no picture can be rendered here ({error}); set MUJOCO_GL=egl and install libegl1 and libgl1-mesa-dri"
            ) from error
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = False
        return renderer

    def close(self) -> None:
        """Free all contexts; the next picture makes new ones."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
