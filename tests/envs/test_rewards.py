from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vid2demo.envs.randomization import RANDOMIZATIONS, Randomization
from vid2demo.envs.rewards import REWARD_MODES, TERMS, RewardConfig, StepErrors, kernel, term_table, weighted_terms
from vid2demo.extract.errors import UserError

PERFECT = StepErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
numbers = st.floats(0.0, 1e6)


@given(st.builds(StepErrors, *[numbers] * 4, *[st.floats(-1, 1)] * 2, numbers, st.sampled_from([0.0, 1.0])))
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
    whole = dataclasses.replace(PERFECT, poured_gain=1.0)
    assert weighted_terms(whole, RewardConfig())["poured"] == RewardConfig().poured
    assert weighted_terms(dataclasses.replace(PERFECT, spilled_gain=0.1), RewardConfig())["spilled"] < 0


def test_modes_pay_for_what_they_are_named_after() -> None:
    busy = StepErrors(0.05, 0.1, 0.1, 0.1, 0.2, 0.1, 0.3, 1.0)
    paid = {mode: {k for k, v in weighted_terms(busy, config).items() if v} for mode, config in REWARD_MODES.items()}
    assert paid["sparse"] == {"success"}
    assert paid["pour"] == {"poured", "spilled", "action_rate"}
    assert paid["tracking"] == {"position", "rotation", "linear_velocity", "angular_velocity", "action_rate"}
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


def test_draws_stay_in_range_repeat_with_their_seed_and_cost_the_same_numbers() -> None:
    import numpy as np

    spread = Randomization(start_offset_m=(0.02, 0.0, 0.0), receptacle_offset_m=(0.03, 0.03, 0.0))
    draws = [np.concatenate(spread.draw(np.random.default_rng(seed))) for seed in range(200)]
    assert np.all(np.abs(draws) <= [0.02, 0, 0, 0.03, 0.03, 0])
    assert np.ptp(draws, axis=0)[0] > 0.03
    np.testing.assert_array_equal(draws[3], np.concatenate(spread.draw(np.random.default_rng(3))))
    quiet, loud = np.random.default_rng(0), np.random.default_rng(0)
    RANDOMIZATIONS["none"].draw(quiet)
    spread.draw(loud)
    assert quiet.uniform() == loud.uniform()


@pytest.mark.parametrize("value", [(0.1, 0.1), (-0.1, 0.0, 0.0), (9.0, 0.0, 0.0)])
def test_senseless_ranges_are_refused(value: tuple[float, ...]) -> None:
    with pytest.raises(UserError, match="start_offset_m"):
        Randomization(start_offset_m=value)  # type: ignore[arg-type]
