"""The LeRobot dataset: what is written is what was played, and damage is noticed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.demos.camera_encoder import CameraEncoder, histogram_statistics
from vid2demo.demos.dataset import DatasetLayout, write_dataset
from vid2demo.demos.episode import Episode, flatten_state, state_difference, state_digest
from vid2demo.demos.stored import (
    COLLECTION_FILE,
    check_dataset,
    count_frames,
    read_collection,
    read_columns,
    read_info,
)
from vid2demo.extract.errors import UserError

SIZE = (64, 48)
LENGTHS = (11, 7, 14)
LAYOUT = DatasetLayout(
    fps=25,
    task="pour from the kettle into the mug",
    action_names=("joint1", "joint2"),
    state_names=("q1", "q2", "q3"),
    environment_names=("tilt_rad",),
    cameras=("front", "wrist"),
    image_size=SIZE,
)


def gray_level(episode: int, t: int) -> int:
    """Frames tell which episode and step they belong to, also after lossy compression."""
    return 20 + 60 * episode + 4 * t


def make_episode(index: int) -> Episode:
    rng = np.random.default_rng(index)
    steps = LENGTHS[index]
    videos = {}
    for camera in LAYOUT.cameras:
        encoder = CameraEncoder(LAYOUT.fps)
        for t in range(steps):
            encoder.write(np.full((*SIZE, 3), gray_level(index, t), np.uint8))
        videos[camera] = encoder.finish()
    return Episode(
        seed=2**52 + index,
        options={},
        action=rng.normal(size=(steps, 2)).astype(np.float32),
        agent_pos=rng.normal(size=(steps, 3)).astype(np.float32),
        environment_state=rng.normal(size=(steps, 1)).astype(np.float32),
        reward=rng.normal(size=steps).astype(np.float32),
        success=np.arange(steps) == steps - 1,
        start_state={"qpos": rng.normal(size=4), "time_s": 0.0, "rng": {"state": 2**100 + index}},
        end_state={"qpos": rng.normal(size=4), "time_s": steps / 25, "rng": {"state": 2**100 + index}},
        videos=videos,
        summary={"poured_fraction": 0.9},
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    files = []
    for index in range(len(LENGTHS)):
        files.append(folder / f"attempt_{index}.npz")
        make_episode(index).save(files[-1])
    reference = folder / "pour.reference.npz"
    np.savez(reference, nothing=np.zeros(1))
    collection = {"seed": 0, "attempts": {"tried": 4, "succeeded": 3, "failed": {"spilled": 1}}, "versions": {}}
    write_dataset(folder / "dataset", files, LAYOUT, reference, collection)
    return folder / "dataset"


def test_lerobot_opens_it_and_every_frame_is_at_its_place(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    opened = LeRobotDataset("vid2demo/test", root=dataset)
    assert opened.num_episodes == len(LENGTHS)
    assert opened.num_frames == sum(LENGTHS)
    assert opened.fps == 25
    row = 0
    for index, steps in enumerate(LENGTHS):
        episode = make_episode(index)
        for t in range(steps):
            item = opened[row]
            assert item["episode_index"] == index
            assert item["timestamp"] == pytest.approx(t / 25)
            assert item["task"] == LAYOUT.task
            np.testing.assert_array_equal(item["action"].numpy(), episode.action[t])
            np.testing.assert_array_equal(item["observation.state"].numpy(), episode.agent_pos[t])
            assert bool(item["next.done"]) == bool(item["next.success"]) == (t == steps - 1)
            for camera in LAYOUT.cameras:
                level = float(item[f"observation.images.{camera}"].mean()) * 255
                assert level == pytest.approx(gray_level(index, t), abs=1.9), (index, t, camera)
            row += 1


def test_actions_come_back_bit_for_bit(dataset: Path) -> None:
    columns = read_columns(dataset, ["action", "episode_index", "next.reward"])
    played = np.concatenate([make_episode(index).action for index in range(len(LENGTHS))])
    assert columns["action"].dtype == np.float32
    assert columns["action"].tobytes() == played.tobytes()
    rewards = np.concatenate([make_episode(index).reward for index in range(len(LENGTHS))])
    np.testing.assert_array_equal(columns["next.reward"], rewards)


def test_statistics_are_those_of_all_rows(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    action = read_columns(dataset, ["action"])["action"]
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(axis=0, dtype=float), rtol=1e-9)
    np.testing.assert_allclose(stats["action"]["q99"], np.quantile(action, 0.99, axis=0), rtol=1e-6)
    assert stats["action"]["count"] == [sum(LENGTHS)]
    assert np.shape(stats["next.success"]["mean"]) == (1,)
    levels = np.concatenate([[gray_level(i, t) for t in range(steps)] for i, steps in enumerate(LENGTHS)]) / 255
    front = stats["observation.images.front"]
    np.testing.assert_allclose(np.squeeze(front["mean"]), levels.mean(), rtol=1e-9)
    np.testing.assert_allclose(np.squeeze(front["std"]), levels.std(), rtol=1e-9)
    np.testing.assert_allclose(np.squeeze(front["max"]), levels.max(), rtol=1e-9)
    assert np.shape(front["q50"]) == (3, 1, 1)


def test_info_names_every_entry(dataset: Path) -> None:
    info = read_info(dataset)
    assert info["robot_type"] == "panda"
    assert info["codebase_version"] == "v3.0"
    assert info["features"]["observation.environment_state"]["names"] == ["tilt_rad"]
    video = info["features"]["observation.images.wrist"]
    assert video["info"]["video.codec"] == "h264"
    assert video["info"]["video.pix_fmt"] == "yuv420p"


def test_card_has_licence_and_instructions(dataset: Path) -> None:
    text = (dataset / "README.md").read_text()
    assert text.startswith("---\nlicense: apache-2.0\n")
    assert "vid2demo replay" in text
    assert "LeRobotDataset(" in text


def test_frames_are_counted_against_rows(dataset: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    check_dataset(copy)
    path = next((copy / "videos").rglob("*.mp4"))
    assert count_frames(path) == sum(LENGTHS)
    encoder = CameraEncoder(25)
    for _ in range(sum(LENGTHS) - 1):
        encoder.write(np.zeros((*SIZE, 3), np.uint8))
    path.write_bytes(encoder.finish().mp4)
    with pytest.raises(UserError, match=f"{sum(LENGTHS) - 1} frames for {sum(LENGTHS)} rows"):
        check_dataset(copy)


@pytest.mark.parametrize("fault", ["missing", "no_collection", "garbled", "no_rows"])
def test_faults_give_one_clear_sentence(dataset: Path, tmp_path: Path, fault: str) -> None:
    import shutil

    copy = tmp_path / "copy"
    if fault != "missing":
        shutil.copytree(dataset, copy)
    if fault == "no_collection":
        (copy / COLLECTION_FILE).unlink()
    if fault == "garbled":
        (copy / COLLECTION_FILE).write_text("{")
    if fault == "no_rows":
        path = next((copy / "data").rglob("*.parquet"))
        path.write_bytes(path.read_bytes()[:-20])
    read: Callable[[Path], Any] = read_collection if fault != "no_rows" else lambda root: read_columns(root, ["action"])
    with pytest.raises(UserError, match="copy"):
        read(copy)


def test_episode_survives_the_disk(tmp_path: Path) -> None:
    episode = make_episode(0)
    episode.save(tmp_path / "episode.npz")
    loaded = Episode.load(tmp_path / "episode.npz")
    assert loaded.seed == episode.seed
    assert loaded.end_digest == episode.end_digest
    assert state_digest(loaded.start_state) == state_digest(episode.start_state)
    assert loaded.videos["front"].mp4 == episode.videos["front"].mp4
    np.testing.assert_array_equal(loaded.reward, episode.reward)


def test_replay_file_is_small_and_keeps_the_ends(tmp_path: Path) -> None:
    episode = make_episode(0)
    episode.save(tmp_path / "record.npz", replay_only=True)
    record = Episode.load(tmp_path / "record.npz")
    assert record.action.tobytes() == episode.action.tobytes()
    assert record.end_digest == episode.end_digest
    assert record.is_success
    assert not record.videos
    assert (tmp_path / "record.npz").stat().st_size < 20_000


def test_truncated_episode_is_a_user_error(tmp_path: Path) -> None:
    path = tmp_path / "episode.npz"
    make_episode(0).save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UserError, match="damaged"):
        Episode.load(path)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"qpos": np.array([1.0, np.nextafter(2.0, 3.0)])}, "qpos differs by up to 4.44e-16"),
        ({"qpos": np.array([1.0, 2.0], np.float32)}, "qpos is float32"),
        ({"rng": {"state": 4}}, "rng.state is 4 instead of 3"),
        ({"extra": np.zeros(1)}, "extra is only in the new state"),
    ],
)
def test_every_bit_of_a_state_counts(change: dict[str, Any], word: str) -> None:
    state = {"qpos": np.array([1.0, 2.0]), "rng": {"state": 3}}
    assert state_difference(state, dict(state)) == []
    assert state_digest({**state, **change}) != state_digest(state)
    assert word in state_difference(state, {**state, **change})[0]


def test_digest_does_not_hang_on_key_order() -> None:
    a = {"x": np.zeros(2), "y": {"b": 1, "a": 2}}
    b = {"y": {"a": 2, "b": 1}, "x": np.zeros(2)}
    assert state_digest(a) == state_digest(b)
    assert flatten_state(a)[1] == {"y.a": 2, "y.b": 1}


def test_histogram_statistics_agree_with_the_pixels() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 200, size=(5, 16, 16, 3)).astype(np.uint8)
    encoder = CameraEncoder(25)
    for frame in frames:
        encoder.write(frame)
    video = encoder.finish()
    statistics = histogram_statistics(video.histogram, video.frame_count)
    pixels = frames.reshape(-1, 3).astype(float)
    np.testing.assert_allclose(statistics["mean"], pixels.mean(axis=0))
    np.testing.assert_allclose(statistics["std"], pixels.std(axis=0))
    np.testing.assert_array_equal(statistics["min"], pixels.min(axis=0))
    np.testing.assert_array_equal(statistics["max"], pixels.max(axis=0))
    np.testing.assert_array_equal(statistics["q90"], np.quantile(pixels, 0.9, axis=0, method="inverted_cdf"))


def test_encoding_is_deterministic_and_checks_its_frames() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, size=(6, 32, 32, 3)).astype(np.uint8)

    def encode() -> bytes:
        encoder = CameraEncoder(25)
        for frame in frames:
            encoder.write(frame)
        return encoder.finish().mp4

    assert encode() == encode()
    encoder = CameraEncoder(25)
    encoder.write(frames[0])
    with pytest.raises(ValueError, match="shape"):
        encoder.write(frames[0, :16])
