"""What vessels hold, as measured in their meshes, and whether the built-in pour empties them into a bowl.

    OMP_NUM_THREADS=1 MUJOCO_GL=egl python bench/vessels.py [NAME | NAME:SEED | FILE ...]
        [--particles 100] [--receptacle bowl] [--sheet PNG] [--json]

Without names every category of the library is poured, and every mesh in ../shared/data/meshes where that is. `error`
is the volume measured in a library vessel's mesh against its exact one. Closed containers are cut open at the top.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vid2demo.envs.builtin import arm_trajectory, pour_reference
from vid2demo.envs.cameras import CameraPose
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.extract.any_vessel import resolve_vessel
from vid2demo.extract.errors import UserError
from vid2demo.extract.files import atomic_path
from vid2demo.extract.geometry import look_at
from vid2demo.extract.vessel_from_mesh import measured, vessel_from_mesh
from vid2demo.extract.vessels import CATEGORIES, Vessel

SHARED = Path(__file__).parents[1].parent / "shared" / "data" / "meshes"
# Pictures of one pour, and pours beside each other.
FRAMES, ABREAST, FRAME_PX = 5, 2, (150, 200)


def load(name: str) -> tuple[Vessel, bool]:
    """A vessel, and whether its mesh had to be cut open."""
    try:
        return resolve_vessel(name), False
    except UserError as error:
        if "open_top" not in str(error):
            raise
        return vessel_from_mesh(name, open_top=True), True


def volume_error(vessel: Vessel) -> float | None:
    """Share by which the volume measured in the mesh misses the exact one; None where no exact one is known."""
    if vessel.source is not None:
        return None
    found, _, _ = measured(vessel.mesh, vessel.category)
    return found.interior_volume_m3 / vessel.interior_volume_m3 - 1.0


def pour(vessel: Vessel, receptacle: Vessel, particles: int, pictures: bool) -> tuple[dict[str, Any], list[Any]]:
    """Figures of one pour, and pictures spread over it."""
    start = time.process_time()
    reference = pour_reference(vessel, receptacle)
    plan_s = time.process_time() - start
    target = reference.T_world_receptacle[:3, 3]
    eye, middle = (np.asarray(target + np.array(offset)) for offset in ((0.75, -0.35, 0.35), (0.0, -0.05, 0.1)))
    view = CameraPose("view", look_at(eye, middle, np.array([0.0, 0.0, 1.0])))
    shown = {"cameras": (view,), "render_mode": "rgb_array", "render_size": FRAME_PX, "render_camera": "view"}
    env = PandaPourEnv(reference, num_particles=particles, **(shown if pictures else {}))
    env.reset(seed=0)
    q_rad = arm_trajectory(reference).astype(np.float32)
    steps = env._max_episode_steps
    wanted = set(np.linspace(0.3 * steps, steps - 1, FRAMES).astype(int).tolist()) if pictures else set()
    frames: list[Any] = []
    info: dict[str, Any] = {}
    for k in range(steps):
        *_, info = env.step(q_rad[min(k + 1, len(q_rad) - 1)])
        if k in wanted:
            frames.append(env.render())
    figures = {
        "tilt_deg": round(float(np.rad2deg(reference.tilt_rad.max()))),
        "poured": info["poured_fraction"],
        "spilled": info["spilled_fraction"],
        "worst_error_mm": 1000 * env._worst_m,
        "radius_mm": 1000 * env.simulation.scene.radius_m,
        "plan_s": plan_s,
    }
    env.close()
    return figures, frames


def sheet(path: Path, rows: list[tuple[str, list[NDArray[np.uint8]]]]) -> None:
    """The pictures of each pour in a row, the vessel's name in the corner."""
    from PIL import Image, ImageDraw

    height, width = FRAME_PX
    picture = Image.new("RGB", (ABREAST * FRAMES * width, -(-len(rows) // ABREAST) * height))
    draw = ImageDraw.Draw(picture)
    for index, (name, frames) in enumerate(rows):
        x, y = index % ABREAST * FRAMES * width, index // ABREAST * height
        for number, frame in enumerate(frames):
            picture.paste(Image.fromarray(frame), (x + number * width, y))
        draw.text((x + 6, y + 4), name, fill=(20, 20, 20))
    with atomic_path(path) as temporary:
        picture.save(temporary, format="PNG")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--receptacle", default="bowl")
    parser.add_argument("--sheet", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    logging.getLogger("vid2demo").setLevel(logging.ERROR)
    names = arguments.names or [*CATEGORIES, *(str(path) for path in sorted(SHARED.glob("*.*")))]
    receptacle = resolve_vessel(arguments.receptacle, "receptacle")
    rows, pictures = [], []
    if not arguments.json:
        print(
            f"{'vessel':24} {'ml':>6} {'error':>6} {'tilt':>5} {'poured':>7} {'spilled':>7} {'r mm':>5} {'plan s':>6}"
        )
    for name in names:
        short = Path(name).name
        try:
            vessel, cut = load(name)
            error = volume_error(vessel)
            figures, frames = pour(vessel, receptacle, arguments.particles, arguments.sheet is not None)
        except UserError as reason:
            rows.append({"vessel": short, "refused": str(reason)})
            if not arguments.json:
                print(f"{short:24} refused: {reason}")
            continue
        pictures.append((short, frames))
        row = {
            "vessel": short,
            "ml": 1e6 * vessel.interior_volume_m3,
            "volume_error": error,
            "cut_open": cut,
            **figures,
        }
        rows.append(row)
        if not arguments.json:
            missed = "" if error is None else f"{100 * error:+.1f}%"
            print(
                f"{short:24} {row['ml']:>6.0f} {missed:>6} {row['tilt_deg']:>5} {row['poured']:>7.2f} "
                f"{row['spilled']:>7.2f} {row['radius_mm']:>5.1f} {row['plan_s']:>6.1f}{'  cut open' if cut else ''}",
                flush=True,
            )
    if arguments.json:
        print(json.dumps(rows, indent=2))
    if arguments.sheet is not None:
        sheet(arguments.sheet, pictures)


if __name__ == "__main__":
    main()
