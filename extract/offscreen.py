"""MuJoCo ready to draw pictures where there is no screen, whoever imported it first and however."""

from __future__ import annotations

import importlib
import os
import platform
from typing import Any


def load_mujoco() -> Any:
    """Import MuJoCo with a back end that can render here; a choice made by MUJOCO_GL is left alone.

    MuJoCo chooses its back end when it is first imported, takes GLFW by default, and ends the whole process when GLFW
    finds no screen. So on Linux without a screen EGL is chosen, and chosen again if MuJoCo was imported before.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if platform.system() == "Linux" and not screen:
        os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco
    from mujoco.rendering.classic import gl_context

    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    context = getattr(gl_context, "GLContext", None)
    if chosen == "egl" and getattr(context, "__module__", "") != "mujoco.egl":
        importlib.reload(gl_context)
    return mujoco
