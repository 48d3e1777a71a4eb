from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.liquid import Liquid, SpoutConduit, count_particles, fill_positions, level_share
from vid2demo.envs.vessel_geometry import cavity_of, collision_boxes
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import make_pose
from vid2demo.extract.vessels import CATEGORIES, make_vessel

RADIUS_M = 0.004
SHARE = 0.0025  # a hundred particles stand for a quarter of the hollow


def tilted(tilt_deg: float, height_m: float = 0.5) -> np.ndarray:
    return make_pose(Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix(), (0.3, 0.1, height_m))


def filled(category: str, count: int) -> np.ndarray:
    vessel = make_vessel(category)
    cavity = cavity_of(vessel)
    return fill_positions(cavity, collision_boxes(vessel, cavity), count, RADIUS_M, category)


@pytest.mark.parametrize("category", ["mug", "wine_glass", "carton", "gooseneck_kettle", "bowl"])
def test_filling_overlaps_nothing_and_grows_from_the_floor(category: str) -> None:
    points = filled(category, 100)
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(100)
    assert gaps.min() >= 2 * RADIUS_M
    vessel = make_vessel(category)
    cavity = cavity_of(vessel)
    assert np.all(cavity.contains(points))
    assert min(box.distance_m(points).min() for box in collision_boxes(vessel, cavity)) >= RADIUS_M
    assert np.all(np.diff(points[:, 2]) >= 0)
    np.testing.assert_array_equal(filled(category, 40), points[:40])


def test_too_many_particles_are_refused_with_the_number_that_fits() -> None:
    with pytest.raises(UserError, match=r"the cup holds at most (\d+) particles of 4\.0 mm radius") as caught:
        filled("cup", 5000)
    fits = int(str(caught.value).split("at most ")[1].split()[0])
    assert 150 < fits < 600
    assert len(filled("cup", fits)) == fits


def test_chosen_radius_suits_both_vessels() -> None:
    liquid = Liquid()
    assert liquid.radius_for(100, 1e-3, 1e-3, 0.04) == pytest.approx(0.005)
    assert liquid.radius_for(500, 1e-4, 1e-4, 0.04) == pytest.approx(0.0025, abs=5e-4)
    assert Liquid(radius_m=0.003).radius_for(100, 1e-3, 1e-3, 0.04) == 0.003
    assert liquid.radius_for(100, 1e-3, 1e-3, 0.013) < 0.003, "a bottle's neck must not jam"
    small = liquid.radius_for(100, 2e-4, 1e-3, 0.04)
    assert 100 * 4 / 3 * np.pi * small**3 < 0.2 * 2e-4


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"radius_m": 0.1}, "radius_m"),
        ({"density_kg_m3": 0.0}, "density_kg_m3 is 0.0; choose 50 to 20000"),
        ({"friction": -0.1}, "friction"),
        ({"drag_1_s": -1.0}, "drag"),
        ({"spout_fill": 2.0}, "spout_fill"),
        ({"solver": "magic"}, "solver is 'magic'; choose engine, fast"),
    ],
)
def test_impossible_liquids_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Liquid(**values)


def test_a_particle_weighs_what_a_ball_of_its_density_does() -> None:
    assert Liquid().particle_mass_kg(0.005) == pytest.approx(0.0005236, rel=1e-3)
    assert Liquid(density_kg_m3=500.0).particle_mass_kg(0.01) == pytest.approx(0.0020944, rel=1e-3)


def test_every_particle_is_held_poured_spilled_or_flying() -> None:
    mug, bowl = cavity_of(make_vessel("mug")), cavity_of(make_vessel("bowl"))
    T_mug, T_bowl = make_pose(None, (0.0, 0.0, 0.3)), make_pose(None, (0.3, 0.0, 0.05))
    in_mug, in_bowl = [0.0, 0.0, 0.3], [0.3, 0.0, 0.05]
    falling, on_table, under_floor = [0.2, 0.0, 0.25], [0.15, 0.0, 0.005], [0.3, 0.0, -0.5]
    count = count_particles(np.array([in_mug, in_bowl, falling, on_table, under_floor]), mug, T_mug, bowl, T_bowl)
    np.testing.assert_array_equal(count.held, [1, 0, 0, 0, 0])
    np.testing.assert_array_equal(count.poured, [0, 1, 0, 0, 0])
    np.testing.assert_array_equal(count.spilled, [0, 0, 0, 1, 1])
    assert (count.held_fraction, count.poured_fraction, count.spilled_fraction) == (0.2, 0.2, 0.4)
    nothing = count_particles(np.zeros((0, 3)), mug, T_mug, bowl, T_bowl)
    assert nothing.poured_fraction == nothing.spilled_fraction == 0.0


