"""Every whole message of a damaged MCAP file, in file order, into a clean one.

The file is walked record by record. Where a record makes no sense, the walk goes on at the next place where records do
(`mcap_plausible`). A chunk that is whole and passes its checksum is copied as it is; of one that is cut off or damaged, what still
inflates is read message by message. Messages whose channel is described only further on, or only in the summary, wait for it.
"""

from __future__ import annotations

from collections import Counter

from mcap.opcode import Opcode
from mcap.records import Header

from vilp_data import limits
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.mcap_chunk_salvage import ChunkSalvage
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_descriptions import Descriptions, recovered_chunk_head
from vilp_data.sources.mcap_hints import data_is_intact, read_hints
from vilp_data.sources.mcap_message_writer import MessageWriter
from vilp_data.sources.mcap_plausible import (
    Record,
    attachment_index,
    attachment_is_intact,
    chunk_head,
    is_run,
    next_run,
    parsed,
    record_at,
)
from vilp_data.sources.mcap_records import MAGIC, MESSAGE_HEAD, RECORD_HEAD

NO_SENSE = "no record makes sense here"
SUMMARY = (
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)


class McapSalvage:
    """One run over one file. `run` writes to `clean` and fills `report`; it raises nothing for damage."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport, *, drop_suspicious: bool) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._drop = drop_suspicious
        self._hints = read_hints(source)
        self._descriptions = Descriptions(self._hints, clean, report)
        self._writer = MessageWriter(
            source, clean, report, self._descriptions, self._hints, drop_suspicious=drop_suspicious
        )
        self._chunks = ChunkSalvage(source, clean, report, self._descriptions, self._hints, self._writer)
        self._longest = 0  # of the records that lie in the file whole

    # --- the walk

    def run(self) -> None:
        position = self._begin()
        while position < self._source.size:
            after = self._take(position)
            if after is None:
                after = next_run(self._source, position, self._known(), self._hints.chunk_places)
                self._report.lose(position, after, NO_SENSE)
            position = after
        self._writer.write_waiting()
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
                self._report.lose(0, position, NO_SENSE)
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
            self._report.lose(position, self._source.size, "the end of the file cuts off a record's first bytes")
            return self._source.size
        if record.opcode == Opcode.CHUNK:
            head = chunk_head(self._source, position)
            return (
                self._chunks.take(record, head)
                if head and head.data_end == record.end
                else self._mended_chunk(position)
            )
        if self._report.ended and record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, *SUMMARY):
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
            self._report.lose(record.position, record.end, f"a record of {length:,} bytes, above VILP_MAX_RECORD_BYTES")
            return record.end
        content = self._source.at(record.begin, length)
        if record.opcode == Opcode.DATA_END:
            return self._data_end(record)
        if record.opcode == Opcode.ATTACHMENT:
            return self._attachment(record, content)
        if record.opcode == Opcode.METADATA:
            return self._metadata(record, content)
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            return record.end if self._descriptions.define(record.opcode, content) else None
        if record.opcode == Opcode.MESSAGE_INDEX:
            return record.end if parsed(Opcode.MESSAGE_INDEX, content) is not None else None
        if record.opcode == Opcode.HEADER:
            return record.end if parsed(Opcode.HEADER, content) is not None else None
        if record.opcode in SUMMARY:
            return record.end if parsed(record.opcode, content) is not None else None
        self._clean.record(record.opcode, content)
        return record.end

    # --- ends

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
            self._report.lose(record.position, self._source.size, "an attachment that is cut off", messages=False)
        else:
            self._report.lose(record.position, self._source.size, "a record that is cut off")
        return self._source.size

    def _data_end(self, record: Record) -> int | None:
        if record.end - record.begin != 4:
            return None
        if self._hints.data_is_intact is None:
            self._hints.data_is_intact = data_is_intact(self._source, record.end)
        self._report.ended = True
        return record.end

    def _footer(self, record: Record) -> int | None:
        end = record.end + len(MAGIC)
        if (
            record.end - record.begin != 20
            or self._source.at(record.end, len(MAGIC)) != MAGIC[: self._source.size - record.end]
        ):
            return None
        self._report.ended = True
        if end >= self._source.size:
            return self._source.size
        if self._source.at(end, len(MAGIC)) == MAGIC:
            self._report.note(f"another log follows in the same file, at byte {end:,}: its messages are taken too")
            self._report.doubt("several logs in one file, whose counts cannot be checked")
            self._report.ended = False
            self._hints.clear()
            return end + len(MAGIC)
        self._report.skip(end, self._source.size, "bytes behind the log's end")
        self._report.note(f"{self._source.size - end:,} bytes behind the log's end belong to no log")
        return self._source.size

    def _known(self) -> set[int]:
        return self._descriptions.channel_ids()

    # --- messages outside chunks

    def _loose_message(self, record: Record) -> int | None:
        length = record.end - record.begin
        if length < MESSAGE_HEAD.size:
            return None
        if length > limits.RECORD_BYTES:
            self._report.lose(
                record.position, record.end, f"a message of {length:,} bytes, above VILP_MAX_RECORD_BYTES"
            )
            return record.end
        content = self._source.at(record.begin, length)
        channel_id = MESSAGE_HEAD.unpack_from(content)[0]
        described = self._descriptions.out_id(channel_id) is not None or channel_id in self._known()
        if not described and not is_run(self._source, record.end, self._known() | {channel_id})[0]:
            return None
        self._writer.loose(record.begin, content)
        return record.end

    # --- chunks

    def _mended_chunk(self, position: int) -> int | None:
        """A chunk whose record head or header is damaged, where a verified index or the rest of its header tells what it is."""
        head = recovered_chunk_head(self._source, position, self._hints, self._known())
        if head is None:
            return None
        self._report.note(f"the head of the chunk at byte {position:,} is damaged, and was told from the rest")
        return self._chunks.take(
            Record(Opcode.CHUNK, position, position + RECORD_HEAD.size, head.data_end), head, mended=True
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
                self._report.lose(
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

    def _conclude(self) -> None:
        report, hints = self._report, self._hints
        if hints.counts is not None and (hints.verified or hints.footer_found):
            expected: Counter[str] = Counter()
            for channel_id, count in hints.counts.items():
                expected[self._descriptions.topic_of(channel_id)[0]] += count
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
