"""Depth: what is no reading stays none, distances keep their place and their unit, and a picture is never taken for one."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.synthetic import colour_card, encode_image
from vilp_data import limits
from vilp_data.decode.depth import decode_depth, depth_levels, is_depth, is_grey16, level_metres
from vilp_data.decode.images import decode_image
from vilp_data.decode.rvl import unpack_rvl
from vilp_data.errors import DecodeError, UsageError
from vilp_data.geometry import fit_depth
from vilp_data.spec import DepthSpec
from vilp_data.types import Message

MM = DepthSpec(unit="mm", near_m=0.5, far_m=3.0)
M = DepthSpec(unit="m", near_m=0.5, far_m=3.0)
U16 = npt.NDArray[np.uint16]


def raw(pixels: npt.NDArray[Any], encoding: str, *, big: bool = False, padding: int = 0, schema: str = "") -> Message:
    height, width = pixels.shape
    rows = [row.astype(row.dtype.newbyteorder(">" if big else "<")).tobytes() + b"\xee" * padding for row in pixels]
    body = SimpleNamespace(data=b"".join(rows), encoding=encoding, height=height, width=width, step=len(rows[0]))
    body.is_bigendian = int(big)
    return Message("/depth", schema or "sensor_msgs/msg/Image", 5, 5, body)


def compressed(data: bytes, said: str) -> Message:
    return Message("/depth", "sensor_msgs/msg/CompressedImage", 5, 5, SimpleNamespace(data=data, format=said))


def png(pixels: npt.NDArray[Any]) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def packed_rvl(pixels: U16) -> bytes:
    """RVL by its definition, a nibble at a time."""
    nibbles: list[int] = []

    def number(value: int) -> None:
        while True:
            nibbles.append((value & 7) | (8 if value >> 3 else 0))
            value >>= 3
            if not value:
                return

    flat, at, last = pixels.ravel().tolist(), 0, 0
    while at < len(flat):
        start = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        number(at - start)
        start = at
        while at < len(flat) and flat[at] != 0:
            at += 1
        number(at - start)
        for value in flat[start:at]:
            step = value - last
            number((step << 1) ^ (step >> 31))
            last = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [sum(n << (28 - 4 * i) for i, n in enumerate(nibbles[k : k + 8])) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def ramp(height: int = 12, width: int = 16) -> U16:
    """Distances in mm, every one another; the first column has no reading."""
    image = (500 + 7 * np.arange(height * width)).reshape(height, width).astype(np.uint16)
    image[:, 0] = 0
    return image


def metres(image: U16) -> npt.NDArray[np.float32]:
    return np.where(image == 0, np.nan, np.clip(image / 1000, 0.5, 3.0)).astype(np.float32)


# --- what a message measures ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schema", ["sensor_msgs/msg/Image", "sensor_msgs/Image", "foxglove.RawImage"])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize(("big", "padding"), [(False, 0), (True, 0), (False, 6), (True, 3)])
def test_raw_millimetres_are_read_in_either_byte_order(schema: str, encoding: str, big: bool, padding: int) -> None:
    message = raw(ramp(), encoding, big=big, padding=padding, schema=schema)
    assert (is_depth(message), is_grey16(message)) == (encoding == "16UC1", encoding == "mono16")
    np.testing.assert_allclose(decode_depth(message, MM), metres(ramp()), rtol=1e-6)


@pytest.mark.parametrize("big", [False, True])
def test_raw_metres_are_read_in_either_byte_order(big: bool) -> None:
    distances = np.where(ramp() == 0, np.nan, ramp() / 1000).astype(np.float32)
    np.testing.assert_allclose(decode_depth(raw(distances, "32FC1", big=big), M), metres(ramp()), rtol=1e-6)


def test_the_unit_is_the_one_that_the_task_states() -> None:
    assert decode_depth(raw(np.full((2, 2), 2, np.uint16), "16UC1"), M)[0, 0] == 2.0
    assert decode_depth(raw(np.full((2, 2), 2000, np.float32), "32FC1"), MM)[0, 0] == 2.0


@pytest.mark.parametrize(
    ("said", "data"),
    [
        ("png", png(ramp())),
        ("16UC1; png compressed", png(ramp())),
        ("16UC1; compressedDepth", struct.pack("<iff", 0, 0, 0) + png(ramp())),
        ("16UC1; compressedDepth png", struct.pack("<iff", 0, 0, 0) + png(ramp())),
        ("mono16; compressedDepth png", struct.pack("<iff", 0, 0, 0) + png(ramp())),
        ("16UC1; compressedDepth rvl", struct.pack("<iffII", 0, 0, 0, 16, 12) + packed_rvl(ramp())),
    ],
)
def test_compressed_millimetres_are_exact(said: str, data: bytes) -> None:
    message = compressed(data, said)
    np.testing.assert_allclose(decode_depth(message, MM), metres(ramp()), rtol=1e-6)
    assert (is_depth(message), is_grey16(message)) == (said != "png", said == "png")


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_a_picture_is_neither_depth_nor_grey_of_16_bits(kind: Any) -> None:
    for message in (compressed(encode_image(colour_card(), kind), kind), compressed(b"torn", kind)):
        assert (is_depth(message), is_grey16(message)) == (False, False)


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_compressed_floats_are_inverse_distances_and_come_back_in_metres(codec: str) -> None:
    distances = np.where(ramp() == 0, np.nan, ramp() / 1000)
    quantum, farthest = 100.0, 10.0  # the transport's own parameters
    slope = quantum * (quantum + 1)
    offset = 1 - slope / farthest
    coded = np.where(np.isnan(distances), 0, slope / np.nan_to_num(distances, nan=1) + offset).astype(np.uint16)
    packed = png(coded) if codec == "png" else struct.pack("<II", 16, 12) + packed_rvl(coded)
    message = compressed(struct.pack("<iff", 0, slope, offset) + packed, f"32FC1; compressedDepth {codec}")
    np.testing.assert_allclose(decode_depth(message, M), metres(ramp()), rtol=2e-3)


FEW = st.sampled_from([0, 0, 0, 1, 700, 701, 65535])


@given(image=hnp.arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=FEW))
def test_rvl_gives_back_every_image(image: U16) -> None:
    assert np.array_equal(unpack_rvl(packed_rvl(image), image.size), image.ravel())


@given(data=st.binary(max_size=60), count=st.integers(1, 200))
def test_rvl_that_is_noise_is_an_image_or_a_value_error(data: bytes, count: int) -> None:
    try:
        assert len(unpack_rvl(data, count)) == count
    except ValueError as error:
        assert "pixel" in str(error) or "ends" in str(error)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(12, 16), (12, 16, 1)])
def test_arrays_of_one_channel_are_depth_where_the_task_says_so(dtype: type, shape: tuple[int, ...]) -> None:
    message = Message("depth", "array", 5, 5, ramp().astype(dtype).reshape(shape))
    np.testing.assert_allclose(decode_depth(message, MM), metres(ramp()), rtol=1e-6)


def test_what_is_no_reading_is_none_and_what_is_out_of_range_is_clipped() -> None:
    odd = np.array([[np.nan, 0.0, -1.0, np.inf, -np.inf, 0.1, 0.5, 2.0, 3.0, 9.0]], np.float32)
    found = decode_depth(raw(odd, "32FC1"), M)
    np.testing.assert_array_equal(found, np.array([[np.nan] * 3 + [3.0, 0.5, 0.5, 0.5, 2.0, 3.0, 3.0]], np.float32))
    assert depth_levels(found, M).ravel().tolist() == [0, 0, 0, 255, 1, 1, 1, 153, 255, 255]


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (raw(np.zeros((4, 4), np.uint8), "mono8"), "16UC1"),
        (raw(np.zeros((4, 4), np.uint16), "rgb8"), "16UC1"),
        (compressed(encode_image(colour_card(), "jpeg"), "jpeg"), "holds no depth"),
        (compressed(encode_image(colour_card(), "png"), "png"), "holds no depth"),
        (compressed(b"\0" * 12, "16UC1; compressedDepth"), "cut off"),
        (compressed(b"\0" * 40, "16UC1; compressedDepth png"), "neither PNG nor RVL"),
        (compressed(struct.pack("<iff", 0, 0, 0) + png(ramp())[:80], "16UC1; compressedDepth png"), "cut off"),
        (compressed(struct.pack("<iffII", 0, 0, 0, 16, 12) + packed_rvl(ramp())[:20], "16UC1; compressedDepth rvl"), "cut off"),
        (Message("depth", "array", 5, 5, np.zeros((4, 4, 3), np.float32)), "one channel"),
        (Message("depth", "array", 5, 5, np.zeros((4, 4), np.uint8)), "uint16 or float"),
        (Message("/joints", "sensor_msgs/msg/JointState", 5, 5, SimpleNamespace()), "no depth images"),
    ],
)  # fmt: skip
def test_what_is_no_depth_is_refused_in_words(message: Message, says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        decode_depth(message, MM)


def test_a_size_that_no_camera_has_is_refused_before_memory_is_taken() -> None:
    huge = struct.pack("<iffII", 0, 0, 0, 1 << 20, 1 << 20)
    with pytest.raises(DecodeError, match="VILP_MAX_IMAGE_PIXELS"):
        decode_depth(compressed(huge, "16UC1; compressedDepth rvl"), MM)
    assert limits.IMAGE_PIXELS < 1 << 40


# --- as a picture, where the task says how bright white is ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "message",
    [raw(ramp(), "mono16"), raw(ramp(), "16UC1"), compressed(png(ramp()), "mono16; png compressed")],
    ids=["mono16", "16UC1", "png"],
)
def test_grey_of_16_bits_is_a_picture_only_with_levels(message: Message) -> None:
    with pytest.raises(DecodeError, match=r"levels = \[black, white\]"):
        decode_image(message)
    picture = decode_image(message, levels=(500, 1010))
    expected = np.rint(np.clip((ramp().astype(float) - 500) / 510 * 255, 0, 255)).astype(np.uint8)
    assert np.array_equal(picture, np.repeat(expected[..., None], 3, axis=2))


@pytest.mark.parametrize(
    "message", [raw(np.zeros((4, 4), np.uint8), "mono8"), compressed(encode_image(colour_card(), "jpeg"), "jpeg")]
)
def test_levels_of_a_picture_that_needs_none_are_refused(message: Message) -> None:
    with pytest.raises(DecodeError, match="levels"):
        decode_image(message, levels=(0, 4095))


# --- stored levels and sizes ----------------------------------------------------------------------------------------------------

READINGS = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 24), st.integers(1, 24)),
    elements=st.one_of(st.just(float("nan")), st.floats(0.5, 3.0, width=32)),
)


@given(distances=READINGS)
def test_levels_keep_distances_to_half_a_level_and_nothing_else_is_zero(distances: npt.NDArray[np.float32]) -> None:
    levels = depth_levels(distances, M)
    assert levels.dtype == np.uint8
    assert levels.shape == (*distances.shape, 1)
    np.testing.assert_array_equal(levels[..., 0] == 0, np.isnan(distances))
    np.testing.assert_allclose(level_metres(levels, M)[..., 0], distances, atol=2.5 / 254 / 2 + 1e-5)


@given(distances=READINGS, height=st.integers(1, 30), width=st.integers(1, 30))
def test_resizing_never_makes_a_distance_that_lies_outside_those_that_were_read(
    distances: npt.NDArray[np.float32], height: int, width: int
) -> None:
    fitted = fit_depth(distances, height, width, "stretch")
    assert fitted.shape == (height, width)
    known = distances[~np.isnan(distances)]
    there = fitted[~np.isnan(fitted)]
    if len(there):
        assert known.min() - 1e-4 <= there.min()
        assert there.max() <= known.max() + 1e-4


def test_a_missing_reading_is_not_averaged_into_a_distance() -> None:
    block = np.array([[1.0, np.nan], [1.0, 2.0]], np.float32)
    assert fit_depth(block, 1, 1, None)[0, 0] == pytest.approx(4 / 3)
    mostly_missing = np.array([[1.0, np.nan], [np.nan, np.nan]], np.float32)
    assert np.isnan(fit_depth(mostly_missing, 1, 1, None)[0, 0])


@pytest.mark.parametrize(("height", "width"), [(6, 6), (8, 16), (4, 6)])
def test_a_depth_image_that_grows_repeats_readings_in_their_place_and_makes_none_up(height: int, width: int) -> None:
    step = np.full((4, 4), 0.6, np.float32)
    step[:, 2:] = 2.9
    step[1, 1] = np.nan
    rows = ((np.arange(height) + 0.5) * 4 / height).astype(int)
    columns = ((np.arange(width) + 0.5) * 4 / width).astype(int)
    np.testing.assert_array_equal(fit_depth(step, height, width, "stretch"), step[np.ix_(rows, columns)])


def test_a_side_of_a_depth_image_that_shrinks_is_averaged_whatever_the_other_does() -> None:
    ramp = np.tile(np.arange(64, dtype=np.float32), (4, 1))
    means = np.arange(8, dtype=np.float32) * 8 + 3.5
    np.testing.assert_allclose(fit_depth(ramp, 8, 8, "stretch"), np.tile(means, (8, 1)))


def test_crop_keeps_the_middle_and_padding_has_no_reading() -> None:
    wide = np.full((4, 12), 1.0, np.float32)
    wide[:, 4:8] = 2.0
    assert (fit_depth(wide, 4, 4, "crop") == 2.0).all()
    padded = fit_depth(wide, 12, 12, "pad")
    assert np.isnan(padded[:4]).all()
    assert np.isnan(padded[8:]).all()
    np.testing.assert_array_equal(padded[4:8], wide)
    with pytest.raises(UsageError, match="fit = "):
        fit_depth(wide, 4, 4, None)
