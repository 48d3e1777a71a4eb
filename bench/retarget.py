"""Inverse kinematics alone against torques by optimal control (Eq. 4), and both carried out in the simulator.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/retarget.py [--pours N] [--tables solve ...] [--grasp NAME] [--json]

Everything starts from exact tracks of synthetic pours, which are rendered small once into --clips. `solve`: error of
the plan to the true motion, where the track is exact and where a tracker trembles by 0.5 mm and 0.2 degrees; largest
torque beyond gravity's, largest jerk. `weights`: what w_d trades. `execute`: with what `--scale auto` chose, the
controller's errors over the whole motion, and what was poured. `time`: one core's time for 250 knots, inverse
kinematics included.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
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


Pour = tuple[str, Reference, Callable[[float], Reference]]


def references(clips: Path, count: int) -> Iterator[Pour]:
    """Seeded pours of eight categories, placed before the robot, and how to place them at another scale."""
    for seed in range(count):
        category = CATEGORIES[seed % len(CATEGORIES)]
        folder = clips / f"{seed:02d}_{category}"
        if not (folder / "truth.track.npz").exists():
            synthesize(category, seed, folder, size=(96, 72), occluder=False, noise=False)
        tracks = [ObjectTrack.load(folder / f"{name}.track.npz") for name in ("truth", "receptacle")]
        yield folder.name, build_reference(*tracks), lambda scale, t=tracks: build_reference(*t, scale=scale)  # type: ignore[misc]


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


def table_solve(pours: list[Pour]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for track in ("exact", "trembling"):
        for solver in ("mink", "torque"):
            found = []
            for number, (_, truth, _) in enumerate(pours):
                seen = truth if track == "exact" else trembling(truth, np.random.default_rng(number))
                found.append(solved(truth, seen, solver))  # type: ignore[arg-type]
            rows.append({"track": track, "solver": {"mink": "mink alone", "torque": "Eq. 4"}[solver], **mean_of(found)})
    return rows


def table_weights(pours: list[Pour]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for factor in (0.01, 0.1, 1.0, 10.0):
        plain = TorqueWeights()
        weights = TorqueWeights(
            position_1_m2=factor * plain.position_1_m2, rotation_1_rad2=factor * plain.rotation_1_rad2
        )
        for track in ("exact", "trembling"):
            found = []
            for number, (_, truth, _) in enumerate(pours):
                seen = truth if track == "exact" else trembling(truth, np.random.default_rng(number))
                found.append(solved(truth, seen, "torque", weights))
            rows.append({"w_d": weights.position_1_m2, "track": track, **mean_of(found)})
    return rows


def table_execute(pours: list[Pour], particles: int, grasp: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for name, faithful, at_scale in pours:
        reference = search_scale(faithful, at_scale)
        joints = retarget(reference, strict=False)
        findings = feasibility(reference, joints)
        env = make_env(DEFAULT_ENV_ID, reference, num_particles=particles, grasp=grasp, control_mode="joint_position")
        errors: list[tuple[float, float]] = []
        episode = roll_out(
            env,
            ImpedancePlayer(joints),
            seed=0,
            on_step=lambda k, a, o, r, info, into=errors: into.append(  # type: ignore[misc]
                (info["position_error_m"], info["rotation_error_rad"])
            ),
        )
        env.close()
        position_m, rotation_rad = np.array(errors)[: len(reference) - 1].T
        curve = JointCurve(joints.time_s, joints.q_rad)
        found = extremes(commanded(curve.at(curve.clock(1000.0)), joints.tau_nm))
        rows.append(
            {
                "pour": name,
                "feasible": findings["feasible"],
                "mean_mm": 1e3 * float(position_m.mean()),
                "max_mm": 1e3 * float(position_m.max()),
                "mean_deg": float(np.rad2deg(rotation_rad.mean())),
                "max_deg": float(np.rad2deg(rotation_rad.max())),
                "limit_part": max(e.part for e in found if e.quantity != "torque rate"),
                "collisions": len(findings["collisions"]),
                "changed": changed(reference),
                "poured": episode.summary["poured_fraction"],
                "spilled": episode.summary["spilled_fraction"],
            }
        )
    return rows


def changed(reference: Reference) -> str:
    """What `--scale auto` changed, in short."""
    chosen = next(t for t in reference.header["scale_search"] if t["chosen"])
    moved_cm = 100 * float(np.hypot(chosen["along_m"], chosen["across_m"]))
    return f"x{chosen['scale']:.2f} {moved_cm:.0f}cm +{chosen['tip_deg']:.0f}deg"


def table_time(pours: list[Pour]) -> list[dict[str, Any]]:
    rows = []
    for name, reference, _ in pours[:3]:
        long = reference.stretched(249 / 25.0 / reference.duration_s)
        retarget(long)  # loads the libraries and compiles
        for solver in ("mink", "torque"):
            start = time.process_time()
            joints = retarget(long, solver=solver)  # type: ignore[arg-type]
            taken_s = time.process_time() - start
            told = joints.header["solver"]
            rows.append(
                {"pour": name, "solver": solver, "knots": len(joints), "s": taken_s, "steps": told.get("iterations", 0)}
            )
    return rows


def show(title: str, rows: list[dict[str, Any]]) -> None:
    print(f"\n{title}")
    print(" ".join(f"{name:>17}" for name in rows[0]))
    for row in rows:
        print(" ".join(f"{v:17.3f}" if isinstance(v, float) else f"{v!s:>17}" for v in row.values()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pours", type=int, default=20)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--grasp", choices=["weld", "friction"], default="weld")
    parser.add_argument("--clips", type=Path, default=Path("runs/bench_retarget"))
    parser.add_argument("--tables", nargs="+", default=["solve", "weights", "execute", "time"])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    pours = list(references(arguments.clips, arguments.pours))
    make = {
        "solve": lambda: table_solve(pours),
        "weights": lambda: table_weights(pours[:5]),
        "execute": lambda: table_execute(pours, arguments.particles, arguments.grasp),
        "time": lambda: table_time(pours),
    }
    result = {}
    for name in arguments.tables:
        result[name] = make[name]()
        if not arguments.json:
            show(name, result[name])
    if arguments.json:
        print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
