"""What the fingers must bear: weight along the pads, its lever about the line between them, and haste on top."""

from __future__ import annotations

import numpy as np
import pytest
from vid2demo.demos.dynamics import Payload
from vid2demo.demos.grip import grip_of, slip_of
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.retarget import retarget
from vid2demo.envs.builtin import builtin_reference
from vid2demo.envs.grip import PAD_RADIUS_M
from vid2demo.envs.kinematics import panda_chain
from vid2demo.envs.panda import FINGER_MAX_N, Q_HOME_RAD
from vid2demo.envs.reference import minimum_jerk
from vid2demo.extract.geometry import Array, make_pose

POINT = np.full(3, 1e-9)
WIDE_M = 0.06


def joints_of(q_rad: Array, hz: float = 25.0) -> JointTrajectory:
    n = len(q_rad)
    return JointTrajectory(np.arange(n) / hz, q_rad, np.zeros((n, 7)), np.zeros((n, 7)), np.zeros(n))


def test_a_weight_that_hangs_between_the_pads_pulls_and_turns_nothing() -> None:
    grip = grip_of(joints_of(np.tile(Q_HOME_RAD, (20, 1))), np.eye(4), Payload(0.5, np.zeros(3), POINT), WIDE_M, False)
    assert grip.force_n == pytest.approx(0.5 * 9.81)
    assert grip.moment_nm == pytest.approx(0.0, abs=1e-9)
    assert grip.part == pytest.approx(0.5 * 9.81 / (2 * FINGER_MAX_N))
    assert "should hold" in grip.sentence()


@pytest.mark.parametrize(
    ("side", "turns"), [((0.1, 0.0, 0.0), True), ((0.0, 0.1, 0.0), False), ((0.0, 0.0, 0.1), False)]
)
def test_only_a_lever_across_the_closing_line_turns_the_vessel(side: tuple[float, float, float], turns: bool) -> None:
    """At home the hand points down: x and y of the hand are level."""
    T_hand = panda_chain().hand(Q_HOME_RAD)[0]
    assert T_hand[2, 2] == pytest.approx(-1.0, abs=1e-3)
    grip = grip_of(
        joints_of(np.tile(Q_HOME_RAD, (20, 1))), make_pose(None, side), Payload(1.0, np.zeros(3), POINT), WIDE_M, False
    )
    assert grip.moment_nm == pytest.approx(0.981 if turns else 0.0, abs=2e-3)
    assert (grip.part > 0.9) is turns
    if turns:
        assert grip.part == pytest.approx(np.hypot(9.81, 0.981 / PAD_RADIUS_M) / (2 * FINGER_MAX_N), rel=1e-3)


def test_haste_counts_like_weight() -> None:
    """Thrown upward at 5 m/s^2 a weight is half as heavy again."""
    move = minimum_jerk(np.linspace(0.0, 1.0, 26))[:, None]
    q_rad = Q_HOME_RAD + move * np.array([0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    payload = Payload(1.0, np.zeros(3), POINT)
    slow, fast = (grip_of(joints_of(q_rad, hz), np.eye(4), payload, WIDE_M, False) for hz in (1.0, 50.0))
    assert slow.force_n < 9.85
    z_m = panda_chain().hand(q_rad)[:, 2, 3]
    assert fast.force_n > 9.81 + 0.5 * np.abs(np.diff(z_m, n=2)).max() * 50.0**2
    heavy = grip_of(
        joints_of(q_rad), make_pose(None, (0.12, 0.0, 0.0)), Payload(1.5, np.zeros(3), POINT), WIDE_M, False
    )
    assert "may let the vessel slip" in heavy.sentence()
    assert heavy.part > 1.0


def test_a_lever_along_the_closing_line_is_borne_the_better_the_wider_the_vessel() -> None:
    still, aside = joints_of(np.tile(Q_HOME_RAD, (20, 1))), make_pose(None, (0.0, 0.1, 0.0))
    narrow, wide = (
        grip_of(still, aside, Payload(1.0, np.zeros(3), POINT), width_m, False) for width_m in (0.03, WIDE_M)
    )
    for grip, width_m in ((narrow, 0.03), (wide, WIDE_M)):
        assert grip.other_nm == pytest.approx(0.981, abs=2e-3)
        assert grip.part == pytest.approx((9.81 + 2 * 0.981 / width_m) / (2 * FINGER_MAX_N), rel=1e-2)
    across = grip_of(still, make_pose(None, (0.1, 0.0, 0.0)), Payload(1.0, np.zeros(3), POINT), 0.03, False)
    assert wide.part < narrow.part < across.part
    flat = grip_of(still, aside, Payload(1.0, np.zeros(3), POINT), 0.03, True)
    assert flat.part < narrow.part
    strained = grip_of(still, aside, Payload(3.0, np.zeros(3), POINT), 0.03, False)
    assert 1.0 < strained.part < 2.0
    assert "can press with, but not keep up" in strained.sentence()


def test_what_does_not_weigh_but_is_bulky_resists_being_turned() -> None:
    turn = minimum_jerk(np.linspace(0.0, 1.0, 26))[:, None] * np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    still = grip_of(joints_of(Q_HOME_RAD + turn, 50.0), np.eye(4), Payload(0.1, np.zeros(3), POINT), WIDE_M, False)
    bulky = grip_of(
        joints_of(Q_HOME_RAD + turn, 50.0), np.eye(4), Payload(0.1, np.zeros(3), np.full(3, 0.02)), WIDE_M, False
    )
    assert bulky.moment_nm > still.moment_nm + 0.1


def test_a_mug_played_by_friction_does_not_slip_under_what_the_hand_keeps_up() -> None:
    reference = builtin_reference()
    slip = slip_of(reference, retarget(reference))
    assert slip is not None
    assert slip.pressing_n == FINGER_MAX_N
    assert slip.distance_m < 0.002
    assert slip.angle_rad < np.deg2rad(1.0)
    assert "which the hand keeps up, it slips by about" in slip.sentence()


def test_what_the_fingers_cannot_close_on_has_no_slip() -> None:
    reference = builtin_reference()
    T = np.array(reference.T_hand_object)
    T[1, 3] += 0.3
    beside = reference.with_header(T_hand_object=T.tolist())
    assert slip_of(beside, retarget(reference)) is None
