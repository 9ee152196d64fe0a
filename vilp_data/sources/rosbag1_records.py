"""Records of a ROS 1 bag, in a file or in an inflated chunk, whole or damaged (http://wiki.ros.org/Bags/Format/2.0). Pure."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

MAGIC = b"#ROSBAG V2.0\n"
COMPRESSIONS = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
LARGEST_HEADER = 1 << 20  # bytes; the text of a definition lies in the data, not here
FURTHEST_BACK = 4096  # bytes from a record's start to its `op`
NEEDED = {
    MESSAGE: {b"conn": 4, b"time": 8},
    BAG_HEADER: {b"index_pos": 8, b"conn_count": 4, b"chunk_count": 4},
    INDEX: {b"conn": 4, b"count": 4},
    CHUNK: {b"size": 4},
    CHUNK_INFO: {b"chunk_pos": 8, b"start_time": 8, b"end_time": 8, b"count": 4},
    CONNECTION: {b"conn": 4},
}
OP = re.compile(rb"\x04\x00\x00\x00op=[\x02-\x07]")

# (offset, length) -> up to that many bytes.
Bytes = Callable[[int, int], bytes]


class BagRecord(NamedTuple):
    """A record: its header's fields, and where its data lie; `end` may reach past the end of the bytes."""

    op: int
    fields: dict[bytes, bytes]
    position: int
    begin: int
    end: int

    def number(self, name: bytes) -> int:
        return int.from_bytes(self.fields[name], "little")

    def time_ns(self, name: bytes = b"time") -> int:
        seconds, nanoseconds = struct.unpack("<II", self.fields[name])
        return int(seconds) * 10**9 + int(nanoseconds)


class Connection(NamedTuple):
    """What the bag says of one publisher: `definition` is the text of its message type, empty where the recorder had none; `about`
    is what else is said of it (`md5sum`, `callerid`, `latching`)."""

    topic: str
    type: str
    definition: bytes
    about: dict[str, str]


def header_fields(header: bytes) -> dict[bytes, bytes] | None:
    """The `name=value` fields that fill a header, None where they do not."""
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        if position + 4 > len(header):
            return None
        end = position + 4 + int.from_bytes(header[position : position + 4], "little")
        name, equals, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not equals:
            return None
        fields[name] = value
        position = end
    return fields


def bytes_of(data: bytes) -> Bytes:
    """Those of an inflated chunk."""
    return lambda offset, length: data[offset : offset + length]


def bag_record(at: Bytes, position: int) -> BagRecord | None:
    """The record that begins here, None where none does: its fields fill its header, and it has those that its kind needs."""
    length = int.from_bytes(at(position, 4), "little")
    if not 0 < length <= LARGEST_HEADER:
        return None
    header = at(position + 4, length + 4)
    if len(header) < length + 4:
        return None
    fields = header_fields(header[:length])
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    op = fields[b"op"][0]
    if any(len(fields.get(name, b"")) != size for name, size in NEEDED.get(op, {b"": 0}).items()):
        return None
    begin = position + 8 + length
    return BagRecord(op, fields, position, begin, begin + int.from_bytes(header[length:], "little"))


def connection_of(record: BagRecord, data: bytes) -> Connection | None:
    """What a CONNECTION record with these data describes; None where that cannot be read."""
    fields = header_fields(data)
    if fields is None or b"type" not in fields:
        return None
    topic = record.fields.get(b"topic", fields.get(b"topic", b""))
    try:
        about = {
            name.decode(): fields[name].decode() for name in (b"md5sum", b"callerid", b"latching") if name in fields
        }
        return Connection(topic.decode(), fields[b"type"].decode(), fields.get(b"message_definition", b""), about)
    except UnicodeDecodeError:
        return None


def chunk_counts(data: bytes) -> dict[int, int]:
    """Connection -> messages, as the data of a CHUNK_INFO record count them."""
    return dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))


def starts_before(at: Bytes, op_place: int, first: int) -> Iterator[int]:
    """Where a record may begin whose `op` field lies at `op_place`: nearest first, none before `first`."""
    back = at(max(op_place - FURTHEST_BACK, first), min(FURTHEST_BACK, op_place - first) + 8)
    for distance in range(4, len(back) - 8 + 1):
        begin = len(back) - 8 - distance
        length = int.from_bytes(back[begin : begin + 4], "little")
        if distance + 4 <= length <= LARGEST_HEADER and length <= FURTHEST_BACK * 2:
            yield op_place - distance
