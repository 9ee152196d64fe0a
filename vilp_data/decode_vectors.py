"""Messages into float vectors: the fields that a task names, or a schema's usual ones. Pure: a message in, an array out."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.errors import DecodeError, nearest
from vilp_data.message_body import cannot_decode, member, member_names, require_member
from vilp_data.types import F64, Message

# What a message's whole vector is, where the spec names no fields.
POSE = tuple(
    f"{part}"
    for part in (
        "position.x",
        "position.y",
        "position.z",
        "orientation.x",
        "orientation.y",
        "orientation.z",
        "orientation.w",
    )
)
TWIST = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")
XYZ = ("x", "y", "z")
DEFAULT_FIELDS: dict[str, tuple[str, ...]] = {
    "sensor_msgs/msg/JointState": ("position",),
    "foxglove.JointStates": ("joints.position",),
    "foxglove.Pose": POSE,
    "foxglove.PoseInFrame": tuple(f"pose.{path}" for path in POSE),
    "geometry_msgs/msg/Pose": POSE,
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{path}" for path in POSE),
    "geometry_msgs/msg/Twist": TWIST,
    "geometry_msgs/msg/TwistStamped": tuple(f"twist.{path}" for path in TWIST),
    "geometry_msgs/msg/Point": XYZ,
    "geometry_msgs/msg/Vector3": XYZ,
    **{
        f"std_msgs/msg/{kind}": ("data",)
        for kind in ("Float32", "Float64", "Int32", "Int64", "Bool", "Float32MultiArray", "Float64MultiArray")
    },
}

_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)(?::(\d+))?\]")


@dataclass(frozen=True, slots=True)
class _Member:
    name: str


Step = _Member | int | slice
VectorReader = Callable[[Message], F64]


def decode_vector(message: Message, fields: Sequence[str] = (), names: Sequence[str] = ()) -> F64:
    """The vector float64 [D] that `fields` and `names` pick out of a message, as `spec.VectorSpec` describes them.

    Each field is a path ("pose.position.x", "position[0:7]", "[0:2]" into a bare array); their values are concatenated. Without
    fields: the whole array, or the schema's usual ones. With `names`, each field is a list parallel to the message's `name`, and
    the values of those names are taken in that order. DecodeError where a field, index or name is not in the message."""
    return compile_fields(tuple(fields), tuple(names))(message)


@lru_cache(maxsize=256)
def compile_fields(fields: tuple[str, ...], names: tuple[str, ...] = ()) -> VectorReader:
    """`decode_vector` for one topic, its paths parsed once: message -> float64 [D]. DecodeError where a path is malformed."""
    paths = [(path, _parse_path(path)) for path in fields]
    orders: dict[tuple[str, ...], list[int]] = {}  # by the names that a message lists

    def read(message: Message) -> F64:
        chosen = paths or [(path, _parse_path(path)) for path in _default_fields(message)]
        parts = [_numbers(message, path, _follow(message, path, steps)) for path, steps in chosen]
        if names:
            published = _published_names(message)
            if published not in orders:
                orders[published] = _order(message, published, names)
            for number, (path, _) in enumerate(chosen):
                parts[number] = _reordered(message, path, parts[number], orders[published], len(published))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return read


def _default_fields(message: Message) -> tuple[str, ...]:
    if isinstance(message.body, np.ndarray):
        return ("",)
    fields = DEFAULT_FIELDS.get(message.schema)
    if fields is None:
        known = ", ".join(member_names(message.body))
        raise cannot_decode(
            message,
            "the task names no fields, and this schema has no usual ones",
            message.schema,
            f"fields here: {known}",
        )
    return fields


def _parse_path(path: str) -> tuple[Step, ...]:
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
        steps.append(_Member(name) if name else int(first) if stop is None else slice(int(first), int(stop)))
        position = match.end()
    return tuple(steps)


def _follow(message: Message, path: str, steps: tuple[Step, ...]) -> Any:
    value = message.body
    if steps and not isinstance(steps[0], _Member) and not isinstance(value, np.ndarray):
        value = _bare_array(message)
    for step in steps:
        if isinstance(step, _Member):
            try:
                value = require_member(value, step.name)
            except (AttributeError, KeyError):
                raise cannot_decode(
                    message, f"field {path!r}: no {step.name!r}", None, nearest(step.name, member_names(value))
                ) from None
        else:
            value = _item(message, path, value, step)
    return value


def _bare_array(message: Message) -> Any:
    """What "[0:2]" indexes in a message that is no array: the only field that its schema's vector is made of, as of the std_msgs
    arrays; else the message itself, which has no items."""
    fields = DEFAULT_FIELDS.get(message.schema, ())
    if len(fields) != 1:
        return message.body
    (path,) = fields
    return _follow(message, path, _parse_path(path))


def _item(message: Message, path: str, value: Any, step: int | slice) -> Any:
    if isinstance(value, dict) or not hasattr(value, "__len__"):
        found = type(value).__name__
        raise cannot_decode(
            message, f"field {path!r}: only lists and arrays have items", found, "leave the brackets out"
        )
    length = len(value)
    last = step.stop if isinstance(step, slice) else step + 1
    if last > length or (isinstance(step, slice) and step.start >= step.stop):
        raise cannot_decode(
            message, f"field {path!r} reaches outside its list", f"{length} values", f"use indices within [0:{length}]"
        )
    return value[step]


def _numbers(message: Message, path: str, value: Any) -> F64:
    if isinstance(value, float):  # the common case, and ten times faster than what follows
        return np.array([value])
    try:
        array: npt.NDArray[Any] = np.asarray(value)
    except ValueError:
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        inside = [f"{path}.{name}" if path else name for name in member_names(value)]
        remedy = f"name its fields: {', '.join(inside)}" if inside else "choose a field that holds numbers"
        raise cannot_decode(message, f"field {path!r} holds no numbers", type(value).__name__, remedy)
    return array.astype(np.float64).ravel()


def _published_names(message: Message) -> tuple[str, ...]:
    joints = member(message.body, "joints", None)
    return tuple(member(message.body, "name", ()) if joints is None else require_member(joints, "name"))


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
