"""What is in an MCAP file and where: from the summary that its writer left, or by reading the file once.

The summary is believed only after its CRC, and only where it suffices to find every message; else the file is scanned, its
data CRC checked on the way. Either way a reader gets the same `McapIndex`.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, MetadataIndex, Schema, Statistics

from vilp_data.errors import LogError, copy_or_salvage, number_of
from vilp_data.sources.mcap_loose import FileRecord, LooseRun, LooseRuns, file_records
from vilp_data.sources.mcap_records import CHUNK_HEAD, LAST_NS, MAGIC, MESSAGE_HEAD, RECORD_HEAD, RecordReader

FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary_start, summary_offset_start, summary_crc
TAIL_SIZE = FOOTER.size + len(MAGIC)
DATA_END = struct.Struct("<BQI")  # opcode, length, data_section_crc


@dataclass
class McapIndex:
    """Schemas and channels by id; chunks and metadata by place; `loose`: the messages outside all chunks, in runs.

    `counts` (channel id -> messages), and the log times of the first and the last message, are None where nothing tells them.
    The data section ends at byte `data_end`; its CRC is 0 where none was written."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    loose: list[LooseRun] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None
    counts: Counter[int] | None = None
    first_ns: int | None = None
    last_ns: int | None = None
    data_end: int = 0
    data_crc: int = 0

    def count(self, counts: Counter[int], first_ns: int, last_ns: int) -> None:
        """Note messages found by scanning, and the log times between which they lie."""
        self.counts = Counter() if self.counts is None else self.counts
        self.counts.update(counts)
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(self.last_ns, last_ns)


def read_index(reader: RecordReader) -> McapIndex:
    """The index of a file; LogError where the file is cut off, or its summary is damaged."""
    tail = b""
    if reader.size >= len(MAGIC) + TAIL_SIZE:
        tail = reader.bytes_at(reader.size - TAIL_SIZE, TAIL_SIZE, "the footer")
    if not tail.endswith(MAGIC):
        raise _cut_off(reader)
    opcode, length, summary_start, _, crc = FOOTER.unpack_from(tail)
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - RECORD_HEAD.size):
        raise reader.damaged("the footer", f"record {opcode:#04x} of {length} bytes")
    footer_start = reader.size - TAIL_SIZE
    if summary_start > footer_start:
        raise reader.damaged("the footer", f"a summary at byte {summary_start}, past the footer at {footer_start}")
    summary = _summary(reader, summary_start, footer_start, crc) if summary_start else None
    if summary is not None and _suffices(summary, reader, summary_start):
        index = _counted(summary, reader)
    else:
        index = _from_scan(reader)
        _refuse_other_counts(index, summary, reader)
    times = [index.last_ns or 0, *(run.last_ns for run in index.loose)]
    if (latest := max(times)) > LAST_NS:
        raise reader.damaged("its times", f"a message at {latest} ns, past the year 2262")
    index.data_end, index.data_crc = _data_end(reader, summary_start or footer_start)
    return index


def _data_end(reader: RecordReader, after: int) -> tuple[int, int]:
    """(offset, CRC) of the DataEnd record, which ends at byte `after`."""
    offset = after - DATA_END.size
    opcode, length, crc = DATA_END.unpack(reader.bytes_at(offset, DATA_END.size, "the end of the data section"))
    return (offset, crc) if (opcode, length) == (Opcode.DATA_END, DATA_END.size - RECORD_HEAD.size) else (offset, 0)


# --- from the summary -----------------------------------------------------------------------------------------------


def _summary(reader: RecordReader, start: int, footer_start: int, crc: int) -> McapIndex:
    """What the writer left at the end of the file."""
    section = reader.bytes_at(start, footer_start - start, "the summary")
    footer = reader.bytes_at(footer_start, FOOTER.size - 4, "the footer")  # the CRC covers all but itself
    if crc and zlib.crc32(footer, zlib.crc32(section)) != crc:
        raise reader.damaged("the summary", "its checksum does not match")
    index = McapIndex()
    for opcode, begin, end in reader.records(section, "the summary"):
        _add(index, reader, opcode, section[begin:end], "the summary")
    return index


def _suffices(index: McapIndex, reader: RecordReader, data_end: int) -> bool:
    """Whether every message can be found by a summary."""
    return _describes_channels(index) and _reaches_all(index) and _gaps_are_read(index, reader, data_end)


