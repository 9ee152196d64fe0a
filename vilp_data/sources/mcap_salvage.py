"""Every whole message of a damaged MCAP file, in file order, into a clean one.

The file is walked record by record. Where a record makes no sense, the walk goes on at the next place where records do
(`mcap_plausible`). A chunk that is whole and passes its checksum is copied as it is; of one that is cut off or damaged, what still
inflates is read message by message. Messages whose channel is described only further on, or only in the summary, wait for it.
"""

from __future__ import annotations

import zlib
from collections import Counter
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Header

from vilp_data import limits
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import inflate_prefix
from vilp_data.sources.mcap_chunk_records import ChunkContents, Entry, rescued_messages, walk_chunk
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_descriptions import Descriptions, told_chunk
from vilp_data.sources.mcap_hints import Hints, data_is_intact, index_entries, read_hints
from vilp_data.sources.mcap_plausible import (
    ChunkHead,
    Record,
    attachment_index,
    attachment_is_intact,
    chunk_head,
    is_run,
    next_run,
    parsed,
    record_at,
)
from vilp_data.sources.mcap_records import LAST_NS, MAGIC, MESSAGE_HEAD, RECORD_HEAD

NO_SENSE = "no record makes sense here"
SUMMARY = (
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)


class _Waiting(NamedTuple):
    """Messages of these channels, in the record that begins at `position`, wait until something describes their channel."""

    position: int
    channels: frozenset[int]


