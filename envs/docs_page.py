"""`docs/environment.md`, written from the code: what goes in and out of the environments, entry by entry.

    python -m vid2demo.envs.docs_page [--picture]

A test fails when the page no longer says what the code does; `make docs` writes it anew. `--picture` draws its picture
anew as well.
"""

from __future__ import annotations

import inspect
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ..extract.files import atomic_path, write_text
from .builtin import arm_trajectory
from .cameras import CAMERAS
from .control import CONTROL_MODES, action_entries
from .liquid import Liquid
from .observations import AGENT_ENTRIES, ENVIRONMENT_ENTRIES, Entry
from .options import TERMINATIONS
from .pouring import PandaPourEnv
from .randomization import RANDOMIZATIONS
from .rewards import REWARD_MODES, TERMS, RewardConfig
from .start import ReferenceStart

PAGE, PICTURE = Path("docs/environment.md"), Path("docs/environment.jpg")
ENV_IDS = ("PandaPour-v0", "PandaTrack-v0")
CONTROL_HZ = 25.0

_TOP = """# PandaPour-v0 and PandaTrack-v0

![A mug of particles is emptied into a bowl: from the front, from the wrist, and from the side](environment.jpg)

<!-- Written by `make docs` from the code; change the code, not this page. -->

```python
import gymnasium as gym

env = gym.make("vid2demo:PandaPour-v0")
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
```

## Description

A Franka Panda holds a vessel full of particles and must reproduce a motion that a person made: lift it, bring it over a
receptacle, and pour. The motion is the *reference*: poses of the vessel in the robot's world, one per control period,
taken from a video by `vid2demo retarget`, or built in. `PandaPour-v0` is rewarded for the motion and for what arrives
in the receptacle; `PandaTrack-v0` is the same without particles, rewarded for the motion alone, and many times faster.

The world frame is the robot's base (`panda_link0`), z up, table top at z = 0. The vessel's frame has its origin in the
middle of the bounding box, +z up when upright, +x toward spout or lip, or away from the handle. The receptacle's is
like it. Lengths are in metres, angles in radians, masses in kilograms. A step lasts one control period (1/25 s by
default); the action of step k is reached at its end, when the object should be at knot k + 1 of the reference.
"""

_REWARDS = """The reward of a step is the sum of weight x term; each product is in `info["reward_terms"]`. The
columns are the weights in each `reward_mode`. Tracking terms are kernels, exp(-(error / scale)^2); `tolerance`
multiplies all their scales.
"""

_STARTING = """## Starting state

The arm holds the vessel in the reference's first pose, at rest. The particles have settled in it once, when the
environment was made, and are put back there: a reset is exact and repeats bit for bit. `randomization` moves the start
of the motion and the receptacle and varies more (table below); the reference follows, so that the pour still fits.
`start="reference"` begins anywhere along the reference, in a state that an open-loop run went through.
`reset(options=...)` takes `start_offset_m` and `receptacle_offset_m` (3,), `start_index`, or a `state` from
`get_state()`.
"""

_END = """## End of an episode

* **Truncated** when the reference has ended and `settle_s` more has passed.
* **Terminated** as `termination` says: never by default in `PandaPour-v0`; in `PandaTrack-v0` when the object is lost.
* A simulation that diverges raises `PhysicsError`, which names the seed, the step and a file with the state before it.

Success (`info["is_success"]`, at every step) is at least 70% poured and at most 10% spilled (`success_poured_fraction`,
`success_spilled_fraction`); without particles, to have stayed within 5 cm and 0.3 rad of the reference to its end.
"""

_STATE = """## State

`env.unwrapped.get_state()` gives everything that the rest of the episode depends on (physics, controller, counters,
generator); `set_state()`, or `reset(options={"state": ...})`, continues exactly there. `model` and `data` are MuJoCo's.
`envs.as_dm_env(env)` puts an environment behind DeepMind's `dm_env` interface.
"""

_VECTOR = """## Many at once

`gym.make_vec("vid2demo:PandaPour-v0", num_envs=16, ...)` takes the same arguments and gives, for equal seeds and
actions, bit for bit what single environments give, whatever `num_threads` (one per processor unless given).
`reference` may be a list with one for each environment.
`autoreset_mode` is `NextStep` (default), `SameStep` (`infos` then holds `final_obs` and `final_info`) or `Disabled`
(reset what has ended with `options={"reset_mask": ...}`). Seeds, infos, `call`, `get_attr`, `set_attr` and `render` are
as in `SyncVectorEnv`.
"""