def _counted(index: McapIndex, reader: RecordReader) -> McapIndex:
    """A summary that suffices, with its counts and its span."""
    statistics = index.statistics
    if statistics is None:
        index.counts = _counts_by_message_index(index, reader)
        for run in index.loose:
            index.counts += run.counts
    elif statistics.channel_message_counts or not statistics.message_count:
        index.counts = Counter(statistics.channel_message_counts)
        if (total := sum(index.counts.values())) != statistics.message_count:
            found = f"{total} messages by its channels, {statistics.message_count} in all"
            raise reader.damaged("the statistics", found)
    index.first_ns, index.last_ns = _span(index)
    return index


def _span(index: McapIndex) -> tuple[int | None, int | None]:
    """Log times of the first and the last message, as wide as anything in the summary tells: rosbag2's rewriter leaves statistics
    that begin after its first chunk does."""
    statistics = index.statistics
    spans = [(run.first_ns, run.last_ns) for run in index.loose]
    # A chunk without messages claims a time of zero.
    spans += [
        (chunk.message_start_time, chunk.message_end_time)
        for chunk in index.chunks
        if chunk.message_index_offsets or chunk.message_end_time
    ]
    if statistics is not None and statistics.message_count:
        spans.append((statistics.message_start_time, statistics.message_end_time))
    return min((first for first, _ in spans), default=None), max((last for _, last in spans), default=None)


def _describes_channels(index: McapIndex) -> bool:
    """Whether every channel that chunks speak of, and every schema that channels speak of, is in the summary."""
    spoken_of = {channel_id for chunk in index.chunks for channel_id in chunk.message_index_offsets}
    schema_ids = {channel.schema_id for channel in index.channels.values()} - {0}
    return spoken_of <= index.channels.keys() and schema_ids <= index.schemas.keys()


def _reaches_all(index: McapIndex) -> bool:
    """Whether the summary's chunks and metadata are no fewer than its statistics count."""
    statistics = index.statistics
    if statistics is None:
        return bool(index.chunks) and all(chunk.message_index_offsets for chunk in index.chunks)
    chunks = not statistics.message_count or (bool(index.chunks) and statistics.chunk_count == len(index.chunks))
    metadata = statistics.metadata_count <= len(index.metadata)
    return (
        chunks and metadata and statistics.channel_count <= len(index.channels)
    )  # libmcap leaves unused ones uncounted


def _gaps_are_read(index: McapIndex, reader: RecordReader, data_end: int) -> bool:
    """Find the messages that lie between the indexed chunks; False where a chunk lies there that the summary does not list."""
    position, loose = len(MAGIC), LooseRuns()
    ends = [
        (c.chunk_start_offset, c.chunk_start_offset + c.chunk_length + c.message_index_length) for c in index.chunks
    ]
    for gap_end, after in [*sorted(ends), (data_end, data_end)]:
        for record in file_records(reader, position, gap_end, whole=False):
            if record.opcode == Opcode.CHUNK:
                return False
            if record.opcode == Opcode.MESSAGE:
                loose.add(reader, record)
            position = record.end
        if position != gap_end:
            raise reader.damaged(f"byte {position}", f"a record that runs into what begins at byte {gap_end}")
        loose.close()
        position = after
    index.loose = loose.runs
    return True


def _counts_by_message_index(index: McapIndex, reader: RecordReader) -> Counter[int]:
    counts: Counter[int] = Counter()
    for chunk in index.chunks:
        for channel_id, offset in chunk.message_index_offsets.items():
            head = reader.bytes_at(offset, RECORD_HEAD.size, "a message index")
            counts[channel_id] += (RECORD_HEAD.unpack(head)[1] - 6) // 16
    return counts


def _add(index: McapIndex, reader: RecordReader, opcode: int, content: bytes, where: str) -> None:
    if opcode == Opcode.SCHEMA:
        schema = reader.parse(Schema.read, content, where)
        index.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = reader.parse(Channel.read, content, where)
        index.channels[channel.id] = channel
    elif opcode == Opcode.CHUNK_INDEX:
        index.chunks.append(reader.parse(ChunkIndex.read, content, where))
    elif opcode == Opcode.METADATA_INDEX:
        index.metadata.append(reader.parse(MetadataIndex.read, content, where))
    elif opcode == Opcode.STATISTICS:
        index.statistics = reader.parse(Statistics.read, content, where)


# --- from the whole file --------------------------------------------------------------------------------------------


