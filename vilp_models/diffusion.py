"""Denoising diffusion as free functions: noise levels, what a network is to predict, samplers.

Symbols as in Ho et al. 2020: x0 the data, ε unit noise, ᾱ_t (alphas_bar) the share of x0's variance left at level t, so that
x_t = √ᾱ_t x0 + √(1-ᾱ_t) ε. Levels are 0 … T-1, the last the noisiest. Samples are float32 tensors of any shape [B,…].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from diffusers import DPMSolverMultistepScheduler
from torch import Tensor

Prediction = Literal["v", "epsilon"]
Spacing = Literal["trailing", "leading"]
Network = Callable[[Tensor, Tensor], Tensor]
"""(x_t [B,…], t int64 [B]) -> what it predicts, like x_t."""

MAX_BETA = 0.999


def cosine_alphas_bar(levels: int, *, zero_terminal_snr: bool) -> Tensor:
    """ᾱ of the squared-cosine schedule (Nichol and Dhariwal 2021, eq. 17), float64 [levels], falling.

    `zero_terminal_snr` shifts and scales √ᾱ so that the last level is pure noise, as sampling begins (Lin et al. 2024,
    algorithm 1); without, ᾱ there is small but not zero.
    """
    f = torch.cos((torch.arange(levels + 1, dtype=torch.float64) / levels + 0.008) / 1.008 * math.pi / 2).square()
    alphas_bar = (1 - (1 - f[1:] / f[:-1]).clamp(max=MAX_BETA)).cumprod(0)
    if not zero_terminal_snr:
        return alphas_bar
    root = alphas_bar.sqrt()
    return ((root - root[-1]) * root[0] / (root[0] - root[-1])).square()


def sampling_levels(levels: int, steps: int, spacing: Spacing) -> list[int]:
    """The levels that `steps` denoising steps visit, noisiest first (Lin et al. 2024, table 2).

    "trailing" begins at the last level; "leading" at the (steps-1)/steps-th, which is not pure noise.
    """
    if spacing == "trailing":
        return [round(levels - i * levels / steps) - 1 for i in range(steps)]
    return [i * (levels // steps) for i in reversed(range(steps))]


def add_noise(x0: Tensor, noise: Tensor, alpha_bar: Tensor) -> Tensor:
    """x_t from x0 and ε at ᾱ_t, which broadcasts."""
    return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise


def target(x0: Tensor, noise: Tensor, alpha_bar: Tensor, prediction: Prediction) -> Tensor:
    """What the network is to predict at ᾱ_t: ε, or v = √ᾱ ε - √(1-ᾱ) x0 (Salimans and Ho 2022)."""
    return noise if prediction == "epsilon" else alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * x0


def denoised(x_t: Tensor, predicted: Tensor, alpha_bar: float, prediction: Prediction) -> tuple[Tensor, Tensor]:
    """(x0, ε) as predicted from x_t. With "epsilon" the first is ε's error over √ᾱ: never at ᾱ = 0."""
    a, b = math.sqrt(alpha_bar), math.sqrt(1 - alpha_bar)
    if prediction == "epsilon":
        return (x_t - b * predicted) / a, predicted
    return a * x_t - b * predicted, a * predicted + b * x_t


def ddim(
    network: Network, noise: Tensor, alphas_bar: Sequence[float], levels: Sequence[int], prediction: Prediction = "v"
) -> Tensor:
    """x0 from `noise` by deterministic DDIM (Song et al. 2021, eq. 12 with η = 0) through `levels`, noisiest first."""
    steps = [*(alphas_bar[level] for level in levels), 1.0]
    x = noise
    for i, level in enumerate(levels):
        t = torch.full(x.shape[:1], level, device=x.device)
        x0, epsilon = denoised(x, network(x, t).to(x.dtype), steps[i], prediction)
        x = math.sqrt(steps[i + 1]) * x0 + math.sqrt(1 - steps[i + 1]) * epsilon
    return x


def dpm_solver(
    network: Network,
    noise: Tensor,
    alphas_bar: Sequence[float],
    steps: int,
    *,
    spacing: Spacing,
    prediction: Prediction = "v",
) -> Tensor:
    """x0 from `noise` by DPM-Solver++ of second order (Lu et al. 2022), diffusers' multistep solver, in `steps` calls."""
    before = [1.0, *alphas_bar[:-1]]
    scheduler = DPMSolverMultistepScheduler(
        num_train_timesteps=len(alphas_bar),
        trained_betas=[1 - after / prior for after, prior in zip(alphas_bar, before, strict=True)],
        prediction_type="v_prediction" if prediction == "v" else "epsilon",
        timestep_spacing=spacing,
        rescale_betas_zero_snr=bool(
            alphas_bar[-1] == 0
        ),  # moves nothing here, but keeps the solver's logarithms finite
        final_sigmas_type="zero",
        solver_order=2,
    )
    scheduler.set_timesteps(steps, device=noise.device)
    x = noise
    for t in scheduler.timesteps:
        x = scheduler.step(network(x, t.expand(x.shape[0])).to(x.dtype), t, x, return_dict=False)[0]
    return x
