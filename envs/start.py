"""Where an episode begins: at the reference's beginning, or anywhere along it (reference-state initialisation).

Beginning in the middle lets a policy see the pour before it has learned to get there (Peng et al., DeepMimic, 2018).
The states along the way come from one rehearsal: the arm follows the reference open loop and every knot is kept, so
what was poured by then has been poured, and nothing is out of balance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..extract.errors import UserError
from ..extract.geometry import Array, invert_pose
from .kernels import POURED, SPILLED
from .reference import Reference
from .simulation import Simulation


@dataclass(frozen=True)
class ReferenceStart:
    """Begin at a random knot.

    failure_share: share of starts that are drawn by how often episodes begun or lost there failed; the rest is drawn
        evenly. last_phase: no episode begins after this share of the reference. bins: how finely failures are told
        apart along the reference. memory: weight of the past when a bin's failure rate is updated.
    """

    failure_share: float = 0.0
    last_phase: float = 0.9
    bins: int = 20
    memory: float = 0.9

    def __post_init__(self) -> None:
        for name, low, high in (("failure_share", 0, 1), ("last_phase", 0, 1), ("bins", 1, 1000), ("memory", 0, 1)):
            if not low <= getattr(self, name) <= high:
                raise UserError(f"start {name} is {getattr(self, name)}; give a number from {low} to {high}")


STARTS: dict[str, ReferenceStart | None] = {"beginning": None, "reference": ReferenceStart()}


class StartSampler:
    """Draws the knot at which an episode begins, and learns where episodes are lost."""

    def __init__(self, config: ReferenceStart, knots: int) -> None:
        self._config = config
        self._last = max(0, int(config.last_phase * (knots - 1)))
        self._edges = np.linspace(0, self._last + 1, min(config.bins, self._last + 1) + 1)
        self.failure_rate: Array = np.zeros(len(self._edges) - 1)

    def draw(self, generator: np.random.Generator) -> int:
        """A knot; always takes two numbers."""
        by_failure, where = generator.uniform(size=2)
        total = float(self.failure_rate.sum())
        if by_failure >= self._config.failure_share or total == 0.0:
            return min(int(where * (self._last + 1)), self._last)
        passed = np.concatenate([[0.0], np.cumsum(self.failure_rate)]) / total
        return min(int(np.interp(where, passed, self._edges)), self._last)

    def record(self, knot: int, failed: bool) -> None:
        """An episode ended at `knot`, lost or not."""
        at = int(np.clip(np.searchsorted(self._edges, knot, side="right") - 1, 0, len(self.failure_rate) - 1))
        keep = self._config.memory
        self.failure_rate[at] = keep * self.failure_rate[at] + (1.0 - keep) * float(failed)


class Rehearsal:
    """The states at the knots of a reference, as the arm goes through them open loop."""

    def __init__(self, reference: Reference, simulation: Simulation) -> None:
        """simulation: with servo motors, of the reference's own scene; it is left in another state."""
        from .builtin import arm_trajectory
        from .control import Control

        self._reference = reference
        self.q_rad = arm_trajectory(reference)
        control = Control("joint_position", reference.control_hz, simulation.substeps)
        control.reset(reference.q_start_rad, np.zeros(7))
        simulation.begin(reference.q_start_rad, reference.receptacle_m)
        self._motions = [simulation.get_motion()]
        for q_rad in self.q_rad[1:]:
            simulation.advance(control.advance(q_rad)[0])
            simulation.refresh()
            self._motions.append(simulation.get_motion())

    def begin(self, simulation: Simulation, moved: Reference, knot: int) -> Array:
        """Put a simulation into the state at a knot of `moved`, a warped copy of the reference; (7,) joint targets.

        Held and flying particles go with the vessel, the others with the receptacle.
        """
        from .kinematics import configuration_near

        motion, q_rad = self._motions[knot], self.q_rad[knot]
        q_moved = q_rad
        if np.any(moved.T_world_object[knot] != self._reference.T_world_object[knot]):
            q_moved = configuration_near(moved.T_world_object[knot], moved.T_hand_object, q_rad)
        shift_m = moved.receptacle_m - self._reference.receptacle_m
        simulation.place_receptacle(moved.receptacle_m)
        simulation.set_motion(motion, motion.robot_qpos[:7] + q_moved - q_rad)
        T = simulation.T_world_vessel @ invert_pose(motion.T_world_vessel)
        left = (motion.where == POURED) | (motion.where == SPILLED)
        particles_m = simulation.particles_m
        particles_m[:] = np.where(left[:, None], particles_m + shift_m, particles_m @ T[:3, :3].T + T[:3, 3])
        simulation.refresh()
        return np.asarray(q_moved)
