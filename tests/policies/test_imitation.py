"""LeRobot's own trainer starts on a collected dataset and learns from it."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from vid2demo.extract.errors import UserError
from vid2demo.policies.imitation import act_training_command


def test_command_needs_a_dataset(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not a LeRobot dataset"):
        act_training_command(tmp_path, tmp_path / "out")


@pytest.mark.slow
def test_lerobot_train_lowers_its_loss(pour_reference: Path, tmp_path: Path) -> None:
    from vid2demo.demos.collect import collect

    dataset = tmp_path / "dataset"
    collect(pour_reference, dataset, episodes=2, image_size=(64, 64), env_kwargs={"num_particles": 20})
    command = act_training_command(dataset, tmp_path / "training", steps=40, batch_size=8, small=True, log_freq=5)
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "HF_HOME": str(tmp_path / "hub")}
    done = subprocess.run(
        [*command, "--save_checkpoint=true", "--save_freq=40"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    losses = [float(value) for value in re.findall(r"\bloss:([0-9.]+)", done.stdout + done.stderr)]
    assert len(losses) == 8, (done.stdout + done.stderr)[-3000:]
    assert losses[-1] < 0.7 * losses[0]
    assert next((tmp_path / "training").rglob("model.safetensors")).stat().st_size > 0
