"""The numbers inside a message of any schema, found by walking it: what a viewer can plot without being told anything. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.decode.message_body import member_names, set_members
from vilp_data.decode.usual_fields import PARTS_OF
from vilp_data.short_names import clean_name
from vilp_data.types import F64, Message

LARGEST_VECTOR = 32
"""Longer arrays are images, scans or matrices rather than something to plot."""

MAX_DEPTH = 8
ABOUT = frozenset({"header", "timestamp", "stamp", "layout"})
"""Members that tell of a message what it holds, stamps and a MultiArray's layout, and are nothing to plot."""
ITEM_NAMES = ("name", "child_frame_id", "id")

Series = dict[str, dict[str, float]]
"""Group -> name of the series -> value: {"position": {"elbow": 0.1}}, {"pose.position": {"x": 0.3, "y": …}}."""


def as_numbers(value: Any) -> F64 | None:
    """A number, or a list or an array of numbers, as float64 of its own shape; None for anything else."""
    try:
        array: npt.NDArray[Any] = np.asarray(value)
    except ValueError:  # lists of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiub" else None


def numeric_series(message: Message, names: Sequence[str] = ()) -> Series:
    """Every number in a message, grouped into what belongs in one plot. Header stamps and text are left out.

    An array of at most LARGEST_VECTOR values is a group, its series named by the message's parallel `name` list if that has the
    same length, else by index. Lists of messages (foxglove.JointStates, transforms) name their items by their own name."""
    series: Series = {}
    body = message.body
    named = [clean_name(name) for name in names]
    for path, value in _list_leaves(body, (), named) if isinstance(body, np.ndarray) else _leaves(body, ()):
        group, name = ".".join(path[:-1]), path[-1]
        series.setdefault(group, {})[name] = value
    return series


def numeric_paths(body: Any) -> list[str]:
    """Every path at which a message holds numbers, as a task's `fields` would name it: `position[0:7]` for a list, `pose.position`
    for a point, `speed` for a number. Header stamps are left out, and so are lists of messages past their first item."""
    if isinstance(body, np.ndarray | np.generic):
        return [f"[0:{len(np.asarray(body))}]"] if body.ndim and body.dtype.kind in "fiub" else []
    return list(_paths(body, "", 0))


def _paths(value: Any, path: str, depth: int) -> Iterator[str]:
    if depth > MAX_DEPTH:
        return
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield path
    elif isinstance(value, np.ndarray) or is_list(value):
        if len(value) and (
            value.dtype.kind in "fiub" if isinstance(value, np.ndarray) else _numbers(value) is not None
        ):
            yield f"{path}[0:{len(value)}]"
        elif len(value) and not isinstance(value, np.ndarray):
            yield from _paths(value[0], f"{path}[0]", depth + 1)
    else:
        names = member_names(value)
        if path and frozenset(names) in PARTS_OF:
            yield path
            return
        for name, inside in set_members(value):
            if name not in ABOUT:
                yield from _paths(inside, f"{path}.{name}" if path else name, depth + 1)


def _leaves(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    if len(path) > MAX_DEPTH:
        return
    if isinstance(value, bool | int | float | np.number | np.bool_):
        with suppress(OverflowError):  # JSON has whole numbers of any length
            yield path or ("value",), float(value)
    elif isinstance(value, np.ndarray) or is_list(value):
        yield from _list_leaves(value, path, ())
    else:
        fields = dict(set_members(value))
        names = _texts(fields.get("name"))
        for name, inside in fields.items():
            if name in ABOUT:
                continue
            if isinstance(inside, np.ndarray) or is_list(inside):
                yield from _list_leaves(inside, (*path, name), names)
            else:
                yield from _leaves(inside, (*path, name))


def _list_leaves(values: Any, path: tuple[str, ...], names: Sequence[str]) -> Iterator[tuple[tuple[str, ...], float]]:
    if len(values) == 0 or len(values) > LARGEST_VECTOR:
        return
    numbers = _numbers(values)
    if numbers is not None:
        places = [str(index) for index in range(len(numbers))]
        labels = names if len(set(names)) == len(names) == len(numbers) and all(names) else places
        yield from (((*path, label), number) for label, number in zip(labels, numbers, strict=True))
        return
    for index, item in enumerate(values):
        if isinstance(item, str | bytes):
            return
        label = _item_name(item) or str(index)
        for inside, number in _leaves(item, ()):
            # A plain field of an item joins the same field of its neighbours: one plot of all joints' positions.
            yield ((*inside, label) if len(inside) == 1 else (*path, label, *inside)), number


def _numbers(values: Any) -> list[float] | None:
    """The values of a flat list or array of numbers; None for anything else."""
    array = as_numbers(values)
    return array.tolist() if array is not None and array.ndim == 1 else None


def is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray | memoryview)


def _texts(value: Any) -> Sequence[str]:
    return [clean_name(str(text)) for text in value] if value is not None and is_list(value) else ()


def _item_name(item: Any) -> str | None:
    fields = dict(set_members(item))
    told = (clean_name(fields[name]) for name in ITEM_NAMES if isinstance(fields.get(name), str))
    return next((name for name in told if name), None)
