"""`PandaPour-v0`: a Panda holds a vessel full of particles and must pour as the reference does.

The world frame is the robot's base, z up, table top at z = 0. A step lasts one control period; the action given at step
k is reached at its end, when the object should be at knot k + 1 of the reference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array, make_pose
from . import observations
from .liquid import Count, Liquid, SpoutConduit, count_particles, fill_positions, level_share
from .options import (
    check_cameras,
    check_number,
    limit,
    load_reference,
    offset,
    one_of,
    particle_count,
    picture_size,
    preset,
    timing,
)
from .panda import ARM_JOINTS, DQ_MAX_RAD_S, FINGER_JOINTS, Q_MAX_RAD, Q_MIN_RAD, SERVO_LEAD_S
from .randomization import RANDOMIZATIONS, Randomization
from .reference import Reference
from .rendering import Cameras
from .rewards import REWARD_MODES, TERMS, RewardConfig, StepErrors, term_table, weighted_terms
from .scene import RECEPTACLE_BODY, VESSEL_BODY, Scene, build_scene
from .vessel_geometry import gripper_half_width_m

# The spout's conduit looks at the particles every so many physics steps.
CONDUIT_STRIDE = 2
SETTLE_AT_START_S = 1.5
_PHYSICS = int(mujoco.mjtState.mjSTATE_INTEGRATION)

Observation = dict[str, Any]
Info = dict[str, Any]


class PhysicsError(RuntimeError):
    """The simulation has produced values that are not finite; the message names seed, step and the mend."""


class PandaPourEnv(gym.Env[Observation, NDArray[np.float32]]):
    """Reproduce a recorded pour with a Franka Panda.

    reference: path of a `*.reference.npz`, a `Reference`, or None for a built-in pour of a mug into a bowl.
    num_particles: 0 to 500. liquid: what the particles are like.
    control_hz: actions per second; a reference at another rate is resampled.
    timestep_s: physics step; must divide the control period; None takes the longest one up to 2 ms that does.
    obs_mode: "state" (agent_pos, environment_state), "pixels" (agent_pos, pixels) or "both".
    cameras: any of front, wrist, side; image_size: (height, width) in px.
    control_mode: "joint_position": joint targets in rad; "joint_delta": their change in rad. Targets are kept inside
        the joint limits and move no faster than the joints' speed limits.
    reward_mode: dense, tracking, pour or sparse, or a `RewardConfig`.
    randomization: none, low, or a `Randomization`.
    settle_s: time after the reference's end in which the last reference pose is held.
    success_poured_fraction, success_spilled_fraction: success means at least and at most so much.
    max_position_error_m, max_rotation_error_rad: beyond these the episode is terminated; None never does.
    render_mode: None or "rgb_array"; render_size: (height, width) in px; render_camera: one of the cameras.

    `reset(options=...)` takes `start_offset_m` and `receptacle_offset_m` (3,) in place of the random draw, or `state`
    from `get_state()`. Raises UserError for every argument that makes no sense.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self,
        reference: Reference | Path | str | None = None,
        num_particles: int = 100,
        control_hz: float = 25.0,
        obs_mode: str = "state",
        cameras: Sequence[str] = ("front", "wrist"),
        image_size: tuple[int, int] = (224, 224),
        control_mode: str = "joint_position",
        randomization: str | Randomization = "none",
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 640),
        render_camera: str = "front",
        reward_mode: str | RewardConfig = "dense",
        liquid: Liquid | None = None,
        timestep_s: float | None = None,
        settle_s: float = 1.0,
        success_poured_fraction: float = 0.7,
        success_spilled_fraction: float = 0.1,
        max_position_error_m: float | None = None,
        max_rotation_error_rad: float | None = None,
    ) -> None:
        one_of("obs_mode", obs_mode, ("state", "pixels", "both"))
        one_of("control_mode", control_mode, ("joint_position", "joint_delta"))
        check_cameras(cameras, render_camera, render_mode)
        check_number("settle_s", settle_s, 0.0, 60.0)
        check_number("success_poured_fraction", success_poured_fraction, 0.0, 1.0)
        check_number("success_spilled_fraction", success_spilled_fraction, 0.0, 1.0)
        self.max_position_error_m = limit("max_position_error_m", max_position_error_m)
        self.max_rotation_error_rad = limit("max_rotation_error_rad", max_rotation_error_rad)
        self.control_hz = float(control_hz)
        self.timestep_s, self._substeps = timing(self.control_hz, timestep_s)
        self.randomization = preset("randomization", randomization, RANDOMIZATIONS, Randomization)
        self.reward_config = preset("reward_mode", reward_mode, REWARD_MODES, RewardConfig)
        self.obs_mode, self.control_mode, self.cameras = obs_mode, control_mode, tuple(cameras)
        self.image_size = picture_size("image_size", image_size)
        self.render_size = picture_size("render_size", render_size)
        self.render_mode, self.render_camera = render_mode, render_camera
        self.success_poured_fraction, self.success_spilled_fraction = success_poured_fraction, success_spilled_fraction
        self.metadata = {**type(self).metadata, "render_fps": int(control_hz) if control_hz % 1 == 0 else control_hz}

        self._base = load_reference(reference, self.control_hz)
        self.reference = self._base
        self._scene = build_scene(self._base, particle_count(num_particles), liquid or Liquid(), self.timestep_s)
        self.model: mujoco.MjModel = self._scene.model
        self.data = mujoco.MjData(self.model)
        self._bind(self._scene)
        self._seed: int | None = None
        self._settled_m, self._settled_held = self._settle()
        self._settle_steps = round(settle_s * self.control_hz)
        self._max_episode_steps = len(self._base) - 1 + self._settle_steps
        self.task = f"pour from the {self._scene.vessel.category} into the {self._scene.receptacle.category}".replace(
            "_", " "
        )
        self.task_description = self.task

        self._delta_rad = DQ_MAX_RAD_S / self.control_hz
        if control_mode == "joint_position":
            self.action_space = spaces.Box(Q_MIN_RAD.astype(np.float32), Q_MAX_RAD.astype(np.float32))
        else:
            self.action_space = spaces.Box((-self._delta_rad).astype(np.float32), self._delta_rad.astype(np.float32))
        self.observation_space, self.observation_names = observations.space(obs_mode, self.cameras, self.image_size)
        self._renderer = Cameras(self.model)
        self._step_index = 0
        self._target: Array = self._base.q_start_rad
        self._target_speed: Array = np.zeros(7)
        self._count: Count
        self._begin(np.zeros(3), np.zeros(3))

    # ------------------------------------------------------------------ Gymnasium

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observation, Info]:
        """Begin an episode; see the class for `options`."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed = seed
        options = dict(options or {})
        if unknown := set(options) - {"state", "start_offset_m", "receptacle_offset_m"}:
            raise UserError(
                f"reset has no option {', '.join(sorted(unknown))}; it knows state, start_offset_m, receptacle_offset_m"
            )
        if "state" in options:
            self.set_state(options["state"])
        else:
            # Drawn even when overridden, so that an option does not shift the draws of later episodes.
            start_m, receptacle_m = self.randomization.draw(self.np_random)
            start_m = offset("start_offset_m", options.get("start_offset_m", start_m))
            receptacle_m = offset("receptacle_offset_m", options.get("receptacle_offset_m", receptacle_m))
            self._begin(start_m, receptacle_m)
        return self._observation(), self._info(dict.fromkeys(TERMS, 0.0))

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Advance one control period."""
        target = self._target_from(np.asarray(action, np.float64))
        speed = (target - self._target) * self.control_hz
        ramp = self._commands(target)
        data, model, control, step = self.data, self.model, self.data.ctrl, mujoco.mj_step
        for i in range(self._substeps):
            control[:7] = ramp[i]
            step(model, data)
            if self._conduit is not None and i % CONDUIT_STRIDE == 0:
                self._pour_through_spout(self._conduit)
        self._target, last_speed, self._target_speed = target, self._target_speed, speed
        self._step_index += 1
        before = self._count
        self._refresh()
        if not np.all(np.isfinite(data.qpos)):
            raise PhysicsError(
                f"the simulation diverged at step {self._step_index} of the episode with seed {self._seed}; "
                "reset the environment, and use a smaller timestep_s or fewer particles if it happens again"
            )
        errors = self._errors(before, float(np.mean(((speed - last_speed) / (2 * DQ_MAX_RAD_S)) ** 2)))
        terms = weighted_terms(errors, self.reward_config)
        lost = (self.max_position_error_m is not None and errors.position_error_m > self.max_position_error_m) or (
            self.max_rotation_error_rad is not None and errors.rotation_error_rad > self.max_rotation_error_rad
        )
        truncated = self._step_index >= self._max_episode_steps
        return self._observation(), float(sum(terms.values())), bool(lost), truncated, self._info(terms)

    def render(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) uint8 picture of `render_camera`, or None without a render mode."""
        if self.render_mode is None:
            return None
        return self._renderer.picture(self.data, self.render_camera, self.render_size)

    def close(self) -> None:
        """Free the rendering contexts."""
        if hasattr(self, "_renderer"):
            self._renderer.close()

    # ------------------------------------------------------------------ state

    def get_state(self) -> dict[str, Any]:
        """Everything that the rest of the episode depends on; arrays are copies, the generator's state is JSON-like."""
        physics = np.empty(mujoco.mj_stateSize(self.model, _PHYSICS))
        mujoco.mj_getState(self.model, self.data, physics, _PHYSICS)
        return {
            "physics": physics,
            "start_offset_m": self._start_offset_m.copy(),
            "receptacle_offset_m": self._receptacle_offset_m.copy(),
            "target_rad": self._target.copy(),
            "target_speed_rad_s": self._target_speed.copy(),
            "step": self._step_index,
            "generator": self.np_random.bit_generator.state,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where `get_state()` was called, in this or an equal environment."""
        names = ("physics", "start_offset_m", "receptacle_offset_m", "target_rad", "target_speed_rad_s", "step")
        if missing := [name for name in (*names, "generator") if name not in state]:
            raise UserError(f"the state lacks {', '.join(missing)}; take it from get_state()")
        physics = np.asarray(state["physics"], np.float64)
        if physics.shape != (mujoco.mj_stateSize(self.model, _PHYSICS),):
            raise UserError(
                f"the state holds {physics.size} physics values, this environment has "
                f"{mujoco.mj_stateSize(self.model, _PHYSICS)}; it was taken with other arguments"
            )
        self._place(np.asarray(state["start_offset_m"], float), np.asarray(state["receptacle_offset_m"], float))
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, _PHYSICS)
        self._target = np.array(state["target_rad"], np.float64)
        self._target_speed = np.array(state["target_speed_rad_s"], np.float64)
        self._step_index = int(state["step"])
        self.np_random.bit_generator.state = state["generator"]
        self._refresh()

    def reward_table(self) -> str:
        """The reward's terms, weights and scales in plain text."""
        return term_table(self.reward_config)

    @property
    def T_world_object(self) -> Array:
        """(4, 4) pose of the held object now."""
        return make_pose(self._vessel_R, self._vessel_xpos)

    @property
    def T_world_receptacle(self) -> Array:
        """(4, 4) pose of the receptacle in this episode."""
        return self._T_world_receptacle.copy()

    @property
    def particle_positions_m(self) -> Array:
        """(N, 3) centres of the particles in the world."""
        return np.array(self._particle_qpos)

    # ------------------------------------------------------------------ inside

    def _bind(self, scene: Scene) -> None:
        model, data = self.model, self.data
        arm = [int(model.joint(name).qposadr[0]) for name in (*ARM_JOINTS, *FINGER_JOINTS)]
        if arm != list(range(9)) or model.nq != 9 + 3 * scene.num_particles:
            raise RuntimeError("the scene's joints are not in the order arm, fingers, particles")
        self._vessel_id = int(model.body(VESSEL_BODY).id)
        self._receptacle_id = int(model.body(RECEPTACLE_BODY).id)
        # Views into the simulator's memory: always the pose of the last kinematics.
        self._vessel_xpos, self._vessel_R = data.xpos[self._vessel_id], data.xmat[self._vessel_id].reshape(3, 3)
        self._arm_axes, self._arm_anchors = data.xaxis[:7], data.xanchor[:7]
        self._particle_qpos = data.qpos[9:].reshape(-1, 3)
        self._particle_qvel = data.qvel[9:].reshape(-1, 3)
        self._twist: Array = np.zeros(6)
        self._fractions = (np.arange(1, self._substeps + 1) / self._substeps)[:, None]
        self._gripper_m = gripper_half_width_m(scene.vessel, self._base.T_hand_object)
        self._conduit = self._make_conduit(scene) if scene.vessel.outlet.kind == "spout" else None

    def _make_conduit(self, scene: Scene) -> SpoutConduit | None:
        if scene.num_particles == 0:
            return None
        share = level_share(scene.liquid, scene.vessel_cavity, scene.num_particles, scene.radius_m)
        return SpoutConduit(scene.vessel, scene.vessel_cavity, scene.vessel_boxes, scene.radius_m, share)

    def _settle(self) -> tuple[Array, int]:
        """(N, 3) resting places of the particles in the vessel's frame, and how many stay inside it."""
        scene, data = self._scene, self.data
        lattice = fill_positions(
            scene.vessel_cavity, scene.vessel_boxes, scene.num_particles, scene.radius_m, scene.vessel.category
        )
        self._pose_arm(self._base.q_start_rad)
        T = self.T_world_object
        self._particle_qpos[:] = lattice @ T[:3, :3].T + T[:3, 3]
        if scene.num_particles:
            mujoco.mj_step(self.model, data, round(SETTLE_AT_START_S / self.timestep_s))
            mujoco.mj_kinematics(self.model, data)
            T = self.T_world_object
        local = (self._particle_qpos - T[:3, 3]) @ T[:3, :3]
        return local, int(np.count_nonzero(scene.vessel_cavity.contains(local)))

    def _pose_arm(self, q_rad: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = self.data.ctrl[:7] = q_rad
        self.data.qpos[7:9] = self.data.ctrl[7:9] = self._gripper_m
        mujoco.mj_kinematics(self.model, self.data)

    def _place(self, start_m: Array, receptacle_m: Array) -> None:
        self._start_offset_m, self._receptacle_offset_m = start_m, receptacle_m
        self.reference = self._base.warped(tuple(start_m), tuple(receptacle_m))
        self._targets = observations.Targets(self.reference)
        self._T_world_receptacle = self._scene.T_world_receptacle.copy()
        self._T_world_receptacle[:3, 3] += receptacle_m
        self.model.body_pos[self._receptacle_id] = self._T_world_receptacle[:3, 3]

    def _begin(self, start_m: Array, receptacle_m: Array) -> None:
        self._place(start_m, receptacle_m)
        q_rad = self.reference.q_start_rad
        self._pose_arm(q_rad)
        T = self.T_world_object
        self._particle_qpos[:] = self._settled_m @ T[:3, :3].T + T[:3, 3]
        self._target, self._target_speed = q_rad.copy(), np.zeros(7)
        self._step_index = 0
        self._refresh()

    def _refresh(self) -> None:
        """Bring all that is derived up to the state; after a restored state it must be what it was before."""
        mujoco.mj_kinematics(self.model, self.data)
        self._read_twist()
        self._count = self._counted()
        self._tracking_errors = self._targets.errors(
            self._reference_index, self._vessel_xpos, self._vessel_R, self._twist
        )

    def _read_twist(self) -> None:
        # Seven joints move the vessel; the engine's own velocities would first go through every particle.
        rates = self._arm_axes * self.data.qvel[:7, None]
        arms = self._vessel_xpos - self._arm_anchors
        self._twist[3:] = rates.sum(axis=0)
        self._twist[0] = rates[:, 1] @ arms[:, 2] - rates[:, 2] @ arms[:, 1]
        self._twist[1] = rates[:, 2] @ arms[:, 0] - rates[:, 0] @ arms[:, 2]
        self._twist[2] = rates[:, 0] @ arms[:, 1] - rates[:, 1] @ arms[:, 0]

    def _pour_through_spout(self, conduit: SpoutConduit) -> None:
        T = self.T_world_object
        if conduit.may_flow(T, self._particle_qpos):
            self._read_twist()
            conduit.move(self._particle_qpos, self._particle_qvel, T, self._twist)

    def _target_from(self, action: Array) -> Array:
        if action.shape != (7,) or not np.all(np.isfinite(action)):
            raise UserError(f"the action must be 7 finite joint values in rad, got {action!r}")
        wanted = action if self.control_mode == "joint_position" else self._target + action
        step = np.clip(wanted - self._target, -self._delta_rad, self._delta_rad)
        return np.clip(self._target + step, Q_MIN_RAD, Q_MAX_RAD)

    def _commands(self, target: Array) -> Array:
        """(substeps, 7) servo commands of one control period: straight to the target, leading by the servos' lag."""
        way = target - self._target
        return self._target + self._fractions * way + (SERVO_LEAD_S * self.control_hz) * way

    def _counted(self) -> Count:
        scene = self._scene
        return count_particles(
            self._particle_qpos,
            scene.vessel_cavity,
            self.T_world_object,
            scene.receptacle_cavity,
            self._T_world_receptacle,
        )

    @property
    def _reference_index(self) -> int:
        return min(self._step_index, len(self.reference) - 1)

    def _is_success(self) -> bool:
        return (
            self._count.poured_fraction >= self.success_poured_fraction
            and self._count.spilled_fraction <= self.success_spilled_fraction
        )

    def _errors(self, before: Count, action_rate: float) -> StepErrors:
        now = self._count
        return StepErrors(
            *self._tracking_errors,
            now.poured_fraction - before.poured_fraction,
            now.spilled_fraction - before.spilled_fraction,
            action_rate,
            float(self._is_success()),
        )

    def _observation(self) -> Observation:
        data = self.data
        observation: Observation = {"agent_pos": np.concatenate([data.qpos[:7], data.qvel[:7]]).astype(np.float32)}
        if self.obs_mode != "pixels":
            observation["environment_state"] = self._targets.environment_state(
                self._reference_index,
                self._vessel_xpos,
                self._vessel_R,
                self._twist,
                self._T_world_receptacle[:3, 3],
                (self._count.held_fraction, self._count.poured_fraction, self._count.spilled_fraction),
            )
        if self.obs_mode != "state":
            observation["pixels"] = {
                camera: self._renderer.picture(data, camera, self.image_size) for camera in self.cameras
            }
        return observation

    def _info(self, terms: dict[str, float]) -> Info:
        position_m, rotation_rad, _, _ = self._tracking_errors
        info: Info = {
            "reward_terms": terms,
            "poured_fraction": self._count.poured_fraction,
            "spilled_fraction": self._count.spilled_fraction,
            "held_fraction": self._count.held_fraction,
            "position_error_m": position_m,
            "rotation_error_rad": rotation_rad,
            "reference_index": self._reference_index,
            "is_success": self._is_success(),
            "outlet": "spout_conduit" if self._scene.vessel.outlet.kind == "spout" else "lip",
        }
        if self._settled_held < self._scene.num_particles:
            lost = self._scene.num_particles - self._settled_held
            info["start_warning"] = f"{lost} particles run out in the start pose: the vessel is tilted or too full"
        return info
