"""Evaluation: the open-loop policy pours, a still arm does not, and the figures are honest about few episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from vid2demo.demos.attempt import attempt_seed
from vid2demo.demos.retarget import retarget
from vid2demo.envs.reference import Reference
from vid2demo.extract.errors import UserError
from vid2demo.policies.evaluate import evaluate, evaluation_seed, wilson_interval
from vid2demo.policies.open_loop import OpenLoopPolicy

SMALL = {"num_particles": 20}


class StillPolicy:
    """Holds the arm where the episode began."""

    name = "still"

    def reset(self, env: Any, observation: Any, info: Any) -> None:
        self.target = np.asarray(observation["agent_pos"][:7], np.float32)

    def act(self, observation: Any) -> Any:
        return self.target


def test_open_loop_pours_and_a_still_arm_does_not(pour_reference: Path) -> None:
    good = evaluate(OpenLoopPolicy(), pour_reference, episodes=3, env_kwargs=SMALL)
    bad = evaluate(StillPolicy(), pour_reference, episodes=2, env_kwargs=SMALL)
    assert good.successes == 3
    assert bad.successes == 0
    assert [row["reason"] for row in bad.episodes] == ["poured too little"] * 2
    assert all(row["position_error_mean_m"] < 0.005 for row in good.episodes)
    report = good.to_json()
    assert report["success_rate"] == 1.0
    assert report["success_rate_95_low"] == pytest.approx(0.4385, abs=1e-3)
    assert report["settings"]["env_kwargs"]["randomization"] == "low"
    json.dumps(report, allow_nan=False)
    assert good.as_text() == "open loop: 3 of 3 episodes succeed (100%, 95% interval 44 to 100%)"


def test_equal_seeds_equal_rows(pour_reference: Path) -> None:
    a, b, c = (evaluate(OpenLoopPolicy(), pour_reference, episodes=1, seed=s, env_kwargs=SMALL) for s in (3, 3, 4))
    assert a.to_json() == b.to_json()
    assert a.episodes[0]["return"] != c.episodes[0]["return"]


def test_fixed_joints_are_played_as_they_are(pour_reference: Path, tmp_path: Path) -> None:
    joints = retarget(Reference.load(pour_reference))
    joints.save(tmp_path / "mug.joints.npz")
    for policy in (OpenLoopPolicy(joints), OpenLoopPolicy(tmp_path / "mug.joints.npz")):
        report = evaluate(policy, pour_reference, episodes=1, env_kwargs={**SMALL, "randomization": "none"})
        assert report.successes == 1
        assert report.policy == "open loop, fixed"


def test_wrong_control_mode_or_rate_counts_as_failure_with_the_mend(pour_reference: Path) -> None:
    report = evaluate(OpenLoopPolicy(), pour_reference, episodes=1, env_kwargs={**SMALL, "control_mode": "joint_delta"})
    assert report.successes == 0
    assert "control_mode='joint_position'" in report.episodes[0]["reason"]
    joints = retarget(Reference.load(pour_reference))
    report = evaluate(OpenLoopPolicy(joints), pour_reference, episodes=1, env_kwargs={**SMALL, "control_hz": 50.0})
    assert "make it with control_hz=25" in report.episodes[0]["reason"]
    assert report.to_json()["means"]["poured_fraction"] == 0.0


def test_pixels_alone_are_enough_for_a_roll_out(pour_reference: Path) -> None:
    kwargs = {**SMALL, "obs_mode": "pixels", "cameras": ("wrist",), "image_size": (32, 32)}
    assert evaluate(OpenLoopPolicy(), pour_reference, episodes=1, env_kwargs=kwargs).successes == 1


def test_no_episodes_is_refused(pour_reference: Path) -> None:
    with pytest.raises(UserError, match="--episodes is 0"):
        evaluate(OpenLoopPolicy(), pour_reference, episodes=0)


@given(st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_agrees_with_scipy(case: tuple[int, int]) -> None:
    successes, trials = case
    low, high = wilson_interval(successes, trials)
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    assert low == pytest.approx(expected.low, abs=1e-9)
    assert high == pytest.approx(expected.high, abs=1e-9)
    assert low <= successes / trials <= high


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3), (0, 0)])
def test_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="make no rate"):
        wilson_interval(successes, trials)


def test_evaluation_never_sees_the_seeds_of_collection() -> None:
    collected = {attempt_seed(seed, index) for seed in range(10) for index in range(200)}
    evaluated = {evaluation_seed(seed, index) for seed in range(10) for index in range(200)}
    assert len(evaluated) == 2000
    assert not collected & evaluated
