"""What messages call the numbers of a vector: by a list of names beside theirs, by the items and members that they lie in. Pure.

The way to each number is told by the trail that its path takes through the message, the same that `decode_vector` reads it by: a range, an
index or `msg.` cannot mean one number there and another here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from vilp_data.decode.field_paths import Member, Step, n_stated, trail
from vilp_data.decode.message_body import holds_items, member, member_names
from vilp_data.decode.usual_fields import PARTS_OF
from vilp_data.decode.vectors import NAME_LISTS, decode_vector, default_fields
from vilp_data.short_names import Token, clean_name, short_names
from vilp_data.types import Message

Axis = tuple[str, ...] | range
"""A token for each item of a list: names, or places in it. Of what has no items, or rows of them, no places."""

NO_ITEMS = range(0)

Outline = tuple[Any, ...]
"""How numbers lie in what a path leads to: the shape of an array, () of a number alone; (name, outline) of each member of a message that is
nothing but numbers; (None, outline) of each item in a list of such."""

Glance = Callable[[Message], object]
"""What `ColumnNames` looks at in most messages: where it is as it was, so are all the names."""


class Way(NamedTuple):
    """The way to a number; `told`: whether the message named a token of it, beyond those of the path."""

    tokens: tuple[Token, ...]
    told: bool


class Seen(NamedTuple):
    """All that the names at a path depend on in one message: the steps taken, the items of what each was taken in and of what the last
    one led to, and how numbers lie in that."""

    steps: tuple[Step, ...]
    axes: tuple[Axis, ...]
    outline: Outline


class ColumnNames:
    """What the messages of one topic call the numbers at `fields`: give it each of them, then ask for the `names`.

    `topic_names` are those that the log gives the numbers of an array."""

    def __init__(self, fields: Sequence[str] = (), topic_names: Sequence[str] = ()) -> None:
        self._fields, self._topic_names = tuple(fields), tuple(topic_names)
        self._seen: object = None
        self._glance: Glance | None = None
        self._glimpsed: object = None
        self._names: tuple[str, ...] | None = None
        self.differ = False
        """Whether messages named the numbers differently: which of them is right for a column is not told."""

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each number, "" for what nothing names, or messages name differently; empty where they tell no more than the paths."""
        names = self._names or ()
        return ("",) * len(names) if self.differ else names

    def add(self, message: Message, n_numbers: int) -> None:
        """A message, and how many numbers were read of it. Raises nothing that reading them did not."""
        if self.differ or (self._glance is not None and self._glance(message) == self._glimpsed):
            return
        seen = self._look(message)
        if seen == self._seen:
            return
        self._glance = _glance_at(message, self._fields or default_fields(message))
        self._glimpsed = self._glance(message) if self._glance is not None else None
        self._seen, found = seen, self._named(message, seen)
        if len(found) != n_numbers:
            found = ()
        self.differ = self._names is not None and found != self._names
        self._names = self._names or found

    def _look(self, message: Message) -> object:
        if isinstance(message.body, np.ndarray | np.generic):
            return message.body.shape
        return tuple([_seen_at(message, path) for path in self._fields or default_fields(message)])

    def _named(self, message: Message, seen: Any) -> tuple[str, ...]:
        paths = self._fields or default_fields(message)
        if isinstance(message.body, np.ndarray | np.generic):
            ways = [self._ways_of_array(message, path) for path in paths]
        else:
            ways = [_ways(*one) for one in seen]
        flat = [way for found in ways for way in found]
        as_stated = [n_stated(path) == len(found) for path, found in zip(paths, ways, strict=True)]
        if self._fields and all(as_stated) and not any(way.told for way in flat):
            return ()
        return short_names([way.tokens for way in flat])

    def _ways_of_array(self, message: Message, path: str) -> tuple[Way, ...]:
        """Read off an array that holds at each place what place it is."""
        places = np.arange(message.body.size).reshape(message.body.shape)
        chosen = decode_vector(replace(message, body=places), (path,)).astype(int).tolist()
        names: Axis = self._topic_names if len(self._topic_names) == places.size else NO_ITEMS
        return tuple(_to_item(Way((), False), place, names) for place in chosen)


def _glance_at(message: Message, paths: Sequence[str]) -> Glance | None:
    """A glance at messages of this one's type, which fixes all but the lengths of their lists of numbers and the names beside them. None
    where it does not: for JSON, and for lists of messages."""
    lists, names = list[str](), list[str]()
    for path in paths:
        steps, values = trail(message, path)
        if any(isinstance(value, dict) for value in values):
            return None
        first = next((place for place, value in enumerate(values) if _has_items(value)), None)
        if first is None:
            continue
        members = [step.name for step in steps[:first] if isinstance(step, Member)]
        if not first or len(members) < first or not _is_row_of_numbers(values[first]):
            return None
        lists.append(".".join(members))
        beside = [name for name in NAME_LISTS if holds_items(type(member(values[first - 1], name)))]
        names += [".".join([*members[:-1], name]) for name in beside]
    get, n_lists = attrgetter("__class__", "__class__", *lists, *names), 2 + len(lists)

    def glance(message: Message) -> object:
        try:
            found = get(message.body)
        except AttributeError:  # of another type
            return None
        return found[0], message.schema, [len(row) for row in found[2:n_lists]], [list(row) for row in found[n_lists:]]

    return glance


