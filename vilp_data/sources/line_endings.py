"""Logs whose line endings a transfer converted, as git without .gitattributes and FTP in text mode do: told, and undone where they can be.

Each line feed that became carriage return + line feed is found again without doubt. The other way, where a pair became a line feed,
a pair left no trace; but an MCAP chunk says how long it was, and its checksum says when it is right, so the few line feeds that lost
their return are found by trial. What no checksum vouches for stays as it is.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from itertools import combinations
from math import comb
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode

from vilp_data.errors import number_of
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import UNFINISHED, inflate, inflate_prefix
from vilp_data.sources.mcap_records import CHUNK_HEAD, MAGIC, RECORD_HEAD

RETURNED = (b"\x89MCAP0\r\r\n", b"#ROSBAG V2.0\r\n")
FED = (b"\x89MCAP0\n",)
MOST_TRIALS = 20_000
"""Ways to put returns back into one zstd block or chunk; beyond that it is left as it is."""
LARGEST_CHUNK = 1 << 26
"""Of chunks that are tried, as they are and inflated."""
BLOCK = 1 << 20
MOST_BYTES = 1 << 34
"""Inflated for trials, of the whole log: half a minute."""


class _Budget:
    """What may still be spent on trials."""

    def __init__(self, left: int = MOST_BYTES) -> None:
        self.left = left

    def allows(self, size: int) -> bool:
        self.left -= size
        return self.left > 0


def is_converted(head: bytes) -> bool:
    """Whether a log that begins with these bytes went through a conversion of line endings."""
    return head.startswith(RETURNED) or head.startswith(FED)


def restore(source: FileBytes, out: BinaryIO) -> str:
    """Write the log before the conversion, or as near as can be had; what was done, in words. `source` begins as `is_converted` says."""
    return _without_returns(source, out) if source.at(0, 16).startswith(RETURNED) else _with_returns(source, out)


# --- line feeds that became pairs ---------------------------------------------------------------------------------------------


def _without_returns(source: FileBytes, out: BinaryIO) -> str:
    lone, kept = 0, b""
    for begin in range(0, source.size, BLOCK):
        block = kept + source.at(begin, BLOCK)
        kept = b"\r" if block.endswith(b"\r") else b""  # its line feed may begin the next block
        block = block.removesuffix(kept)
        lone += block.count(b"\n") - block.count(b"\r\n")
        out.write(block.replace(b"\r\n", b"\n"))
    out.write(kept)
    what = "its line feeds had become pairs (\\r\\n): turned back"
    return what + (
        f"; {lone} line feeds were not converted, so not every pair need have been a line feed" if lone else ""
    )


# --- pairs that became line feeds ---------------------------------------------------------------------------------------------


def _with_returns(source: FileBytes, out: BinaryIO) -> str:
    """An MCAP file whose pairs became line feeds, its chunks made whole again by trial."""
    out.write(MAGIC)
    position, found, budget = len(FED[0]), 0, _Budget()
    while position < source.size:
        if (chunk := _chunk_at(source, position, budget)) is not None:
            record, position = chunk
            out.write(record)
            found += 1
            continue
        told = _record_length(source, position)
        length, lacks = told if told is not None else (source.size - position, 0)
        # An index that lacks bytes is worth nothing, and made anew.
        if not lacks or source.at(position, 1)[0] != Opcode.MESSAGE_INDEX:
            for begin in range(position, position + length, BLOCK):
                out.write(source.at(begin, min(BLOCK, position + length - begin)))
        position += length
    return f"its pairs \\r\\n had become line feeds: {number_of(found, 'chunk')} made whole again, as checksums say"


def _record_length(source: FileBytes, position: int) -> tuple[int, int] | None:
    """(length, returns that it lacks) of the record here: as many as it takes that another record follows."""
    head = source.at(position, RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack(head)
    if not 0 < opcode < 16 or length > source.size:
        return None
    for missing in range(3):
        end = position + RECORD_HEAD.size + length - missing
        if _follows(source, end):
            return int(end - position), missing
    return None


def _follows(source: FileBytes, end: int) -> bool:
    """Whether a record head, or the end of the file, is here."""
    head = source.at(end, RECORD_HEAD.size)
    if end == source.size or head in (MAGIC, FED[0]):
        return True
    if len(head) < RECORD_HEAD.size:
        return False
    opcode, length = RECORD_HEAD.unpack(head)
    return bool(0 < opcode < 16 and 0 < length <= source.size)


def _chunk_at(source: FileBytes, position: int, budget: _Budget) -> tuple[bytes, int] | None:
    """The chunk record here with its returns, and where the next record begins; None where it is none, or no trial is right."""
    head = source.at(position, CHUNK_HEAD.size + 12)
    if len(head) < CHUNK_HEAD.size + 12 or head[0] != Opcode.CHUNK:
        return None
    _, _, _, _, size, crc, name_length = CHUNK_HEAD.unpack_from(head)
    at = CHUNK_HEAD.size + name_length
    name = head[CHUNK_HEAD.size : at]
    if name not in (b"", b"lz4", b"zstd") or not crc:
        return None
    packed_size, begin = int.from_bytes(head[at : at + 8], "little"), position + at + 8
    if max(packed_size, size) > LARGEST_CHUNK:
        return None
    for missing in range(64):
        end = begin + packed_size - missing
        if end < begin or not _follows(source, end):
            continue
        packed = _completed(source.at(begin, end - begin), missing, name.decode(), size, crc, budget)
        if packed is not None:
            return head[: at + 8] + packed, end
    return None


def _completed(packed: bytes, missing: int, compression: str, size: int, crc: int, budget: _Budget) -> bytes | None:
    """`packed` with `missing` returns put before line feeds so that it inflates to what the checksum says."""
    for trial in _trials(packed, missing, compression, size, budget):
        if not budget.allows(size):
            return None
        try:
            if zlib.crc32(inflate(trial, compression, size)) == crc:
                return trial
        except ValueError:
            continue
    return None


def _trials(packed: bytes, missing: int, compression: str, size: int, budget: _Budget) -> Iterator[bytes]:
    if compression == "zstd" and missing:
        yield from _zstd_trials(packed, missing, size, budget)
        return
    feeds = [place for place, byte in enumerate(packed) if byte == 10]
    if comb(len(feeds), missing) <= MOST_TRIALS:
        yield from (_with_pairs(packed, places) for places in combinations(feeds, missing))


def _with_pairs(packed: bytes, places: tuple[int, ...]) -> bytes:
    out, begin = bytearray(), 0
    for place in places:
        out += packed[begin:place] + b"\r"
        begin = place
    return bytes(out + packed[begin:])


def _zstd_trials(packed: bytes, missing: int, size: int, budget: _Budget) -> Iterator[bytes]:
    """Block by block: a block's header says how long it was, and most wrong trials do not inflate."""
    try:
        start = zstandard.frame_header_size(packed[:18])
    except zstandard.ZstdError:
        return
    yield from _zstd_from(packed, start, missing, size, budget)


