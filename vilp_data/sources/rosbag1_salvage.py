"""Every whole message of a damaged ROS 1 bag into a clean MCAP: bags without an index, cut off, or damaged in between.

Bags carry no checksums (bz2 apart): of a chunk that does not inflate to its end, messages up to the damage are suspicious; a changed
byte in an uncompressed chunk shows only where it breaks the structure.
"""

from __future__ import annotations

from array import array
from collections import Counter
from typing import NamedTuple

from mcap.records import Channel, Schema

from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import Inflated, inflate_prefix, largest_guess
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_records import MESSAGE_HEAD
from vilp_data.sources.rosbag1_records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    COMPRESSIONS,
    CONNECTION,
    INDEX,
    MAGIC,
    MESSAGE,
    OP,
    BagRecord,
    Bytes,
    Connection,
    bag_record,
    bytes_of,
    chunk_counts,
    connection_of,
    starts_before,
)

NO_SENSE = "no record makes sense here"
PACKED = {"bz2": b"BZh", "lz4": b"\x04\x22\x4d\x18"}


class _Chunk(NamedTuple):
    """A chunk's place in the file, and how far its data go: up to `end`; of the one that the recorder was still writing (`is_open`) no
    header says how far, nor what comes out."""

    record: BagRecord
    compression: str
    size: int
    end: int
    is_open: bool
    is_cut: bool


class _Waiting(NamedTuple):
    """Messages that nothing describes yet: where their records begin, in a chunk's data or (None) in the file."""

    chunk: _Chunk | None
    suspicious: bool
    places: array[int]


