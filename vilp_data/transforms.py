"""Messages of `/tf` and `/tf_static` into links between frames of reference, and transforms into columns. Pure.

Words: a *link* says where a child frame lies in its parent, from one stamp on until the child's next link, which may name another
parent (an object that is grasped). What links say together is `transform_tree`. Frame names are compared without ROS 1's leading slash.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from vilp_data.decode import header_time_ns
from vilp_data.decode.message_body import cannot_decode, first_member, member, member_names, number
from vilp_data.errors import DecodeError, nearest
from vilp_data.rotations import NO_ROTATION
from vilp_data.types import F64, Clock, Message

COLUMNS: dict[str, tuple[int, ...]] = {
    "translation": (0, 1, 2), "rotation": (3, 4, 5, 6),
    "translation.x": (0,), "translation.y": (1,), "translation.z": (2,),
    "rotation.x": (3,), "rotation.y": (4,), "rotation.z": (5,), "rotation.w": (6,),
}  # fmt: skip
"""What a task's `fields` may name of a transform, and where it lies in the seven numbers."""

STATIC = "_static"
"""What the topic of static transforms is called after the topic of those that move."""

Transform = tuple[float, float, float, float, float, float, float]
"""Translation x y z in the parent, and the unit quaternion x y z w that turns the child's axes into the parent's."""


class Link(NamedTuple):
    """From `stamp_ns` on, `child` lies at `transform` in `parent`; at all times where `static`."""

    stamp_ns: int
    parent: str
    child: str
    transform: Transform
    static: bool


def links_of(message: Message, *, clock: Clock, offset_s: float = 0.0, static: bool = False) -> list[Link]:
    """The links in a message of tf (TFMessage, TransformStamped, foxglove.FrameTransform or FrameTransforms).

    With `clock` "header" each link has its own stamp; a static one needs none. DecodeError where the message holds no transforms, or
    no stamps."""
    offset_ns = round(offset_s * 1e9)
    arrival_ns = message.publish_time_ns if clock == "publish" else message.log_time_ns
    found = []
    for item in _items(message):
        parent = first_member(member(item, "header"), ("frame_id",)) or member(item, "parent_frame_id")
        child, transform = member(item, "child_frame_id"), member(item, "transform", item)
        if not isinstance(parent, str) or not isinstance(child, str):
            raise _no_transform(message)
        stamp_ns: int | None = arrival_ns
        if clock == "header" and not static:
            stamp_ns = header_time_ns(Message(message.topic, message.schema, message.log_time_ns, 0, item))
        if stamp_ns is None:
            remedy = 'set clock = "log" for this topic'
            raise cannot_decode(message, f"the transform of {child!r} carries no stamp of its own", None, remedy)
        found.append(
            Link(stamp_ns + offset_ns, plain(parent), plain(child), _transform(message, child, transform), static)
        )
    return found


def pick_columns(values: F64, fields: Sequence[str], *, where: str) -> F64:
    """The columns of [M,7] that `fields` name, all where they name none. DecodeError naming the nearest."""
    for name in fields:
        if name not in COLUMNS:
            raise DecodeError(f"a transform has no field {name!r}", where=where, remedy=nearest(name, COLUMNS))
    return values[:, [column for name in fields for column in COLUMNS[name]]] if fields else values


def picked_names(fields: Sequence[str]) -> tuple[str, ...]:
    """The names of the columns that `pick_columns` picks: `translation.x`, …"""
    single = [name for name in COLUMNS if "." in name]
    return tuple(single[column] for name in fields or ("translation", "rotation") for column in COLUMNS[name])


def plain(frame: str) -> str:
    return frame.lstrip("/")


def _items(message: Message) -> Sequence[Any]:
    """The transforms in a message of many, or the message itself."""
    items = member(message.body, "transforms", None)
    if items is None:
        return [message.body]
    if not isinstance(items, Sequence) or isinstance(items, str | bytes):
        raise _no_transform(message)
    return items


def _transform(message: Message, child: str, value: Any) -> Transform:
    """Translation and unit quaternion; NaN for a rotation that is none, as drivers send before they know better."""
    shift, turn = member(value, "translation"), member(value, "rotation")
    numbers = [member(shift, axis, math.nan) for axis in "xyz"] + [member(turn, axis, math.nan) for axis in "xyzw"]
    if any(type(part) is not float for part in numbers):  # an int, as JSON may have it, or nonsense
        names = [f"{child}: {name}" for name in COLUMNS if "." in name]
        numbers = [number(part, message, name) for part, name in zip(numbers, names, strict=True)]
    x, y, z, *quaternion = numbers
    norm = math.sqrt(sum(part * part for part in quaternion))
    qx, qy, qz, qw = (part / norm for part in quaternion) if norm > NO_ROTATION else [math.nan] * 4
    return x, y, z, qx, qy, qz, qw


def _no_transform(message: Message) -> DecodeError:
    found = f"{message.schema}, with {', '.join(member_names(message.body)) or 'no members'}"
    remedy = "from_frame and to_frame are for topics of tf: TFMessage, TransformStamped, foxglove.FrameTransform(s)"
    return cannot_decode(message, "the message holds no transforms between frames", found, remedy)
