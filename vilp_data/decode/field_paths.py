"""Paths into a message: "pose.position.x", "position[0:7]", "joints[2].effort", "[0:2]" for a bare array, "points[-1]" for the
last of a list. Pure.

A path may begin with `msg.`, as message definitions and plotting tools have it: "msg.position[0:7]" is "position[0:7]".
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from vilp_data.decode.message_body import cannot_decode, member_names, require_member
from vilp_data.decode.numeric_fields import numeric_paths
from vilp_data.decode.usual_fields import usual_fields
from vilp_data.errors import DecodeError, nearest, some_of
from vilp_data.types import Message

_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(-?\d+)(?::(\d+))?\]")
_RANGE = re.compile(r"(.*)\[(\d+):(\d+)\]", re.DOTALL)
WHOLE = "msg"
SHOWN_PATHS = 24


@dataclass(frozen=True, slots=True)
class Member:
    name: str


Step = Member | int | slice


@lru_cache(maxsize=1024)
def parse_path(path: str) -> tuple[Step, ...]:
    """The steps of a path. DecodeError where it is malformed."""
    steps: list[Step] = []
    position = 0
    while position < len(path):
        match = _STEP.match(path, position)
        if (
            match is None
            or (match.group().startswith(".") and not steps)
            or (match.group(1) and steps and not match.group().startswith("."))
        ):
            remedy = 'paths look like "pose.position.x", "position[0:7]", "[0:2]"'
            raise DecodeError(f"field path {path!r} cannot be understood", found=path[position:], remedy=remedy)
        name, first, stop = match.groups()
        steps.append(Member(name) if name else int(first) if stop is None else slice(int(first), int(stop)))
        position = match.end()
    return tuple(steps)


def follow(message: Message, path: str) -> Any:
    """What lies at `path` in a message. DecodeError where the path leads nowhere: it says what is there."""
    return trail(message, path)[1][-1]


def trail(message: Message, path: str) -> tuple[tuple[Step, ...], list[Any]]:
    """The steps that a path takes in a message, without `msg.` and from its body on; what the first is taken in, and what each leads to.
    DecodeError as `follow`."""
    steps, value = parse_path(path), message.body
    if steps and steps[0] == Member(WHOLE) and WHOLE not in member_names(value):
        steps = steps[1:]
    if steps and not isinstance(steps[0], Member) and not isinstance(value, np.ndarray):
        steps = (*_only_field(message), *steps)
    values = [value]
    for step in steps:
        if isinstance(step, Member):
            try:
                value = require_member(value, step.name)
            except (AttributeError, KeyError):
                raise _no_member(message, path, step.name, value) from None
        else:
            value = _item(message, path, value, step)
        values.append(value)
    return steps, values


def range_of(path: str) -> tuple[str, range] | None:
    """What a path that ends in a range of items leads through ("position" of "position[0:7]"), and the range; None for another path."""
    match = _RANGE.fullmatch(path)
    return (match.group(1), range(int(match.group(2)), int(match.group(3)))) if match else None


def n_stated(path: str) -> int:
    """How many numbers a path seems to lead to, as far as its text tells: those of its range, else one."""
    found = range_of(path)
    return len(found[1]) if found else 1


def fields_here(message: Message) -> str:
    """The numeric fields of a message, to be shown to whoever named none, or a wrong one."""
    paths = numeric_paths(message.body)
    return some_of(paths, SHOWN_PATHS) or "(no numbers)"


def _no_member(message: Message, path: str, name: str, value: Any) -> DecodeError:
    known = member_names(value)
    if not known and isinstance(value, list | tuple) and value:
        known = member_names(value[0])
    remedy = f"{nearest(name, known)}; fields that hold numbers here: {fields_here(message)}"
    return cannot_decode(message, f"field {path!r}: no {name!r}", None, remedy)


def _only_field(message: Message) -> tuple[Step, ...]:
    """The steps to what "[0:2]" indexes in a message that is no array: the only field that its schema's vector is made of, as of the
    std_msgs arrays; none where it has no such field, and nothing in it has items."""
    fields = usual_fields(message.schema) or ()
    return parse_path(fields[0]) if len(fields) == 1 else ()


def _item(message: Message, path: str, value: Any, step: int | slice) -> Any:
    if isinstance(value, dict) or not hasattr(value, "__len__"):
        found = type(value).__name__
        raise cannot_decode(
            message, f"field {path!r}: only lists and arrays have items", found, "leave the brackets out"
        )
    length = len(value)
    if not _is_inside(step, length):
        raise cannot_decode(
            message, f"field {path!r} reaches outside its list", f"{length} values", f"use indices within [0:{length}]"
        )
    return value[step]


def _is_inside(step: int | slice, length: int) -> bool:
    return 0 <= step.start < step.stop <= length if isinstance(step, slice) else -length <= step < length
