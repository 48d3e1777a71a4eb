"""Writing and reading LeRobot datasets (v3.0) whose episodes can be replayed bit for bit.

Beside LeRobot's own files a dataset holds `meta/vid2demo/`: `collection.json` (environment, settings, versions and a
digest per episode), `reference.npz` (a copy) and `episode_000000.npz` ... (seed, actions, first and last state).
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError
from ..extract.files import sha256_of_file, write_json, write_text
from .camera_encoder import ENCODER, ENCODER_EXTRA, histogram_statistics
from .dataset_card import dataset_card
from .episode import Episode

COLLECTION_SCHEMA = "vid2demo/collection"
COLLECTION_VERSION = 1
RECORD_FOLDER = Path("meta/vid2demo")
COLLECTION_FILE = RECORD_FOLDER / "collection.json"
REFERENCE_FILE = RECORD_FOLDER / "reference.npz"
QUANTILES_PERCENT = (1, 10, 50, 90, 99)


@dataclass(frozen=True)
class DatasetLayout:
    """What every episode of a dataset has in common.

    fps: control rate, a whole number of Hz.  image_size: (height, width) in px.
    action_names, state_names, environment_names: one name per entry, no slashes.
    """

    fps: int
    task: str
    action_names: tuple[str, ...]
    state_names: tuple[str, ...]
    environment_names: tuple[str, ...]
    cameras: tuple[str, ...]
    image_size: tuple[int, int]
    robot_type: str = "panda"

    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's feature dictionary."""

        def vector(names: Sequence[str]) -> dict[str, Any]:
            if slashed := [name for name in names if "/" in name]:
                raise ValueError(f"LeRobot allows no slash in names: {slashed}")
            return {"dtype": "float32", "shape": (len(names),), "names": list(names)}

        image = {"dtype": "video", "shape": (*self.image_size, 3), "names": ["height", "width", "channels"]}
        return {
            "observation.state": vector(self.state_names),
            "observation.environment_state": vector(self.environment_names),
            **{f"observation.images.{camera}": dict(image) for camera in self.cameras},
            "action": vector(self.action_names),
            "next.reward": {"dtype": "float32", "shape": (1,), "names": ["reward"]},
            "next.success": {"dtype": "bool", "shape": (1,), "names": ["success"]},
            "next.done": {"dtype": "bool", "shape": (1,), "names": ["done"]},
        }


class _EncodedVideos:
    """Stands where LeRobot keeps its streaming encoder, and hands over files that are encoded already.

    The frames were encoded once, where they were rendered; LeRobot's own encoder would have to get them again, may
    drop frames when its queue is full, and spends more time on adaptive histograms than on encoding.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._episode: Episode | None = None

    def hand_over(self, episode: Episode) -> None:
        self._episode = episode

    def start_episode(self, **_: Any) -> None:
        pass

    def feed_frame(self, video_key: str, image: Any) -> None:
        pass

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, NDArray[np.float64]]]]:
        assert self._episode is not None
        results = {}
        for camera, video in self._episode.videos.items():
            # LeRobot removes the file's folder after it took the file.
            path = Path(tempfile.mkdtemp(dir=self._folder)) / "episode.mp4"
            path.write_bytes(video.mp4)
            statistics = histogram_statistics(video.histogram, video.frame_count)
            results[f"observation.images.{camera}"] = (path, statistics)
        return results

    def cancel_episode(self) -> None:
        pass

    def close(self) -> None:
        pass


def import_lerobot() -> Any:
    """The module `lerobot.datasets.lerobot_dataset`, set up so that nothing asks the network.

    HF_HUB_OFFLINE is set to 1 unless the user has set it. Raises UserError when lerobot is not installed.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    try:
        from lerobot.datasets import lerobot_dataset
    except ModuleNotFoundError as error:
        raise UserError(
            f"writing datasets needs {error.name}, which is not installed; run `pip install 'vid2demo[lerobot]'`"
        ) from error
    return lerobot_dataset


