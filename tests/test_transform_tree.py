"""The transform between two frames is what the tree says at that instant: composed, never from the future, never of two signs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data import transform_tree
from vilp_data.align import ALWAYS_NS, NEVER_NS
from vilp_data.errors import AlignError, DecodeError
from vilp_data.transform_tree import TransformTrack, TransformTree
from vilp_data.transforms import Link, Transform
from vilp_data.types import F64, I64

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


def between(links: Iterable[Link], one: str, other: str) -> TransformTrack:
    tree = TransformTree([one, other])
    tree.add(links)
    return tree.between(one, other, where="/tf")


def told_one_by_one(tree: TransformTree, links: Iterable[Link]) -> TransformTree:
    """The tree after as many messages as there are links: it is between messages that it sorts out."""
    for link in links:
        tree.add([link])
    return tree


def xs(track: TransformTrack, *times_s: float) -> list[float]:
    """The x of the transform at these instants."""
    return list(track.at(instants(*times_s)).values[:, 0])


def instants(*times_s: float) -> I64:
    return np.round(np.array(times_s) * S).astype(np.int64)


@given(links=histories(), data=st.data())
@settings(max_examples=30, deadline=None)
def test_the_resolved_transform_is_the_composition_of_the_tree_at_every_instant(
    links: list[Link], data: st.DataObject
) -> None:
    frames = sorted({link.child for link in links} | {link.parent for link in links})
    one, other = (data.draw(st.sampled_from(frames)) for _ in range(2))
    if one == other:
        return
    times = np.arange(-1, 14) * S
    roots = [(at(links, one, time), at(links, other, time)) for time in times]
    if not any(in_one[0] == in_other[0] for in_one, in_other in roots):
        with pytest.raises(DecodeError, match="nothing joins"):
            between(links, one, other)
        return
    latest = between(links, one, other).at(times)
    for (in_one, in_other), found, stamp_ns in zip(roots, latest.values, latest.stamps_ns, strict=True):
        if in_one[0] != in_other[0]:
            assert np.isnan(found).all()
            assert stamp_ns == NEVER_NS
        else:
            np.testing.assert_allclose(matrix(found), np.linalg.inv(in_one[1]) @ in_other[1], atol=1e-9)


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
        before = between(past, root, child)
    except DecodeError:
        return
    instants_ns = np.arange(-1, time + 1) * S
    np.testing.assert_array_equal(between(more, root, child).at(instants_ns).values, before.at(instants_ns).values)


@given(links=histories(), data=st.data())
@settings(max_examples=60, deadline=None)
def test_links_that_are_sorted_out_on_the_way_change_nothing(links: list[Link], data: st.DataObject) -> None:
    """Whatever is passed over as useless: either it was, or it is named, and a second reading keeps it."""
    frames = sorted({link.child for link in links} | {link.parent for link in links})
    one, other = data.draw(st.permutations(frames))[:2]
    links = sorted(links, key=lambda link: link.stamp_ns)
    try:
        expected = between(links, one, other)
    except DecodeError:
        return
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(transform_tree, "LINKS_BEFORE_SORTING_OUT", data.draw(st.integers(1, 4)))
        tree = told_one_by_one(TransformTree([one, other]), links)
        for _ in range(len(NAMES)):
            if not tree.missed:
                break
            tree = told_one_by_one(tree.again(), links)
    assert not tree.missed
    instants_ns = np.arange(-1, 14) * S
    found = tree.between(one, other, where="/tf").at(instants_ns)
    np.testing.assert_array_equal(found.values, expected.at(instants_ns).values)
    np.testing.assert_array_equal(found.stamps_ns, expected.at(instants_ns).stamps_ns)


def test_a_frame_that_comes_to_matter_after_it_was_passed_over_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hand moves all along; only at 15 s does the cup hang on it."""
    monkeypatch.setattr(transform_tree, "LINKS_BEFORE_SORTING_OUT", 5)
    links = [link(k, "base", "hand", k) for k in range(20)] + [
        link(0, "base", "cup", 100),
        link(15, "hand", "cup", 100),
    ]
    links.sort(key=lambda link: link.stamp_ns)
    tree = told_one_by_one(TransformTree(["base", "cup"]), links)
    assert tree.missed == {"hand"}
    tree = told_one_by_one(tree.again(), links)
    assert not tree.missed
    assert xs(tree.between("base", "cup", where="/tf"), 14, 15, 16) == [100, 115, 116]


def test_frames_that_nobody_asked_for_take_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transform_tree, "LINKS_BEFORE_SORTING_OUT", 100)
    tree = TransformTree(["base", "tool"])
    for k in range(2000):
        tree.add([link(k / 100, "base", "tool"), *(link(k / 100, "base", f"finger{n}", k) for n in range(20))])
    kept = tree.between("base", "tool", where="/tf")
    assert xs(kept, 19.99) == [1.0]
    assert {child: len(packed.stamps) for child, packed in tree._moving.items()} == {"tool": 2000}


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
    times_ns = np.arange(100) * S
    values = between(turning(100, flip), "base", "tool").at(times_ns).values
    assert np.abs(np.diff(values, axis=0)).max() < 0.06
    assert values[0, 6] > 0
    np.testing.assert_allclose(values, between(turning(100, lambda k: False), "base", "tool").at(times_ns).values)


