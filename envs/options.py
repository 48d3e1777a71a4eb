"""The environment's arguments: checked at construction, each with an error that names the mend."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ..extract.errors import UserError
from ..extract.geometry import Array
from .cameras import CAMERAS, CameraPose, chosen_cameras
from .observations import resampled
from .reference import Reference
from .scene import MAX_PICTURE_PX

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

MAX_PARTICLES = 500
# Longer steps let particles leak through walls.
MAX_TIMESTEP_S = 0.002


def one_of(name: str, value: object, valid: Sequence[str]) -> None:
    """Raise UserError unless the value is one of the valid names."""
    if value not in valid:
        raise UserError(f"{name} is {value!r}; choose {', '.join(valid)}")


def preset[T](name: str, value: object, presets: Mapping[str, T], kind: type[Any]) -> T:
    """A preset by its name, a value of the kind as it is, or one made from a dict of the dataclass's fields.

    Dicts are what an environment's spec can be written to JSON with.
    """
    if isinstance(value, kind):
        return cast(T, value)
    if isinstance(value, Mapping):
        known = [entry.name for entry in fields(kind)]
        if unknown := sorted(set(map(str, value)) - set(known)):
            raise UserError(f"{name} has no {', '.join(unknown)}; it has {', '.join(known)}")
        return cast(T, kind(**{key: tuple(v) if isinstance(v, list) else v for key, v in value.items()}))
    one_of(name, value, tuple(presets))
    return presets[str(value)]


@dataclass(frozen=True)
class Termination:
    """An episode is over when the object is farther than this from the reference, or so much is spilled; None: never.

    position_m and rotation_rad are multiplied by the environment's tolerance.
    """

    position_m: float | None = None
    rotation_rad: float | None = None
    spilled_fraction: float | None = None

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is not None and not value > 0.0:
                raise UserError(f"termination {entry.name} is {value}; give a positive number, or None for never")

    def ends(self, position_m: float, rotation_rad: float, spilled: float, tolerance: float) -> bool:
        """Whether an episode with these errors is over."""
        return (
            (self.position_m is not None and position_m > self.position_m * tolerance)
            or (self.rotation_rad is not None and rotation_rad > self.rotation_rad * tolerance)
            or (self.spilled_fraction is not None and spilled > self.spilled_fraction)
        )


TERMINATIONS = {"never": Termination(), "lost": Termination(position_m=0.25, rotation_rad=0.8)}


def offset(name: str, value: object) -> Array:
    """A reset option (3,) in m."""
    vector = np.asarray(value, np.float64)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise UserError(f"reset option {name} is {value!r}; give three numbers in m")
    return vector


def timing(control_hz: float, timestep_s: float | None) -> tuple[float, int]:
    """Physics step in s and how many make a control period."""
    if not 1.0 <= control_hz <= 500.0:
        raise UserError(f"control_hz is {control_hz}; choose 1 to 500")
    period_s = 1.0 / control_hz
    if timestep_s is None:
        steps = math.ceil(period_s / MAX_TIMESTEP_S - 1e-9)
        return period_s / steps, steps
    if not 1e-4 <= timestep_s <= MAX_TIMESTEP_S:
        raise UserError(
            f"timestep_s is {timestep_s}; choose 0.0001 to {MAX_TIMESTEP_S}: longer steps let particles leak"
        )
    steps = round(period_s / timestep_s)
    if abs(steps * timestep_s - period_s) > 1e-9:
        raise UserError(
            f"timestep_s {timestep_s} does not divide the control period of {period_s:.6g} s; "
            f"choose {period_s / math.ceil(period_s / timestep_s):.6g} or None"
        )
    return timestep_s, steps


def load_reference(
    reference: Reference | Path | str | None,
    control_hz: float,
    vessel: str | Path | Vessel | None = None,
    receptacle: str | Path | Vessel | None = None,
) -> Reference:
    """A reference from a file, as given, or the built-in one, at the control rate and with these vessels."""
    from ..extract.any_vessel import resolve_vessel
    from .builtin import builtin_reference
    from .substitution import with_receptacle, with_vessel

    held = None if vessel is None else resolve_vessel(vessel, "vessel")
    standing = None if receptacle is None else resolve_vessel(receptacle, "receptacle")
    if reference is None:
        return builtin_reference(control_hz, held, standing)
    if isinstance(reference, str | Path):
        reference = Reference.load(Path(reference))
    if not isinstance(reference, Reference):
        raise UserError(f"reference is a {type(reference).__name__}; give a Reference, a path or None")
    reference = resampled(reference, control_hz)
    if standing is not None:
        reference = with_receptacle(reference, standing)
    return reference if held is None else with_vessel(reference, held)


def check_number(name: str, value: float, low: float, high: float) -> None:
    """Raise UserError unless low <= value <= high."""
    if not low <= value <= high:
        raise UserError(f"{name} is {value}; give a number from {low:g} to {high:g}")


def particle_count(value: int) -> int:
    """A number of particles that the engine can bear."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value <= MAX_PARTICLES:
        raise UserError(f"num_particles is {value!r}; give a whole number from 0 to {MAX_PARTICLES}")
    return int(value)


def picture_size(name: str, size: Sequence[int]) -> tuple[int, int]:
    """(height, width) in px."""
    if len(size) != 2 or not all(16 <= int(side) <= MAX_PICTURE_PX for side in size):
        raise UserError(f"{name} is {size!r}; give (height, width) from 16 to {MAX_PICTURE_PX} px")
    return int(size[0]), int(size[1])


def check_cameras(
    cameras: Sequence[str | CameraPose | Mapping[str, Any]], render_camera: str
) -> tuple[tuple[str, ...], tuple[CameraPose, ...]]:
    """Names of the cameras, those among them that are one's own, and a camera to render with that is there."""
    names, own = chosen_cameras(cameras)
    one_of("render_camera", render_camera, tuple(dict.fromkeys((*CAMERAS, *names))))
    return names, own
