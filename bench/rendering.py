"""How many pictures a second the scene's cameras give with software rendering.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/rendering.py [--json]

The state's cost is left out: a pour of 100 particles stands still in its middle while it is drawn. CPU time; Mesa's
software rasterizer is kept in one thread. `beside` draws particles that are not in the model, as the fast liquid's are;
`overlays` adds ghost, trail and figures.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from vid2demo.envs.builtin import arm_trajectory, builtin_reference
from vid2demo.envs.cameras import CAMERAS
from vid2demo.envs.overlays import OVERLAYS, Hud, Overlays
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.rendering import Cameras

PARTICLES, REPEATS = 100, 60
SIZES = ((96, 96), (224, 224), (480, 640))
AT_LEAST_FPS = {"96x96": 150, "224x224": 100, "640x480": 60}


def pictures_per_s(take: Callable[[], Any]) -> float:
    """Pictures per CPU second, by the median picture."""
    take()
    spent = []
    for _ in range(REPEATS):
        start = time.process_time()
        take()
        spent.append(time.process_time() - start)
    return 1.0 / statistics.median(spent)


def main() -> None:
    reference = builtin_reference()
    q_rad = arm_trajectory(reference).astype(np.float32)
    env = PandaPourEnv(reference, num_particles=PARTICLES)
    bare = PandaPourEnv(reference, num_particles=0)
    env.reset(seed=0)
    bare.reset(seed=0)
    overlays = Overlays(OVERLAYS, reference.control_hz)
    for k in range(1, 106):
        env.step(q_rad[k])
        bare.step(q_rad[k])
        overlays.record(env.T_world_object[:3, 3])
    overlay = overlays.at(reference.T_world_object[105], Hud(4.2, 0.5, 0.0, 0.001, 0.01))
    beside = env.particle_positions_m, env.simulation.scene.radius_m
    full, empty = Cameras(env.model), Cameras(bare.model)
    rows = []
    for size in SIZES:
        for camera in CAMERAS:
            ways: dict[str, Callable[[], Any]] = {
                "fps": partial(full.picture, env.data, camera, size),
                "fps_beside": partial(empty.picture, bare.data, camera, size, beside),
                "fps_overlays": partial(full.picture, env.data, camera, size, None, overlay),
            }
            rates = {name: pictures_per_s(take) for name, take in ways.items()}
            rows.append({"size": f"{size[1]}x{size[0]}", "camera": camera, **rates})
    if "--json" in sys.argv:
        print(json.dumps(rows, indent=2))
        return
    print(f"{'size':<9} {'camera':<7} {'pictures/s':>11} {'beside':>8} {'overlays':>9} {'wanted':>7}")
    for row in rows:
        print(
            f"{row['size']:<9} {row['camera']:<7} {row['fps']:>11.0f} {row['fps_beside']:>8.0f} "
            f"{row['fps_overlays']:>9.0f} {AT_LEAST_FPS[str(row['size'])]:>7}"
        )


if __name__ == "__main__":
    main()
