"""One chunk of a damaged MCAP file: copied as it is where it is whole, else what still inflates, message by message."""

from __future__ import annotations

import zlib
from collections import Counter

from mcap.records import ChunkIndex

from vilp_data import limits
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import largest_guess
from vilp_data.sources.mcap_chunk_records import ChunkContents, Entry, rescued_messages, walk_chunk
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_descriptions import Descriptions
from vilp_data.sources.mcap_hints import Hints, index_entries
from vilp_data.sources.mcap_message_writer import MessageWriter, inflated
from vilp_data.sources.mcap_plausible import ChunkHead, Record
from vilp_data.sources.mcap_records import LAST_NS


class ChunkSalvage:
    """Takes chunks one by one, as the walk through the file meets them."""

    def __init__(
        self,
        source: FileBytes,
        clean: CleanMcap,
        report: SalvageReport,
        descriptions: Descriptions,
        hints: Hints,
        writer: MessageWriter,
    ) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._descriptions = descriptions
        self._hints = hints
        self._writer = writer

    def take(self, record: Record, head: ChunkHead, *, mended: bool = False) -> int:
        """Write what the chunk gives; where its record ends. `mended`: its header is not the one in the file."""
        cut = head.data_end > self._source.size
        if max(head.size, head.data_end - head.data_begin) > limits.CHUNK_BYTES and not cut:
            what = f"a chunk of {head.size:,} bytes, above VILP_MAX_CHUNK_BYTES"
            self._report.lose(record.position, record.end, what)
            return record.end
        data, fault = inflated(self._source, head)
        if fault and not cut and (right := self._by_checksum(head, data)) is not None:
            data, fault, mended, head = right, "", True, head._replace(size=len(right))
            self._report.note(
                f"byte {record.position:,}: a chunk whose header or frame is damaged, its data are not; written anew"
            )
        contents = walk_chunk(data)
        crc_fails = not fault and bool(head.crc) and zlib.crc32(data) != head.crc
        suspicious = crc_fails or bool(fault and not cut)
        if fault or crc_fails or contents.end < len(data):
            self._rescue(record, head, data, contents, fault, suspicious=suspicious, cut=cut)
        else:
            self._copy(record, head, data, contents, mended=mended)
        return min(record.end, self._source.size)

    def _by_checksum(self, head: ChunkHead, data: bytes) -> bytes | None:
        """The chunk's data, where they are whole and only the size in its header, or the end of the frame, is damaged.

        `data`: what comes out up to that size."""
        if len(data) == head.size and head.crc:
            packed_size = head.data_end - head.data_begin
            data = inflated(self._source, head._replace(size=largest_guess(packed_size))).data
        return data if head.crc and zlib.crc32(data) == head.crc else None

    # --- whole

    def _copy(self, record: Record, head: ChunkHead, data: bytes, contents: ChunkContents, *, mended: bool) -> None:
        """A chunk that is as it was written: copied whole where every message of it can be, else message by message."""
        verified = bool(head.crc)
        agreed = True
        for opcode, begin, end in contents.definitions:
            agreed &= self._descriptions.define(opcode, data[begin:end], sure=verified)
        fits = not contents.entries or (contents.span() == (head.first_ns, head.last_ns) and head.last_ns <= LAST_NS)
        if not (agreed and fits and self._index_agrees(record.position, head)):
            self._report.note(
                f"byte {record.position:,}: a chunk whose header or index does not fit what is in it; written anew"
            )
        intact = verified or self._hints.data_is_intact is not False
        known = all(self._descriptions.out_id(channel_id) == channel_id for channel_id in contents.entries)
        if mended or not (
            agreed and fits and intact and known and self._descriptions.doubted.isdisjoint(contents.entries)
        ):
            self._writer.in_chunk(head, data, contents.places, suspicious=False, verified=verified)
            return
        if not contents.entries:
            return
        for channel_id, entries in contents.entries.items():
            times = [time for time, _ in entries]
            topic = self._report.topic(*self._descriptions.topic_of(channel_id))
            topic.add(min(times), max(times), len(times))
            vouched = (verified and channel_id not in self._descriptions.unsure) or self._hints.data_is_intact
            topic.unverified += 0 if vouched else len(times)
        index = ChunkIndex(
            chunk_length=0, chunk_start_offset=0, compression=head.compression, compressed_size=head.data_end - head.data_begin,
            message_end_time=head.last_ns, message_index_length=0, message_index_offsets={}, message_start_time=head.first_ns,
            uncompressed_size=head.size,
        )  # fmt: skip
        self._clean.chunk(self._source.at(record.position, head.data_end - record.position), index, contents.entries)

    def _index_agrees(self, position: int, head: ChunkHead) -> bool:
        """Whether the summary, if it lists chunks, says of this one what its header says."""
        if not self._hints.chunks:
            return True
        index = self._hints.chunks.get(position)
        return index is not None and (
            (index.message_start_time, index.message_end_time, index.uncompressed_size, index.compression)
            == (head.first_ns, head.last_ns, head.size, head.compression)
            and index.compressed_size == head.data_end - head.data_begin
        )

    # --- damaged

    def _rescue(
        self,
        record: Record,
        head: ChunkHead,
        data: bytes,
        contents: ChunkContents,
        fault: str,
        *,
        suspicious: bool,
        cut: bool,
    ) -> None:
        """What can be had of a chunk that is cut off or damaged."""
        index, _ = index_entries(self._source, record.end) if not cut else ({}, 0)
        for opcode, begin, end in contents.definitions:
            self._descriptions.define(opcode, data[begin:end], weak=suspicious)
        known = self._descriptions.channel_ids() | index.keys()
        span = (head.first_ns, head.last_ns)
        messages = list(rescued_messages(data, contents, index, known, span, suspicious=suspicious))
        self._writer.in_chunk(head, data, messages, suspicious=suspicious, verified=False)
        came_out = f"{len(data):,} of {head.size:,} bytes inflate"
        if cut:
            self._report.amount_known = False
            what = f"a chunk that is cut off: {came_out}"
        else:
            self._count_lost(messages, index)
            why = fault or ("its checksum fails" if suspicious else "its records do not follow each other")
            what = f"a damaged chunk: {came_out}; {why}"
        self._report.doubt(f"byte {record.position:,}: {what}")
        if not messages:
            self._report.skip(record.position, min(record.end, self._source.size), what)

    def _count_lost(self, messages: list[Entry], index: dict[int, list[tuple[int, int]]]) -> None:
        """What the message index behind a damaged chunk lists beyond what was got out of it."""
        if not index:
            self._report.amount_known = False
            return
        found = Counter(message.channel_id for message in messages)
        for channel_id, entries in index.items():
            missing = len(entries) - found[channel_id]
            if missing > 0:
                self._report.topic(*self._descriptions.topic_of(channel_id)).known_lost += missing
