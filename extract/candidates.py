"""What to look for in a video: the mesh that a user gave, or every vessel of the library that a name may mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .geometry import Symmetry
from .meshes import load_mesh, mesh_sha256
from .region import TrackingMesh
from .segment import Box
from .shape_fit import tracking_mesh
from .symmetry import estimate_symmetry
from .vessels import Vessel, make_vessel, parameter_space, resolve_category

STATURE = 0.6  # of the way from a category's usual height to its least and its greatest
TRACKED_FACES = 4000  # of a user's mesh: silhouettes do not gain from more


@dataclass(frozen=True)
class ObjectRequest:
    """An object to follow.

    name: a category of the vessel library or a word for one ("kettle"), or any name when `mesh` is given.
    box_xywh_px: box in the start frame, in pixels of the video; found automatically when None.
    mesh: the object's own mesh file; mesh_unit: "m", "mm", "cm", "in" or "auto".
    mask: picture file of the object in the start frame, white on black, as large as the video.
    mesh_up: axis of the mesh file that points out of the opening ("+y"), or "auto"; mesh_open_top: take a closed mesh
        as a hollow open at its top. Tracking needs neither; who makes a vessel of the mesh finds both in the header.
    """

    name: str
    box_xywh_px: Box | None = None
    mesh: Path | None = None
    mesh_unit: str = "auto"
    mask: Path | None = None
    mesh_up: str = "auto"
    mesh_open_top: bool = False

    @property
    def pointed_at(self) -> bool:
        """Whether somebody said where the object is."""
        return self.box_xywh_px is not None or self.mask is not None


@dataclass(frozen=True)
class Model:
    """A mesh to look for, and what the track's header says of it."""

    mesh: TrackingMesh
    symmetry: Symmetry
    header: Mapping[str, Any] = field(default_factory=dict)
    vessel: Vessel | None = None


def candidate_models(request: ObjectRequest) -> list[Model]:
    """The user's mesh, or the nominal vessel of every category that the name may mean.

    Raises UserError for a bad mesh file or unit, and for a name that the library does not know.
    """
    if request.mesh is None:
        return [model for category in resolve_category(request.name) for model in _statures(category)]
    mesh = load_mesh(request.mesh, request.mesh_unit)
    light = mesh
    if len(mesh.faces) > TRACKED_FACES:
        # Large flat walls stay finer than asked: thinned out more forcefully they bulge.
        light = mesh.simplify_quadric_decimation(face_count=TRACKED_FACES, aggression=5)
    header: dict[str, Any] = {
        "name": request.mesh.name,
        "file": str(request.mesh),
        "unit": mesh.metadata["unit"],
        "up": request.mesh_up,
        "open_top": request.mesh_open_top,
        "unit_source": mesh.metadata["unit_source"],
        "sha256": mesh_sha256(mesh),
        "extents_m": [float(v) for v in mesh.extents],
        "faces": {"in_file": int(mesh.metadata["faces_in_file"]), "tracked": len(light.faces)},
        "symmetry_source": "estimated",
    }
    tracked = TrackingMesh.build(np.asarray(light.vertices, float), np.asarray(light.faces, np.int32))
    return [Model(tracked, estimate_symmetry(mesh), header)]


def with_stoutest(models: Sequence[Model]) -> list[Model]:
    """The same, and of bodies of revolution the stoutest: nothing but its proportions tells how far one leans."""
    round_ones = {m.vessel.category for m in models if m.vessel is not None and m.symmetry.order == 0}
    stoutest = []
    for category in sorted(round_ones):
        space = parameter_space(category)
        if "height_m" in space and "radius_m" in space:
            size = {"height_m": space["height_m"].low, "radius_m": space["radius_m"].high}
            stoutest.append(vessel_model(make_vessel(category, None, **{**make_vessel(category).params, **size})))
    return [*models, *stoutest]


def _statures(category: str) -> list[Model]:
    """The nominal vessel of a category, a low and a tall one: one that leans looks like another that does not."""
    nominal = make_vessel(category)
    height = parameter_space(category).get("height_m")
    if height is None:
        return [vessel_model(nominal)]
    usual = nominal.params["height_m"]
    heights = (usual, usual + STATURE * (height.low - usual), usual + STATURE * (height.high - usual))
    return [vessel_model(make_vessel(category, None, **{**nominal.params, "height_m": h})) for h in heights]


def vessel_model(vessel: Vessel) -> Model:
    """A vessel of the library as something to look for."""
    header = {
        "name": vessel.category,
        "sha256": mesh_sha256(vessel.mesh),
        "extents_m": [float(v) for v in vessel.mesh.extents],
        "library": {"category": vessel.category, "params": dict(vessel.params)},
        "symmetry_source": "library",
    }
    return Model(tracking_mesh(vessel), vessel.symmetry, header, vessel)
