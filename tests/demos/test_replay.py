"""Replay: bit-same from the dataset alone, and every deviation is noticed and named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from vid2demo.demos.replay import as_text, replay, version_notes
from vid2demo.demos.stored import COLLECTION_FILE, RECORD_FOLDER, REFERENCE_FILE
from vid2demo.extract.errors import UserError
from vid2demo.extract.stages import versions


@pytest.fixture
def copied(pour_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pour_dataset, tmp_path / "moved elsewhere"))


def change_action(dataset: Path, row: int, by_rad: float) -> None:
    path = next((dataset / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    actions = np.stack(table["action"].to_numpy())
    actions[row, 3] += np.float32(by_rad)
    column = table.schema.get_field_index("action")
    field = table.schema.field(column)
    changed = pa.chunked_array([pa.array(actions.tolist(), type=field.type)])
    pq.write_table(table.set_column(column, field, changed), path)


def test_every_episode_ends_bit_for_bit_the_same(copied: Path) -> None:
    report = replay(copied)
    assert (report["episodes"], report["same_end"], report["success"]) == (2, 2, 2)
    assert report["notes"] == []
    assert all(detail["differences"] == [] for detail in report["details"])
    assert "2 of 2 episodes end bit for bit" in as_text(report)
    json.dumps(report, allow_nan=False)


def test_chosen_episodes_only(copied: Path) -> None:
    told: list[str] = []
    report = replay(copied, [1], progress=lambda done, total, text: told.append(f"{done}/{total}"))
    assert [detail["episode"] for detail in report["details"]] == [1]
    assert told == ["1/1"]
    with pytest.raises(UserError, match="episodes 0 to 1, there is no episode 2"):
        replay(copied, [2])


def test_one_changed_action_is_noticed(copied: Path) -> None:
    change_action(copied, row=40, by_rad=1e-3)
    report = replay(copied)
    assert report["same_end"] == 1
    first, second = report["details"]
    assert not first["same_end"]
    assert "1 actions are not those played (first at step 40, by up to 0.001 rad)" in first["differences"][0]
    assert any("at the end, simulation.physics differs" in words for words in first["differences"])
    assert second["same_end"]


def test_changed_seed_shows_at_the_start(copied: Path) -> None:
    from vid2demo.demos.episode import Episode
    from vid2demo.extract.files import sha256_of_file

    path = copied / RECORD_FOLDER / "episode_000000.npz"
    episode = Episode.load(path)
    object.__setattr__(episode, "seed", episode.seed + 1)
    episode.save(path, replay_only=True)
    collection = json.loads((copied / COLLECTION_FILE).read_text())
    collection["episodes"][0]["sha256"] = sha256_of_file(path)
    (copied / COLLECTION_FILE).write_text(json.dumps(collection))
    (detail,) = replay(copied, [0])["details"]
    assert not detail["same_end"]
    assert any(words.startswith("at the start, ") for words in detail["differences"])


@pytest.mark.parametrize("victim", [REFERENCE_FILE, RECORD_FOLDER / "episode_000001.npz"])
@pytest.mark.parametrize("fault", ["missing", "damaged"])
def test_damage_is_named(copied: Path, victim: Path, fault: str) -> None:
    path = copied / victim
    if fault == "missing":
        path.unlink()
    else:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    with pytest.raises(UserError, match=f"{victim.name} is {fault}"):
        replay(copied)


def test_other_versions_are_named() -> None:
    here = versions()
    assert version_notes(here) == []
    (note,) = version_notes({**here, "mujoco": "3.1.0", "av": "1"})
    assert "mujoco 3.1.0" in note
    assert here["mujoco"] in note


def test_foreign_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no meta/info\.json"):
        replay(tmp_path)