def _has_items(value: Any) -> bool:
    return isinstance(value, np.ndarray) or holds_items(type(value))


def _is_row_of_numbers(value: Any) -> bool:
    return _is_row(value) and (isinstance(value, np.ndarray) or not len(value) or isinstance(value[0], int | float))


def _seen_at(message: Message, path: str) -> Seen:
    steps, values = trail(message, path)
    axes = [_places(values[0])]
    for number, step in enumerate(steps):
        value, inside = values[number], values[number + 1]
        if isinstance(step, slice):
            axes.append(axes[-1][step])
        elif isinstance(step, Member) and not holds_items(type(value)):
            axes.append(_named_items(inside, value, _beyond(steps, values, number)))
        elif isinstance(step, Member):  # that member of every item
            axes.append(axes[-1])
        else:
            axes.append(_places(inside))
    return Seen(steps, tuple(axes), _outline(values[-1]))


def _beyond(steps: Sequence[Step], values: Sequence[Any], number: int) -> Any:
    """The message that a list of messages is a member of, of one of which this step takes a member (`points[-1].positions`)."""
    if number >= 2 and isinstance(steps[number - 1], int) and isinstance(steps[number - 2], Member):
        return values[number - 2]
    return None


def _places(value: Any) -> Axis:
    return range(len(value)) if _is_row(value) else NO_ITEMS


def _is_row(value: Any) -> bool:
    return value.ndim == 1 if isinstance(value, np.ndarray) else holds_items(type(value))


def _named_items(value: Any, beside: Any, beyond: Any) -> Axis:
    """The items of a member: by their own names, else by the list of names beside it, of a trajectory's point by its joints."""
    if not _is_row(value):
        return NO_ITEMS
    n_items = len(value)
    if n_items and isinstance(member(value[0], "name"), str):
        return _texts([member(item, "name") for item in value], n_items) or range(n_items)
    for whole, name in (*((beside, name) for name in NAME_LISTS), (beyond, NAME_LISTS[-1])):
        listed = member(whole, name)
        if listed is not None and holds_items(type(listed)) and (names := _texts(listed, n_items)):
            return names
    return range(n_items)


def _texts(values: Sequence[Any], n_items: int) -> tuple[str, ...]:
    """Values as names, where they are as many and all of them texts; else nothing."""
    return tuple(values) if len(values) == n_items and all(type(value) is str for value in values) else ()


def _outline(value: Any) -> Outline:
    if isinstance(value, int | float | np.generic):
        return ()
    if isinstance(value, np.ndarray):
        return tuple(value.shape)
    if holds_items(type(value)):
        if not len(value) or isinstance(value[0], int | float):
            return (len(value),)
        if not member_names(value[0]):
            return np.shape(value)
        return tuple([(None, _outline(item)) for item in value])
    return tuple([(name, _outline(member(value, name))) for name in PARTS_OF.get(frozenset(member_names(value)), ())])


def _ways(steps: tuple[Step, ...], axes: tuple[Axis, ...], outline: Outline) -> tuple[Way, ...]:
    """The way to each number that a path gives, in their order."""
    way = Way((), False)
    for step, axis in zip(steps, axes, strict=False):  # the last axis is of what the path leads to
        if isinstance(step, Member):
            way = _further(way, step.name)
        elif isinstance(step, int):
            way = _to_item(way, step, axis)
    return tuple(_inside(way, axes[-1], outline))


def _inside(way: Way, axis: Axis, outline: Outline) -> Iterator[Way]:
    if not outline:
        yield way
    elif isinstance(outline[0], int):
        row = axis if len(outline) == 1 else NO_ITEMS
        yield from (_to_item(way, place, row) for place in range(math.prod(outline)))
    else:
        for place, (name, inside) in enumerate(outline):
            further = _to_item(way, place, axis) if name is None else _further(way, name, told=True)
            yield from _inside(further, NO_ITEMS, inside)


def _to_item(way: Way, place: int, axis: Axis) -> Way:
    token = axis[place] if axis else place
    return _further(way, token, told=isinstance(token, str))


def _further(way: Way, token: Token, *, told: bool = False) -> Way:
    return Way((*way.tokens, clean_name(token) if isinstance(token, str) else token), way.told or told)
