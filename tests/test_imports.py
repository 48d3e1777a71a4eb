"""Guards the direction of imports: extract <- envs <- demos <- policies <- the command."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("extract", "envs", "demos", "policies")
HEAVY = ("torch", "lerobot", "transformers", "ray", "pinocchio", "crocoddyl", "stable_baselines3", "onnxruntime")


def module_files(root: Path) -> dict[str, Path]:
    """Module name inside the package ("" is the package itself, "envs", "envs.panda", "cli") -> file."""
    files = {"": root / "__init__.py"} | {p.stem: p for p in root.glob("*.py") if p.stem != "__init__"}
    for room in ROOMS:
        for path in (root / room).rglob("*.py"):
            parts = path.relative_to(root).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return {name: path for name, path in files.items() if path.exists()}


def is_for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def imports_of(tree: ast.AST, at_load: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """Import statements; with `at_load` only those that run when the module is loaded."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif at_load and (is_for_types_only(node) or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
            continue
        else:
            yield from imports_of(node, at_load)


def targets(name: str, path: Path, node: ast.Import | ast.ImportFrom, known: set[str]) -> Iterator[str]:
    """Modules of the package that a relative import reaches."""
    if not isinstance(node, ast.ImportFrom) or node.level == 0:
        return
    package = name.split(".") if name else []
    if path.name != "__init__.py":
        package = package[:-1]
    base = package[: len(package) - (node.level - 1)] + (node.module.split(".") if node.module else [])
    for alias in node.names:
        full = ".".join([*base, alias.name])
        yield full if full in known else ".".join(base)


def graph(root: Path, at_load: bool) -> dict[str, set[str]]:
    files = module_files(root)
    return {
        name: {
            target
            for node in imports_of(ast.parse(path.read_text(encoding="utf-8")), at_load)
            for target in targets(name, path, node, set(files))
        }
        - {name}
        for name, path in files.items()
    }


def level(module: str) -> int:
    """Height of a module's room; the command, the run and the report stand above all rooms."""
    room = module.split(".")[0]
    return ROOMS.index(room) if room in ROOMS else len(ROOMS)


def back_edges(root: Path) -> list[str]:
    """Imports, lazy ones too, that go against the stream. The package itself only registers and tells its version."""
    return [
        f"{name} imports {target}"
        for name, reached in graph(root, at_load=False).items()
        for target in sorted(reached)
        if name and target and level(target) > level(name)
    ]


def circles(root: Path) -> list[str]:
    """Circles between modules, lazy imports included: they say that two modules are one idea."""
    edges, found = graph(root, at_load=False), []
    state: dict[str, int] = {}

    def visit(name: str, trail: list[str]) -> None:
        state[name] = 1
        for target in sorted(edges.get(name, ())):
            if target == "":
                continue
            if state.get(target) == 1:
                found.append(" -> ".join([*trail[trail.index(target) :], target]))
            elif target not in state:
                visit(target, [*trail, target])
        state[name] = 2

    for name in edges:
        if name not in state:
            visit(name, [name])
    return found


def absolute_imports(root: Path) -> list[str]:
    return [
        f"{name}: {ast.unparse(node)}"
        for name, path in module_files(root).items()
        for node in imports_of(ast.parse(path.read_text(encoding="utf-8")), at_load=False)
        if any(n.split(".")[0] == "vid2demo" for n in imported_names(node))
    ]


def heavy_imports(root: Path) -> list[str]:
    """Heavy libraries loaded with `extract`, `envs`, the package itself or the command."""
    return [
        f"{name}: {ast.unparse(node)}"
        for name, path in module_files(root).items()
        for node in imports_of(ast.parse(path.read_text(encoding="utf-8")), at_load=True)
        if level(name) not in (2, 3) and any(n.split(".")[0] in HEAVY for n in imported_names(node))
    ]


def imported_names(node: ast.Import | ast.ImportFrom) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module or ""] if node.level == 0 else []


def outside_imports(root: Path) -> dict[str, set[str]]:
    """Top-level names of other distributions -> modules that import them, lazily or not."""
    found: dict[str, set[str]] = {}
    for name, path in module_files(root).items():
        for node in imports_of(ast.parse(path.read_text(encoding="utf-8")), at_load=False):
            for imported in imported_names(node):
                top = imported.split(".")[0]
                if top and top not in sys.stdlib_module_names:
                    found.setdefault(top, set()).add(name)
    return found


CHECKS = (back_edges, circles, absolute_imports, heavy_imports)


@pytest.mark.parametrize("check", CHECKS)
def test_imports_run_one_way(check: object) -> None:
    assert callable(check)
    assert check(ROOT) == []


