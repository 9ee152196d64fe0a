"""Serialised messages of a ROS 1 bag, chunk by chunk (http://wiki.ros.org/Bags/Format/2.0). Knows nothing of what they mean.

The container is read here rather than by rosbags, whose reader keeps an object in memory for every message, inflates a chunk to
whatever size comes out, and inflates it again for every change between chunks that overlap.

A bag says three times what is in it: in its index at the end, in the index behind each chunk, and in the chunks. On opening, the first
must agree with the second and both must fill the file; on reading, the second must agree with the third. So a number that was changed
is an error, and never a shorter bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vilp_data import limits
from vilp_data.errors import LogError, copy_or_salvage, mangled, salvage_command
from vilp_data.sources.channels import RawMessage
from vilp_data.sources.chunked_log import MessageChunk
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import inflate
from vilp_data.sources.line_endings import is_converted
from vilp_data.sources.rosbag1_records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    COMPRESSIONS,
    CONNECTION,
    INDEX,
    MAGIC,
    MESSAGE,
    BagRecord,
    Connection,
    bag_record,
    bytes_of,
    chunk_counts,
    connection_of,
)
from vilp_data.types import I64

INDEX_ENTRY = 12  # bytes: seconds, nanoseconds, offset in the chunk


@dataclass(frozen=True, slots=True)
class BagChunk(MessageChunk):
    """A chunk as the bag's index describes it: messages by connection; the records of its own index fill [begin of those, end)."""

    counts: dict[int, int]
    end: int


