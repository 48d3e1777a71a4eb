from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vid2demo.envs.randomization import RANDOMIZATIONS, Randomization
from vid2demo.envs.rewards import (
    JOINT_MARGIN_RAD,
    REWARD_MODES,
    TERMS,
    RewardConfig,
    StepErrors,
    kernel,
    limit_share,
    term_table,
    weighted_terms,
    with_tolerance,
)
from vid2demo.extract.errors import UserError

PERFECT = StepErrors(*[0.0] * 11)
numbers = st.floats(0.0, 1e6)


@given(st.builds(StepErrors, *[numbers] * 4, *[st.floats(-1, 1)] * 2, numbers, *[st.floats(0, 1)] * 4))
def test_terms_are_finite_and_tracking_stays_within_its_share(errors: StepErrors) -> None:
    config = RewardConfig()
    terms = weighted_terms(errors, config)
    assert list(terms) == list(TERMS)
    assert all(math.isfinite(value) for value in terms.values())
    for name in ("position", "rotation", "linear_velocity", "angular_velocity"):
        assert 0.0 <= terms[name] <= getattr(config, name)


def test_kernel_falls_to_one_over_e_at_its_scale_and_never_rises() -> None:
    assert kernel(0.0, 0.2) == 1.0
    assert kernel(0.2, 0.2) == pytest.approx(1 / math.e)
    assert kernel(0.1, 0.2) > kernel(0.11, 0.2) > kernel(1e9, 0.2) > 0.0


def test_perfect_tracking_earns_one_and_a_whole_pour_its_weight() -> None:
    assert sum(weighted_terms(PERFECT, RewardConfig()).values()) == pytest.approx(1.0)
    whole = PERFECT._replace(poured_gain=1.0)
    assert weighted_terms(whole, RewardConfig())["poured"] == RewardConfig().poured
    assert weighted_terms(PERFECT._replace(spilled_gain=0.1), RewardConfig())["spilled"] < 0


def test_modes_pay_for_what_they_are_named_after() -> None:
    busy = StepErrors(0.05, 0.1, 0.1, 0.1, 0.2, 0.1, 0.3, 0.5, 1.0, 1.0, 1.0)
    paid = {mode: {k for k, v in weighted_terms(busy, config).items() if v} for mode, config in REWARD_MODES.items()}
    assert paid["sparse"] == {"success"}
    care = {"action_rate", "joint_limits", "self_contact", "table_contact"}
    assert paid["pour"] == {"poured", "spilled"} | care
    assert paid["tracking"] == {"position", "rotation", "linear_velocity", "angular_velocity"} | care
    assert paid["dense"] == paid["tracking"] | paid["pour"]


def test_table_lists_every_term_with_weight_scale_and_meaning() -> None:
    lines = term_table(RewardConfig()).splitlines()
    assert len(lines) == 2 + len(TERMS)
    assert "0.1 m" in next(line for line in lines if line.startswith("position"))
    assert "1.5 rad/s" in next(line for line in lines if line.startswith("angular_velocity"))
    assert "-10" in next(line for line in lines if line.startswith("spilled"))


@pytest.mark.parametrize("values", [{"position_scale_m": 0.0}, {"poured": math.nan}, {"rotation_scale_rad": -1.0}])
def test_senseless_configurations_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(UserError, match=next(iter(values))):
        RewardConfig(**values)


@given(numbers, st.floats(0.01, 100.0))
def test_the_tolerance_widens_every_tracking_kernel_alike(error: float, tolerance: float) -> None:
    wide = with_tolerance(RewardConfig(), tolerance)
    for name in ("position_scale_m", "rotation_scale_rad", "linear_velocity_scale_m_s", "angular_velocity_scale_rad_s"):
        scale = getattr(RewardConfig(), name)
        assert kernel(error * tolerance, getattr(wide, name)) == pytest.approx(kernel(error, scale), abs=1e-12)
    assert with_tolerance(RewardConfig(), 1.0) == RewardConfig()


def test_a_joint_near_its_limit_is_charged_linearly() -> None:
    low, high = [-1.0] * 7, [1.0] * 7
    assert limit_share([0.0] * 7, low, high) == 0.0
    for margin_rad, share in ((JOINT_MARGIN_RAD, 0.0), (JOINT_MARGIN_RAD / 2, 0.5), (0.0, 1.0), (-0.2, 1.0)):
        q_rad = [0.0, 0.0, 0.0, 1.0 - margin_rad, 0.0, 0.0, 0.0]
        assert limit_share(q_rad, low, high) == pytest.approx(share)
        assert limit_share([-q for q in q_rad], low, high) == pytest.approx(share)


def test_draws_stay_in_range_repeat_with_their_seed_and_cost_the_same_numbers() -> None:
    spread = RANDOMIZATIONS["high"]
    draws = [spread.draw(np.random.default_rng(seed)) for seed in range(300)]
    for name in ("start_offset_m", "receptacle_offset_m"):
        drawn = np.array([getattr(draw, name) for draw in draws])
        assert np.all(np.abs(drawn) <= getattr(spread, name))
        assert np.all(np.ptp(drawn, axis=0) >= 1.7 * np.asarray(getattr(spread, name)))
    for name in ("vessel_mass", "stiffness", "light"):
        drawn = np.array([getattr(draw, name) for draw in draws])
        assert np.all(np.abs(drawn - 1.0) <= getattr(spread, name))
        assert np.ptp(drawn) > 1.7 * getattr(spread, name)
    assert {draw.receptacle_shape for draw in draws} == set(range(spread.receptacle_shapes))
    nothing = RANDOMIZATIONS["none"].draw(np.random.default_rng(5))
    assert nothing.receptacle_shape == -1
    assert nothing.vessel_mass == nothing.stiffness == nothing.light == 1.0
    assert not np.any([nothing.start_offset_m, nothing.receptacle_offset_m, nothing.camera_offset_m])
    again = spread.draw(np.random.default_rng(3)).to_state()
    assert all(np.array_equal(again[name], value) for name, value in draws[3].to_state().items())
    quiet, loud = np.random.default_rng(0), np.random.default_rng(0)
    RANDOMIZATIONS["none"].draw(quiet)
    spread.draw(loud)
    assert quiet.uniform() == loud.uniform()


@pytest.mark.parametrize("value", [-0.1, 2.0, math.nan, "much", (0.1, 0.1)])
def test_senseless_factors_are_refused(value: object) -> None:
    with pytest.raises(UserError, match="vessel_mass"):
        Randomization(vessel_mass=value)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [(0.1, 0.1), (-0.1, 0.0, 0.0), (9.0, 0.0, 0.0)])
def test_senseless_ranges_are_refused(value: tuple[float, ...]) -> None:
    with pytest.raises(UserError, match="start_offset_m"):
        Randomization(start_offset_m=value)  # type: ignore[arg-type]
