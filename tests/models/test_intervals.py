"""Confidence intervals: known values, and they hold the truth as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_models.intervals import Estimate, crossed_estimate, mean_estimate, paired_difference, rate_estimate


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0), (1, 50, 0.00354, 0.10495)],
)
def test_wilsons_interval_of_known_counts(successes, trials, low, high):
    estimate = rate_estimate(successes, trials)
    assert estimate.value == successes / trials
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-5)


@given(st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_rate_lies_in_its_interval_and_that_in_zero_to_one(counts):
    estimate = rate_estimate(*counts)
    assert 0 <= estimate.low <= estimate.value + 1e-12
    assert estimate.value - 1e-12 <= estimate.high <= 1


def test_wilsons_interval_holds_the_true_rate_about_95_times_in_100():
    counts = np.random.default_rng(0).binomial(50, 0.2, size=2000)
    held = [estimate.low <= 0.2 <= estimate.high for estimate in (rate_estimate(int(n), 50) for n in counts)]
    assert 0.92 < np.mean(held) < 0.98


def test_the_bootstrap_holds_the_true_mean_about_95_times_in_100():
    """Of skewed values, as the rewards of a policy that seldom succeeds are."""
    samples = np.random.default_rng(1).exponential(size=(400, 50))
    held = [estimate.low <= 1 <= estimate.high for estimate in (mean_estimate(row, draws=500) for row in samples)]
    assert 0.89 < np.mean(held) < 0.98


def test_the_bootstrap_is_as_wide_as_theory_says_and_the_same_every_time():
    values = np.random.default_rng(2).normal(3.0, 2.0, size=1000)
    estimate = mean_estimate(values)
    assert estimate == mean_estimate(values.tolist())
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * values.std() / math.sqrt(1000), rel=0.05)


def test_pairing_sees_a_small_difference_in_values_that_vary_much():
    theirs = np.random.default_rng(3).normal(0.0, 10.0, size=50)
    ours = theirs + 0.1 + np.random.default_rng(4).normal(0.0, 0.05, size=50)
    assert not mean_estimate(ours).is_above_zero
    difference = paired_difference(ours.tolist(), theirs.tolist())
    assert difference.is_above_zero
    assert difference.value == pytest.approx(0.1, abs=0.03)


def test_an_interval_lies_above_zero_or_below_or_neither():
    assert (Estimate(1.0, 0.5, 2.0).is_above_zero, Estimate(1.0, 0.5, 2.0).is_below_zero) == (True, False)
    assert (Estimate(-1.0, -2.0, -0.5).is_above_zero, Estimate(-1.0, -2.0, -0.5).is_below_zero) == (False, True)
    assert not Estimate(1.0, -0.5, 2.0).is_above_zero


def test_one_value_has_a_mean_and_no_interval():
    estimate = mean_estimate([0.5])
    assert estimate.value == 0.5
    assert math.isnan(estimate.low)
    assert not estimate.is_above_zero
    assert not estimate.is_below_zero


def test_what_has_no_interval_is_refused():
    for call in (
        lambda: mean_estimate([]),
        lambda: mean_estimate([1.0, math.nan]),
        lambda: paired_difference([1.0], [1.0, 2.0]),
        lambda: rate_estimate(3, 2),
        lambda: rate_estimate(0, 0),
    ):
        with pytest.raises(ValueError, match="."):
            call()


@pytest.mark.parametrize("n", [6, 8, 20])
def test_few_values_have_an_interval_that_holds_the_mean_as_often_as_it_says(n: int) -> None:
    samples = np.random.default_rng(n).normal(size=(400, n))
    held = [estimate.low <= 0 <= estimate.high for estimate in (mean_estimate(row, draws=1000) for row in samples)]
    assert 0.9 < np.mean(held) < 0.98


def test_too_few_values_have_none() -> None:
    assert math.isnan(mean_estimate([0.0, 1.0, 2.0, 3.0, 4.0]).low)
    assert not math.isnan(mean_estimate([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]).low)


def test_seeds_and_starts_are_both_chance() -> None:
    """With an effect of the training seed as large as that of a start, drawing starts alone holds the truth too seldom."""
    random = np.random.default_rng(0)
    both, starts = [], []
    for _ in range(200):
        common = random.normal(size=30)
        ours, theirs = (common + 0.4 * random.normal(size=(3, 1)) + random.normal(size=(3, 30)) for _ in range(2))
        crossed = crossed_estimate(ours, theirs, draws=500)
        of_starts = mean_estimate((ours - theirs).mean(axis=0), draws=500)
        both.append(crossed.low <= 0 <= crossed.high)
        starts.append(of_starts.low <= 0 <= of_starts.high)
    assert np.mean(both) > 0.88
    assert np.mean(starts) < 0.75


def test_what_both_sides_meet_at_a_start_drops_out() -> None:
    common = np.random.default_rng(1).normal(0, 10, size=(1, 40))
    ours, theirs = (
        common + shift + np.random.default_rng(k).normal(0, 0.1, (3, 40)) for k, shift in ((2, 0.5), (3, 0))
    )
    gain = crossed_estimate(ours, theirs)
    assert gain.value == pytest.approx(0.5, abs=0.05)
    assert 0.3 < gain.low < gain.high < 0.7
    with pytest.raises(ValueError, match="same starts"):
        crossed_estimate(ours, theirs[:, :-1])
