"""Pictures of the scene, without a screen and fast enough for software rendering; and a window where there is one."""

from __future__ import annotations

import atexit
import math
import os
import platform
import threading
import time
import warnings
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from ..extract.offscreen import load_mujoco
from .overlays import Overlay, add_overlay, write_hud
from .scene import VESSEL_BODY, WATER_RGBA

# Room in a scene for what is drawn beside the model: particles of the fast solver, ghost and trail.
EXTRA_GEOMS = 1000
FONT_PERCENT = 150
# How long a closed window may take to go. New texts keep us until the window has drawn them, so they come seldom.
CLOSING_S, TEXT_PERIOD_S = 2.0, 0.2
Particles = tuple[Array, float]
"""Centres (N, 3) in the world and the radius, both in m, of particles that are not in the model."""


class Cameras:
    """The scene's cameras; a drawing surface per picture size is made when first needed.

    Belongs to the thread that takes the first picture.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._surfaces: dict[tuple[int, int], _Surface] = {}

    def picture(
        self,
        data: mujoco.MjData,
        camera: str,
        size: tuple[int, int],
        particles: Particles | None = None,
        overlay: Overlay | None = None,
    ) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 picture by a named camera; size is (height, width) in px.

        particles: drawn as the model's own would be. overlay: what is drawn on top of the scene; see `overlays`.
        """
        surface = self._surfaces.get(size)
        if surface is None:
            surface = self._surfaces[size] = _Surface(self.model, size)
        picture = surface.draw(data, self.model.camera(camera).id, particles, overlay)
        if overlay is not None and overlay.hud is not None:
            write_hud(picture, overlay.hud)
        return picture

    def close(self) -> None:
        """Free all surfaces; the next picture makes new ones."""
        for surface in self._surfaces.values():
            surface.free()
        self._surfaces.clear()


class _Surface:
    """What MuJoCo draws on: buffers of one size, and the scene's meshes and textures in the graphics memory."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int]) -> None:
        height, width = size
        self._model = model
        self._gl = _gl_context()
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, FONT_PERCENT)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        # Clearing a buffer of the largest size that the model allows takes longer than drawing a small picture.
        mujoco.mjr_resizeOffscreen(width, height, self._context)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._upside_down = np.empty((height, width, 3), np.uint8)
        self._scene = mujoco.MjvScene(model, model.ngeom + EXTRA_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._option, self._view = mujoco.MjvOption(), mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._spheres = _Spheres()

    def draw(
        self, data: mujoco.MjData, camera: int, particles: Particles | None, overlay: Overlay | None
    ) -> NDArray[np.uint8]:
        model, scene = self._model, self._scene
        # The physics step leaves camera and light poses one step behind.
        mujoco.mj_camlight(model, data)
        self._view.fixedcamid = camera
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(model, data, self._option, None, self._view, everything, scene)
        if particles is not None:
            self._spheres.add_to(scene, *particles)
        if overlay is not None:
            add_overlay(scene, model, overlay)
        self._gl.make_current()
        # Another surface of this context may have drawn last.
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjr_render(self._rect, scene, self._context)
        mujoco.mjr_readPixels(self._upside_down, None, self._rect, self._context)
        return np.array(self._upside_down[::-1])

    def free(self) -> None:
        self._gl.make_current()
        self._context.free()


_of_thread = threading.local()


def _gl_context() -> Any:
    """This thread's graphics context, shared by all surfaces: only the first one costs a fifth of a second."""
    # A child process must not draw with its parent's.
    if getattr(_of_thread, "process", None) != os.getpid():
        # Mesa's rasterizer draws in threads of its own: a forked process lacks them and waits for them for ever, and
        # many environments at once crowd each other out.
        os.environ.setdefault("LP_NUM_THREADS", "0")
        load_mujoco()  # without a screen MuJoCo's own choice of back end would end the process
        try:
            from mujoco.rendering.classic import gl_context

            context = gl_context.GLContext(64, 64)
        except Exception as error:  # MuJoCo raises whatever its GL backend raises
            raise UserError(
                f"no picture can be rendered here ({error}); set MUJOCO_GL=egl and install libegl1 and libgl1-mesa-dri"
            ) from error
        _of_thread.context, _of_thread.process = context, os.getpid()
        # Later than the back end registers its own end, and so called before it.
        atexit.register(_end, context, os.getpid())
    return _of_thread.context


def _end(context: Any, process: int) -> None:
    if os.getpid() == process:
        context.free()