_HISTORY = """## Version history

* v0: first version.
"""

# Unit and description of what `info` always holds, and of what it holds sometimes.
INFO: dict[str, tuple[str, str]] = {
    "reward_terms": ("1", "weight x term of every term of the reward, by name"),
    "held_fraction": ("1", "share of the particles in the held vessel"),
    "poured_fraction": ("1", "share of the particles in the receptacle"),
    "spilled_fraction": ("1", "share of the particles in neither and below the receptacle's rim"),
    "position_error_m": ("m", "distance of the object's origin from the reference's"),
    "rotation_error_rad": ("rad", "smallest angle between the object and the reference, over the object's symmetry"),
    "reference_index": ("1", "knot of the reference that belongs to this moment"),
    "is_success": ("1", "whether the episode counts as a success so far"),
    "outlet": ("", "`lip`, or `spout_conduit`: particles that reach the spout's inner end leave at its tip"),
}
INFO_SOMETIMES: dict[str, tuple[str, str]] = {
    "slip_m": ("m", "with friction grasps: how far the vessel has slipped in the hand"),
    "slip_rad": ("rad", "with friction grasps: how far it has turned in the hand"),
    "start_warning": ("", "when particles run out in the start pose: how many"),
}


def page() -> str:
    """The whole page in Markdown."""
    parts = [_TOP, _summary(), "## Action space\n"]
    for mode in CONTROL_MODES:
        parts += [f'### `control_mode="{mode}"`\n', _ACTIONS[mode], entry_table(action_entries(mode, CONTROL_HZ))]
    parts += [
        "## Observation space\n",
        "A `Dict`. `env.unwrapped.observation_names` gives the names of the entries of each vector.\n",
        table(
            ("key", "there with `obs_mode`", "type", "what it is"),
            [
                ("`agent_pos`", "state, pixels, both", f"float32 ({len(AGENT_ENTRIES)},)", "the arm"),
                ("`environment_state`", "state, both", f"float32 ({len(ENVIRONMENT_ENTRIES)},)", "object, reference"),
                ("`pixels`", "pixels, both", "dict of uint8 (height, width, 3)", "an RGB picture per camera"),
            ],
        ),
        "### `agent_pos`\n",
        entry_table(AGENT_ENTRIES),
        "### `environment_state`\n",
        entry_table(ENVIRONMENT_ENTRIES),
        "## Rewards\n",
        _REWARDS,
        reward_table(),
        _STARTING,
        preset_table(RANDOMIZATIONS),
        _END,
        preset_table(TERMINATIONS),
        "## Arguments\n",
        "All are checked when the environment is made; a wrong one raises one sentence that names the mend. "
        "`PandaTrack-v0` takes the same but `num_particles` and `liquid`.\n",
        argument_table(),
        "What `liquid` may be made of, as a `Liquid` or a dict, and likewise `start`:\n",
        preset_table({"default": Liquid()}),
        preset_table({"reference": ReferenceStart()}),
        "## Info\n",
        table(
            ("name", "unit", "what it is"),
            [(f"`{name}`", unit, text) for name, (unit, text) in {**INFO, **INFO_SOMETIMES}.items()],
        ),
        _STATE,
        _VECTOR,
        _HISTORY,
    ]
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


_ACTIONS = {
    "joint_position": "Where the joints should be at the end of the step.\n",
    "joint_delta": "How far the joints' targets move in this step. The range shrinks with the control period.\n",
    "ee_delta": "How far the hand's target moves and turns in this step, in the world's axes.\n",
    "torque": "The motors' torques, held for the whole step; gravity is compensated besides.\n",
}


def _summary() -> str:
    rows = [("made by", ", ".join(f'`gym.make("vid2demo:{name}")`' for name in ENV_IDS))]
    rows.append(("action space", f"`Box({len(action_entries(CONTROL_MODES[0], CONTROL_HZ))},)` float32 in radians"))
    rows.append(("observation space", "`Dict(agent_pos, environment_state)`; pictures with `obs_mode`"))
    rows.append(("render modes", ", ".join(f"`{mode}`" for mode in PandaPourEnv.metadata["render_modes"])))
    return table(("", ""), rows)


