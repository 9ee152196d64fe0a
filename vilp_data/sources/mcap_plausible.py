"""Whether bytes of a damaged MCAP file are a record, and where after damage the next one begins.

A record is believed alone only where a checksum says so; else a run of them must follow each other, up to the end of the file or for
a while. A run that ends in a footer with more of the file behind it is another log inside a message or an attachment: not this one's.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from vilp_data import limits
from vilp_data.sources import inflate
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_records import BROKEN, CHUNK_HEAD, MAGIC, MESSAGE_HEAD, RECORD_HEAD, StrictStream

COMPRESSIONS = (b"", b"lz4", b"zstd")
ENOUGH = 3  # records in a row that are believed without a checksum
LONGEST_RUN = 100_000  # records looked at to see where a run ends
# The first byte of a record, and a length below 2^40: looked at closely wherever it occurs.
_HEAD = re.compile(rb"(?=([\x02-\x0f].{5}\x00\x00\x00))", re.DOTALL)

_PARSERS = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata, Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.CHUNK_INDEX: ChunkIndex, Opcode.ATTACHMENT_INDEX: AttachmentIndex, Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics, Opcode.SUMMARY_OFFSET: SummaryOffset,
}  # fmt: skip


@dataclass(frozen=True)
class Record:
    """A record's place: its content lies at [begin, end), which may reach past the end of the file."""

    opcode: int
    position: int
    begin: int
    end: int


class ChunkHead(NamedTuple):
    """A chunk by its own header; its compressed data lie at [data_begin, data_end)."""

    first_ns: int
    last_ns: int
    size: int
    crc: int
    compression: str
    data_begin: int
    data_end: int


