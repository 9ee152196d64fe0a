"""The vectors of a demonstration, gathered from its messages as they come: each part of low_dim, action and state on its own clock."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from vilp_data import align, decode, rotations
from vilp_data.align import NEVER_NS, Latest
from vilp_data.decode.column_names import ColumnNames
from vilp_data.decode.vectors import concerns, published_names, rotation_columns
from vilp_data.errors import DecodeError, LogError, nearest
from vilp_data.short_names import short_names
from vilp_data.spec import ActionSpec, TaskSpec, TopicSpec, VectorSpec
from vilp_data.transform_tree import TransformTrack, TransformTree
from vilp_data.transforms import STATIC, Link, links_of, pick_columns, picked_names
from vilp_data.types import F64, I64, LogEpisode, Message

ROWS_PACKED = 4096

VectorTable: TypeAlias = VectorSpec | ActionSpec


class Track(Protocol):
    """One part's vectors in order of its topic's clock. `stamps_ns`: when something came, int64 [M] ascending; `held_s`: how long
    before the demonstration the first message came that is not of it, 0 where there is none such; `column_names`: of its
    numbers, as `ColumnNames.names`; `names_differ`: whether its messages gave two."""

    @property
    def held_s(self) -> float: ...
    @property
    def stamps_ns(self) -> I64: ...
    @property
    def column_names(self) -> tuple[str, ...]: ...
    @property
    def names_differ(self) -> bool: ...

    def known_ns(self) -> I64:
        """Those of `stamps_ns` that are of the demonstration itself, and at which every number is known."""
        ...

    def at(self, instants_ns: I64) -> Latest:
        """The latest vector at each instant, int64 [F] ascending."""
        ...


Tracks: TypeAlias = Mapping[str, Track]


def vector_tables(spec: TaskSpec) -> dict[str, VectorTable]:
    """Part ("low_dim.<name>", "action.<name>", "state") -> its table, of the parts that are read from messages."""
    tables: dict[str, VectorTable] = {f"low_dim.{name}": table for name, table in spec.low_dim.items()}
    tables |= {f"action.{name}": table for name, table in spec.action.items()}
    tables |= {"state": spec.state} if spec.state else {}
    return {part: table for part, table in tables.items() if table.topic is not None}


def reads_transforms(table: VectorTable) -> bool:
    """Whether a part is where one frame of reference lies in another, and its topic one of transforms."""
    return table.from_frame is not None


def age_names(spec: TaskSpec) -> dict[str, str]:
    """Part -> what the ages of its values are stored under: its topic, of transforms with the two frames. Where a topic's parts may be
    of different age (joints of several publishers, a state and a command), the part's own name comes after it."""
    tables = {part: table for part, table in vector_tables(spec).items() if part != "state"}
    names = {
        part: f"{table.topic} {table.from_frame}->{table.to_frame}" if reads_transforms(table) else str(table.topic)
        for part, table in tables.items()
    }
    ages: dict[str, set[tuple[object, ...]]] = {}
    for part, table in tables.items():
        ages.setdefault(names[part], set()).add((_how_held(table), table.names))
    return {part: name if len(ages[name]) == 1 else f"{name} {part}" for part, name in names.items()}


def _how_held(table: VectorTable) -> str:
    """What a value's age is counted from: of observations the tick, of absolute commands the interval; of deltas nothing."""
    if isinstance(table, VectorSpec):
        return "observed"
    return "held" if table.kind == "absolute" else "never held"


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


