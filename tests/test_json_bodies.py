"""A JSON message may hold anything in any field: decoding answers, or refuses it in words; it never ends in a traceback."""

from __future__ import annotations

import base64
import copy
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.decode import decode_image, decode_vector, header_time_ns
from vilp_data.decode.depth import decode_depth, is_depth
from vilp_data.decode.images import payload
from vilp_data.decode.message_body import number, whole_number
from vilp_data.decode.video import VideoDecoder
from vilp_data.decode.video_packet import holds_picture, is_video
from vilp_data.errors import DecodeError
from vilp_data.spec import DepthSpec
from vilp_data.transforms import links_of
from vilp_data.types import Message

STAMP = {"sec": 1_700_000_000, "nsec": 5}
HEAD = {"header": {"stamp": STAMP, "frame_id": "base"}, "timestamp": STAMP}
PNG = base64.b64encode(cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1].tobytes()).decode()
SIZE = {"height": 2, "width": 2, "step": 2, "is_bigendian": 0}
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
TRANSFORM = {"translation": POSE["position"], "rotation": POSE["orientation"]}
DEPTH = DepthSpec(unit="mm", near_m=0.1, far_m=2.0)

BODIES: dict[str, tuple[dict[str, Any], tuple[Callable[[Message], object], ...]]] = {
    "sensor_msgs/msg/Image": (
        HEAD | SIZE | {"encoding": "mono8", "data": [1, 2, 3, 4]},
        (decode_image, is_depth, lambda message: decode_depth(message, DEPTH)),
    ),
    "foxglove.RawImage": (
        HEAD | SIZE | {"encoding": "16UC1", "step": 4, "data": base64.b64encode(bytes(8)).decode()},
        (
            lambda message: decode_depth(message, DEPTH),
            lambda message: decode_image(message, levels=(0, 9)),
            decode_image,
        ),
    ),
    "foxglove.CompressedImage": (
        HEAD | {"format": "png", "data": PNG},
        (decode_image, is_video, holds_picture, lambda message: decode_depth(message, DEPTH)),
    ),
    "foxglove.CompressedVideo": (
        HEAD | {"format": "h264", "data": [0, 0, 0, 1, 0x65, 0x88]},
        (is_video, holds_picture, lambda message: list(VideoDecoder().feed(0, message))),
    ),
    "geometry_msgs/msg/PoseStamped": (HEAD | {"pose": POSE}, (decode_vector,)),
    "sensor_msgs/msg/JointState": (HEAD | {"name": ["a", "b"], "position": [1.0, 2.0]}, (decode_vector,)),
    "tf2_msgs/msg/TFMessage": (
        {"transforms": [HEAD | {"child_frame_id": "tool", "transform": TRANSFORM}]},
        (lambda message: links_of(message, clock="header"), lambda message: links_of(message, clock="log")),
    ),
}
ANYTHING = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.floats(), st.integers(-(10**30), 10**30), st.text(max_size=8),
        st.sampled_from([0, -1, 3, 1.5, 10**400, "rgb8", "32FC1", "16UC1; compressedDepth", "h264", "jpeg", "=", "é"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.sampled_from(["sec", "x", "data"]), inner, max_size=3)),
    max_leaves=5,
)  # fmt: skip


def places(body: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where every member and item of a body is."""
    keys = body if isinstance(body, dict) else range(len(body)) if isinstance(body, list) else ()
    return [place for key in keys for place in [(*at, key), *places(body[key], (*at, key))]]


def replaced(body: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(body)
    inner: Any = changed
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return changed


@pytest.mark.parametrize("schema", BODIES)
def test_the_bodies_are_read_as_they_are(schema: str) -> None:
    body, reads = BODIES[schema]
    assert reads[0](Message("/t", schema, 5, 5, body)) is not None


@pytest.mark.parametrize("schema", BODIES)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_anything_in_any_field_is_read_or_refused_in_words(schema: str, data: st.DataObject) -> None:
    body, reads = BODIES[schema]
    place = data.draw(st.sampled_from(places(body)))
    message = Message("/t", schema, 5, 5, replaced(body, place, data.draw(ANYTHING)))
    header_time_ns(message)
    for read in reads:
        try:
            read(message)
        except DecodeError as error:
            assert error.where
            assert error.remedy


@pytest.mark.parametrize(
    "data", [[300], [-1], [1.7, 2.0], ["a"], [None], [[1], [1, 2]], [10**30], [[1, 2]], "é", {}, 3, None, True]
)
def test_image_data_that_is_no_bytes_is_refused_rather_than_cast(data: Any) -> None:
    with pytest.raises(DecodeError, match="data"):
        payload(Message("/t", "sensor_msgs/msg/Image", 5, 5, {"data": data}))


def test_image_data_may_be_a_list_of_whole_numbers() -> None:
    message = Message("/t", "sensor_msgs/msg/Image", 5, 5, {"data": [0, 1.0, 255]})
    assert payload(message).tolist() == [0, 1, 255]


@pytest.mark.parametrize("value", [None, "x", [1], {}, 10**400])
def test_what_is_no_number_is_refused_by_the_name_of_its_field(value: Any) -> None:
    message = Message("/t", "s", 7, 7, {})
    with pytest.raises(DecodeError, match="/t at 7 ns: height is no number"):
        number(value, message, "height")


def test_numbers_in_text_are_numbers_and_sizes_are_whole() -> None:
    message = Message("/t", "s", 7, 7, {})
    assert np.isnan(number("NaN", message, "x"))
    assert whole_number("480", message, "height") == 480
    for value in (1.5, float("inf"), float("nan")):
        with pytest.raises(DecodeError, match="no whole number"):
            whole_number(value, message, "height")
