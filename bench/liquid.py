"""The fast liquid against the engine's: do they pour the same, how much faster is it, does it rest?

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/liquid.py [--pours 100] [--seed 0]

Every pour is played three times on the same motion: with the engine's particles, with the engine's again after they
were disturbed by a hundredth of a millimetre (how far chance alone takes two pours apart), and with the fast ones.
Vessels, tilts, tilt speeds and offsets of start and receptacle are drawn from the seed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from vid2demo.envs.builtin import arm_trajectory, builtin_reference, pour_reference
from vid2demo.envs.liquid import Liquid
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.extract.vessels import make_vessel

# Vessel, receptacle, least and greatest tilt in degrees: from a part of the contents to all of them.
KINDS = (
    ("mug", "bowl", 80.0, 120.0),
    ("cup", "mug", 80.0, 120.0),
    ("wine_glass", "bowl", 85.0, 125.0),
    ("pitcher", "bowl", 90.0, 125.0),
    ("beaker", "bowl", 80.0, 120.0),
    ("bottle", "bowl", 90.0, 125.0),
    ("carton", "bowl", 90.0, 125.0),
    ("gooseneck_kettle", "mug", 55.0, 85.0),
)
PARTICLES, DISTURBANCE_M = 100, 1e-5
MEAN_LIMIT, WORST_LIMIT = 0.05, 0.15
FAST = Liquid(solver="fast")


def drawn_pour(number: int, seed: int) -> tuple[str, Reference, dict[str, Any]]:
    """The vessel, the reference and the reset options of one pour."""
    vessel, receptacle, low_deg, high_deg = KINDS[number % len(KINDS)]
    rng = np.random.default_rng([seed, number])
    speed = float(np.exp(rng.uniform(np.log(0.7), np.log(1.4))))
    built = pour_reference(
        make_vessel(vessel),
        make_vessel(receptacle),
        tilt_deg=rng.uniform(low_deg, high_deg),
        clearance_m=rng.uniform(0.02, 0.06),
        control_hz=25.0 / speed,
    )
    # Knots that were laid for another rate, played at 25 Hz: the same way, faster or slower.
    reference = Reference.from_poses(built.T_world_object, np.arange(len(built)) / 25.0, built.header)
    options = {
        "start_offset_m": [*rng.uniform(-0.03, 0.03, 2), 0.0],
        "receptacle_offset_m": [*rng.uniform(-0.02, 0.02, 2), 0.0],
    }
    return vessel, reference, options


def poured(env: PandaPourEnv, options: Mapping[str, Any], disturbance_m: float = 0.0) -> np.ndarray[Any, Any]:
    """(2,) poured and spilled fractions at the end of an episode that follows the reference."""
    env.reset(seed=0, options=options)
    env.simulation.particles_m += np.random.default_rng(0).normal(0.0, disturbance_m, (PARTICLES, 3))
    q_rad = arm_trajectory(env.reference).astype(np.float32)
    truncated, step, info = False, 0, {}
    while not truncated:
        step += 1
        _, _, _, truncated, info = env.step(q_rad[min(step, len(q_rad) - 1)])
    return np.array([info["poured_fraction"], info["spilled_fraction"]])


def compare(pours: int, seed: int) -> None:
    rows = []
    print(f"{'vessel':17} {'engine':>12} {'again':>12} {'fast':>12}   poured and spilled in percent")
    for number in range(pours):
        vessel, reference, options = drawn_pour(number, seed)
        engine = PandaPourEnv(reference, num_particles=PARTICLES)
        fast = PandaPourEnv(reference, num_particles=PARTICLES, liquid=FAST)
        row = [poured(engine, options), poured(engine, options, DISTURBANCE_M), poured(fast, options)]
        print(f"{vessel:17}", *(f"{100 * p:6.0f} {100 * s:5.0f}" for p, s in row), flush=True)
        rows.append(row)
    found = np.array(rows)
    for name, other in (("engine again", found[:, 1]), ("fast", found[:, 2])):
        off = other - found[:, 0]
        for what, column in (("poured", off[:, 0]), ("spilled", off[:, 1])):
            print(
                f"{name:12} {what:7}: mean difference {100 * np.abs(column).mean():4.1f} points, "
                f"worst {100 * np.abs(column).max():4.1f}, bias {100 * column.mean():+4.1f}"
            )
    off = np.abs(found[:, 2] - found[:, 0])
    kept = off.mean(axis=0).max() <= MEAN_LIMIT and off.max() <= WORST_LIMIT
    print(f"within {100 * MEAN_LIMIT:.0f} points on average and {100 * WORST_LIMIT:.0f} at worst: {kept}", flush=True)


def speeds() -> None:
    """Env steps per second of CPU time, the solvers in turns."""
    reference = builtin_reference()
    q_rad = arm_trajectory(reference).astype(np.float32)
    for count in (100, 300):
        rates: dict[str, list[float]] = {"engine": [], "fast": []}
        envs = {solver: PandaPourEnv(reference, num_particles=count, liquid=Liquid(solver=solver)) for solver in rates}
        for _ in range(3):
            for solver, env in envs.items():
                env.reset(seed=0)
                steps = env._max_episode_steps
                start = time.process_time()
                for k in range(steps):
                    env.step(q_rad[min(k + 1, len(q_rad) - 1)])
                rates[solver].append(steps / (time.process_time() - start))
        engine, fast = max(rates["engine"]), max(rates["fast"])
        print(
            f"{count} particles: engine {engine:.0f} env steps/s, fast {fast:.0f}: {fast / engine:.1f} times as many, "
            f"{fast / 25:.1f} times real time",
            flush=True,
        )


def rest() -> None:
    """A closed vessel that nobody moves."""
    reference = pour_reference(make_vessel("gooseneck_kettle"), make_vessel("mug"), tilt_deg=70.0)
    for solver in ("engine", "fast"):
        env = PandaPourEnv(reference, num_particles=PARTICLES, liquid=Liquid(solver=solver))
        env.reset(seed=0)
        speed_m_s, heights_m = [], []
        for _ in range(100):
            env.step(env.reference.q_start_rad.astype(np.float32))
            speed_m_s.append(np.sqrt(np.mean(np.sum(env.simulation.particle_velocities_m_s**2, axis=1))))
            heights_m.append(env.particle_positions_m[:, 2].mean())
        print(
            f"at rest for 4 s, {solver:6}: root mean square speed {1e3 * max(speed_m_s[25:]):.3f} mm/s at most after "
            f"1 s, {1e3 * speed_m_s[-1]:.3f} at the end; middle height changed by {1e3 * np.ptp(heights_m):.3f} mm"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pours", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    speeds()
    rest()
    compare(arguments.pours, arguments.seed)


if __name__ == "__main__":
    main()
