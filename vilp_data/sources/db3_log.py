"""SQLite files of ROS 2 bags (.db3), of any schema version, opened read-only. One file is one episode, or a part of one.

SQLite keeps no checksums: damage shows where its structure breaks, or where a message no longer fits its type."""

from __future__ import annotations

import sqlite3
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.records import Schema

from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.sources.channels import WHOLE_FILE, Channel, Channels, RawMessage
from vilp_data.sources.folder_hash import file_sha256
from vilp_data.sources.message_decoders import BEFORE_DEFINITIONS
from vilp_data.types import I64, LogEpisode, Message, TopicInfo

MAGIC = b"SQLite format 3\0"
SALVAGE = "copy it again from where it was recorded; `vilp-data salvage` gets back what is there"
END_OF_TIME_NS = (1 << 63) - 1  # SQLite's largest integer
LISTED_TIMES = 1_000_000  # rows read by message_times: about a second
INSTRUCTIONS = 1_000_000  # of SQLite's machine, between two looks at how much a query has done

TABLES = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"id", "topic_id", "timestamp", "data"}}
OPTIONAL = {
    "message_definitions": {"topic_type", "encoding", "encoded_message_definition"},
    "schema": {"ros_distro"},
}


class Db3Log:
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
        self._counts: Counter[int] | None = None

    def sha256(self) -> str:
        return file_sha256(self._file)

    def topics(self) -> list[TopicInfo]:
        """Every topic, sorted by name. Counting reads the file's table of messages once, not the messages."""
        if self._counts is None:
            self._counts = Counter(dict(self._rows("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id")))
            if strange := self._counts.keys() - self._topic_ids:
                raise self._damaged(
                    f"messages of topics {sorted(map(str, strange))[:3]}, which the file does not describe"
                )
        return self._channels.topics(self._counts)

    def metadata(self) -> dict[str, dict[str, str]]:
        return {}

    def episodes(self) -> list[LogEpisode]:
        """The whole file as one; none where it holds no message."""
        ((first_ns, last_ns),) = self._rows(
            "SELECT (SELECT MIN(timestamp) FROM messages), (SELECT MAX(timestamp) FROM messages)"
        )
        if first_ns is None:
            return []
        return [LogEpisode(WHOLE_FILE, self._whole(first_ns), self._whole(last_ns) + 1)]

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """As `LogReader.messages`. After a MessageError the iterator can be asked for the next message."""
        return map(self.decoded, self.raw_messages(topics, start_ns=start_ns, end_ns=end_ns))

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; ties as they were written. An unreadable topic is refused before
        the first of any."""
        ids = sorted(self._channels.ids_of(topics))
        self._channels.require_decoders(ids)
        first = -END_OF_TIME_NS if start_ns is None else max(min(start_ns, END_OF_TIME_NS), -END_OF_TIME_NS)
        end = END_OF_TIME_NS if end_ns is None else max(min(end_ns, END_OF_TIME_NS), -END_OF_TIME_NS)
        return self._raw(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join('?' * len(ids))})"
            " AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, id",
            (*ids, first, end),
        )

    def decoded(self, raw: RawMessage) -> Message:
        """The message of some bytes; MessageError where they do not fit its schema."""
        return self._channels.decoded(raw)

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
            head = stream.read(100)
        if len(head) < 100:
            raise LogError("the bag is cut off", where=self.path, found=f"{size} bytes", remedy=SALVAGE)
        (page_size,) = struct.unpack_from(">H", head, 16)
        change, pages, pages_valid_for = (struct.unpack_from(">I", head, place)[0] for place in (24, 28, 92))
        expected = (65536 if page_size == 1 else page_size) * pages
        if change == pages_valid_for and size < expected:
            raise LogError(
                "the bag is cut off", where=self.path, found=f"{size:,} of {expected:,} bytes", remedy=SALVAGE
            )
        for journal in (self._file.with_name(self._file.name + suffix) for suffix in ("-wal", "-journal")):
            if journal.is_file() and journal.stat().st_size:
                raise LogError(
                    "the recorder did not close this bag: its last messages are in a journal",
                    where=self.path,
                    found=f"{journal.name}, {journal.stat().st_size:,} bytes",
                    remedy="keep both files together: `vilp-data salvage` makes one MCAP of them",
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

    # --- rows -----------------------------------------------------------------------------------------------------------

    def _rows(self, query: str, values: tuple[int, ...] = ()) -> Iterator[Any]:
        with self._damage_told():
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

    @contextmanager
    def _damage_told(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError) as error:
            if "interrupted" in str(error):
                raise self._damaged("its tables lead in circles") from error
            raise self._damaged(str(error) or repr(error)) from error

    def _whole(self, value: object) -> int:
        if not isinstance(value, int):
            raise self._damaged(f"a time that is no whole number ({value!r:.40})")
        return value

    def _text(self, value: object) -> str:
        if not isinstance(value, str):
            raise self._damaged(f"{value!r:.40} where text was expected")
        return value

    def _damaged(self, found: str) -> LogError:
        return LogError("the bag is damaged", where=self.path, found=found, remedy=SALVAGE)
