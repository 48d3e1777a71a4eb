from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from vid2demo.demos.feasibility import feasibility, without_contact
from vid2demo.demos.joints import JointTrajectory
from vid2demo.demos.retarget import retarget
from vid2demo.envs.builtin import builtin_reference, pour_reference
from vid2demo.envs.clearance import overlaps_m
from vid2demo.envs.kinematics import configuration_near, panda_chain
from vid2demo.envs.panda import DQ_MAX_RAD_S, Q_HOME_RAD, Q_MAX_RAD, TAU_MAX_NM
from vid2demo.envs.reference import Reference, minimum_jerk, vessel_to_header
from vid2demo.extract.geometry import Array, make_pose
from vid2demo.extract.vessels import make_vessel


def moved(target_rad: Array, knots: int = 51, strict: bool = True) -> tuple[Reference, JointTrajectory]:
    """The reference that the arm makes itself on its way from home to a configuration, and its retargeting."""
    q = Q_HOME_RAD + minimum_jerk(np.linspace(0, 1, knots))[:, None] * (target_rad - Q_HOME_RAD)
    T_hand_object = make_pose(None, (0.0, 0.0, 0.05))
    header = {
        "vessel": vessel_to_header(make_vessel("mug")),
        "T_hand_object": T_hand_object.tolist(),
        "q_start_rad": q[0].tolist(),
        "notes": ["The receptacle stands where it was seen."],
        "scale": 0.9,
        "time_stretch": 1.25,
    }
    reference = Reference.from_poses(panda_chain().hand(q) @ T_hand_object, np.arange(knots) / 25.0, header)
    return reference, retarget(reference, strict=strict)


def lowered(bottom_m: float) -> tuple[Reference, JointTrajectory]:
    """An upright mug brought down until its foot is so far above the table, and up again."""
    mug = make_vessel("mug")
    T_hand_object = make_pose(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.02))
    down = np.minimum(np.arange(51), 50 - np.arange(51)) / 25
    T = np.tile(np.eye(4), (51, 1, 1))
    T[:, :3, 3] = (0.5, 0.0, 0.5 * mug.extents_m[2] + bottom_m)
    T[:, 2, 3] += 0.15 * (1.0 - minimum_jerk(down))
    header = {
        "vessel": vessel_to_header(mug),
        "T_hand_object": T_hand_object.tolist(),
        "q_start_rad": configuration_near(T[0], T_hand_object, Q_HOME_RAD).tolist(),
    }
    reference = Reference.from_poses(T, np.arange(51) / 25.0, header)
    return reference, retarget(reference)


@pytest.fixture(scope="module")
def easy() -> tuple[Reference, JointTrajectory]:
    return moved(Q_HOME_RAD + np.array([0.4, 0.2, 0.0, 0.2, 0.0, 0.3, 0.2]))


def test_an_easy_motion_is_feasible_and_told_in_words(easy: tuple[Reference, JointTrajectory]) -> None:
    findings = feasibility(*easy)
    assert findings["feasible"] is True
    assert findings["words"][0] == "The arm can do this motion."
    assert "The receptacle stands where it was seen." in findings["words"]
    assert any("1.25 times as long as the human" in sentence for sentence in findings["words"])
    assert all(sentence.endswith(".") for sentence in findings["words"])
    assert findings["scale"] == 0.9
    json.dumps(findings, allow_nan=False)


