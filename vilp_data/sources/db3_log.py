"""SQLite files of ROS 2 bags (.db3), of any schema version, opened read-only. One file is one episode, or a part of one.

SQLite keeps no checksums: damage shows where its structure breaks, or where a message no longer fits its type. Messages are counted by
the table alone; they are read through the table's index of times, as SQLite chooses, so before that the index and every page are
compared with the table: an index that lacks rows would otherwise be a shorter bag."""

from __future__ import annotations

import sqlite3
from array import array
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.records import Schema

from vilp_data import limits
from vilp_data.errors import LogError, copy_or_salvage, reason, salvage_command
from vilp_data.sources.channels import WHOLE_FILE, Channel, Channels, RawMessage, SerialisedLog
from vilp_data.sources.folder_hash import file_sha256
from vilp_data.sources.message_decoders import BEFORE_DEFINITIONS
from vilp_data.sources.rosbag2_metadata import missing_from_file
from vilp_data.sources.sqlite_pages import HEAD_SIZE, file_head
from vilp_data.types import I64, LogEpisode, Message, TopicInfo

MAGIC = b"SQLite format 3\0"
END_OF_TIME_NS = (1 << 63) - 1  # SQLite's largest integer
LISTED_TIMES = 1_000_000  # rows read by message_times: about a second
INSTRUCTIONS = 1_000_000  # of SQLite's machine, between two looks at how much a query has done

TABLES = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"id", "topic_id", "timestamp", "data"}}
OPTIONAL = {
    "message_definitions": {"topic_type", "encoding", "encoded_message_definition"},
    "schema": {"ros_distro"},
}


