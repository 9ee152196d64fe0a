"""As much of a damaged ROS 2 bag in SQLite as its pages hold, into a clean MCAP.

The file is copied first, with the journal beside it: opening it there lets SQLite finish or roll back what the recorder had begun,
and leaves the bag as it was.

Where SQLite's own check finds nothing wrong it gives the rows, from the table itself, never through the index of times. Where anything is
damaged, or the file is cut off, SQLite is asked for the descriptions alone, and every page is looked through for rows (`sqlite_pages`):
where a page is missing SQLite may answer with zeros, and it cannot tell which rows are not all there.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from vilp_data import limits
from vilp_data.errors import LogError, number_of
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_records import MESSAGE_HEAD
from vilp_data.sources.message_decoders import BEFORE_DEFINITIONS, stock_definition
from vilp_data.sources.sqlite_pages import HEAD_SIZE, MessagePages, MessageRow, file_head

JOURNALS = ("-wal", "-journal")
LOWEST = -(1 << 63)  # of SQLite's row ids
INSTRUCTIONS = 1_000_000  # of SQLite's machine, between two looks at how much it has done
TOTAL = 10  # of those per byte of the file: a row takes some 20 and is seen a few times, a tree that leads in circles takes any number
BROKEN = (sqlite3.Error, OverflowError, MemoryError, ValueError)
# The table itself, in order of its rows: `id` would be another column if the text that declares it were damaged.
_ROWS = "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY rowid"


class Db3Salvage:
    """One run over one file. `run` writes to `clean` and fills `report`."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._channels: dict[int, int] = {}
        self._unknown: Counter[int] = Counter()
        self._roots: dict[str, int] = {}  # of the tables' trees
        self._reached = LOWEST - 1  # the last row that SQLite gave
        self._last: MessageRow | None = None  # that was taken from a page
        self._unlike = self._unled = 0
        self._damaged = self._cut_off = False
        self._beside: list[str] = []  # suffixes of the journals
        self._bytes = source.size  # and those of the journals beside it, which may add as many to the file

    def run(self) -> None:
        self._clean.start("ros2", "")
        with tempfile.TemporaryDirectory(prefix="vilp-salvage-") as folder:
            copy = self._copied(Path(folder))
            with closing(sqlite3.connect(copy)) as database:
                database.execute("PRAGMA trusted_schema = OFF")
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(limits.RECORD_BYTES, (1 << 31) - 1))
                database.text_factory = lambda data: data.decode(errors="replace")
                if self._cut_off:  # else SQLite opens no file that is shorter than it says
                    database.execute("PRAGMA writable_schema = ON")
                self._set_budget(database)
                self._describe(database)
                if not self._cut_off and self._is_sound(database):
                    self._set_budget(database)
                    self._read(database)
            self._note_journals(copy)
            if self._damaged:
                self._read_pages(copy)
        self._conclude()

    def _copied(self, folder: Path) -> Path:
        copy = folder / "log.db3"
        shutil.copyfile(self._source.path, copy)
        for suffix in JOURNALS:
            beside = self._source.path.with_name(self._source.path.name + suffix)
            if beside.is_file() and beside.stat().st_size:
                shutil.copyfile(beside, copy.with_name(copy.name + suffix))
                self._bytes += beside.stat().st_size
                self._beside.append(suffix)
        self._cut(copy)
        return copy

    def _note_journals(self, copy: Path) -> None:
        """What became of the journals: a WAL that was taken in is deleted, while another journal may stay though nothing is left of it."""
        for suffix in self._beside:
            name = self._source.path.name + suffix
            if suffix == "-wal" and copy.with_name(copy.name + suffix).exists():
                self._damaged = True
                self._report.doubt(f"{name} could not be taken in")
            else:
                self._report.note(f"{name}, which the recorder left, was taken in")

    def _cut(self, copy: Path) -> None:
        """Where the file is shorter than its pages are, leave nothing of the last one in the copy."""
        head, size = file_head(self._source.at(0, HEAD_SIZE)), self._source.size
        if head is None:
            return
        wanted = (head.pages or -(-size // head.page_size)) * head.page_size
        if size < wanted:
            os.truncate(copy, size - size % head.page_size)
            if self._beside:  # SQLite puts no journal's pages far behind a file's end
                os.truncate(copy, min(wanted, size + limits.RECORD_BYTES))
            self._damaged = self._cut_off = True
            self._report.doubt(f"the file is cut off: {size:,} of {wanted:,} bytes")

    def _set_budget(self, database: sqlite3.Connection) -> None:
        """What comes next ends, whatever circles the file's trees lead in: a query that does too much counts as damaged."""
        self._budget = TOTAL * (self._bytes + INSTRUCTIONS)

        def spent() -> int:
            self._budget -= INSTRUCTIONS
            return int(self._budget < 0)

        database.set_progress_handler(spent, INSTRUCTIONS)

    # --- descriptions

    def _describe(self, database: sqlite3.Connection) -> None:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {}
        for name, encoding, text in self._some(database, query):
            if _are_texts(name, encoding, text):
                definitions[name] = (encoding, text)
            else:
                self._report.doubt(f"the definition of {name!r} is damaged")
        release = next((str(row[0]) for row in self._some(database, "SELECT ros_distro FROM schema")), "")
        for number, topic, name, serialization in self._some(
            database, "SELECT id, name, type, serialization_format FROM topics NOT INDEXED ORDER BY id", needed=True
        ):
            if not isinstance(number, int) or not 0 <= number <= 0xFFFE or not _are_texts(topic, name, serialization):
                self._damaged = True
                self._report.doubt("a topic's row is damaged")
                continue
            encoding, text = definitions.get(name, ("", ""))
            if not text.strip() and (stock := stock_definition(release or BEFORE_DEFINITIONS, name)):
                encoding, text = "ros2msg", stock
            schema = Schema(id=number + 1, name=name, encoding=encoding, data=text.encode())
            channel = Channel(id=number, topic=topic, message_encoding=serialization, metadata={}, schema_id=number + 1)
            self._channels[number] = self._clean.describe(channel, schema)
        for table, root in self._some(database, "SELECT name, rootpage FROM sqlite_master WHERE type = 'table'"):
            if isinstance(table, str) and isinstance(root, int):
                self._roots[table] = root

    def _some(self, database: sqlite3.Connection, query: str, *, needed: bool = False) -> Iterator[tuple[Any, ...]]:
        """The rows of a small table up to damage."""
        try:
            yield from database.execute(query)
        except BROKEN as error:
            if needed:
                self._damaged = True
                self._report.doubt(f"the table of topics is damaged ({error})")

    # --- messages

    def _is_sound(self, database: sqlite3.Connection) -> bool:
        """Whether SQLite's own check finds nothing wrong with the file's trees: else rows may be missing that no query misses."""
        try:
            found = str(database.execute("PRAGMA integrity_check(1)").fetchone()[0]).removeprefix(
                "*** in database main ***"
            )
        except BROKEN as error:
            found = str(error)
        if found != "ok":
            self._damaged = True
            self._report.doubt(f"SQLite's check of the file fails ({' '.join(found.split())})")
        return found == "ok"

    def _read(self, database: sqlite3.Connection) -> None:
        try:
            for row in database.execute(_ROWS):
                self._reached = row[0]
                self._take(*row[1:])
        except BROKEN as error:
            self._note_damage(error)

    def _read_pages(self, copy: Path) -> None:
        """Take the rows in the copy's pages that SQLite did not give."""
        # A journal may put pages anywhere behind a cut, with a hole before them that takes no bytes of the disk, but time.
        size, most = copy.stat().st_size, self._bytes + limits.RECORD_BYTES
        if size > most:
            size = most
            self._report.doubt("a journal's pages far behind the cut were not looked at (VILP_MAX_RECORD_BYTES)")
        own = self._roots.pop("messages", 0)
        others = self._roots.values() if own else ()  # the messages' may be one of them, under a name that is damaged
        with copy.open("rb") as stream:
            pages = MessagePages(
                stream, size, whole=self._source.size, largest=limits.RECORD_BYTES, own=own, others=others
            )
            for row in pages.rows():
                if row.number > self._reached:
                    self._take_once(row)
        if self._unled:
            self._report.doubt(
                f"{number_of(self._unled, 'message')} in pages that the table of messages no longer leads to: deleted ones"
                " and another table's rows may be among them"
            )
        if self._unlike:
            self._report.doubt(f"{number_of(self._unlike, 'row')} under the id of another one that is unlike it")
        if pages.left_out:
            self._report.doubt(
                f"{number_of(pages.left_out, 'row')} left out, whose ids do not fit the rows beside them"
            )

    def _take_once(self, row: MessageRow) -> None:
        """Take a row of a page, where it is none again. Of two unlike ones under one id the second is no message if the tree leads to
        the first alone; else nothing tells which is."""
        if row.topic_id not in self._channels:
            self._unknown[row.topic_id] += 1
            return
        last = self._last
        if last is not None and last.number == row.number:
            if last[:-1] == row[:-1]:
                return
            self._unlike += 1
            if last.led_to and not row.led_to:
                return
        self._last = row
        self._unled += not row.led_to
        self._take(row.topic_id, row.time_ns, row.data)

    def _take(self, topic_id: Any, time_ns: Any, data: Any) -> None:
        if not isinstance(time_ns, int) or not isinstance(data, bytes) or not isinstance(topic_id, int) or time_ns < 0:
            self._note_damage(ValueError("a row that is no message"))
            return
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
        if not self._channels and not self._unknown:
            found = "; ".join(report.doubts) or "no topics"
            raise LogError(
                "no bag of ROS 2, or too damaged", where=self._source.path, found=found, remedy="look for another copy"
            )
        if self._unknown:
            report.doubt(f"{self._unknown.total():,} messages are left out: the rows that say what they are are lost")
        report.ended = not self._damaged
        report.amount_known = report.amount_known and not self._damaged
        report.settle()


def _are_texts(*values: Any) -> bool:
    """Whether these are texts of which all is there: SQLite may answer with zeros for a page that is not."""
    return all(isinstance(value, str) and "\0" not in value for value in values)
