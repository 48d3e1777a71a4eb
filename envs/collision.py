"""Does the arm, with the vessel in its hand, touch itself, the table or the receptacle along a motion?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..extract.geometry import Array
from .kinematics import HAND_BODY
from .panda import FINGER_MAX_M, panda_spec
from .receptacle import mouth_radius_m, mouth_xy_m

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

TOLERANCE_M = 0.002
_HELD = "held_vessel"
_ROBOT, _HELD_BIT, _FIXED = 1, 2, 4
_WORDS = {"world": "table", _HELD: "vessel", "receptacle": "receptacle", "panda_hand": "hand"}


@dataclass(frozen=True)
class Collision:
    """first, second: names of the touching things; knot: index; depth_m: how deep they overlap."""

    first: str
    second: str
    knot: int
    depth_m: float


class CollisionChecker:
    """Collision model of the arm, the held vessel (convex hull), the table z = 0 and the receptacle (a cylinder).

    The vessel against the receptacle is left to `place_receptacle`, which knows the true shapes: hulls would fill the
    gap between a spout and its body.
    """

    def __init__(
        self,
        vessel: Vessel,
        T_hand_object: Array,
        width_m: float,
        receptacle: Vessel | None,
        T_receptacle: Array | None,
    ) -> None:
        spec = panda_spec(visuals=False)
        for body in spec.bodies:
            for geom in body.geoms:
                geom.contype, geom.conaffinity = _ROBOT, _ROBOT | _HELD_BIT | _FIXED
        hull = vessel.mesh.convex_hull
        spec.add_mesh(name=_HELD, uservert=np.asarray(hull.vertices).ravel(), userface=np.asarray(hull.faces).ravel())
        x, y, z, w = Rotation.from_matrix(T_hand_object[:3, :3]).as_quat()
        held = spec.body(HAND_BODY).add_body(name=_HELD, pos=T_hand_object[:3, 3], quat=[w, x, y, z])
        geom = held.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=_HELD, contype=_HELD_BIT, conaffinity=_FIXED)
        geom.mass = 0.0
        table = spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], contype=_FIXED, conaffinity=0
        )
        table.name = "table"
        if receptacle is not None and T_receptacle is not None:
            radius, height = float(receptacle.exterior.radius_m.max()), float(receptacle.extents_m[2])
            radius = max(radius, mouth_radius_m(receptacle))
            place_m = [*mouth_xy_m(receptacle, T_receptacle), T_receptacle[2, 3]]
            stand = spec.worldbody.add_body(name="receptacle", pos=place_m)
            stand.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[radius, height / 2, 0], contype=_FIXED, conaffinity=0
            )
            spec.add_exclude(bodyname1="receptacle", bodyname2=_HELD)
        spec.add_exclude(bodyname1="world", bodyname2="panda_link0")
        for part in ("panda_hand", "panda_leftfinger", "panda_rightfinger"):
            spec.add_exclude(bodyname1=_HELD, bodyname2=part)
        # Hulls of links that are nearly neighbours overlap in every configuration; that is no collision.
        for first, second in _NEIGHBOURS:
            spec.add_exclude(bodyname1=first, bodyname2=second)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._fingers_m = min(0.5 * width_m, FINGER_MAX_M)

    def check(self, q_rad: Array, every: int = 1) -> list[Collision]:
        """Collisions in configurations (N, 7), each pair at its deepest; every `every`-th knot is looked at."""
        deepest: dict[tuple[str, str], Collision] = {}
        model, data = self._model, self._data
        data.qpos[:] = 0.0
        data.qpos[7:9] = self._fingers_m
        for knot in [*range(0, len(q_rad), every), len(q_rad) - 1]:
            data.qpos[:7] = q_rad[knot]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            for contact in data.contact[: data.ncon]:
                depth = -float(contact.dist)
                if depth <= TOLERANCE_M:
                    continue
                names = sorted(model.body(int(model.geom_bodyid[g])).name for g in contact.geom)
                pair = (names[0], names[1])
                if pair not in deepest or deepest[pair].depth_m < depth:
                    deepest[pair] = Collision(_word(pair[0]), _word(pair[1]), knot, depth)
        return sorted(deepest.values(), key=lambda c: -c.depth_m)


_NEIGHBOURS = (
    ("panda_link5", "panda_link7"),
    ("panda_link5", "panda_hand"),
    ("panda_link6", "panda_hand"),
    ("panda_link7", "panda_hand"),
    ("panda_hand", "panda_leftfinger"),
    ("panda_hand", "panda_rightfinger"),
    ("panda_leftfinger", "panda_rightfinger"),
)


def _word(body: str) -> str:
    if body.endswith("finger"):
        return "finger"
    return _WORDS.get(body, body.removeprefix("panda_").replace("link", "arm link "))