def write_dataset(
    root: Path, episode_files: Sequence[Path], layout: DatasetLayout, reference: Path, collection: Mapping[str, Any]
) -> None:
    """Write a whole, checked dataset into `root`, which must not exist.

    episode_files: saved `Episode`s with frames, in order.  collection: what `collection.json` is to say besides the
    episodes.  The caller renames `root` to its final place: a folder under this name may be half-written.
    """
    lerobot_dataset = import_lerobot()
    from lerobot.configs import RGBEncoderConfig

    dataset = lerobot_dataset.LeRobotDataset.create(
        repo_id=f"vid2demo/{root.name.strip('.')}",
        fps=layout.fps,
        features=layout.features(),
        root=root,
        robot_type=layout.robot_type,
        use_videos=True,
        rgb_encoder=RGBEncoderConfig(**ENCODER, extra_options=dict(ENCODER_EXTRA)),
    )
    videos = _EncodedVideos(root)
    dataset.writer._streaming_encoder = videos
    records = []
    histograms = {camera: np.zeros((3, 256), np.int64) for camera in layout.cameras}
    frame_count = 0
    (root / RECORD_FOLDER).mkdir(parents=True)
    for index, path in enumerate(episode_files):
        episode = Episode.load(path)
        _check_fits(episode, layout, path)
        videos.hand_over(episode)
        blank = np.zeros((*layout.image_size, 3), np.uint8)
        for t in range(len(episode)):
            dataset.add_frame(
                {
                    "observation.state": episode.agent_pos[t],
                    "observation.environment_state": episode.environment_state[t],
                    **{f"observation.images.{camera}": blank for camera in layout.cameras},
                    "action": episode.action[t],
                    "next.reward": episode.reward[t : t + 1],
                    "next.success": episode.success[t : t + 1],
                    "next.done": np.array([t == len(episode) - 1]),
                    "task": layout.task,
                }
            )
        dataset.save_episode()
        for camera, video in episode.videos.items():
            histograms[camera] += video.histogram
        frame_count += len(episode)
        record = root / RECORD_FOLDER / f"episode_{index:06d}.npz"
        episode.save(record, replay_only=True)
        records.append(
            {
                "file": record.name,
                "sha256": sha256_of_file(record),
                "seed": episode.seed,
                "length": len(episode),
                "end_digest": episode.end_digest,
                "summary": dict(episode.summary),
            }
        )
    dataset.finalize()
    shutil.rmtree(root / "images", ignore_errors=True)
    _write_exact_stats(root, layout, histograms, frame_count)
    shutil.copyfile(reference, root / REFERENCE_FILE)
    whole = {"schema": COLLECTION_SCHEMA, "version": COLLECTION_VERSION, **collection, "episodes": records}
    write_json(root / COLLECTION_FILE, whole)
    write_text(root / "README.md", dataset_card(layout.task, layout.features(), layout.fps, whole))
    check_dataset(root)


def _check_fits(episode: Episode, layout: DatasetLayout, path: Path) -> None:
    widths = (
        ("action", episode.action, layout.action_names),
        ("agent_pos", episode.agent_pos, layout.state_names),
        ("environment_state", episode.environment_state, layout.environment_names),
    )
    for name, value, names in widths:
        if value.shape[1:] != (len(names),) or not np.all(np.isfinite(value)):
            raise ValueError(f"{path}: {name} must be finite of width {len(names)}, got shape {value.shape}")
    if set(episode.videos) != set(layout.cameras):
        raise ValueError(f"{path} has cameras {sorted(episode.videos)}, expected {sorted(layout.cameras)}")


def _write_exact_stats(
    root: Path, layout: DatasetLayout, histograms: Mapping[str, NDArray[np.int64]], frame_count: int
) -> None:
    """Replace LeRobot's running statistics, whose quantiles over several episodes are wrong, by exact ones."""
    from lerobot.datasets.io_utils import write_stats

    info = read_info(root)
    numeric = [name for name, feature in info["features"].items() if feature["dtype"] not in ("video", "image")]
    stats: dict[str, dict[str, NDArray[np.float64]]] = {}
    for name, column in read_columns(root, numeric).items():
        values = column.reshape(len(column), -1).astype(np.float64)
        stats[name] = {
            "min": values.min(axis=0),
            "max": values.max(axis=0),
            "mean": values.mean(axis=0),
            "std": values.std(axis=0),
            "count": np.array([len(values)]),
            **{f"q{percent:02d}": np.quantile(values, percent / 100, axis=0) for percent in QUANTILES_PERCENT},
        }
    for camera in layout.cameras:
        stats[f"observation.images.{camera}"] = {
            name: value if name == "count" else value.reshape(3, 1, 1) / 255.0
            for name, value in histogram_statistics(histograms[camera], frame_count).items()
        }
    write_stats(stats, root)