def _zstd_from(packed: bytes, position: int, missing: int, size: int, budget: _Budget) -> Iterator[bytes]:
    """`packed` is right up to `position`, where a block's header lies, and lacks `missing` returns behind it."""
    if missing == 0:
        yield packed
        return
    header = int.from_bytes(packed[position : position + 3], "little")
    last, kind, length = header & 1, header >> 1 & 3, header >> 3
    if position + 3 > len(packed) or kind == 3:
        return
    length = 1 if kind == 1 else length
    for here in range(missing + 1):
        if last and here != missing:
            continue
        end = position + 3 + length - here
        if not last and not _is_block_header(packed[end : end + 3]):
            continue
        block = packed[position + 3 : end]
        feeds = [place for place, byte in enumerate(block) if byte == 10]
        if comb(len(feeds), here) > MOST_TRIALS:
            continue
        for places in combinations(feeds, here):
            trial = packed[: position + 3] + _with_pairs(block, places) + packed[end:]
            after = position + 3 + length
            if last:
                yield trial
            elif budget.allows(after) and _inflates_to(trial, after, size):
                yield from _zstd_from(trial, after, missing - here, size, budget)
            elif budget.left <= 0:
                return


def _is_block_header(header: bytes) -> bool:
    value = int.from_bytes(header, "little")
    return len(header) == 3 and value >> 1 & 3 != 3 and 0 < value >> 3 <= 1 << 17


def _inflates_to(packed: bytes, end: int, size: int) -> bool:
    """Whether the blocks up to `end` inflate."""
    fault = inflate_prefix(packed[:end], "zstd", size).fault
    return "header says" in fault or fault in ("", UNFINISHED)
