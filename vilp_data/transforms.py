"""The transform between two named frames over time, from messages of `/tf` and `/tf_static`. Pure.

Words: a *link* says where a child frame lies in its parent, from one stamp on until the child's next link, which may name another
parent (an object that is grasped). A static link holds at all times; one that is published again with another value holds from then
on. Only links stamped at or before an instant decide what holds at it. Frame names are compared without ROS 1's leading slash.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vilp_data import align
from vilp_data.decode import header_time_ns
from vilp_data.decode.message_body import cannot_decode, first_member, member, member_names
from vilp_data.errors import AlignError, DecodeError, nearest
from vilp_data.types import F64, I64, Clock, Message

COLUMNS: dict[str, tuple[int, ...]] = {
    "translation": (0, 1, 2), "rotation": (3, 4, 5, 6),
    "translation.x": (0,), "translation.y": (1,), "translation.z": (2,),
    "rotation.x": (3,), "rotation.y": (4,), "rotation.z": (5,), "rotation.w": (6,),
}  # fmt: skip
"""What a task's `fields` may name of a transform, and where it lies in the seven numbers."""

ALWAYS_NS = -(1 << 62)  # the stamp of what holds from the beginning of time
SHOWN_FRAMES = 30

Transform = tuple[float, float, float, float, float, float, float]
"""Translation x y z in the parent, and the unit quaternion x y z w that turns the child's axes into the parent's."""

IDENTITY: Transform = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Link(NamedTuple):
    """From `stamp_ns` on, `child` lies at `transform` in `parent`."""

    stamp_ns: int
    parent: str
    child: str
    transform: Transform
    static: bool


@dataclass(frozen=True)
class Resolved:
    """Where `to_frame` lies in `from_frame`: a row at each change, in order of time.

    stamps_ns  int64 [M]; ALWAYS_NS for what static links alone say
    values     float64 [M,7]: translation x y z, unit quaternion x y z w, of continuous sign; NaN where a link is too old, or no number
    """

    stamps_ns: I64
    values: F64


def links_of(message: Message, *, clock: Clock, offset_s: float = 0.0, static: bool = False) -> list[Link]:
    """The links in a message of tf (TFMessage, TransformStamped, foxglove.FrameTransform or FrameTransforms).

    With `clock` "header" each link has its own stamp; a static one needs none. DecodeError where the message holds no transforms, or
    no stamps."""
    offset_ns = round(offset_s * 1e9)
    arrival_ns = (message.publish_time_ns if clock == "publish" else message.log_time_ns) + offset_ns
    found = []
    for item in _items(message):
        parent = first_member(member(item, "header"), ("frame_id",)) or member(item, "parent_frame_id")
        child, transform = member(item, "child_frame_id"), member(item, "transform", item)
        if not isinstance(parent, str) or not isinstance(child, str):
            raise _no_transform(message)
        stamp_ns = arrival_ns
        if clock == "header" and not static:
            own = header_time_ns(Message(message.topic, message.schema, message.log_time_ns, 0, item))
            if own is None:
                remedy = 'set clock = "log" for this topic'
                raise cannot_decode(message, f"the transform of {child!r} carries no stamp of its own", None, remedy)
            stamp_ns = own + offset_ns
        found.append(Link(stamp_ns, plain(parent), plain(child), _transform(transform), static))
    return found


def resolve(
    links: Sequence[Link], from_frame: str, to_frame: str, *, where: str, stale_after_s: float = math.inf
) -> Resolved:
    """Where `to_frame` lies in `from_frame`, through the tree that `links` span, at every change of a link between the two.

    A row is NaN from the instant at which one of its links that are not static is older than `stale_after_s`. Raises DecodeError
    where nothing ever joins the two frames, naming the frames there are and the gap; AlignError where a frame's clock jumps back."""
    from_frame, to_frame = plain(from_frame), plain(to_frame)
    holding: dict[str, Link] = {}
    rows: list[_Row] = []
    for stamp_ns, changed in _by_stamp(_in_time(_above(links, (from_frame, to_frame)), where)):
        holding.update((link.child, link) for link in changed)
        chains = _chains(holding, from_frame, to_frame)
        if chains is not None and (not rows or rows[-1].broken or _touches(changed, chains)):
            rows.append(_row(stamp_ns, chains))
        elif chains is None and rows and not rows[-1].broken:
            rows.append(_Row(stamp_ns, None, _BROKEN, True))
    if not rows:
        raise _not_joined({link.child: link for link in links}, from_frame, to_frame, where)
    return _with_expiry(rows, stale_after_s)


