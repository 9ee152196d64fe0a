"""The transform between two frames is what the tree says at that instant: composed, never from the future, never of two signs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.errors import AlignError, DecodeError
from vilp_data.transforms import ALWAYS_NS, Link, Transform, compose, inverse, links_of, pick_columns, resolve
from vilp_data.types import F64, Message

S = 10**9
NAMES = "abcdefgh"
NUMBER = st.floats(-3, 3)


@st.composite
def transforms(draw: st.DrawFn) -> Transform:
    quaternion = np.array(draw(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER).filter(lambda q: np.linalg.norm(q) > 0.1)))
    x, y, z = draw(st.tuples(NUMBER, NUMBER, NUMBER))
    qx, qy, qz, qw = (quaternion / np.linalg.norm(quaternion)).tolist()
    return x, y, z, qx, qy, qz, qw


def matrix(transform: Any) -> F64:
    """The 4x4 matrix of a transform, written down from the textbook."""
    x, y, z, qx, qy, qz, qw = transform
    return np.array(
        [
            [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw), x],
            [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw), y],
            [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy), z],
            [0, 0, 0, 1],
        ]
    )


@st.composite
def histories(draw: st.DrawFn) -> list[Link]:
    """Links of a random tree over NAMES: every child has an earlier name as its parent, which may change; some are static."""
    size = draw(st.integers(2, len(NAMES)))
    links = []
    for number in range(1, size):
        static = draw(st.booleans())
        times = [0] if static else draw(st.lists(st.integers(0, 12), min_size=1, max_size=5, unique=True).map(sorted))
        for time in times:
            parent = NAMES[draw(st.integers(0, number - 1))]
            links.append(Link(time * S, parent, NAMES[number], draw(transforms()), static))
    return links


def at(links: list[Link], frame: str, time_ns: int) -> tuple[str, F64] | None:
    """The root that a frame hangs on at an instant, and the frame's matrix in it, by walking up the latest links."""
    total = np.eye(4)
    while True:
        known = [link for link in links if link.child == frame and (link.static or link.stamp_ns <= time_ns)]
        if not known:
            return frame, total
        link = max(known, key=lambda link: link.stamp_ns)
        total, frame = matrix(link.transform) @ total, link.parent


@given(links=histories(), data=st.data())
@settings(max_examples=30, deadline=None)
def test_the_resolved_transform_is_the_composition_of_the_tree_at_every_instant(
    links: list[Link], data: st.DataObject
) -> None:
    frames = sorted({link.child for link in links} | {link.parent for link in links})
    one, other = (data.draw(st.sampled_from(frames)) for _ in range(2))
    resolved = resolve(links, one, other, where="/tf") if one != other else None
    if resolved is None:
        return
    assert (np.diff(resolved.stamps_ns) > 0).all()
    for time in range(14):
        (root_one, in_one), (root_other, in_other) = at(links, one, time * S), at(links, other, time * S)
        row = int(np.searchsorted(resolved.stamps_ns, time * S, side="right")) - 1
        found = resolved.values[row] if row >= 0 else np.full(7, np.nan)
        if root_one != root_other:
            assert np.isnan(found).all()
        else:
            np.testing.assert_allclose(matrix(found), np.linalg.inv(in_one) @ in_other, atol=1e-9)


@given(links=histories(), later=transforms(), time=st.integers(0, 12))
@settings(max_examples=25, deadline=None)
def test_what_comes_later_changes_nothing_before_it(links: list[Link], later: Transform, time: int) -> None:
    child = links[-1].child
    past = [link for link in links if link.static or link.stamp_ns <= time * S]
    if not any(link.child == child for link in past):
        return
    more = [*past, Link((time + 1) * S, links[-1].parent, child, later, False)]
    root = links[0].parent
    try:
        before = resolve(past, root, child, where="/tf")
    except DecodeError:
        return
    after = resolve(more, root, child, where="/tf")
    kept = after.stamps_ns <= time * S
    np.testing.assert_array_equal(after.stamps_ns[kept], before.stamps_ns)
    np.testing.assert_allclose(after.values[kept], before.values)


@given(transform=transforms())
def test_a_transform_and_its_inverse_are_the_identity(transform: Transform) -> None:
    np.testing.assert_allclose(matrix(compose(transform, inverse(transform))), np.eye(4), atol=1e-9)


def turning(n: int, flip: Any) -> list[Link]:
    """A frame that turns about z by a tenth of a radian a step, its quaternions published with the signs that `flip` says."""
    links = []
    for k in range(n):
        sign = -1.0 if flip(k) else 1.0
        quaternion = 0.0, 0.0, sign * np.sin(k * 0.05), sign * np.cos(k * 0.05)
        links.append(Link(k * S, "base", "tool", (1.0, 2.0, 3.0, *quaternion), False))
    return links


