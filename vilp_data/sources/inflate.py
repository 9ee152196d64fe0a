"""Compressed chunks into bytes, never more of them than were announced, and as many as a damaged chunk still gives.

Nothing here allocates on a header's word alone: memory grows with what really comes out.
"""

from __future__ import annotations

import bz2
import struct
from io import BytesIO
from typing import NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from vilp_data import limits

STEP = 1 << 18  # bytes inflated at a time
LARGEST_WINDOW = 1 << 27  # what zstd looks back on, 128 MB: also what its own command line allows
AT_ONCE = 1 << 26  # a zstd frame up to this size is inflated by one call, which allocates what the header claims
UNKNOWN_SIZE, UNKNOWN_RATIO = (
    1 << 26,
    16,
)  # what a chunk whose size nothing tells may inflate to, at the least, and per packed byte
UNFINISHED = "the compressed data have no end"
LZ4_BLOCK_BYTES = {4: 1 << 16, 5: 1 << 18, 6: 1 << 20, 7: 1 << 22}

# What the three libraries raise for damaged data.
BROKEN = (zstandard.ZstdError, RuntimeError, ValueError, OSError, EOFError, MemoryError, OverflowError)


class Inflated(NamedTuple):
    """What came out; `fault` says why it is not all, and is empty where it is."""

    data: bytes
    fault: str


class _Prefix:
    """Up to `size` bytes that come out piece by piece, held once: the buffer grows, and is handed out as it is."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._buffer = BytesIO()
        self.full = False

    def add(self, part: bytes) -> None:
        """Note what came out; `full` once it is more than `size`."""
        room = self._size - self._buffer.tell()
        self.full = self.full or len(part) > room
        self._buffer.write(part if len(part) <= room else part[:room])

    def too_many(self) -> str:
        return f"more than {self._size} bytes where the header says {self._size}"

    def data(self) -> bytes:
        return self._buffer.getvalue()


class _Stream(Protocol):
    @property
    def eof(self) -> bool: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def largest_guess(packed_size: int) -> int:
    """Bytes that a chunk may inflate to whose own word about it is missing or wrong: more than recorders' chunks have, and little
    beside the file itself."""
    return min(limits.CHUNK_BYTES, max(UNKNOWN_SIZE, UNKNOWN_RATIO * packed_size))


def inflate(packed: bytes, compression: str, size: int) -> bytes:
    """The chunk's bytes ("", "zstd", "lz4", "bz2"); ValueError where they are damaged or not exactly `size` long."""
    if compression == "zstd" and size <= AT_ONCE:
        return _zstd_at_once(packed, size)
    data, fault = inflate_prefix(packed, compression, size)
    if fault:
        raise ValueError(fault)
    return data


def inflate_prefix(packed: bytes, compression: str, size: int) -> Inflated:
    """As many of the chunk's `size` bytes as come out before damage, or before the compressed data end.

    Of zstd and bz2 that is every whole block (at most 128 kB, 900 kB are lost), of lz4 every byte. ValueError where the compression
    is not known."""
    if compression == "":
        data, fault = packed[:size], ""
        if len(packed) > size:
            fault = f"more than {size} bytes where the header says {size}"
    elif compression == "zstd":
        data, fault = _zstd_prefix(packed, size)
    elif compression == "lz4":
        data, fault = _lz4_prefix(packed, size)
    elif compression == "bz2":
        data, fault = _stream_prefix(bz2.BZ2Decompressor(), packed, size)
    else:
        raise ValueError(f"compression {compression!r}; known: none, zstd, lz4, bz2")
    if fault in ("", UNFINISHED) and len(data) != size:
        fault = f"{len(data)} bytes where the header says {size}"
    return Inflated(data, fault)


def _zstd_at_once(packed: bytes, size: int) -> bytes:
    try:
        claimed = zstandard.frame_content_size(packed)
        if claimed in (-1, size):
            stream = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW)
            data = stream.decompress(packed, max_output_size=max(size, 1))
            claimed = len(data)
    except BROKEN as error:
        raise ValueError(str(error)) from error
    if claimed != size:
        raise ValueError(f"{claimed} bytes where the header says {size}")
    return data