def link(time_s: float, parent: str, child: str, x: float = 1.0, *, static: bool = False) -> Link:
    return Link(round(time_s * S), parent, child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), static)


def test_a_transform_is_as_old_as_the_oldest_link_that_moves() -> None:
    links = [link(0, "world", "base"), *(link(k / 10, "base", "tool", k) for k in range(30))]
    latest = between([*links, link(9, "tool", "tip", static=True)], "world", "tip").at(instants(0.05, 1.0, 2.9))
    assert latest.values[:, 0].tolist() == [2, 12, 31]
    assert latest.stamps_ns.tolist() == [0, 0, 0]
    np.testing.assert_allclose(latest.age_s(instants(0.05, 1.0, 2.9)), [0.05, 1.0, 2.9])
    other = [*(link(k / 10, "world", "base") for k in range(30)), link(0, "base", "tool")]
    assert between(other, "world", "tool").at(instants(1.05)).stamps_ns.tolist() == [0]


def test_static_links_hold_always_and_never_grow_old() -> None:
    links = [link(50, "tool", "camera", 5.0, static=True), *(link(k, "base", "tool", k) for k in range(3))]
    assert xs(between(links, "base", "camera"), 0, 1, 2) == [5, 6, 7]
    alone = between(links, "tool", "camera")
    assert alone.stamps_ns.tolist() == [ALWAYS_NS]
    assert alone.at(instants(0, 70)).values.tolist() == [[5, 0, 0, 0, 0, 0, 1]] * 2
    assert alone.at(instants(70)).age_s(instants(70)).tolist() == [0]
    assert len(alone.known_ns()) == 0


def test_a_static_link_with_a_new_value_holds_from_then_on() -> None:
    values = [(1, 1.0), (4, 1.0), (7, 2.0)]
    track = between([link(t, "a", "b", x, static=True) for t, x in values], "a", "b")
    assert track.stamps_ns.tolist() == [ALWAYS_NS, 7 * S]
    assert xs(track, 0, 5, 6.9, 7, 90) == [1, 1, 1, 2, 2]


def test_a_link_that_is_published_again_unchanged_is_fresh_again() -> None:
    track = between([link(k, "a", "b", 1.0) for k in range(5)], "a", "b")
    assert track.at(instants(0, 3.5, 9)).stamps_ns.tolist() == [0, 3 * S, 4 * S]
    assert track.known_ns().tolist() == [k * S for k in range(5)]


def test_an_object_that_is_grasped_follows_the_hand() -> None:
    links = [
        link(0, "base", "table", 10),
        link(0, "table", "cup", 1),
        link(0, "base", "hand", 0),
        link(5, "hand", "cup", 2),
    ]
    assert xs(between(links, "base", "cup"), 0, 4.9, 5, 6) == [11, 11, 2, 2]


def test_a_rotation_that_is_none_is_not_a_number_until_the_next_one() -> None:
    bad = Link(0, "a", "b", (0.0, 0.0, 0.0, *[float("nan")] * 4), False)
    latest = between([bad, link(1, "a", "b")], "a", "b").at(instants(0.5, 1))
    assert np.isfinite(latest.values).all(axis=1).tolist() == [False, True]


# --- errors ---------------------------------------------------------------------------------------------------------------


def test_an_unknown_frame_names_the_frames_there_are() -> None:
    links = [link(0, "base", "tool0"), link(0, "base", "camera")]
    with pytest.raises(
        DecodeError, match=r"no frame called 'tool'\n.*did you mean 'tool0'\? known: base, camera, tool0"
    ):
        between(links, "base", "tool")


def test_two_trees_name_the_link_that_is_missing() -> None:
    links = [link(0, "base", "arm"), link(0, "arm", "tool"), link(0, "map", "odom")]
    with pytest.raises(DecodeError, match="no transform between 'base' and 'map'") as refused:
        between(links, "tool", "odom")
    assert "tool -> arm -> base and odom -> map" in str(refused.value)


def test_frames_that_run_in_a_circle_are_said() -> None:
    with pytest.raises(DecodeError, match="circle"):
        between([link(0, "a", "b"), link(0, "b", "a")], "a", "b")


def test_a_clock_that_was_reset_is_refused_only_for_frames_that_matter() -> None:
    links = [link(0, "a", "b"), link(1, "a", "b"), link(9, "a", "x"), link(2, "a", "x")]
    assert xs(between(links, "a", "b"), 1) == [1]
    with pytest.raises(AlignError, match="jumps back"):
        between(links, "a", "x")
    with pytest.raises(AlignError, match="tell no time"):
        between([link(0, "a", "b")] * 3, "a", "b")
