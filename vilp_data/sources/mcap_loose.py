"""The records of an MCAP file outside its chunks, and the messages among them, gathered into runs that are read as chunks are.

A file without chunks may hold tens of millions of messages: nothing is kept of one alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from vilp_data.sources.chunked_log import MessageChunk
from vilp_data.sources.mcap_records import MESSAGE_HEAD, RECORD_HEAD, RecordReader

WINDOW = 1 << 16  # bytes of small records read at a time
RUN_BYTES = 1 << 20  # of the file, in one run


class FileRecord(NamedTuple):
    """A record at [position, end) of the file, and at `begin` of `window`: bytes that hold at least its head, and a message's."""

    opcode: int
    position: int
    end: int
    window: bytes
    begin: int

    def whole(self) -> bytes:
        return self.window[self.begin : self.begin + self.end - self.position]

    def content(self) -> bytes:
        return self.whole()[RECORD_HEAD.size :]


@dataclass(frozen=True, slots=True)
class LooseRun(MessageChunk):
    """Messages outside all chunks that follow each other, other records between them: [offset, end) of the file, at most RUN_BYTES or
    one message. `counts`: messages by channel."""

    end: int
    counts: Counter[int]


def file_records(reader: RecordReader, begin: int, end: int, *, whole: bool) -> Iterator[FileRecord]:
    """The records that begin at [begin, end). `whole`: their windows hold all of them, else what is long is passed over unread.
    LogError where one reaches past the end of the file."""
    position, start, window = begin, begin, b""
    least = RECORD_HEAD.size + MESSAGE_HEAD.size
    while position < end:
        if position + least > start + len(window) < reader.size:
            window, start = reader.bytes_at(position, min(WINDOW, reader.size - position), f"byte {position}"), position
        if position + RECORD_HEAD.size > reader.size:
            raise reader.damaged(f"byte {position}", "it ends inside a record")
        opcode, length = RECORD_HEAD.unpack_from(window, position - start)
        after = position + RECORD_HEAD.size + length
        if after > reader.size:
            raise reader.damaged(f"the record at byte {position}", f"it would reach to byte {after} of {reader.size}")
        if whole and after > start + len(window):
            window, start = reader.bytes_at(position, after - position, f"the record at byte {position}"), position
        yield FileRecord(opcode, position, after, window, position - start)
        position = after


class LooseRuns:
    """Gathers messages into `runs`, in file order."""

    def __init__(self) -> None:
        self.runs: list[LooseRun] = []
        self._offset = self._end = self._first_ns = self._last_ns = 0
        self._counts: Counter[int] = Counter()

    def add(self, reader: RecordReader, record: FileRecord) -> tuple[int, int]:
        """Take a message in; its channel and log time. LogError where the record is too short for one."""
        if record.end - record.position < RECORD_HEAD.size + MESSAGE_HEAD.size:
            raise reader.damaged(f"byte {record.position}", "a message record shorter than its own header")
        channel_id, _, time_ns, _ = MESSAGE_HEAD.unpack_from(record.window, record.begin + RECORD_HEAD.size)
        if self._counts and record.end - self._offset > RUN_BYTES:
            self.close()
        if not self._counts:
            self._offset, self._first_ns, self._last_ns = record.position, time_ns, time_ns
        self._end = record.end
        if time_ns > self._last_ns:
            self._last_ns = time_ns
        elif time_ns < self._first_ns:
            self._first_ns = time_ns
        self._counts[channel_id] += 1
        return channel_id, time_ns

    def close(self) -> None:
        """End the run: a chunk, or what is no message and long, begins."""
        if self._counts:
            run = LooseRun(self._offset, self._first_ns, self._last_ns, self._counts.keys(), self._end, self._counts)
            self.runs.append(run)
            self._counts = Counter()
