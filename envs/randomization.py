"""What may differ from episode to episode, as ranges in a frozen dataclass, drawn from a passed generator."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import mujoco
import numpy as np

from ..extract.errors import UserError
from ..extract.geometry import Array

_MOST = {
    "start_offset_m": 0.3,
    "receptacle_offset_m": 0.3,
    "vessel_mass": 0.9,
    "stiffness": 0.5,
    "joint_noise_rad": 0.1,
    "object_noise_m": 0.1,
    "camera_offset_m": 0.2,
    "light": 0.9,
    "color": 0.9,
    "receptacle_shapes": 64,
}


@dataclass(frozen=True)
class Randomization:
    """Half ranges of uniform draws, one draw an episode; nothing differs by default.

    start_offset_m, receptacle_offset_m: (3,) of the motion's start and the receptacle, along world x, y, z.
    vessel_mass, stiffness, light, color: of factors around 1 on the vessel's mass (the robot goes on compensating the
        nominal one), on the arm's servos, on the lights, and on both vessels' colour channels.
    joint_noise_rad, object_noise_m: standard deviation of noise at every step on the observed joint positions, and on
        the observed positions of object and receptacle and all offsets from them.
    camera_offset_m: of the cameras that stand in the world.
    receptacle_shapes: so many seeded shapes of the receptacle's category, each as likely; 0 keeps its own. The motion
        is raised by as much as a shape's rim is higher.
    """

    start_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    receptacle_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    vessel_mass: float = 0.0
    stiffness: float = 0.0
    joint_noise_rad: float = 0.0
    object_noise_m: float = 0.0
    camera_offset_m: float = 0.0
    light: float = 0.0
    color: float = 0.0
    receptacle_shapes: int = 0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, most = getattr(self, entry.name), _MOST[entry.name]
            vector = entry.name.endswith("_offset_m") and entry.name != "camera_offset_m"
            try:
                numbers = np.asarray(value, float)
            except (TypeError, ValueError):
                numbers = np.full(1, np.nan)
            if numbers.shape != ((3,) if vector else ()) or not np.all((numbers >= 0) & (numbers <= most)):
                what = f"three half ranges of 0 to {most} m" if vector else f"0 to {most}"
                raise UserError(f"randomization {entry.name} is {value}; give {what}")
        if self.receptacle_shapes != int(self.receptacle_shapes):
            raise UserError(f"randomization receptacle_shapes is {self.receptacle_shapes}; give a whole number")

    @property
    def noisy(self) -> bool:
        """Whether observations carry noise."""
        return self.joint_noise_rad > 0.0 or self.object_noise_m > 0.0

    def draw(self, generator: np.random.Generator) -> Draw:
        """One episode's draw. Always takes equally many numbers, so that seeds keep their meaning."""
        start, receptacle, camera, vessel_color, receptacle_color = generator.uniform(-1.0, 1.0, (5, 3))
        mass, stiffness, light, shape = generator.uniform(-1.0, 1.0, 4)
        shapes = int(self.receptacle_shapes)
        return Draw(
            start * np.asarray(self.start_offset_m),
            receptacle * np.asarray(self.receptacle_offset_m),
            float(1.0 + mass * self.vessel_mass),
            float(1.0 + stiffness * self.stiffness),
            camera * self.camera_offset_m,
            float(1.0 + light * self.light),
            1.0 + vessel_color * self.color,
            1.0 + receptacle_color * self.color,
            min(int((shape + 1.0) / 2.0 * shapes), shapes - 1) if shapes else -1,
        )


@dataclass(frozen=True)
class Draw:
    """What one episode drew: offsets in m (3,), factors (1 or (3,) a colour), and the receptacle's shape or -1."""

    start_offset_m: Array
    receptacle_offset_m: Array
    vessel_mass: float
    stiffness: float
    camera_offset_m: Array
    light: float
    vessel_color: Array
    receptacle_color: Array
    receptacle_shape: int

    def to_state(self) -> dict[str, Any]:
        """Arrays and plain numbers by name."""
        return asdict(self)

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> Draw:
        """The draw that `to_state` wrote."""
        values: dict[str, Any] = {}
        for entry in fields(Draw):
            value = np.array(state[entry.name])
            values[entry.name] = value.astype(np.float64) if value.ndim else value.item()
        return Draw(**values)


class ModelVariation:
    """Applies draws to a compiled model, each to its nominal values."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._vessel = int(model.body("vessel").id)
        self._mass = float(model.body_mass[self._vessel])
        self._inertia = model.body_inertia[self._vessel].copy()
        self._compensation = float(model.body_gravcomp[self._vessel])
        self._gain, self._bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
        self._servo = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
        self._servo[7:] = False
        self._cameras = np.flatnonzero(model.cam_bodyid == 0)
        self._camera_pos = model.cam_pos.copy()
        self._light = model.light_diffuse.copy()
        self._rgba = model.mat_rgba.copy()
        self._materials = {
            body: np.array([i for i in range(model.nmat) if model.mat(i).name.startswith(f"{body}_")], int)
            for body in ("vessel", "receptacle")
        }

    def of(self, model: mujoco.MjModel) -> ModelVariation:
        """The same for a copy of the model, whichever draw it was copied with."""
        made = copy.copy(self)
        made._model = model
        return made

    def apply(self, draw: Draw) -> None:
        """Make the model the one of an episode."""
        model, vessel = self._model, self._vessel
        model.body_mass[vessel] = self._mass * draw.vessel_mass
        model.body_inertia[vessel] = self._inertia * draw.vessel_mass
        model.body_gravcomp[vessel] = self._compensation / draw.vessel_mass
        model.actuator_gainprm[self._servo] = self._gain[self._servo] * draw.stiffness
        model.actuator_biasprm[self._servo] = self._bias[self._servo] * draw.stiffness
        model.cam_pos[self._cameras] = self._camera_pos[self._cameras] + draw.camera_offset_m
        model.light_diffuse[:] = np.minimum(self._light * draw.light, 1.0)
        for body, color in (("vessel", draw.vessel_color), ("receptacle", draw.receptacle_color)):
            rows = self._materials[body]
            model.mat_rgba[rows, :3] = np.clip(self._rgba[rows, :3] * color, 0.0, 1.0)


RANDOMIZATIONS = {
    "none": Randomization(),
    "low": Randomization(start_offset_m=(0.02, 0.02, 0.0), receptacle_offset_m=(0.03, 0.03, 0.0)),
    "high": Randomization(
        start_offset_m=(0.04, 0.04, 0.02),
        receptacle_offset_m=(0.05, 0.05, 0.0),
        vessel_mass=0.3,
        stiffness=0.1,
        joint_noise_rad=0.002,
        object_noise_m=0.003,
        camera_offset_m=0.03,
        light=0.3,
        color=0.3,
        receptacle_shapes=8,
    ),
}