class VectorTracks:
    """Give it every message of the `static_topics` that the log has (`add_static`), and every one of `topics`, those that came before
    the demonstration first (`add`); once more, where `read_again` says so; then ask for the `tracks`."""

    def __init__(
        self,
        spec: TaskSpec,
        topics: Collection[str],
        demonstration: LogEpisode,
        topic_names: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """`topic_names`: topic -> what its log calls the numbers of its arrays."""
        tables = {part: table for part, table in vector_tables(spec).items() if table.topic in topics}
        self._trees = {
            topic: _TransformsReader(topic, [table for table in tables.values() if table.topic == topic], demonstration)
            for topic in {str(table.topic) for table in tables.values() if reads_transforms(table)}
        }
        self._parts: dict[str, _FieldsReader | _PartOfTree] = {}
        self._readers: dict[str, list[_FieldsReader | _TransformsReader]] = {
            topic: [tree] for topic, tree in self._trees.items()
        }
        for part, table in tables.items():
            topic = str(table.topic)
            if topic in self._trees:
                self._parts[part] = _PartOfTree(self._trees[topic], table)
            else:
                reader = self._parts[part] = _FieldsReader(table, demonstration, (topic_names or {}).get(topic, ()))
                self._readers.setdefault(topic, []).append(reader)

    @property
    def static_topics(self) -> set[str]:
        """Topics of transforms that hold at all times, published perhaps once, long before the demonstration."""
        return {topic + STATIC for topic in self._trees}

    def add_static(self, message: Message) -> None:
        self._trees[message.topic.removesuffix(STATIC)].add_static(message)

    def add(self, message: Message) -> None:
        for reader in self._readers.get(message.topic, ()):
            reader.add(message)

    def read_again(self) -> set[str]:
        """Topics whose messages have to be added once more, for some that matter were passed over; those kept of them are dropped."""
        return {topic for topic, tree in self._trees.items() if tree.missed_some()}

    def tracks(self, where: str) -> dict[str, Track]:
        """Part -> its track. Raises LogError where nothing came for a part, and what `TransformTree.between` and `align.in_time` raise."""
        return {part: reader.track(where) for part, reader in self._parts.items()}


# --- fields of messages -------------------------------------------------------------------------------------------------


class _FieldsReader:
    """The rows of a part that is read from the fields of messages."""

    def __init__(self, table: VectorTable, demonstration: LogEpisode, topic_names: Sequence[str]) -> None:
        self._table, self._topic, self._start_ns = table, str(table.topic), demonstration.start_ns
        self._names = None if table.names else ColumnNames(table.fields, topic_names)  # the task's own, else the log's
        self._read = decode.compile_fields(table.fields, table.names)
        self._stamps, self._rows = array("q"), _Rows(self._topic)
        self._before = array("q")  # log times of the rows that came before the demonstration: the first ones
        self._others: set[str] = set()
        self._rotations: tuple[int, ...] = ()

    def add(self, message: Message) -> None:
        if self._table.names and not concerns(message, self._table.names):
            self._others |= set(published_names(message))
            return
        if not self._stamps and not self._table.names:
            self._rotations = rotation_columns(message, self._table.fields)
        if message.log_time_ns < self._start_ns:
            self._before.append(message.log_time_ns)
        self._stamps.append(stamp_ns(message, self._table))
        row = self._read(message)
        self._rows.append(row)
        if self._names is not None:
            self._names.add(message, len(row))

    def track(self, where: str) -> FieldsTrack:
        if not self._stamps:
            raise self._nothing(where)
        n_before = len(self._before)
        stamps_ns, values = np.array(self._stamps, np.int64), self._rows.stacked()
        first = _first_that_holds(stamps_ns[:n_before], stamps_ns[n_before:])
        _, order = align.in_time(stamps_ns[first:], topic=self._topic)
        values = values[first:][order]
        for column in self._rotations:
            values[:, column : column + 4] = rotations.continuous(values[:, column : column + 4])
        held_s = (self._start_ns - self._before[-1]) / 1e9 if first < n_before else 0.0
        own_ns = int(stamps_ns[n_before:].min()) if n_before < len(stamps_ns) else None
        names, differ = (self._names.names, self._names.differ) if self._names is not None else ((), False)
        return FieldsTrack(stamps_ns[first:][order], values, own_ns, held_s, names, differ)

    def _nothing(self, where: str) -> LogError:
        if self._others:
            remedy = nearest(self._table.names[0], self._others)
            return LogError(f"no message on topic {self._topic!r} is of the joints named", where=where, remedy=remedy)
        return no_message(self._topic, where)


def no_message(topic: str, where: str) -> LogError:
    """The error for a demonstration in which a topic of the task is silent."""
    remedy = "leave this demonstration out, or take the topic out of the task TOML"
    return LogError(f"no message on topic {topic!r}", where=where, remedy=remedy)


def _first_that_holds(before_ns: I64, own_ns: I64) -> int:
    """The first of the stamps from before a demonstration that is of its clock: a recording often begins where a clock was reset."""
    if not len(before_ns):
        return 0
    resets = np.flatnonzero(np.diff(before_ns) < -align.BACKWARD_JUMP_NS)
    first = int(resets[-1]) + 1 if len(resets) else 0
    if len(own_ns) and before_ns[-1] > own_ns[0] + align.BACKWARD_JUMP_NS:
        return len(before_ns)
    return first


@dataclass(frozen=True)
class FieldsTrack:
    """Stamps int64 [M] ascending, values float64 [M,D]; `own_ns`: the earliest stamp of the demonstration's own messages, None where
    all came before it."""

    stamps_ns: I64
    values: F64
    own_ns: int | None = None
    held_s: float = 0.0
    column_names: tuple[str, ...] = ()
    names_differ: bool = False

    def known_ns(self) -> I64:
        if self.own_ns is None:
            return self.stamps_ns[:0]
        return self.stamps_ns[(self.stamps_ns >= self.own_ns) & np.isfinite(self.values).all(axis=1)]

    def at(self, instants_ns: I64) -> Latest:
        index = np.searchsorted(self.stamps_ns, instants_ns, side="right") - 1
        values = self.values[np.maximum(index, 0)]
        values[index < 0] = np.nan
        return Latest(values, np.where(index < 0, NEVER_NS, self.stamps_ns[np.maximum(index, 0)]))


# --- transforms ---------------------------------------------------------------------------------------------------------


class _TransformsReader:
    """The tree that a topic of transforms says, for all parts that are read from it."""

    def __init__(self, topic: str, tables: list[VectorTable], demonstration: LogEpisode) -> None:
        self.topic, self._clock, self._start_ns = topic, tables[0], demonstration.start_ns
        self._tree = TransformTree([str(frame) for table in tables for frame in (table.from_frame, table.to_frame)])
        self._held: list[Link] = []  # from before the demonstration
        self.own_ns: int | None = None

    def add(self, message: Message) -> None:
        links = links_of(message, clock=self._clock.clock, offset_s=self._clock.offset_s)
        if message.log_time_ns < self._start_ns:
            self._held += links
        elif links:
            first_ns = min(link.stamp_ns for link in links)
            self._take_held(
                until_ns=first_ns + align.BACKWARD_JUMP_NS
            )  # later ones are of a clock that was reset since
            self.own_ns = first_ns if self.own_ns is None else min(self.own_ns, first_ns)
            self._tree.add(links)

    def add_static(self, message: Message) -> None:
        self._tree.add(links_of(message, clock="log", static=True))

    def tree(self) -> TransformTree:
        self._take_held()
        return self._tree

    def missed_some(self) -> bool:
        if missed := bool(self._tree.missed):
            self._tree = self._tree.again()
        return missed

    def _take_held(self, until_ns: int | None = None) -> None:
        self._tree.add(link for link in self._held if until_ns is None or link.stamp_ns <= until_ns)
        self._held = []


@dataclass(frozen=True)
class _PartOfTree:
    """A part that is where one frame lies in another."""

    reader: _TransformsReader
    table: VectorTable

    def track(self, where: str) -> ColumnsTrack:
        topic = self.reader.topic
        whole = self.reader.tree().between(str(self.table.from_frame), str(self.table.to_frame), where=topic)
        pick_columns(
            np.zeros((0, 7)), self.table.fields, where=topic
        )  # a wrong name is said before anything is computed
        return ColumnsTrack(whole, self.table.fields, topic, self.reader.own_ns)


@dataclass(frozen=True)
class ColumnsTrack:
    """Some of the seven numbers of a transform over time; `own_ns` as in `FieldsTrack`."""

    whole: TransformTrack
    fields: tuple[str, ...]
    topic: str
    own_ns: int | None
    held_s: float = 0.0
    names_differ: bool = False

    @property
    def column_names(self) -> tuple[str, ...]:
        return short_names([name.split(".") for name in picked_names(self.fields)])

    @property
    def stamps_ns(self) -> I64:
        return self.whole.stamps_ns

    def known_ns(self) -> I64:
        known_ns = self.whole.known_ns()
        return known_ns[:0] if self.own_ns is None else known_ns[known_ns >= self.own_ns]

    def at(self, instants_ns: I64) -> Latest:
        latest = self.whole.at(instants_ns)
        return Latest(pick_columns(latest.values, self.fields, where=self.topic), latest.stamps_ns)


# --- packed -------------------------------------------------------------------------------------------------------------


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
