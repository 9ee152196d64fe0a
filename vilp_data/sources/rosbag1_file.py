"""Serialised messages of a ROS 1 bag in order of log time (http://wiki.ros.org/Bags/Format/2.0). Knows nothing of what they mean.

The container is read here rather than by rosbags, whose reader keeps an object in memory for every message, inflates a chunk to
whatever size comes out, and inflates it again for every change between chunks that overlap."""

from __future__ import annotations

import os
import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.sources.channels import RawMessage
from vilp_data.sources.inflate import inflate
from vilp_data.types import I64

MAGIC = b"#ROSBAG V2.0\n"
SALVAGE = "copy it again from where it was recorded; `vilp-data salvage` gets back what is there"

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
COMPRESSIONS = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}

U32 = struct.Struct("<I")
U64 = struct.Struct("<Q")
TIME = struct.Struct("<II")  # seconds, nanoseconds
COUNT = struct.Struct("<II")  # connection, messages

Fields = dict[bytes, bytes]
_log_time = attrgetter("log_time_ns")


class Connection(NamedTuple):
    """What the bag says of one publisher; `definition` is the text of its message type, empty where the recorder had none."""

    topic: str
    type: str
    definition: bytes


class BagChunk(NamedTuple):
    """A chunk as the bag's index describes it: messages by connection, log times of the first and the last."""

    offset: int
    first_ns: int
    last_ns: int
    counts: dict[int, int]


