"""Environment steps per CPU second of PandaPour and of other manipulation environments, on this machine.

    make bench-peers        or        python bench/peers.py [--json] [--steps N] [NAME ...]

Every peer gets a virtual environment of its own under build/peers/ (made by uv on the first call, which takes minutes
and needs a package index), because they want other versions of MuJoCo than we do. Each environment runs in a process
of its own with state observations and random actions; only `env.step` is timed. Random actions soon spill our
particles, and what lies apart costs less than what is poured: `bench/env_speed.py` times the pour itself.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from argparse import ArgumentParser
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PEERS = ROOT / "build/peers"
STEPS = 1000


@dataclass(frozen=True)
class Peer:
    """packages: what is installed; module: what registers `environments`: ids with their keyword arguments."""

    module: str
    environments: tuple[tuple[str, dict[str, Any]], ...]
    packages: tuple[str, ...] = ()


OURS = "vid2demo"
ALL = {
    OURS: Peer(
        "vid2demo",
        (
            ("PandaTrack-v0", {}),
            ("PandaPour-v0", {"num_particles": 50}),
            ("PandaPour-v0", {"num_particles": 100}),
            ("PandaPour-v0", {"num_particles": 100, "liquid": {"solver": "fast"}}),
        ),
    ),
    # From mujoco 3.12 on, its comparison of enums fails.
    "gymnasium-robotics": Peer(
        "gymnasium_robotics",
        (("FetchPickAndPlace-v4", {}), ("FrankaKitchen-v1", {})),
        ("gymnasium-robotics", "mujoco==3.8.1"),
    ),
    "metaworld": Peer("metaworld", (("Meta-World/MT1", {"env_name": "pick-place-v3"}),), ("metaworld", "packaging")),
    "gym-hil": Peer("gym_hil", (("gym_hil/PandaPickCubeBase-v0", {"image_obs": False}),), ("gym-hil",)),
}


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(ALL)}; all by default")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps to time per environment")
    parser.add_argument("--measure", help="a JSON list [module, id, keyword arguments]: measure this one here")
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(*json.loads(options.measure), steps=options.steps)))
        return
    if unknown := set(options.names) - set(ALL):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(ALL)}")
    rows = []
    for name in options.names or ALL:
        try:
            python = interpreter(name)
            rows += [
                {"peer": name, **measured(python, ALL[name].module, env_id, kwargs, options.steps)}
                for env_id, kwargs in ALL[name].environments
            ]
        except subprocess.CalledProcessError as error:
            lines = (error.stderr or "").strip().splitlines() or [str(error)]
            print(f"{name}: {lines[-1]}", file=sys.stderr)
    print(json.dumps(rows, indent=2) if options.json else table(rows))


def interpreter(name: str) -> str:
    """The peer's Python, with its packages installed."""
    if name == OURS:
        return sys.executable
    folder = PEERS / name
    python, done = folder / "bin/python", folder / "installed.json"
    packages = list(ALL[name].packages)
    if not done.exists() or json.loads(done.read_text()) != packages:
        print(f"{name}: installing {', '.join(packages)} into {folder.relative_to(ROOT)}", file=sys.stderr, flush=True)
        uv = str(Path(sys.executable).with_name("uv"))
        run([uv, "venv", "--quiet", "--clear", "--python", sys.executable, str(folder)])
        run([uv, "pip", "install", "--quiet", "--python", str(python), *packages])
        done.write_text(json.dumps(packages))
    return str(python)


def measured(python: str, module: str, env_id: str, kwargs: dict[str, Any], steps: int) -> dict[str, Any]:
    """What `measure` gives when it runs in another interpreter."""
    what = json.dumps([module, env_id, kwargs])
    return dict(json.loads(run([python, __file__, "--measure", what, "--steps", str(steps)]).splitlines()[-1]))


def run(command: list[str]) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment.setdefault("MUJOCO_GL", "egl")
    # A path meant for our interpreter would hand our packages to theirs.
    environment.pop("PYTHONPATH", None) if command[0] != sys.executable else None
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


def measure(module: str, env_id: str, kwargs: dict[str, Any], steps: int) -> dict[str, Any]:
    """Step an environment with random actions; resets are not counted."""
    import gymnasium

    import_module(module)
    # Gymnasium's checker calls every step's result into question, which costs as much as a light environment's step.
    env: Any = gymnasium.make(env_id, disable_env_checker=True, **kwargs)
    env.reset(seed=0)
    env.action_space.seed(0)
    seconds, resets = 0.0, 0
    start_s = clock_s(env)
    env.step(env.action_space.sample())
    period_s = clock_s(env) - start_s
    for _ in range(steps):
        action = env.action_space.sample()
        start = time.process_time()
        _, _, terminated, truncated, _ = env.step(action)
        seconds += time.process_time() - start
        if terminated or truncated:
            env.reset()
            resets += 1
    versions = {name: metadata.version(name) for name in ("mujoco", "gymnasium")}
    return {
        "environment": " ".join([env_id.removeprefix("gym_hil/"), *(f"{k}={v}" for k, v in kwargs.items())]),
        "steps_per_s": steps / seconds,
        "control_hz": 1.0 / period_s if period_s > 0 else None,
        "times_real_time": steps * period_s / seconds if period_s > 0 else None,
        "steps": steps,
        "resets": resets,
        **versions,
    }


def clock_s(env: Any) -> float:
    """The simulator's clock in s, wherever the environment keeps its data; 0 when it keeps it elsewhere."""
    base = env.unwrapped
    for owner in (base, getattr(base, "robot_env", None)):
        for name in ("data", "_data"):
            if hasattr(getattr(owner, name, None), "time"):
                return float(getattr(owner, name).time)
    return 0.0


def table(rows: list[dict[str, Any]]) -> str:
    """The rows for a person."""
    lines = [f"{'':<20} {'environment':<64} {'steps/s':>8} {'control Hz':>11} {'x real time':>12} {'mujoco':>8}"]
    for row in rows:
        rate, times = (f"{row[k]:.4g}" if row[k] else "?" for k in ("control_hz", "times_real_time"))
        lines.append(
            f"{row['peer']:<20} {row['environment']:<64} {row['steps_per_s']:>8.0f} {rate:>11} {times:>12} "
            f"{row['mujoco']:>8}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