@pytest.mark.parametrize("flip", [lambda k: k % 2, lambda k: k > 20, lambda k: True], ids=["each", "once", "all"])
def test_quaternions_keep_their_sign_whatever_is_published(flip: Any) -> None:
    values = resolve(turning(100, flip), "base", "tool", where="/tf").values
    assert np.abs(np.diff(values, axis=0)).max() < 0.06
    assert values[0, 6] > 0
    np.testing.assert_allclose(values, resolve(turning(100, lambda k: False), "base", "tool", where="/tf").values)


def link(time_s: float, parent: str, child: str, x: float = 1.0, *, static: bool = False) -> Link:
    return Link(round(time_s * S), parent, child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), static)


def test_a_link_that_fell_silent_makes_the_whole_chain_stale() -> None:
    links = [link(0, "world", "base"), *(link(k / 10, "base", "tool", k) for k in range(30))]
    resolved = resolve(links, "world", "tool", where="/tf", stale_after_s=0.5)
    fresh = np.isfinite(resolved.values).all(axis=1)
    assert fresh.tolist() == [True] * 6 + [False] * (len(fresh) - 6)
    assert resolved.stamps_ns[6] == round(0.5 * S) + 1001
    assert np.isfinite(resolve(links, "world", "tool", where="/tf").values).all()


def test_the_last_transform_expires_too() -> None:
    resolved = resolve([link(0, "a", "b"), link(1, "a", "b")], "a", "b", where="/tf", stale_after_s=2.0)
    assert resolved.stamps_ns.tolist() == [0, S, 3 * S + 1001]
    assert np.isnan(resolved.values[2]).all()


def test_static_links_hold_always_and_never_grow_stale() -> None:
    links = [link(50, "tool", "camera", 5.0, static=True), *(link(k, "base", "tool", k) for k in range(3))]
    resolved = resolve(links, "base", "camera", where="/tf", stale_after_s=1.5)
    assert resolved.values[:3, 0].tolist() == [5, 6, 7]
    alone = resolve(links, "tool", "camera", where="/tf", stale_after_s=0.5)
    assert alone.stamps_ns.tolist() == [ALWAYS_NS]
    assert alone.values[0].tolist() == [5, 0, 0, 0, 0, 0, 1]


def test_a_static_link_with_a_new_value_holds_from_then_on() -> None:
    links = [
        link(1, "a", "b", 1.0, static=True),
        link(4, "a", "b", 1.0, static=True),
        link(7, "a", "b", 2.0, static=True),
    ]
    resolved = resolve(links, "a", "b", where="/tf")
    assert resolved.stamps_ns.tolist() == [ALWAYS_NS, 7 * S]
    assert resolved.values[:, 0].tolist() == [1, 2]


def test_an_object_that_is_grasped_follows_the_hand() -> None:
    links = [
        link(0, "base", "table", 10),
        link(0, "table", "cup", 1),
        link(0, "base", "hand", 0),
        link(5, "hand", "cup", 2),
    ]
    assert resolve(links, "base", "cup", where="/tf").values[:, 0].tolist() == [11, 2]


def test_rotations_that_are_none_are_not_numbers_until_the_next_one() -> None:
    body = {
        "transforms": [
            {"header": {"frame_id": "a"}, "child_frame_id": "b", "transform": {"translation": {}, "rotation": {}}}
        ]
    }
    (bad,) = links_of(Message("/tf", "tf2_msgs/msg/TFMessage", 5, 5, body), clock="log")
    resolved = resolve([bad, link(1, "a", "b")], "a", "b", where="/tf")
    assert np.isnan(resolved.values[0]).all()
    assert np.isfinite(resolved.values[1]).all()


# --- errors ---------------------------------------------------------------------------------------------------------------


def test_an_unknown_frame_names_the_frames_there_are() -> None:
    links = [link(0, "base", "tool0"), link(0, "base", "camera")]
    with pytest.raises(DecodeError, match=r"no frame called 'tool'\n.*base, camera, tool0\n.*did you mean 'tool0'"):
        resolve(links, "base", "tool", where="/tf")


def test_two_trees_name_the_link_that_is_missing() -> None:
    links = [link(0, "base", "arm"), link(0, "arm", "tool"), link(0, "map", "odom")]
    with pytest.raises(DecodeError, match="no transform between 'base' and 'map'") as refused:
        resolve(links, "tool", "odom", where="/tf")
    assert "tool -> arm -> base and odom -> map" in str(refused.value)


def test_frames_that_run_in_a_circle_are_said() -> None:
    with pytest.raises(DecodeError, match="circle"):
        resolve([link(0, "a", "b"), link(0, "b", "a")], "a", "b", where="/tf")


def test_a_clock_that_was_reset_is_refused_only_for_frames_that_matter() -> None:
    links = [link(0, "a", "b"), link(1, "a", "b"), link(9, "a", "x"), link(2, "a", "x")]
    assert len(resolve(links, "a", "b", where="/tf").values) == 2
    with pytest.raises(AlignError, match="jumps back"):
        resolve(links, "a", "x", where="/tf")
    with pytest.raises(AlignError, match="tell no time"):
        resolve([link(0, "a", "b")] * 3, "a", "b", where="/tf")


# --- messages ---------------------------------------------------------------------------------------------------------------


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