def _from_scan(reader: RecordReader) -> McapIndex:
    """Index a file by reading all of it, its data CRC checked on the way."""
    index, loose = McapIndex(counts=Counter()), LooseRuns()
    crc = zlib.crc32(MAGIC)
    for record in file_records(reader, len(MAGIC), reader.size, whole=True):
        if record.opcode == Opcode.FOOTER:
            break
        if record.opcode == Opcode.DATA_END:
            content = record.content()
            expected = struct.unpack_from("<I", content)[0] if len(content) >= 4 else 0
            if expected and expected != crc:
                raise reader.damaged("the data section", f"CRC {crc:08x} where {expected:08x} was written")
            break
        if record.opcode == Opcode.MESSAGE:
            loose.add(reader, record)
        elif record.opcode == Opcode.CHUNK:
            loose.close()
            _scan_chunk(index, reader, record)
        elif record.opcode == Opcode.METADATA:
            length = record.end - record.position
            index.metadata.append(MetadataIndex(offset=record.position, length=length, name=""))
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _add(index, reader, record.opcode, record.content(), f"byte {record.position}")
        crc = zlib.crc32(memoryview(record.window)[record.begin : record.begin + record.end - record.position], crc)
    loose.close()
    index.loose = loose.runs
    for run in loose.runs:
        index.count(run.counts, run.first_ns, run.last_ns)
    _check_described(index, reader)
    return index


def _scan_chunk(index: McapIndex, reader: RecordReader, record: FileRecord) -> None:
    where = f"the chunk at byte {record.position}"
    chunk = reader.chunk_index_of(record.whole(), record.position)
    data = reader.chunk_data(chunk)
    times: list[int] = []
    counts: Counter[int] = Counter()
    for opcode, begin, end in reader.records(data, where):
        if opcode == Opcode.MESSAGE and end - begin >= MESSAGE_HEAD.size:
            channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, begin)
            times.append(log_time)
            counts[channel_id] += 1
        else:
            _add(index, reader, opcode, data[begin:end], where)
    if times and (min(times), max(times)) != (chunk.message_start_time, chunk.message_end_time):
        raise reader.damaged(where, "its messages do not lie in the time range that its header gives")
    if times:
        index.count(counts, min(times), max(times))
    index.chunks.append(chunk)


def _refuse_other_counts(index: McapIndex, summary: McapIndex | None, reader: RecordReader) -> None:
    """LogError where the writer counted other than as many messages as were found: most files without chunks have no checksum."""
    found = sum((index.counts or {}).values())
    if summary is not None and summary.statistics is not None and summary.statistics.message_count != found:
        stated = summary.statistics.message_count
        raise reader.damaged("the data section", f"{found} messages where the file's own statistics count {stated}")


def _check_described(index: McapIndex, reader: RecordReader) -> None:
    for channel_id in index.counts or ():
        if channel_id not in index.channels:
            raise reader.damaged("its channels", f"messages of channel {channel_id}, which the file does not describe")
    for channel in index.channels.values():
        if channel.schema_id and channel.schema_id not in index.schemas:
            raise reader.damaged(f"topic {channel.topic}", f"its schema {channel.schema_id} is not in the file")


def _cut_off(reader: RecordReader) -> LogError:
    """The error for a file without an end, saying how much of it is intact."""
    position, chunks, first_ns, last_ns = len(MAGIC), 0, 1 << 64, 0
    while position + RECORD_HEAD.size <= reader.size:
        opcode, length = RECORD_HEAD.unpack(reader.bytes_at(position, RECORD_HEAD.size, "a record"))
        if position + RECORD_HEAD.size + length > reader.size:
            break
        if opcode == Opcode.CHUNK and length >= CHUNK_HEAD.size:
            start, end = struct.unpack("<QQ", reader.bytes_at(position + RECORD_HEAD.size, 16, "a chunk"))
            chunks, first_ns, last_ns = chunks + 1, min(first_ns, start), max(last_ns, end)
        position += RECORD_HEAD.size + length
    intact = f"whole records up to byte {min(position, reader.size):,} of {reader.size:,}"
    held = f"{number_of(chunks, 'chunk')}, {(last_ns - first_ns) / 1e9:.1f} s of messages"
    held = held if chunks else "no whole chunk; of one that is cut a part can be had"
    return LogError(
        "the log is cut off: the recorder was stopped, or a copy did not finish",
        where=reader.path,
        found=f"no end mark; {intact} ({held})",
        remedy=copy_or_salvage(reader.path),
    )
