"""Messages into float vectors: the fields that a task names, or a schema's usual ones. Pure: a message in, an array out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from vilp_data.decode.field_paths import fields_here, follow, parse_path
from vilp_data.decode.message_body import cannot_decode, first_member, member, member_names, number, require_member
from vilp_data.decode.numeric_fields import as_numbers
from vilp_data.decode.usual_fields import ONE_POINT, PARTS_OF, ROTATION, usual_fields
from vilp_data.errors import nearest
from vilp_data.types import F64, Message

NAME_LISTS = ("name", "joint_names")
"""Members that list what the other lists of a message are of: JointState's, JointTrajectory's."""

VectorReader = Callable[[Message], F64]


def decode_vector(message: Message, fields: Sequence[str] = (), names: Sequence[str] = ()) -> F64:
    """The vector float64 [D] that `fields` and `names` pick out of a message, as `spec.VectorSpec` describes them.

    Each field is a path ("pose.position.x", "position[0:7]", "[0:2]" into a bare array) to a number, a list of them or a message
    that is nothing but numbers (a point, a quaternion, a pose, a twist); their values are concatenated. Without fields: the whole
    array, or the schema's usual ones. With `names`, each field is a list parallel to the message's `name`, and the values of those
    names are taken in that order. DecodeError where a field, index or name is not in the message."""
    return compile_fields(tuple(fields), tuple(names))(message)


@lru_cache(maxsize=256)
def compile_fields(fields: tuple[str, ...], names: tuple[str, ...] = ()) -> VectorReader:
    """`decode_vector` for one topic, its paths parsed once: message -> float64 [D]. DecodeError where a path is malformed."""
    for path in fields:
        parse_path(path)
    orders: dict[tuple[str, ...], list[int]] = {}  # by the names that a message lists

    def read(message: Message) -> F64:
        chosen = fields or default_fields(message)
        parts = [_numbers(message, path, follow(message, path)) for path in chosen]
        if names:
            published = published_names(message)
            if published not in orders:
                orders[published] = _order(message, published, names)
            for place, path in enumerate(chosen):
                parts[place] = _reordered(message, path, parts[place], orders[published], len(published))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return read


def rotation_columns(message: Message, fields: Sequence[str] = ()) -> tuple[int, ...]:
    """Where in the vector of a message each quaternion begins: of a path that leads to a rotation or to a message with some in it (a
    pose, a list of poses), and of four paths in a row that are one's x, y, z and w."""
    found: list[int] = []
    paths, size = fields or default_fields(message), 0
    for place, path in enumerate(paths):
        value = follow(message, path)
        found += [size + column for column in _rotations_in(value)[0]]
        base = path.removesuffix("x")
        if path.endswith("x") and tuple(paths[place : place + 4]) == tuple(base + axis for axis in "xyzw"):
            found.append(size)
        size += len(_numbers(message, path, value))
    return tuple(found)


def concerns(message: Message, names: Sequence[str]) -> bool:
    """Whether a message says anything of the joints called `names`. Several publishers may share one topic, each with joints of
    its own; a message of another robot part is not a message of this vector."""
    if not names:
        return True
    published = published_names(message)
    return not published or not set(published).isdisjoint(names)


def published_names(message: Message) -> tuple[str, ...]:
    """The names that a message's lists are parallel to; empty where it has none. DecodeError where what should be names is none."""
    joints = member(message.body, "joints", None)
    try:
        names = first_member(message.body, NAME_LISTS) if joints is None else require_member(joints, "name")
        listed = () if names is None or isinstance(names, str) else tuple(names)
    except (AttributeError, KeyError, TypeError):
        listed = (None,)
    if not all(isinstance(name, str) for name in listed):
        remedy = "leave the topic out, or this message where it is the only one"
        raise cannot_decode(message, "the names of its joints are no list of names", None, remedy)
    return listed


def default_fields(message: Message) -> tuple[str, ...]:
    """The paths that are read where a task names none. DecodeError where a schema has no usual ones."""
    if isinstance(message.body, np.ndarray | np.generic):
        return ("",)
    fields = usual_fields(message.schema)
    if fields is None:
        raise cannot_decode(
            message,
            "the task names no fields, and this schema has no usual ones",
            message.schema,
            f"choose among the fields here: {fields_here(message)}",
        )
    points = member(message.body, "points", ()) if fields == ONE_POINT else ()
    if isinstance(points, Sequence) and len(points) > 1:
        found = f'{len(points)} points; fields = ["points[-1].positions"] is where they end'
        remedy = "name the point: controllers begin with where the robot is, or with where it should be next"
        raise cannot_decode(message, "nothing says which point of a trajectory is the command", found, remedy)
    return fields


def _numbers(message: Message, path: str, value: Any) -> F64:
    if isinstance(value, float):  # the common cases, and ten times faster than what follows
        return np.array([value])
    if type(value) is list and value and type(value[0]) is float and not any(type(item) is not float for item in value):
        return np.array(value)
    flat = _flattened(message, path, value)
    if flat is not None:
        return np.array(flat)
    array = as_numbers(value)
    if array is None:
        inside = [f"{path}.{name}" if path else name for name in member_names(value)]
        remedy = f"name its fields: {', '.join(inside)}" if inside else f"choose among: {fields_here(message)}"
        raise cannot_decode(message, f"field {path!r} holds no numbers", type(value).__name__, remedy)
    return array.ravel()


def _flattened(message: Message, path: str, value: Any) -> list[float] | None:
    """The numbers of a point, quaternion, pose, twist, …, or of a list of them, in their usual order; None for anything else."""
    if isinstance(value, list | tuple) and value and member_names(value[0]):
        items = [_flattened(message, path, item) for item in value]
        return None if any(item is None for item in items) else [value for item in items for value in item or ()]
    names = PARTS_OF.get(frozenset(member_names(value)))
    if names is None:
        return None
    out: list[float] = []
    for name in names:
        part = member(value, name)
        if isinstance(part, int | float):
            out.append(number(part, message, f"field {path!r}"))
        elif (inside := _flattened(message, path, part)) is not None:
            out += inside
        else:
            return None
    return out


def _rotations_in(value: Any) -> tuple[list[int], int]:
    """Where in the numbers that `_flattened` gives each quaternion begins, and how many numbers there are."""
    if isinstance(value, list | tuple):
        parts = list(value) if value and member_names(value[0]) else []
    else:
        names = PARTS_OF.get(frozenset(member_names(value)), ())
        if names == ROTATION:
            return [0], len(ROTATION)
        parts = [member(value, name) for name in names]
    found, size = [], 0
    for part in parts:
        inside, length = ([], 1) if isinstance(part, int | float) else _rotations_in(part)
        found += [size + column for column in inside]
        size += length
    return found, size


def _order(message: Message, published: tuple[str, ...], names: tuple[str, ...]) -> list[int]:
    if not published:
        remedy = "use indices: position[0:7]"
        raise cannot_decode(
            message, "the task picks by name, but the message has no list `name`", message.schema, remedy
        )
    for name in names:
        if name not in published:
            raise cannot_decode(message, f"no joint {name!r}", None, nearest(name, published))
    return [published.index(name) for name in names]


def _reordered(message: Message, path: str, part: F64, order: list[int], n_names: int) -> F64:
    if len(part) != n_names:
        found = f"{len(part)} values, {n_names} names"
        raise cannot_decode(message, f"field {path!r} is not parallel to `name`", found, "leave `names` or slices out")
    return part[order]
