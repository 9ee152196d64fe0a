"""Writing a clean MCAP from what another log still gives: records are copied as bytes, indexes and statistics made anew.

Ids of schemas and channels stay as they were; only where a damaged file gives one id two meanings does the later one get a new id.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from vilp_data.errors import LogError
from vilp_data.sources.mcap_records import MAGIC, MESSAGE_HEAD, RECORD_HEAD

HIGHEST_ID = 0xFFFF  # of channels and schemas
CHUNK_BYTES = 1 << 20  # of rescued messages, which are packed anew

# Channel id -> (log time in ns, offset in the chunk) of each of its messages, in file order.
Entries = Mapping[int, Sequence[tuple[int, int]]]


class _Numbers:
    """Which id stands for what: the one that the source gave, where that stands for nothing else; else one from the top down, which
    recorders never reach. LogError where none is left."""

    def __init__(self) -> None:
        self._said: dict[int, Hashable] = {}
        self._ids: dict[Hashable, int] = {}
        self._next = HIGHEST_ID

    def of(self, wanted: int, said: Hashable) -> int:
        """The id of what is `said`."""
        if self._said.setdefault(wanted, said) == said:
            self._ids.setdefault(said, wanted)
            return wanted
        if said not in self._ids:
            while self._next in self._said:
                self._next -= 1
            if self._next < 1:
                remedy = "it is damaged or hostile beyond what can be told apart; look for another copy"
                raise LogError(
                    "more channels or schemas than an MCAP file can hold", found=f"above {HIGHEST_ID:,}", remedy=remedy
                )
            self._said[self._next] = said
            self._ids[said] = self._next
        return self._ids[said]


class CleanMcap:
    """A growing MCAP file. Call `start`, then the others in the order of the source, then `finish`."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._crc = 0
        self._position = 0
        self._buffer = bytearray()
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self._compressor = zstandard.ZstdCompressor()
        self._numbers, self._schema_numbers = _Numbers(), _Numbers()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._written: set[int] = set()  # channels that the file describes already
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self.counts: Counter[int] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0

    def start(self, profile: str, library: str) -> None:
        self._write(MAGIC)
        self._write_record(Header(profile, library))

    def describe(self, channel: Channel, schema: Schema | None) -> int:
        """Make a channel known, and its schema (None: it has none); returns the id that its messages bear in this file.

        LogError where there are more channels than MCAP has ids for."""
        schema_id = 0 if schema is None else self._schema_id(schema)
        said = (channel.topic, channel.message_encoding, tuple(sorted(channel.metadata.items())), schema_id)
        number = self._numbers.of(channel.id, said)
        if number not in self.channels:
            self.channels[number] = Channel(
                id=number,
                topic=channel.topic,
                message_encoding=channel.message_encoding,
                metadata=dict(channel.metadata),
                schema_id=schema_id,
            )
        return number

    def message(self, channel_id: int, content: bytes) -> None:
        """One message record's content; its channel id is replaced by `channel_id`, the rest copied."""
        (_, _, log_time, _) = MESSAGE_HEAD.unpack_from(content)
        self._make_known(channel_id)
        self._entries.setdefault(channel_id, []).append((log_time, len(self._buffer)))
        self._buffer += RECORD_HEAD.pack(Opcode.MESSAGE, len(content))
        self._buffer += struct.pack("<H", channel_id)
        self._buffer += memoryview(content)[2:]
        if len(self._buffer) >= CHUNK_BYTES:
            self._flush()

    def chunk(self, record: bytes, header: ChunkIndex, entries: Entries) -> None:
        """A whole chunk record as it is; `header` is what its own header says, `entries` what is in it."""
        self._flush()
        for channel_id in entries:
            self._make_known(channel_id)
        self._add_chunk(record, header, entries)

    def metadata(self, content: bytes, name: str) -> None:
        """A metadata record's content, copied."""
        self._flush()
        self._metadata.append(MetadataIndex(self._position, RECORD_HEAD.size + len(content), name))
        self._write(RECORD_HEAD.pack(Opcode.METADATA, len(content)))
        self._write(content)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A metadata record of our own."""
        builder = RecordBuilder()
        Metadata(name, dict(values)).write(builder)
        self.metadata(builder.end()[RECORD_HEAD.size :], name)

    def attachment(self, content: bytes, index: AttachmentIndex) -> None:
        """An attachment record's content; its CRC is written anew. `index` gives times, name, type and size."""
        self._flush()
        index.offset, index.length = self._position, RECORD_HEAD.size + len(content)
        self._attachments.append(index)
        body = memoryview(content)[:-4]
        self._write(RECORD_HEAD.pack(Opcode.ATTACHMENT, len(content)))
        self._write(body)
        self._write(struct.pack("<I", zlib.crc32(body)))

    def record(self, opcode: int, content: bytes) -> None:
        """A record of an application's own (opcode 0x80 and above), copied."""
        self._flush()
        self._write(RECORD_HEAD.pack(opcode, len(content)) + content)

    def finish(self) -> None:
        self._flush()
        for channel_id in self.channels:
            self._make_known(channel_id)
        self._write_record(DataEnd(self._crc))
        start = self._position
        summary = RecordBuilder()
        offsets: list[SummaryOffset] = []
        for opcode, group in self._groups():
            begin = summary.count
            for record in group:
                record.write(summary)
            if group:
                offsets.append(SummaryOffset(opcode, start + begin, summary.count - begin))
        offset_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        self._write(data)
        self._write_record(Footer(start, offset_start, zlib.crc32(head, zlib.crc32(data))))
        self._write(MAGIC)

    # --- inside

    def _groups(self) -> list[tuple[Opcode, Sequence[McapRecord]]]:
        """What the summary holds, in order."""
        return [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self._chunks),
            message_count=self.counts.total(),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self.schemas),
        )

    def _schema_id(self, schema: Schema) -> int:
        number = self._schema_numbers.of(schema.id, (schema.name, schema.encoding, schema.data))
        if number not in self.schemas:
            self.schemas[number] = Schema(id=number, name=schema.name, encoding=schema.encoding, data=schema.data)
        return number

    def _make_known(self, channel_id: int) -> None:
        """Describe a channel in the data section, before the first message of it."""
        if channel_id in self._written:
            return
        self._flush()
        channel = self.channels[channel_id]
        if channel.schema_id:
            self._write_record(self.schemas[channel.schema_id])
        self._write_record(channel)
        self._written.add(channel_id)

    def _flush(self) -> None:
        """Write the rescued messages that wait as a chunk."""
        if not self._entries:
            return
        data = bytes(self._buffer)
        packed = self._compressor.compress(data)
        times = [time for entries in self._entries.values() for time, _ in entries]
        builder = RecordBuilder()
        chunk = Chunk("zstd", packed, max(times), min(times), zlib.crc32(data), len(data))
        chunk.write(builder)
        record = builder.end()
        header = ChunkIndex(
            chunk_length=len(record), chunk_start_offset=0, compression="zstd", compressed_size=len(packed),
            message_end_time=max(times), message_index_length=0, message_index_offsets={}, message_start_time=min(times),
            uncompressed_size=len(data),
        )  # fmt: skip
        entries, self._entries, self._buffer = self._entries, {}, bytearray()
        self._add_chunk(record, header, entries)

    def _add_chunk(self, record: bytes, header: ChunkIndex, entries: Entries) -> None:
        header.chunk_start_offset, header.chunk_length, header.message_index_offsets = self._position, len(record), {}
        self._write(record)
        begin = self._position
        for channel_id, found in entries.items():
            header.message_index_offsets[channel_id] = self._position
            self._write_record(MessageIndex(channel_id, list(found)))
            self._count(channel_id, found)
        header.message_index_length = self._position - begin
        self._chunks.append(header)

    def _count(self, channel_id: int, found: Sequence[tuple[int, int]]) -> None:
        self.counts[channel_id] += len(found)
        first, last = min(time for time, _ in found), max(time for time, _ in found)
        self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
        self._last_ns = max(self._last_ns, last)

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, data: bytes | memoryview) -> None:
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)
