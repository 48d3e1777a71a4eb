"""How fast PandaPour steps, resets and renders, as ratios that do not depend on the machine.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/env_speed.py [--json]

`step / mj_step` compares `env.step` with the bare physics steps inside it, both timed in this process and turn by
turn on the same states; `x real time` is simulated time over CPU time of one thread. With the fast liquid `mj_step`
is the arm alone, so there the ratio tells what the liquid costs beside it.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mujoco
import numpy as np
from vid2demo.envs.builtin import arm_trajectory, builtin_reference
from vid2demo.envs.pouring import PandaPourEnv

CASES = ((0, "engine"), (50, "engine"), (100, "engine"), (300, "engine"), (100, "fast"), (300, "fast"))
SIZES = ((96, 96), (224, 224), (480, 640))


def step_cost(env: PandaPourEnv, actions: np.ndarray[Any, Any]) -> tuple[float, float]:
    """CPU seconds of a whole episode of `env.step` and of its physics steps alone.

    Each control period runs twice from the same state: once bare, with the commands the environment gives, then
    restored and through `env.step`.
    """
    env.reset(seed=0)
    whole_s, bare_s = 0.0, 0.0
    for action in actions:
        state = env.get_state()
        env.set_state(state)  # before both, so that both start with the same caches
        commands, _ = env.before_step(action)
        control = env.data.ctrl
        start = time.process_time()
        for command in commands:
            control[:7] = command
            mujoco.mj_step(env.model, env.data)
        bare_s += time.process_time() - start
        env.set_state(state)
        start = time.process_time()
        env.step(action)
        whole_s += time.process_time() - start
    return whole_s, bare_s


def main() -> None:
    reference = builtin_reference()
    q_rad = arm_trajectory(reference).astype(np.float32)
    rows = []
    for count, solver in CASES:
        arguments = {"num_particles": count, "liquid": {"solver": solver}}
        # The first one of all loads the compiled arithmetic.
        PandaPourEnv(reference, **arguments).step(q_rad[0])
        start = time.process_time()
        env = PandaPourEnv(reference, **arguments)
        make_s = time.process_time() - start
        steps = env._max_episode_steps
        actions = q_rad[np.minimum(np.arange(1, steps + 1), len(q_rad) - 1)]
        whole_s, bare_s = step_cost(env, actions)
        start = time.process_time()
        for seed in range(20):
            env.reset(seed=seed)
        reset_s = (time.process_time() - start) / 20
        rows.append(
            {
                "particles": count,
                "liquid": solver,
                "step_over_mj_step": whole_s / bare_s,
                "times_real_time": steps / env.control_hz / whole_s,
                "env_steps_per_s": steps / whole_s,
                "overhead_us_per_step": 1e6 * (whole_s - bare_s) / steps,
                "reset_ms": 1e3 * reset_s,
                "make_ms": 1e3 * make_s,
            }
        )
    env = PandaPourEnv(reference, num_particles=100)
    env.reset(seed=0)
    pictures = {}
    for size in SIZES:
        env._stage.pictures.picture(env.data, "front", size)
        start = time.process_time()
        for _ in range(20):
            env._stage.pictures.picture(env.data, "front", size)
        pictures[f"{size[1]}x{size[0]}"] = 20 / (time.process_time() - start)
    env.close()
    if "--json" in sys.argv:
        print(json.dumps({"steps": rows, "pictures_per_cpu_s": pictures}, indent=2))
        return
    columns = {
        "particles": "particles",
        "liquid": "liquid",
        "step_over_mj_step": "step/mj_step",
        "times_real_time": "x real time",
        "env_steps_per_s": "steps/s",
        "overhead_us_per_step": "+us/step",
        "reset_ms": "reset ms",
    }
    print("".join(f"{title:>13}" for title in columns.values()))
    for row in rows:
        cells = (row[name] for name in columns)
        print("".join(f"{cell:>13.2f}" if isinstance(cell, float) else f"{cell:>13}" for cell in cells))
    print("pictures per CPU second:", ", ".join(f"{size}: {rate:.0f}" for size, rate in pictures.items()))


if __name__ == "__main__":
    main()