class Rosbag1File:
    """An open bag, a `ChunkedFile`. LogError on opening where it has no index, is cut off or contradicts itself, on reading where a chunk
    is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: dict[int, Connection] = {}
        self.chunks: list[BagChunk] = []
        self._bytes = FileBytes(path)
        try:
            self._read_index()
        except BaseException:
            self.close()
            raise
        self.counts: Counter[int] = Counter()
        for chunk in self.chunks:
            self.counts.update(chunk.counts)

    def close(self) -> None:
        self._bytes.close()

    @property
    def span(self) -> tuple[int, int] | None:
        filled = [chunk for chunk in self.chunks if chunk.channels]
        if not filled:
            return None
        return min(chunk.first_ns for chunk in filled), max(chunk.last_ns for chunk in filled)

    def chunk_messages(
        self, chunk: BagChunk, channel_ids: Collection[int], start_ns: int, end_ns: int
    ) -> list[RawMessage]:
        where = f"the chunk at byte {chunk.offset}"
        data = self._chunk_data(chunk.offset, where)
        found: list[RawMessage] = []
        times: dict[int, list[int]] = {}
        for record in self._records_in(data, where):
            if record.op == MESSAGE:
                connection, time_ns = record.number(b"conn"), record.time_ns()
                times.setdefault(connection, []).append(time_ns)
                if connection in channel_ids and start_ns <= time_ns < end_ns:
                    found.append(RawMessage(time_ns, time_ns, connection, data[record.begin : record.end]))
            elif record.op == CONNECTION:
                self._compare_connection(record, data, where)
        listed = {connection: values.tolist() for connection, values in self.chunk_times(chunk).items() if len(values)}
        if times != listed:
            many, expected = (sum(map(len, each.values())) for each in (times, listed))
            raise self.damaged(where, f"{many} messages where its index lists {expected}, or others")
        return found

    def chunk_times(self, chunk: BagChunk) -> dict[int, I64]:
        """As `ChunkedFile.chunk_times`; LogError where the chunk's own index is another than the bag's."""
        where = f"the index of the chunk at byte {chunk.offset}"
        times: dict[int, I64] = {}
        for record in self._records(self._record(chunk.offset, CHUNK, where).end, chunk.end, where):
            if record.op != INDEX:
                continue
            connection, size = record.number(b"conn"), record.end - record.begin
            if size % INDEX_ENTRY or connection in times:
                raise self.damaged(where, f"entries of connection {connection} that make no sense")
            entries = np.frombuffer(self._bytes.at(record.begin, size), "<u4").reshape(-1, 3).astype(np.int64)
            entries = entries[np.argsort(entries[:, 2], kind="stable")]
            times[connection] = entries[:, 0] * 10**9 + entries[:, 1]
        for connection in sorted({*times, *chunk.counts}):
            values = times.get(connection, ())
            if len(values) != chunk.counts.get(connection, 0):
                found = (
                    f"{len(values)} messages of connection {connection}, {chunk.counts.get(connection, 0)} by the bag's"
                )
                raise self.damaged(where, found)
            if len(values) and not (chunk.first_ns <= np.min(values) and np.max(values) <= chunk.last_ns):
                raise self.damaged(where, f"times of connection {connection} outside the range that the bag's gives")
        return times

    def pass_bytes_to(self, update: Callable[[bytes], object]) -> None:
        for offset in range(0, self._bytes.size, 1 << 20):
            update(self._bytes.at(offset, 1 << 20))

    def damaged(self, where: str, found: str) -> LogError:
        return LogError(
            f"the bag is damaged at {where}", where=self.path, found=found, remedy=copy_or_salvage(self.path)
        )

    # --- the index ------------------------------------------------------------------------------------------------------

    def _read_index(self) -> None:
        head = self._bytes.at(0, len(MAGIC))
        if head != MAGIC:
            raise self._another_head(head)
        header = self._record(len(MAGIC), BAG_HEADER, "the bag header")
        if header.fields.get(b"encryptor"):
            found = f"by {header.fields[b'encryptor'].decode(errors='replace')}"
            raise LogError(
                "the bag is encrypted", where=self.path, found=found, remedy="decrypt it with `rosbag decrypt`"
            )
        index, connections, chunks = (header.number(name) for name in (b"index_pos", b"conn_count", b"chunk_count"))
        if index == 0:
            found = "its header leads to no index: the recorder was stopped before it wrote one"
            remedy = (
                f"{salvage_command(self.path)} gets back what is there; `rosbag reindex` too, where ROS 1 is installed"
            )
            raise LogError("the bag has no index", where=self.path, found=found, remedy=remedy)
        if index > self._bytes.size or (index == self._bytes.size and connections + chunks > 0):
            raise self._cut_off(f"its index begins at byte {index:,} of {self._bytes.size:,}")
        position = index
        for _ in range(connections):
            position = self._read_connection(position)
        infos: list[BagRecord] = []
        for _ in range(chunks):
            infos.append(self._record(position, CHUNK_INFO, "the index"))
            position = infos[-1].end
        self._refuse_more(position)
        self._read_chunks(infos, header.end, index)

    def _another_head(self, head: bytes) -> LogError:
        if MAGIC.startswith(head):
            return self._cut_off(f"{len(head)} bytes")
        if is_converted(begin := self._bytes.at(0, len(MAGIC) + 1)):
            return mangled("a bag", self.path, begin)
        remedy = "`rosbag migrate`, where ROS 1 is installed, makes a 2.0 bag of it"
        return LogError(
            "a bag of a version that is not read", where=self.path, found=f"it begins with {head!r}", remedy=remedy
        )

    def _read_connection(self, position: int) -> int:
        """Note one connection; the place after it."""
        record = self._record(position, CONNECTION, "the index")
        connection = connection_of(record, self._bytes.at(record.begin, record.end - record.begin))
        if connection is None:
            raise self.damaged("the index", f"a connection at byte {position} without a readable topic or type")
        self.connections[record.number(b"conn")] = connection
        return record.end

    def _refuse_more(self, position: int) -> None:
        """LogError where the bag goes on behind its index: the header counts fewer connections or chunks than there are."""
        while rest := self._bytes.at(position, 1 << 20):
            if rest.strip(b"\0"):
                found = f"{self._bytes.size - position:,} bytes behind what the bag header counts"
                raise self.damaged("the index", found)
            position += len(rest)

    def _read_chunks(self, infos: list[BagRecord], begin: int, end: int) -> None:
        """Note the chunks; LogError where they and their own indexes are not all that lies between the header and the bag's index."""
        infos = sorted(infos, key=lambda record: record.number(b"chunk_pos"))
        offsets = [*(record.number(b"chunk_pos") for record in infos), end]
        for _ in self._records(begin, offsets[0], "the bag header"):
            pass
        for record, offset, after in zip(infos, offsets[:-1], offsets[1:], strict=True):
            counts = chunk_counts(self._bytes.at(record.begin, record.end - record.begin))
            if unknown := counts.keys() - self.connections.keys():
                raise self.damaged("the index", f"messages of connection {min(unknown)}, which it does not describe")
            channels = frozenset(connection for connection, count in counts.items() if count)
            times = record.time_ns(b"start_time"), record.time_ns(b"end_time")
            self.chunks.append(BagChunk(offset, *times, channels, counts, after))
            self.chunk_times(self.chunks[-1])

    # --- records --------------------------------------------------------------------------------------------------------

    def _chunk_data(self, offset: int, where: str) -> bytes:
        record = self._record(offset, CHUNK, where)
        compression = COMPRESSIONS.get(record.fields.get(b"compression", b""))
        if compression is None:
            raise self.damaged(where, f"compression {record.fields.get(b'compression')!r}; known: none, bz2, lz4")
        size = record.number(b"size")
        limits.check(where, "CHUNK_BYTES", max(size, record.end - record.begin), where=self.path)
        try:
            return inflate(self._bytes.at(record.begin, record.end - record.begin), compression, size)
        except ValueError as error:
            raise self.damaged(where, f"{compression or 'stored'} data that cannot be read ({error})") from error

    def _compare_connection(self, record: BagRecord, data: bytes, where: str) -> None:
        """LogError where a chunk describes a connection otherwise than the bag's index."""
        here, number = connection_of(record, data[record.begin : record.end]), record.number(b"conn")
        known = self.connections.get(number)
        if known is None or here is None or (here.topic, here.type) != (known.topic, known.type):
            raise self.damaged(where, f"connection {number} is another than the index describes")

    def _record(self, offset: int, op: int, where: str) -> BagRecord:
        """The record of a kind at a place of the file. Its data are not read."""
        record = bag_record(self._bytes.at, offset)
        if record is None:
            if offset + 4 + int.from_bytes(self._bytes.at(offset, 4), "little") >= self._bytes.size:
                raise self._cut_off(f"{where} ends inside a record's header, at byte {self._bytes.size:,}")
            raise self.damaged(where, f"no record makes sense at byte {offset}")
        if record.end > self._bytes.size:
            raise self._cut_off(f"{where} reaches to byte {record.end:,} of {self._bytes.size:,}")
        if record.op != op:
            raise self.damaged(where, f"another record in its place, at byte {offset}")
        return record

    def _records(self, begin: int, end: int, where: str) -> Iterator[BagRecord]:
        """The records that fill [begin, end) of the file, none of them a chunk or a message; LogError where they do not."""
        while begin < end:
            record = bag_record(self._bytes.at, begin)
            if record is None or record.end > end:
                raise self.damaged(where, f"no record makes sense at byte {begin}")
            if record.op in (CHUNK, MESSAGE):
                raise self.damaged("the index", f"messages at byte {begin}, which it does not list")
            yield record
            begin = record.end
        if begin != end:
            raise self.damaged(where, f"it reaches past byte {end}, where the next chunk begins")

    def _records_in(self, data: bytes, where: str) -> Iterator[BagRecord]:
        """The records that fill an inflated chunk."""
        position = 0
        while position < len(data):
            record = bag_record(bytes_of(data), position)
            if record is None or record.end > len(data):
                raise self.damaged(where, f"no record makes sense at byte {position} of its data")
            yield record
            position = record.end

    def _cut_off(self, found: str) -> LogError:
        what = "the bag is cut off, or damaged: a copy did not finish"
        return LogError(what, where=self.path, found=found, remedy=copy_or_salvage(self.path))
