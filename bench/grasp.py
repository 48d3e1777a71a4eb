"""How well the fingers hold each vessel of the library by friction alone, during a whole built-in pour.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/grasp.py [--particles N] [--json] [category ...]

`slip` is the vessel's greatest shift and turn in the hand since it closed; poured and spilled fractions stand beside
those of the welded vessel, which cannot slip; `step` is CPU time of `env.step` by friction and welded.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np
from vid2demo.envs.builtin import arm_trajectory, pour_reference
from vid2demo.envs.holding import Grasp
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.extract.vessels import CATEGORIES, make_vessel

# Spouts pour at less tilt than lips, into something narrow.
SPOUTS = {"gooseneck_kettle": 75.0, "stovetop_kettle": 80.0, "electric_kettle": 90.0, "teapot": 80.0, "moka_pot": 110.0}


def pour(reference: Reference, grasp: Grasp, particles: int) -> dict[str, float]:
    """Play a reference open loop; what came of it."""
    env = PandaPourEnv(reference, num_particles=particles, grasp=grasp)
    q_rad = arm_trajectory(reference).astype(np.float32)
    env.reset(seed=0)
    slip_m, slip_rad = 0.0, 0.0
    start = time.process_time()
    steps = env._max_episode_steps
    for k in range(steps):
        *_, info = env.step(q_rad[min(k + 1, len(q_rad) - 1)])
        slip_m, slip_rad = max(slip_m, info.get("slip_m", 0.0)), max(slip_rad, info.get("slip_rad", 0.0))
    step_ms = 1e3 * (time.process_time() - start) / steps
    env.close()
    return {
        "slip_mm": 1e3 * slip_m,
        "slip_deg": float(np.rad2deg(slip_rad)),
        "poured": info["poured_fraction"],
        "spilled": info["spilled_fraction"],
        "step_ms": step_ms,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("category", nargs="*", default=CATEGORIES)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if not arguments.json:
        print(f"{'':24}   slip           friction           weld               step ms")
        print(f"{'category':16} {'kg':>5}   mm    deg    poured spilled   poured spilled   friction weld")
    for category in arguments.category:
        vessel = make_vessel(category)
        receptacle = make_vessel("mug" if category in SPOUTS else "bowl")
        try:
            reference = pour_reference(vessel, receptacle, tilt_deg=SPOUTS.get(category, 110.0))
            held, weld = (pour(reference, grasp, arguments.particles) for grasp in ("friction", "weld"))
        except UserError as error:
            if not arguments.json:
                print(f"{category:16} {error}")
            continue
        rows.append({"category": category, "mass_kg": vessel.mass_kg, "friction": held, "weld": weld})
        if not arguments.json:
            print(
                f"{category:16} {vessel.mass_kg:5.2f} {held['slip_mm']:5.2f} {held['slip_deg']:6.2f} "
                f"{held['poured']:8.2f} {held['spilled']:7.2f} {weld['poured']:8.2f} {weld['spilled']:7.2f} "
                f"{held['step_ms']:9.1f} {weld['step_ms']:5.1f}",
                flush=True,
            )
    if arguments.json:
        print(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
