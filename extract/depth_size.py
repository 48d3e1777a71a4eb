"""How large a vessel of the library is, read off depth pictures.

An outline leaves size and distance open: an object twice as large and twice as far away looks the same. Depth says how
far away its surface is, and so settles both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .candidates import vessel_model
from .depth_term import draw_surface, size_told
from .depth_video import DepthView
from .geometry import Array
from .region import TrackingMesh
from .shape_fit import FIXED
from .starting import Hypothesis, Start
from .vessels import Vessel, make_vessel, parameter_space

LEAST_CHANGE = 0.002  # of the size


def size_of_clip(mesh: TrackingMesh, seen: Sequence[tuple[Array, DepthView]]) -> float | None:
    """How many times larger, and farther away, the object is than a mesh at its poses in some depth pictures.

    None when the pictures do not tell, or say that it is right.
    """
    told = []
    for T, view in seen:
        surface = draw_surface(mesh, T, view.camera_matrix)
        ratio = None if surface is None else size_told(surface, T, view)
        if ratio is not None:
            told.append(ratio)
    ratio = float(np.median(told)) if told else 1.0
    return None if abs(ratio - 1) < LEAST_CHANGE else ratio


def scaled_vessel(vessel: Vessel, ratio: float) -> Vessel:
    """A vessel that many times as large, as far as its category goes; its wall stays as thick as it was."""
    space = parameter_space(vessel.category)
    scaled = {
        name: float(np.clip(vessel.params[name] * ratio, limits.low, limits.high))
        for name, limits in space.items()
        if limits.unit == "m" and name not in FIXED
    }
    return make_vessel(vessel.category, None, **{**vessel.params, **scaled})


def sized(start: Start, view: DepthView | None) -> Start:
    """The start with every vessel as large and as far away as a depth picture of the start frame says."""
    if view is None:
        return start
    return replace(start, hypotheses=tuple(_sized(hypothesis, view) for hypothesis in start.hypotheses))


def _sized(hypothesis: Hypothesis, view: DepthView) -> Hypothesis:
    model, T = hypothesis.model, hypothesis.pose.T_camera_object.copy()
    ratio = size_of_clip(model.mesh, [(T, view)]) if model.vessel is not None else None
    if ratio is None or model.vessel is None:
        return hypothesis
    T[:3, 3] *= ratio
    return replace(
        hypothesis,
        model=vessel_model(scaled_vessel(model.vessel, ratio)),
        pose=replace(hypothesis.pose, T_camera_object=T),
    )