def read_info(root: Path) -> dict[str, Any]:
    """`meta/info.json`. Raises UserError when `root` is not a LeRobot dataset of version 3."""
    path = Path(root) / "meta/info.json"
    if not path.is_file():
        raise UserError(f"{root} is not a LeRobot dataset (no meta/info.json); name the folder `collect` wrote")
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}); collect the dataset again") from error
    if not str(info.get("codebase_version", "")).startswith("v3"):
        raise UserError(f"{root} has format {info.get('codebase_version')!r}, expected v3.0")
    return dict(info)


def read_collection(root: Path) -> dict[str, Any]:
    """`collection.json`. Raises UserError when the dataset was not written by this project or is damaged."""
    read_info(root)
    path = Path(root) / COLLECTION_FILE
    if not path.is_file():
        raise UserError(f"{root} is a LeRobot dataset without {COLLECTION_FILE}: only what `collect` wrote can replay")
    try:
        collection = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}); collect the dataset again") from error
    if collection.get("schema") != COLLECTION_SCHEMA or int(collection.get("version", 0)) > COLLECTION_VERSION:
        raise UserError(
            f"{path} has schema {collection.get('schema')!r} version {collection.get('version')}, this program reads "
            f"{COLLECTION_SCHEMA!r} up to {COLLECTION_VERSION}; update vid2demo"
        )
    return dict(collection)


def read_columns(root: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of all rows in order, (rows,) or (rows, width), straight from the parquet files."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted((Path(root) / "data").glob("*/*.parquet"))
    if not files:
        raise UserError(f"{root} holds no data (no data/*/*.parquet); collect the dataset again")
    try:
        tables = [pq.read_table(path, columns=list(names)) for path in files]
    except (pa.ArrowException, OSError, KeyError) as error:
        raise UserError(f"the rows of {root} cannot be read ({error}); collect the dataset again") from error
    if missing := [name for name in names if name not in tables[0].column_names]:
        raise UserError(f"{root} lacks the columns {', '.join(missing)}; collect the dataset again")
    columns = {}
    for name in names:
        column = pa.chunked_array([chunk for table in tables for chunk in table[name].chunks]).combine_chunks()
        if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
            columns[name] = np.asarray(column.flatten()).reshape(len(column), -1)
        else:
            columns[name] = np.asarray(column.to_numpy(zero_copy_only=False))
    return columns


def check_dataset(root: Path) -> None:
    """Raise UserError unless rows, episodes and the frames of every mp4 agree in number and time."""
    import pyarrow.parquet as pq

    info = read_info(root)
    fps = int(info["fps"])
    episode_index = read_columns(root, ["episode_index"])["episode_index"]
    lengths = np.bincount(episode_index, minlength=int(info["total_episodes"]))
    if len(episode_index) != info["total_frames"] or len(lengths) != info["total_episodes"]:
        raise UserError(
            f"{root} has {len(episode_index)} rows in {len(lengths)} episodes, its info.json says "
            f"{info['total_frames']} in {info['total_episodes']}; collect the dataset again"
        )
    rows = [
        row for path in sorted((root / "meta/episodes").glob("*/*.parquet")) for row in pq.read_table(path).to_pylist()
    ]
    for key in (name for name, feature in info["features"].items() if feature["dtype"] == "video"):
        expected: dict[Path, int] = {}
        for row in rows:
            place = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            path = root / info["video_path"].format(video_key=key, **place)
            start = expected.get(path, 0)
            if abs(row[f"videos/{key}/from_timestamp"] * fps - start) > 1e-3:
                raise UserError(
                    f"episode {row['episode_index']} of {root} starts in {path.name} of {key} at "
                    f"{row[f'videos/{key}/from_timestamp']} s instead of {start / fps} s; collect the dataset again"
                )
            expected[path] = start + int(lengths[row["episode_index"]])
        for path, count in expected.items():
            if (found := count_frames(path)) != count:
                raise UserError(f"{path} has {found} frames for {count} rows; collect the dataset again")


def count_frames(path: Path) -> int:
    """Number of frames in a video file, counted and not believed from its header."""
    import av

    try:
        with av.open(str(path)) as container:
            return sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)
    except (OSError, av.FFmpegError, IndexError) as error:
        raise UserError(f"{path} cannot be read as a video ({error}); collect the dataset again") from error