class TestSpout:
    @pytest.fixture
    def conduit(self) -> SpoutConduit:
        vessel = make_vessel("gooseneck_kettle")
        cavity = cavity_of(vessel)
        return SpoutConduit(vessel, cavity, collision_boxes(vessel, cavity), RADIUS_M, SHARE)

    @pytest.fixture
    def tip_m(self) -> np.ndarray:
        return np.asarray(make_vessel("gooseneck_kettle").outlet.point_m)

    def world(self, T: np.ndarray, count: int = 100) -> np.ndarray:
        return filled("gooseneck_kettle", count) @ T[:3, :3].T + T[:3, 3]

    def test_level_stands_where_the_volume_below_is_the_liquids(self, conduit: SpoutConduit) -> None:
        cavity = cavity_of(make_vessel("gooseneck_kettle"))
        samples = cavity.sample(20000)
        for tilt_deg in (0.0, 40.0, 90.0):
            T = tilted(tilt_deg)
            level_m = conduit.level_m(T, 100)
            below = np.mean(samples @ T[2, :3] + T[2, 3] < level_m)
            assert below == pytest.approx(0.25, abs=0.01)
        assert conduit.level_m(T, 0) == -np.inf

    def test_a_few_particles_stand_for_a_fair_filling_and_many_for_themselves(self) -> None:
        cavity = cavity_of(make_vessel("gooseneck_kettle"))
        assert level_share(Liquid(), cavity, 10, RADIUS_M) == pytest.approx(0.025)
        assert level_share(Liquid(spout_fill=0.0), cavity, 100, RADIUS_M) == pytest.approx(
            4 / 3 * np.pi * RADIUS_M**3 / 0.58 / cavity.volume_m3
        )

    def test_nothing_flows_while_the_tip_is_above_the_level(self, conduit: SpoutConduit) -> None:
        T = tilted(20.0)
        points = self.world(T)
        before = points.copy()
        assert not conduit.move(points, np.zeros_like(points), T, np.zeros(6))
        np.testing.assert_array_equal(points, before)

    def test_a_particle_leaves_at_the_tip_along_the_outlet(self, conduit: SpoutConduit, tip_m: np.ndarray) -> None:
        T = tilted(85.0)
        points = self.world(T)
        before, velocity = points.copy(), np.zeros_like(points)
        assert conduit.may_flow(T, points)
        assert conduit.move(points, velocity, T, np.array([0.1, 0, 0, 0, 0, 0]))
        (moved,) = np.flatnonzero(np.any(points != before, axis=1))
        tip = T[:3, :3] @ tip_m + T[:3, 3]
        assert np.linalg.norm(points[moved] - tip) < 2 * RADIUS_M
        leaving = velocity[moved] - [0.1, 0, 0]
        direction = T[:3, :3] @ make_vessel("gooseneck_kettle").outlet.direction
        assert 0.3 < np.linalg.norm(leaving) < 1.0
        assert leaving @ direction == pytest.approx(np.linalg.norm(leaving))

    def test_the_next_waits_until_the_tip_is_clear(self, conduit: SpoutConduit) -> None:
        T = tilted(85.0)
        points = self.world(T)
        velocity = np.zeros_like(points)
        assert conduit.move(points, velocity, T, np.zeros(6))
        assert not conduit.move(points, velocity, T, np.zeros(6))
        leaver = int(np.argmax(np.linalg.norm(velocity, axis=1)))
        points[leaver] += 2.5 * RADIUS_M * velocity[leaver] / np.linalg.norm(velocity[leaver])
        assert conduit.move(points, velocity, T, np.zeros(6))

    def test_a_spout_without_an_entry_is_refused(self) -> None:
        mug = make_vessel("mug")
        with pytest.raises(UserError, match="names no entry"):
            SpoutConduit(mug, cavity_of(mug), [], RADIUS_M, SHARE)


@pytest.mark.parametrize("category", [c for c in CATEGORIES if make_vessel(c).outlet.kind == "spout"])
def test_every_spout_lets_go_near_its_tip_and_clear_of_the_walls(category: str) -> None:
    vessel = make_vessel(category)
    cavity = cavity_of(vessel)
    boxes = collision_boxes(vessel, cavity)
    conduit = SpoutConduit(vessel, cavity, boxes, RADIUS_M, SHARE)
    T = tilted(89.0)
    points = fill_positions(cavity, boxes, 100, RADIUS_M, category) @ T[:3, :3].T + T[:3, 3]
    before = points.copy()
    assert conduit.move(points, np.zeros_like(points), T, np.zeros(6))
    left = points[np.any(points != before, axis=1)]
    local = (left - T[:3, 3]) @ T[:3, :3]
    assert np.linalg.norm(local - vessel.outlet.point_m) < 0.03
    assert min(box.distance_m(local)[0] for box in boxes) >= 0.999 * RADIUS_M