def entry_table(entries: Sequence[Entry]) -> str:
    """Number, name, unit, frame, range and description of the entries of a vector."""
    rows = [
        (str(k), f"`{e.name}`", e.unit, e.frame, _bound(e.low), _bound(e.high), e.description)
        for k, e in enumerate(entries)
    ]
    return table(("num", "name", "unit", "frame", "min", "max", "what it is"), rows)


def reward_table() -> str:
    """Weights of every term in every mode, and the scales of the kernels."""
    scales = {field.name.split("_scale_")[0]: field.name for field in fields(RewardConfig) if "_scale_" in field.name}
    rows = []
    for name, term in TERMS.items():
        scale = ""
        if name in scales:
            unit = scales[name].split("_scale_")[1].replace("_s", "/s")
            scale = f"{getattr(RewardConfig(), scales[name]):g} {unit}"
        weights = [f"{getattr(config, name):g}" for config in REWARD_MODES.values()]
        rows.append((f"`{name}`", *weights, scale, (term.__doc__ or "").strip()))
    return table(("term", *REWARD_MODES, "scale", "what it measures"), rows)


def preset_table(presets: Mapping[str, Any]) -> str:
    """The fields of a dataclass, with their values in each preset and what its docstring says of them."""
    kind = type(next(iter(presets.values())))
    names = [field.name for field in fields(kind)]
    told = described(inspect.getdoc(kind) or "", names)
    rows = [
        (f"`{name}`", *(_plain(getattr(value, name)) for value in presets.values()), told.get(name, ""))
        for name in names
    ]
    return table((f"`{kind.__name__}`", *presets, "what it is"), rows)


def argument_table() -> str:
    """The environment's arguments, their defaults and what its docstring says of them.

    Raises ValueError when the docstring leaves one out.
    """
    parameters = {n: p for n, p in inspect.signature(PandaPourEnv.__init__).parameters.items() if n != "self"}
    told = described(inspect.getdoc(PandaPourEnv) or "", list(parameters))
    if missing := [name for name in parameters if name not in told]:
        raise ValueError(f"the docstring of PandaPourEnv does not tell of {', '.join(missing)}")
    rows = [(f"`{name}`", _plain(parameters[name].default), text) for name, text in told.items()]
    return table(("argument", "default", "what it is"), rows)


def described(text: str, names: Sequence[str]) -> dict[str, str]:
    """What a docstring says of each name: the words after `name:` or `name, other:` up to the next of them."""
    either = "|".join(names)
    head = re.compile(rf"(?:^|(?<=[.;] ))((?:{either})(?:, (?:{either}))*): ")
    told: dict[str, str] = {}
    for paragraph in text.split("\n\n")[1:]:
        # Before the first head, then each head and the words after it.
        _, *pieces = head.split(" ".join(paragraph.split()))
        for heads, words in zip(pieces[::2], pieces[1::2], strict=True):
            told |= dict.fromkeys(heads.split(", "), words.strip().rstrip(".;"))
    return told


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + " --- |" * len(head), *lines[1:]]) + "\n"


def _bound(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else ("-inf" if value < 0 else "inf")


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return f'`"{value}"`' if isinstance(value, str) else str(value)


def draw(path: Path) -> None:
    """Write the page's picture: the built-in pour half done, from each camera."""
    from PIL import Image

    env = PandaPourEnv(obs_mode="both", cameras=CAMERAS, image_size=(240, 320))
    observation, info = env.reset(seed=0)
    for action in arm_trajectory(env.reference)[1:].astype(np.float32):
        if info["poured_fraction"] < 0.5:
            observation, _, _, _, info = env.step(action)
    env.close()
    picture = Image.fromarray(np.hstack([observation["pixels"][camera] for camera in CAMERAS]))
    with atomic_path(path) as temporary:
        picture.save(temporary, quality=88, optimize=True)


if __name__ == "__main__":
    write_text(PAGE, page())
    if "--picture" in sys.argv:
        draw(PICTURE)
    print(f"written to {PAGE}")
