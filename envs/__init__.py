"""6D object trajectory to a Gymnasium environment with a reference-tracking reward.

The names below are loaded when they are first asked for, so that importing the package stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .cameras import CameraPose
    from .dm_adapter import as_dm_env
    from .liquid import Liquid
    from .options import Termination
    from .pouring import PandaPourEnv
    from .randomization import Randomization
    from .reference import Reference
    from .rewards import RewardConfig
    from .start import ReferenceStart
    from .tracking import PandaTrackEnv

_HOMES = {
    "CameraPose": "cameras",
    "Liquid": "liquid",
    "PandaPourEnv": "pouring",
    "PandaTrackEnv": "tracking",
    "Randomization": "randomization",
    "Reference": "reference",
    "ReferenceStart": "start",
    "RewardConfig": "rewards",
    "Termination": "options",
    "as_dm_env": "dm_adapter",
}
__all__ = [
    "CameraPose",
    "Liquid",
    "PandaPourEnv",
    "PandaTrackEnv",
    "Randomization",
    "Reference",
    "ReferenceStart",
    "RewardConfig",
    "Termination",
    "as_dm_env",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
