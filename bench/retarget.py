"""Inverse kinematics alone against torques by optimal control (Eq. 4), and both carried out in the simulator.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/retarget.py [--pours N] [--first K] [--workers N]
        [--tables solve ...] [--grasp NAME] [--json]

Everything starts from exact tracks of synthetic pours, which are rendered small once into --clips. `solve`: means over
the pours of the plan's error to the true motion, where the track is exact and where a tracker trembles by 0.5 mm and
0.2 degrees, of the largest torque beyond gravity's and of the largest jerk; `wins` counts the pours in which Eq. 4 is
no worse than inverse kinematics in mean error, torque and jerk at once, and `within 1%` those in which it is worse in
none by more. On an exact track nothing is to be smoothed: its jerk is what there is, and followed 40 times closer than
by inverse kinematics, whose lag of a few micrometres rounds it off, single pours have up to 5% more of it. `weights`:
what the pull toward the track trades. `execute`: with what `--scale auto` chose, the controller's errors over the whole
motion, and what was poured; `faithful` is what the motion poured and spilled as it was seen.
`time`: one core's time for 250 knots, inverse kinematics included.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from vid2demo.demos.dynamics import arm_with, inverse_dynamics, payload_of
from vid2demo.demos.feasibility import feasibility
from vid2demo.demos.impedance import ImpedancePlayer
from vid2demo.demos.limits import commanded, extremes
from vid2demo.demos.motion import JointCurve
from vid2demo.demos.optimize import TorqueWeights
from vid2demo.demos.retarget import Solver, retarget, tracking_errors
from vid2demo.demos.rollout import DEFAULT_ENV_ID, make_env, roll_out
from vid2demo.demos.scale_search import search_scale
from vid2demo.envs.placement import build_reference
from vid2demo.envs.reference import Reference
from vid2demo.extract.geometry import Array
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.track import ObjectTrack

CATEGORIES = ("mug", "gooseneck_kettle", "bottle", "tumbler", "teapot", "jug", "measuring_cup", "saucepan")
TREMBLE_M, TREMBLE_RAD = 5e-4, np.deg2rad(0.2)
TRACKS = ("exact", "trembling")
FACTORS = (0.01, 0.1, 1.0, 10.0)


@dataclass(frozen=True)
class Pour:
    """A synthetic pour, placed before the robot. number: its seed. tracks: the vessel's and the receptacle's."""

    name: str
    number: int
    tracks: tuple[ObjectTrack, ObjectTrack]
    reference: Reference

    def at_scale(self, scale: float) -> Reference:
        return build_reference(*self.tracks, scale=scale)

    def seen(self, track: str) -> Reference:
        return self.reference if track == "exact" else trembling(self.reference, np.random.default_rng(self.number))


def make_pour(clips: Path, seed: int) -> Pour:
    category = CATEGORIES[seed % len(CATEGORIES)]
    folder = clips / f"{seed:02d}_{category}"
    if not (folder / "truth.track.npz").exists():
        synthesize(category, seed, folder, size=(96, 72), occluder=False, noise=False)
    vessel, receptacle = (ObjectTrack.load(folder / f"{name}.track.npz") for name in ("truth", "receptacle"))
    return Pour(folder.name, seed, (vessel, receptacle), build_reference(vessel, receptacle))


def trembling(reference: Reference, rng: np.random.Generator) -> Reference:
    T = reference.T_world_object.copy()
    T[1:, :3, 3] += rng.normal(0.0, TREMBLE_M, (len(T) - 1, 3))
    T[1:, :3, :3] = T[1:, :3, :3] @ Rotation.from_rotvec(rng.normal(0.0, TREMBLE_RAD, (len(T) - 1, 3))).as_matrix()
    return Reference.from_poses(T, reference.time_s, reference.header, reference.confidence, reference.video_time_s)


def measured(truth: Reference, q_rad: Array) -> dict[str, float]:
    """Of one plan: errors to the true motion, and what it asks of the joints between its knots."""
    position_m, rotation_rad = tracking_errors(truth, q_rad)
    arm, curve = arm_with(payload_of(truth), truth.T_hand_object), JointCurve(truth.time_s, q_rad)
    fine_s = curve.clock(200.0)
    motion = [curve.at(fine_s, order) for order in range(3)]
    still = np.zeros_like(motion[0])
    torque_nm = inverse_dynamics(arm, *motion)
    beyond_nm = torque_nm - inverse_dynamics(arm, motion[0], still, still)
    found = extremes(commanded(curve.at(curve.clock(1000.0)), torque_nm))
    return {
        "mean_mm": 1e3 * float(position_m.mean()),
        "max_mm": 1e3 * float(position_m.max()),
        "mean_deg": float(np.rad2deg(rotation_rad.mean())),
        "max_deg": float(np.rad2deg(rotation_rad.max())),
        "torque_nm": float(np.abs(beyond_nm).max()),
        "torque_rms_nm": float(np.sqrt((beyond_nm**2).mean())),
        "torque_part": max(e.part for e in found if e.quantity == "torque"),
        "acceleration_part": max(e.part for e in found if e.quantity == "acceleration"),
        "jerk_rad_s3": max(abs(e.value) for e in found if e.quantity == "jerk"),
    }


def solved(truth: Reference, seen: Reference, solver: Solver, weights: TorqueWeights | None = None) -> dict[str, float]:
    return measured(truth, retarget(seen, strict=False, solver=solver, weights=weights).q_rad)


def mean_of(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def solve_pour(pour: Pour) -> dict[tuple[str, str], dict[str, float]]:
    return {
        (track, solver): solved(pour.reference, pour.seen(track), solver)  # type: ignore[arg-type]
        for track in TRACKS
        for solver in ("mink", "torque")
    }


def table_solve(made: list[dict[tuple[str, str], dict[str, float]]]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for track in TRACKS:
        plain, best = ([found[track, solver] for found in made] for solver in ("mink", "torque"))
        judged = ("mean_mm", "mean_deg", "torque_nm", "jerk_rad_s3")
        worst = [max(b[name] / p[name] for name in judged) for p, b in zip(plain, best, strict=True)]
        wins, nearly = (f"{sum(part <= most for part in worst)}/{len(made)}" for most in (1.0, 1.01))
        rows.append({"track": track, "solver": "mink alone", "wins": "", "within 1%": "", **mean_of(plain)})
        rows.append({"track": track, "solver": "Eq. 4", "wins": wins, "within 1%": nearly, **mean_of(best)})
    return rows


def weights_pour(pour: Pour) -> dict[tuple[float, str], dict[str, float]]:
    plain = TorqueWeights()
    found = {}
    for factor in FACTORS:
        weights = replace(
            plain,
            position_1_m2=factor * plain.position_1_m2,
            rotation_1_rad2=factor * plain.rotation_1_rad2,
            patience=plain.patience / factor,
        )
        for track in TRACKS:
            found[factor, track] = solved(pour.reference, pour.seen(track), "torque", weights)
    return found


def table_weights(made: list[dict[tuple[float, str], dict[str, float]]]) -> list[dict[str, Any]]:
    return [{"pull": f"x{factor}", "track": track, **mean_of([found[factor, track] for found in made])}
            for track in TRACKS for factor in FACTORS]  # fmt: skip


def execute_pour(pour: Pour, particles: int, grasp: str) -> dict[str, Any]:
    reference = search_scale(pour.reference, pour.at_scale)
    joints = retarget(reference, strict=False)
    findings = feasibility(reference, joints)
    env = make_env(DEFAULT_ENV_ID, reference, num_particles=particles, grasp=grasp, control_mode="joint_position")
    errors: list[tuple[float, float]] = []
    slips: list[float] = [0.0]

    def note(step: int, action: Any, observation: Any, reward: float, info: dict[str, Any]) -> None:
        errors.append((info["position_error_m"], info["rotation_error_rad"]))
        slips.append(info.get("slip_m", 0.0))

    episode = roll_out(env, ImpedancePlayer(joints), seed=0, on_step=note)
    env.close()
    position_m, rotation_rad = np.array(errors)[: len(reference) - 1].T
    curve = JointCurve(joints.time_s, joints.q_rad)
    found = extremes(commanded(curve.at(curve.clock(1000.0)), joints.tau_nm))
    return {
        "pour": pour.name,
        "feasible": findings["feasible"],
        "mean_mm": 1e3 * float(position_m.mean()),
        "max_mm": 1e3 * float(position_m.max()),
        "mean_deg": float(np.rad2deg(rotation_rad.mean())),
        "max_deg": float(np.rad2deg(rotation_rad.max())),
        "slip_mm": 1e3 * max(slips),
        "limit_part": max(e.part for e in found if e.quantity != "torque rate"),
        "collisions": len(findings["collisions"]),
        "changed": changed(reference),
        "faithful": faithful(reference),
        "poured": episode.summary["poured_fraction"],
        "spilled": episode.summary["spilled_fraction"],
    }


def changed(reference: Reference) -> str:
    """What `--scale auto` changed, in short."""
    chosen = next(t for t in reference.header["scale_search"] if t["chosen"])
    moved_cm = 100 * float(np.hypot(chosen["along_m"], chosen["across_m"]))
    return f"x{chosen['scale']:.2f} {moved_cm:.0f}cm +{chosen['tip_deg']:.0f}deg"


def faithful(reference: Reference) -> str:
    """Poured and spilled fraction of the first try of `--scale auto`, the motion as it was seen."""
    first = reference.header["scale_search"][0]
    return f"{first['poured']:.2f} {first['spilled']:.2f}"


def table_time(pours: list[Pour]) -> list[dict[str, Any]]:
    rows = []
    for pour in pours[:3]:
        long = pour.reference.stretched(249 / 25.0 / pour.reference.duration_s)
        retarget(long)  # loads the libraries and compiles
        for solver in ("mink", "torque"):
            start = time.process_time()
            joints = retarget(long, solver=solver)  # type: ignore[arg-type]
            taken_s = time.process_time() - start
            told = joints.header["solver"]
            rows.append(
                {
                    "pour": pour.name,
                    "solver": solver,
                    "knots": len(joints),
                    "s": taken_s,
                    "steps": told.get("iterations", 0),
                }
            )
    return rows


def show(title: str, rows: Iterable[dict[str, Any]]) -> None:
    """Print rows as they come; they may take minutes each."""
    print(f"\n{title}")
    for number, row in enumerate(rows):
        if number == 0:
            print(" ".join(f"{name:>17}" for name in row))
        print(" ".join(f"{v:17.4f}" if isinstance(v, float) else f"{v!s:>17}" for v in row.values()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pours", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--grasp", choices=["weld", "friction"], default="weld")
    parser.add_argument("--clips", type=Path, default=Path("runs/bench_retarget"))
    parser.add_argument("--tables", nargs="+", default=["solve", "weights", "execute", "time"])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    # Spawned, not forked: the engines' libraries have threads of their own.
    pool = ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn"))
    each: Any = pool.map if arguments.workers > 1 else map
    seeds = range(arguments.first, arguments.first + arguments.pours)
    pours = list(each(partial(make_pour, arguments.clips), seeds))
    execute = partial(execute_pour, particles=arguments.particles, grasp=arguments.grasp)
    make: dict[str, Any] = {
        "solve": lambda: table_solve(list(each(solve_pour, pours))),
        "weights": lambda: table_weights(list(each(weights_pour, pours))),
        "execute": lambda: each(execute, pours),
        "time": lambda: table_time(pours),
    }
    if arguments.json:
        print(json.dumps({name: list(make[name]()) for name in arguments.tables}, indent=2))
    else:
        for name in arguments.tables:
            show(name, make[name]())


if __name__ == "__main__":
    main()
