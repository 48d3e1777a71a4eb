from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from vid2demo import cli
from vid2demo.demos.check_trajectory import check, check_file, export_file
from vid2demo.demos.export import CSV_COLUMNS, commands_of, read_commands, write_csv, write_ros
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.motion import JointCurve
from vid2demo.envs.panda import ARM_JOINTS, DDDQ_MAX_RAD_S3, DDQ_MAX_RAD_S2, DQ_MAX_RAD_S, Q_HOME_RAD, TAU_MAX_NM
from vid2demo.envs.reference import minimum_jerk
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import Array

WAY = np.array([0.4, 0.3, -0.2, 0.35, 0.3, 0.4, -0.5])


def motion(seconds: float = 2.0, way: Array = WAY) -> JointTrajectory:
    """From home along `way` with minimum jerk."""
    time_s = np.arange(round(25 * seconds) + 1) / 25.0
    q = Q_HOME_RAD + minimum_jerk(time_s / time_s[-1])[:, None] * way
    curve = JointCurve(time_s, q)
    tau = 20.0 * np.ones((len(q), 7)) * np.array([1, 1, 1, 1, 0.1, 0.1, 0.1]) + np.sin(time_s)[:, None]
    return JointTrajectory(time_s, q, curve.at(time_s, 1), tau, np.full(len(q), 0.01))


def test_csv_is_a_row_a_millisecond_through_the_knots(tmp_path: Path) -> None:
    joints = motion()
    write_csv(joints, tmp_path / "a.csv")
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 2001
    for k, row in ((0, rows[0]), (10, rows[400]), (50, rows[2000])):
        assert float(row["time_s"]) == pytest.approx(joints.time_s[k])
        assert [float(row[f"q{i}_rad"]) for i in range(1, 8)] == pytest.approx(joints.q_rad[k].tolist(), abs=1e-9)
        assert [float(row[f"dq{i}_rad_s"]) for i in range(1, 8)] == pytest.approx(joints.dq_rad_s[k].tolist(), abs=1e-9)
        assert [float(row[f"tau{i}_nm"]) for i in range(1, 8)] == pytest.approx(joints.tau_nm[k].tolist(), abs=1e-9)
        assert float(row["gripper_width_m"]) == pytest.approx(0.02)


def test_the_ros_message_has_the_fields_of_the_type_and_means_the_same_motion(tmp_path: Path) -> None:
    joints = motion()
    write_ros(joints, tmp_path / "a.json")
    message = json.loads((tmp_path / "a.json").read_text())
    assert set(message) == {"header", "joint_names", "points"}
    assert message["joint_names"] == list(ARM_JOINTS)
    assert set(message["points"][0]) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
    assert message["points"][26]["time_from_start"] == {"sec": 1, "nanosec": 40_000_000}
    told, meant = read_commands(tmp_path / "a.json"), commands_of(joints)
    np.testing.assert_allclose(told.q_rad, meant.q_rad, atol=1e-9)
    np.testing.assert_allclose(told.dq_rad_s, meant.dq_rad_s, atol=1e-8)
    np.testing.assert_allclose(told.tau_nm, meant.tau_nm, atol=1e-8)


