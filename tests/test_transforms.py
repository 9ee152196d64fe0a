"""Every kind of message of transforms gives the same links, and one that holds none, or nonsense, says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms

from vilp_data.errors import DecodeError
from vilp_data.transforms import Link, links_of, pick_columns
from vilp_data.types import Message

S = 10**9


def ros_transform(parent: str, child: str, seconds: int, x: float) -> Any:
    stamp = SimpleNamespace(sec=seconds, nanosec=5)
    rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=2.0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(translation=SimpleNamespace(x=x, y=0.0, z=0.0), rotation=rotation),
    )


def test_every_kind_of_message_gives_the_same_links() -> None:
    one = ros_transform("/world", "turtle", 7, 4.0)
    expected = [Link(7 * S + 5, "world", "turtle", (4.0, 0, 0, 0, 0, 0, 1.0), False)]
    as_message = Message("/tf", "tf2_msgs/msg/TFMessage", 9 * S, 8 * S, SimpleNamespace(transforms=[one]))
    assert links_of(as_message, clock="header") == expected
    assert links_of(Message("/tf", "geometry_msgs/msg/TransformStamped", 9 * S, 8 * S, one), clock="header") == expected
    foxglove = FrameTransform(parent_frame_id="world", child_frame_id="turtle", translation={"x": 4}, rotation={"w": 2})
    foxglove.timestamp.FromNanoseconds(7 * S + 5)
    assert links_of(Message("/tf", "foxglove.FrameTransform", 9, 8, foxglove), clock="header") == expected
    many = FrameTransforms(transforms=[foxglove])
    assert links_of(Message("/tf", "foxglove.FrameTransforms", 9, 8, many), clock="header") == expected
    assert [found.stamp_ns for found in links_of(as_message, clock="log", offset_s=1.0)] == [10 * S]
    assert [found.stamp_ns for found in links_of(as_message, clock="publish")] == [8 * S]
    assert [found.stamp_ns for found in links_of(as_message, clock="header", static=True)] == [9 * S]


def test_messages_that_hold_no_transforms_are_refused() -> None:
    with pytest.raises(DecodeError, match="holds no transforms"):
        links_of(Message("/joints", "sensor_msgs/msg/JointState", 0, 0, {"position": [1.0]}), clock="log")
    unstamped = {"transforms": [{"parent_frame_id": "a", "child_frame_id": "b"}]}
    with pytest.raises(DecodeError, match='clock = "log"'):
        links_of(Message("/tf", "x", 0, 0, unstamped), clock="header")


def test_a_task_may_take_parts_of_a_transform() -> None:
    values = np.arange(14.0).reshape(2, 7)
    assert pick_columns(values, (), where="/tf").shape == (2, 7)
    assert pick_columns(values, ("rotation", "translation.z"), where="/tf").tolist() == [
        [3, 4, 5, 6, 2],
        [10, 11, 12, 13, 9],
    ]
    with pytest.raises(DecodeError, match="did you mean 'translation'"):
        pick_columns(values, ("translaton",), where="/tf")


def json_transform(**changes: Any) -> Message:
    item = {
        "header": {"frame_id": "a", "stamp": {"sec": 7, "nanosec": 0}},
        "child_frame_id": "b",
        "transform": {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 2}},
    }
    return Message("/tf", "tf2_msgs/msg/TFMessage", 5, 5, {"transforms": [item | changes]})


@pytest.mark.parametrize("nothing", [None, "one", [1.0], {}, 10**400])
@pytest.mark.parametrize("part", ["translation", "rotation"])
def test_a_number_that_is_none_is_refused_with_its_name(nothing: Any, part: str) -> None:
    transform = {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 2}}
    transform[part]["y"] = nothing
    with pytest.raises(DecodeError, match=rf"b: {part}\.y is no number"):
        links_of(json_transform(transform=transform), clock="header")


@pytest.mark.parametrize("transforms", [3, "abc", True, {"a": 1}, [7], [None], ["abc"]])
def test_a_list_of_transforms_that_is_none_is_refused(transforms: Any) -> None:
    with pytest.raises(DecodeError, match="holds no transforms"):
        links_of(Message("/tf", "tf2_msgs/msg/TFMessage", 5, 5, {"transforms": transforms}), clock="header")


@pytest.mark.parametrize("seconds", [10**30, -(10**30), None, 1.5, "7"])
def test_a_stamp_that_no_clock_shows_is_none(seconds: Any) -> None:
    header = {"frame_id": "a", "stamp": {"sec": seconds, "nanosec": 0}}
    with pytest.raises(DecodeError, match='clock = "log"'):
        links_of(json_transform(header=header), clock="header")
    assert len(links_of(json_transform(header=header), clock="log")) == 1


def test_rotations_that_are_none_are_not_numbers() -> None:
    (bad,) = links_of(json_transform(transform={"translation": {}, "rotation": {}}), clock="log")
    assert np.isnan(bad.transform).all()
