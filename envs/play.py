"""Play a pour open loop, to look at: in MuJoCo's window, or into an mp4 where there is no screen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.geometry import Array
from ..extract.progress import Progress
from ..extract.video import VideoWriter
from .builtin import arm_trajectory
from .overlays import OVERLAYS
from .pouring import PandaPourEnv
from .reference import Reference
from .rendering import has_screen

DEFAULT_OUT = Path("runs/play.mp4")


def play(
    reference: Path | None = None,
    q_rad: Array | None = None,
    out: Path | None = None,
    seed: int = 0,
    arguments: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Play a reference (None: the built-in one) with ghost, trail and figures drawn over it; tells how it went.

    q_rad: (N, 7) joint positions at the reference's knots; None solves for those of the episode's reference. out: the
    mp4 to write; None opens a window, which repeats the pour until it is closed, and writes `DEFAULT_OUT` where there
    is no screen. arguments: more for `PandaPourEnv`.
    Returns `shown` ("window" or the file), `seconds`, `is_success`, `poured_fraction`, `spilled_fraction`,
    `position_error_m` and `rotation_error_rad` (worst).
    Raises UserError for a reference, joints or a file name that will not do.
    """
    file = out if out is not None or has_screen() else DEFAULT_OUT
    if file is not None and file.suffix != ".mp4":
        raise UserError(f"--out is {file}; give a name that ends in .mp4")
    given: dict[str, Any] = {"overlays": OVERLAYS, **(arguments or {})}
    if reference is not None:
        given["reference"] = loaded = Reference.load(reference)
        given.setdefault("control_hz", loaded.control_hz)
    env = PandaPourEnv(**given, render_mode="human" if file is None else "rgb_array")
    try:
        if file is None:
            found = _episode(env, q_rad, seed, None, progress)
            while env.is_watched:
                found = _episode(env, q_rad, seed, None, None)
            return {"shown": "window", **found}
        with VideoWriter(file, env.control_hz) as writer:
            found = _episode(env, q_rad, seed, writer, progress)
        return {"shown": str(file), **found}
    finally:
        env.close()


def _episode(
    env: PandaPourEnv, q_rad: Array | None, seed: int, writer: VideoWriter | None, progress: Progress | None
) -> dict[str, Any]:
    """One episode to its end, or until nobody watches."""
    _, info = env.reset(seed=seed)
    actions = _actions(env.reference, q_rad)
    steps, worst_m, worst_rad, done = 0, 0.0, 0.0, False
    _write(env, writer)
    while not done and (writer is not None or env.is_watched):
        _, _, terminated, truncated, info = env.step(actions[min(steps + 1, len(actions) - 1)])
        done, steps = terminated or truncated, steps + 1
        worst_m = max(worst_m, info["position_error_m"])
        worst_rad = max(worst_rad, info["rotation_error_rad"])
        _write(env, writer)
        if progress is not None:
            progress(steps, env._max_episode_steps, "play")
    return {
        "seconds": steps / env.control_hz,
        **{name: info[name] for name in ("is_success", "poured_fraction", "spilled_fraction")},
        "position_error_m": worst_m,
        "rotation_error_rad": worst_rad,
    }


def _write(env: PandaPourEnv, writer: VideoWriter | None) -> None:
    if writer is None:
        return  # the window shows every step by itself
    picture = env.render()
    assert picture is not None
    writer.write(picture)


def _actions(reference: Reference, q_rad: Array | None) -> NDArray[np.float32]:
    if q_rad is None:
        q_rad = arm_trajectory(reference)
    if len(q_rad) != len(reference):
        raise UserError(
            f"the joint motion has {len(q_rad)} knots and the reference {len(reference)}: they are not of one motion; "
            "make the joints anew with `vid2demo retarget`, or leave --joints away"
        )
    return np.asarray(q_rad, np.float32)