def _zstd_prefix(packed: bytes, size: int) -> Inflated:
    """Block by block, since an error takes with it whatever the same call has inflated."""
    stream = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW).decompressobj()
    out, position = _Prefix(size), 0
    try:
        while position < len(packed) and not out.full:
            end = _zstd_block_end(packed, position)
            out.add(stream.decompress(packed[position:end]))
            position = end
            if stream.eof and position < len(packed):
                stream = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW).decompressobj()  # frames may follow
        fault = UNFINISHED if not stream.eof else ""
        fault = fault if position == len(packed) and not out.full else out.too_many()
    except BROKEN as error:
        fault = str(error)
    return Inflated(out.data(), fault)


def _zstd_block_end(packed: bytes, position: int) -> int:
    """Where the next piece ends that zstd inflates by itself: a frame's header, or one block. A guess that is wrong costs only the
    piece: the library looks at every byte itself."""
    if packed[position : position + 4] == b"\x28\xb5\x2f\xfd":
        try:
            return min(position + zstandard.frame_header_size(packed[position : position + 18]), len(packed))
        except zstandard.ZstdError:
            return len(packed)
    header = int.from_bytes(packed[position : position + 3], "little")
    kind, size = header >> 1 & 3, header >> 3
    return min(position + 3 + (1 if kind == 1 else min(size, 1 << 17)), len(packed))


def _stream_prefix(stream: _Stream, packed: bytes, size: int) -> Inflated:
    """Through a decompressor that stops at a length."""
    out, position = _Prefix(size), 0
    try:
        while not stream.eof and not out.full:
            piece = packed[position : position + STEP] if getattr(stream, "needs_input", True) else b""
            part = stream.decompress(piece, max_length=STEP)
            position += len(piece)
            out.add(part)
            if not part and position >= len(packed) and not stream.eof:
                break
    except BROKEN as error:
        return Inflated(out.data(), str(error) or type(error).__name__)
    fault = out.too_many() if out.full else UNFINISHED if not stream.eof else ""
    return Inflated(out.data(), fault)


def _lz4_prefix(packed: bytes, size: int) -> Inflated:
    found = _stream_prefix(lz4.frame.LZ4FrameDecompressor(), packed, size)
    if len(found.data) >= size:
        return found
    rest = _lz4_last_block(packed, found.data)
    if not rest:
        return found
    data = (found.data + rest)[:size]
    return Inflated(data, found.fault)


def _lz4_last_block(packed: bytes, before: bytes) -> bytes:
    """What the block at which a frame is cut off gives up to the cut; the library hands out whole blocks alone."""
    try:
        flags, largest = packed[4], LZ4_BLOCK_BYTES[packed[5] >> 4 & 7]
        begin = 7 + (8 if flags & 8 else 0) + (4 if flags & 1 else 0)  # content size, dictionary id
        while True:
            (word,) = struct.unpack_from("<I", packed, begin)
            length = word & 0x7FFFFFFF
            end = begin + 4 + length + (4 if flags & 16 else 0)
            if length > largest:
                return b""
            if end > len(packed):
                break
            begin = end
    except (IndexError, KeyError, struct.error):
        return b""
    block = packed[begin + 4 : begin + 4 + length]
    return block if word >> 31 else _lz4_sequences(block, before[-65536:], largest)


def _lz4_sequences(block: bytes, history: bytes, largest: int) -> bytes:
    """The sequences of an lz4 block that lie whole in `block`, decoded (https://github.com/lz4/lz4/blob/dev/doc/lz4_Block_format.md)."""
    out = bytearray(history)
    position, stop = 0, len(history) + largest
    try:
        while position < len(block) and len(out) < stop:
            token = block[position]
            literals, position = _lz4_length(block, position + 1, token >> 4)
            out += block[position : position + literals]
            position += literals
            offset = block[position] | block[position + 1] << 8
            matched, position = _lz4_length(block, position + 2, token & 15)
            if not 0 < offset <= len(out):
                break
            begin, left = len(out) - offset, min(matched + 4, stop - len(out))
            while left > 0:  # a match may run into what it writes
                out += out[begin : begin + left]
                left, begin = left - min(left, offset), begin + min(left, offset)
    except IndexError:
        pass
    return bytes(out[len(history) :])


def _lz4_length(block: bytes, position: int, length: int) -> tuple[int, int]:
    """(length, where it ends): 15 is continued by bytes up to the first that is not 255."""
    if length == 15:
        while True:
            length += block[position]
            position += 1
            if block[position - 1] != 255:
                break
    return length, position
