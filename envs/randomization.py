"""What may differ from episode to episode, as ranges in a frozen dataclass, drawn from a passed generator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..extract.errors import UserError
from ..extract.geometry import Array


@dataclass(frozen=True)
class Randomization:
    """Half ranges of uniform draws along world x, y, z in m for the motion's start and for the receptacle."""

    start_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    receptacle_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("start_offset_m", "receptacle_offset_m"):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (3,) or not np.all(np.isfinite(value)) or np.any(value < 0) or np.any(value > 0.3):
                raise UserError(f"randomization {name} is {getattr(self, name)}; give three half ranges of 0 to 0.3 m")

    def draw(self, generator: np.random.Generator) -> tuple[Array, Array]:
        """Start and receptacle offsets (3,), (3,) in m. Always takes six numbers, so that seeds keep their meaning."""
        start, receptacle = generator.uniform(-1.0, 1.0, (2, 3))
        return start * np.asarray(self.start_offset_m), receptacle * np.asarray(self.receptacle_offset_m)


RANDOMIZATIONS = {
    "none": Randomization(),
    "low": Randomization(start_offset_m=(0.02, 0.02, 0.0), receptacle_offset_m=(0.03, 0.03, 0.0)),
}
