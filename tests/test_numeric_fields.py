"""Every number in a message is found once, under a name that leads back to it, and text, stamps and images are not."""

from __future__ import annotations

from dataclasses import make_dataclass
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from hypothesis import given
from hypothesis import strategies as st

from tests.synthetic import STORE
from vilp_data.decode.message_body import member_names, set_members
from vilp_data.decode.numeric_fields import LARGEST_VECTOR, numeric_series
from vilp_data.types import Message

NAMES = st.text("abcxyz", min_size=1, max_size=3)
NUMBERS = st.one_of(st.integers(-1000, 1000), st.floats(-1e6, 1e6), st.booleans())
BODIES = st.dictionaries(
    NAMES,
    st.recursive(
        st.one_of(NUMBERS, st.text(max_size=3), st.none()), lambda inner: st.dictionaries(NAMES, inner), max_leaves=8
    ),
)


def series(body: Any) -> dict[str, dict[str, float]]:
    return numeric_series(Message("/t", "s", 0, 0, body))


def numbers_in(body: dict[str, Any], path: tuple[str, ...] = ()) -> dict[tuple[str, ...], float]:
    """Path -> value of every number in nested dicts."""
    found: dict[tuple[str, ...], float] = {}
    for name, value in body.items():
        if isinstance(value, dict):
            found |= numbers_in(value, (*path, name))
        elif isinstance(value, int | float):
            found[(*path, name)] = float(value)
    return found


def as_object(value: Any) -> Any:
    """The same message with attributes instead of keys, as decoded CDR has them."""
    if not isinstance(value, dict):
        return value
    inside = {name: as_object(item) for name, item in value.items()}
    return make_dataclass("Body", inside)(**inside)


@given(body=BODIES)
def test_every_number_is_found_once_under_its_own_path(body: dict[str, Any]) -> None:
    found = {
        (*filter(None, group.split(".")), name): v for group, part in series(body).items() for name, v in part.items()
    }
    assert found == numbers_in(body)


@given(body=BODIES)
def test_dicts_and_objects_are_walked_alike(body: dict[str, Any]) -> None:
    assert series(as_object(body)) == series(body)


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=2 * LARGEST_VECTOR))
def test_short_arrays_are_plotted_by_index_and_long_ones_left_out(values: list[float]) -> None:
    expected = {"a": {str(i): v for i, v in enumerate(values)}} if len(values) <= LARGEST_VECTOR else {}
    assert series({"a": values}) == expected
    assert series({"a": np.array(values)}) == expected


@given(joints=st.dictionaries(NAMES, st.floats(-10, 10), min_size=1, max_size=6))
def test_joints_go_by_their_names_in_every_schema(joints: dict[str, float]) -> None:
    lists = {"name": list(joints), "position": list(joints.values()), "velocity": []}
    states = JointStates(joints=[{"name": name, "position": value} for name, value in joints.items()])
    assert series(lists) == {"position": joints}
    assert series(states)["position"] == joints


@pytest.mark.parametrize("stamped", ["header", "stamp", "timestamp"])
def test_stamps_are_no_series(stamped: str) -> None:
    assert series({stamped: {"sec": 5, "nanosec": 6}, "x": 1}) == {"": {"x": 1.0}}


def test_what_a_protobuf_message_does_not_set_is_not_walked() -> None:
    assert series(PoseInFrame(pose={"position": {"x": 4}})) == {"pose.position": {"x": 4.0, "y": 0.0, "z": 0.0}}


def test_all_kinds_of_bodies_name_their_members_in_the_order_of_the_schema() -> None:
    point = STORE.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    assert member_names(point) == member_names({"x": 1, "y": 2, "z": 3}) == ["x", "y", "z"]
    assert dict(set_members(point)) == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert member_names(PoseInFrame()) == ["timestamp", "frame_id", "pose"]
    assert [name for name, _ in set_members(PoseInFrame())] == ["frame_id"]
    assert member_names([1, 2]) == member_names(3.0) == member_names("text") == []


def test_how_a_multi_array_lies_is_not_plotted_beside_what_it_holds() -> None:
    assert series({"layout": {"dim": [], "data_offset": 0}, "data": [1.0, 2.0]}) == {"data": {"0": 1.0, "1": 2.0}}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["hip", "knee"], ["hip", "knee"]),
        (["hip", "hip"], ["0", "1"]),
        (["hip", "hip\x1b"], ["0", "1"]),
        (["hip", "\x1b"], ["0", "1"]),
        (["hip"], ["0", "1"]),
        (["left\narm", "\ud800b"], ["left arm", "b"]),
    ],
)
def test_a_list_goes_by_its_places_unless_each_of_its_numbers_has_a_name_of_its_own(
    names: list[str], expected: list[str]
) -> None:
    said = {"name": names, "position": [1.0, 2.0]}
    assert series(said) == {"position": dict(zip(expected, [1.0, 2.0], strict=True))}
    array = Message("/t", "array", 0, 0, np.array([1.0, 2.0]))
    assert numeric_series(array, names) == {"": dict(zip(expected, [1.0, 2.0], strict=True))}


def test_items_go_by_names_that_can_be_shown() -> None:
    items = [{"name": "\x1b[1mhip", "angle": 1.0}, {"name": "\x07", "angle": 2.0}]
    assert series({"joints": items}) == {"angle": {"[1mhip": 1.0, "1": 2.0}}
