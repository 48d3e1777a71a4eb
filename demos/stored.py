"""Reading datasets that `collect` wrote, and checking that they are whole, without loading LeRobot or torch.

Beside LeRobot's own files such a dataset holds `meta/vid2demo/`: `collection.json` (environment, settings, versions
and a digest per episode), `reference.npz` (a copy) and `episode_000000.npz` ... (seed, actions, first and last state).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..extract.errors import UserError

COLLECTION_SCHEMA = "vid2demo/collection"
COLLECTION_VERSION = 1
RECORD_FOLDER = Path("meta/vid2demo")
COLLECTION_FILE = RECORD_FOLDER / "collection.json"
REFERENCE_FILE = RECORD_FOLDER / "reference.npz"


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
    columns: dict[str, NDArray[Any]] = {}
    for name in names:
        column = pa.chunked_array([chunk for table in tables for chunk in table[name].chunks]).combine_chunks()
        nested = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
        flat = (column.flatten() if nested else column).to_numpy(zero_copy_only=False)
        columns[name] = flat.reshape(len(column), -1) if nested else flat
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

    count = 0
    try:
        with av.open(str(path)) as container:
            count = sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)
    except (OSError, av.FFmpegError, IndexError) as error:
        raise UserError(f"{path} cannot be read as a video ({error}); collect the dataset again") from error
    return count
