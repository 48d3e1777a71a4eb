"""`Stage`: one geometry ready to play on: a reference, its simulation, its cameras, and what an episode drew for it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from threading import RLock
from typing import Literal

import numpy as np

from ..extract.geometry import Array
from .cameras import CameraPose
from .holding import Grasp
from .liquid import Liquid
from .observations import Targets
from .randomization import Draw, ModelVariation
from .reference import Reference
from .rendering import Cameras
from .simulation import Simulation
from .start import Rehearsal
from .substitution import with_receptacle


class Stage:
    """reference: this episode's; base: as it was given; targets: the reference's, for comparison with the object."""

    def __init__(
        self,
        reference: Reference,
        num_particles: int,
        liquid: Liquid,
        timestep_s: float,
        substeps: int,
        actuation: Literal["servo", "torque"],
        grasp: Grasp,
        cameras: Sequence[CameraPose],
        alike: Stage | None = None,
    ) -> None:
        """alike: a stage with the same vessel, whose particles' size and resting places are taken over."""
        if alike is not None:
            liquid = replace(liquid, radius_m=alike.simulation.scene.radius_m)
        self.base = self.reference = reference
        self._arguments = (reference, num_particles, liquid, timestep_s, substeps)
        self._grasp = grasp
        self.simulation: Simulation = Simulation(
            *self._arguments,
            actuation=actuation,
            grasp=grasp,
            cameras=cameras,
            alike=None if alike is None else alike.simulation,
        )
        self._rehearsal = _Once(self._rehearse)
        self.pictures = Cameras(self.simulation.model)
        self._variation = ModelVariation(self.simulation.model)
        self.targets = self._base_targets = Targets.of(reference)

    def take(self, draw: Draw) -> None:
        """Make model and reference those of an episode; the simulation's state is left as it is."""
        self._variation.apply(draw)
        self.reference = self.base.warped(tuple(draw.start_offset_m), tuple(draw.receptacle_offset_m))
        moved = self.reference is not self.base
        self.targets = self._base_targets.shifted(self.reference) if moved else self._base_targets

    def begin(self, draw: Draw, index: int) -> tuple[Array, Array]:
        """Begin an episode at a knot of the reference; joint targets (7,) in rad and their velocity (7,) in rad/s."""
        self.take(draw)
        if index == 0:
            q_rad = self.reference.q_start_rad
            self.simulation.begin(q_rad, self.reference.receptacle_m)
            return q_rad, np.zeros(7)
        q_rad = self.rehearsal.begin(self.simulation, self.reference, index)
        return q_rad, (self.rehearsal.q_rad[index] - self.rehearsal.q_rad[index - 1]) * self.base.control_hz

    @property
    def rehearsal(self) -> Rehearsal:
        """The states along the reference; played through when first asked for."""
        return self._rehearsal.get()

    def _rehearse(self) -> Rehearsal:
        return Rehearsal(self.base, Simulation(*self._arguments, grasp=self._grasp, alike=self.simulation))

    def twin(self) -> Stage:
        """An equal stage with a simulation of its own. It may be made while an episode is played on this one."""
        made = copy.copy(self)
        made.simulation = self.simulation.twin(self.base)
        made.pictures = Cameras(made.simulation.model)
        made._variation = self._variation.of(made.simulation.model)
        return made


class Stages:
    """One stage for each shape of the receptacle, each made when first needed and kept.

    Those of a twin are built once for both.
    """

    def __init__(
        self,
        reference: Reference,
        num_particles: int,
        liquid: Liquid,
        timestep_s: float,
        substeps: int,
        actuation: Literal["servo", "torque"],
        grasp: Grasp,
        cameras: Sequence[CameraPose],
    ) -> None:
        def build(reference: Reference, alike: Stage | None = None) -> Stage:
            return Stage(reference, num_particles, liquid, timestep_s, substeps, actuation, grasp, cameras, alike)

        self._build = build
        self._stages = {-1: build(reference)}
        # What this one and its twins have built, whoever asked first; they may be used from several threads.
        self._built, self._lock = dict(self._stages), RLock()

    def get(self, shape: int) -> Stage:
        """The stage with the receptacle's seeded shape, or with its own for -1 or when there is none."""
        if not self._built[-1].base.has_receptacle:
            shape = -1
        if shape not in self._stages:
            self._stages[shape] = self._take(shape)
        return self._stages[shape]

    def twin(self) -> Stages:
        """Equal stages, to play on beside these."""
        made = copy.copy(self)
        made._stages = {}
        return made

    def _take(self, shape: int) -> Stage:
        with self._lock:
            if shape in self._built:
                return self._built[shape].twin()
            from ..extract.vessels import make_vessel

            own = self._built[-1]
            other = make_vessel(own.base.receptacle().category, shape)
            self._built[shape] = self._build(with_receptacle(own.base, other), own)
            return self._built[shape]

    def close(self) -> None:
        """Free the rendering contexts."""
        for stage in self._stages.values():
            stage.pictures.close()


class _Once[T]:
    """A value that is made when first asked for, by one of several threads."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make, self._lock = make, RLock()
        self._made: list[T] = []

    def get(self) -> T:
        with self._lock:
            if not self._made:
                self._made.append(self._make())
            return self._made[0]