class Db3Log(SerialisedLog):
    """A `LogReader` over one file. LogError where it is no database, no bag, cut off, or was not closed by its recorder.

    Publish times are not recorded: they are the log times. Types that the file does not define are those of its ROS 2 release.
    `named` is the path that errors name, where the file is an inflated copy of another."""

    format = "rosbag2"

    def __init__(self, path: Path, *, named: Path | None = None) -> None:
        self.path = named or path
        self._file = path
        self._refuse_unfinished()
        self._database = sqlite3.connect(
            f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(limits.RECORD_BYTES, (1 << 31) - 1))
            self._guard()
            channels, distro = self._describe()
            self._channels = Channels(self.path, channels, distro=distro or BEFORE_DEFINITIONS)
            self._topic_ids = channels.keys()
        except BaseException:
            self._database.close()
            raise
        self._known: list[tuple[int, int, int, int]] | None = None
        self._is_sound = False

    def sha256(self) -> str:
        return file_sha256(self._file)

    def topics(self) -> list[TopicInfo]:
        """Every topic, sorted by name. Counting reads the file's table of messages once, not the messages."""
        return self._channels.topics({topic_id: count for topic_id, count, _, _ in self._counted()})

    def metadata(self) -> dict[str, dict[str, str]]:
        return {}

    def episodes(self) -> list[LogEpisode]:
        """The whole file as one; none where it holds no message."""
        counted = self._counted()
        if not counted:
            return []
        first_ns, last_ns = min(first for *_, first, _ in counted), max(last for *_, last in counted)
        return [LogEpisode(WHOLE_FILE, first_ns, last_ns + 1)]

    def doubts(self) -> list[str]:
        """Where the file is a part of a bag whose metadata.yaml counts other than as many messages in it."""
        return missing_from_file(self.path, sum(count for _, count, _, _ in self._counted()))

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; ties as they were written. An unreadable topic is refused before
        the first of any; a file whose structure is damaged anywhere with the first one."""
        ids = sorted(self._channels.ids_of(topics))
        self._channels.require_decoders(ids)
        first = -END_OF_TIME_NS if start_ns is None else max(min(start_ns, END_OF_TIME_NS), -END_OF_TIME_NS)
        end = END_OF_TIME_NS if end_ns is None else max(min(end_ns, END_OF_TIME_NS), -END_OF_TIME_NS)
        return self._raw_of_sound(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(ids))})"
            " AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, id",
            (*ids, first, end),
        )

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order; and whether they are all (else the first part)."""
        names = self._channels.names()
        times: dict[str, array[int]] = {}
        query = f"SELECT topic_id, timestamp FROM messages ORDER BY id LIMIT {LISTED_TIMES + 1}"
        listed = 0
        for topic_id, time_ns in self._rows(query):
            listed += 1
            if topic_id in names and listed <= LISTED_TIMES:
                times.setdefault(names[topic_id], array("q")).append(self._whole(time_ns))
        return {topic: np.array(values, np.int64) for topic, values in times.items()}, listed <= LISTED_TIMES

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """The first `limit` messages of a topic."""
        ids = sorted(self._channels.ids_of([topic]))
        self._channels.require_decoders(ids)
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(ids))}) ORDER BY id LIMIT ?"
        return [self.decoded(raw) for raw in self._raw(query, (*ids, limit))]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._database.close()

    # --- opening --------------------------------------------------------------------------------------------------------

    def _refuse_unfinished(self) -> None:
        """LogError where the file is shorter than its header says, or its last messages are in a file beside it."""
        size = self._file.stat().st_size
        with self._file.open("rb") as stream:
            start = stream.read(HEAD_SIZE)
        if len(start) < HEAD_SIZE:
            raise LogError(
                "the bag is cut off", where=self.path, found=f"{size} bytes", remedy=copy_or_salvage(self.path)
            )
        head = file_head(start)
        expected = head.page_size * head.pages if head else 0
        if size < expected:
            raise LogError(
                "the bag is cut off",
                where=self.path,
                found=f"{size:,} of {expected:,} bytes",
                remedy=copy_or_salvage(self.path),
            )
        for journal in (self._file.with_name(self._file.name + suffix) for suffix in ("-wal", "-journal")):
            if journal.is_file() and journal.stat().st_size:
                raise LogError(
                    "the recorder did not close this bag: its last messages are in a journal",
                    where=self.path,
                    found=f"{journal.name}, {journal.stat().st_size:,} bytes",
                    remedy=f"keep both files together: {salvage_command(self.path)} makes one MCAP of them",
                )

    def _guard(self) -> None:
        """Nothing in the file may run as a program or go on for ever: plain tables only, and a query of a damaged tree ends."""
        self._database.execute("PRAGMA trusted_schema = OFF")
        self._budget = 0

        def spent() -> int:
            self._budget -= INSTRUCTIONS
            return int(self._budget < 0)

        self._database.set_progress_handler(spent, INSTRUCTIONS)

    def _describe(self) -> tuple[dict[int, Channel], str]:
        """Channels by topic id, and the ROS 2 release ("" where nothing tells)."""
        have = self._tables()
        for table, columns in TABLES.items():
            if not columns <= have.get(table, set()):
                found = f"tables {', '.join(sorted(have)) or '(none)'}"
                remedy = "a bag of ROS 2 has the tables topics and messages; name a file that rosbag2 wrote"
                raise LogError("an SQLite database, but no bag of ROS 2", where=self.path, found=found, remedy=remedy)
        definitions: dict[str, tuple[str, str]] = {}
        if OPTIONAL["message_definitions"] <= have.get("message_definitions", set()):
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (encoding, text) for name, encoding, text in self._texts(query)}
        distro = ""
        if OPTIONAL["schema"] <= have.get("schema", set()):
            distro = next((row[0] for row in self._texts("SELECT ros_distro FROM schema")), "")
        channels: dict[int, Channel] = {}
        for number, *words in self._rows("SELECT id, name, type, serialization_format FROM topics ORDER BY id"):
            topic, name, serialization = (self._text(word) for word in words)
            encoding, text = definitions.get(name, ("", ""))
            schema = Schema(id=number, data=text.encode(), encoding=encoding, name=name)
            channels[number] = Channel(topic, serialization, schema)
        return channels, distro

    def _tables(self) -> dict[str, set[str]]:
        """Name -> columns of the file's plain tables: views and virtual tables, which run code, are none."""
        query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE '%VIRTUAL%'"
        names = [name for (name,) in self._texts(query)]
        found = {}
        for name in {*TABLES, *OPTIONAL}.intersection(names):
            found[name] = {self._text(row[1]) for row in self._rows(f"PRAGMA table_info({name})")}
        return found

    def _counted(self) -> list[tuple[int, int, int, int]]:
        """(topic id, messages, log times of the first and the last) by the table itself."""
        if self._known is None:
            query = (
                "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages NOT INDEXED GROUP BY topic_id"
            )
            known = list(self._rows(query))
            if strange := {topic_id for topic_id, *_ in known} - self._topic_ids:
                raise self._damaged(
                    f"messages of topics {sorted(map(str, strange))[:3]}, which the file does not describe"
                )
            self._known = [(row[0], row[1], self._whole(row[2]), self._whole(row[3])) for row in known]
        return self._known

    def _refuse_unsound(self) -> None:
        """LogError where SQLite finds fault with any page, or with what an index says of its table. Reads the file once."""
        if not self._is_sound:
            faults = [" ".join(texts[0].split()) for texts in self._texts("PRAGMA integrity_check(3)")]
            if faults != ["ok"]:
                raise self._damaged("; ".join(faults))
            self._counted()
            self._is_sound = True

    # --- rows -----------------------------------------------------------------------------------------------------------

    def _rows(self, query: str, values: tuple[int, ...] = ()) -> Iterator[Any]:
        with self._damage_as_log_error():
            self._budget = 10 * (self._file.stat().st_size + INSTRUCTIONS)
            cursor = self._database.execute(query, values)
            while (
                row := cursor.fetchone()
            ) is not None:  # `yield from` would close the cursor, after the database perhaps
                yield row

    def _texts(self, query: str) -> Iterator[list[str]]:
        return ([self._text(value) for value in row] for row in self._rows(query))

    def _raw(self, query: str, values: tuple[int, ...]) -> Iterator[RawMessage]:
        for topic_id, time_ns, data in self._rows(query, values):
            if not isinstance(data, bytes):
                raise self._damaged(f"a message at {time_ns} ns that is no bytes")
            time = self._whole(time_ns)
            yield RawMessage(time, time, topic_id, data)

    def _raw_of_sound(self, query: str, values: tuple[int, ...]) -> Iterator[RawMessage]:
        self._refuse_unsound()
        yield from self._raw(query, values)

    @contextmanager
    def _damage_as_log_error(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError) as error:
            if "interrupted" in str(error):
                raise self._damaged("its tables lead in circles") from error
            raise self._damaged(reason(error)) from error

    def _whole(self, value: object) -> int:
        if not isinstance(value, int):
            raise self._damaged(f"a time that is no whole number ({value!r:.40})")
        return value

    def _text(self, value: object) -> str:
        if not isinstance(value, str):
            raise self._damaged(f"{value!r:.40} where text was expected")
        return value

    def _damaged(self, found: str) -> LogError:
        return LogError("the bag is damaged", where=self.path, found=found, remedy=copy_or_salvage(self.path))
