"""`Simulation`: one compiled scene and its state. It knows no reference, reward or observation.

It poses arm, vessel and particles, advances one control period, and reads off how the vessel moves and where the
particles are.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array, make_pose
from .cameras import CameraPose
from .contacts import RobotContacts
from .holding import Grasp, Holding, still_arm
from .kernels import sort_particles, vessel_twist
from .liquid import Liquid, SpoutConduit, fill_positions, level_share
from .panda import ARM_JOINTS, FINGER_JOINTS
from .reference import Reference
from .scene import RECEPTACLE_BODY, VESSEL_BODY, Scene, build_scene, particle_obstacles

if TYPE_CHECKING:
    from .fast_liquid import FastLiquid
    from .fast_steps import Together

# The spout's conduit looks at the particles every so many physics steps.
CONDUIT_STRIDE = 2
SETTLE_AT_START_S = 1.5
_PHYSICS = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_MOVING = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_ENGINE = Rollout()  # has no threads of its own
ARM = 7


@dataclass(frozen=True)
class Motion:
    """A state apart from where in the world it is.

    robot_qpos, robot_qvel: of arm, fingers and a free vessel, in the engine's order. particles_m,
    particle_velocities_m_s: (N, 3). T_world_vessel, T_hand_object: (4, 4). where: (N,) the particles' places.
    """

    robot_qpos: Array
    robot_qvel: Array
    particles_m: Array
    particle_velocities_m_s: Array
    T_world_vessel: Array
    T_hand_object: Array
    where: NDArray[np.uint8]


class Simulation:
    """A reference's scene in motion.

    vessel_m (3,), vessel_R (3, 3), twist (6,) [m/s, rad/s, of the vessel's origin, world axes], particles_m (N, 3),
    where (N,) and share (3,) [held, poured, spilled; see `kernels.sort_particles`] tell the state after the last
    `refresh()`; the first two and the particles are views into the engine's memory. receptacle_m, receptacle_R: pose
    of the receptacle, which is still; at the origin without one. settled_m: (N, 3) where the particles rest in the
    vessel's frame; settled_held: how many of those places are in the vessel. holding: how the vessel is held, and how
    far it has slipped.
    """

    def __init__(
        self,
        reference: Reference,
        num_particles: int,
        liquid: Liquid,
        timestep_s: float,
        substeps: int,
        *,
        actuation: Literal["servo", "torque"] = "servo",
        grasp: Grasp = "weld",
        alike: Simulation | None = None,
        cameras: Sequence[CameraPose] = (),
    ) -> None:
        """alike: one with the same vessel, whose settled particles and closed hand are taken over."""
        self.scene: Scene = build_scene(
            reference, num_particles, liquid, timestep_s, actuation=actuation, grasp=grasp, cameras=cameras
        )
        self.model: mujoco.MjModel = self.scene.model
        self.data = mujoco.MjData(self.model)
        self.substeps, self._servo = substeps, actuation == "servo"
        self._bind(reference)
        if alike is not None:
            self.holding.take_over(alike.holding)
        self.settled_m: Array = self._settle(reference.q_start_rad) if alike is None else alike.settled_m
        self.settled_held = int(np.count_nonzero(self.scene.vessel_cavity.contains(self.settled_m)))

    def twin(self, reference: Reference) -> Simulation:
        """An equal simulation with a model and a state of its own; reference: what this one was made of."""
        made = copy.copy(self)
        made.model = copy.copy(self.model)
        made.scene, made.data = replace(self.scene, model=made.model), mujoco.MjData(made.model)
        made._bind(reference)
        made.holding.take_over(self.holding)
        return made

    # ------------------------------------------------------------------ motion

    def begin(self, q_rad: Array, receptacle_m: Array) -> None:
        """Rest in a posture (7,), the particles settled in the vessel, the receptacle at `receptacle_m` (3,)."""
        self.place_receptacle(receptacle_m)
        self._pose_arm(q_rad)
        self._place(self.settled_m @ self.vessel_R.T + self.vessel_m)
        self.refresh()

    def place_receptacle(self, position_m: Array) -> None:
        """Move the receptacle's origin to (3,)."""
        self.receptacle_m[:] = self.model.body_pos[self._receptacle_id] = position_m

    def advance(self, commands: Array) -> None:
        """One physics step for each of the commands (K, 7) to the arm."""
        conduit = self._conduit
        if conduit is None:
            self._step(commands)
            return
        for start in range(1 - CONDUIT_STRIDE, len(commands), CONDUIT_STRIDE):
            end = start + CONDUIT_STRIDE
            self._step(commands[max(start, 0) : end])
            if end <= len(commands) and conduit.may_flow(self.T_world_vessel, self.particles_m):
                self._read_twist()
                conduit.move(self.particles_m, self.particle_velocities_m_s, self.T_world_vessel, self.twist)

    def _step(self, commands: Array) -> None:
        """All steps in one call, during which other threads have Python for themselves."""
        if self._together is not None:
            self._together.advance(commands, self.T_world_receptacle)
            return
        data, start_s = self.data, self.data.time
        controls = np.empty((1, len(commands), self.model.nu))
        controls[0, :, :ARM], controls[0, :, ARM:] = commands, data.ctrl[ARM:]
        state = np.empty((1, mujoco.mj_stateSize(self.model, _MOVING)))
        mujoco.mj_getState(self.model, data, state[0], _MOVING)
        _ENGINE.rollout(
            [self.model],
            [data],
            state,
            controls,
            skip_checks=True,
            nstep=len(commands),
            initial_warmstart=data.qacc_warmstart[None],
            chunk_size=1,
        )
        # A rollout ends at a warning of the engine; single steps go on.
        for command in commands[round((data.time - start_s) / self.model.opt.timestep) :]:
            data.ctrl[:ARM] = command
            mujoco.mj_step(self.model, data)

    def refresh(self) -> None:
        """Bring all that is derived up to the state; after a restored state it is what it was before."""
        mujoco.mj_kinematics(self.model, self.data)
        self._read_twist()
        if self._receptacle_hollow is None:
            return
        sort_particles(
            self.particles_m,
            self._vessel_hollow,
            self.vessel_m,
            self.vessel_R,
            self._receptacle_hollow,
            self.receptacle_m,
            self.receptacle_R,
            self.where,
            self.share,
        )

    def contacts(self) -> tuple[int, int]:
        """Counts of contacts of the arm with itself, and of arm or held vessel with the table or the floor."""
        return self._robot_contacts.count(self.data)

    @property
    def T_world_vessel(self) -> Array:
        """(4, 4) pose of the held vessel."""
        return make_pose(self.vessel_R, self.vessel_m)

    @property
    def T_world_receptacle(self) -> Array:
        """(4, 4) pose of the receptacle."""
        return make_pose(self.receptacle_R, self.receptacle_m)

    @property
    def is_finite(self) -> bool:
        """Whether the physics still makes sense."""
        robot = np.isfinite(self.data.qpos).all() and np.isfinite(self.data.qvel).all()
        return bool(robot and (self._fast is None or np.isfinite(self.particles_m).all()))

    @property
    def unmodelled_particles(self) -> tuple[Array, float] | None:
        """Positions (N, 3) and radius in m of particles that the engine does not know, and so does not draw."""
        return None if self._fast is None else (self.particles_m, self.scene.radius_m)

    # ------------------------------------------------------------------ state

    def get_state(self) -> dict[str, Array]:
        """All that the motion depends on, as copies."""
        physics = np.empty(mujoco.mj_stateSize(self.model, _PHYSICS))
        mujoco.mj_getState(self.model, self.data, physics, _PHYSICS)
        liquid = {} if self._fast is None else {"liquid": self._fast.get_state()}
        return {"physics": physics, "receptacle_m": self.receptacle_m.copy(), **liquid}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `get_state()` of this or an equal simulation. Raises UserError for one of another kind."""
        physics, size = np.asarray(state["physics"], np.float64), mujoco.mj_stateSize(self.model, _PHYSICS)
        if physics.shape != (size,) or ("liquid" in state) != (self._fast is not None):
            raise UserError(
                f"the state holds {physics.size} physics values, this environment has {size}; "
                "it was taken with other arguments"
            )
        self.place_receptacle(np.asarray(state["receptacle_m"], np.float64))
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, _PHYSICS)
        if self._fast is not None:
            self._fast.set_state(np.asarray(state["liquid"], np.float64))
        self.refresh()

    def get_motion(self) -> Motion:
        """What there is, as copies, for `set_motion` to continue from elsewhere in the world."""
        return Motion(
            self.data.qpos[: self._first_particle].copy(),
            self.data.qvel[: self._first_velocity].copy(),
            self.particles_m.copy(),
            self.particle_velocities_m_s.copy(),
            self.T_world_vessel,
            self.holding.T_hand_object,
            self.where.copy(),
        )

    def set_motion(self, motion: Motion, q_rad: Array) -> None:
        """Take over a motion with the arm at `q_rad` (7,); the particles stay where they are in the world."""
        self._pose_arm(q_rad, motion.T_hand_object)
        self.data.qpos[ARM : ARM + 2] = motion.robot_qpos[ARM : ARM + 2]
        self.data.qvel[: self._first_velocity] = motion.robot_qvel
        self._place(motion.particles_m)
        self.particle_velocities_m_s[:] = motion.particle_velocities_m_s
        mujoco.mj_kinematics(self.model, self.data)

    # ------------------------------------------------------------------ inside

    def _bind(self, reference: Reference) -> None:
        model, data, scene = self.model, self.data, self.scene
        arm = [int(model.joint(name).qposadr[0]) for name in (*ARM_JOINTS, *FINGER_JOINTS)]
        self.holding = Holding(model, data, scene.vessel, reference.T_hand_object)
        self._first_particle, self._first_velocity = 9 + self.holding.positions, 9 + self.holding.velocities
        fast = scene.liquid.solver == "fast" and scene.num_particles > 0
        if arm != list(range(9)) or model.nq != self._first_particle + (0 if fast else 3 * scene.num_particles):
            raise RuntimeError("the scene's joints are not in the order arm, fingers, free vessel, particles")
        self._vessel_id, self._receptacle_id = int(model.body(VESSEL_BODY).id), int(model.body(RECEPTACLE_BODY).id)
        # Views into the engine's memory: always the pose of the last kinematics.
        self.vessel_m, self.vessel_R = data.xpos[self._vessel_id], data.xmat[self._vessel_id].reshape(3, 3)
        self._axes, self._anchors_m, self._rates = data.xaxis[:ARM], data.xanchor[:ARM], data.qvel[:ARM]
        self._fast = self._make_fast() if fast else None
        self._together = None if self._fast is None else self._put_together(self._fast)
        self.particles_m: Array = data.qpos[self._first_particle :].reshape(-1, 3)
        self.particle_velocities_m_s: Array = data.qvel[self._first_velocity :].reshape(-1, 3)
        if self._fast is not None:
            self.particles_m, self.particle_velocities_m_s = self._fast.positions_m, self._fast.velocities_m_s
        self.twist: Array = np.zeros(6)
        self._robot_contacts = RobotContacts(model)
        self.where: NDArray[np.uint8] = np.zeros(scene.num_particles, np.uint8)
        self.share: Array = np.zeros(3)
        self.receptacle_m: Array = scene.T_world_receptacle[:3, 3].copy()
        self.receptacle_R: Array = scene.T_world_receptacle[:3, :3].copy()
        self._vessel_hollow = scene.vessel_cavity.arrays
        receptacle = scene.receptacle_cavity if scene.num_particles else None
        self._receptacle_hollow = None if receptacle is None else receptacle.arrays
        self._conduit = self._make_conduit() if scene.vessel.outlet.kind == "spout" and scene.num_particles else None

    def _make_fast(self) -> FastLiquid:
        from .fast_liquid import FastLiquid

        scene = self.scene
        return FastLiquid(
            particle_obstacles(self.model, VESSEL_BODY),
            particle_obstacles(self.model, RECEPTACLE_BODY),
            particle_obstacles(self.model, "world"),
            scene.num_particles,
            scene.radius_m,
            scene.liquid,
            float(self.model.opt.timestep),
        )

    def _put_together(self, liquid: FastLiquid) -> Together:
        from .fast_steps import Together

        return Together(self.model, self.data, self._vessel_id, liquid)

    def _make_conduit(self) -> SpoutConduit:
        scene = self.scene
        share = level_share(scene.liquid, scene.vessel_cavity, scene.num_particles, scene.radius_m)
        return SpoutConduit(scene.vessel, scene.vessel_cavity, scene.vessel_boxes, scene.radius_m, share)

    def _settle(self, q_rad: Array) -> Array:
        """(N, 3) resting places of the particles in the vessel's frame; meanwhile the hand closes on a free vessel."""
        scene = self.scene
        lattice = fill_positions(
            scene.vessel_cavity, scene.vessel_boxes, scene.num_particles, scene.radius_m, scene.vessel.category
        )
        self._pose_arm(q_rad)
        self._place(lattice @ self.vessel_R.T + self.vessel_m)
        with still_arm(self.model):
            self.holding.close()
            if self._fast is not None:
                mujoco.mj_kinematics(self.model, self.data)
                self._place(lattice @ self.vessel_R.T + self.vessel_m)
                self._fast.settle(self.T_world_vessel, self.T_world_receptacle, SETTLE_AT_START_S)
            elif scene.num_particles:
                mujoco.mj_step(self.model, self.data, round(SETTLE_AT_START_S / self.model.opt.timestep))
        self.holding.keep()
        return np.asarray((self.particles_m - self.vessel_m) @ self.vessel_R)

    def _pose_arm(self, q_rad: Array, T_hand_object: Array | None = None) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:ARM] = q_rad
        if self._servo:
            self.data.ctrl[:ARM] = q_rad
        self.holding.pose(T_hand_object)

    def _place(self, positions_m: Array) -> None:
        """Put the particles at (N, 3), at rest."""
        if self._fast is not None:
            self._fast.place(positions_m)
        else:
            self.particles_m[:], self.particle_velocities_m_s[:] = positions_m, 0.0

    def _read_twist(self) -> None:
        if self.holding.free:
            self.holding.read_twist(self.twist)
            return
        # Seven joints move the vessel; the engine's own velocities would first go through every particle.
        vessel_twist(self._axes, self._anchors_m, self._rates, self.vessel_m, self.twist)
