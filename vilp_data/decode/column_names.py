"""What the numbers of a vector are called: by the log (joints, a dataset's own names), else by the fields that they lie in. Pure."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vilp_data.decode.field_paths import bare_array, follow
from vilp_data.decode.message_body import first_member, member, member_names
from vilp_data.decode.numeric_fields import as_numbers, is_list
from vilp_data.decode.usual_fields import PARTS_OF
from vilp_data.decode.vectors import NAME_LISTS, decode_vector, default_fields, published_names
from vilp_data.errors import DecodeError
from vilp_data.types import Message

LONGEST_NAME = 100
"""Characters of a name that are kept: whoever wrote the log chose it."""

_ITEMS = re.compile(r"(\[[^\[\]]*\])+$")


def column_names(
    message: Message, fields: Sequence[str] = (), names: Sequence[str] = (), topic_names: Sequence[str] = ()
) -> tuple[str, ...]:
    """A name for each number of the vector that `decode_vector` gives of this message.

    `topic_names` are those that the log gives the numbers of an array. What nothing names is called by its place in its list. Where
    several fields share names (position and velocity of a joint), each says its field first. DecodeError as `decode_vector`."""
    paths = tuple(fields) or default_fields(message)
    named = [(_field(path), names or _names_at(message, path, topic_names)) for path in paths]
    found = [name for _, inside in named for name in inside]
    if len(set(found)) < len(found):
        found = [f"{field}.{name}".strip(".") for field, inside in named for name in inside]
    return tuple(_clean(name) for name in found)


def _field(path: str) -> str:
    """What the numbers at a path belong to: their list, or the message that a single one is a member of."""
    whole = _ITEMS.sub("", path)
    return whole if whole != path else path.rpartition(".")[0] or path


def _names_at(message: Message, path: str, topic_names: Sequence[str]) -> Sequence[str]:
    values = decode_vector(message, (path,))
    last = [path.rpartition(".")[2]]
    field = _ITEMS.sub("", path)
    whole = as_numbers(follow(message, field) if field or _is_array(message) else bare_array(message))
    if whole is None or not whole.ndim:
        parts = _part_names(follow(message, path))
        counted = last if len(values) == 1 else [str(place) for place in range(len(values))]
        return parts if len(parts) == len(values) else counted
    places = np.arange(whole.size).reshape(whole.shape)
    chosen = decode_vector(replace(message, body=places), (path[len(field) :],)).astype(int).tolist()
    known = topic_names if _is_array(message) else _parallel_names(message, field)
    if len(known) == whole.size:
        return [known[place] for place in chosen]
    return last if path.endswith("]") and ":" not in path else [str(place) for place in chosen]


def _is_array(message: Message) -> bool:
    return isinstance(message.body, np.ndarray)


def _parallel_names(message: Message, field: str) -> Sequence[str]:
    """The names that a list is parallel to: those beside it, else those of the message; none where what should be names is not."""
    beside = first_member(follow(message, field.rpartition(".")[0]), NAME_LISTS)
    if is_list(beside) and all(isinstance(name, str) for name in beside):
        return list(beside)
    try:
        return published_names(message)
    except DecodeError:  # nobody asked for names: the numbers are read by their places
        return ()


def _part_names(value: Any) -> list[str]:
    """The names of the numbers in a message that is nothing but numbers (`position.x`), or in a list of such (`0.position.x`)."""
    if isinstance(value, list | tuple):
        items = [(str(place), item) for place, item in enumerate(value)]
    else:
        items = [(name, member(value, name)) for name in PARTS_OF.get(frozenset(member_names(value)), ())]
    return [f"{name}.{inside}" if inside else name for name, item in items for inside in _part_names(item) or [""]]


def _clean(name: str) -> str:
    """A name on one line, of letters that can be stored, and no longer than anybody reads."""
    return " ".join(name.encode(errors="replace").decode().split())[:LONGEST_NAME]
