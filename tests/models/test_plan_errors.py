from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_models.metrics import MAX_PSNR_DB, psnr
from vilp_models.plan_errors import Sums, best_samples, latent_errors, masked_errors, resampled, score


def sums(totals: list[list[float]], counts: list[list[float]]) -> Sums:
    return Sums(np.array(totals), np.array(counts))


def test_errors_are_pooled_over_episodes_at_each_step() -> None:
    errors = Sums.zeros(2, 2)
    errors.add(0, np.array([[10.0, 20.0], [30.0, 0.0]]), np.array([[1.0, 1.0], [1.0, 1.0]]))
    errors.add(1, np.array([[2.0, 4.0]]), np.array([[2.0, 2.0]]))
    found = score(errors, "latent")
    np.testing.assert_allclose(found.steps, [42 / 4, 24 / 4])
    assert found.mean.value == pytest.approx((42 / 4 + 24 / 4) / 2)
    assert found.last.value == pytest.approx(6)


def test_psnr_of_masked_pixels_is_that_of_the_images() -> None:
    rng = np.random.default_rng(0)
    real, other = (rng.integers(0, 256, (1, 1, 8, 8, 3), dtype=np.uint8) for _ in range(2))
    mask = rng.random((1, 1, 8, 8)) < 0.4
    errors = Sums.zeros(1, 1)
    errors.add(0, masked_errors(real, other, mask), mask.sum(axis=(-2, -1)))
    assert score(errors, "moving").last.value == pytest.approx(psnr(real, other, mask), abs=1e-4)


def test_a_perfect_frame_scores_the_ceiling_and_a_still_one_nothing() -> None:
    found = score(sums([[0.0, 0.0]], [[5.0, 0.0]]), "moving")
    assert found.steps[0] == MAX_PSNR_DB
    assert np.isnan(found.steps[1])
    assert np.isnan(found.last.value)
    assert found.mean.value == MAX_PSNR_DB


def test_an_interval_holds_the_value_and_is_of_episodes() -> None:
    rng = np.random.default_rng(1)
    total = rng.uniform(1, 3, (20, 4))
    found = score(sums(total.tolist(), np.ones((20, 4)).tolist()), "latent")
    assert found.last.low < found.last.value < found.last.high
    # by the central limit theorem: 1.96 standard errors either way
    half = 1.96 * total[:, -1].std() / np.sqrt(20)
    assert (found.last.high - found.last.low) / 2 == pytest.approx(half, rel=0.1)
    assert np.isnan(score(sums([[1.0]], [[1.0]]), "latent").last.low)


def test_a_paired_difference_leaves_out_what_is_common_to_both() -> None:
    rng = np.random.default_rng(2)
    hard = rng.uniform(1, 100, (20, 3))
    ones = np.ones((20, 3))
    worse, better = Sums(hard + 1, ones), Sums(hard, ones)
    gain = score(better, "latent", minus=worse)
    assert gain.mean.value == pytest.approx(-1)
    assert gain.mean.low == pytest.approx(gain.mean.high)
    assert score(better, "latent", minus=better).mean.high == 0


def test_latent_errors_are_in_units_of_each_channels_deviation() -> None:
    true = np.zeros((1, 2, 1, 1), np.float32)
    other = np.array([2.0, 30.0], np.float32).reshape(1, 2, 1, 1)
    assert latent_errors(true, other, [1.0, 10.0]).tolist() == [(4 + 9) / 2]


def test_the_best_sample_is_the_best_over_the_horizon_not_at_its_start() -> None:
    errors = np.array([[[0.0, 9.0], [2.0, 2.0]], [[1.0, 1.0], [3.0, 3.0]]])
    assert best_samples(errors).tolist() == [1, 0]


@given(st.integers(2, 30), st.integers(0, 5))
def test_every_resample_draws_as_many_episodes_as_there_are(n_episodes: int, seed: int) -> None:
    drawn = resampled(n_episodes, resamples=50, seed=seed)
    assert drawn.shape == (50, n_episodes)
    assert (drawn.sum(axis=1) == n_episodes).all()
    assert (drawn == resampled(n_episodes, resamples=50, seed=seed)).all()
