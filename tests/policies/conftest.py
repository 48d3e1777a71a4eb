"""References and a dataset for the policies' tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def pour_reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in pour of a mug into a bowl, as a file."""
    from vid2demo.envs.builtin import builtin_reference

    path = tmp_path_factory.mktemp("reference") / "mug.reference.npz"
    builtin_reference().save(path)
    return path
