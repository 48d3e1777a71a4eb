"""The paper's tables: which rows there are, what the paper prints, and what fills each row here.

Figures are those of the paper (FreePose, ICLR 2025), copied for reference; `extract.tables` puts measured ones beside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

AR_COLUMNS = {"ar": "AR", "ar_cou": "AR_CoU", "ar_ch": "AR_CH", "ar_pch": "AR_pCH"}
YCBV, HOPE, DTTD2, WILD = "YCB-V", "HOPE-Video", "DTTD2", "32 videos"


@dataclass(frozen=True)
class Row:
    """key: what `--results KEY=FILE` names it by. how: what fills it, empty where nothing does.

    paper: data set -> the figures the paper prints, in the columns' order.
    """

    key: str
    title: str
    how: str
    paper: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """One of the paper's tables. columns: name of a figure -> its heading; source: where the paper has it."""

    title: str
    source: str
    columns: Mapping[str, str]
    rows: tuple[Row, ...]


def _ours(bench: str = "", onboard: str = "", meshes: str = "MESHES", network: str = "") -> str:
    """Our own commands: meshes taken into a database, then the data set's objects found by it."""
    pull = f"vid2demo models pull {network}; " if network else ""
    features = f" --features {network}" if network else ""
    return (
        f"{pull}vid2demo meshes onboard {meshes}{features}{onboard} --out DB; "
        f"vid2demo bench pose DATASET --db DB --out OUT{bench}"
    )


_BASELINE = "run {name} with our retrieved meshes and sizes, and give its BOP csv"
_TRUE = {"bench": " --meshes true --sizes true", "onboard": " --unit mm", "meshes": "DATASET/models"}
_PAPER = "dinov2-large"
_DESCRIPTORS = {"cls": "summary", "ffa": "average"}


def _baseline(key: str, title: str, *figures: Sequence[float]) -> Row:
    return Row(key, title, _BASELINE.format(name=title), dict(zip((YCBV, HOPE, DTTD2), figures, strict=False)))