def test_figures_are_those_of_the_trajectory(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    findings = feasibility(reference, joints)
    margins = findings["joint_limit_margin_rad"]
    assert [entry["joint"] for entry in margins] == [1, 2, 3, 4, 5, 6, 7]
    last = margins[0]
    assert last["value"] == pytest.approx(float((Q_MAX_RAD - joints.q_rad)[:, 0].min()))
    assert last["at_s"] == pytest.approx(joints.time_s[int(joints.q_rad[:, 0].argmax())])
    speed = np.abs(joints.dq_rad_s) / DQ_MAX_RAD_S
    assert [entry["value"] for entry in findings["speed_part_of_limit"]] == pytest.approx(speed.max(axis=0).tolist())
    assert findings["position_error_m"]["max"] < 1e-4


def test_every_broken_limit_is_named(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    q, dq, tau = joints.q_rad.copy(), joints.dq_rad_s.copy(), joints.tau_nm.copy()
    q[20, 4] = 3.1
    dq[10, 6] = 1.2 * DQ_MAX_RAD_S[6]
    tau[30, 1] = -1.1 * TAU_MAX_NM[1]
    findings = feasibility(reference, dataclasses.replace(joints, q_rad=q, dq_rad_s=dq, tau_nm=tau))
    assert findings["feasible"] is False
    verdict = findings["words"][0]
    assert "joint 5 exceeds its position limit" in verdict
    assert "joint 7 exceeds its speed limit" in verdict
    assert "joint 2 exceeds its torque limit" in verdict


def test_a_lagging_arm_is_told_with_distance_and_time(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    late = dataclasses.replace(joints, q_rad=np.concatenate([joints.q_rad[:1].repeat(8, axis=0), joints.q_rad[:-8]]))
    findings = feasibility(reference, late)
    assert findings["feasible"] is False
    assert "cm off the reference (at " in findings["words"][0]


def test_collisions_make_it_infeasible_and_carried_higher_it_can() -> None:
    """A mug set down with its foot 15 mm below the table's top."""
    reference, joints = lowered(-0.015)
    findings = feasibility(reference, joints)
    (hit,) = findings["collisions"]
    assert {hit["first"], hit["second"]} == {"vessel", "table"}
    assert hit["depth_m"] == pytest.approx(0.015, abs=2e-3)
    assert hit["time_s"] == pytest.approx(1.0, abs=0.1)
    assert findings["feasible"] is False
    assert "the vessel touches the table at 1.0 s" in findings["words"][0]
    variant = findings["variant"]
    assert variant["words"] == "Carried 2 cm higher, it can."
    assert variant["distance_m"] == {"mean": pytest.approx(0.02), "max": pytest.approx(0.02)}
    assert feasibility(*lowered(0.01))["feasible"] is True


def test_a_small_touch_of_the_table_is_given_way_to_and_told() -> None:
    reference, _ = lowered(-0.004)
    freed = without_contact(reference)
    np.testing.assert_allclose(freed.T_world_object[:, :3, 3] - reference.T_world_object[:, :3, 3], [[0, 0, 0.01]] * 51)
    found = feasibility(freed, retarget(freed))
    assert found["feasible"] is True
    contact = found["changed"]["contact"]
    assert (contact["raised_m"], contact["receptacle_moved_m"]) == (0.01, 0.0)
    (touch,) = contact["freed_of"]
    assert touch["depth_m"] == pytest.approx(0.004, abs=1e-3)
    told = next(words for words in found["words"] if "raised by 1 cm" in words)
    assert "would touch the" in told
    assert "(4 mm deep at 1.0 s)" in told
    # Nothing is done where nothing is wrong, nor where it takes more than a little.
    for bottom_m in (0.01, -0.07):
        kept = lowered(bottom_m)[0]
        assert without_contact(kept) is kept


def test_a_receptacle_that_is_touched_from_the_side_is_moved_aside() -> None:
    reference, _ = lowered(0.03)
    bowl, mug = make_vessel("bowl"), make_vessel("mug")
    lowest = reference.T_world_object[25]

    def beside(aside_m: float) -> Array:
        return make_pose(None, (lowest[0, 3], lowest[1, 3] + aside_m, 0.5 * bowl.extents_m[2]))

    near_m, far_m = 0.05, 0.25
    while far_m - near_m > 2e-4:
        middle_m = 0.5 * (near_m + far_m)
        deep = overlaps_m(mug, bowl, lowest[None], beside(middle_m))[0] > 0.004
        near_m, far_m = (middle_m, far_m) if deep else (near_m, middle_m)
    T = beside(near_m)
    touching = reference.with_header(receptacle={**vessel_to_header(bowl), "T_world_receptacle": T.tolist()})
    freed = without_contact(touching)
    contact = freed.header["changed"]["contact"]
    assert contact["freed_of"][0]["depth_m"] == pytest.approx(0.004, abs=1e-3)
    assert contact["receptacle_moved_m"] == pytest.approx(0.01)
    np.testing.assert_allclose(freed.T_world_receptacle[:3, 3] - T[:3, 3], [0.0, 0.01, 0.0], atol=1e-9)
    np.testing.assert_array_equal(freed.T_world_object, reference.T_world_object)
    assert "the receptacle was moved by 1 cm" in freed.notes[-1]
    assert overlaps_m(mug, bowl, lowest[None], freed.T_world_receptacle)[0] <= 0.002
    assert feasibility(freed, retarget(freed))["feasible"] is True


def test_a_vessel_that_meets_the_receptacle_on_its_way_is_told() -> None:
    """It goes down through the place where a bowl is put, and not through the one beside it."""
    reference, joints = lowered(0.05)
    bowl = make_vessel("bowl")
    there = reference.T_world_object[25, :3, 3]
    for aside_m, meets in ((0.0, False), (0.07, True), (0.25, False)):
        T = make_pose(None, (there[0], there[1] + aside_m, 0.5 * bowl.extents_m[2]))
        placed = reference.with_header(receptacle={**vessel_to_header(bowl), "T_world_receptacle": T.tolist()})
        pairs = [{c["first"], c["second"]} for c in feasibility(placed, joints)["collisions"]]
        assert ({"vessel", "receptacle"} in pairs) is meets


def test_tight_margins_are_warned_of(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    q = joints.q_rad.copy()
    q[30, 6] = Q_MAX_RAD[6] - 0.02
    findings = feasibility(reference, dataclasses.replace(joints, q_rad=q))
    assert any("tight" in sentence for sentence in findings["words"])


def test_different_clocks_are_refused(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    with pytest.raises(ValueError, match="knots"):
        feasibility(reference.stretched(2.0), joints)


def test_every_limit_is_told_with_its_margin(easy: tuple[Reference, JointTrajectory]) -> None:
    findings = feasibility(*easy)
    limits = findings["limits"]
    assert set(limits) == {"position", "speed", "acceleration", "jerk", "torque", "torque rate"}
    for entry in limits.values():
        assert 0.0 < entry["part"] < 1.0
        assert entry["margin"] == pytest.approx(1.0 - entry["part"])
    assert limits["speed"]["part"] == pytest.approx(
        max(entry["value"] for entry in findings["speed_part_of_limit"]), rel=0.02
    )
    assert findings["variant"] is None


def test_reach_is_the_flange_s_and_stands_beside_its_limit(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    frames = panda_chain().frames(joints.q_rad)
    flange_m = (frames[:, 6] @ np.array([0.0, 0.0, 0.107, 1.0]))[:, :3]
    far_m = np.linalg.norm(flange_m - frames[:, 1, :3, 3], axis=1)
    findings = feasibility(reference, joints)
    reach = findings["reach"]
    assert reach["value_m"] == pytest.approx(far_m.max(), abs=1e-4)
    assert reach["at_s"] == joints.time_s[int(far_m.argmax())]
    assert reach["margin_m"] == pytest.approx(0.855 - far_m.max(), abs=1e-4)
    assert any("of the 85.5 cm that the arm reaches" in words for words in findings["words"])


@pytest.mark.slow
def test_a_saucepan_that_fingers_cannot_hold_is_said_to_slip_and_by_how_much() -> None:
    reference = pour_reference(make_vessel("saucepan"), make_vessel("bowl"))
    findings = feasibility(reference, retarget(reference))
    grip = findings["grip"]
    assert grip["part"] > 1.0
    assert grip["slip_m"] > 0.003
    assert 70.0 < grip["pressing_n"] <= 140.0
    told = f"more than the hand keeps up, it slips by about {1000 * grip['slip_m']:.1f} mm"
    assert any(told in words for words in findings["words"])


def test_errors_are_told_before_in_and_after_the_pour() -> None:
    reference = builtin_reference()
    joints = retarget(reference, solver="mink")
    q = joints.q_rad.copy()
    pour = reference.pour_index
    q[pour, 0] += 0.01
    phases = feasibility(reference, dataclasses.replace(joints, q_rad=q))["phases"]
    assert [phase["name"] for phase in phases] == ["carry", "pour", "return"][: len(phases)]
    worst = max(phases, key=lambda phase: float(phase["position_error_m"]["max"]))
    assert worst["name"] == "pour"
    assert worst["from_s"] <= reference.time_s[pour] <= worst["to_s"]
    assert phases[0]["position_error_m"]["max"] < 1e-3


def test_too_fast_a_motion_comes_with_the_nearest_that_is_not() -> None:
    reference, joints = moved(Q_HOME_RAD + np.array([0.8, 0.4, 0.0, 0.4, 0.0, 0.6, 0.4]), knots=14, strict=False)
    findings = feasibility(reference, joints)
    assert findings["feasible"] is False
    assert "exceeds its acceleration limit" in findings["words"][0]
    factor = findings["variant"]["time_stretch"]
    assert 1.05 < factor < 4.0
    assert f"--speed {1 / factor:.2f}" in findings["words"][1]
    slow = reference.stretched(factor)
    assert feasibility(slow, retarget(slow))["feasible"] is True


def test_too_heavy_and_too_wide_are_told_with_both_numbers(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, _ = easy
    heavy = retarget(reference, contents_kg=4.0, strict=False)
    verdict = feasibility(reference, heavy)["words"][0]
    assert "weigh 4.3 kg, the arm carries 3 kg at most" in verdict
    wide = reference.with_header(grasp={"kind": "body", "width_m": 0.1, "fits": False})
    findings = feasibility(wide, retarget(wide))
    assert findings["feasible"] is False
    assert "10.0 cm wide where it is held, the fingers open to 7.8 cm" in findings["words"][0]
    assert findings["variant"] is None
    less = feasibility(reference, heavy)["variant"]
    assert "With at most 2.6" in less["words"]
    assert feasibility(reference, retarget(reference, contents_kg=less["contents_kg"]))["feasible"] is True


def test_what_was_changed_is_told_in_numbers(easy: tuple[Reference, JointTrajectory]) -> None:
    reference, joints = easy
    changed = feasibility(reference, joints)["changed"]
    assert changed["scale"] == 0.9
    assert changed["receptacle_moved_m"] == changed["tipped_further_rad"] == 0.0
    tried = {"along_m": 0.03, "across_m": -0.04, "tip_deg": 20.0, "chosen": True}
    searched = reference.with_header(scale_search=[{**tried, "chosen": False, "tip_deg": 0.0}, tried])
    found = feasibility(searched, joints)["changed"]
    assert found["receptacle_moved_m"] == pytest.approx(0.05)
    assert found["tipped_further_rad"] == pytest.approx(np.deg2rad(20.0))
    assert changed["time_stretch"] == 1.25
    assert changed["robot_s"] == pytest.approx(2.0)