@pytest.mark.parametrize("kind", ["csv", "ros"])
def test_what_is_exported_passes_its_own_check(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    motion().save(tmp_path / "mug.joints.npz")
    assert cli.main(["export-trajectory", str(tmp_path / "mug.joints.npz"), "--format", kind]) == 0
    written = tmp_path / ("mug.csv" if kind == "csv" else "mug.ros.json")
    assert str(written) in capsys.readouterr().out
    assert cli.main(["check-trajectory", str(written)]) == 0
    told = capsys.readouterr().out
    assert "would take" in told
    assert "jerk" in told


def planted(tmp_path: Path, fault: str) -> Path:
    """A good file with one fault at 1 s."""
    write_csv(motion(), tmp_path / "bad.csv")
    rows = np.loadtxt(tmp_path / "bad.csv", delimiter=",", skiprows=1)
    q, dq, tau = rows[:, 1:8], rows[:, 8:15], rows[:, 15:22]
    beyond = np.maximum(rows[:, 0] - 1.0, 0.0)
    if fault == "jump":
        q[1000:, 2] += 0.002
    if fault == "kink":
        # Speed that is there from one millisecond to the next, too little to break the limit of speed.
        fading = np.minimum(beyond, 0.5)
        q[:, 5] += 0.1 * (fading - fading**2)
        dq[:, 5] += 0.1 * (1.0 - 2.0 * fading) * (beyond > 0)
    if fault == "torque":
        tau[1000:1010, 1] = -1.05 * TAU_MAX_NM[1]
    if fault == "torque step":
        tau[1000:, 0] += 2.0
    if fault == "position":
        q[:, 3] += 2.0 * minimum_jerk((rows[:, 0]) / 2.0) * 1.3
        dq[:, 3] = np.gradient(q[:, 3], rows[:, 0])
    if fault == "stated speed":
        dq[1000, 4] += 0.3
    if fault == "clock":
        rows[1000:, 0] += 0.004
    if fault == "gripper":
        rows[1000:, 22] = 0.09
    np.savetxt(tmp_path / "bad.csv", rows, fmt="%.13g", delimiter=",", header=",".join(CSV_COLUMNS), comments="")
    return tmp_path / "bad.csv"


@pytest.mark.parametrize(
    ("fault", "quantity", "joint"),
    [
        ("jump", "jerk", 3),
        ("kink", "acceleration", 6),
        ("torque", "torque", 2),
        ("torque step", "torque rate", 1),
        ("stated speed", "stated speed", 5),
        ("clock", "clock", None),
        ("gripper", "gripper", None),
    ],
)
def test_each_fault_is_named_with_joint_time_value_and_limit(
    tmp_path: Path, fault: str, quantity: str, joint: int | None
) -> None:
    result = check_file(planted(tmp_path, fault))
    assert not result["ok"]
    (found,) = [f for f in result["findings"] if f["quantity"] == quantity]
    assert found["time_s"] == pytest.approx(1.0, abs=0.005)
    if joint is not None:
        assert found["joint"] == joint
        assert f"joint {joint}" in found["sentence"]
    assert "s" in found["sentence"]
    if quantity in ("jerk", "acceleration", "torque", "torque rate"):
        assert abs(found["value"]) > abs(found["limit"])
        assert f"{found['limit']:.4g}" in found["sentence"]


def test_a_position_beyond_its_range_is_named(tmp_path: Path) -> None:
    found = [f for f in check_file(planted(tmp_path, "position"))["findings"] if f["quantity"] == "position"]
    assert [f["joint"] for f in found] == [4]
    assert found[0]["limit"] == pytest.approx(-0.0698)


def test_the_status_is_1_with_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check-trajectory", str(planted(tmp_path, "torque"))]) == 1
    assert "joint 2 exceeds its torque limit at 1.00" in capsys.readouterr().out


def test_motions_just_under_each_limit_pass_and_just_over_do_not() -> None:
    """A minimum-jerk way of one joint has known peaks: 1.875 L/T, 5.774 L/T^2 and 60 L/T^3."""
    for joint in range(7):
        for peak, power, limit in (
            (1.875, 1, DQ_MAX_RAD_S),
            (10.0 / 3.0**0.5, 2, DDQ_MAX_RAD_S2),
            (60.0, 3, DDDQ_MAX_RAD_S3),
        ):
            length = 0.6 if power == 1 else 0.1
            for factor, name in ((0.97, None), (1.15, ("speed", "acceleration", "jerk")[power - 1])):
                seconds = (peak * length / (factor * limit[joint])) ** (1 / power)
                time_s = np.arange(np.ceil(seconds * 1000) + 1) / 1000.0
                q = np.tile(Q_HOME_RAD, (len(time_s), 1))
                q[:, joint] -= length * minimum_jerk(time_s / seconds)
                still = np.zeros_like(q)
                commands = type(commands_of(motion()))(time_s, q, np.gradient(q, 1e-3, axis=0), still, np.zeros(len(q)))
                names = {f["quantity"] for f in check(commands)["findings"] if "joint" in f} - {"stated speed"}
                if name is None:
                    assert (("speed", "acceleration", "jerk")[power - 1]) not in names
                else:
                    assert name in names


def test_a_motion_that_starts_at_speed_is_refused() -> None:
    joints = motion()
    commands = commands_of(joints)
    cut = type(commands)(
        *(getattr(commands, n)[500:] for n in ("time_s", "q_rad", "dq_rad_s", "tau_nm", "gripper_width_m"))
    )
    assert {f["quantity"] for f in check(cut)["findings"]} >= {"acceleration", "jerk"}


def test_what_no_arm_would_take_is_not_exported(tmp_path: Path) -> None:
    motion(seconds=0.4).save(tmp_path / "fast.joints.npz")
    with pytest.raises(UserError, match=r"joint \d exceeds its .* limit at .* s: .* rad"):
        export_file(tmp_path / "fast.joints.npz", "csv")
    assert not (tmp_path / "fast.csv").exists()


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.csv", "t,q\n1,2\n", "must begin with the columns"),
        ("a.csv", "", "must begin with the columns"),
        ("a.csv", ",".join(CSV_COLUMNS) + "\n1,2,x\n", "row that is not 23 numbers"),
        (
            "a.csv",
            ",".join(CSV_COLUMNS) + "\n" + ",".join(["0"] * 23) + "\n" + ",".join(["nan"] * 23),
            "finite number in row 2",
        ),
        ("a.json", "{", "no trajectory_msgs/JointTrajectory"),
        ("a.json", '{"joint_names": ["x"], "points": []}', "no trajectory_msgs/JointTrajectory"),
        ("a.txt", "", "is no trajectory"),
        ("gone.csv", None, "cannot read"),
    ],
)
def test_bad_files_are_one_clear_error(tmp_path: Path, name: str, text: str | None, told: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=told):
        check_file(tmp_path / name)