TABLES: dict[str, Table] = {
    "main": Table(
        "Comparison with other methods, meshes retrieved",
        "paper tables 1 and 10",
        AR_COLUMNS,
        (
            _baseline(
                "megapose-coarse",
                "MegaPose (coarse)",
                (23.75, 10.08, 10.65, 50.53),
                (31.77, 9.96, 6.87, 78.50),
                (26.15, 13.72, 6.67, 58.05),
            ),
            _baseline(
                "megapose",
                "MegaPose",
                (25.76, 14.01, 11.91, 51.37),
                (33.03, 13.07, 6.38, 79.64),
                (27.84, 17.73, 8.77, 57.00),
            ),
            _baseline(
                "gigapose",
                "GigaPose",
                (29.18, 11.90, 9.20, 66.45),
                (23.12, 4.15, 4.90, 60.30),
                (41.84, 39.32, 12.16, 74.00),
            ),
            _baseline(
                "foundpose",
                "FoundPose",
                (42.95, 35.40, 15.69, 77.75),
                (42.30, 31.18, 9.58, 86.13),
                (37.39, 31.32, 11.41, 69.44),
            ),
            Row(
                "ours",
                "Ours (the paper's networks)",
                _ours(" --masks proposed", network=_PAPER),
                {
                    YCBV: (49.86, 45.20, 18.53, 85.83),
                    HOPE: (45.98, 39.21, 10.72, 88.01),
                    DTTD2: (47.11, 52.10, 12.68, 76.54),
                },
            ),
            Row("classical", "Ours, classical features, true masks", _ours()),
            Row("classical-oracle", "Ours, classical features, true masks, meshes and sizes", _ours(**_TRUE)),
            Row("classical-proposed", "Ours, classical features and segmenter", _ours(" --masks proposed")),
        ),
    ),
    "retrieval": Table(
        "Which mesh is retrieved, and how",
        "paper tables 2 and 6",
        {**AR_COLUMNS, "category_percent": "top-1 [%]", "category_top5_percent": "top-5 [%]"},
        (
            Row(
                "openshape",
                "OpenShape",
                "retrieve with OpenShape and give the BOP csv",
                {YCBV: (34.51, 20.25, 10.59, 72.69)},
            ),
            *(
                Row(
                    f"{kind}-{layer}",
                    f"Ours (layer {layer}, {kind.upper()})",
                    _ours(" --descriptor " + _DESCRIPTORS[kind], f" --block {layer}", network=_PAPER),
                    {YCBV: figures},
                )
                for kind, layers in {
                    "cls": {
                        18: (46.42, 39.78, 12.49, 86.99),
                        20: (48.36, 43.46, 13.97, 87.66),
                        22: (45.05, 40.93, 16.16, 78.06),
                        24: (41.14, 36.10, 15.62, 71.68),
                    },
                    "ffa": {
                        18: (47.40, 43.68, 15.35, 83.16),
                        20: (48.46, 44.67, 17.37, 83.33),
                        22: (49.86, 45.20, 18.53, 85.83),
                        24: (46.73, 42.04, 17.32, 80.84),
                    },
                }.items()
                for layer, figures in layers.items()
            ),
            Row(
                "oracle-cls",
                "Oracle, CLS",
                _ours(**_TRUE, network=_PAPER),
                {YCBV: (63.31, 52.42, 46.43, 91.07)},
            ),
            Row(
                "oracle-ffa",
                "Oracle, FFA",
                _ours(**_TRUE, network=_PAPER),
                {YCBV: (62.93, 51.99, 45.95, 90.85)},
            ),
            Row("classical-cls", "Classical, one descriptor of the crop", _ours(" --descriptor summary")),
            Row("classical-ffa", "Classical, averaged over the foreground", _ours(" --descriptor average")),
            Row("classical-oracle", "Classical, true meshes and sizes", _ours(**_TRUE)),
            Row("moments", "Silhouette moments alone", "python bench/retrieval_baselines.py DATASET"),
            Row("chance", "Chance", ""),
        ),
    ),
    "views": Table(
        "How many views a mesh is rendered in",
        "paper table 8",
        {**AR_COLUMNS, "spacing_deg": "Avg err [deg]", "seconds_per_image": "s/image"},
        tuple(
            Row(f"views-{count}", f"{count} views", _ours(f" --views {count}", f" --views {count}"), {YCBV: figures})
            for count, figures in (
                (600, (49.86, 45.20, 18.53, 85.83, 25.0)),
                (1200, (49.66, 44.64, 19.10, 85.24, 20.0)),
                (1800, (49.10, 43.95, 18.25, 85.11, 16.0)),
            )
        ),
    ),
    "scale": Table(
        "How an object's size is found; the other recalls do not depend on it",
        "paper tables 3 and 9",
        {"ar_ch": "AR_CH", "scale_error_percent": "scale error [%]"},
        (
            Row("constant", "Constant, 10 cm", _ours(" --sizes constant"), {YCBV: (11.89,)}),
            Row("ours", "Ours (size table of this package)", _ours()),
            Row("gpt-4", "Ours, GPT-4's table", _ours(" --size-table TABLE.json"), {YCBV: (18.53,)}),
            Row("gpt-3.5", "Ours, GPT-3.5-Turbo's table", _ours(" --size-table TABLE.json"), {YCBV: (4.85,)}),
            Row("llama-3.1", "Ours, Llama-3.1-8B's table", _ours(" --size-table TABLE.json"), {YCBV: (16.92,)}),
            Row("gemma-2", "Ours, Gemma2-9B's table", _ours(" --size-table TABLE.json"), {YCBV: (6.98,)}),
            Row("true-sizes", "Retrieved meshes in their objects' true sizes", _ours(" --sizes true")),
            Row("oracle", "Oracle: true meshes and sizes", _ours(**_TRUE), {YCBV: (45.95,)}),
        ),
    ),
    "proposals": Table(
        "How objects are proposed",
        "paper table 7",
        {"scale_error_percent": "scale error [%]", "ap": "AP", "ar_at_10": "AR@10", "per_image": "proposals/image"},
        (
            Row(
                "cnos",
                "CNOS (FastSAM)",
                "run CNOS and give its segmentation JSON and poses",
                {YCBV: (118.55, 61.60, 71.80, 34.0)},
            ),
            Row(
                "ours",
                "Ours (the paper's networks)",
                _ours(" --masks proposed", network=_PAPER),
                {YCBV: (14.42, 69.70, 76.70, 6.0)},
            ),
            Row("classical", "Ours, classical segmenter", _ours(" --masks proposed")),
            Row("truth", "True masks", _ours(), {YCBV: (16.65, 100.0, 100.0)}),
        ),
    ),
    "video": Table(
        "Motion of objects in videos, errors a frame",
        "paper tables 4 and 5",
        {"e_rot": "rotation [deg]", "e_proj": "projected [% of diagonal]", "e_depth": "depth [sizes]"},
        (
            *(
                Row(key, title, f"run {title} on each frame and give compare-track's JSON", {WILD: figures})
                for key, title, figures in (
                    ("megapose-coarse", "MegaPose (coarse)", (6.866, 0.107, 0.1198)),
                    ("megapose", "MegaPose", (6.822, 0.161, 0.1192)),
                    ("foundpose", "FoundPose", (7.736, 0.405, 0.2592)),
                )
            ),
            Row(
                "ours",
                "Ours, each frame by itself",
                "vid2demo compare-track TRACK TRUTH --out FILE.json",
                {WILD: (1.719, 0.091, 0.0801)},
            ),
            Row(
                "refined",
                "Ours, refined",
                "vid2demo compare-track TRACK TRUTH --out FILE.json",
                {WILD: (1.205, 0.086, 0.0800)},
            ),
            Row("still", "An object that never moves in depth", "", {WILD: (np.nan, np.nan, 0.0289)}),
        ),
    ),
}