def pick_columns(values: F64, fields: Sequence[str], *, where: str) -> F64:
    """The columns of [M,7] that `fields` name, all where they name none. DecodeError naming the nearest."""
    for name in fields:
        if name not in COLUMNS:
            raise DecodeError(f"a transform has no field {name!r}", where=where, remedy=nearest(name, COLUMNS))
    return values[:, [column for name in fields for column in COLUMNS[name]]] if fields else values


def plain(frame: str) -> str:
    return frame.lstrip("/")


# --- the tree -----------------------------------------------------------------------------------------------------------


class _Row(NamedTuple):
    stamp_ns: int
    oldest_ns: int | None  # of the links that are not static; None where all are
    transform: Transform
    broken: bool


_BROKEN: Transform = (math.nan,) * 7
_Chains = tuple[list[Link], list[Link]]


def _above(links: Sequence[Link], frames: Iterable[str]) -> list[Link]:
    """The links of those frames, and of every frame that ever was above them: no other can matter."""
    parents: dict[str, set[str]] = {}
    for link in links:
        parents.setdefault(link.child, set()).add(link.parent)
    above, left = set(frames), list(frames)
    while left:
        new = parents.get(left.pop(), set()) - above
        above |= new
        left += new
    return [link for link in links if link.child in above]


def _in_time(links: Sequence[Link], where: str) -> list[Link]:
    """In order of their stamps; a child's first static link from the beginning of time, and no static link that only says again what
    the one before it said."""
    static: dict[str, Link] = {}
    moving: dict[str, list[int]] = {}
    kept: list[Link] = []
    for link in links:
        if not link.static:
            moving.setdefault(link.child, []).append(link.stamp_ns)
            kept.append(link)
            continue
        before = static.get(link.child)
        if before is None or (before.parent, before.transform) != (link.parent, link.transform):
            kept.append(link if before else link._replace(stamp_ns=ALWAYS_NS))
        static[link.child] = link
    for child, times in moving.items():
        stamps = np.array(times, np.int64)
        align.order_of(stamps, topic=f"{where}, frame {child!r}")
        if len(stamps) > 2 and stamps.min() == stamps.max():
            found = f"{len(stamps)} transforms of {child!r}, all stamped {stamps[0]} ns"
            raise AlignError(
                "its stamps tell no time", where=where, found=found, remedy='set clock = "log" for this topic'
            )
    return sorted(kept, key=lambda link: link.stamp_ns)


def _by_stamp(links: Sequence[Link]) -> Iterator[tuple[int, list[Link]]]:
    """Links of equal stamps together: a tree published in one message changes at once."""
    group: list[Link] = []
    for link in links:
        if group and link.stamp_ns != group[0].stamp_ns:
            yield group[0].stamp_ns, group
            group = []
        group.append(link)
    if group:
        yield group[0].stamp_ns, group


def _chains(holding: Mapping[str, Link], from_frame: str, to_frame: str) -> _Chains | None:
    """The links from each frame up to their nearest common ancestor; None where there is none."""
    if not holding:
        return None
    up_from, up_to = _upwards(holding, from_frame), _upwards(holding, to_frame)
    if up_from is None or up_to is None:
        return None
    place = {frame: number for number, frame in enumerate([from_frame, *(link.parent for link in up_from)])}
    for number, frame in enumerate([to_frame, *(link.parent for link in up_to)]):
        if frame in place:
            return up_from[: place[frame]], up_to[:number]
    return None


def _upwards(holding: Mapping[str, Link], frame: str) -> list[Link] | None:
    """The links from a frame to its root; None where they run in a circle."""
    links: list[Link] = []
    while (link := holding.get(frame)) is not None:
        links.append(link)
        frame = link.parent
        if len(links) > len(holding):
            return None
    return links


def _touches(changed: Iterable[Link], chains: _Chains) -> bool:
    children = {link.child for chain in chains for link in chain}
    return any(link.child in children for link in changed)


def _row(stamp_ns: int, chains: _Chains) -> _Row:
    up_from, up_to = chains
    moving = [link.stamp_ns for chain in chains for link in chain if not link.static]
    transform = compose(inverse(_composed(up_from)), _composed(up_to))
    return _Row(stamp_ns, min(moving) if moving else None, transform, False)


def _composed(chain: Sequence[Link]) -> Transform:
    """Where the frame at the bottom of a chain lies in the one at its top."""
    total = IDENTITY
    for link in chain:
        total = compose(link.transform, total)
    return total


def _with_expiry(rows: Sequence[_Row], stale_after_s: float) -> Resolved:
    """Rows, NaN from where one of their links is too old, with quaternions of continuous sign."""
    stamps: list[int] = []
    values: list[Transform] = []
    for number, row in enumerate(rows):
        stamps.append(row.stamp_ns)
        values.append(row.transform)
        if row.oldest_ns is None or math.isinf(stale_after_s):
            continue
        expires_ns = row.oldest_ns + round(stale_after_s * 1e9) + align.TOLERANCE_NS + 1
        if expires_ns <= row.stamp_ns:
            values[-1] = _BROKEN
        elif number + 1 == len(rows) or expires_ns < rows[number + 1].stamp_ns:
            stamps.append(expires_ns)
            values.append(_BROKEN)
    return Resolved(np.array(stamps, np.int64), _continuous(np.array(values, np.float64)))


