"""How sure a mean, a rate or a difference is: 95 % confidence intervals, pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from vilp_data.types import F64

CONFIDENCE = 0.95
DRAWS = 10_000
"""Resamples of a bootstrap: its ends are then good to a few per cent of the interval's width."""

SEED = 0


@dataclass(frozen=True)
class Estimate:
    """A value, and the ends of its confidence interval; these are NaN where there is too little to tell."""

    value: float
    low: float
    high: float

    @property
    def is_above_zero(self) -> bool:
        """Whether the whole interval lies above zero; False where there is none."""
        return self.low > 0

    @property
    def is_below_zero(self) -> bool:
        """Whether the whole interval lies below zero; False where there is none."""
        return self.high < 0


def mean_estimate(values: Sequence[float] | F64, *, confidence: float = CONFIDENCE, draws: int = DRAWS) -> Estimate:
    """The mean of independent values [n], with the percentile interval of a bootstrap over them (Efron 1979).

    The same values give the same interval: resampling has a fixed generator. One value has no interval. Raises ValueError for
    none, or one that is not finite."""
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or not len(data) or not np.isfinite(data).all():
        raise ValueError(f"a mean needs finite values in one row, got shape {data.shape}")
    if len(data) == 1:
        return Estimate(float(data[0]), math.nan, math.nan)
    random = np.random.Generator(np.random.Philox(key=SEED))
    means = data[random.integers(len(data), size=(draws, len(data)))].mean(axis=1)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Estimate(float(data.mean()), float(low), float(high))


def paired_difference(ours: Sequence[float], theirs: Sequence[float], *, draws: int = DRAWS) -> Estimate:
    """Mean of ours - theirs [n], pair by pair, with its bootstrap interval: what is common to a pair drops out.

    Raises ValueError where they are not of one length."""
    if len(ours) != len(theirs):
        raise ValueError(f"pairs need one value on each side, got {len(ours)} and {len(theirs)}")
    return mean_estimate(np.asarray(ours, np.float64) - np.asarray(theirs, np.float64), draws=draws)


def rate_estimate(successes: int, trials: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """successes / trials with the score interval of Wilson (1927), which stays within [0, 1] and has a width at 0 and 1 too.

    Raises ValueError unless 0 <= successes <= trials and trials > 0."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    return Estimate(rate, max(0.0, centre - half), min(1.0, centre + half))