class Rosbag1File:
    """An open bag. LogError on opening where it has no index or is cut off, on reading where a chunk is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: dict[int, Connection] = {}
        self.chunks: list[BagChunk] = []
        self._stream = path.open("rb")
        try:
            self.size = os.fstat(self._stream.fileno()).st_size
            self._read_index()
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        self._stream.close()

    def counts(self) -> Counter[int]:
        """Connection -> its messages, as the index counts them."""
        counts: Counter[int] = Counter()
        for chunk in self.chunks:
            counts.update(chunk.counts)
        return counts

    def messages(self, connections: Collection[int], start_ns: int, end_ns: int) -> Iterator[RawMessage]:
        """Messages of these connections with start_ns <= log time < end_ns, by log time, ties as they lie in the file.

        Memory holds one chunk, and those that overlap it in time."""
        wanted = [
            chunk
            for chunk in self.chunks
            if chunk.first_ns < end_ns and chunk.last_ns >= start_ns and not chunk.counts.keys().isdisjoint(connections)
        ]
        pending: list[RawMessage] = []
        for chunk in sorted(wanted, key=lambda chunk: (chunk.first_ns, chunk.offset)):
            ready = bisect_right(pending, chunk.first_ns, key=_log_time)
            yield from pending[:ready]
            pending = pending[ready:]
            found = self.chunk_messages(chunk, connections)
            pending += [message for message in found if start_ns <= message.log_time_ns < end_ns]
            pending.sort(key=_log_time)  # stable, and nearly in order already
        yield from pending

    def chunk_messages(self, chunk: BagChunk, connections: Collection[int]) -> list[RawMessage]:
        """The messages of these connections in one chunk, in file order; no fewer and no more than the index counts."""
        where = f"the chunk at byte {chunk.offset}"
        data = self._chunk_data(chunk.offset, where)
        found: list[RawMessage] = []
        seen: Counter[int] = Counter()
        position = 0
        while position < len(data):
            fields, begin, end = self._record_in(data, position, where)
            if self._op(fields, where) == MESSAGE:
                connection = self._number(fields, b"conn", U32, where)
                if connection in connections:
                    time_ns = self._time(fields, b"time", where)
                    if not chunk.first_ns <= time_ns <= chunk.last_ns:
                        raise self.damaged(
                            where, f"a message at {time_ns} ns, outside the time range that the index gives"
                        )
                    found.append(RawMessage(time_ns, time_ns, connection, data[begin:end]))
                seen[connection] += 1
            position = end
        if seen != Counter({connection: count for connection, count in chunk.counts.items() if count}):
            raise self.damaged(
                where, f"{seen.total()} messages where the index counts {sum(chunk.counts.values())}, or of others"
            )
        return found

    def message_times(self, chunk_limit: int) -> dict[int, I64]:
        """Connection -> log times [n] in file order, from the index records of the first `chunk_limit` chunks; none is inflated."""
        times: dict[int, list[I64]] = {}
        for chunk in sorted(self.chunks[:chunk_limit]):
            where = f"the index of the chunk at byte {chunk.offset}"
            fields, _, position = self._record_at(chunk.offset, where)
            for _ in chunk.counts:
                fields, begin, end = self._record_at(position, where)
                if self._op(fields, where) != INDEX or (end - begin) % 12:
                    raise self.damaged(where, "another record in its place")
                entries = (
                    np.frombuffer(self._bytes_at(begin, end - begin, where), "<u4").reshape(-1, 3).astype(np.int64)
                )
                entries = entries[np.argsort(entries[:, 2], kind="stable")]  # seconds, nanoseconds, offset in the chunk
                connection = self._number(fields, b"conn", U32, where)
                if chunk.counts.get(connection) != len(entries):
                    raise self.damaged(
                        where, f"{len(entries)} messages of connection {connection}, otherwise than at the bag's end"
                    )
                times.setdefault(connection, []).append(entries[:, 0] * 10**9 + entries[:, 1])
                position = end
        return {connection: np.concatenate(parts) for connection, parts in times.items()}

    def pass_bytes_to(self, update: Callable[[bytes], object]) -> None:
        """Hand every byte of the file to `update`, in order."""
        for offset in range(0, self.size, 1 << 20):
            update(self._bytes_at(offset, min(1 << 20, self.size - offset), "the file"))

    # --- the index ------------------------------------------------------------------------------------------------------

    def _read_index(self) -> None:
        head = self._bytes_at(0, min(len(MAGIC), self.size), "its first line")
        if head != MAGIC:
            raise self._another_head(head)
        fields, _, _ = self._record_at(len(MAGIC), "the bag header")
        if self._op(fields, "the bag header") != BAG_HEADER:
            raise self.damaged("the bag header", "another record in its place")
        if fields.get(b"encryptor"):
            found = f"by {fields[b'encryptor'].decode(errors='replace')}"
            raise LogError(
                "the bag is encrypted", where=self.path, found=found, remedy="decrypt it with `rosbag decrypt`"
            )
        position = self._number(fields, b"index_pos", U64, "the bag header")
        connections = self._number(fields, b"conn_count", U32, "the bag header")
        chunks = self._number(fields, b"chunk_count", U32, "the bag header")
        if position == 0:
            found = "its header leads to no index: the recorder was stopped before it wrote one"
            remedy = "`vilp-data salvage` gets back what is there; `rosbag reindex` too, where ROS 1 is installed"
            raise LogError("the bag has no index", where=self.path, found=found, remedy=remedy)
        if position > self.size or (position == self.size and connections + chunks > 0):
            raise self._cut_off(f"its index begins at byte {position:,} of {self.size:,}")
        for _ in range(connections):
            position = self._read_connection(position)
        for _ in range(chunks):
            position = self._read_chunk_info(position)

    def _another_head(self, head: bytes) -> LogError:
        if MAGIC.startswith(head):
            return self._cut_off(f"{len(head)} bytes")
        remedy = "`rosbag migrate`, where ROS 1 is installed, makes a 2.0 bag of it"
        return LogError(
            "a bag of a version that is not read", where=self.path, found=f"it begins with {head!r}", remedy=remedy
        )

    def _read_connection(self, position: int) -> int:
        """Note one connection; the place after it."""
        fields, begin, end = self._record_at(position, "the index")
        if self._op(fields, "the index") != CONNECTION:
            raise self.damaged("the index", f"a record at byte {position} that is no connection")
        header = self._fields(self._bytes_at(begin, end - begin, "the index"), "the index")
        connection = self._number(fields, b"conn", U32, "the index")
        topic, message_type = (self._text(f, name) for f, name in ((fields, b"topic"), (header, b"type")))
        self.connections[connection] = Connection(topic, message_type, header.get(b"message_definition", b""))
        return end

    def _read_chunk_info(self, position: int) -> int:
        fields, begin, end = self._record_at(position, "the index")
        if self._op(fields, "the index") != CHUNK_INFO or (end - begin) % COUNT.size:
            raise self.damaged("the index", f"a record at byte {position} that describes no chunk")
        counts = dict(COUNT.iter_unpack(self._bytes_at(begin, end - begin, "the index")))
        offset = self._number(fields, b"chunk_pos", U64, "the index")
        first_ns, last_ns = self._time(fields, b"start_time", "the index"), self._time(fields, b"end_time", "the index")
        if unknown := counts.keys() - self.connections.keys():
            raise self.damaged("the index", f"messages of connection {min(unknown)}, which it does not describe")
        self.chunks.append(BagChunk(offset, first_ns, last_ns, counts))
        return end

    # --- records --------------------------------------------------------------------------------------------------------

    def _chunk_data(self, offset: int, where: str) -> bytes:
        fields, begin, end = self._record_at(offset, where)
        if self._op(fields, where) != CHUNK:
            raise self.damaged(where, "another record in its place")
        compression = COMPRESSIONS.get(fields.get(b"compression", b""))
        if compression is None:
            raise self.damaged(where, f"compression {fields.get(b'compression')!r}; known: none, bz2, lz4")
        size = self._number(fields, b"size", U32, where)
        limits.check(where, "CHUNK_BYTES", max(size, end - begin), where=self.path)
        try:
            return inflate(self._bytes_at(begin, end - begin, where), compression, size)
        except ValueError as error:
            raise self.damaged(where, f"{compression or 'stored'} data that cannot be read ({error})") from error

    def _record_at(self, offset: int, where: str) -> tuple[Fields, int, int]:
        """(header fields, begin, end of its data) of a record in the file. The data are not read."""
        (length,) = U32.unpack(self._bytes_at(offset, 4, where))
        fields = self._fields(self._bytes_at(offset + 4, length, where), where)
        (size,) = U32.unpack(self._bytes_at(offset + 4 + length, 4, where))
        begin = offset + 8 + length
        if begin + size > self.size:
            raise self._cut_off(f"{where} reaches to byte {begin + size:,} of {self.size:,}")
        return fields, begin, begin + size

    def _record_in(self, data: bytes, offset: int, where: str) -> tuple[Fields, int, int]:
        """The same of a record in an inflated chunk."""
        try:
            (length,) = U32.unpack_from(data, offset)
            (size,) = U32.unpack_from(data, offset + 4 + length)
        except struct.error as error:
            raise self.damaged(where, "it ends inside a record") from error
        begin = offset + 8 + length
        if begin + size > len(data):
            raise self.damaged(where, f"a record of {size} bytes where {len(data) - begin} are left")
        return self._fields(data[offset + 4 : begin - 4], where), begin, begin + size

    def _fields(self, header: bytes, where: str) -> Fields:
        """A record header, `name=value` each after its length."""
        fields: Fields = {}
        position = 0
        while position < len(header):
            end = position + 4 + (U32.unpack_from(header, position)[0] if position + 4 <= len(header) else len(header))
            name, found, value = header[position + 4 : end].partition(b"=")
            if end > len(header) or not found:
                raise self.damaged(where, "a record header that cannot be read")
            fields[name] = value
            position = end
        return fields

    def _op(self, fields: Fields, where: str) -> int:
        if len(fields.get(b"op", b"")) != 1:
            raise self.damaged(where, "a record that does not say what it is")
        return fields[b"op"][0]

    def _number(self, fields: Fields, name: bytes, form: struct.Struct, where: str) -> int:
        if len(fields.get(name, b"")) != form.size:
            raise self.damaged(where, f"a record without {name.decode()}")
        return int(form.unpack(fields[name])[0])

    def _time(self, fields: Fields, name: bytes, where: str) -> int:
        if len(fields.get(name, b"")) != TIME.size:
            raise self.damaged(where, f"a record without {name.decode()}")
        seconds, nanoseconds = TIME.unpack(fields[name])
        return int(seconds) * 10**9 + int(nanoseconds)

    def _text(self, fields: Fields, name: bytes) -> str:
        try:
            return fields[name].decode()
        except (KeyError, UnicodeDecodeError) as error:
            raise self.damaged("the index", f"a connection without a readable {name.decode()}") from error

    def _bytes_at(self, offset: int, length: int, where: str) -> bytes:
        if offset + length > self.size:
            raise self._cut_off(f"{where} reaches to byte {offset + length:,} of {self.size:,}")
        try:
            self._stream.seek(offset)
            data = self._stream.read(length)
        except OSError as error:
            raise self.damaged(where, f"{error.strerror} at byte {offset}") from error
        if len(data) != length:
            raise self.damaged(where, f"{len(data)} of {length} bytes at {offset}; is it being written to?")
        return data

    def damaged(self, where: str, found: str) -> LogError:
        return LogError(f"the bag is damaged at {where}", where=self.path, found=found, remedy=SALVAGE)

    def _cut_off(self, found: str) -> LogError:
        what = "the bag is cut off, or damaged: a copy did not finish"
        return LogError(what, where=self.path, found=found, remedy=SALVAGE)
