"""JSON says anything anywhere: a message of numbers is either read, or refused with a DecodeError that names its topic."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.decode import decode_vector, header_time_ns
from vilp_data.decode.numeric_fields import numeric_paths, numeric_series
from vilp_data.decode.vectors import concerns, rotation_columns
from vilp_data.errors import DecodeError
from vilp_data.transforms import links_of
from vilp_data.types import Message

LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.just(10**400),
    st.floats(),
    st.text(max_size=3),
    st.just([]),
    st.just({}),
)
ANYTHING = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("xyzw"), inner), max_leaves=4
)
STAMP = {"sec": 5, "nanosec": 6}
POSE = {"position": dict.fromkeys("xyz", 1.0), "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
BODIES: dict[str, dict[str, Any]] = {
    "geometry_msgs/msg/PoseStamped": {"header": {"stamp": STAMP, "frame_id": "a"}, "pose": POSE},
    "sensor_msgs/msg/JointState": {"header": {"stamp": STAMP}, "name": ["a", "b"], "position": [1.0, 2.0]},
    "foxglove.JointStates": {"timestamp": STAMP, "joints": [{"name": "a", "position": 1.0}]},
    "trajectory_msgs/msg/JointTrajectory": {"joint_names": ["a"], "points": [{"positions": [1.0]}]},
    "std_msgs/msg/Float64": {"data": 1.0},
    "tf2_msgs/msg/TFMessage": {
        "transforms": [
            {
                "header": {"stamp": STAMP, "frame_id": "a"},
                "child_frame_id": "b",
                "transform": {"translation": dict.fromkeys("xyz", 1.0), "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}},
            }
        ]
    },
}


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of everything inside nested dicts and lists."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from places(value[key], (*path, key))


def replaced(body: Any, path: tuple[Any, ...], value: Any) -> Any:
    changed = inside = copy.deepcopy(body)
    for key in path[:-1]:
        inside = inside[key]
    inside[path[-1]] = value
    return changed


@pytest.mark.parametrize("schema", BODIES)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_body_with_anything_in_one_place_is_read_or_refused(schema: str, data: st.DataObject) -> None:
    place = data.draw(st.sampled_from(list(places(BODIES[schema]))))
    message = Message("/topic", schema, 5, 5, replaced(BODIES[schema], place, data.draw(ANYTHING)))
    header_time_ns(message)
    numeric_paths(message.body)
    numeric_series(message)
    for read in (
        lambda: decode_vector(message),
        lambda: decode_vector(message, (), ("a",)),
        lambda: rotation_columns(message),
        lambda: concerns(message, ["a"]),
        lambda: links_of(message, clock="header"),
        lambda: links_of(message, clock="log", static=True),
    ):
        try:
            read()
        except DecodeError as error:
            assert "/topic" in str(error)
