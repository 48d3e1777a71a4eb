"""What the arm carries, and the torques that a motion with it takes: the simulator's own arm, asked backwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..envs.grip import center_of_mass_m
from ..envs.jet import filling_kg, filling_m3, jet_of
from ..envs.kinematics import HAND_BODY
from ..envs.panda import panda_spec
from ..extract.geometry import Array

if TYPE_CHECKING:
    from ..envs.reference import Reference

HELD_BODY = "held_vessel"


@dataclass(frozen=True)
class Payload:
    """A body in the hand: mass, centre (3,) in the object's frame, principal moments (3,) along the object's axes."""

    mass_kg: float
    center_m: Array
    inertia_kg_m2: Array


def payload_of(reference: Reference, contents_kg: float = 0.0) -> Payload:
    """The reference's vessel with `contents_kg` at its origin.

    A box's inertia stands for the vessel's, a small part of the arm's.
    """
    vessel = reference.vessel() if reference.header.get("vessel") else None
    if vessel is None:
        return Payload(max(contents_kg, 1e-3), np.zeros(3), np.full(3, 1e-6))
    mass_kg = float(vessel.mass_kg) + contents_kg
    a, b, c = (float(e) for e in vessel.extents_m)
    center_m = center_of_mass_m(vessel, contents_kg)
    return Payload(mass_kg, center_m, mass_kg / 8.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b]))


def contents_of(reference: Reference) -> tuple[float, Array]:
    """Mass in kg of the water that the pour begins with, and the part (N,) of it that is still in the vessel.

    It is what the environments fill in by default; none where the reference names no vessel or no receptacle.
    """
    if not reference.header.get("vessel") or not reference.has_receptacle:
        return 0.0, np.zeros(len(reference))
    vessel, receptacle = reference.vessel(), reference.receptacle()
    jet = jet_of(reference.T_world_object, vessel, filling_m3(vessel, receptacle), reference.control_hz)
    return filling_kg(vessel, receptacle), 1.0 - min(jet.poured, 1.0) * np.cumsum(jet.share)


def arm_with(payload: Payload, T_hand_object: Array) -> Any:
    """The compiled arm with a payload in its hand; no contacts, no gravity compensation: torques are the motors'."""
    spec = panda_spec(visuals=False)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for body in spec.bodies:
        body.gravcomp = 0.0
    x, y, z, w = Rotation.from_matrix(T_hand_object[:3, :3]).as_quat()
    held = spec.body(HAND_BODY).add_body(name=HELD_BODY, pos=T_hand_object[:3, 3], quat=[w, x, y, z])
    held.explicitinertial = True
    held.mass, held.ipos, held.inertia = payload.mass_kg, payload.center_m, payload.inertia_kg_m2
    return spec.compile()


def inverse_dynamics(model: Any, q_rad: Array, dq_rad_s: Array, ddq_rad_s2: Array) -> Array:
    """(N, 7) joint torques in N m for a motion (N, 7) without contacts."""
    data = mujoco.MjData(model)
    tau_nm = np.empty_like(q_rad)
    for k in range(len(q_rad)):
        data.qpos[:7], data.qvel[:7], data.qacc[:7] = q_rad[k], dq_rad_s[k], ddq_rad_s2[k]
        mujoco.mj_inverse(model, data)
        tau_nm[k] = data.qfrc_inverse[:7]
    return tau_nm
