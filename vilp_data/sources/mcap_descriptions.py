"""What the messages and chunks of a damaged MCAP file are, from whatever part of the file still says so."""

from __future__ import annotations

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_hints import Hints
from vilp_data.sources.mcap_plausible import ChunkHead, chunk_head, is_run, parsed, record_at
from vilp_data.sources.mcap_records import CHUNK_HEAD


class Descriptions:
    """Schemas and channels: those met on the way, else the summary's; in the end those of damaged chunks too.

    A verified summary outranks what lies further up. `unsure`: channels described outside all checksums; `doubted`: only where a
    checksum fails."""

    def __init__(self, hints: Hints, clean: CleanMcap, report: SalvageReport) -> None:
        self._hints = hints
        self._clean = clean
        self._report = report
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._weak_schemas: dict[int, Schema] = {}  # from chunks whose checksum fails: believed where nothing else is
        self._weak_channels: dict[int, Channel] = {}
        self._out: dict[int, int] = {}  # channel id here -> its id in the clean file
        self.unsure: set[int] = set()
        self.doubted: set[int] = set()
        self._all_seen = False

    def believe_damaged_chunks(self) -> None:
        """Every description there is has been seen: what damaged chunks alone describe is taken from there."""
        self._all_seen = True

    def channel_ids(self) -> set[int]:
        return self._channels.keys() | self._hints.channels.keys() | self._weak_channels.keys()

    def define(self, opcode: int, content: bytes, *, weak: bool = False, sure: bool = False) -> bool:
        """Note a schema or a channel; False where it cannot be read, or a verified summary says otherwise.

        `weak`: from a chunk whose checksum fails; `sure`: from one whose checksum is right."""
        found = parsed(opcode, content)
        if found is None:
            return False
        trusted = self._hints.schemas if opcode == Opcode.SCHEMA else self._hints.channels
        if self._hints.verified and trusted.get(found.id, found) != found:
            return False
        if opcode == Opcode.SCHEMA:
            (self._weak_schemas if weak else self._schemas)[found.id] = found
        elif weak:
            self._weak_channels[found.id] = found
        else:
            self._define_channel(found, sure=sure or self._hints.verified or bool(self._hints.data_is_intact))
        return True

    def _define_channel(self, channel: Channel, *, sure: bool) -> None:
        is_new = self._channels.get(channel.id) != channel
        if sure:
            self.unsure.discard(channel.id)
        elif is_new:
            self.unsure.add(channel.id)
        if is_new:
            self._channels[channel.id] = channel
            self._out.pop(channel.id, None)

    def out_id(self, channel_id: int) -> int | None:
        """The channel's id in the clean file; None where nothing (yet) describes it."""
        if channel_id in self._out:
            return self._out[channel_id]
        channel = self._channels.get(channel_id) or self._hints.channels.get(channel_id)
        schemas = self._hints.schemas | self._schemas
        if self._all_seen:
            schemas = self._weak_schemas | schemas
            if channel is None and channel_id in self._weak_channels:
                channel = self._weak_channels[channel_id]
                self.doubted.add(channel_id)
        if channel is None:
            return None
        schema = schemas.get(channel.schema_id)
        if channel.schema_id and schema is None:
            if not self._all_seen:
                return None
            lost = f"{channel.topic}: its schema is lost; its messages are kept, and nothing says how to read them"
            self._report.doubt(lost)
        self._out[channel_id] = self._clean.describe(channel, schema)
        return self._out[channel_id]

    def topic_of(self, channel_id: int) -> tuple[str, str]:
        """Names of the topic and the schema."""
        out = self.out_id(channel_id)
        if out is None:
            return f"(channel {channel_id}, of which nothing tells the topic)", ""
        channel = self._clean.channels[out]
        return channel.topic, self._clean.schemas[channel.schema_id].name if channel.schema_id else ""


def recovered_chunk_head(source: FileBytes, position: int, hints: Hints, channels: set[int]) -> ChunkHead | None:
    """The chunk whose record's head or header is damaged: by a verified index, by the size in its header though its length is
    damaged, or by its length though the size is. None where nothing tells."""
    index = hints.chunks.get(position) if hints.verified else None
    if index is not None:
        head = source.at(position, CHUNK_HEAD.size)
        crc = CHUNK_HEAD.unpack(head)[5] if len(head) == CHUNK_HEAD.size else 0
        begin = position + CHUNK_HEAD.size + len(index.compression.encode()) + 8
        end = begin + index.compressed_size
        times = index.message_start_time, index.message_end_time
        return ChunkHead(*times, index.uncompressed_size, crc, index.compression, begin, end)
    found = chunk_head(source, position)
    if (
        found is not None
        and found.data_begin < found.data_end <= source.size
        and (found.data_end == source.size or is_run(source, found.data_end, channels)[0])
    ):
        return found
    record = record_at(source, position)
    if record is None or record.opcode != Opcode.CHUNK or record.end > source.size:
        return None
    if record.end < source.size and not is_run(source, record.end, channels)[0]:
        return None
    return chunk_head(source, position, end=record.end)