class _Spheres:
    """Particles that are not in the model, drawn as if they were."""

    def __init__(self) -> None:
        self._drawn: tuple[int, int, float] | None = None
        self._places: list[NDArray[np.float32]] = []

    def add_to(self, scene: mujoco.MjvScene, positions_m: Array, radius_m: float) -> None:
        first, count = scene.ngeom, len(positions_m)
        if first + count > scene.maxgeom:
            raise ValueError(f"{count} particles are more than the {scene.maxgeom - first} that can be drawn")
        # What was put behind the model's geoms stays there, so from the second picture on only the places change.
        if self._drawn != (first, count, radius_m):
            size, upright, rgba = np.full(3, radius_m), np.eye(3).ravel(), np.array(WATER_RGBA, np.float32)
            geoms = scene.geoms[first : first + count]
            for geom in geoms:
                mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, np.zeros(3), upright, rgba)
            self._drawn, self._places = (first, count, radius_m), [geom.pos for geom in geoms]
        for place, position in zip(self._places, positions_m, strict=True):
            place[:] = position
        scene.ngeom = first + count


class Viewer:
    """MuJoCo's window on a running simulation; it shows the state of each call of `show`, in real time."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, fps: float) -> None:
        """camera: from where the window looks at first. Raises UserError when there is no screen to open it on."""
        require_screen()
        import mujoco.viewer

        try:
            self._window: Any = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except RuntimeError as error:  # on a Mac the window must own the main thread
            raise UserError(
                f"MuJoCo's viewer cannot be opened ({error}); start Python as `mjpython`, or use "
                "render_mode='rgb_array'"
            ) from error
        self._model, self.data, self._period_s, self._due_s = model, data, 1.0 / fps, time.monotonic()
        self._spheres, self._told_s = _Spheres(), -math.inf
        with self._window.lock():
            _look_from(self._window.cam, model, data, camera)

    @property
    def is_open(self) -> bool:
        """Whether the person has not closed the window."""
        return bool(self._window.is_running())

    def show(self, particles: Particles | None = None, overlay: Overlay | None = None) -> None:
        """Bring the window up to the simulation's state, then wait for the next picture's turn.

        Does nothing when the window has been closed.
        """
        if not self.is_open:
            return
        with self._window.lock():
            scene = self._window.user_scn
            scene.ngeom = 0
            if particles is not None:
                self._spheres.add_to(scene, *particles)
            if overlay is not None:
                add_overlay(scene, self._model, overlay)
        self._window.sync()
        if overlay is not None and overlay.hud is not None and time.monotonic() > self._told_s + TEXT_PERIOD_S:
            self._told_s = time.monotonic()
            names, values = zip(*overlay.hud.lines(), strict=True)
            self._window.set_texts((None, None, "\n".join(names), "\n".join(values)))
        self._due_s = max(self._due_s + self._period_s, time.monotonic())
        time.sleep(max(0.0, self._due_s - time.monotonic()))

    def close(self) -> None:
        """Close the window and wait until it is gone: what it still draws must not outlive the screen."""
        self._window.close()
        until_s = time.monotonic() + CLOSING_S
        while self._window.d is not None and time.monotonic() < until_s:
            time.sleep(0.01)


def _look_from(view: mujoco.MjvCamera, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> None:
    """Put a camera that a person can move to where a camera of the model is now, turning about what it looks at."""
    mujoco.mj_camlight(model, data)
    number = model.camera(camera).id
    eye, forward = data.cam_xpos[number], -data.cam_xmat[number].reshape(3, 3)[:, 2]
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.distance = float(np.linalg.norm(data.body(VESSEL_BODY).xpos - eye))
    view.lookat[:] = eye + view.distance * forward
    view.azimuth = math.degrees(math.atan2(forward[1], forward[0]))
    view.elevation = math.degrees(math.asin(float(np.clip(forward[2], -1.0, 1.0))))


def has_screen() -> bool:
    """Whether a window can be hoped for: a Mac or Windows, or a display server that the environment names."""
    return platform.system() != "Linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def require_screen() -> None:
    """Raise UserError unless a window can be opened."""
    mend = "set DISPLAY, or take pictures: render_mode='rgb_array', or `vid2demo play --out FILE.mp4`"
    if not has_screen():
        raise UserError(f"MuJoCo's viewer needs a screen and there is none here; {mend}")
    import glfw

    # MuJoCo asks this in a thread of its own, and waits for ever when the answer is no.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opened = glfw.init()
    if not opened:
        raise UserError(f"the screen {os.environ.get('DISPLAY', '')!r} cannot be opened for MuJoCo's viewer; {mend}")
