"""Decoding is exact, right way up and in RGB, or it is refused."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from dataclasses import make_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.real_data import real_data
from tests.synthetic import (
    STORE,
    Codec,
    Encoding,
    card_frame,
    colour_card,
    encode_image,
    image_topic,
    psnr,
    write_mcap,
)
from vilp_data.decode import compile_fields, decode_image, decode_vector, header_time_ns, is_image
from vilp_data.errors import DecodeError
from vilp_data.sources import open_log
from vilp_data.types import U8, Message

LOSSY_DB = 40.0  # what JPEG of quality 95, 4:4:4, keeps of the card


def message(body: Any, schema: str = "array") -> Message:
    return Message("/t", schema, 5, 5, body)


def raw(pixels: bytes, encoding: str, height: int, width: int, step: int) -> Message:
    body = SimpleNamespace(data=pixels, encoding=encoding, height=height, width=width, step=step, is_bigendian=1)
    return message(body, "sensor_msgs/msg/Image")


def compressed(data: bytes) -> Message:
    return message(SimpleNamespace(data=data, format="jpeg"), "foxglove.CompressedImage")


def carried(image: U8, codec: Codec, encoding: Encoding, folder: Path) -> U8:
    """The colour card after the trip through a log."""
    log = write_mcap(
        folder / "run.mcap",
        encoding=encoding,
        image_codec=codec,
        n_frames=2,
        height=image.shape[0],
        width=image.shape[1],
    )
    with open_log(log.path) as reader:
        return decode_image(next(iter(reader.messages([image_topic("front")]))))


def survives(card: U8, image: U8, codec: Codec) -> bool:
    """The check that every codec must pass."""
    return image.shape == card.shape and (
        psnr(card, image) > LOSSY_DB if codec == "jpeg" else np.array_equal(card, image)
    )


# --- images -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
def test_every_codec_carries_the_colour_card(tmp_path: Path, codec: Codec, encoding: Encoding) -> None:
    card = card_frame(0)
    assert survives(card, carried(card, codec, encoding, tmp_path), codec)


@pytest.mark.parametrize("codec", ["jpeg", "png"])
@pytest.mark.parametrize(
    "mistake",
    [
        lambda image: image[..., ::-1],
        lambda image: image[..., [1, 0, 2]],
        lambda image: image[::-1],
        lambda image: image[:, ::-1],
        lambda image: image[::-1, ::-1],
        lambda image: np.roll(image, 1, axis=1),
        lambda image: np.roll(image, 1, axis=0),
        lambda image: image.swapaxes(0, 1),
    ],
    ids=["bgr", "grb", "upside down", "mirrored", "turned", "a pixel right", "a pixel down", "transposed"],
)
def test_the_check_fails_for_every_common_mistake(codec: Codec, mistake: Any) -> None:
    card = colour_card(64, 64)
    image = decode_image(compressed(encode_image(card, codec)))
    assert survives(card, image, codec)
    assert not survives(card, mistake(image), codec)


@given(
    image=hnp.arrays(np.uint8, st.tuples(st.integers(1, 7), st.integers(1, 7), st.just(4))),
    encoding=st.sampled_from(["rgb8", "bgr8", "rgba8", "bgra8", "mono8"]),
    padding=st.integers(0, 9),
    pad_last=st.booleans(),
)
def test_raw_images_of_any_row_padding_decode_exactly(image: U8, encoding: str, padding: int, pad_last: bool) -> None:
    channels = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 3], "bgra8": [2, 1, 0, 3], "mono8": [0]}[
        encoding
    ]
    rows = [row.tobytes() + b"\xee" * padding for row in image[..., channels]]
    if not pad_last:
        rows[-1] = rows[-1][: len(rows[-1]) - padding]
    height, width, _ = image.shape
    decoded = decode_image(raw(b"".join(rows), encoding, height, width, width * len(channels) + padding))
    expected = image[..., [0, 0, 0]] if encoding == "mono8" else image[..., :3]
    assert decoded.dtype == np.uint8
    assert np.array_equal(decoded, expected)


def test_a_step_of_zero_means_rows_without_padding() -> None:
    card = colour_card(8, 8)
    assert np.array_equal(decode_image(raw(card.tobytes(), "rgb8", 8, 8, 0)), card)


@pytest.mark.parametrize(("n_bytes", "step"), [(191, 24), (0, 24), (192, 23)])
def test_raw_images_whose_bytes_do_not_fit_are_refused(n_bytes: int, step: int) -> None:
    with pytest.raises(DecodeError, match="do not fit"):
        decode_image(raw(bytes(n_bytes), "rgb8", 8, 8, step))


@pytest.mark.parametrize("codec", ["jpeg", "png"])
def test_a_cut_off_compressed_image_is_refused_at_every_length(codec: Any) -> None:
    data = encode_image(colour_card(), codec)
    for size in range(0, len(data) - 12, 37):
        with pytest.raises(DecodeError):
            decode_image(compressed(data[:size]))


@pytest.mark.parametrize(("quality", "bound"), [(101, 0), (95, 12)], ids=["lossless", "lossy"])
def test_webp_carries_the_colour_card(quality: int, bound: int) -> None:
    card = colour_card(64, 96)
    data = cv2.imencode(".webp", card[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    decoded = decode_image(compressed(data))
    corners = [(4, 4), (4, -5), (-5, 4), (-5, -5)]

    def error(image: U8) -> int:
        return max(int(np.abs(image[y, x].astype(int) - card[y, x]).max()) for y, x in corners)

    assert error(decoded) <= bound
    assert all(error(wrong) > 100 for wrong in (decoded[..., ::-1], decoded[::-1], decoded[:, ::-1]))
    for size in (11, 40, len(data) // 2, len(data) - 1):
        with pytest.raises(DecodeError):
            decode_image(compressed(data[:size]))


def test_a_colour_png_of_16_bits_keeps_its_upper_8() -> None:
    card = colour_card()
    data = cv2.imencode(".png", card[..., ::-1].astype(np.uint16) * 257)[1].tobytes()
    assert np.array_equal(decode_image(compressed(data)), card)


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp"])
def test_an_image_that_claims_a_size_no_camera_has_is_refused_unread(kind: str) -> None:
    data = bytearray(cv2.imencode(f".{kind}", colour_card())[1].tobytes())
    if kind == "png":
        data[16:24] = struct.pack(">II", 60_000, 60_000)
    elif kind == "jpeg":
        place = data.index(b"\xff\xc0") + 5
        data[place : place + 4] = struct.pack(">HH", 60_000, 60_000)
    else:
        data[21:25] = struct.pack("<I", 16383 | 16383 << 14)  # 14 bits each of width and height, less one
    with pytest.raises(DecodeError, match=r"VILP_MAX_IMAGE_PIXELS=\d{9,10}"):
        decode_image(compressed(bytes(data)))


def test_exif_orientation_is_ignored() -> None:
    card = colour_card()
    data = encode_image(card, "jpeg")
    tag = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)  # orientation 6: turn by 90 degrees
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + tag + bytes(4)
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    assert np.array_equal(decode_image(compressed(turned)), decode_image(compressed(data)))


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_picture() -> None:
    data = encode_image(colour_card(), "jpeg")
    thumbnail = b"Exif\0\0" + encode_image(colour_card(16, 16), "jpeg")
    whole = data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(thumbnail)) + thumbnail + data[2:]
    assert np.array_equal(decode_image(compressed(whole)), decode_image(compressed(data)))
    for size in (40, 4 + len(thumbnail), len(whole) // 2, len(whole) - 40):
        with pytest.raises(DecodeError, match="cut off"):
            decode_image(compressed(whole[:size]))


def test_a_sixteen_bit_png_is_refused() -> None:
    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 2, 2, 16, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", zlib.compress(bytes(10))) + part(b"IEND", b"")
    with pytest.raises(DecodeError, match="16 bits"):
        decode_image(compressed(data))


@pytest.mark.parametrize("data", [b"", b"RIFF....WAVE", b"\0" * 64])
def test_what_is_neither_jpeg_nor_png_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError, match="neither JPEG nor PNG"):
        decode_image(compressed(data))


def test_json_images_that_are_not_base64_are_refused() -> None:
    with pytest.raises(DecodeError, match="base64"):
        decode_image(message({"data": "%%%", "format": "jpeg"}, "foxglove.CompressedImage"))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
def test_image_arrays_are_exact(dtype: type) -> None:
    assert np.array_equal(decode_image(message(colour_card().astype(dtype))), colour_card())


@given(noise=st.floats(-0.0009, 0.0009))
def test_float_images_may_miss_whole_numbers_by_rounding_errors_only(noise: float) -> None:
    assert np.array_equal(decode_image(message(colour_card() + noise)), colour_card())


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (colour_card() / 255, "range 0 to 1"),
        ((colour_card() > 128).astype(np.float32), "range 0 to 1"),
        (colour_card() + 0.4, "whole numbers"),
        (colour_card() - 30.0, "whole numbers"),
        (colour_card() * 2.0, "whole numbers"),
        (np.where(colour_card() > 200, np.nan, 7.0), "whole numbers"),
        (colour_card().transpose(2, 0, 1), "channels come last"),
        (colour_card().astype(np.int16), "uint8 or float"),
        (np.zeros((4, 4)), "height, width, 3"),
    ],
)
def test_arrays_that_would_have_to_be_guessed_at_are_refused(image: Any, says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        decode_image(message(image))


def test_a_black_float_image_is_black() -> None:
    assert not decode_image(message(np.zeros((4, 4, 3), np.float32))).any()


def test_schemas_that_are_no_images_are_refused() -> None:
    joints = message(SimpleNamespace(position=[1.0]), "sensor_msgs/msg/JointState")
    assert not is_image(joints)
    with pytest.raises(DecodeError, match="no images"):
        decode_image(joints)


def test_real_json_log_holds_jpeg_camera_images() -> None:
    with open_log(real_data("logs/lichtblick/e2e_fixtures_assets_custom-camera-model.mcap")) as log:
        frames = [decode_image(m) for m in log.messages(["/image/compressed"])]
    assert len(frames) == 10
    assert {frame.shape for frame in frames} == {(360, 520, 3)}
    assert np.std(frames[0]) > 10


# --- vectors ----------------------------------------------------------------------------------------------------------

POSE = {
    "pose": {"position": {"x": 1, "y": 2.5, "z": -3}},
    "tags": ["a"],
    "list": [4, 5, 6, 7],
    "rows": [{"v": [8, 9]}, {"v": [10, 11]}],
}


def as_object(value: Any) -> Any:
    """The same message with attributes instead of keys, as decoded CDR has them."""
    return json.loads(json.dumps(value), object_hook=lambda table: make_dataclass("Body", table)(**table))


@pytest.mark.parametrize("body", [POSE, as_object(POSE)], ids=["dict", "object"])
@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        (["pose.position.x", "pose.position.z"], [1, -3]),
        (["list"], [4, 5, 6, 7]),
        (["list[1:3]", "pose.position.y"], [5, 6, 2.5]),
        (["list[3]"], [7]),
        (["rows[1].v[0]"], [10]),
        (["rows.v[0]"], [8, 9]),
    ],
)
def test_fields_are_paths_into_objects_and_dicts_alike(body: Any, fields: list[str], expected: list[float]) -> None:
    vector = decode_vector(message(body, "s"), fields)
    assert vector.dtype == np.float64
    assert vector.tolist() == expected


@given(values=st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=9), data=st.data())
def test_slices_of_arrays_and_lists_agree_with_python(values: list[float], data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(values) - 1))
    stop = data.draw(st.integers(start + 1, len(values)))
    expected = values[start:stop]
    assert decode_vector(message(np.array(values)), [f"[{start}:{stop}]"]).tolist() == expected
    assert decode_vector(message({"a": {"b": values}}, "s"), [f"a.b[{start}:{stop}]"]).tolist() == expected
    with pytest.raises(DecodeError, match="outside"):
        decode_vector(message({"b": values}, "s"), [f"b[{start}:{len(values) + 1}]"])


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (["pose.positon.x"], "did you mean 'position'"),
        (["pose.position.w"], "known: x, y, z"),
        (["pose"], "name its fields: pose.position"),
        (["speed"], "fields that hold numbers here: pose.position, list"),
        (["tags"], "holds no numbers"),
        (["list[4]"], "outside"),
        (["list[3:3]"], "outside"),
        (["pose[0]"], "only lists"),
        (["pose..x"], "cannot be understood"),
        (["list[-5]"], "outside"),
        (["list[-3:2]"], "outside"),
        (["list[+1]"], "cannot be understood"),
        (["list[1:"], "cannot be understood"),
        ([".pose"], "cannot be understood"),
    ],
)
@pytest.mark.parametrize("body", [POSE, as_object(POSE)], ids=["dict", "object"])
def test_paths_that_lead_nowhere_say_what_is_there(body: Any, fields: list[str], says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        decode_vector(message(body, "s"), fields)


def test_an_array_without_fields_is_taken_whole() -> None:
    assert decode_vector(message(np.arange(6, dtype=np.float32).reshape(2, 3))).tolist() == [0, 1, 2, 3, 4, 5]


def test_a_schema_without_usual_fields_asks_for_them() -> None:
    with pytest.raises(DecodeError, match=r"fields here: pose.position, list\[0:4\], rows"):
        decode_vector(message(POSE, "my.Schema"))


@given(order=st.permutations(["a", "b", "c", "d"]))
def test_joints_are_picked_by_name_whatever_order_the_robot_publishes(order: list[str]) -> None:
    body = {"name": order, "position": [ord(name) for name in order], "velocity": []}
    joints = message(body, "sensor_msgs/msg/JointState")
    assert decode_vector(joints, [], ["c", "a"]).tolist() == [ord("c"), ord("a")]
    states = message({"joints": [{"name": n, "position": ord(n)} for n in order]}, "foxglove.JointStates")
    assert decode_vector(states, [], ["c", "a"]).tolist() == [ord("c"), ord("a")]
    with pytest.raises(DecodeError, match="not parallel"):
        decode_vector(joints, ["velocity"], ["a"])


def test_an_unknown_joint_names_the_nearest() -> None:
    body = {"name": ["elbow_joint", "wrist_joint"], "position": [1.0, 2.0]}
    with pytest.raises(DecodeError, match="did you mean 'elbow_joint'"):
        decode_vector(message(body, "sensor_msgs/msg/JointState"), [], ["elbow"])
    with pytest.raises(DecodeError, match="no list `name`"):
        decode_vector(message({"position": [1.0]}, "s"), ["position"], ["elbow"])


def test_nan_passes_for_alignment_to_judge() -> None:
    assert np.isnan(decode_vector(message(np.array([np.nan, 1.0])))[0])


def test_ros_and_protobuf_poses_have_usual_fields() -> None:
    types = STORE.types
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
        orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8),
    )
    assert decode_vector(message(pose, "geometry_msgs/msg/Pose")).tolist() == [1, 2, 3, 0, 0, 0.6, 0.8]
    framed = PoseInFrame(pose={"position": {"x": 4}, "orientation": {"w": 1}})
    assert decode_vector(message(framed, "foxglove.PoseInFrame")).tolist() == [4, 0, 0, 0, 0, 0, 1]
    with pytest.raises(DecodeError, match="did you mean 'pose'"):
        decode_vector(message(framed, "foxglove.PoseInFrame"), ["poses.position.x"])


def test_paths_are_parsed_once_for_a_topic() -> None:
    assert compile_fields(("a.b",), ()) is compile_fields(("a.b",), ())


# --- time -------------------------------------------------------------------------------------------------------------

T = 1_700_000_000_123_456_789
SEC, NSEC = divmod(T, 10**9)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"header": {"stamp": {"sec": SEC, "nanosec": NSEC}}}, T),
        ({"header": {"stamp": {"sec": SEC, "nsec": NSEC}}}, T),
        (as_object({"header": {"stamp": {"sec": SEC, "nanosec": NSEC}}}), T),
        ({"timestamp": {"sec": SEC, "nsec": NSEC}}, T),
        (PoseInFrame(timestamp=Timestamp(seconds=SEC, nanos=NSEC)), T),
        ({"header": {"stamp": {"sec": 0, "nanosec": 0}}}, 0),
        (PoseInFrame(), None),
        ({"timestamp": 17.5}, None),
        ({"header": {}}, None),
        (np.zeros(3), None),
    ],
)
def test_header_time_of_every_kind_of_message(body: Any, expected: int | None) -> None:
    assert header_time_ns(message(body, "s")) == expected


def test_base64_and_bytes_give_the_same_image() -> None:
    data = encode_image(colour_card(), "png")
    as_json = message({"data": base64.b64encode(data).decode(), "format": "png"}, "foxglove.CompressedImage")
    assert np.array_equal(decode_image(as_json), decode_image(compressed(data)))