class McapSalvage:
    """One run over one file. `run` writes to `clean` and fills `report`; it raises nothing for damage."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport, *, drop_suspicious: bool) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._drop = drop_suspicious
        self._hints: Hints = read_hints(source)
        self._said = Descriptions(self._hints, clean, report)
        self._waiting: list[_Waiting] = []
        self._only: frozenset[int] | None = None  # in the second look: the channels that were waited for
        self._data_ended = False
        self._longest = 0  # of the records that lie in the file whole

    # --- the walk

    def run(self) -> None:
        position = self._begin()
        while position < self._source.size:
            after = self._take(position)
            if after is None:
                after = next_run(self._source, position, self._known(), self._hints.chunk_places)
                self._lose(position, after, NO_SENSE)
            position = after
        self._second_look()
        self._conclude()

    def _begin(self) -> int:
        """Past the magic and the header record; the clean file is started."""
        magic = self._source.at(0, len(MAGIC))
        position = len(MAGIC)
        if magic != MAGIC:
            if not is_run(self._source, position, ())[0] and self._header_at(position) is None:
                position = next_run(self._source, 0, self._known(), self._hints.chunk_places)
            self._report.note(f"the first mark is damaged: {magic!r} instead of {MAGIC!r}")
            if position > len(MAGIC):
                self._lose(0, position, NO_SENSE)
        header = self._header_at(position)
        self._clean.start(header.profile if header else self._profile(), header.library if header else "")
        if header is None and magic == MAGIC:
            self._report.note("the header record is damaged or missing: the profile is not known")
        return position

    def _header_at(self, position: int) -> Header | None:
        record = record_at(self._source, position)
        if record is None or record.opcode != Opcode.HEADER or record.end > self._source.size:
            return None
        content = self._source.at(record.begin, min(record.end - record.begin, 1 << 16))
        header: Header | None = parsed(Opcode.HEADER, content)
        return header

    def _profile(self) -> str:
        encodings = {schema.encoding for schema in self._hints.schemas.values()}
        return "ros2" if encodings == {"ros2msg"} else "ros1" if encodings == {"ros1msg"} else ""

    def _take(self, position: int) -> int | None:
        """Take the record at `position` for what it is worth; where the next one begins, or None where this is no record."""
        record = record_at(self._source, position)
        if record is None:
            self._cut(position, "the end of the file cuts off a record's first bytes")
            return self._source.size
        if record.opcode == Opcode.CHUNK:
            head = chunk_head(self._source, position)
            return self._chunk(record, head) if head and head.data_end == record.end else self._mended_chunk(position)
        if self._data_ended and record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, *SUMMARY):
            return record.end if record.end <= self._source.size else self._summary_cut(record)
        if record.opcode == Opcode.FOOTER:
            return self._footer(record)
        if not 0 < record.opcode < 0x10 and record.opcode < 0x80:
            return self._mended_chunk(position)
        if record.end > self._source.size:
            return self._cut_record(record)
        after = self._whole_record(record)
        if after is not None:
            self._longest = max(self._longest, record.end - record.begin)
        return after

    def _whole_record(self, record: Record) -> int | None:
        """A record other than a chunk that lies in the file whole."""
        length = record.end - record.begin
        if record.opcode == Opcode.MESSAGE:
            return self._loose_message(record)
        if length > limits.RECORD_BYTES:
            self._lose(record.position, record.end, f"a record of {length:,} bytes, above VILP_MAX_RECORD_BYTES")
            return record.end
        content = self._source.at(record.begin, length)
        if record.opcode == Opcode.DATA_END:
            return self._data_end(record)
        if record.opcode == Opcode.ATTACHMENT:
            return self._attachment(record, content)
        if record.opcode == Opcode.METADATA:
            return self._metadata(record, content)
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            return record.end if self._said.define(record.opcode, content) else None
        if record.opcode == Opcode.MESSAGE_INDEX:
            return record.end if parsed(Opcode.MESSAGE_INDEX, content) is not None else None
        if record.opcode == Opcode.HEADER:
            return record.end if parsed(Opcode.HEADER, content) is not None else None
        if record.opcode in SUMMARY:
            return record.end if parsed(record.opcode, content) is not None else None
        self._clean.record(record.opcode, content)
        return record.end

    # --- ends

    def _cut(self, position: int, what: str) -> None:
        self._lose(position, self._source.size, what)

    def _summary_cut(self, record: Record) -> int:
        self._report.skip(record.position, self._source.size, "an index that is cut off")
        return self._source.size

    def _cut_record(self, record: Record) -> int | None:
        """A record whose length reaches past the end: the end of the file cuts it, or its length is damaged."""
        content = self._source.at(record.begin, MESSAGE_HEAD.size)
        known = self._known()
        is_message = record.opcode == Opcode.MESSAGE and len(content) == MESSAGE_HEAD.size
        if is_message and MESSAGE_HEAD.unpack(content)[0] not in known:
            return None
        # The end cuts it, or its length is damaged. What lies inside may look like records (a log in an attachment): so they are
        # looked for only where the file has its end, or no record so far was remotely as long.
        absurd = record.end - record.begin > max(1 << 16, 4 * self._longest)
        if self._hints.footer_found or absurd:
            after = next_run(self._source, record.position, known, self._hints.chunk_places)
            if after < self._source.size:
                return None
        if record.opcode == Opcode.ATTACHMENT:
            self._report.attachments_lost += 1
            self._lose(record.position, self._source.size, "an attachment that is cut off", messages=False)
        else:
            self._cut(record.position, "a record that is cut off")
        return self._source.size

    def _data_end(self, record: Record) -> int | None:
        if record.end - record.begin != 4:
            return None
        if self._hints.data_is_intact is None:
            self._hints.data_is_intact = data_is_intact(self._source, record.end)
        self._data_ended = self._report.ended = True
        return record.end

    def _footer(self, record: Record) -> int | None:
        end = record.end + len(MAGIC)
        if (
            record.end - record.begin != 20
            or self._source.at(record.end, len(MAGIC)) != MAGIC[: self._source.size - record.end]
        ):
            return None
        self._data_ended = self._report.ended = True
        if end >= self._source.size:
            return self._source.size
        if self._source.at(end, len(MAGIC)) == MAGIC:
            self._report.note(f"another log follows in the same file, at byte {end:,}: its messages are taken too")
            self._report.doubt("several logs in one file, whose counts cannot be checked")
            self._data_ended = self._report.ended = False
            self._hints = Hints()
            return end + len(MAGIC)
        self._report.skip(end, self._source.size, "bytes behind the log's end")
        self._report.note(f"{self._source.size - end:,} bytes behind the log's end belong to no log")
        return self._source.size

    def _known(self) -> set[int]:
        return self._said.channel_ids()

    # --- messages outside chunks

    def _loose_message(self, record: Record) -> int | None:
        length = record.end - record.begin
        if length < MESSAGE_HEAD.size:
            return None
        if length > limits.RECORD_BYTES:
            self._lose(record.position, record.end, f"a message of {length:,} bytes, above VILP_MAX_RECORD_BYTES")
            return record.end
        content = self._source.at(record.begin, length)
        channel_id = MESSAGE_HEAD.unpack_from(content)[0]
        if self._said.out_id(channel_id) is None:
            if (
                channel_id not in self._known()
                and not is_run(self._source, record.end, self._known() | {channel_id})[0]
            ):
                return None
            self._wait(record.position, {channel_id})
            return record.end
        self._write(channel_id, content, suspicious=self._hints.data_is_intact is False, verified=False)
        return record.end

    def _write(self, channel_id: int, content: bytes, *, suspicious: bool, verified: bool) -> None:
        out = self._said.out_id(channel_id)
        assert out is not None  # callers ask first
        suspicious = suspicious or channel_id in self._said.doubted
        verified = verified and channel_id not in self._said.unsure
        if suspicious and self._drop:
            self._report.suspicious_left_out += 1
            return
        topic = self._report.topic(*self._said.topic_of(channel_id))
        log_time = MESSAGE_HEAD.unpack_from(content)[2]
        if log_time > LAST_NS:
            topic.known_lost += 1
            self._report.doubt("messages past the year 2262 are left out: their times are damaged")
            return
        topic.add(log_time, log_time, 1)
        topic.suspicious += suspicious
        topic.unverified += not (suspicious or verified or self._hints.data_is_intact)
        self._clean.message(out, content)

    # --- chunks

    def _mended_chunk(self, position: int) -> int | None:
        """A chunk whose record head or header is damaged, where a verified index or the rest of its header tells what it is."""
        head = told_chunk(self._source, position, self._hints, self._known())
        if head is None:
            return None
        self._report.note(f"the head of the chunk at byte {position:,} is damaged, and was told from the rest")
        return self._chunk(
            Record(Opcode.CHUNK, position, position + RECORD_HEAD.size, head.data_end), head, mended=True
        )

    def _chunk(self, record: Record, head: ChunkHead, *, mended: bool = False) -> int:
        cut = head.data_end > self._source.size
        if max(head.size, head.data_end - head.data_begin) > limits.CHUNK_BYTES and not cut:
            self._lose(record.position, record.end, f"a chunk of {head.size:,} bytes, above VILP_MAX_CHUNK_BYTES")
            return record.end
        packed_size = min(head.data_end, self._source.size) - head.data_begin
        whole_record = self._source.at(
            record.position, head.data_begin - record.position + min(packed_size, limits.CHUNK_BYTES)
        )
        packed = whole_record[head.data_begin - record.position :]
        data, fault = inflate_prefix(packed, head.compression, min(head.size, limits.CHUNK_BYTES))
        if fault and not cut and head.crc:  # its size may be what is damaged
            other = inflate_prefix(packed, head.compression, limits.CHUNK_BYTES).data
            if zlib.crc32(other) == head.crc:
                data, fault, head, mended = other, "", head._replace(size=len(other)), True
                self._report.note(
                    f"byte {record.position:,}: a chunk whose header or frame is damaged, its data are not; written anew"
                )
        contents = walk_chunk(data)
        crc_fails = not fault and bool(head.crc) and zlib.crc32(data) != head.crc
        suspicious = crc_fails or bool(fault and not cut) or (not head.crc and self._hints.data_is_intact is False)
        if fault or crc_fails or contents.end < len(data):
            self._rescue(record, head, data, fault, suspicious=suspicious, cut=cut)
        else:
            self._copy(record, head, whole_record, contents, data, suspicious=suspicious, mended=mended)
        return min(record.end, self._source.size)

    def _copy(
        self,
        record: Record,
        head: ChunkHead,
        whole: bytes,
        contents: ChunkContents,
        data: bytes,
        *,
        suspicious: bool,
        mended: bool,
    ) -> None:
        """A chunk that is as it was written: copied whole where every message of it can be, else message by message."""
        agreed = [
            self._said.define(opcode, data[begin:end], sure=bool(head.crc))
            for opcode, begin, end in contents.definitions
        ]
        fits = not contents.entries or (contents.span() == (head.first_ns, head.last_ns) and head.last_ns <= LAST_NS)
        if not (all(agreed) and fits and self._index_agrees(record.position, head)):
            self._report.note(
                f"byte {record.position:,}: a chunk whose header or index does not fit what is in it; written anew"
            )
        plain = self._only is None and all(agreed) and fits and not suspicious and not mended
        plain = plain and self._said.doubted.isdisjoint(contents.entries)
        plain = plain and all(self._said.out_id(channel_id) == channel_id for channel_id in contents.entries)
        if not plain:
            self._write_all(record.position, data, contents.places, suspicious=suspicious, verified=bool(head.crc))
            return
        if not contents.entries:
            return
        for channel_id, entries in contents.entries.items():
            times = [time for time, _ in entries]
            topic = self._report.topic(*self._said.topic_of(channel_id))
            topic.add(min(times), max(times), len(times))
            sure = (head.crc and channel_id not in self._said.unsure) or self._hints.data_is_intact
            topic.unverified += 0 if sure else len(times)
        index = ChunkIndex(
            chunk_length=0, chunk_start_offset=0, compression=head.compression, compressed_size=head.data_end - head.data_begin,
            message_end_time=head.last_ns, message_index_length=0, message_index_offsets={}, message_start_time=head.first_ns,
            uncompressed_size=head.size,
        )  # fmt: skip
        self._clean.chunk(whole, index, contents.entries)

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

    def _rescue(self, record: Record, head: ChunkHead, data: bytes, fault: str, *, suspicious: bool, cut: bool) -> None:
        """What can be had of a chunk that is cut off or damaged."""
        index, _ = index_entries(self._source, record.end) if not cut else ({}, 0)
        contents = walk_chunk(data)
        for opcode, begin, end in contents.definitions:
            self._said.define(opcode, data[begin:end], weak=suspicious)
        known = self._known() | index.keys()
        span = (head.first_ns, head.last_ns)
        messages = list(rescued_messages(data, contents, index, known, span, suspicious=suspicious))
        self._write_all(record.position, data, messages, suspicious=suspicious, verified=False)
        if self._only is not None:
            return
        end = min(record.end, self._source.size)
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
            self._report.skip(record.position, end, what)

    def _count_lost(self, messages: list[Entry], index: dict[int, list[tuple[int, int]]]) -> None:
        """What the message index behind a damaged chunk lists beyond what was got out of it."""
        if not index:
            self._report.amount_known = False
            return
        found = Counter(message.channel_id for message in messages)
        for channel_id, entries in index.items():
            missing = len(entries) - found[channel_id]
            if missing > 0:
                self._report.topic(*self._said.topic_of(channel_id)).known_lost += missing

    def _write_all(
        self, position: int, data: bytes, messages: list[Entry], *, suspicious: bool, verified: bool
    ) -> None:
        orphans: set[int] = set()
        for channel_id, begin, end in messages:
            if self._only is not None and channel_id not in self._only:
                continue
            if self._said.out_id(channel_id) is None:
                orphans.add(channel_id)
                continue
            self._write(channel_id, data[begin:end], suspicious=suspicious, verified=verified)
        if orphans:
            self._wait(position, orphans)

    # --- what had to wait

    def _wait(self, position: int, channels: set[int]) -> None:
        self._waiting.append(_Waiting(position, frozenset(channels)))

    def _second_look(self) -> None:
        """Take what waited for a description, now that every one there is has been seen."""
        waiting, self._waiting = self._waiting, []
        self._said.last_chance = True
        doubts, notes, skipped = list(self._report.doubts), list(self._report.notes), list(self._report.skipped)
        for position, channels in waiting:
            self._only = channels
            self._take(position)
            self._only = None
        self._report.doubts[:] = doubts + [text for text in self._report.doubts if "schema is lost" in text]
        self._report.notes[:], self._report.skipped[:] = notes, skipped
        for _, channels in self._waiting:
            self._report.amount_known = False
            numbers = ", ".join(str(channel_id) for channel_id in sorted(channels))
            self._report.doubt(
                f"messages of channel {numbers} are left out: the record that says what they are is lost"
            )

    # --- beside messages

    def _attachment(self, record: Record, content: bytes) -> int | None:
        index = attachment_index(content)
        if index is None:
            self._report.attachments_lost += 1
            return None
        if not attachment_is_intact(content):
            if self._drop:
                self._report.attachments_lost += 1
                self._lose(
                    record.position, record.end, f"attachment {index.name!r}, whose checksum fails", messages=False
                )
                return record.end
            self._report.attachments_suspicious += 1
            self._report.doubt(f"attachment {index.name!r}: its checksum fails")
        self._report.attachments += 1
        self._clean.attachment(content, index)
        return record.end

    def _metadata(self, record: Record, content: bytes) -> int | None:
        found = parsed(Opcode.METADATA, content)
        if found is None:
            return None
        self._report.metadata_records += 1
        self._clean.metadata(content, found.name)
        return record.end

    # --- sums

    def _lose(self, begin: int, end: int, what: str, *, messages: bool = True) -> None:
        """Bytes that gave nothing, in the part of the file that holds messages; behind it they only held the index."""
        self._report.skip(begin, end, what)
        if messages and not self._data_ended:
            self._report.amount_known = False
            self._report.doubt("bytes are missing or unreadable where the log keeps its messages")

    def _conclude(self) -> None:
        report, hints = self._report, self._hints
        if hints.counts is not None and (hints.verified or hints.footer_found):
            expected: Counter[str] = Counter()
            for channel_id, count in hints.counts.items():
                expected[self._said.topic_of(channel_id)[0]] += count
            report.expected = dict(expected)
            report.ended = True
        if hints.attachment_count is not None:
            report.attachments_lost = max(0, hints.attachment_count - report.attachments)
        if hints.metadata_count is not None and report.metadata_records < hints.metadata_count:
            report.doubt(f"{hints.metadata_count - report.metadata_records} metadata records are lost")
        if hints.data_is_intact is False and not report.doubts:
            report.doubt("the checksum over the whole log fails: descriptions or metadata may have changed")
        if not report.ended:
            report.doubt("the log has no end: what its recorder had not written yet is not in it")
        if hints.damaged:
            report.note("its index is damaged, and was made anew")
        elif not hints.footer_found:
            report.note("its index is missing, and was made")
        if hints.data_is_intact:
            for topic in report.topics.values():
                topic.unverified = 0
        report.settle()
