"""Serialised messages of an MCAP file in order of log time. Knows nothing of what a message means."""

from __future__ import annotations

import os
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from heapq import merge
from operator import attrgetter
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata

from vilp_data.sources.channels import RawMessage
from vilp_data.sources.mcap_index import read_index
from vilp_data.sources.mcap_records import MESSAGE_HEAD, RECORD_HEAD, RecordReader
from vilp_data.types import I64

_log_time = attrgetter("log_time_ns")


class McapFile:
    """An open MCAP file. LogError on opening where it is cut off or its index is damaged, on reading where a chunk is.

    `named` is the path that errors name, where it is another than the file's."""

    def __init__(self, path: Path, *, named: Path | None = None) -> None:
        self._stream = path.open("rb")
        try:
            self._reader = RecordReader(named or path, self._stream, os.fstat(self._stream.fileno()).st_size)
            self.index = read_index(self._reader)
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        self._stream.close()

    def messages(self, channel_ids: Collection[int], start_ns: int, end_ns: int) -> Iterator[RawMessage]:
        """Messages of these channels with start_ns <= log time < end_ns, by log time, ties as they lie in the file.

        Memory holds one chunk, and those that overlap it in time. Where the whole file was asked for, the messages found are
        counted against the file's own statistics at the end."""
        seen: Counter[int] = Counter()
        chunked = self._chunked(channel_ids, start_ns, end_ns)
        loose = self._loose(channel_ids, start_ns, end_ns)
        for message in merge(chunked, loose, key=_log_time) if self.index.loose else chunked:
            seen[message.channel_id] += 1
            yield message
        if start_ns <= (self.index.first_ns or 0) and end_ns > (self.index.last_ns or 0):
            self._check_counts(seen, channel_ids)

    def chunk_messages(
        self, chunk: ChunkIndex, channel_ids: Collection[int], start_ns: int, end_ns: int
    ) -> list[RawMessage]:
        """The messages of one chunk, in file order, its checksum verified."""
        data = self._reader.chunk_data(chunk)
        where = f"the chunk at byte {chunk.chunk_start_offset}"
        found: list[RawMessage] = []
        for opcode, begin, end in self._reader.records(data, where):
            if opcode != Opcode.MESSAGE:
                continue
            if end - begin < MESSAGE_HEAD.size:
                raise self._reader.damaged(where, "a message record shorter than its own header")
            channel_id, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, begin)
            if not chunk.message_start_time <= log_time <= chunk.message_end_time:
                found_at = f"a message at {log_time} ns, outside the time range that the index gives"
                raise self._reader.damaged(where, found_at)
            if channel_id not in self.index.channels:
                raise self._reader.damaged(
                    where, f"a message of channel {channel_id}, which the file does not describe"
                )
            if channel_id in channel_ids and start_ns <= log_time < end_ns:
                found.append(RawMessage(log_time, publish_time, channel_id, data[begin + MESSAGE_HEAD.size : end]))
        return found

    def message_times(self, chunk_limit: int) -> dict[int, I64]:
        """Channel id -> log times [n] in file order, from the message indexes of the first `chunk_limit` chunks; no chunk is
        opened. A chunk that has no message indexes contributes nothing."""
        times: dict[int, list[I64]] = {}
        for chunk in self.index.chunks[:chunk_limit]:
            if chunk.message_index_offsets:
                for channel_id, values in self._indexed_times(chunk):
                    times.setdefault(channel_id, []).append(values)
        for message in sorted(self.index.loose, key=attrgetter("offset")):
            times.setdefault(message.channel_id, []).append(np.array([message.log_time_ns], np.int64))
        return {channel_id: np.concatenate(parts) for channel_id, parts in times.items()}

    def metadata(self) -> dict[str, dict[str, str]]:
        """Named metadata records; those of one name are joined, the later value winning."""
        joined: dict[str, dict[str, str]] = {}
        for entry in self.index.metadata:
            where = f"the metadata record at byte {entry.offset}"
            record = self._reader.bytes_at(entry.offset, entry.length, where)
            content = record[RECORD_HEAD.size :]
            if record[: RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.METADATA, len(content)):
                raise self._reader.damaged(where, "another record than the index says")
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
            raise self._reader.damaged("the data section", f"CRC {crc:08x} where {self.index.data_crc:08x} was written")

    def _chunked(self, channel_ids: Collection[int], start_ns: int, end_ns: int) -> Iterator[RawMessage]:
        wanted = [chunk for chunk in self.index.chunks if _overlaps(chunk, channel_ids, start_ns, end_ns)]
        pending: list[RawMessage] = []
        for chunk in sorted(wanted, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset)):
            ready = bisect_right(pending, chunk.message_start_time, key=_log_time)
            yield from pending[:ready]
            pending = pending[ready:]
            pending.extend(self.chunk_messages(chunk, channel_ids, start_ns, end_ns))
            pending.sort(key=_log_time)  # stable, and nearly in order already
        yield from pending

    def _loose(self, channel_ids: Collection[int], start_ns: int, end_ns: int) -> Iterator[RawMessage]:
        for log_time, channel_id, offset, length in self.index.loose:
            if channel_id in channel_ids and start_ns <= log_time < end_ns:
                content = self._reader.bytes_at(offset, length, "a message")
                publish_time = MESSAGE_HEAD.unpack_from(content)[3]
                yield RawMessage(log_time, publish_time, channel_id, content[MESSAGE_HEAD.size :])

    def _check_counts(self, seen: Counter[int], channel_ids: Collection[int]) -> None:
        counts = self.index.counts
        for channel_id in channel_ids:
            if counts is not None and counts[channel_id] != seen[channel_id]:
                found = f"{seen[channel_id]} messages where the file's own index counts {counts[channel_id]}"
                raise self._reader.damaged(f"topic {self.index.channels[channel_id].topic}", found)

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
                raise self._reader.damaged(where, "entries that do not fit their record")
            entries = np.frombuffer(section, "<i8", n_bytes // 8, begin + 6).reshape(-1, 2)  # (log time, offset)
            yield channel_id, entries[np.argsort(entries[:, 1], kind="stable"), 0].astype(np.int64)


def _overlaps(chunk: ChunkIndex, channel_ids: Collection[int], start_ns: int, end_ns: int) -> bool:
    if chunk.message_end_time < start_ns or chunk.message_start_time >= end_ns:
        return False
    return not chunk.message_index_offsets or not chunk.message_index_offsets.keys().isdisjoint(channel_ids)