def _continuous(values: F64) -> F64:
    """The same rotations with the sign of each quaternion chosen to be near the one before it; of the first, w >= 0."""
    before = np.array([0.0, 0.0, 0.0, 1.0])
    for quaternion in values[:, 3:]:
        if not np.isfinite(quaternion).all():
            continue
        if quaternion @ before < 0:
            quaternion *= -1
        before = quaternion
    return values


# --- rotations ----------------------------------------------------------------------------------------------------------


def compose(outer: Transform, inner: Transform) -> Transform:
    """`inner` is of a child in a parent, `outer` of that parent in its own: the child in the latter."""
    x, y, z = _turned(outer, inner[0], inner[1], inner[2])
    ax, ay, az, aw = outer[3:]
    bx, by, bz, bw = inner[3:]
    return (
        x + outer[0], y + outer[1], z + outer[2],
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )  # fmt: skip


def inverse(transform: Transform) -> Transform:
    """The parent in the child."""
    qx, qy, qz, qw = transform[3:]
    turned_back: Transform = (0.0, 0.0, 0.0, -qx, -qy, -qz, qw)
    x, y, z = _turned(turned_back, transform[0], transform[1], transform[2])
    return (-x, -y, -z, -qx, -qy, -qz, qw)


def _turned(transform: Transform, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector, turned by a unit quaternion: v + 2 q × (q × v + w v)."""
    qx, qy, qz, qw = transform[3:]
    cx, cy, cz = qy * z - qz * y + qw * x, qz * x - qx * z + qw * y, qx * y - qy * x + qw * z
    return x + 2 * (qy * cz - qz * cy), y + 2 * (qz * cx - qx * cz), z + 2 * (qx * cy - qy * cx)


# --- reading messages -----------------------------------------------------------------------------------------------------


def _items(message: Message) -> Sequence[Any]:
    """The transforms in a message of many, or the message itself."""
    items = member(message.body, "transforms", None)
    return [message.body] if items is None else items


def _transform(value: Any) -> Transform:
    """Translation and unit quaternion; NaN for a rotation that is none, as drivers send before they know better."""
    shift, turn = member(value, "translation"), member(value, "rotation")
    numbers = [float(member(shift, axis, math.nan)) for axis in "xyz"]
    quaternion = [float(member(turn, axis, math.nan)) for axis in "xyzw"]
    norm = math.sqrt(sum(number * number for number in quaternion))
    unit = [number / norm for number in quaternion] if norm > 1e-9 else [math.nan] * 4
    x, y, z, qx, qy, qz, qw = (*numbers, *unit)
    return x, y, z, qx, qy, qz, qw


def _no_transform(message: Message) -> DecodeError:
    found = f"{message.schema}, with {', '.join(member_names(message.body)) or 'no members'}"
    remedy = "from_frame and to_frame are for topics of tf: TFMessage, TransformStamped, foxglove.FrameTransform(s)"
    return cannot_decode(message, "the message holds no transforms between frames", found, remedy)


def _not_joined(holding: Mapping[str, Link], from_frame: str, to_frame: str, where: str) -> DecodeError:
    frames = sorted({frame for link in holding.values() for frame in (link.parent, link.child)})
    shown = ", ".join(frames[:SHOWN_FRAMES]) + (
        f" and {len(frames) - SHOWN_FRAMES} more" if len(frames) > SHOWN_FRAMES else ""
    )
    for frame in (from_frame, to_frame):
        if frame not in frames:
            found = f"frames: {shown or 'none'}"
            return DecodeError(f"no frame called {frame!r}", where=where, found=found, remedy=nearest(frame, frames))
    ends = []
    for frame in (from_frame, to_frame):
        chain = _upwards(holding, frame)
        if chain is None:
            return DecodeError(
                "the frames run in a circle", where=where, found=shown, remedy="correct who publishes them"
            )
        ends.append([frame, *(link.parent for link in chain)])
    found = f"{' -> '.join(ends[0])} and {' -> '.join(ends[1])}; frames: {shown}"
    return DecodeError(
        f"nothing joins frames {from_frame!r} and {to_frame!r}: no transform between {ends[0][-1]!r} and {ends[1][-1]!r}",
        where=where, found=found, remedy="choose two frames of one tree, or record the topic that holds the missing transform",
    )  # fmt: skip
