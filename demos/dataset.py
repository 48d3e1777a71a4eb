"""Writing LeRobot datasets (v3.0) whose episodes can be replayed bit for bit; `stored.py` reads them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
from .stored import (
    COLLECTION_FILE,
    COLLECTION_SCHEMA,
    COLLECTION_VERSION,
    RECORD_FOLDER,
    REFERENCE_FILE,
    check_dataset,
    read_columns,
    read_info,
)

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
    require_lerobot()
    from lerobot.datasets import lerobot_dataset

    return lerobot_dataset


def require_lerobot() -> None:
    """Raise UserError unless lerobot is installed, without the time its import takes."""
    if importlib.util.find_spec("lerobot") is None:
        raise UserError("writing datasets needs lerobot, which is not installed; run `pip install 'vid2demo[lerobot]'`")


def write_dataset(
    root: Path, episode_files: Sequence[Path], layout: DatasetLayout, reference: Path, collection: Mapping[str, Any]
) -> None:
    """Write a whole, checked dataset into `root`, which must not exist.

    episode_files: saved `Episode`s with frames, in order.  collection: what `collection.json` is to say besides the
    episodes.  The caller renames `root` to its final place: a folder under this name may be half-written.
    """
    with _quiet():
        _write_dataset(root, episode_files, layout, reference, collection)


def _write_dataset(
    root: Path, episode_files: Sequence[Path], layout: DatasetLayout, reference: Path, collection: Mapping[str, Any]
) -> None:
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
    if not hasattr(dataset.writer, "_streaming_encoder"):
        # Otherwise LeRobot would encode the blank frames it is given below.
        raise UserError("this version of lerobot keeps its encoder elsewhere; install lerobot==0.6.1")
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


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep progress bars of every single episode and the remuxer's remarks off the screen."""
    import av.logging
    import datasets

    shown = datasets.utils.is_progress_bar_enabled()
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        yield
    finally:
        if shown:
            datasets.enable_progress_bars()


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
