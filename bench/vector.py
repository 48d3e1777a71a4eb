"""How much faster a vector environment is than one environment, and what each of its environments takes of memory.

    OMP_NUM_THREADS=1 python bench/vector.py [--envs 8] [--threads 2] [--steps 60] [--repeats 8] [--pin] [--json]

`speedup` compares the environment steps a second of `make_vec(num_envs=E, num_threads=T)` with those of one
environment on one thread, in one process and turn by turn along the same motion. `engine` is the same ratio for the
bare physics steps: what the machine gives to T threads at all, which is less than T where they share a core.

The time that threads were ready to run and had no processor, as Linux tells it, is taken off, and steps with much of
it do not count; `kept` is the share of the others. Where other processes run, `--pin` gives every thread a processor.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import vid2demo  # noqa: F401 (registers the environments)
from vid2demo.envs.builtin import arm_trajectory
from vid2demo.extract.crew import Crew

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "PandaTrack": ("PandaTrack-v0", {"termination": "never"}),
    "PandaPour, 0 particles": ("PandaPour-v0", {"num_particles": 0}),
    "PandaPour, 100 particles": ("PandaPour-v0", {"num_particles": 100}),
    "PandaPour, 100 particles, fast": ("PandaPour-v0", {"num_particles": 100, "liquid": {"solver": "fast"}}),
}
# Steps that waited longer than this share of their time do not count.
WAITED = 0.4


def waited_s() -> float:
    """Time that this process's threads were ready to run and had no processor, where the system tells."""
    total = 0
    for path in Path("/proc/self/task").glob("*/schedstat"):
        try:
            total += int(path.read_text().split()[1])
        except OSError:  # the thread has ended
            continue
    return total * 1e-9


def timed(act: Callable[[], object], threads: int) -> float:
    """Seconds of a call that keeps `threads` threads busy; nan when they had to wait for processors for long."""
    before_s, start_s = waited_s(), time.perf_counter()
    act()
    took_s, lost_s = time.perf_counter() - start_s, (waited_s() - before_s) / threads
    return took_s - lost_s if lost_s < WAITED * took_s else np.nan


def resident_mb() -> float:
    """Memory of this process that is really there, in MB."""
    gc.collect()
    # What building freed must not be counted as room for what comes.
    getattr(ctypes.CDLL(None), "malloc_trim", lambda _: None)(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def pin() -> None:
    """Give the main thread the first processor, and every crew's threads the others."""
    usable = sorted(os.sched_getaffinity(0))
    for thread in threading.enumerate():
        if thread.name.startswith("vid2demo") and thread.native_id is not None:
            number = int(thread.name.rsplit("_", 1)[1]) + 1
            os.sched_setaffinity(thread.native_id, {usable[number % len(usable)]})
    os.sched_setaffinity(0, {usable[0]})


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One row of the table."""
    env_id, arguments = CASES[name]
    one = gym.make(f"vid2demo:{env_id}", disable_env_checker=True, **arguments).unwrapped
    actions = arm_trajectory(one.reference).astype(np.float32)[1 : options.steps + 1]
    count = options.envs
    one.reset(seed=0)
    one.step(actions[0])
    before_mb = resident_mb()
    start_s = time.perf_counter()
    extra = [one.twin() for _ in range(count)]
    twin_s = (time.perf_counter() - start_s) / count
    for env in extra:
        env.reset(seed=0)
        for action in actions[:10]:
            env.step(action)
    memory_mb = (resident_mb() - before_mb) / count
    del extra

    alone, together = (
        gym.make_vec(f"vid2demo:{env_id}", count, "vector_entry_point", num_threads=threads, **arguments)
        for threads in (1, options.threads)
    )
    crews = Crew(1), Crew(options.threads)
    envs = together.unwrapped.envs

    def advance(crew: Crew, commands: Sequence[Any]) -> None:
        crew.run(lambda i: envs[i].simulation.advance(commands[i]), range(count))

    # Threads are started by the first work that there is for them.
    for env in (alone, together):
        env.reset(seed=0)
        env.step(np.tile(actions[0], (count, 1)))
    advance(crews[1], [env.before_step(actions[0])[0].copy() for env in envs])
    if options.pin:
        pin()
    times: dict[str, list[list[float]]] = {}
    for _ in range(options.repeats):
        for key, env, threads in (("one", one, 1), ("alone", alone, 1), ("together", together, options.threads)):
            env.reset(seed=0)
            given = actions if env is one else np.repeat(actions[:, None], count, axis=1)
            row = [timed(lambda env=env, action=action: env.step(action), threads) for action in given]
            times.setdefault(key, []).append(row)
        for key, crew in (("engine alone", crews[0]), ("engine together", crews[1])):
            for env in envs:
                env.reset(seed=0)
            row = []
            for action in actions:
                commands = [env.before_step(action)[0].copy() for env in envs]
                row.append(timed(lambda crew=crew, commands=commands: advance(crew, commands), crew.threads))
                for env in envs:
                    env.after_step(0.0)
            times.setdefault(key, []).append(row)
    for env in (one, alone, together):
        env.close()
    for crew in crews:
        crew.close()
    kept = {key: np.array(rows) for key, rows in times.items()}
    # The same steps of the motion for all, each as the median of its undisturbed repeats.
    good = np.all([~np.isnan(rows).all(axis=0) for rows in kept.values()], axis=0)
    if not good.any():
        raise SystemExit(f"{name}: every step was disturbed by other processes; try --pin, or a quieter hour")
    step_us = {
        key: 1e6 * float(np.nanmedian(rows[:, good], axis=0).mean()) / (1 if key == "one" else count)
        for key, rows in kept.items()
    }
    return {
        "case": name,
        "one_us": step_us["one"],
        "alone_us": step_us["alone"],
        "together_us": step_us["together"],
        "speedup": step_us["one"] / step_us["together"],
        "engine_speedup": step_us["engine alone"] / step_us["engine together"],
        "steps_per_s": 1e6 / step_us["together"],
        "memory_mb": memory_mb,
        "twin_ms": 1e3 * twin_s,
        "kept": 1.0 - float(np.mean([np.isnan(rows).mean() for rows in kept.values()])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Throughput and memory of the vector environment.")
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--case", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--pin", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    head = f"{'us per environment step':<31}{'one':>7}{'E on 1':>8}{'E on T':>8}"
    print(head + f"{'speedup':>9}{'engine':>8}{'steps/s':>9}{'MB/env':>8}{'ms/env':>8}{'kept':>6}", flush=True)
    for name in options.case:
        row = measure(name, options)
        rows.append(row)
        print(
            f"{name:<31}{row['one_us']:>7.0f}{row['alone_us']:>8.0f}{row['together_us']:>8.0f}{row['speedup']:>9.2f}"
            f"{row['engine_speedup']:>8.2f}{row['steps_per_s']:>9.0f}{row['memory_mb']:>8.1f}{row['twin_ms']:>8.1f}"
            f"{row['kept']:>6.0%}",
            flush=True,
        )
        # The next case's threads begin free.
        if options.pin:
            os.sched_setaffinity(0, range(os.cpu_count() or 1))
    if options.json:
        print(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
