from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.plots import frame_psnr
from vilp_models.metrics import MAX_PSNR_DB, moving_mask, psnr, temporal_median


def _grey(value: int, frames: int = 3) -> np.ndarray:
    return np.full((frames, 8, 12, 3), value, np.uint8)


@given(st.integers(0, 255), st.integers(0, 255))
def test_psnr_of_a_constant_offset_is_its_formula_both_ways(a: int, b: int) -> None:
    expected = MAX_PSNR_DB if a == b else 20 * math.log10(255 / abs(a - b))
    assert psnr(_grey(a), _grey(b)) == pytest.approx(expected, abs=1e-3)
    assert psnr(_grey(b), _grey(a)) == pytest.approx(expected, abs=1e-3)


@given(st.integers(0, 2**32 - 1))
def test_psnr_of_a_frame_is_what_the_viewer_plots_for_it(seed: int) -> None:
    real, other = (np.random.default_rng([seed, i]).integers(0, 256, (2, 4, 6, 3), np.uint8) for i in range(2))
    plotted = frame_psnr(real, other)
    assert [psnr(a, b) for a, b in zip(real, other, strict=True)] == pytest.approx(plotted.tolist(), abs=1e-3)


def test_psnr_over_a_mask_ignores_everything_else() -> None:
    real, other = _grey(100), _grey(100)
    other[:, :, 6:] = 0
    mask = np.zeros((3, 8, 12), np.bool_)
    mask[:, :, :6] = True
    assert psnr(real, other, mask) == MAX_PSNR_DB
    assert psnr(real, other, ~mask) == pytest.approx(20 * math.log10(255 / 100), abs=1e-3)
    assert math.isnan(psnr(real, other, np.zeros_like(mask)))


def test_what_passes_through_moves_and_the_background_does_not() -> None:
    frames = _grey(200, frames=5)
    for i in range(5):
        frames[i, 2, 2 * i] = (200, 200, 20)  # one channel is enough
    frames[0, 5, 5] += 10  # as much as compression may do
    moving = moving_mask(frames, temporal_median(frames))
    assert moving.sum() == 5
    assert all(moving[i, 2, 2 * i] for i in range(5))


@given(st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_median_is_a_value_of_its_pixel_in_the_middle_of_its_order(n: int, seed: int) -> None:
    frames = np.random.default_rng(seed).integers(0, 256, (n, 2, 3, 3), np.uint8)
    assert np.array_equal(temporal_median(frames), np.sort(frames, axis=0)[(n - 1) // 2])
