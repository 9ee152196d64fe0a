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

FEWEST = 6
"""Independent values that a bootstrap needs: resampling fewer never leaves their own range, which holds the mean too seldom."""

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
    """The mean of independent values [n], with the interval of a bootstrap over them (`ends`).

    The same values give the same interval: resampling has a fixed generator. Raises ValueError for no value, or one that is not
    finite."""
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or not len(data) or not np.isfinite(data).all():
        raise ValueError(f"a mean needs finite values in one row, got shape {data.shape}")
    means = _weights(_random(), len(data), draws) @ data
    return Estimate(float(data.mean()), *ends(means, len(data), confidence=confidence))


def crossed_estimate(values: F64, less: F64 | None = None, *, draws: int = DRAWS) -> Estimate:
    """The mean over training seeds and starts, `values` [S,n], less that of `less` [S,n] from the same starts, with the interval of a
    bootstrap that draws seeds as well as starts (the pigeonhole bootstrap: Owen 2007). Both sides see the same starts in a draw; their
    seeds are drawn apart, since no model of one has a partner in the other. One seed is taken as it is.

    Raises ValueError where starts are not the same number, or a value is not finite."""
    sides = [np.asarray(side, np.float64) for side in (values, less) if side is not None]
    n = sides[0].shape[-1]
    if any(side.ndim != 2 or side.shape[1] != n or not side.size or not np.isfinite(side).all() for side in sides):
        raise ValueError(
            f"finite values [seeds,starts] of the same starts, got shapes {[side.shape for side in sides]}"
        )
    random = _random()
    starts = _weights(random, n, draws)
    drawn = [np.einsum("ds,sn,dn->d", _weights(random, len(side), draws), side, starts) for side in sides]
    value = sides[0].mean() - (sides[1].mean() if less is not None else 0)
    return Estimate(float(value), *ends(drawn[0] - (drawn[1] if less is not None else 0), n))


def ends(drawn: F64, n: int, *, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The ends of the interval of a statistic over `n` independent values, from what it is in the draws of a bootstrap [draws]: the
    expanded percentiles (Hesterberg 2015), as far out for a mean of normal values as Student's. NaN, NaN for fewer than FEWEST."""
    if n < FEWEST or not np.isfinite(drawn).any():
        return math.nan, math.nan
    tail = NormalDist().cdf(-math.sqrt(n / (n - 1)) * _students_quantile((1 + confidence) / 2, n - 1))
    low, high = np.nanquantile(drawn, [tail, 1 - tail])
    return float(low), float(high)


def paired_difference(ours: Sequence[float], theirs: Sequence[float], *, draws: int = DRAWS) -> Estimate:
    """Mean of ours - theirs [n], pair by pair, with its bootstrap interval: what is common to a pair drops out.

    Raises ValueError where they are not of one length."""
    if len(ours) != len(theirs):
        raise ValueError(f"pairs need one value on each side, got {len(ours)} and {len(theirs)}")
    return mean_estimate(np.asarray(ours, np.float64) - np.asarray(theirs, np.float64), draws=draws)


def rate_estimate(successes: float, trials: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """successes / trials with the score interval of Wilson (1927), which stays within [0, 1] and has a width at 0 and 1 too.

    Successes are no whole number where a trial counts by its share of them. Raises ValueError unless 0 <= successes <= trials and
    trials > 0."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    return Estimate(rate, max(0.0, centre - half), min(1.0, centre + half))


def _random() -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=SEED))


def _weights(random: np.random.Generator, n: int, draws: int) -> F64:
    """The share of each of n values in every draw with replacement, float64 [draws,n]."""
    return random.multinomial(n, np.full(n, 1 / n), size=draws) / n


def _students_quantile(level: float, freedom: int) -> float:
    """Of Student's distribution, by the expansion in 1 / freedom (Abramowitz & Stegun 26.7.5): within 0.5 % from 4 degrees on."""
    x = NormalDist().inv_cdf(level)
    terms = (
        x**3 + x,
        5 * x**5 + 16 * x**3 + 3 * x,
        3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x,
    )
    return x + math.fsum(
        term / (scale * freedom**k) for k, (term, scale) in enumerate(zip(terms, (4, 96, 384), strict=True), 1)
    )
