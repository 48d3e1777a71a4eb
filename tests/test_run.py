from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vid2demo.demos.steps import collect_stage, joints_path, reference_path
from vid2demo.extract.errors import UserError
from vid2demo.extract.progress import Progress
from vid2demo.extract.stages import Stage
from vid2demo.extract.steps import ObjectSettings, extract_stage, settings_record
from vid2demo.extract.video import VideoWriter
from vid2demo.run import RunSettings, run, stages_of

KETTLE = RunSettings(Path("coffee.mp4"), ObjectSettings("kettle"), ObjectSettings("mug"))


def test_every_stage_reads_what_the_ones_before_wrote(tmp_path: Path) -> None:
    stages = stages_of(KETTLE, tmp_path)
    assert [s.name for s in stages] == ["extract", "reference", "retarget", "simulate", "collect", "report"]
    there = {KETTLE.video}
    for stage in stages:
        assert set(stage.inputs.values()) <= there, stage.name
        there |= {tmp_path / name for name in stage.outputs}
    wanted = (
        "kettle.track.npz mug.track.npz kettle.masks.npz mug.masks.npz kettle.mask.png mug.mask.png overlay.mp4 "
        "kettle.reference.npz kettle.joints.npz feasibility.json simulation.mp4 series.json dataset report.html"
    )
    assert {path.name for path in there - {KETTLE.video}} == set(wanted.split())


def test_report_reads_everything(tmp_path: Path) -> None:
    *stages, report = stages_of(KETTLE, tmp_path)
    assert set(report.inputs.values()) == {tmp_path / name for stage in stages for name in stage.outputs}


@pytest.mark.parametrize(
    "change",
    [
        {"object": ObjectSettings("kettle", (1, 2, 3, 4))},
        {"object": ObjectSettings("kettle", mesh_unit="mm")},
        {"object": ObjectSettings("kettle", mesh_up="+y")},
        {"object": ObjectSettings("kettle", mesh_open_top=True)},
        {"camera": (500.0, 500.0, 320.0, 240.0)},
        {"seed": 1},
        {"start_frame": 3},
        {"camera_motion": "moving"},
        {"rerun": True},
        {"receptacle": None},
    ],
)
def test_what_decides_the_tracks_is_in_the_key_of_extract(tmp_path: Path, change: dict[str, object]) -> None:
    video = tmp_path / "coffee.mp4"
    video.write_bytes(b"frames")
    settings = dataclasses.replace(KETTLE, video=video)
    changed = dataclasses.replace(settings, **change)  # type: ignore[arg-type]
    assert extract_stage(settings, tmp_path).key() != extract_stage(changed, tmp_path).key()


def test_the_place_of_the_video_and_the_number_of_episodes_do_not_matter_to_extract(tmp_path: Path) -> None:
    keys = set()
    for name, episodes in (("a.mp4", 1), ("b.mp4", 9)):
        (tmp_path / name).write_bytes(b"frames")
        settings = dataclasses.replace(KETTLE, video=tmp_path / name, episodes=episodes)
        keys.add(extract_stage(settings, tmp_path).key())
    assert len(keys) == 1


def test_the_user_s_mesh_is_read_by_content(tmp_path: Path) -> None:
    video, mesh = tmp_path / "coffee.mp4", tmp_path / "kettle.stl"
    video.write_bytes(b"frames")
    mesh.write_bytes(b"one shape")
    settings = dataclasses.replace(KETTLE, video=video, object=ObjectSettings("kettle", mesh=mesh))
    before = extract_stage(settings, tmp_path).key()
    mesh.write_bytes(b"another shape")
    assert extract_stage(settings, tmp_path).key() != before


def test_the_mask_is_read_by_content(tmp_path: Path) -> None:
    video, mask = tmp_path / "coffee.mp4", tmp_path / "kettle.png"
    video.write_bytes(b"frames")
    mask.write_bytes(b"one mask")
    settings = dataclasses.replace(KETTLE, video=video, object=ObjectSettings("kettle", mask=mask))
    before = extract_stage(settings, tmp_path).key()
    mask.write_bytes(b"another mask")
    assert extract_stage(settings, tmp_path).key() != before


def test_the_number_of_episodes_is_in_the_key_of_collect(tmp_path: Path) -> None:
    reference = tmp_path / "kettle.reference.npz"
    reference.write_bytes(b"motion")
    few, many = (collect_stage(reference, tmp_path, episodes=n, seed=0).key() for n in (2, 3))
    assert few != many


@pytest.mark.parametrize(
    ("track", "stem"), [("kettle.track.npz", "kettle"), ("my.cup.track.npz", "my.cup"), ("cup.npz", "cup")]
)
def test_files_of_one_object_bear_its_name(track: str, stem: str) -> None:
    folder = Path("runs/a")
    assert reference_path(Path("x") / track, folder) == folder / f"{stem}.reference.npz"
    assert joints_path(reference_path(Path(track), folder), folder) == folder / f"{stem}.joints.npz"


def test_settings_are_recorded_as_json_knows_them() -> None:
    record = settings_record(dataclasses.replace(KETTLE, object=ObjectSettings("kettle", (1, 2, 3, 4))))
    assert record["video"] == "coffee.mp4"
    assert record["object"]["box_xywh_px"] == [1, 2, 3, 4]
    assert record["seed"] == 0


def test_a_robot_that_cannot_do_it_leaves_a_report_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def follow(progress: Progress) -> Mapping[str, Any]:
        (tmp_path / "out/kettle.track.npz").write_bytes(b"seen")
        return {}

    def refuse(progress: Progress) -> Mapping[str, Any]:
        raise UserError("out of reach by 0.3 m; try --scale 0.7")

    def short(settings: RunSettings, folder: Path) -> list[Stage]:
        return [Stage("extract", "", follow, outputs=("kettle.track.npz",)), Stage("reference", "", refuse)]

    video = tmp_path / "coffee.mp4"
    with VideoWriter(video, 25.0) as writer:
        for _ in range(2):
            writer.write(np.full((64, 64, 3), 80, np.uint8))
    monkeypatch.setattr("vid2demo.run.stages_of", short)
    with pytest.raises(UserError, match=r"try --scale 0\.7; what was done so far is in .*report\.html"):
        run(dataclasses.replace(KETTLE, video=video), tmp_path / "out")
    assert (tmp_path / "out/report.html").is_file()
