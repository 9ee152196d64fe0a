"""Bytes of an MCAP file into checked records and chunks (https://mcap.dev/spec). Every error is a LogError that names the place."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from vilp_data import limits
from vilp_data.errors import LogError, copy_or_salvage
from vilp_data.sources.inflate import inflate

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, content length
CHUNK_HEAD = struct.Struct(
    "<BQQQQII"
)  # opcode, length, first and last log time, size, CRC, length of compression's name
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time

LAST_NS = (1 << 63) - 1
"""The last time that is read, in the year 2262. MCAP has room for later ones, NumPy has not: they come from damage."""

# What the mcap library raises for a damaged record; anything else is a mistake in the code and must surface.
BROKEN = (McapError, struct.error, ValueError, OverflowError)


class StrictStream(ReadDataStream):  # type: ignore[misc]
    """The mcap library's stream over a record's content. Its own takes a text that the record cuts off for a shorter one."""

    def __init__(self, content: bytes) -> None:
        super().__init__(BytesIO(content))

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


class RecordReader:
    """Reads records of one open file. Chunks are handed out only after their header agreed with the index and their CRC matched."""

    def __init__(self, path: Path, stream: BinaryIO, size: int) -> None:
        self.path = path
        self.size = size
        self._stream = stream

    def bytes_at(self, offset: int, length: int, what: str) -> bytes:
        """Exactly `length` bytes; LogError about `what` where the file does not have them."""
        if offset < 0 or offset + length > self.size:
            raise self.damaged(what, f"it would reach from byte {offset} to {offset + length} of {self.size}")
        if length > limits.RECORD_BYTES:
            raise limits.exceeded(what, "RECORD_BYTES", length, where=self.path)
        try:
            self._stream.seek(offset)
            data = self._stream.read(length)
        except OSError as error:
            raise self.damaged(what, f"{error.strerror} at byte {offset}") from error
        if len(data) != length:
            raise self.damaged(what, f"{len(data)} of {length} bytes at {offset}; is it being written to?")
        return data

    def blocks(self) -> Iterator[bytes]:
        """The whole file, in order, in pieces of a megabyte."""
        for offset in range(0, self.size, 1 << 20):
            yield self.bytes_at(offset, min(1 << 20, self.size - offset), "the file")

    def records(self, data: bytes, where: str) -> Iterator[tuple[int, int, int]]:
        """(opcode, begin, end) of each record's content in a run of records."""
        position, size = 0, len(data)
        while position < size:
            begin = position + RECORD_HEAD.size
            if begin > size:
                raise self.damaged(where, "it ends inside a record")
            opcode, length = RECORD_HEAD.unpack_from(data, position)
            position = begin + length
            if position > size:
                raise self.damaged(where, f"a record of {length} bytes where {size - begin} are left")
            yield opcode, begin, position

    def parse(self, read: Callable[[ReadDataStream], Any], content: bytes, where: str) -> Any:
        """A record by the mcap library's own parser."""
        try:
            return read(StrictStream(content))
        except BROKEN as error:
            raise self.damaged(where, f"a record that cannot be read ({error!r})") from error

    def chunk_index_of(self, record: bytes, position: int) -> ChunkIndex:
        """The index entry that a chunk's own header amounts to (without message indexes)."""
        try:
            _, _, start, end, size, _, name_length = CHUNK_HEAD.unpack_from(record)
            compression = str(record[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length], "utf-8")
            (compressed_size,) = struct.unpack_from("<Q", record, CHUNK_HEAD.size + name_length)
        except BROKEN as error:
            raise self.damaged(f"the chunk at byte {position}", str(error)) from error
        return ChunkIndex(
            chunk_start_offset=position,
            chunk_length=len(record),
            message_start_time=start,
            message_end_time=end,
            message_index_offsets={},
            message_index_length=0,
            compression=compression,
            compressed_size=compressed_size,
            uncompressed_size=size,
        )

    def chunk_data(self, chunk: ChunkIndex) -> bytes:
        """A chunk's records, inflated; its header compared with the index and its CRC verified (0 means none was written)."""
        where = f"the chunk at byte {chunk.chunk_start_offset}"
        record = self.bytes_at(chunk.chunk_start_offset, chunk.chunk_length, where)
        begin = CHUNK_HEAD.size + len(chunk.compression.encode()) + 8
        if len(record) < begin:
            raise self.damaged(where, "a chunk shorter than its own header")
        opcode, length, *_, crc, _ = CHUNK_HEAD.unpack_from(record)
        if (opcode, length) != (Opcode.CHUNK, len(record) - RECORD_HEAD.size):
            raise self.damaged(where, f"record {opcode:#04x} of {length} bytes instead")
        header = self.chunk_index_of(record, chunk.chunk_start_offset)
        for name in ("message_start_time", "message_end_time", "uncompressed_size", "compression", "compressed_size"):
            if getattr(header, name) != getattr(chunk, name):
                found = f"{name} {getattr(header, name)!r}, while the index says {getattr(chunk, name)!r}"
                raise self.damaged(where, found)
        limits.check(where, "CHUNK_BYTES", max(chunk.uncompressed_size, chunk.compressed_size), where=self.path)
        try:
            packed = record[begin : begin + chunk.compressed_size]
            data = inflate(packed, chunk.compression, chunk.uncompressed_size)
        except ValueError as error:
            raise self.damaged(where, f"{chunk.compression or 'stored'} data that cannot be read ({error})") from error
        if crc and zlib.crc32(data) != crc:
            raise self.damaged(where, f"CRC {zlib.crc32(data):08x} where {crc:08x} was written")
        return data

    def damaged(self, where: str, found: str) -> LogError:
        return LogError(
            f"the log is damaged at {where}", where=self.path, found=found, remedy=copy_or_salvage(self.path)
        )
