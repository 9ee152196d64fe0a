"""Noise levels and samplers, against what the papers say and diffusers does."""

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler
from diffusers.schedulers.scheduling_ddim import rescale_zero_terminal_snr

from vilp_models.diffusion import add_noise, cosine_alphas_bar, ddim, denoised, dpm_solver, sampling_levels, target

LEVELS = 300


def scheduler(prediction, spacing, *, zero_snr):
    return DDIMScheduler(
        num_train_timesteps=LEVELS,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="v_prediction" if prediction == "v" else "epsilon",
        timestep_spacing=spacing,
        rescale_betas_zero_snr=zero_snr,
        clip_sample=False,
    )


def network(x, t):
    """Smooth in both, and no function of the solver's order."""
    return torch.tanh(0.7 * x + (t.double() / LEVELS).to(x).view(-1, *[1] * (x.ndim - 1)) - 0.3)


@pytest.mark.parametrize("zero_snr", [True, False])
def test_noise_levels_are_diffusers_squared_cosine(zero_snr):
    theirs = scheduler("v", "trailing", zero_snr=zero_snr).alphas_cumprod
    ours = cosine_alphas_bar(LEVELS, zero_terminal_snr=zero_snr)
    assert torch.allclose(ours.float(), theirs, rtol=1e-3, atol=1e-6)
    assert (ours[1:] < ours[:-1]).all()


def test_the_last_level_is_pure_noise_with_zero_terminal_snr():
    assert cosine_alphas_bar(LEVELS, zero_terminal_snr=True)[-1] == 0
    assert 0 < cosine_alphas_bar(LEVELS, zero_terminal_snr=False)[-1] < 1e-6
    betas = torch.linspace(1e-3, 0.2, 50, dtype=torch.float64)
    bars = (1 - betas).cumprod(0).sqrt()
    scaled = ((bars - bars[-1]) * bars[0] / (bars[0] - bars[-1])).square()
    assert torch.allclose((1 - rescale_zero_terminal_snr(betas)).cumprod(0), scaled, atol=1e-9)


@pytest.mark.parametrize("steps", [1, 4, 8, 16, 300])
@pytest.mark.parametrize("spacing", ["trailing", "leading"])
def test_levels_are_those_of_diffusers(spacing, steps):
    theirs = scheduler("v", spacing, zero_snr=True)
    theirs.set_timesteps(steps)
    assert sampling_levels(LEVELS, steps, spacing) == theirs.timesteps.tolist()


def test_leading_spacing_starts_where_the_release_did():
    assert [sampling_levels(LEVELS, k, "leading")[0] for k in (4, 8)] == [225, 259]


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
def test_a_perfect_prediction_gives_back_data_and_noise(prediction):
    random = torch.Generator().manual_seed(0)
    x0, noise = torch.randn(2, 3, 5, generator=random), torch.randn(2, 3, 5, generator=random)
    alpha_bar = torch.tensor(0.3)
    got = denoised(add_noise(x0, noise, alpha_bar), target(x0, noise, alpha_bar, prediction), 0.3, prediction)
    assert torch.allclose(got[0], x0, atol=1e-5)
    assert torch.allclose(got[1], noise, atol=1e-5)


@pytest.mark.parametrize(
    ("prediction", "spacing", "zero_snr"),
    [("v", "trailing", True), ("v", "leading", True), ("v", "leading", False), ("epsilon", "leading", False)],
)
@pytest.mark.parametrize("steps", [1, 4, 10])
def test_ddim_is_diffusers_ddim(prediction, spacing, zero_snr, steps):
    theirs = scheduler(prediction, spacing, zero_snr=zero_snr)
    theirs.set_timesteps(steps)
    noise = torch.randn(3, 2, 4, 4, generator=torch.Generator().manual_seed(1))
    x = noise
    for t in theirs.timesteps:
        x = theirs.step(network(x, t.expand(3)), t, x, eta=0.0).prev_sample
    levels = sampling_levels(LEVELS, steps, spacing)
    ours = ddim(network, noise, theirs.alphas_cumprod.tolist(), levels, prediction)
    assert torch.allclose(ours, x, atol=2e-5)


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
def test_both_samplers_find_a_gaussian(prediction):
    """For data N(m, s²) the best prediction is known in closed form, and the way back is an affine map of the noise."""
    mean, std = 0.8, 0.5
    spacing = "trailing" if prediction == "v" else "leading"
    bars = cosine_alphas_bar(LEVELS, zero_terminal_snr=prediction == "v")

    def best(x, t):
        bar = bars[t].view(-1, 1).to(x)
        expected = mean + bar.sqrt() * std**2 * (x - bar.sqrt() * mean) / (bar * std**2 + 1 - bar)
        noise = (x - bar.sqrt() * expected) / (1 - bar).sqrt()
        return target(expected, noise, bar, prediction)

    noise = torch.randn(4000, 1, generator=torch.Generator().manual_seed(2))
    many = ddim(best, noise, bars.tolist(), sampling_levels(LEVELS, 100, spacing), prediction)
    assert many.mean().item() == pytest.approx(mean, abs=0.05)
    assert many.std().item() == pytest.approx(std, abs=0.05)
    few = dpm_solver(best, noise, bars.tolist(), 12, spacing=spacing, prediction=prediction)
    assert few.std().item() == pytest.approx(std, abs=0.06)


def test_the_fast_solver_needs_fewer_steps_than_ddim():
    bars = cosine_alphas_bar(LEVELS, zero_terminal_snr=True)

    def best(x, t):
        bar = bars[t].view(-1, 1).to(x)
        expected = bar.sqrt() * 0.25 * x / (bar * 0.25 + 1 - bar)
        noise = (x - bar.sqrt() * expected) / (1 - bar).sqrt()
        return target(expected, noise, bar, "v")

    noise = torch.linspace(-2, 2, 50)[:, None]
    exact = ddim(best, noise, bars.tolist(), sampling_levels(LEVELS, 300, "trailing"), "v")
    ours = ddim(best, noise, bars.tolist(), sampling_levels(LEVELS, 8, "trailing"), "v")
    fast = dpm_solver(best, noise, bars.tolist(), 8, spacing="trailing", prediction="v")
    assert np.abs(fast - exact).max() < np.abs(ours - exact).max()
