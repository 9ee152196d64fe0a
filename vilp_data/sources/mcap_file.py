"""Serialised messages of an MCAP file, chunk by chunk. Knows nothing of what a message means."""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata

from vilp_data.errors import LogError
from vilp_data.sources.channels import RawMessage
from vilp_data.sources.chunked_log import MessageChunk
from vilp_data.sources.mcap_index import read_index
from vilp_data.sources.mcap_loose import LooseRun
from vilp_data.sources.mcap_records import MESSAGE_HEAD, RECORD_HEAD, RecordReader
from vilp_data.types import I64


@dataclass(frozen=True, slots=True)
class IndexedChunk(MessageChunk):
    """A chunk of the file, as the file's index describes it."""

    entry: ChunkIndex


class McapFile:
    """An open MCAP file, a `ChunkedFile`. LogError on opening where it is cut off or its index is damaged, on reading where a chunk is.

    `named` is the path that errors name, where it is another than the file's."""

    def __init__(self, path: Path, *, named: Path | None = None) -> None:
        self._stream = path.open("rb")
        try:
            self._reader = RecordReader(named or path, self._stream, os.fstat(self._stream.fileno()).st_size)
            self.index = read_index(self._reader)
        except BaseException:
            self._stream.close()
            raise
        chunks = [_indexed(entry) for entry in self.index.chunks]
        self.chunks: list[IndexedChunk | LooseRun] = sorted(
            [*chunks, *self.index.loose], key=lambda chunk: chunk.offset
        )

    def close(self) -> None:
        self._stream.close()

    @property
    def counts(self) -> Counter[int] | None:
        return self.index.counts

    @property
    def span(self) -> tuple[int, int] | None:
        first_ns, last_ns = self.index.first_ns, self.index.last_ns
        return None if first_ns is None or last_ns is None else (first_ns, last_ns)

    def chunk_messages(
        self, chunk: IndexedChunk | LooseRun, channel_ids: Collection[int], start_ns: int, end_ns: int
    ) -> list[RawMessage]:
        found: list[RawMessage] = []
        data, where = self._data(chunk)
        for channel_id, log_time, publish_time, begin, end in self._messages_in(data, chunk, where):
            if channel_id in channel_ids and start_ns <= log_time < end_ns:
                found.append(RawMessage(log_time, publish_time, channel_id, data[begin:end]))
        return found

    def chunk_times(self, chunk: IndexedChunk | LooseRun) -> Mapping[int, I64] | None:
        if isinstance(chunk, LooseRun):
            times: dict[int, array[int]] = {}
            data, where = self._data(chunk)
            for channel_id, log_time, *_ in self._messages_in(data, chunk, where):
                times.setdefault(channel_id, array("q")).append(log_time)
            return {channel_id: np.array(values, np.int64) for channel_id, values in times.items()}
        if chunk.channels is not None:
            return dict(self._indexed_times(chunk.entry))
        return {} if chunk.last_ns == 0 else None  # a chunk without messages claims a time of zero

    def metadata(self) -> dict[str, dict[str, str]]:
        """Named metadata records; those of one name are joined, the later value winning."""
        joined: dict[str, dict[str, str]] = {}
        for entry in self.index.metadata:
            where = f"the metadata record at byte {entry.offset}"
            record = self._reader.bytes_at(entry.offset, entry.length, where)
            content = record[RECORD_HEAD.size :]
            if record[: RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.METADATA, len(content)):
                raise self.damaged(where, "another record than the index says")
            parsed = self._reader.parse(Metadata.read, content, where)
            joined.setdefault(parsed.name, {}).update(parsed.metadata)
        return joined

    def pass_bytes_to(self, update: Callable[[bytes], object]) -> None:
        """Hand every byte of the file to `update`, in order; the data section's CRC, where there is one, is checked on the way."""
        crc, position = 0, 0
        for block in self._reader.blocks():
            update(block)
            if self.index.data_crc and position < self.index.data_end:
                crc = zlib.crc32(memoryview(block)[: self.index.data_end - position], crc)
            position += len(block)
        if self.index.data_crc and crc != self.index.data_crc:
            raise self.damaged("the data section", f"CRC {crc:08x} where {self.index.data_crc:08x} was written")

    def damaged(self, where: str, found: str) -> LogError:
        return self._reader.damaged(where, found)

    def _data(self, chunk: IndexedChunk | LooseRun) -> tuple[bytes, str]:
        """The records of a chunk or a run, checksum verified; and what errors call it."""
        if isinstance(chunk, IndexedChunk):
            return self._reader.chunk_data(chunk.entry), f"the chunk at byte {chunk.offset}"
        where = f"the messages at byte {chunk.offset}"
        return self._reader.bytes_at(chunk.offset, chunk.end - chunk.offset, where), where

    def _messages_in(self, data: bytes, chunk: MessageChunk, where: str) -> Iterator[tuple[int, int, int, int, int]]:
        """(channel id, log time, publish time, begin, end of its data) of every message, in file order."""
        for opcode, begin, end in self._reader.records(data, where):
            if opcode != Opcode.MESSAGE:
                continue
            if end - begin < MESSAGE_HEAD.size:
                raise self.damaged(where, "a message record shorter than its own header")
            channel_id, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, begin)
            if not chunk.first_ns <= log_time <= chunk.last_ns:
                raise self.damaged(where, f"a message at {log_time} ns, outside the time range that the index gives")
            if channel_id not in self.index.channels:
                raise self.damaged(where, f"a message of channel {channel_id}, which the file does not describe")
            yield channel_id, log_time, publish_time, begin + MESSAGE_HEAD.size, end

    def _indexed_times(self, chunk: ChunkIndex) -> Iterator[tuple[int, I64]]:
        """(channel id, log times [n] in file order) of one chunk, from the message indexes that follow it."""
        where = f"the message index of the chunk at byte {chunk.chunk_start_offset}"
        section = self._reader.bytes_at(
            chunk.chunk_start_offset + chunk.chunk_length, chunk.message_index_length, where
        )
        for opcode, begin, end in self._reader.records(section, where):
            if opcode != Opcode.MESSAGE_INDEX:
                continue
            channel_id, n_bytes = struct.unpack_from("<HI", section, begin) if end - begin >= 6 else (0, -1)
            if n_bytes % 16 or begin + 6 + n_bytes > end:
                raise self.damaged(where, "entries that do not fit their record")
            entries = np.frombuffer(section, "<i8", n_bytes // 8, begin + 6).reshape(-1, 2)  # (log time, offset)
            yield channel_id, entries[np.argsort(entries[:, 1], kind="stable"), 0].astype(np.int64)


def _indexed(entry: ChunkIndex) -> IndexedChunk:
    channels = entry.message_index_offsets.keys() or None
    return IndexedChunk(entry.chunk_start_offset, entry.message_start_time, entry.message_end_time, channels, entry)
