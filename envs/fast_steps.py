"""The engine and the fast liquid in turn: many steps in one compiled call, during which other threads have Python.

Compiled code calls the engine's C functions itself; through Python every step would take an eighth longer,
and the threads of a vector environment would spend their time waiting for each other. An error of the engine would
end the process here; a scene that has been compiled, and where only the arm touches anything, gives no cause for one.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
from numba import njit, types

from ..extract.geometry import Array
from . import fast_liquid_kernels as kernels

if TYPE_CHECKING:
    from .fast_liquid import FastLiquid

_LIBRARIES = ("libmujoco.so.*", "libmujoco.*dylib", "mujoco.dll")


class Together:
    """A scene's engine and its liquid, each of which moves the held vessel or is moved by it."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, vessel_id: int, liquid: FastLiquid) -> None:
        self._liquid = liquid
        # Views into the engine's memory, which lasts as long as they do.
        self._pose = data.xpos[vessel_id], data.xmat[vessel_id].reshape(3, 3)
        self._push = data.xfrc_applied[vessel_id], data.xipos[vessel_id]
        self._control = data.ctrl
        self._engine = model._address, data._address
        self._kept = model, data

    def advance(self, commands: Array, T_world_receptacle: Array) -> None:
        """One step of both for each of the commands (K, 7) to the arm."""
        liquid = self._liquid
        liquid.poses[1] = T_world_receptacle
        given = (*self._engine, commands, self._control, self._push, self._pose)
        _steps(*given, liquid.poses, liquid.wrench, liquid.arguments)


def _engine_function(name: str) -> Any:
    """A C function of the engine that takes the addresses of a model and a data, for compiled code to call."""
    return types.ExternalFunction(name, types.void(types.intp, types.intp))


# Where the linker finds the engine's functions by their names, which is how cached code knows them.
_path = next(path for pattern in _LIBRARIES for path in Path(mujoco.__file__).parent.glob(pattern))
_library = ctypes.CDLL(str(_path), ctypes.RTLD_GLOBAL)
_step, _kinematics = _engine_function("mj_step"), _engine_function("mj_kinematics")


def _compiled(kernels_changed_ns: int) -> Any:
    """The steps, compiled anew when the kernels have changed: they become a part of it, which the cache cannot know."""

    @njit(cache=True, nogil=True, error_model="numpy")
    def steps(
        model: int,
        data: int,
        commands: Array,
        control: Array,
        push: tuple[Array, Array],
        pose: tuple[Array, Array],
        poses: Array,
        wrench: Array,
        liquid: tuple[Any, ...],
    ) -> int:
        wrench_world, center_m = push
        position_m, R = pose
        poses[0, 1, :3, :3], poses[0, 1, :3, 3] = R, position_m
        for k in range(len(commands)):
            for j in range(commands.shape[1]):
                control[j] = commands[k, j]
            _step(model, data)
            _kinematics(model, data)
            poses[0, 0] = poses[0, 1]
            poses[0, 1, :3, :3], poses[0, 1, :3, 3] = R, position_m
            kernels.advance(*liquid)
            # The engine takes forces at the centre of mass.
            x, y, z = position_m[0] - center_m[0], position_m[1] - center_m[1], position_m[2] - center_m[2]
            wrench_world[:3] = wrench[:3]
            wrench_world[3] = wrench[3] + y * wrench[2] - z * wrench[1]
            wrench_world[4] = wrench[4] + z * wrench[0] - x * wrench[2]
            wrench_world[5] = wrench[5] + x * wrench[1] - y * wrench[0]
        return kernels_changed_ns

    return steps


_steps = _compiled(Path(kernels.__file__).stat().st_mtime_ns)