def record_at(source: FileBytes, position: int) -> Record | None:
    """The record whose head lies here; None where fewer bytes than a head are left."""
    head = source.at(position, RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack(head)
    begin = position + RECORD_HEAD.size
    return Record(opcode, position, begin, begin + length)


def parsed(opcode: int, content: bytes) -> Any:
    """The record by the mcap library's parser, None where the content does not fit it from first to last byte."""
    stream = StrictStream(content)
    try:
        record = _PARSERS[Opcode(opcode)].read(stream)
    except BROKEN:
        return None
    return record if stream.count == len(content) else None


def chunk_head(source: FileBytes, position: int, *, end: int | None = None) -> ChunkHead | None:
    """The chunk whose record begins here, whatever its opcode and length say; None where its header makes no sense.

    `end`: where its data end, if that is known better than by its header."""
    head = source.at(position, CHUNK_HEAD.size + 12)
    if len(head) < CHUNK_HEAD.size + 8:
        return None
    _, _, first, last, size, crc, name_length = CHUNK_HEAD.unpack_from(head)
    if name_length > 4 or (name := head[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length]) not in COMPRESSIONS:
        return None
    at = CHUNK_HEAD.size + name_length
    if first > last or len(head) < at + 8:
        return None
    data_begin = position + at + 8
    packed_size = int.from_bytes(head[at : at + 8], "little") if end is None else end - data_begin
    if not name and packed_size != size:
        if end is None:
            return None
        size = packed_size
    if packed_size < 0 or max(size, packed_size) > 1 << 40:
        return None
    return ChunkHead(first, last, size, crc, name.decode(), data_begin, data_begin + packed_size)


def chunk_is_intact(source: FileBytes, head: ChunkHead) -> bool:
    """Whether a chunk inflates to what its checksum says (or, without one, to what its size says)."""
    if head.data_end > source.size or max(head.size, head.data_end - head.data_begin) > limits.CHUNK_BYTES:
        return False
    try:
        data = inflate.inflate(source.at(head.data_begin, head.data_end - head.data_begin), head.compression, head.size)
    except ValueError:
        return False
    return not head.crc or zlib.crc32(data) == head.crc


def attachment_index(content: bytes) -> AttachmentIndex | None:
    """What an attachment record says of itself; None where its parts do not fill it."""
    stream = StrictStream(content)
    try:
        log_time, create_time = stream.read8(), stream.read8()
        name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
        size = stream.read8()
    except BROKEN:
        return None
    if stream.count + size + 4 != len(content):
        return None
    return AttachmentIndex(
        offset=0, length=0, log_time=log_time, create_time=create_time, data_size=size, name=name, media_type=media_type
    )


def attachment_is_intact(content: bytes) -> bool:
    (crc,) = struct.unpack("<I", content[-4:])
    return not crc or zlib.crc32(memoryview(content)[:-4]) == crc


def is_sensible(source: FileBytes, record: Record, channels: Collection[int]) -> bool:
    """Whether a record's content fits its kind. Of a record that the end of the file cuts, as far as it goes."""
    length = record.end - record.begin
    if record.opcode == Opcode.CHUNK:
        head = chunk_head(source, record.position)
        return head is not None and head.data_end == record.end
    if record.opcode == Opcode.MESSAGE:
        content = source.at(record.begin, MESSAGE_HEAD.size)
        return length >= MESSAGE_HEAD.size == len(content) and MESSAGE_HEAD.unpack(content)[0] in channels
    if record.opcode == Opcode.FOOTER:
        return length == 20 and source.at(record.end, len(MAGIC)) == MAGIC
    if record.opcode == Opcode.DATA_END:
        return length == 4 and record.end <= source.size
    if record.end > source.size or length > limits.RECORD_BYTES:
        return False
    content = source.at(record.begin, length)
    if record.opcode == Opcode.ATTACHMENT:
        return attachment_index(content) is not None and attachment_is_intact(content)
    return record.opcode in _PARSERS and parsed(record.opcode, content) is not None


def is_run(source: FileBytes, position: int, channels: Collection[int]) -> tuple[bool, int]:
    """Whether records begin here that are believed; and, where they are another log's, the byte after that log (else 0)."""
    count, strong, here = 0, False, position
    while count < LONGEST_RUN:
        record = record_at(source, here)
        if record is None:
            return (count > 0 and here <= source.size) or strong, 0
        if not is_sensible(source, record, channels):
            return strong or count >= ENOUGH, 0
        count += 1
        if record.opcode == Opcode.FOOTER:
            behind = source.at(record.end + len(MAGIC), len(MAGIC))
            theirs = bool(behind.strip(b"\0")) and behind != MAGIC
            return not theirs, record.end + len(MAGIC) if theirs else 0
        if record.end > source.size:
            return strong or count > 1 or record.opcode == Opcode.CHUNK, 0
        if count == 1 and record.opcode == Opcode.CHUNK:
            head = chunk_head(source, record.position)
            strong = head is not None and bool(head.crc) and chunk_is_intact(source, head)
        here = record.end
    return True, 0


def next_run(source: FileBytes, position: int, channels: Collection[int], chunk_places: Collection[int] | None) -> int:
    """The first byte after `position` at which records begin that are believed; the file's end where there is none.

    `chunk_places`: where a verified index says that chunks are; no chunk is then believed elsewhere."""
    record = record_at(source, position)
    inside_only = record is not None and 0 < record.opcode < 0x10 and record.position < record.end < source.size
    if record is not None and inside_only and is_run(source, record.end, channels)[0]:
        return record.end
    believed_after = position + 1
    while believed_after < source.size:
        for place, _ in source.matches(_HEAD, believed_after, longest=RECORD_HEAD.size):
            found = record_at(source, place)
            if found is None or not is_sensible(source, found, channels):
                continue
            if found.opcode == Opcode.CHUNK and chunk_places is not None and place not in chunk_places:
                continue
            believed, behind = is_run(source, place, channels)
            if believed:
                return place
            if behind:
                believed_after = behind
                break
        else:
            return source.size
    return source.size
