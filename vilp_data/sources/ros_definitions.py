"""ROS message definitions that no robot writes, refused before code is made of them.

rosbags turns a definition into Python and runs it, names as they stand, and a log's schema record may hold any text as a name. Its
parsers refuse most that is no name, but not all (`3d_msgs/msg/Scan` ends as a SyntaxError), so that does not hang on them alone.

A definition of one line can ask for a billion fields (`string[1000000000] a`), or for a list of messages without members: in ROS 1
those take no bytes, and a message of four bytes may claim four billion of them. In CDR they take one each."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping, Sequence
from typing import Any

from rosbags.interfaces import Nodetype

from vilp_data import limits

MOST_FIELDS = 5000
"""Fields of one type, those of fixed arrays counted one by one where they are text or messages: each becomes a line of code."""

EMPTY_MEMBER = "structure_needs_at_least_one_member"  # what IDL puts into a type without members

_MEMBER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*")

# Type name -> (constants, [(field name, its description)]), as rosbags parses definitions.
Types = Mapping[str, Any]


def refuse_unreasonable(types: Types, *, empty_takes_bytes: bool) -> None:
    """ValueError where a name is more than a name, where a type has too many fields, contains itself, nests too deep, or repeats what
    takes no bytes."""
    for name, (constants, fields) in types.items():
        _require_names(_TYPE, [name, *(inner for _, kind in fields if (inner := _inner_name(kind)) is not None)])
        _require_names(_MEMBER, [member[0] for member in (*constants, *fields)])
    depths: dict[str, int] = {}
    for name, (_, fields) in types.items():
        if (count := sum(_count(kind) for _, kind in fields)) > MOST_FIELDS:
            raise ValueError(f"{name} has {count:,} fields, where {MOST_FIELDS:,} are allowed")
        _depth(name, types, depths, ())
    for name, (_, fields) in types.items() if not empty_takes_bytes else ():
        for field, kind in fields:
            if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and _is_empty(kind[1][0], types):
                raise ValueError(f"{name}.{field} repeats a message without members")


def _require_names(pattern: re.Pattern[str], names: Sequence[str]) -> None:
    """ValueError for a name that is not of ASCII letters, digits and _, with slashes in a type's; or that Python keeps for itself."""
    for name in names:
        if not pattern.fullmatch(name) or (pattern is _TYPE and keyword.iskeyword(name)):
            raise ValueError(f"{name[:60]!r} is no name")


def _count(kind: Any) -> int:
    """How many lines of code a field becomes."""
    if kind[0] == Nodetype.ARRAY:
        inner, length = kind[1]
        return length if inner[0] == Nodetype.NAME or inner[1][0] in ("string", "wstring") else 1
    return 1


def _depth(name: str, types: Types, depths: dict[str, int], above: tuple[str, ...]) -> int:
    """How many levels of messages there are in a type; ValueError where it contains itself or there are too many."""
    if name in above:
        raise ValueError(f"{name} contains itself")
    if len(above) >= limits.DEFINITION_DEPTH:
        raise ValueError(f"messages nested more than {limits.DEFINITION_DEPTH} deep")
    if name not in depths:
        inner = [_inner_name(kind) for _, kind in types[name][1]] if name in types else []
        depths[name] = 1 + max((_depth(n, types, depths, (*above, name)) for n in inner if n), default=0)
    if len(above) + depths[name] > limits.DEFINITION_DEPTH:
        raise ValueError(f"messages nested more than {limits.DEFINITION_DEPTH} deep")
    return depths[name]


def _inner_name(kind: Any) -> str | None:
    inner = kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
    return str(inner[1]) if inner[0] == Nodetype.NAME else None


def _is_empty(kind: Any, types: Types) -> bool:
    """Whether this kind takes no bytes in ROS 1. Types that nest without end were refused before."""
    if kind[0] == Nodetype.ARRAY:
        return kind[1][1] == 0 or _is_empty(kind[1][0], types)
    if kind[0] != Nodetype.NAME or kind[1] not in types:
        return False
    return all(name == EMPTY_MEMBER or _is_empty(inner, types) for name, inner in types[kind[1]][1])
