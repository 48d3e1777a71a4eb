from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from vid2demo import cli
from vid2demo.demos.figure import _LABEL_PX, _TITLE_PX, ROW_PX, figure, joint_plots
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.plots import motion_rows, tries_figure
from vid2demo.demos.simulate import PANEL_HEIGHT_PX, STRIP_HEIGHT_PX
from vid2demo.envs.panda import Q_HOME_RAD, TAU_MAX_NM
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.extract.video import VideoWriter

KNOTS, HZ = 51, 25.0


def film(path: Path, fps: float, shades: list[int], height: int, width: int, left: int | None = None) -> None:
    """Frame k is gray by shades[k]; with `left`, that part of it stays black."""
    with VideoWriter(path, fps) as writer:
        for shade in shades:
            picture = np.full((height, width, 3), shade, np.uint8)
            if left is not None:
                picture[:, :left] = 0
            writer.write(picture)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A clip of 1 s that the robot takes 2 s for; its k-th frame and the robot's at that moment are equally bright."""
    time_s = np.arange(KNOTS) / HZ
    T = np.tile(np.eye(4), (KNOTS, 1, 1))
    Reference.from_poses(T, time_s, {}, video_time_s=0.5 * time_s).save(tmp_path / "mug.reference.npz")
    q = np.tile(Q_HOME_RAD, (KNOTS, 1))
    tau = np.zeros((KNOTS, 7))
    JointTrajectory(time_s, q, np.zeros_like(q), tau, np.zeros(KNOTS)).save(tmp_path / "mug.joints.npz")
    film(tmp_path / "clip.mp4", 20.0, [20 + 10 * k for k in range(20)], 96, 128)
    film(tmp_path / "overlay.mp4", 20.0, [230 - 10 * k for k in range(20)], 96, 128)
    panel = PANEL_HEIGHT_PX * 4 // 3
    shades = [20 + 4 * k for k in range(KNOTS)]
    film(tmp_path / "simulation.mp4", HZ, shades, PANEL_HEIGHT_PX + STRIP_HEIGHT_PX, 2 * panel, left=panel)
    (tmp_path / "run.json").write_text(json.dumps({"video": {"path": str(tmp_path / "clip.mp4")}}))
    return tmp_path


def shade(picture: np.ndarray, row: int, column: int, columns: int) -> float:
    """Mean gray in the middle of a cell."""
    width = (picture.shape[1] - _LABEL_PX) // columns
    y, x = _TITLE_PX + row * (ROW_PX + 4) + ROW_PX // 2, _LABEL_PX + column * width + width // 2
    return float(picture[y - 20 : y + 20, x - 20 : x + 20].mean())


def test_every_cell_shows_its_row_at_its_moment(run: Path) -> None:
    result = figure(run, (0.1, 0.5, 0.9))
    assert result["rows"] == ["input", "prediction", "simulation"]
    assert result["times_s"] == [0.1, 0.5, 0.9]
    picture = cv2.imread(str(run / "figure.png"))
    for column, t in enumerate((0.1, 0.5, 0.9)):
        assert shade(picture, 0, column, 3) == pytest.approx(20 + 200 * t, abs=4)
        assert shade(picture, 1, column, 3) == pytest.approx(230 - 200 * t, abs=4)
        # The robot is at this moment of the video after twice the time.
        assert shade(picture, 2, column, 3) == pytest.approx(20 + 4 * 2 * t * HZ, abs=6)
    assert (run / "joints.png").is_file()
    assert not list(run.glob(".*"))


def test_rows_without_a_film_are_left_out(run: Path) -> None:
    (run / "run.json").unlink()
    (run / "overlay.mp4").unlink()
    result = figure(run, columns=4)
    assert result["rows"] == ["simulation"]
    assert result["times_s"] == pytest.approx([0.0, 0.333, 0.667, 1.0], abs=1e-3)


def test_the_command_draws_the_moments_it_is_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["figure", str(run), "--times", "0.2", "0.8", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["times_s"] == [0.2, 0.8]


@pytest.mark.parametrize(
    ("times", "columns", "told"),
    [
        ((3.0,), 5, "from 0.00 to 1.00 s"),
        ((), 5, "must be 1 to 12"),
        (None, 0, "make no figure"),
        (None, 99, "make no"),
    ],
)
def test_moments_outside_the_video_are_refused(run: Path, times: tuple[float, ...], columns: int, told: str) -> None:
    with pytest.raises(UserError, match=told):
        figure(run, times, columns)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="give the folder of a run"):
        figure(tmp_path)


def test_a_joint_beyond_its_limit_is_seen_beyond_it() -> None:
    time_s = np.arange(KNOTS) / HZ
    q = np.tile(Q_HOME_RAD, (KNOTS, 1))
    tau = np.zeros((KNOTS, 7))
    plain = joint_plots(JointTrajectory(time_s, q, np.zeros_like(q), tau, np.zeros(KNOTS)))
    tau[20:30, 6] = 1.5 * TAU_MAX_NM[6]
    beyond = joint_plots(JointTrajectory(time_s, q, np.zeros_like(q), tau, np.zeros(KNOTS)))
    changed = np.argwhere((plain != beyond).any(axis=2))
    assert changed[:, 0].min() > 6 * plain.shape[0] // 8
    assert changed[:, 1].min() > 2 * plain.shape[1] // 3


def test_the_report_tells_what_is_left_to_each_limit() -> None:
    time_s = np.arange(KNOTS) / HZ
    q = np.tile(Q_HOME_RAD, (KNOTS, 1))
    tau = np.zeros((KNOTS, 7))
    tau[:, 1] = TAU_MAX_NM[1] - 12.0
    tau[25, 6] = TAU_MAX_NM[6] + 2.5
    html = motion_rows(JointTrajectory(time_s, q, np.zeros_like(q), tau, np.zeros(KNOTS)))
    assert html.count("<figure") == 3
    assert "12 N m to the limit" in html
    assert "2.5 N m beyond the limit" in html
    assert "125°/s to the limit" in html.replace("125 °/s", "125°/s")


def test_the_curve_of_pours_tried_has_a_dot_a_try_and_a_line_a_scale() -> None:
    still = {"scale": 1.0, "along_m": 0.0, "across_m": 0.0, "tip_deg": 0.0, "chosen": False}
    tries = [
        {**still, "poured": 0.5, "spilled": 0.5, "score": 0.0},
        {**still, "along_m": 0.02, "poured": 0.0, "spilled": 1.0, "score": -1.0},
        {**still, "scale": 0.85, "along_m": 0.02, "poured": 1.0, "spilled": 0.0, "score": 1.0, "chosen": True},
        {**still, "scale": 0.85, "across_m": -0.02, "poured": 0.8, "spilled": 0.05, "score": 0.75},
    ]
    html = tries_figure(tries)
    root = ElementTree.fromstring(html)
    circles = [c for c in root.iter() if c.tag.endswith("circle")]
    assert [c.get("r") == "7" for c in circles] == [False, False, True, False]
    assert ["fill:none" in str(c.get("style")) for c in circles] == [False, False, False, True]
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = ((float(c.get("cx", "nan")), float(c.get("cy", "nan"))) for c in circles)
    assert x1 == x2 > x0 == x3
    assert y0 == pytest.approx(0.5 * (y1 + y2), abs=0.1)
    assert y3 == pytest.approx(y0 + 0.75 * (y2 - y0), abs=0.1)
    assert len([p for p in root.iter() if p.tag.endswith("path") and p.get("class") == "line"]) == 2
    assert "80% poured, 5% spilled" in html
    assert all(f"path ×{scale}" in html for scale in ("1", "0.85"))
