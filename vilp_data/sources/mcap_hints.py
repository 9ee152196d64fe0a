"""What the summary of a damaged MCAP file still tells: descriptions that were lost further up, counts, places of chunks."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from vilp_data import limits
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_index import DATA_END, FOOTER, TAIL_SIZE
from vilp_data.sources.mcap_plausible import parsed
from vilp_data.sources.mcap_records import MAGIC, RECORD_HEAD

BLOCK = 1 << 20


@dataclass
class Hints:
    """`verified`: the summary's own checksum holds. `chunks` by place; `data_is_intact`: what the data section's checksum says, None
    where there is none to ask."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    counts: Counter[int] | None = None
    attachment_count: int | None = None
    metadata_count: int | None = None
    verified: bool = False
    footer_found: bool = False
    damaged: bool = False
    data_is_intact: bool | None = None

    def clear(self) -> None:
        """Forget all of it: what follows is another log."""
        self.__dict__.update(Hints().__dict__)

    @property
    def chunk_places(self) -> set[int] | None:
        return set(self.chunks) if self.verified and self.chunks else None


def read_hints(source: FileBytes) -> Hints:
    """The summary, if the file still has it; nothing in it is believed where its checksum fails."""
    hints = Hints()
    tail = source.at(source.size - TAIL_SIZE, TAIL_SIZE) if source.size >= TAIL_SIZE + len(MAGIC) else b""
    if not tail.endswith(MAGIC):
        return hints
    opcode, length, start, _, crc = FOOTER.unpack_from(tail)
    footer = source.size - TAIL_SIZE
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - RECORD_HEAD.size):
        return hints
    hints.footer_found = True
    hints.data_is_intact = data_is_intact(source, min(start or footer, footer))
    if not start:
        return hints
    if not len(MAGIC) <= start <= footer or footer - start > limits.RECORD_BYTES:
        hints.damaged = True
        return hints
    section = source.at(start, footer - start)
    if crc and zlib.crc32(tail[: FOOTER.size - 4], zlib.crc32(section)) != crc:
        hints.damaged = True
        return hints
    read = _read_section(section)
    if read is None:
        hints.damaged = True
        return hints
    read.footer_found, read.data_is_intact, read.verified = True, hints.data_is_intact, bool(crc)
    return read


def data_is_intact(source: FileBytes, data_end: int) -> bool | None:
    """Whether the data section, whose last record ends at byte `data_end`, has the checksum that it says; None where it says none."""
    opcode, length, crc = DATA_END.unpack(
        source.at(data_end - DATA_END.size, DATA_END.size).ljust(DATA_END.size, b"\0")
    )
    if (opcode, length) != (Opcode.DATA_END, 4) or not crc:
        return None
    found, end = 0, data_end - DATA_END.size
    for begin in range(0, end, BLOCK):
        found = zlib.crc32(source.at(begin, min(BLOCK, end - begin)), found)
    return bool(found == crc)


def _read_section(section: bytes) -> Hints | None:
    hints, position = Hints(), 0
    while position < len(section):
        if position + RECORD_HEAD.size > len(section):
            return None
        opcode, length = RECORD_HEAD.unpack_from(section, position)
        begin, position = position + RECORD_HEAD.size, position + RECORD_HEAD.size + length
        if position > len(section):
            return None
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.STATISTICS):
            continue
        record = parsed(opcode, section[begin:position])
        if record is None:
            return None
        if opcode == Opcode.SCHEMA:
            hints.schemas[record.id] = record
        elif opcode == Opcode.CHANNEL:
            hints.channels[record.id] = record
        elif opcode == Opcode.CHUNK_INDEX:
            hints.chunks[record.chunk_start_offset] = record
        else:
            counts = Counter(record.channel_message_counts)
            hints.counts = counts if counts.total() == record.message_count else None
            hints.attachment_count, hints.metadata_count = record.attachment_count, record.metadata_count
    return hints


def index_entries(source: FileBytes, position: int) -> tuple[dict[int, list[tuple[int, int]]], int]:
    """Channel -> (log time, offset) of each message of the chunk whose message indexes lie here, and where they end."""
    entries: dict[int, list[tuple[int, int]]] = {}
    while True:
        head = source.at(position, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return entries, position
        opcode, length = RECORD_HEAD.unpack(head)
        end = position + RECORD_HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or end > source.size or length > limits.RECORD_BYTES or length < 6:
            return entries, position
        content = source.at(position + RECORD_HEAD.size, length)
        channel_id, n_bytes = struct.unpack_from("<HI", content)
        if n_bytes % 16 or n_bytes + 6 != length:
            return entries, position
        pairs = struct.unpack(f"<{n_bytes // 8}Q", content[6:])
        entries.setdefault(channel_id, []).extend(zip(pairs[::2], pairs[1::2], strict=True))
        position = end
