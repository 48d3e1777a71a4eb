from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.observations import ENVIRONMENT_NAMES, Targets, resampled
from vid2demo.envs.reference import Reference
from vid2demo.extract.geometry import Symmetry

TIME_S = np.arange(20) / 25


def swinging(symmetry: Symmetry) -> Reference:
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(TIME_S[:, None] * np.array([1.0, 0.5, 2.0])).as_matrix()
    T[:, :3, 3] = TIME_S[:, None] * np.array([0.1, 0.0, 0.2])
    return Reference.from_poses(T, TIME_S, {"symmetry": symmetry.to_json()})


SYMMETRIES = [Symmetry(order=1), Symmetry(order=2), Symmetry(order=4), Symmetry(order=0), Symmetry((1.0, 0.0, 0.0), 0)]


@pytest.mark.parametrize("symmetry", SYMMETRIES, ids=lambda s: f"{s.order}{s.axis}")
def test_turn_leads_into_the_reference_and_is_as_long_as_the_error(symmetry: Symmetry) -> None:
    reference = swinging(symmetry)
    targets = Targets.of(reference)
    for index, R in enumerate(Rotation.random(20, rng=np.random.default_rng(1)).as_matrix()):
        wanted = reference.T_world_object[index, :3, :3]
        expected = float(symmetry.error_rad(R, wanted))
        turn = targets.turn_vector(index, R)
        assert np.linalg.norm(turn) == pytest.approx(expected, abs=1e-6)
        turned = Rotation.from_rotvec(turn).as_matrix() @ R
        assert float(symmetry.error_rad(turned, wanted)) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("symmetry", SYMMETRIES, ids=lambda s: f"{s.order}{s.axis}")
def test_the_reference_itself_has_no_error(symmetry: Symmetry) -> None:
    reference = swinging(symmetry)
    T = reference.T_world_object[7]
    errors = Targets.of(reference).errors(7, T[:3, 3], T[:3, :3], reference.twist_world[7])
    np.testing.assert_allclose(errors, 0.0, atol=1e-6)


def test_an_upside_down_round_vessel_is_half_a_turn_off() -> None:
    targets = Targets.of(swinging(Symmetry(order=0)))
    upside_down = np.diag([1.0, -1.0, -1.0])
    turn = targets.turn_vector(0, upside_down)
    assert np.linalg.norm(turn) == pytest.approx(np.pi)
    assert turn[2] == pytest.approx(0.0, abs=1e-9)


def test_spin_about_a_round_vessels_axis_is_no_error() -> None:
    reference = swinging(Symmetry(order=0))
    T = reference.T_world_object[7]
    spun = reference.twist_world[7] + np.concatenate([np.zeros(3), 3.0 * T[:3, 2]])
    assert Targets.of(reference).errors(7, T[:3, 3], T[:3, :3], spun)[3] == pytest.approx(0.0, abs=1e-9)
    uneven = swinging(Symmetry(order=1))
    assert Targets.of(uneven).errors(7, T[:3, 3], T[:3, :3], spun)[3] == pytest.approx(3.0)


def test_after_the_end_the_object_should_stand_still() -> None:
    reference = swinging(Symmetry(order=1))
    T = reference.T_world_object[-1]
    errors = Targets.of(reference).errors(19, T[:3, 3], T[:3, :3], np.array([0.3, 0.4, 0, 0, 0, 2.0]))
    np.testing.assert_allclose(errors[2:], [0.5, 2.0])


def test_environment_state_has_one_value_for_every_name() -> None:
    reference = swinging(Symmetry(order=1))
    T = reference.T_world_object[0]
    share = np.array([1.0, 0.0, 0.0])
    vector = Targets.of(reference).environment_state(0, T[:3, 3], T[:3, :3], np.zeros(6), np.ones(3), share)
    assert vector.shape == (len(ENVIRONMENT_NAMES),)
    assert vector.dtype == np.float32
    assert len(set(ENVIRONMENT_NAMES)) == len(ENVIRONMENT_NAMES)
    named = dict(zip(ENVIRONMENT_NAMES, vector, strict=True))
    np.testing.assert_allclose([named[f"reference_200ms_turn_{a}_rad"] for a in "xyz"], [0.2, 0.1, 0.4], atol=1e-6)


@pytest.mark.parametrize("control_hz", [10.0, 50.0, 30.0])
def test_another_rate_keeps_the_path(control_hz: float) -> None:
    reference = swinging(Symmetry())
    other = resampled(reference, control_hz)
    assert other.control_hz == pytest.approx(control_hz)
    assert other.duration_s == pytest.approx(reference.duration_s, abs=1 / control_hz)
    inside = other.time_s <= reference.duration_s
    np.testing.assert_allclose(other.T_world_object[inside, 2, 3], 0.2 * other.time_s[inside], atol=1e-9)
    assert resampled(reference, 25.0) is reference
