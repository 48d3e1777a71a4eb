"""The environment's page says what the code does."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import vid2demo  # noqa: F401 (registers the environments)
from vid2demo.envs import docs_page
from vid2demo.envs.control import CONTROL_MODES, action_entries
from vid2demo.envs.pouring import PandaPourEnv

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def page() -> str:
    return docs_page.page()


def rows_under(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table after a heading, without its head."""
    lines = page.split(f"\n{heading}\n", 1)[1].splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("|"))
    found = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip().strip("`") for cell in line.strip("|").split(" | ")])
    return found


def test_page_in_the_repository_is_the_code_s(page: str) -> None:
    written = (ROOT / docs_page.PAGE).read_text(encoding="utf-8")
    assert written == page, "docs/environment.md is stale; run `make docs`"


def test_page_s_picture_and_environments_are_there(page: str) -> None:
    for name in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page):
        assert (ROOT / docs_page.PAGE.parent / name).is_file()
    for env_id in docs_page.ENV_IDS:
        assert gym.spec(env_id).id == env_id


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_actions_are_listed_entry_by_entry_with_the_space_s_range(page: str, mode: str) -> None:
    env = PandaPourEnv(num_particles=0, control_mode=mode)
    rows = rows_under(page, f'### `control_mode="{mode}"`')
    assert tuple(row[1] for row in rows) == env.action_names
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    for row, low, high, entry in zip(rows, space.low, space.high, action_entries(mode, 25.0), strict=True):
        assert row[2] == entry.unit
        assert np.allclose([float(row[4]), float(row[5])], [low, high], rtol=1e-4)
    env.close()


def test_observations_and_info_are_listed_entry_by_entry(page: str) -> None:
    env = PandaPourEnv(num_particles=1)
    observation, info = env.reset(seed=0)
    assert isinstance(env.observation_space, gym.spaces.Dict)
    for key, space in env.observation_space.spaces.items():
        assert isinstance(space, gym.spaces.Box)
        rows = rows_under(page, f"### `{key}`")
        assert tuple(row[1] for row in rows) == env.observation_names[key]
        assert len(rows) == len(observation[key])
        assert np.allclose([float(row[4]) for row in rows], space.low, atol=1e-4)
        assert np.allclose([float(row[5]) for row in rows], space.high, atol=1e-4)
        assert all(row[2] and row[3] and row[6] for row in rows)
    assert set(docs_page.INFO) <= set(info) <= set(docs_page.INFO) | set(docs_page.INFO_SOMETIMES)
    assert [row[0] for row in rows_under(page, "## Info")] == [*docs_page.INFO, *docs_page.INFO_SOMETIMES]
    env.close()


def test_docstring_words_go_to_the_names_they_are_about() -> None:
    text = """One line.

    near, far: distances; names: of all things. far away: not a head.
    color: any of red (warm), blue. size: in px.

    Raises nothing: at all.
    """
    told = docs_page.described(text.replace("    ", ""), ["near", "far", "names", "color", "size"])
    assert told["near"] == told["far"] == "distances"
    assert told["names"] == "of all things. far away: not a head"
    assert told["color"] == "any of red (warm), blue"
    assert told["size"] == "in px"
    assert docs_page.described("One line.", ["near"]) == {}


def test_argument_that_the_docstring_forgets_stops_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PandaPourEnv, "__doc__", "Pours.\n\nreference: a path.")
    with pytest.raises(ValueError, match="num_particles"):
        docs_page.argument_table()


def test_tables_keep_bars_inside_cells() -> None:
    @dataclass(frozen=True)
    class Choice:
        """A choice.

        which: a|b.
        """

        which: str = "a"

    presets: dict[str, Any] = {"default": Choice()}
    assert docs_page.preset_table(presets).splitlines()[-1] == '| `which` | `"a"` | a\\|b |'
