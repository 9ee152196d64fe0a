"""What a JPEG, PNG or WebP file says of itself in its first bytes, read before anything is decoded or allocated. Pure."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
RIFF, WEBP = b"RIFF", b"WEBP"
_TAIL = 4096  # where an end mark is looked for first
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers whose segment gives the size
_JPEG_SCAN = 0xDA
_PNG_GREY = frozenset({0, 4})


@dataclass(frozen=True)
class ImageFile:
    """`kind` is "jpeg", "png" or "webp"; `bits` a channel; `whole` says whether its end is there; `grey` whether it has no colour
    (told for PNG alone)."""

    kind: str
    height: int
    width: int
    bits: int
    whole: bool
    grey: bool = False


def image_file(data: bytes) -> ImageFile | None:
    """The head of an image file, None where it is none of the three. A size that cannot be read is 0 x 0.

    Damage in the middle shows in a PNG (it carries checksums), while a JPEG decoder fills in what it cannot read; the log's own
    checksums must catch that."""
    for matches, read in _READERS:
        if matches(data):
            return read(data)
    return None


def _png(data: bytes) -> ImageFile:
    """Chunk after chunk up to the end mark: a decoder allocates the length that a chunk claims, though the file has no such bytes."""
    # signature, then IHDR: length, name, width, height, bit depth, colour type
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    bits, colour = (data[24], data[25]) if len(data) > 25 else (8, 2)
    place = len(PNG_START)
    while place + 12 <= len(data) and data[place + 4 : place + 8] != PNG_END:  # length, name, data, checksum
        place += 12 + int.from_bytes(data[place : place + 4], "big")
    return ImageFile("png", height, width, bits, place + 12 <= len(data), grey=colour in _PNG_GREY)


def _jpeg(data: bytes) -> ImageFile:
    """Segment after segment up to the first scan: the end mark is looked for behind it, for a thumbnail among the segments has one
    of its own."""
    height = width = 0
    bits, place = 8, 2
    while place + 9 <= len(data) and data[place] == 0xFF and (marker := data[place + 1]) != _JPEG_SCAN:
        if marker in _JPEG_FRAMES:  # length, precision, height, width
            bits, height, width = data[place + 4], *struct.unpack_from(">HH", data, place + 5)
        filler = marker == 0xFF
        place += 1 if filler else 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    scan = data.find(bytes((0xFF, _JPEG_SCAN)), place)
    whole = scan >= 0 and (data.find(JPEG_END, max(scan, len(data) - _TAIL)) >= 0 or data.find(JPEG_END, scan) >= 0)
    return ImageFile("jpeg", height, width, bits, whole)


def _webp(data: bytes) -> ImageFile:
    whole = len(data) >= 8 + int.from_bytes(data[4:8], "little")
    height = width = 0
    if data[12:16] == b"VP8X" and len(data) >= 30:
        width, height = 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    elif data[12:16] == b"VP8L" and len(data) >= 25:
        sizes = int.from_bytes(data[21:25], "little")
        width, height = 1 + (sizes & 0x3FFF), 1 + (sizes >> 14 & 0x3FFF)
    elif data[12:16] == b"VP8 " and len(data) >= 30:
        width = int.from_bytes(data[26:28], "little") & 0x3FFF
        height = int.from_bytes(data[28:30], "little") & 0x3FFF
    return ImageFile("webp", height, width, 8, whole)


_READERS: tuple[tuple[Callable[[bytes], bool], Callable[[bytes], ImageFile]], ...] = (
    (lambda data: data.startswith(JPEG_START), _jpeg),
    (lambda data: data.startswith(PNG_START), _png),
    (lambda data: data.startswith(RIFF) and data[8:12] == WEBP, _webp),
)
