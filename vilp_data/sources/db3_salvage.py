"""As much of a damaged ROS 2 bag in SQLite as SQLite gives, into a clean MCAP.

The file is copied first, with the journal beside it: opening it there lets SQLite finish or roll back what the recorder had begun,
and leaves the bag as it was. A copy that is cut off is filled up with zeros, since SQLite reads no file that is shorter than it says.
Rows are read from both ends towards the damage, and then around it.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema
from rosbags.typesys import Stores, get_typestore

from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_records import MESSAGE_HEAD
from vilp_data.sources.message_decoders import ros_name

PROBES = 2000  # queries spent on damaged parts of the table
STEP = 1000  # rows
BROKEN = (sqlite3.Error, OverflowError, MemoryError, ValueError)


class Db3Salvage:
    """One run over one file. `run` writes to `clean` and fills `report`."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._channels: dict[int, int] = {}
        self._unknown: Counter[int] = Counter()
        self._seen: set[int] = set()
        self._probes = 0
        self._damaged = False

    def run(self) -> None:
        self._clean.start("ros2", "")
        with tempfile.TemporaryDirectory(prefix="vilp-salvage-") as folder:
            copy = self._copied(Path(folder))
            with closing(sqlite3.connect(copy)) as database:
                database.execute("PRAGMA trusted_schema = OFF")
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(limits.RECORD_BYTES, (1 << 31) - 1))
                database.text_factory = lambda data: data.decode(errors="replace")
                self._describe(database)
                self._read(database)
        self._conclude()

    def _copied(self, folder: Path) -> Path:
        copy = folder / "log.db3"
        shutil.copyfile(self._source.path, copy)
        for suffix in ("-wal", "-journal"):
            beside = self._source.path.with_name(self._source.path.name + suffix)
            if beside.is_file() and beside.stat().st_size:
                shutil.copyfile(beside, copy.with_name(copy.name + suffix))
                self._report.note(f"{beside.name}, which the recorder left, was taken in")
        head = self._source.at(0, 100)
        page = int.from_bytes(head[16:18], "big")
        wanted = (65536 if page == 1 else page) * int.from_bytes(head[28:32], "big")
        same = head[24:28] == head[92:96]
        if same and self._source.size < wanted <= self._source.size + limits.RECORD_BYTES:
            with copy.open("r+b") as stream:
                stream.truncate(wanted)
            self._damaged = True
            self._report.doubt(f"the file is cut off: {self._source.size:,} of {wanted:,} bytes")
        return copy

    # --- descriptions

    def _describe(self, database: sqlite3.Connection) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        for name, encoding, text in self._some(database, query):
            definitions[str(name)] = (str(encoding), str(text))
        stock = get_typestore(Stores.LATEST)
        for number, topic, name, serialization in self._some(
            database, "SELECT id, name, type, serialization_format FROM topics ORDER BY id", needed=True
        ):
            if not isinstance(number, int) or not 0 <= number <= 0xFFFE or not isinstance(topic, str):
                self._report.doubt("a topic's row is damaged")
                continue
            encoding, text = definitions.get(str(name), ("", ""))
            if not text and ros_name(str(name)) in stock.fielddefs:
                encoding, text = "ros2msg", stock.generate_msgdef(ros_name(str(name)), ros_version=2)[0]
            schema = Schema(id=number + 1, name=str(name), encoding=encoding, data=text.encode())
            channel = Channel(
                id=number, topic=topic, message_encoding=str(serialization), metadata={}, schema_id=number + 1
            )
            self._channels[number] = self._clean.describe(channel, schema)

    def _some(self, database: sqlite3.Connection, query: str, *, needed: bool = False) -> Iterator[tuple[Any, ...]]:
        """The rows of a small table up to damage."""
        try:
            yield from database.execute(query)
        except BROKEN as error:
            if needed:
                self._damaged = True
                self._report.doubt(f"the table of topics is damaged ({error})")

    # --- messages

    def _read(self, database: sqlite3.Connection) -> None:
        try:
            low, high = database.execute("SELECT MIN(id), MAX(id) FROM messages").fetchone()
        except BROKEN as error:
            low, high = self._ends(database)
            self._note_damage(error)
        if low is None:
            return
        pending = [(int(low), int(high))]
        while pending and self._probes < PROBES:
            first, last = pending.pop()
            reached = self._forward(database, first, last)
            if reached is None:
                continue
            back = self._backward(database, reached, last)
            if back is None or back <= reached or back - reached < 2:
                continue
            middle = (reached + back) // 2
            pending += [(middle + 1, back), (reached + 1, middle)]
        if pending:
            self._report.amount_known = False

    def _ends(self, database: sqlite3.Connection) -> tuple[int | None, int | None]:
        for order in ("ASC", "DESC"):
            try:
                row = database.execute(f"SELECT id FROM messages ORDER BY id {order} LIMIT 1").fetchone()
            except BROKEN:
                continue
            if row is not None:
                return (row[0], 1 << 40) if order == "ASC" else (0, row[0])
        return None, None

    def _forward(self, database: sqlite3.Connection, first: int, last: int) -> int | None:
        """Read rows from `first` up; the last id before damage, or None where `last` was reached."""
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? AND id <= ? ORDER BY id"
        reached = first - 1
        self._probes += 1
        try:
            for row in database.execute(query, (first, last)):
                reached = max(reached, row[0])
                self._take(*row)
        except BROKEN as error:
            self._note_damage(error)
            return reached
        return None

    def _backward(self, database: sqlite3.Connection, first: int, last: int) -> int | None:
        """Read rows from `last` down; the id before damage, or None where `first` was reached."""
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? AND id <= ? ORDER BY id DESC"
        reached = last + 1
        self._probes += 1
        rows: list[tuple[Any, ...]] = []
        try:
            for row in database.execute(query, (first, last)):
                reached = min(reached, row[0])
                rows.append(row)
                if len(rows) >= STEP:
                    self._take_all(rows)
        except BROKEN as error:
            self._note_damage(error)
            self._take_all(rows)
            return reached
        self._take_all(rows)
        return None

    def _take_all(self, rows: list[tuple[Any, ...]]) -> None:
        for row in reversed(rows):
            self._take(*row)
        rows.clear()

    def _take(self, number: int, topic_id: Any, time_ns: Any, data: Any) -> None:
        if number in self._seen:
            return
        if not isinstance(time_ns, int) or not isinstance(data, bytes) or not isinstance(topic_id, int) or time_ns < 0:
            self._note_damage(ValueError("a row that is no message"))
            return
        self._seen.add(number)
        if topic_id not in self._channels:
            self._unknown[topic_id] += 1
            return
        channel_id = self._channels[topic_id]
        channel = self._clean.channels[channel_id]
        topic = self._report.topic(channel.topic, self._clean.schemas[channel.schema_id].name)
        topic.add(time_ns, time_ns, 1)
        topic.unverified += 1
        self._clean.message(channel_id, MESSAGE_HEAD.pack(channel_id, 0, time_ns, time_ns) + data)

    def _note_damage(self, error: BaseException) -> None:
        self._damaged = True
        self._report.doubt(f"SQLite cannot read all of it ({error})")

    def _conclude(self) -> None:
        report = self._report
        if not self._channels and not self._seen:
            found = "; ".join(report.doubts) or "no topics"
            raise LogError(
                "no bag of ROS 2, or too damaged", where=self._source.path, found=found, remedy="look for another copy"
            )
        if self._unknown:
            report.doubt(f"{self._unknown.total():,} messages are left out: the rows that say what they are are lost")
        report.ended = not self._damaged
        report.amount_known = report.amount_known and not self._damaged
        report.settle()
