"""The vectors of a demonstration, gathered from its messages as they come: each part of low_dim, action and state on its own clock."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from vilp_data import align, decode
from vilp_data.decode.vectors import concerns, published_names
from vilp_data.errors import AlignError, DecodeError, LogError, nearest
from vilp_data.spec import ActionSpec, TaskSpec, TopicSpec, VectorSpec
from vilp_data.transforms import Link, links_of, pick_columns, resolve
from vilp_data.types import F64, I64, Message

ROWS_PACKED = 4096

VectorTable: TypeAlias = VectorSpec | ActionSpec


@dataclass(frozen=True)
class Track:
    """One part's vectors in order of its topic's clock: stamps int64 [M], values float64 [M,D]."""

    stamps_ns: I64
    values: F64


Tracks: TypeAlias = Mapping[str, Track]


def vector_tables(spec: TaskSpec) -> dict[str, VectorTable]:
    """Part ("low_dim.<name>", "action.<name>", "state") -> its table, of the parts that are read from messages."""
    tables: dict[str, VectorTable] = {f"low_dim.{name}": table for name, table in spec.low_dim.items()}
    tables |= {f"action.{name}": table for name, table in spec.action.items()}
    tables |= {"state": spec.state} if spec.state else {}
    return {part: table for part, table in tables.items() if table.topic is not None}


class VectorTracks:
    """Give it every message of `topics` (`add`), and before those every message of `static_topics` that the log has (`add_static`);
    then ask for the `tracks`."""

    def __init__(self, spec: TaskSpec, topics: Collection[str]) -> None:
        tables = {part: table for part, table in vector_tables(spec).items() if table.topic in topics}
        self._gatherers: dict[str, _Fields | _Frames] = {}
        for part, table in tables.items():
            self._gatherers[part] = _Fields(table) if table.from_frame is None else _Frames(table)
        self._by_topic: dict[str, list[_Fields | _Frames]] = {}
        for gatherer in self._gatherers.values():
            self._by_topic.setdefault(gatherer.topic, []).append(gatherer)
        self._links: dict[str, list[Link]] = {
            gatherer.topic: [] for gatherer in self._gatherers.values() if isinstance(gatherer, _Frames)
        }

    @property
    def static_topics(self) -> set[str]:
        """Topics of transforms that hold at all times, published perhaps once, long before the demonstration."""
        return {topic + STATIC for topic in self._links}

    def add_static(self, message: Message) -> None:
        self._links[message.topic.removesuffix(STATIC)] += links_of(message, clock="log", static=True)

    def add(self, message: Message, stamp_ns: int | None) -> None:
        """`stamp_ns`: by the topic's clock; None for a topic of transforms, which have stamps of their own."""
        gatherers = self._by_topic.get(message.topic, ())
        if stamp_ns is None and gatherers:
            table = gatherers[0].table
            self._links[message.topic] += links_of(message, clock=table.clock, offset_s=table.offset_s)
            return
        for gatherer in gatherers:
            if isinstance(gatherer, _Fields) and stamp_ns is not None:
                gatherer.add(message, stamp_ns)

    def tracks(self, where: str) -> dict[str, Track]:
        """Part -> its track. Raises LogError where nothing came for a part, and what `resolve` and `align.order_of` raise."""
        return {
            part: gatherer.track(where)
            if isinstance(gatherer, _Fields)
            else gatherer.track(self._links[gatherer.topic])
            for part, gatherer in self._gatherers.items()
        }


STATIC = "_static"
"""What the topic of static transforms is called after the topic of those that move."""


def moves_frames(spec: TaskSpec) -> set[str]:
    """The topics that are read as transforms between frames."""
    return {str(table.topic) for table in vector_tables(spec).values() if table.from_frame is not None}


def age_name(table: VectorTable) -> str:
    """What the ages of a part's values are stored under: its topic, and of two frames which."""
    return str(table.topic) if table.from_frame is None else f"{table.topic} {table.from_frame}->{table.to_frame}"


