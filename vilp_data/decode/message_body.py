"""The members of a message's body, whatever its kind: an object with attributes (CDR, protobuf), a dict (JSON), an array. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from vilp_data.errors import DecodeError
from vilp_data.types import Message

SHOWN_CHARACTERS = 60
DAMAGED = "the recorder wrote a damaged message; leave the topic out"


def member(value: Any, name: str, default: Any = None) -> Any:
    """A member by name, `default` where there is none."""
    return value.get(name, default) if isinstance(value, dict) else getattr(value, name, default)


def require_member(value: Any, name: str) -> Any:
    """A member by name; of a list of messages (foxglove.JointStates), that member of each. AttributeError or KeyError if absent."""
    if isinstance(value, dict):
        return value[name]
    if holds_items(type(value)):
        return [require_member(item, name) for item in value]
    return getattr(value, name)


def _holds_items(kind: type) -> bool:
    return issubclass(kind, Sequence) and not issubclass(kind, str | bytes)


holds_items: Callable[[type[Any]], bool] = cache(_holds_items)  # type: ignore[assignment]
"""Whether a type is a list of things; asked once a type, for asking an abstract class costs more than the rest of a path."""


def first_member(value: Any, names: Iterable[str]) -> Any:
    """The first of these members that is there, None where none is."""
    for name in names:  # a loop, for this is asked of every message
        found = value.get(name) if isinstance(value, dict) else getattr(value, name, None)
        if found is not None:
            return found
    return None


def member_names(value: Any) -> list[str]:
    """The names of a message's members in the schema's order, set or not; none for numbers, text, lists and arrays."""
    if isinstance(value, dict):
        return [str(key) for key in value]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("__")]


def set_members(value: Any) -> Iterator[tuple[str, Any]]:
    """(name, value) of a message's members, those left out that a protobuf message has no value for."""
    for name in member_names(value):
        if not _is_unset(value, name):
            yield name, member(value, name)


def _is_unset(value: Any, name: str) -> bool:
    descriptor = getattr(value, "DESCRIPTOR", None)
    return descriptor is not None and descriptor.fields_by_name[name].has_presence and not value.HasField(name)


def number(value: Any, message: Message, field: str) -> float:
    """A member's value as a float: a number, or text that reads as one, which is how JSON has 64-bit integers and "NaN".

    DecodeError naming the field for anything else (null, a list, an object, an integer beyond the floats)."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise cannot_decode(message, f"{field} is no number", shown(value), DAMAGED) from error


def whole_number(value: Any, message: Message, field: str) -> int:
    """The same of a size or a count: DecodeError for what is not whole too."""
    found = number(value, message, field)
    if not found.is_integer():
        raise cannot_decode(message, f"{field} is no whole number", shown(value), DAMAGED)
    return int(found)


def shown(value: Any) -> str:
    """A value for an error's `found`, cut where it is long."""
    text = "null" if value is None else repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}…"


def cannot_decode(message: Message, what: str, found: str | None, remedy: str) -> DecodeError:
    """The error for a message that cannot become what was asked for; it names the topic and the time."""
    return DecodeError(what, where=f"{message.topic} at {message.log_time_ns} ns", found=found, remedy=remedy)
