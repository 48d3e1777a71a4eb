"""Jobs over processes and over Ray: every one once, a worker's death costs only the job that caused it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from vid2demo.cli import main
from vid2demo.extract.errors import UserError
from vid2demo.extract.mesh_sources import find_sources
from vid2demo.extract.mesh_store import MeshStore
from vid2demo.extract.onboarding import onboard
from vid2demo.extract.parallel import in_processes, on_cluster, ray_cluster
from vid2demo.extract.templates import ViewSettings

FRAGILE = """
import os, signal

def work(job):
    if job == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    if job == -1:
        raise ValueError("a fault of the code")
    return job * job
"""


@pytest.fixture
def fragile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that other processes can import, whose process dies of one job."""
    (tmp_path / "fragile_work.py").write_text(FRAGILE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return importlib.import_module("fragile_work").work


def test_one_worker_needs_no_process_and_keeps_the_order(fragile: Any) -> None:
    assert list(in_processes(fragile, [3, 1, 2], 1)) == [(3, 9), (1, 1), (2, 4)]


@pytest.mark.slow
def test_a_worker_that_dies_costs_one_job_and_no_other(fragile: Any) -> None:
    found = dict(in_processes(fragile, list(range(12)), 2))
    assert found == {job: None if job == 7 else job * job for job in range(12)}


def test_a_fault_of_the_code_is_not_hidden(fragile: Any) -> None:
    with pytest.raises(ValueError, match="fault of the code"):
        list(in_processes(fragile, [1, -1, 2], 2))


def test_a_cluster_that_is_not_there_is_named(fragile: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "no address at all")
    with pytest.raises(UserError, match="no address at all"):
        list(on_cluster(fragile, [1], 1))


@pytest.mark.slow
def test_ray_gives_what_processes_give(
    tmp_path: Path, fragile: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Starting Ray takes most of it, so one test says all; one CPU, for each worker loads what the command loads."""
    for k in range(2):
        trimesh.creation.box([0.1, 0.05 + 0.01 * k, 0.03]).export(tmp_path / f"box_{k}.ply")
    with ray_cluster(1):
        words = ["meshes", "onboard", str(tmp_path), "--views", "4", "--out", str(tmp_path / "ray")]
        assert main([*words, "--ray"]) == 0
        assert "2 meshes stored" in capsys.readouterr().out
        # A task that dies costs its job and no other; what the cluster has not is refused.
        assert dict(on_cluster(fragile, [6, 7, 8], 1)) == {6: 36, 7: None, 8: 64}
        with pytest.raises(ValueError, match="fault of the code"):
            list(on_cluster(fragile, [1, -1], 1))
        with pytest.raises(UserError, match="--gpus 1 is more than the 0"):
            list(on_cluster(fragile, [1], 1, gpus=1))
    again = onboard(find_sources(tmp_path), tmp_path / "one", settings=ViewSettings(count=4))
    assert len(again.stored) == 2
    ray, one = (MeshStore.open(tmp_path / name).index() for name in ("ray", "one"))
    assert ray.keys == one.keys
    np.testing.assert_array_equal(ray.summary, one.summary)
    assert MeshStore.open(tmp_path / "ray").check() == []
