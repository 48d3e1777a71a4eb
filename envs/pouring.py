"""`PandaPour-v0`: a Panda holds a vessel full of particles and must pour as the reference does.

The world frame is the robot's base, z up, table top at z = 0. A step lasts one control period; the action given at step
k is reached at its end, when the object should be at knot k + 1 of the reference.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from . import observations
from .cameras import CameraPose
from .control import CONTROL_MODES, Control, ControlState
from .display import Display, render_modes
from .diverged import PhysicsError, diverged_message
from .holding import Grasp
from .kernels import HELD, POURED, SPILLED
from .liquid import Liquid
from .options import (
    TERMINATIONS,
    Termination,
    check_cameras,
    check_number,
    load_reference,
    offset,
    one_of,
    particle_count,
    picture_size,
    preset,
    timing,
)
from .overlays import Hud
from .panda import Q_MAX_RAD, Q_MIN_RAD
from .randomization import RANDOMIZATIONS, Draw, Randomization
from .reference import Reference
from .rewards import (
    REWARD_MODES,
    TERMS,
    RewardConfig,
    StepErrors,
    limit_share,
    term_table,
    weighted_terms,
    with_tolerance,
)
from .simulation import Simulation
from .stage import Stages
from .start import STARTS, ReferenceStart, StartSampler

if TYPE_CHECKING:
    from ..extract.vessels import Vessel

# Following the reference means to stay this near to it to the end.
_Q_MIN_RAD, _Q_MAX_RAD = Q_MIN_RAD.tolist(), Q_MAX_RAD.tolist()
TRACKED_M, TRACKED_RAD = 0.05, 0.3
_OPTIONS = ("state", "start_offset_m", "receptacle_offset_m", "start_index")

Observation = dict[str, Any]
Info = dict[str, Any]


class PandaPourEnv(gym.Env[Observation, NDArray[np.float32]]):
    """Reproduce a recorded pour with a Franka Panda.

    reference: path of a `*.reference.npz`, a `Reference`, or None for a built-in pour of `vessel` into `receptacle`.
    vessel, receptacle: what takes the place of the reference's own (a mug and a bowl for a built-in pour): a library
        category ("mug"), a seeded variant ("mug:3"), a mesh file, or a `Vessel`.
    num_particles: 0 to 500. liquid: what the particles are like, a `Liquid` or a dict of its fields.
    control_hz: actions per second; a reference at another rate is resampled.
    timestep_s: physics step; must divide the control period; None takes the longest one up to 2 ms that does.
    obs_mode: "state" (agent_pos, environment_state), "pixels" (agent_pos, pixels) or "both".
    cameras: any of front, wrist, side, and `CameraPose`s of one's own; image_size: (height, width) in px.
    control_mode: joint_position, joint_delta, ee_delta or torque; see `control.action_entries`. Targets are kept
        inside the joint limits and move no faster than the joints' speed limits.
    reward_mode: dense, tracking, pour or sparse, or a `RewardConfig`; tolerance: factor on the width of its tracking
        kernels and on the termination thresholds, to be narrowed as a policy learns (`env.unwrapped.tolerance = ...`).
    randomization: none, low, high, or a `Randomization`.
    start: "beginning", "reference" (anywhere along it), or a `ReferenceStart`.
    termination: "never", "lost" (0.25 m or 0.8 rad from the reference), or a `Termination`.
    grasp: "weld" makes the vessel a part of the hand; with "friction" the fingers hold it by contact alone, at about
        three times the cost, and `info` tells how far it has slipped.
    settle_s: time after the reference's end in which the last reference pose is held.
    success_poured_fraction, success_spilled_fraction: success means at least and at most so much; without particles,
        to have stayed within 5 cm and 0.3 rad of the reference to its end.
    render_mode: None, "rgb_array" or "human" (MuJoCo's window); render_size: (height, width) in px; render_camera: one
        of the cameras. overlays: any of ghost (the reference), trail (of the lip) and hud, in what is rendered.

    `reset(options=...)` takes `start_offset_m` and `receptacle_offset_m` (3,) and `start_index` in place of the random
    draw, or `state` from `get_state()`. Raises UserError for every argument that makes no sense.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 25}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self,
        reference: Reference | Path | str | None = None,
        num_particles: int = 100,
        control_hz: float = 25.0,
        obs_mode: str = "state",
        cameras: Sequence[str | CameraPose | Mapping[str, Any]] = ("front", "wrist"),
        image_size: tuple[int, int] = (224, 224),
        control_mode: str = "joint_position",
        randomization: str | Randomization | Mapping[str, Any] = "none",
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 640),
        render_camera: str = "front",
        reward_mode: str | RewardConfig | Mapping[str, Any] = "dense",
        liquid: Liquid | Mapping[str, Any] | None = None,
        timestep_s: float | None = None,
        settle_s: float = 1.0,
        success_poured_fraction: float = 0.7,
        success_spilled_fraction: float = 0.1,
        vessel: str | Path | Vessel | None = None,
        receptacle: str | Path | Vessel | None = None,
        start: str | ReferenceStart | Mapping[str, Any] = "beginning",
        termination: str | Termination | Mapping[str, Any] = "never",
        tolerance: float = 1.0,
        grasp: Grasp = "weld",
        overlays: Sequence[str] = (),
    ) -> None:
        one_of("obs_mode", obs_mode, ("state", "pixels", "both"))
        one_of("grasp", grasp, ("weld", "friction"))
        one_of("control_mode", control_mode, CONTROL_MODES)
        check_number("settle_s", settle_s, 0.0, 60.0)
        check_number("success_poured_fraction", success_poured_fraction, 0.0, 1.0)
        check_number("success_spilled_fraction", success_spilled_fraction, 0.0, 1.0)
        check_number("tolerance", tolerance, 1e-3, 1e3)
        self.cameras, own_cameras = check_cameras(cameras, render_camera)
        self.control_hz = float(control_hz)
        self.timestep_s, self._substeps = timing(self.control_hz, timestep_s)
        self.randomization = preset("randomization", randomization, RANDOMIZATIONS, Randomization)
        self._reward_at_one = preset("reward_mode", reward_mode, REWARD_MODES, RewardConfig)
        self.tolerance = tolerance
        self.termination = preset("termination", termination, TERMINATIONS, Termination)
        self._start = preset("start", start, STARTS, ReferenceStart)
        self.obs_mode, self.control_mode, self.render_mode = obs_mode, control_mode, render_mode
        self.grasp: Grasp = grasp
        self.image_size, size = picture_size("image_size", image_size), picture_size("render_size", render_size)
        self._display = Display(render_mode, render_camera, size, overlays, self.control_hz)
        self.success_poured_fraction, self.success_spilled_fraction = success_poured_fraction, success_spilled_fraction
        fps = int(control_hz) if control_hz % 1 == 0 else control_hz
        self.metadata = {"render_modes": render_modes(), "render_fps": fps}

        self._num_particles = particle_count(num_particles)
        self._liquid: Liquid = preset("liquid", {} if liquid is None else liquid, {}, Liquid)
        self._base = load_reference(reference, self.control_hz, vessel, receptacle)
        self._control = Control(control_mode, self.control_hz, self._substeps)
        actuation, step_s = self._control.actuation, self.timestep_s
        self._stages = Stages(
            self._base, self._num_particles, self._liquid, step_s, self._substeps, actuation, self.grasp, own_cameras
        )
        scene = self._stages.get(-1).simulation.scene
        self._max_episode_steps = len(self._base) - 1 + round(settle_s * self.control_hz)
        into = f"pour from the {{}} into the {scene.receptacle.category}" if scene.receptacle else "move the {}"
        self.task = self.task_description = into.format(scene.vessel.category).replace("_", " ")
        self.action_space = self._control.space
        self.action_names = tuple(entry.name for entry in self._control.entries)
        self.observation_space, self.observation_names = observations.space(obs_mode, self.cameras, self.image_size)
        self._starts = StartSampler(self._start or ReferenceStart(), len(self._base))
        self._worst_m = self._worst_rad = 0.0
        self._begin(Randomization().draw(np.random.default_rng(0)), 0)

    # ------------------------------------------------------------------ Gymnasium

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observation, Info]:
        """Begin an episode; see the class for `options`."""
        super().reset(seed=seed)
        options = dict(options or {})
        if unknown := sorted(set(options) - set(_OPTIONS)):
            raise UserError(f"reset has no option {', '.join(unknown)}; it knows {', '.join(_OPTIONS)}")
        if "state" in options:
            self.set_state(options["state"])
            return self._first()
        # All is drawn even when overridden, so that an option does not shift the draws of later episodes.
        draw = self.randomization.draw(self.np_random)
        index = self._starts.draw(self.np_random) if self._start is not None else 0
        changes = {name: offset(name, options[name]) for name in _OPTIONS[1:3] if name in options}
        if "start_index" in options:
            index = int(options["start_index"])
            check_number("reset option start_index", index, 0, len(self._base) - 1)
        self._begin(Draw(**{**vars(draw), **changes}), index)
        return self._first()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Advance one control period."""
        commands, jerk = self.before_step(action)
        self.simulation.advance(commands)
        return self.after_step(jerk)

    def before_step(self, action: NDArray[np.float32]) -> tuple[Array, float]:
        """The arm's commands (substeps, 7) of a step and the action's jerkiness; `after_step` ends what this begins."""
        self._before = (self.simulation.get_state(), self._control.state, action)
        return self._control.advance(action)

    def after_step(self, jerk: float) -> tuple[Observation, float, bool, bool, Info]:
        """What `step` returns, once the physics has been advanced."""
        simulation = self.simulation
        self._step_index += 1
        if not simulation.is_finite:
            physics, control, action = self._before
            state = {**self.get_state(), "simulation": physics, "target": control.target, "rate": control.rate}
            state["step"] = self._step_index - 1
            raise PhysicsError(diverged_message(state, action, self._np_random_seed, self._step_index))
        _, poured, spilled = self._share
        simulation.refresh()
        self._look()
        self._worst_m = max(self._worst_m, self._tracking_errors[0])
        self._worst_rad = max(self._worst_rad, self._tracking_errors[1])
        self_contact, table_contact = simulation.contacts()
        errors = StepErrors(
            *self._tracking_errors,
            self._share[1] - poured,
            self._share[2] - spilled,
            jerk,
            limit_share(simulation.data.qpos[:7].tolist(), _Q_MIN_RAD, _Q_MAX_RAD),
            float(self_contact > 0),
            float(table_contact > 0),
            float(self.is_success),
        )
        terms = weighted_terms(errors, self.reward_config)
        lost = self.termination.ends(*self._tracking_errors[:2], self._share[2], self._tolerance)
        truncated = self._step_index >= self._max_episode_steps
        if self._start is not None and (lost or truncated):
            self._starts.record(self._step_index, lost)
        if self._display.is_window:
            self.render()
        return self._observation(), sum(terms.values()), lost, truncated, self._info(terms)

    def render(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) uint8 picture of `render_camera`; None without a render mode, or when it went to the window."""
        hud = Hud(self._step_index / self.control_hz, *self._share[1:], *self._tracking_errors[:2])
        T_world_reference = self.reference.T_world_object[self._reference_index]
        unmodelled = self.simulation.unmodelled_particles
        return self._display.show(self._stage.pictures, self.data, T_world_reference, hud, unmodelled)

    def close(self) -> None:
        """Free the rendering contexts and close the window."""
        if hasattr(self, "_display"):
            self._display.close()
        if hasattr(self, "_stages"):
            self._stages.close()

    def twin(self) -> Self:
        """An equal environment that awaits its first reset; what never changes is shared, so it is made at once."""
        made = copy.copy(self)
        made._np_random, made._np_random_seed = None, None
        made._stages, made._display = self._stages.twin(), self._display.twin()
        made._control = Control(self.control_mode, self.control_hz, self._substeps)
        made._starts = StartSampler(self._start or ReferenceStart(), len(self._base))
        made.action_space, made.observation_space = made._control.space, copy.deepcopy(self.observation_space)
        made._begin(Randomization().draw(np.random.default_rng(0)), 0)
        return made

    # ------------------------------------------------------------------ state

    def get_state(self) -> dict[str, Any]:
        """Everything that the rest of the episode depends on; arrays are copies, the generator's state is JSON-like."""
        return {
            "simulation": self.simulation.get_state(),
            "target": self._control.state.target.copy(),
            "rate": self._control.state.rate.copy(),
            "step": self._step_index,
            "worst_m": self._worst_m,
            "worst_rad": self._worst_rad,
            "tolerance": self._tolerance,
            "draw": self._draw.to_state(),
            "failure_rate": self._starts.failure_rate.copy(),
            "generator": self.np_random.bit_generator.state,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where `get_state()` was called, in this or an equal environment."""
        if missing := [name for name in self.get_state() if name not in state]:
            raise UserError(f"the state lacks {', '.join(missing)}; take it from get_state()")
        self._draw = Draw.from_state(state["draw"])
        self._stage = self._stages.get(self._draw.receptacle_shape)
        self._stage.take(self._draw)
        self.simulation.set_state(state["simulation"])
        self._control.state = ControlState(np.array(state["target"], float), np.array(state["rate"], float))
        self._step_index = int(state["step"])
        self._worst_m, self._worst_rad = float(state["worst_m"]), float(state["worst_rad"])
        self.tolerance = float(state["tolerance"])
        self._starts.failure_rate = np.array(state["failure_rate"], float)
        self.np_random.bit_generator.state = state["generator"]
        self._display.restart()
        self._look()

    # ------------------------------------------------------------------ what one may look at

    @property
    def simulation(self) -> Simulation:
        """The scene in motion."""
        return self._stage.simulation

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled scene of this episode."""
        return self.simulation.model

    @property
    def data(self) -> mujoco.MjData:
        """Its state."""
        return self.simulation.data

    @property
    def reference(self) -> Reference:
        """This episode's reference: the environment's own, moved by what was drawn."""
        return self._stage.reference

    @property
    def tolerance(self) -> float:
        """Factor on the width of the tracking kernels and on the termination thresholds."""
        return self._tolerance

    @tolerance.setter
    def tolerance(self, value: float) -> None:
        check_number("tolerance", value, 1e-3, 1e3)
        self._tolerance = float(value)
        self.reward_config = with_tolerance(self._reward_at_one, self._tolerance)

    @property
    def is_watched(self) -> bool:
        """Whether there is a window that nobody has closed."""
        return self._display.is_window and self._display.is_open

    def reward_table(self) -> str:
        """The reward's terms, weights and scales in plain text."""
        return term_table(self.reward_config)

    @property
    def T_world_object(self) -> Array:
        """(4, 4) pose of the held object now."""
        return self.simulation.T_world_vessel

    @property
    def T_world_receptacle(self) -> Array:
        """(4, 4) pose of the receptacle in this episode."""
        return self.simulation.T_world_receptacle

    @property
    def particle_positions_m(self) -> Array:
        """(N, 3) centres of the particles in the world."""
        return np.array(self.simulation.particles_m)

    @property
    def particle_places(self) -> dict[str, NDArray[np.bool_]]:
        """Masks (N,) of the particles that are held, poured and spilled; the others are in flight."""
        where = self.simulation.where
        return {"held": where == HELD, "poured": where == POURED, "spilled": where == SPILLED}

    @property
    def has_tracked(self) -> bool:
        """Whether the object has stayed within 5 cm and 0.3 rad of the reference to its end."""
        arrived = self._step_index >= len(self._base) - 1
        return arrived and self._worst_m <= TRACKED_M and self._worst_rad <= TRACKED_RAD

    @property
    def is_success(self) -> bool:
        """Whether the episode counts as a success so far; see `success_poured_fraction`."""
        if self._num_particles == 0:
            return self.has_tracked
        _, poured, spilled = self._share
        return bool(poured >= self.success_poured_fraction and spilled <= self.success_spilled_fraction)

    # ------------------------------------------------------------------ inside

    def _begin(self, draw: Draw, index: int) -> None:
        self._draw, self._step_index = draw, index
        self._stage = self._stages.get(draw.receptacle_shape)
        target, rate = self._stage.begin(draw, index)
        self._control.reset(target, rate)
        self._worst_m, self._worst_rad = 0.0, 0.0
        self._display.restart()
        self._look()

    def _first(self) -> tuple[Observation, Info]:
        """What `reset` returns."""
        if self._display.is_window:
            self.render()
        return self._observation(), self._info(dict.fromkeys(TERMS, 0.0))

    def _look(self) -> None:
        simulation = self.simulation
        held, poured, spilled = simulation.share.tolist()
        self._share: tuple[float, float, float] = (held, poured, spilled)
        self._tracking_errors = self._stage.targets.errors(
            self._reference_index, simulation.vessel_m, simulation.vessel_R, simulation.twist
        )
        if self._display.has_trail:
            self._display.record(simulation.vessel_R @ simulation.scene.vessel.outlet.point_m + simulation.vessel_m)

    @property
    def _reference_index(self) -> int:
        return min(self._step_index, len(self._base) - 1)

    def _observation(self) -> Observation:
        simulation, noise = self.simulation, self.randomization
        agent = np.concatenate([simulation.data.qpos[:7], simulation.data.qvel[:7]])
        observation: Observation = {}
        if noise.noisy:
            agent[:7] += self.np_random.normal(0.0, 1.0, 7) * noise.joint_noise_rad
        observation["agent_pos"] = agent.astype(np.float32)
        if self.obs_mode != "pixels":
            vessel_m, receptacle_m = simulation.vessel_m, simulation.receptacle_m
            if noise.noisy:
                off_m = self.np_random.normal(0.0, 1.0, (2, 3)) * noise.object_noise_m
                vessel_m, receptacle_m = vessel_m + off_m[0], receptacle_m + off_m[1]
            observation["environment_state"] = self._stage.targets.environment_state(
                self._reference_index, vessel_m, simulation.vessel_R, simulation.twist, receptacle_m, simulation.share
            )
        if self.obs_mode != "state":
            observation["pixels"] = {
                camera: self._stage.pictures.picture(
                    simulation.data, camera, self.image_size, simulation.unmodelled_particles
                )
                for camera in self.cameras
            }
        return observation

    def _info(self, terms: dict[str, float]) -> Info:
        held, poured, spilled = self._share
        position_m, rotation_rad, _, _ = self._tracking_errors
        scene = self.simulation.scene
        info: Info = {
            "reward_terms": terms,
            "poured_fraction": poured,
            "spilled_fraction": spilled,
            "held_fraction": held,
            "position_error_m": position_m,
            "rotation_error_rad": rotation_rad,
            "reference_index": self._reference_index,
            "is_success": self.is_success,
            "outlet": "spout_conduit" if scene.vessel.outlet.kind == "spout" else "lip",
        }
        if self.simulation.holding.free:
            info["slip_m"], info["slip_rad"] = self.simulation.holding.slip()
        if self.simulation.settled_held < scene.num_particles:
            lost = scene.num_particles - self.simulation.settled_held
            info["start_warning"] = f"{lost} particles run out in the start pose: the vessel is tilted or too full"
        return info
