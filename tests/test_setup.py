"""The set-up that `make` does: which Python it takes, what it says when there is none, and what the lock may hold."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORKING = f'#!/bin/sh\nexec "{sys.executable}" "$@"\n'
BROKEN_SHIM = "#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2\nexit 127\n"
OTHER_VERSION = "#!/bin/sh\nexit 1\n"  # what the question "are you 3.12?" answers


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


def setup(tmp_path: Path, line: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a line with the functions of .ci/setup at hand, on a PATH that holds tmp_path/bin and a few tools."""
    (tmp_path / "bin").mkdir(exist_ok=True)
    tools = tmp_path / "tools"
    tools.mkdir(exist_ok=True)
    for tool in ("dirname", "bash", "sh", "id", "uname", "grep"):
        link = tools / tool
        if not link.exists():
            link.symlink_to(next(p for p in (Path("/usr/bin") / tool, Path("/bin") / tool) if p.exists()))
    environment = {"PATH": f"{tmp_path / 'bin'}:{tools}", "HOME": str(tmp_path / "home"), **variables}
    command = ["/bin/bash", "-c", f"source {ROOT / '.ci/setup'}; cd {tmp_path}; {line}"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_python_on_path_is_taken(tmp_path: Path) -> None:
    python = script(tmp_path / "bin/python3.12", WORKING)
    assert setup(tmp_path, "find_python").stdout.strip() == str(python)


def test_plain_python3_is_taken_when_it_is_a_312(tmp_path: Path) -> None:
    python = script(tmp_path / "bin/python3", WORKING)
    assert setup(tmp_path, "find_python").stdout.strip() == str(python)


def test_shim_that_does_not_run_is_passed_over_for_pyenv_s_own(tmp_path: Path) -> None:
    script(tmp_path / "bin/python3.12", BROKEN_SHIM)
    script(tmp_path / "bin/python3", OTHER_VERSION)
    python = script(tmp_path / "home/.pyenv/versions/3.12.9/bin/python3.12", WORKING)
    assert setup(tmp_path, "find_python").stdout.strip() == str(python)


def test_pyenv_elsewhere_is_asked_for_its_root(tmp_path: Path) -> None:
    script(tmp_path / "bin/pyenv", f"#!/bin/sh\necho {tmp_path}/opt/pyenv\n")
    script(tmp_path / "opt/pyenv/versions/3.12.1/bin/python3.12", BROKEN_SHIM)
    python = script(tmp_path / "opt/pyenv/versions/3.12.4/bin/python3.12", WORKING)
    assert setup(tmp_path, "find_python").stdout.strip() == str(python)
    named = script(tmp_path / "other/versions/3.12.2/bin/python3.12", WORKING)
    assert setup(tmp_path, "find_python", PYENV_ROOT=str(tmp_path / "other")).stdout.strip() == str(named)


def test_uv_is_asked_last(tmp_path: Path) -> None:
    python = script(tmp_path / "uv-has/python3.12", WORKING)
    script(tmp_path / "bin/uv", f'#!/bin/sh\n[ "$1 $2 $3" = "python find 3.12" ] && echo {python}\n')
    assert setup(tmp_path, "find_python").stdout.strip() == str(python)


def test_named_python_is_taken_or_refused(tmp_path: Path) -> None:
    script(tmp_path / "bin/python3.12", WORKING)
    mine = script(tmp_path / "mine", WORKING)
    assert setup(tmp_path, "find_python", PYTHON=str(mine)).stdout.strip() == str(mine)
    wrong = script(tmp_path / "wrong", OTHER_VERSION)
    done = setup(tmp_path, "find_python", PYTHON=str(wrong))
    assert done.returncode != 0
    assert f"PYTHON={wrong} is not a Python 3.12" in done.stderr


def test_no_python_is_one_clear_message(tmp_path: Path) -> None:
    done = setup(tmp_path, "make_venv")
    assert done.returncode != 0
    assert "no Python 3.12 found on PATH, in pyenv or through uv" in done.stderr
    assert "pyenv install 3.12" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_missing_system_libraries_are_one_line_to_type(tmp_path: Path) -> None:
    script(tmp_path / "bin/id", "#!/bin/sh\necho 1000\n")
    script(tmp_path / "bin/apt-get", "#!/bin/sh\necho must not be called >&2\nexit 1\n")
    done = setup(tmp_path, "can_render() { false; }; install_system_libraries")
    assert done.returncode != 0
    assert "sudo apt-get install -y libegl1 libgl1-mesa-dri" in done.stderr
    assert "must not be called" not in done.stderr


def test_root_installs_the_system_libraries(tmp_path: Path) -> None:
    script(tmp_path / "bin/id", "#!/bin/sh\necho 0\n")
    script(tmp_path / "bin/env", '#!/bin/sh\nshift; exec "$@"\n')
    script(tmp_path / "bin/apt-get", f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n')
    can_render = f"can_render() {{ grep -q libegl1 {tmp_path}/calls 2>/dev/null; }}"
    done = setup(tmp_path, f"{can_render}; install_system_libraries")
    assert done.returncode == 0, done.stderr
    calls = (tmp_path / "calls").read_text()
    assert re.search(r"install .*libegl1 libgl1-mesa-dri", calls)


def test_lock_holds_names_and_versions_only() -> None:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    assert [line for line in lines if not re.fullmatch(r"[a-z0-9-]+==[A-Za-z0-9.+!]+", line)] == []
    assert len(lines) == len(set(lines))


def test_lock_has_every_direct_requirement() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(r for extra in project["optional-dependencies"].values() for r in extra)]
    names = {re.split(r"[\[<>=!~ ]", requirement)[0].lower() for requirement in wanted} - {"vid2demo"}
    locked = {line.split("==")[0] for line in (ROOT / "requirements.lock").read_text().splitlines()}
    assert names <= locked


def test_scripts_are_executable_and_well_formed() -> None:
    for name in ("setup", "run"):
        path = ROOT / ".ci" / name
        assert os.access(path, os.X_OK)
        subprocess.run(["bash", "-n", path], check=True)


@pytest.mark.parametrize("verb", ["demo", "test", "test-fast", "lint", "type", "bench", "clean", "lock", "env"])
def test_make_knows_its_verbs(verb: str) -> None:
    done = subprocess.run(["make", "-n", verb], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    assert f"make {verb} " in subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True).stdout
