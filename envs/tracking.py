"""`PandaTrack-v0`: follow the reference, without liquid."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..extract.errors import UserError
from .options import Termination
from .pouring import PandaPourEnv
from .reference import Reference
from .rewards import RewardConfig


class PandaTrackEnv(PandaPourEnv):
    """The same without liquid: follow the reference, as fast as the arm alone can be simulated.

    Takes `PandaPourEnv`'s arguments but `num_particles` and `liquid`. The reward is for tracking alone, an episode
    that has lost the object ends, and success is to have stayed within 5 cm and 0.3 rad to the end.
    """

    def __init__(
        self,
        reference: Reference | Path | str | None = None,
        *,
        reward_mode: str | RewardConfig | Mapping[str, Any] = "tracking",
        termination: str | Termination | Mapping[str, Any] = "lost",
        **arguments: Any,
    ) -> None:
        if forbidden := sorted({"num_particles", "liquid"} & set(arguments)):
            raise UserError(f"PandaTrack-v0 has no liquid, so no {' and '.join(forbidden)}; make PandaPour-v0 for that")
        super().__init__(reference, 0, reward_mode=reward_mode, termination=termination, **arguments)
