"""Every whole message of a damaged ROS 1 bag into a clean MCAP: bags without an index, cut off, or damaged in between.

Bags carry no checksums (bz2 apart): of a chunk that does not inflate to its end, messages up to the damage are suspicious; a changed
byte in an uncompressed chunk shows only where it breaks the structure.
"""

from __future__ import annotations

from collections import Counter

from mcap.records import Channel, Schema

from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import inflate_prefix
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_records import MESSAGE_HEAD
from vilp_data.sources.rosbag1_file import COMPRESSIONS, MAGIC
from vilp_data.sources.rosbag1_records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    INDEX,
    MESSAGE,
    OP,
    BagRecord,
    Bytes,
    bag_record,
    header_fields,
    starts_before,
)

NO_SENSE = "no record makes sense here"
PACKED = {"bz2": b"BZh", "lz4": b"\x04\x22\x4d\x18"}


class Rosbag1Salvage:
    """One run over one bag. `run` writes to `clean` and fills `report`."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport, *, drop_suspicious: bool) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._drop = drop_suspicious
        self._channels: dict[int, int] = {}  # connection -> channel of the clean file
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._waiting: list[tuple[BagRecord, set[int]]] = []
        self._only: set[int] | None = None
        self._listed: Counter[int] = Counter()  # messages by connection, as the index's chunk infos count them
        self._chunk_infos = 0
        self._expected_infos: int | None = None

    def run(self) -> None:
        self._clean.start("ros1", "")
        head = self._source.at(0, len(MAGIC))
        if head != MAGIC:
            self._report.note(f"the first line is damaged: {head!r} instead of {MAGIC!r}")
        position = len(MAGIC)
        while position < self._source.size:
            record = bag_record(self._source.at, position)
            if record is None or (after := self._take(record)) is None:
                after = self._next_run(position)
                self._lose(position, after)
            position = after
        self._second_look()
        self._conclude()

    # --- the walk

    def _take(self, record: BagRecord) -> int | None:
        """Take a record for what it is worth; where the next one begins."""
        end = min(record.end, self._source.size)
        if record.op == CHUNK:
            return self._chunk(record)
        if record.end > self._source.size:
            if self._next_run(record.position) < self._source.size:
                return None
            self._lose(record.position, end, "a record that is cut off")
        elif record.op == CONNECTION:
            return record.end if self._define(record, self._source.at) else None
        elif record.op == MESSAGE:
            self._message(record, self._source.at, suspicious=False)
        elif record.op == BAG_HEADER:
            self._header(record)
        elif record.op == CHUNK_INFO:
            counts = self._source.at(record.begin, record.end - record.begin)
            for place in range(0, len(counts) - 7, 8):
                self._listed[int.from_bytes(counts[place : place + 4], "little")] += int.from_bytes(
                    counts[place + 4 : place + 8], "little"
                )
            self._chunk_infos += 1
        return end

    def _header(self, record: BagRecord) -> None:
        if record.fields.get(b"encryptor"):
            remedy = "decrypt it with `rosbag decrypt`, where ROS 1 is installed"
            raise LogError("the bag is encrypted", where=self._source.path, remedy=remedy)
        if record.number(b"index_pos"):
            self._expected_infos = record.number(b"chunk_count")
        else:
            self._report.note("the bag has no index: the recorder was stopped before it wrote one")

    def _next_run(self, position: int) -> int:
        """The first byte after `position` at which records begin that follow each other; the end of the file where none do."""
        record = bag_record(self._source.at, position)
        if record is not None and position < record.end < self._source.size and self._is_run(record.end):
            return record.end
        for place, _ in self._source.matches(OP, position + 1, longest=8):
            for start in starts_before(self._source.at, place, position + 1):
                if self._is_run(start):
                    return start
        return self._source.size

    def _is_run(self, position: int) -> bool:
        first = bag_record(self._source.at, position)
        if first is None:
            return False
        if first.end >= self._source.size:
            return first.op == CHUNK or first.end == self._source.size
        return bag_record(self._source.at, first.end) is not None

    # --- connections

    def _define(self, record: BagRecord, at: Bytes) -> bool:
        """Note a connection; False where it cannot be read."""
        connection = record.number(b"conn")
        if connection in self._channels:
            return True
        if record.end - record.begin > limits.DEFINITION_BYTES:
            return False
        fields = header_fields(at(record.begin, record.end - record.begin))
        if fields is None or b"type" not in fields:
            return False
        try:
            name, topic = fields[b"type"].decode(), record.fields.get(b"topic", fields.get(b"topic", b"")).decode()
            said = {
                key.decode(): value.decode()
                for key, value in fields.items()
                if key in (b"md5sum", b"callerid", b"latching")
            }
        except UnicodeDecodeError:
            return False
        if not topic or connection > 0xFFFF:
            return False
        definition = fields.get(b"message_definition", b"")
        schema_id = self._schemas.setdefault((name, definition), len(self._schemas) + 1)
        schema = Schema(id=schema_id, name=name, encoding="ros1msg", data=definition)
        channel = Channel(id=connection, topic=topic, message_encoding="ros1", metadata=said, schema_id=schema_id)
        self._channels[connection] = self._clean.describe(channel, schema)
        return True

    # --- messages

    def _chunk(self, record: BagRecord) -> int | None:
        compression = COMPRESSIONS.get(record.fields.get(b"compression", b""))
        if compression is None:
            return None
        size, begin, end = record.number(b"size"), record.begin, record.end
        if begin == end and self._source.at(begin, 4).startswith(PACKED.get(compression, b"\0")):
            end, size = self._source.size, limits.CHUNK_BYTES  # the recorder writes sizes when the chunk is done
            self._report.note("the last chunk was still being written")
        cut = end > self._source.size or size == limits.CHUNK_BYTES
        if max(size, min(end, self._source.size) - begin) > limits.CHUNK_BYTES:
            self._lose(record.position, end, f"a chunk of {size:,} bytes, above VILP_MAX_CHUNK_BYTES")
            return end
        end = min(end, self._source.size)
        data, fault = inflate_prefix(self._source.at(begin, end - begin), compression, size)
        complete = self._records_in(record, data, cut=cut, suspicious=bool(fault) and not cut)
        if (fault or not complete) and self._only is None:
            self._report.amount_known = False
            what = "a chunk that is cut off" if cut else "a damaged chunk"
            self._report.doubt(
                f"byte {record.position:,}: {what}: {len(data):,} of {size:,} bytes inflate"
                + (f"; {fault}" if fault and not cut else "")
            )
        return end

    def _records_in(self, chunk: BagRecord, data: bytes, *, cut: bool, suspicious: bool) -> bool:
        """Take the records of an inflated chunk; whether they follow each other to its end."""

        def at(offset: int, length: int) -> bytes:
            return data[offset : offset + length]

        places = sorted(self._index_behind(chunk)) if not cut else []
        position, complete = 0, True
        while position < len(data):
            record = bag_record(at, position)
            sensible = record is not None and record.op in (MESSAGE, CONNECTION) and record.end <= len(data)
            if record is not None and sensible and (record.op == MESSAGE or self._define(record, at)):
                if record.op == MESSAGE:
                    self._message(record, at, suspicious=suspicious, chunk=chunk)
                position = record.end
                continue
            complete = False
            following = next((place for place in places if place > position), None)
            if following is None and not places:
                following = _next_message(data, at, position + 1)
            if following is None or cut:
                break
            position = following
        return complete

    def _index_behind(self, chunk: BagRecord) -> set[int]:
        """Offsets in the chunk at which its index records say that messages lie."""
        places: set[int] = set()
        record = bag_record(self._source.at, chunk.end)
        while record is not None and record.op == INDEX and record.end <= self._source.size:
            entries = self._source.at(record.begin, record.end - record.begin)
            places.update(int.from_bytes(entries[i + 8 : i + 12], "little") for i in range(0, len(entries) - 11, 12))
            record = bag_record(self._source.at, record.end)
        return places

    def _message(self, record: BagRecord, at: Bytes, *, suspicious: bool, chunk: BagRecord | None = None) -> None:
        connection = record.number(b"conn")
        if self._only is not None and connection not in self._only:
            return
        if connection not in self._channels:
            if not self._waiting or self._waiting[-1][0] is not (chunk or record):
                self._waiting.append((chunk or record, set()))
            self._waiting[-1][1].add(connection)
            return
        if record.end - record.begin > limits.RECORD_BYTES:
            self._lose(record.position, record.end, "a message above VILP_MAX_RECORD_BYTES")
            return
        if suspicious and self._drop:
            self._report.suspicious_left_out += 1
            return
        channel_id, time_ns = self._channels[connection], record.time_ns()
        channel = self._clean.channels[channel_id]
        topic = self._report.topic(channel.topic, self._clean.schemas[channel.schema_id].name)
        topic.add(time_ns, time_ns, 1)
        topic.suspicious += suspicious
        topic.unverified += not suspicious
        data = at(record.begin, record.end - record.begin)
        self._clean.message(channel_id, MESSAGE_HEAD.pack(channel_id, 0, time_ns, time_ns) + data)

    def _second_look(self) -> None:
        """Messages whose connection was described only further on, as in the index."""
        waiting, self._waiting = self._waiting, []
        doubts, notes, skipped = list(self._report.doubts), list(self._report.notes), list(self._report.skipped)
        for record, connections in waiting:
            self._only = connections
            self._chunk(record) if record.op == CHUNK else self._message(record, self._source.at, suspicious=False)
        self._only = None
        self._report.doubts[:], self._report.notes[:], self._report.skipped[:] = doubts, notes, skipped
        if lost := sorted({connection for _, connections in self._waiting for connection in connections}):
            self._report.amount_known = False
            numbers = ", ".join(map(str, lost))
            self._report.doubt(
                f"messages of connection {numbers} are left out: the record that says what they are is lost"
            )

    # --- sums

    def _lose(self, begin: int, end: int, what: str = NO_SENSE) -> None:
        self._report.skip(begin, end, what)
        self._report.amount_known = False
        self._report.doubt("bytes are missing or unreadable")

    def _conclude(self) -> None:
        report = self._report
        if self._expected_infos is not None and self._chunk_infos == self._expected_infos:
            report.ended = True
            expected: Counter[str] = Counter()
            for connection, count in self._listed.items():
                known = connection in self._channels
                name = self._clean.channels[self._channels[connection]].topic if known else f"(connection {connection})"
                expected[name] += count
            report.expected = dict(expected)
        else:
            report.doubt("the bag has no whole index: what the recorder had not written yet is not in it")
        report.settle()


def _next_message(data: bytes, at: Bytes, position: int) -> int | None:
    """Where in a chunk messages go on, after damage at `position`; None where they do not."""
    for match in OP.finditer(data, position):
        for start in starts_before(at, match.start(), position):
            record = bag_record(at, start)
            if record is None or record.op not in (MESSAGE, CONNECTION) or record.end > len(data):
                continue
            if record.end == len(data) or bag_record(at, record.end) is not None:
                return start
    return None
