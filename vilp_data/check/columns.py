"""The numbers of a topic's messages as columns: found once in the first message, then read fast from every one. Pure.

A message of a thousand a second must cost a microsecond or two, so the paths that hold numbers are looked up once, and read
by one `attrgetter` from then on. Stamps, covariances and arrays longer than LARGEST_VECTOR are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from vilp_data.decode import header_time_ns
from vilp_data.decode.message_body import member, require_member, set_members
from vilp_data.short_names import clean_name
from vilp_data.types import Message

LARGEST_VECTOR = 64
"""Longer arrays are scans, images or matrices rather than joints."""

MAX_COLUMNS = 96
MAX_DEPTH = 6
SKIPPED = ("header", "timestamp", "stamp")
SKIPPED_PARTS = ("covariance",)

Row = Sequence[float]


@dataclass(frozen=True)
class Columns:
    """names [D] of a topic's numbers, and how to read a row of D from a message body; a body of another shape gives another length,
    or raises AttributeError, KeyError, TypeError or ValueError."""

    names: tuple[str, ...]
    read: Callable[[Any], Row]


@dataclass(frozen=True)
class _Leaf:
    """A number, or a list of them, at a path of members; `each`: that member of every item of a list of messages (joints)."""

    path: tuple[str, ...]
    labels: tuple[str, ...]  # of a list; empty for a single number
    each: str | None = None


def columns_of(body: Any, names: Sequence[str] = ()) -> Columns | None:
    """The columns of messages like this one; None where it holds no numbers, or too many to be a robot's state. `names`: of the
    numbers of an array, where its log says them."""
    if isinstance(body, np.ndarray):
        if body.ndim > 1 or body.size > LARGEST_VECTOR or body.dtype.kind not in "fiub":
            return None
        known = names if len(names) == body.size else [""] * body.size
        labels = tuple(f"[{i}] {clean_name(name)}".strip() for i, name in enumerate(known))
        return Columns(labels, lambda array: np.atleast_1d(array).tolist())
    leaves = list(_leaves(body, ()))
    names = tuple(name for leaf in leaves for name in _labels(leaf))
    if not names or len(names) > MAX_COLUMNS:
        return None
    return Columns(names, _reader(leaves, isinstance(body, dict)))


def stamp_reader(message: Message) -> Callable[[Message], int] | None:
    """A fast reader of the stamp that messages like this one give themselves (ns); None where this one gives none."""
    expected = header_time_ns(message)
    if expected is None:
        return None
    for paths in (
        ("header.stamp.sec", "header.stamp.nanosec"),
        ("timestamp.seconds", "timestamp.nanos"),
        ("timestamp.sec", "timestamp.nanosec"),
        ("header.stamp.sec", "header.stamp.nsec"),
    ):
        get = attrgetter(*paths)
        try:
            seconds, nanoseconds = get(message.body)
        except AttributeError:
            continue
        if seconds * 1_000_000_000 + nanoseconds == expected:
            return lambda message, get=get: _joined(get(message.body))  # type: ignore[misc]
    return lambda message: header_time_ns(message) or 0


def _joined(stamp: tuple[int, int]) -> int:
    return stamp[0] * 1_000_000_000 + stamp[1]


def _reader(leaves: list[_Leaf], is_dict: bool) -> Callable[[Any], Row]:
    paths = [".".join(leaf.path) for leaf in leaves]
    plain = not any(leaf.labels or leaf.each for leaf in leaves)
    if is_dict:
        return lambda body: [number for leaf in leaves for number in _follow(leaf, body)]
    get: Callable[[Any], Any] = attrgetter(*paths)
    if plain:
        return get if len(paths) > 1 else lambda body: (get(body),)
    one = len(paths) == 1

    def read(body: Any) -> Row:
        values = (get(body),) if one else get(body)
        row: list[float] = []
        for leaf, value in zip(leaves, values, strict=True):
            if leaf.each:
                row.extend(getattr(item, leaf.each) for item in value)
            elif leaf.labels:
                row.extend(value.tolist() if isinstance(value, np.ndarray) else value)
            else:
                row.append(value)
        return row

    return read


def _follow(leaf: _Leaf, body: Any) -> Sequence[float]:
    for name in leaf.path:
        body = body[name]
    if leaf.each:
        return [float(value) for value in require_member(body, leaf.each)]
    return body if leaf.labels else (body,)


def _labels(leaf: _Leaf) -> list[str]:
    name = ".".join(map(clean_name, leaf.path)) + (f".{clean_name(leaf.each)}" if leaf.each else "")
    return [f"{name}.{clean_name(label)}" for label in leaf.labels] if leaf.labels else [name]


def _leaves(value: Any, path: tuple[str, ...]) -> Iterator[_Leaf]:
    if len(path) > MAX_DEPTH:
        return
    fields = dict(set_members(value))
    published = fields.get("name")
    for name, inside in fields.items():
        if name in SKIPPED or any(part in name for part in SKIPPED_PARTS) or isinstance(inside, str | bytes):
            continue
        here = (*path, name)
        if isinstance(inside, bool | int | float | np.number):
            yield _Leaf(here, ())
        elif isinstance(inside, np.ndarray) or hasattr(inside, "__len__"):
            if isinstance(inside, dict):
                yield from _leaves(inside, here)
            else:
                yield from _list_leaves(inside, here, published)
        else:
            yield from _leaves(inside, here)


def _list_leaves(values: Any, path: tuple[str, ...], published: Any) -> Iterator[_Leaf]:
    if not 0 < len(values) <= LARGEST_VECTOR:
        return
    if isinstance(values, np.ndarray):
        numbers = values.ndim == 1 and values.dtype.kind in "fiub"
    else:
        numbers = all(isinstance(value, bool | int | float) for value in values)
    if numbers:
        parallel = published is not None and not isinstance(published, str) and len(published) == len(values)
        labels = tuple(map(str, published)) if parallel else tuple(map(str, range(len(values))))
        yield _Leaf(path, labels)
    elif path[-1] == "joints" and all(isinstance(member(item, "name"), str) for item in values):
        labels = tuple(str(member(item, "name")) for item in values)
        for name, inside in set_members(values[0]):
            if isinstance(inside, int | float):
                yield _Leaf(path, labels, each=name)
