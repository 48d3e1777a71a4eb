"""The README of a dataset, with the front matter the Hugging Face hub reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def dataset_card(task: str, features: Mapping[str, Mapping[str, Any]], fps: int, collection: Mapping[str, Any]) -> str:
    """Markdown text: what is in the dataset, how it was made, how to load and how to replay it."""
    episodes = collection["episodes"]
    rows = sum(int(episode["length"]) for episode in episodes)
    lines = [
        "---",
        "license: apache-2.0",
        "task_categories:",
        "- robotics",
        "tags:",
        "- LeRobot",
        "- panda",
        "- simulation",
        "- pouring",
        "- vid2demo",
        "configs:",
        "- config_name: default",
        "  data_files: data/*/*.parquet",
        "---",
        "",
        f"# {task[0].upper()}{task[1:]}: a Franka Panda in simulation, taught by a video",
        "",
        f"{len(episodes)} successful episodes, {rows} frames at {fps} Hz, LeRobot format v3.0. The motion comes from",
        "one video of a person; receptacle and start are randomised; every episode was replayed from its seed and",
        "actions to the bit-same end before it was written. The arm is position controlled, the liquid is granular.",
        "",
        "| column | type | entries |",
        "| --- | --- | --- |",
    ]
    for name, feature in features.items():
        lines.append(f"| `{name}` | {feature['dtype']} {tuple(feature['shape'])} | {_entries(feature)} |")
    lines += [
        "",
        "Joint angles are in rad, joint velocities in rad/s, positions in m in the robot's base frame (z up), times in",
        "s. `next.*` is what came after the row's action.",
        "",
        "## Load",
        "",
        "```python",
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset",
        'dataset = LeRobotDataset("vid2demo/dataset", root="PATH/TO/THIS/FOLDER")',
        "```",
        "",
        "## Replay",
        "",
        "```",
        "vid2demo replay PATH/TO/THIS/FOLDER",
        "```",
        "",
        "rebuilds the environment from `meta/vid2demo/` alone, plays the actions of the parquet files and compares the",
        "last simulator state with the recorded one, bit for bit.",
        "",
        "## How it was made",
        "",
        "| | |",
        "| --- | --- |",
        f"| seed | {collection['seed']} |",
        f"| attempts | {collection['attempts']['tried']} tried, {collection['attempts']['succeeded']} succeeded |",
    ]
    lines += [f"| failed: {reason} | {count} |" for reason, count in sorted(collection["attempts"]["failed"].items())]
    lines += [f"| {name} | {version} |" for name, version in sorted(collection["versions"].items())]
    return "\n".join(lines) + "\n"


def _entries(feature: Mapping[str, Any]) -> str:
    names = [str(name) for name in feature["names"]]
    if len(names) <= 16:
        return ", ".join(names)
    return f"{', '.join(names[:6])}, ... ({len(names)} in all, named in `meta/info.json`)"
