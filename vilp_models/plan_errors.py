"""How wrong imagined frames are: squared errors summed by episode and horizon step, then scored, with intervals. Pure.

Axes: E episodes, B starts, S samples, N planned frames (t+Δt … t+NΔt), R resamples; H W pixels, c h w latents.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vilp_data.types import F32, F64, I64, U8, Bool
from vilp_models.intervals import Estimate, ends
from vilp_models.metrics import MAX_PSNR_DB, squared_error

Measure = Literal["latent", "moving", "changed"]
"""latent   standardised latent error: squared, in units of each channel's training deviation, mean over channels and pixels
moving   PSNR in dB over the pixels of frame t+jΔt that differ from the episode's temporal median
changed  PSNR in dB over the pixels of frame t+jΔt that differ from frame t: where copying frame t must fail"""

MEASURES: tuple[Measure, ...] = ("latent", "moving", "changed")

RESAMPLES = 2000


@dataclass(frozen=True)
class Sums:
    """Squared errors of one candidate under one measure: `total` and `count` of what was summed, float64 [E,N] each."""

    total: F64
    count: F64

    @classmethod
    def zeros(cls, n_episodes: int, n_frames: int) -> Sums:
        return cls(np.zeros((n_episodes, n_frames)), np.zeros((n_episodes, n_frames)))

    def add(self, episode: int, total: F64, count: F64) -> None:
        """Count in starts of one episode, [B,N] each."""
        self.total[episode] += total.sum(axis=0)
        self.count[episode] += count.sum(axis=0)


@dataclass(frozen=True)
class Score:
    """A candidate under one measure, or the difference of two: every horizon step [N], their mean, and the last."""

    steps: F64
    mean: Estimate
    last: Estimate


def score(sums: Sums, measure: Measure, *, minus: Sums | None = None, seed: int = 0) -> Score:
    """The score of `sums`, less that of `minus` where given (paired: both are resampled alike).

    Errors are pooled over all starts of the episodes before they become a PSNR; the mean is over the horizon steps where it is
    defined. Intervals are of a bootstrap over episodes (`intervals.ends`)."""
    n_episodes = len(sums.total)
    weights = np.concatenate([np.ones((1, n_episodes)), resampled(n_episodes, seed=seed)])
    steps = _scores(sums, measure, weights) - (0 if minus is None else _scores(minus, measure, weights))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a step with no such pixels is NaN, and so may be all of them
        mean = np.nanmean(steps, axis=1)
    return Score(steps[0], _estimate(mean, n_episodes), _estimate(steps[:, -1], n_episodes))


def resampled(n_episodes: int, *, resamples: int = RESAMPLES, seed: int = 0) -> F64:
    """How often each episode is drawn in each of R draws with replacement: float64 [R,E]."""
    drawn = np.random.default_rng(seed).multinomial(n_episodes, np.full(n_episodes, 1 / n_episodes), size=resamples)
    return drawn.astype(np.float64)


def _scores(sums: Sums, measure: Measure, weights: F64) -> F64:
    """float64 [R,N] under each row of `weights` [R,E]."""
    total, count = weights @ sums.total, weights @ sums.count
    error = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    if measure == "latent":
        return error
    with np.errstate(divide="ignore"):
        decibels: F64 = np.minimum(10 * np.log10(255.0**2 / error), MAX_PSNR_DB)
    return decibels


def _estimate(values: F64, n_episodes: int) -> Estimate:
    """From the value itself [0] and those of the resamples [1:]."""
    return Estimate(float(values[0]), *ends(values[1:], n_episodes))


def latent_errors(true: F32, other: F32, std: Sequence[float]) -> F64:
    """Standardised squared error of every frame, float64 [...], of latents [...,c,h,w] that broadcast; `std` by channel."""
    scale = np.asarray(std, np.float32)[:, None, None]
    errors: F64 = np.square((true - other) / scale).mean(axis=(-3, -2, -1), dtype=np.float64)
    return errors


def masked_errors(real: U8, other: U8, mask: Bool) -> F64:
    """Squared error (0 to 255²) summed over the masked pixels of every frame, float64 [...], of images [...,H,W,3] that broadcast;
    mask bool [...,H,W]."""
    error = squared_error(real, other)
    summed: F64 = np.where(mask, error, 0).sum(axis=(-2, -1), dtype=np.float64)
    return summed


def best_samples(errors: F64) -> I64:
    """Of errors [B,S,N]: the sample with the least error over the horizon, int64 [B]."""
    best: I64 = errors.mean(axis=2).argmin(axis=1)
    return best


Table = Mapping[Measure, Mapping[str, Sums]]
"""measure -> candidate -> sums."""
