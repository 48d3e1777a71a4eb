"""Does the arm touch itself, does arm or vessel touch the furniture? Cheap enough to be asked at every step."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from .kernels import count_pairs
from .panda import CONTACT_HELD, CONTACT_ROBOT

# Sums of two kinds tell which pair it is.
_ROBOT, _HELD, _FURNITURE = 1, 3, 9


class RobotContacts:
    """Counts of the contacts that a robot should avoid, in a scene of `build_scene`.

    Furniture is the table and the floor; a vessel between the fingers is not a part of the robot.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        kinds = np.zeros(model.ngeom, np.int64)
        kinds[(model.geom_contype & CONTACT_ROBOT) != 0] = _ROBOT
        kinds[(model.geom_contype & CONTACT_HELD) != 0] = _HELD
        world = model.geom_bodyid == 0
        kinds[world & ((model.geom_conaffinity & CONTACT_ROBOT) != 0)] = _FURNITURE
        self._kinds: NDArray[np.int64] = kinds

    def count(self, data: mujoco.MjData) -> tuple[int, int]:
        """Contacts of the arm with itself, and of arm or held vessel with the furniture, as of the last step."""
        if data.ncon == 0:
            return 0, 0
        itself, furniture = count_pairs(
            data.contact.geom, self._kinds, 2 * _ROBOT, _FURNITURE + _ROBOT, _FURNITURE + _HELD
        )
        return itself, furniture