def test_everything_imported_is_a_requirement() -> None:
    """What is only there because another package brought it goes away without warning. lerobot brings what it names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def names(requirements: list[str]) -> set[str]:
        return {re.split(r"[\[<>=!~; ]", r)[0].lower().replace("_", "-") for r in requirements}

    extras = project["optional-dependencies"]
    # An adapter for another project's users asks for that project's package in its own error.
    own = [r for extra in ("cluster", "dm", "models", "onnx", "rerun") for r in extras[extra]]
    base, dev = names([*project["dependencies"], *own]), names(extras["dev"])
    brought = {"torch", "torchvision", "pandas", "pyarrow", "datasets", "huggingface-hub"}
    above = names([r for extra, rs in extras.items() if extra != "dev" for r in rs]) | brought
    # rerun-sdk and pin add their own folders to the path, where their metadata do not say that the modules lie.
    distributions = {"rerun": ["rerun-sdk"], "pinocchio": ["pin"], **importlib.metadata.packages_distributions()}
    for top, modules in outside_imports(ROOT).items():
        sources = {d.lower().replace("_", "-") for d in distributions.get(top, [top])}
        allowed = base if any(level(module) < 2 for module in modules) else base | above
        assert sources & allowed, f"{top} is imported by {', '.join(sorted(modules))} but is no requirement"
        assert not sources & dev, f"{top} is for development only"


def test_no_module_at_the_root_but_the_three_that_ship() -> None:
    assert {p.name for p in ROOT.glob("*.py")} == {"__init__.py", "cli.py", "run.py", "report.py"}


@pytest.mark.parametrize("module", ["vid2demo", "vid2demo.extract", "vid2demo.envs", "vid2demo.cli", "vid2demo.run"])
def test_import_loads_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"


def test_every_module_of_extract_and_envs_loads_nothing_heavy() -> None:
    modules = [f"vid2demo.{name}" for name in module_files(ROOT) if name and level(name) < 2]
    code = (
        "import importlib, sys\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_package_is_there_at_once() -> None:
    """Loose, because the machine may be busy: a heavy import would take many seconds."""
    code = "import time; t = time.process_time(); import vid2demo; print(time.process_time() - t)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert float(done.stdout) < 3.0


# The guard itself: each fault, planted in a tree of its own, must be found, and lawful code must not be accused.


def plant(root: Path, files: dict[str, str]) -> Path:
    lawful = {
        "__init__.py": "from .envs.registration import register\nregister()",
        "extract/__init__.py": "",
        "extract/track.py": "import numpy",
        "envs/__init__.py": "",
        "envs/registration.py": "def register(): ...",
        "envs/reference.py": "from ..extract.track import ObjectTrack\nfrom . import registration",
        "demos/__init__.py": "",
        "demos/dataset.py": "def write():\n    import torch\n    from ..envs.reference import Reference",
        "policies/__init__.py": "",
        "cli.py": "def main():\n    from . import __version__\n    from .demos import dataset",
    }
    for name, text in (lawful | files).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_guard_accepts_a_lawful_tree(tmp_path: Path) -> None:
    root = plant(tmp_path, {})
    assert [check(root) for check in CHECKS] == [[]] * 4
    assert graph(root, at_load=False)["envs.reference"] == {"extract.track", "envs.registration"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("extract/pose.py", "from ..envs.reference import Reference"),
        ("extract/pose.py", "from .. import envs"),
        ("extract/deep/__init__.py", "from ...demos import dataset"),
        ("extract/pose.py", "def f():\n    from ..envs import reference"),
        (
            "envs/pouring.py",
            "class A:\n    def f(self):\n        if self:\n            from ..demos.dataset import write",
        ),
        ("demos/collect.py", "try:\n    from ..policies import anything\nexcept ImportError:\n    pass"),
        ("policies/train.py", "from ..cli import main"),
        ("envs/__init__.py", "from ..run import run"),
    ],
)
def test_guard_finds_a_step_back(tmp_path: Path, name: str, text: str) -> None:
    assert len(back_edges(plant(tmp_path, {name: text, "run.py": ""}))) == 1


@pytest.mark.parametrize(
    "files",
    [
        {"envs/a.py": "from .b import x", "envs/b.py": "from . import a"},
        {
            "envs/a.py": "from .b import x",
            "envs/b.py": "from .c import x",
            "envs/c.py": "def f():\n    from .a import x",
        },
        {"envs/a.py": "from ..envs.b import x", "envs/b.py": "from .a import x"},
    ],
)
def test_guard_finds_a_circle(tmp_path: Path, files: dict[str, str]) -> None:
    (found,) = circles(plant(tmp_path, files))
    assert found.startswith("envs.a -> envs.b")
    assert found.endswith("envs.a")


@pytest.mark.parametrize(
    "text", ["import vid2demo", "import vid2demo.extract.track", "from vid2demo.extract import track"]
)
def test_guard_finds_an_absolute_import(tmp_path: Path, text: str) -> None:
    assert absolute_imports(plant(tmp_path, {"envs/pouring.py": text})) == [f"envs.pouring: {text}"]


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [
        ("extract/models.py", "import torch.nn", 1),
        ("envs/a.py", "if True:\n    from lerobot.datasets import x", 1),
        ("envs/a.py", "class A:\n    import ray", 1),
        ("cli.py", "from transformers import AutoModel", 1),
        ("extract/models.py", "def load():\n    import torch", 0),
        ("extract/models.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch", 0),
        ("policies/train.py", "import torch", 0),
    ],
)
def test_guard_finds_a_heavy_import_where_it_costs(tmp_path: Path, name: str, text: str, count: int) -> None:
    assert len(heavy_imports(plant(tmp_path, {name: text}))) == count