def stamp_ns(message: Message, table: TopicSpec | ActionSpec) -> int:
    """The message's time by the clock that the table names, offset included."""
    if table.clock == "header":
        stamp = decode.header_time_ns(message)
        if stamp is None:
            raise DecodeError(
                "its messages carry no stamp of their own",
                where=message.topic,
                found=message.schema,
                remedy='set clock = "log" for this topic',
            )
    else:
        stamp = message.log_time_ns if table.clock == "log" else message.publish_time_ns
    return stamp + round(table.offset_s * 1e9)


def in_time(topic: str, stamps: Sequence[int]) -> tuple[I64, align.Index]:
    """Stamps int64 [M] as they came, and the order that sorts them. AlignError where they tell no time, or were reset."""
    stamps_ns = np.array(stamps, np.int64)
    if len(stamps) > 1 and stamps_ns.min() == stamps_ns.max():
        found = f"{len(stamps)} messages, all stamped {stamps[0]} ns"
        raise AlignError("its stamps tell no time", where=topic, found=found, remedy='set clock = "log" for this topic')
    return stamps_ns, align.order_of(stamps_ns, topic=topic)


class _Fields:
    """The rows of a part that is read from the fields of messages."""

    def __init__(self, table: VectorTable) -> None:
        self.table, self.topic = table, str(table.topic)
        self._read = decode.compile_fields(table.fields, table.names)
        self._stamps, self._rows = array("q"), _Rows(self.topic)
        self._others: set[str] = set()

    def add(self, message: Message, stamp_ns: int) -> None:
        if self.table.names and not concerns(message, self.table.names):
            self._others |= set(published_names(message))
            return
        self._stamps.append(stamp_ns)
        self._rows.append(self._read(message))

    def track(self, where: str) -> Track:
        if not self._stamps:
            raise self._nothing(where)
        stamps_ns, order = in_time(self.topic, self._stamps)
        return Track(stamps_ns[order], self._rows.stacked()[order])

    def _nothing(self, where: str) -> LogError:
        if self._others:
            remedy = nearest(self.table.names[0], self._others)
            return LogError(f"no message on topic {self.topic!r} is of the joints named", where=where, remedy=remedy)
        remedy = "leave this log out, or take the topic out of the task TOML"
        return LogError(f"no message on topic {self.topic!r}", where=where, remedy=remedy)


class _Frames:
    """A part that is the transform between two frames."""

    def __init__(self, table: VectorTable) -> None:
        self.table, self.topic = table, str(table.topic)

    def track(self, links: Sequence[Link]) -> Track:
        stale_after_s = self.table.stale_after_s if isinstance(self.table, VectorSpec) else float("inf")
        resolved = resolve(
            links, str(self.table.from_frame), str(self.table.to_frame), where=self.topic, stale_after_s=stale_after_s
        )
        return Track(resolved.stamps_ns, pick_columns(resolved.values, self.table.fields, where=self.topic))


class _Rows:
    """Vectors of one topic as they come: a long log's are packed as they grow, for a small array is mostly its own head."""

    def __init__(self, topic: str) -> None:
        self._topic, self._length = topic, -1
        self._packed: list[F64] = []
        self._loose: list[F64] = []

    def append(self, row: F64) -> None:
        self._length = len(row) if self._length < 0 else self._length
        if len(row) != self._length:
            raise DecodeError(
                "vectors of different lengths",
                where=self._topic,
                found=f"lengths {sorted({self._length, len(row)})}",
                remedy="say which fields to read, or which joints by `names`",
            )
        self._loose.append(row)
        if len(self._loose) >= ROWS_PACKED:
            self._packed.append(np.asarray(self._loose, np.float64))
            self._loose.clear()

    def stacked(self) -> F64:
        """float64 [M,D]."""
        loose = np.asarray(self._loose, np.float64).reshape(len(self._loose), max(self._length, 0))
        return np.concatenate([*self._packed, loose])