class Rosbag1Salvage:
    """One run over one bag. `run` writes to `clean` and fills `report`."""

    def __init__(self, source: FileBytes, clean: CleanMcap, report: SalvageReport, *, drop_suspicious: bool) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._drop = drop_suspicious
        self._connections: dict[int, Connection] = {}
        self._channels: dict[int, int] = {}  # connection -> channel of the clean file
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._waiting: list[_Waiting] = []
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
                self._report.lose(position, after, NO_SENSE)
            position = after
        self._write_waiting()
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
            self._report.lose(record.position, end, "a record that is cut off")
        elif record.op == CONNECTION:
            return record.end if self._define(record, self._source.at) else None
        elif record.op == MESSAGE:
            self._message(record, self._source.at, None, suspicious=False)
        elif record.op == BAG_HEADER:
            self._header(record)
        elif record.op == CHUNK_INFO:
            self._listed.update(chunk_counts(self._source.at(record.begin, record.end - record.begin)))
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
        """Note a connection; False where it cannot be read. The index repeats each; what contradicts takes its place from here on."""
        number = record.number(b"conn")
        if number > 0xFFFF or record.end - record.begin > limits.DEFINITION_BYTES:
            return False
        found = connection_of(record, at(record.begin, record.end - record.begin))
        if found is None or not found.topic:
            return False
        known = self._connections.get(number)
        if known is not None and known[:3] == found[:3]:
            return True
        if known is not None:
            said = f"as {known.topic} ({known.type}) and as {found.topic} ({found.type})"
            self._report.doubt(
                f"connection {number} is described twice, {said}: its messages are taken for what was said last before them"
            )
        schema_id = self._schemas.setdefault((found.type, found.definition), len(self._schemas) + 1)
        schema = Schema(id=schema_id, name=found.type, encoding="ros1msg", data=found.definition)
        channel = Channel(
            id=number, topic=found.topic, message_encoding="ros1", metadata=found.about, schema_id=schema_id
        )
        self._connections[number] = found
        self._channels[number] = self._clean.describe(channel, schema)
        return True

    # --- messages

    def _chunk(self, record: BagRecord) -> int | None:
        """Take a chunk's messages; where it ends, None where it is none."""
        chunk = self._chunk_of(record)
        if chunk is None:
            return None
        if max(chunk.size, chunk.end - record.begin) > limits.CHUNK_BYTES:
            self._report.lose(
                record.position, record.end, f"a chunk of {chunk.size:,} bytes, above VILP_MAX_CHUNK_BYTES"
            )
            return record.end
        data, fault = self._inflated(chunk)
        complete = self._records_in(chunk, data, suspicious=bool(fault) and not chunk.is_cut)
        if fault or not complete:
            self._report.amount_known = False
            what = "a chunk that is cut off" if chunk.is_cut else "a damaged chunk"
            came_out = f"{len(data):,}{'' if chunk.is_open else f' of {chunk.size:,}'} bytes inflate"
            why = f"; {fault}" if fault and not chunk.is_cut else ""
            self._report.doubt(f"byte {record.position:,}: {what}: {came_out}{why}")
        return chunk.end

    def _chunk_of(self, record: BagRecord) -> _Chunk | None:
        """How far a chunk's data go; None where it is packed in no known way."""
        compression = COMPRESSIONS.get(record.fields.get(b"compression", b""))
        if compression is None:
            return None
        if record.begin == record.end and self._source.at(record.begin, 4).startswith(PACKED.get(compression, b"\0")):
            # The recorder writes sizes when the chunk is done.
            self._report.note("the last chunk was still being written")
            size = largest_guess(self._source.size - record.begin)
            return _Chunk(record, compression, size, self._source.size, is_open=True, is_cut=True)
        end, is_cut = min(record.end, self._source.size), record.end > self._source.size
        return _Chunk(record, compression, record.number(b"size"), end, is_open=False, is_cut=is_cut)

    def _inflated(self, chunk: _Chunk) -> Inflated:
        packed = self._source.at(chunk.record.begin, chunk.end - chunk.record.begin)
        return inflate_prefix(packed, chunk.compression, chunk.size)

    def _records_in(self, chunk: _Chunk, data: bytes, *, suspicious: bool) -> bool:
        """Take the records of an inflated chunk; whether they follow each other to its end."""
        at = bytes_of(data)
        places = [] if chunk.is_cut else sorted(self._index_behind(chunk.record))
        position, complete = 0, True
        while position < len(data):
            record = bag_record(at, position)
            sensible = record is not None and record.op in (MESSAGE, CONNECTION) and record.end <= len(data)
            if record is not None and sensible and (record.op == MESSAGE or self._define(record, at)):
                if record.op == MESSAGE:
                    self._message(record, at, chunk, suspicious=suspicious)
                position = record.end
                continue
            complete = False
            following = next((place for place in places if place > position), None)
            if following is None and not places:
                following = _next_message(data, at, position + 1)
            if following is None or chunk.is_cut:
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

    def _message(self, record: BagRecord, at: Bytes, chunk: _Chunk | None, *, suspicious: bool) -> None:
        """Write a message, or keep its place until something describes its connection."""
        connection = record.number(b"conn")
        if connection not in self._channels:
            last = self._waiting[-1] if self._waiting else None
            if last is None or last.chunk is not chunk:
                last = _Waiting(chunk, suspicious, array("q"))
                self._waiting.append(last)
            last.places.append(record.position)
            return
        if record.end - record.begin > limits.RECORD_BYTES:
            self._report.lose(record.position, record.end, "a message above VILP_MAX_RECORD_BYTES")
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

    def _write_waiting(self) -> None:
        """Write the messages whose connection was described only further on, as in the index."""
        waiting, self._waiting = self._waiting, []
        for chunk, suspicious, places in waiting:
            at = self._source.at if chunk is None else bytes_of(self._inflated(chunk).data)
            for place in places:
                record = bag_record(at, place)
                if record is not None:
                    self._message(record, at, chunk, suspicious=suspicious)
        if self._waiting:
            count = sum(len(still.places) for still in self._waiting)
            self._report.amount_known = False
            self._report.doubt(f"{count:,} messages are left out: the records that say what they are are lost")

    # --- sums

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
