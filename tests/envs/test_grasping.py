from __future__ import annotations

import numpy as np
import pytest
from vid2demo.envs.collision import CollisionChecker
from vid2demo.envs.grasps import MAX_WIDTH_M, Grasp, grasp_candidates, held_grasps
from vid2demo.envs.grip import HOLDS, pressing_n, weight_part
from vid2demo.envs.jet import filling_m3, jet_of
from vid2demo.envs.kinematics import panda_chain
from vid2demo.envs.panda import DDQ_MAX_RAD_S2, FINGER_MAX_N, FINGER_PEAK_N, Q_HOME_RAD
from vid2demo.envs.receptacle import surface_points
from vid2demo.envs.reference import Reference, minimum_jerk
from vid2demo.envs.retiming import slowed
from vid2demo.envs.vessel_geometry import gripper_half_width_m
from vid2demo.extract.geometry import Array, make_pose, transform_points
from vid2demo.extract.vessels import CATEGORIES, Vessel, make_vessel


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_vessel_of_the_library_has_grasps_that_do_not_cut_into_it(category: str) -> None:
    vessel = make_vessel(category)
    grasps = grasp_candidates(vessel)
    assert len(grasps) >= 8
    points = surface_points(vessel)
    for grasp in grasps[::7]:
        R = grasp.T_object_hand[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0
        local = transform_points(grasp.T_hand_object, points)
        palm = np.all(np.abs(local - [0.0, 0.0, -0.09]) < [0.03, 0.10, 0.04], axis=1)
        assert palm.sum() <= 2
    assert all(grasp.fits_hand for grasp in grasps)


def test_what_is_too_wide_is_held_by_the_wall_at_its_rim() -> None:
    bowl = make_vessel("bowl")
    assert all(region.width_m > MAX_WIDTH_M for region in bowl.grasps)
    for grasp in grasp_candidates(bowl):
        assert bowl.wall_m < grasp.width_m < bowl.wall_m + 0.002
        below_rim_m = bowl.interior.z_m[-1] - grasp.T_object_hand[2, 3]
        assert 0.0 < below_rim_m < 0.02
        assert gripper_half_width_m(bowl, grasp.T_hand_object) == pytest.approx(grasp.width_m / 2, abs=0.003)
        # From above, or from a side of it, and never at the lip.
        assert grasp.T_object_hand[2, 2] < 0
        assert grasp.T_object_hand[0, 3] < 0.03


def test_the_fingers_close_across_a_handle() -> None:
    for grasp in grasp_candidates(make_vessel("gooseneck_kettle")):
        if grasp.kind == "handle":
            # The handle lies in the vessel's xz plane: the closing direction is never along it.
            assert abs(grasp.T_object_hand[1, 1]) > 0.85


def test_a_heavy_kettle_may_be_held_across_its_handle_with_a_finger_inside() -> None:
    T, kettle = tilting(80.0, category="electric_kettle")
    usual, held = grasp_candidates(kettle), held_grasps(kettle, 0.2, T)

    def part(grasp: Grasp) -> float:
        return weight_part(kettle, 0.2, T, grasp.T_hand_object, grasp.width_m, grasp.is_flat)

    assert len(held) > len(usual)
    assert min(map(part, usual)) > HOLDS
    assert min(map(part, held)) < 0.9 * min(map(part, usual))
    # What is added closes rather along the handle's distance from the body, and cuts into nothing.
    added = held[len(usual) :]
    assert all(abs(grasp.T_object_hand[0, 1]) > 0.6 for grasp in added)
    points = surface_points(kettle)
    for grasp in added[::5]:
        local = transform_points(grasp.T_hand_object, points)
        assert np.all(np.abs(local - [0.0, 0.0, -0.09]) < [0.03, 0.10, 0.04], axis=1).sum() <= 2
    # The harder to hold, the less liked.
    plain = {tuple(grasp.T_object_hand.ravel()): grasp.cost for grasp in usual}
    dearer = [grasp.cost - plain[tuple(grasp.T_object_hand.ravel())] for grasp in held[: len(usual)]]
    order = np.argsort([part(grasp) for grasp in held[: len(usual)]])
    assert np.all(np.diff(np.array(dearer)[order]) >= -1e-12)


def test_what_is_light_is_held_as_ever() -> None:
    T, mug = tilting(110.0)
    assert [(g.cost, g.kind) for g in held_grasps(mug, 0.1, T)] == [(g.cost, g.kind) for g in grasp_candidates(mug)]


def test_the_fingers_press_harder_only_where_the_weight_asks_for_it() -> None:
    assert pressing_n(0.0) == pressing_n(HOLDS) == FINGER_MAX_N
    assert pressing_n(1.5 * HOLDS) == pytest.approx(1.5 * FINGER_MAX_N)
    assert pressing_n(9.0) == FINGER_PEAK_N


def tilting(
    tilt_deg: float, height_m: float = 0.3, category: str = "mug", seconds: float = 3.0
) -> tuple[Array, Vessel]:
    angle = np.deg2rad(tilt_deg) * minimum_jerk(np.arange(round(seconds * 25) + 25) / (25 * seconds))
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    T[:, 0, 0], T[:, 0, 2], T[:, 2, 0], T[:, 2, 2] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    T[:, 2, 3] = height_m
    return T, make_vessel(category)


def test_the_jet_starts_late_ends_empty_and_lands_ahead() -> None:
    T, mug = tilting(110.0)
    jet = jet_of(T, mug, filling_m3(mug, mug), 25.0)
    assert jet.share.sum() == pytest.approx(1.0)
    assert jet.poured == pytest.approx(1.0, abs=0.02)
    first = int(np.argmax(jet.share > 1e-3))
    assert np.arccos(T[first, 2, 2]) > np.deg2rad(50)
    lip = transform_points(T[-1], mug.outlet.point_m[None])[0]
    low, high = (jet.share @ jet.landing_m(z) for z in (0.0, 0.2))
    assert low[0] > high[0] > lip[0]
    np.testing.assert_allclose([low[1], high[1]], 0.0, atol=1e-6)


def test_what_does_not_pour_is_known_beforehand() -> None:
    T, mug = tilting(40.0)
    jet = jet_of(T, mug, filling_m3(mug, mug), 25.0)
    assert jet.poured == 0.0
    assert jet.share.sum() == pytest.approx(1.0)
    assert jet.share[: len(T) // 2].sum() == 0.0


def test_a_moving_spout_throws_its_jet_along() -> None:
    T, kettle = tilting(70.0, category="gooseneck_kettle")
    moving = T.copy()
    moving[:, 1, 3] += 0.2 * np.arange(len(T)) / 25.0
    still, thrown = (jet_of(poses, kettle, 1e-4, 25.0) for poses in (T, moving))
    gained_m_s = thrown.velocity_m_s - still.velocity_m_s
    np.testing.assert_allclose(gained_m_s, np.tile([0.0, 0.2, 0.0], (len(T), 1)), atol=1e-9)


def test_collisions_are_named_with_depth() -> None:
    mug = make_vessel("mug")
    grasp = grasp_candidates(mug)[0]
    free = CollisionChecker(mug, grasp.T_hand_object, grasp.width_m, None, None)
    assert free.check(Q_HOME_RAD[None]) == []
    down = Q_HOME_RAD + np.array([0.0, 1.4, 0.0, 0.3, 0.0, 0.0, 0.0])
    found = free.check(np.stack([Q_HOME_RAD, down]))
    assert any({"table"} & {c.first, c.second} and c.knot == 1 and c.depth_m > 0.01 for c in found)
    # The same place is taken by a receptacle: the hand that was free now touches it.
    x, y, z = panda_chain().hand(Q_HOME_RAD)[0, :3, 3]
    hand = make_pose(None, (float(x), float(y), float(z)))
    blocked = CollisionChecker(mug, grasp.T_hand_object, grasp.width_m, make_vessel("bowl"), hand)
    assert any("receptacle" in (c.first, c.second) for c in blocked.check(Q_HOME_RAD[None]))


def joints_reference(q_rad: Array) -> Reference:
    T = np.tile(np.eye(4), (len(q_rad), 1, 1))
    T[:, 0, 3] = q_rad[:, 0]
    return Reference.from_poses(T, np.arange(len(q_rad)) / 25.0, {"notes": ["a"]})


def test_only_what_is_too_fast_is_slowed_down() -> None:
    """Joint 1 goes 2 rad in 4 s, but 1 of them within 0.2 s."""
    time_s = np.arange(101) / 25.0
    q = np.tile(Q_HOME_RAD, (101, 1))
    q[:, 0] = 0.25 * time_s + minimum_jerk((time_s - 2.0) / 0.2)
    slow = slowed(joints_reference(q), q)
    assert 1.05 < slow.header["time_stretch"] < 1.6
    travelled = slow.T_world_object[:, 0, 3]
    assert travelled[-1] == pytest.approx(q[-1, 0])
    speed = np.abs(np.diff(travelled)) * 25.0
    assert speed.max() < 2.175
    assert np.abs(np.diff(travelled, n=2)).max() * 25.0**2 < 1.1 * DDQ_MAX_RAD_S2[0]
    # Away from the hasty moment the clock runs as it did.
    assert speed[:30] == pytest.approx(0.25, rel=0.02)
    assert "around 2." in slow.notes[-1]


def test_a_calm_motion_keeps_its_clock() -> None:
    q = np.tile(Q_HOME_RAD, (50, 1))
    reference = joints_reference(q)
    assert slowed(reference, q) is reference
