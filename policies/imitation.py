"""Training on a dataset with LeRobot: the command line, spelled out, so that a person can run it as well."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ..demos.stored import read_info

# Small enough to learn on a laptop's CPU; ACT's own sizes otherwise. Without the variational part, which is there for
# people who do the same thing in different ways: what `collect` writes is one way per start.
SMALL_ACT: dict[str, Any] = {
    "dim_model": 128,
    "dim_feedforward": 256,
    "n_heads": 4,
    "n_encoder_layers": 1,
    "use_vae": "false",
    "chunk_size": 25,
    "n_action_steps": 25,
    "optimizer_lr": 3e-4,
    "optimizer_lr_backbone": 3e-4,
}


def act_training_command(
    dataset: Path,
    out: Path,
    *,
    steps: int = 10_000,
    batch_size: int = 8,
    device: str = "cpu",
    small: bool = False,
    log_freq: int = 100,
    seed: int = 0,
) -> list[str]:
    """`lerobot-train` for ACT on a local dataset, touching neither the hub nor wandb nor pretrained weights.

    out must not exist. Run it with HF_HUB_OFFLINE=1, and on two shared cores with OMP_NUM_THREADS=1 (three times
    faster). Raises UserError when `dataset` is not a LeRobot dataset.
    """
    read_info(dataset)
    options: dict[str, Any] = {
        "dataset.repo_id": f"vid2demo/{Path(dataset).name}",
        "dataset.root": Path(dataset),
        "policy.type": "act",
        "policy.device": device,
        "policy.push_to_hub": "false",
        "policy.pretrained_backbone_weights": "null",
        "output_dir": out,
        "steps": steps,
        "batch_size": batch_size,
        "log_freq": log_freq,
        "seed": seed,
        "num_workers": 0,
        "wandb.enable": "false",
    }
    if small:
        options |= {f"policy.{name}": value for name, value in SMALL_ACT.items()}
    arguments = [f"--{name}={value}" for name, value in options.items()]
    return [sys.executable, "-m", "lerobot.scripts.lerobot_train", *arguments]
