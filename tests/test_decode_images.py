"""Raw encodings of cameras: mosaics and shared colour come out in RGB, measurements and unstated orders are refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.synthetic import colour_card
from vilp_data.decode.images import CHANNELS, decode_image
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message

RED, GREEN, BLUE = 0, 1, 2
FIRST_CORNER = {
    "bayer_rggb8": ((RED, GREEN), (GREEN, BLUE)),
    "bayer_bggr8": ((BLUE, GREEN), (GREEN, RED)),
    "bayer_gbrg8": ((GREEN, BLUE), (RED, GREEN)),
    "bayer_grbg8": ((GREEN, RED), (BLUE, GREEN)),
}
PAIR_ORDER = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUYV", "yuyv": "YUYV"}
COLOURS = st.tuples(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))


def raw(pixels: U8, encoding: str, *, padding: int = 0) -> Message:
    """A raw image message of uint8 [H,W] or [H,W,bytes a pixel], each row followed by padding."""
    rows = [row.tobytes() + b"\xee" * padding for row in pixels]
    height, width = pixels.shape[:2]
    body = SimpleNamespace(data=b"".join(rows), encoding=encoding, height=height, width=width, step=len(rows[0]))
    return Message("/t", "sensor_msgs/msg/Image", 5, 5, body)


def mosaic_of(image: U8, encoding: str) -> U8:
    """What a sensor behind this mosaic sees of an RGB image: one of the three colours at each pixel, uint8 [H,W]."""
    height, width, _ = image.shape
    channel = np.tile(FIRST_CORNER[encoding], (height // 2, width // 2))
    return np.take_along_axis(image, channel[..., None], axis=2)[..., 0]


def paired(image: U8, order: str) -> U8:
    """An RGB image in YUV 4:2:2 by the formulas of ITU-R BT.601, uint8 [H,W,2]; colour is that of the left pixel of a pair."""
    red, green, blue = np.moveaxis(image.astype(np.float64) / 255, 2, 0)
    luma = 16 + 65.481 * red + 128.553 * green + 24.966 * blue
    u = (128 - 37.797 * red - 74.203 * green + 112.0 * blue)[:, ::2]
    v = (128 + 112.0 * red - 93.786 * green - 18.214 * blue)[:, ::2]
    parts = {"Y": [luma[:, ::2], luma[:, 1::2]], "U": [u], "V": [v]}
    laid_out = np.stack([parts[letter].pop(0) for letter in order], axis=2)
    return np.rint(laid_out).astype(np.uint8).reshape(*image.shape[:2], 2)


@given(colour=COLOURS, encoding=st.sampled_from(sorted(FIRST_CORNER)), padding=st.integers(0, 5))
def test_a_mosaic_of_one_colour_gives_that_colour(colour: tuple[int, int, int], encoding: str, padding: int) -> None:
    image = np.full((6, 8, 3), colour, np.uint8)
    assert np.array_equal(decode_image(raw(mosaic_of(image, encoding), encoding, padding=padding)), image)


@pytest.mark.parametrize("encoding", sorted(FIRST_CORNER))
def test_a_mosaic_of_the_colour_card_is_filled_in_the_right_way_round(encoding: str) -> None:
    card = colour_card(64, 64)
    decoded = decode_image(raw(mosaic_of(card, encoding), encoding))
    wrong = (np.abs(decoded.astype(int) - card) > 2).any(axis=2)
    assert wrong.mean() < 0.12  # where colours meet, neighbours are mixed
    for mistaken in (decoded[..., ::-1], decoded[::-1], decoded[:, ::-1]):
        assert (np.abs(mistaken.astype(int) - card) > 2).any(axis=2).mean() > 0.12


@given(colour=COLOURS, encoding=st.sampled_from(sorted(PAIR_ORDER)), padding=st.integers(0, 5))
def test_yuv_of_one_colour_gives_that_colour(colour: tuple[int, int, int], encoding: str, padding: int) -> None:
    image = np.full((3, 4, 3), colour, np.uint8)
    decoded = decode_image(raw(paired(image, PAIR_ORDER[encoding]), encoding, padding=padding))
    assert np.abs(decoded.astype(int) - image).max() <= 4  # 8-bit YUV is coarser than RGB


@pytest.mark.parametrize("encoding", sorted(PAIR_ORDER))
def test_yuv_of_the_colour_card_is_the_right_way_round(encoding: str) -> None:
    card = colour_card(64, 64)
    decoded = decode_image(raw(paired(card, PAIR_ORDER[encoding]), encoding))
    wrong = (np.abs(decoded.astype(int) - card) > 4).any(axis=2)
    assert wrong.mean() < 0.05
    assert (np.abs(decoded[..., ::-1].astype(int) - card) > 4).any(axis=2).mean() > 0.05


def test_one_channel_without_a_name_is_grey() -> None:
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    assert np.array_equal(decode_image(raw(grey, "8UC1")), np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize(
    ("encoding", "says"),
    [
        ("16UC1", "depth image"),
        ("32FC1", "depth image"),
        ("8UC3", "whether red or blue comes first"),
        ("bayer_rggb16", ", ".join(CHANNELS)),
        ("", ", ".join(CHANNELS)),
    ],
)
def test_encodings_that_would_have_to_be_guessed_at_are_refused_with_a_way_out(encoding: str, says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        decode_image(raw(np.zeros((4, 4, 3), np.uint8), encoding))


@pytest.mark.parametrize(("shape", "encoding"), [((2, 2), "bayer_rggb8"), ((4, 3, 2), "yuyv")])
def test_sizes_that_an_encoding_cannot_have_are_refused(shape: tuple[int, ...], encoding: str) -> None:
    with pytest.raises(DecodeError, match="too small|odd width"):
        decode_image(raw(np.zeros(shape, np.uint8), encoding))
