"""One resize for ingest and policies: sizes, fits, and no change of aspect ratio that nobody asked for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.synthetic import colour_card
from vilp_data.errors import UsageError
from vilp_data.geometry import fit_image


def test_an_image_of_the_right_size_is_not_touched() -> None:
    card = colour_card(48, 64)
    assert fit_image(card, 48, 64, None) is card


@given(
    st.integers(8, 80),
    st.integers(8, 80),
    st.integers(4, 64),
    st.integers(4, 64),
    st.sampled_from(["crop", "pad", "stretch"]),
)
def test_every_fit_gives_the_size_asked_for(h: int, w: int, height: int, width: int, fit: str) -> None:
    out = fit_image(colour_card(h, w), height, width, fit)  # type: ignore[arg-type]
    assert out.shape == (height, width, 3)
    assert out.dtype == np.uint8


def test_an_unstated_change_of_aspect_ratio_is_refused_and_says_what_to_state() -> None:
    with pytest.raises(UsageError, match="fit = "):
        fit_image(colour_card(48, 64), 48, 48, None)


def test_halving_averages_blocks_of_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    mean = image.reshape(20, 2, 30, 2, 3).mean(axis=(1, 3))
    assert np.abs(fit_image(image, 20, 30, None) - mean).max() <= 0.5


@pytest.mark.parametrize(("height", "width"), [(96, 8), (64, 8), (32, 8)])
def test_a_side_that_shrinks_is_averaged_whatever_the_other_does(height: int, width: int) -> None:
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::8] = 240
    assert (fit_image(stripes, height, width, "stretch") == 30).all()
    assert (fit_image(stripes.swapaxes(0, 1), width, height, "stretch") == 30).all()


def test_an_image_that_grows_is_interpolated_and_one_that_shrinks_is_not_changed_by_it() -> None:
    image = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    np.testing.assert_array_equal(fit_image(image, 30, 40, None), cv2.resize(image, (40, 30)))
    np.testing.assert_array_equal(
        fit_image(image, 9, 12, None), cv2.resize(image, (12, 9), interpolation=cv2.INTER_AREA)
    )


def test_cropping_keeps_the_middle_and_padding_keeps_the_whole() -> None:
    wide = np.zeros((20, 60, 3), np.uint8)
    wide[:, 20:40] = 200
    assert (fit_image(wide, 20, 20, "crop") == 200).all()
    padded = fit_image(wide, 60, 60, "pad")
    assert (padded[:20] == 0).all()
    assert (padded[40:] == 0).all()
    assert (padded[20:40] == wide).all()


def test_corners_keep_their_colours() -> None:
    small = fit_image(colour_card(96, 128), 48, 64, None)
    assert [tuple(small[y, x]) for y, x in ((2, 2), (2, -3), (-3, 2), (-3, -3))] == [
        (230, 20, 20), (20, 200, 20), (20, 20, 230), (230, 220, 20)
    ]  # fmt: skip
