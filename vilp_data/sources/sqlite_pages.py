"""The rows of a SQLite file page by page, without its trees: what is left of a table whose upper pages are gone.

A table's rows lie in leaf pages, each complete in itself but for long values, which go on in a chain of overflow pages. Layout as in
SQLite's "Database File Format", sections 1.3 (the file's head), 1.5 (free pages), 1.6 (b-tree pages) and 2.1 (records). Only what
rosbag2's `messages` look like is taken: (id, which is the row id and so NULL; integer; time, 0 or above; blob).

Time is bounded by the file's size whatever its pages say: the cells of a page share no bytes, and all chains together read a page twice.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from itertools import islice
from typing import BinaryIO, NamedTuple

import numpy as np

HEAD_SIZE = 100
WINDOW = 1 << 20  # bytes looked through at a time for leaves
LEAF = 0x0D  # the kind of a page that holds rows of a table
CELL_BYTES = 6  # that a cell takes at least, with the pointer to it
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}  # serial type -> bytes; 8 and 9 are 0 and 1 themselves
FIRST_BLOB = 12  # serial type 12 + 2n is a blob of n bytes


class FileHead(NamedTuple):
    """What a SQLite file says of itself: bytes of a page, how many of them SQLite uses, pages (0: not told), first free page (0: none)."""

    page_size: int
    usable: int
    pages: int
    first_free: int


class MessageRow(NamedTuple):
    number: int
    topic_id: int
    time_ns: int
    data: bytes


def file_head(head: bytes) -> FileHead | None:
    """What a file's first HEAD_SIZE bytes say; None where no SQLite file says so."""
    if len(head) < HEAD_SIZE:
        return None
    stored = int.from_bytes(head[16:18], "big")
    page_size = 65536 if stored == 1 else stored
    if page_size < 512 or page_size & (page_size - 1) or page_size - head[20] < 480:
        return None
    told = head[24:28] == head[92:96]  # else written by an SQLite that does not keep the count
    pages = int.from_bytes(head[28:32], "big") if told else 0
    return FileHead(page_size, page_size - head[20], pages, int.from_bytes(head[32:36], "big"))


def message_rows(stream: BinaryIO, size: int, *, whole: int, largest: int) -> Iterator[MessageRow]:
    """Every message in the first `size` bytes of a SQLite file, in order of row ids as far as its leaves are (16 bytes are held of each),
    one of more than `largest` bytes left out.

    Behind the first `whole` bytes a page of zeros counts as missing, and so do the rows that go on in it."""
    head = file_head(stream.read(HEAD_SIZE))
    if head is None:
        return
    pages = _Pages(stream, head, size // head.page_size, whole // head.page_size, largest)
    numbers, first_rows = array("q"), array("q")
    for number, first_row in pages.leaves():
        numbers.append(number)
        first_rows.append(first_row)
    for place in np.argsort(np.asarray(first_rows), kind="stable"):
        yield from pages.rows(numbers[place])


class _Pages:
    """`count` pages of a file, numbered from 1; of those after the first `whole`, the ones that are zeros are missing."""

    def __init__(self, stream: BinaryIO, head: FileHead, count: int, whole: int, largest: int) -> None:
        self._stream, self._head, self._count, self._whole = stream, head, count, whole
        self._usable = head.usable
        self._zeros = bytes(head.usable)
        self._largest = min(largest, count * head.page_size)
        self._overflow_pages = 2 * count  # to read in all: in a whole file each is of one row, in a hostile one of many

    def leaves(self) -> Iterator[tuple[int, int]]:
        """The number and the first row id of each page that holds rows and is in use: those of a free one were deleted."""
        free, size, at_once = self._free(), self._head.page_size, WINDOW // self._head.page_size
        for first in range(0, self._count, at_once):
            self._stream.seek(first * size)
            window = self._stream.read(min(at_once, self._count - first) * size)
            for place, kind in enumerate(window[::size]):
                if kind == LEAF and not free[number := first + place + 1]:
                    page = window[place * size : place * size + self._usable]
                    yield from ((number, row) for row in islice(_row_ids(page), 1))

    def rows(self, number: int) -> Iterator[MessageRow]:
        """The messages of one leaf."""
        page = self._read(number)
        left = self._usable
        for cell in _cells(page):
            row, used = self._row(page, cell)
            left -= used
            if left < 0:
                return
            if row is not None:
                yield row

    def _free(self) -> bytearray:
        """By number of a page, 1 where it is free, as far as the chain of lists of them goes."""
        free = bytearray(self._count + 1)
        trunk = self._head.first_free
        while 0 < trunk <= self._count and not free[trunk]:
            page = self._read(trunk)
            many = int.from_bytes(page[4:8], "big")
            if not page or many > self._usable // 4 - 2:
                break
            for number in (trunk, *struct.unpack_from(f">{many}I", page, 8)):
                if number <= self._count:
                    free[number] = 1
            trunk = int.from_bytes(page[:4], "big")
        return free

    def _row(self, page: bytes, at: int) -> tuple[MessageRow | None, int]:
        """The message in the cell at `at`, None where it is none or not all of it is there; and how many bytes of the page it takes."""
        local = 0
        try:
            length, at = _varint(page, at)
            number, at = _varint(page, at)
            if not 0 < length <= self._largest:
                return None, 0
            local = _local(length, self._usable)
            payload = page[at : at + local]
            if local < length:
                (overflow,) = struct.unpack_from(">I", page, at + local)
                payload += self._chain(overflow, length - local)
            return (_message(number, payload) if len(payload) == length else None), local
        except (IndexError, struct.error):
            return None, local

    def _chain(self, number: int, missing: int) -> bytes:
        """The rest of a row; none where the chain is broken, longer or shorter."""
        parts = []
        while missing > 0 and 0 < number <= self._count and self._overflow_pages > 0:
            self._overflow_pages -= 1
            page = self._read(number)
            if not page:
                return b""
            number = int.from_bytes(page[:4], "big")
            parts.append(page[4 : 4 + missing])
            missing -= len(parts[-1])
        return b"" if missing or number else b"".join(parts)

    def _read(self, number: int) -> bytes:
        """What SQLite uses of a page; nothing where that is missing."""
        self._stream.seek((number - 1) * self._head.page_size)
        page = self._stream.read(self._usable)
        return b"" if len(page) < self._usable or (number > self._whole and page == self._zeros) else page


def _row_ids(page: bytes) -> Iterator[int]:
    """The row ids of a leaf's cells, but of those that are damaged."""
    for cell in _cells(page):
        try:
            _, at = _varint(page, cell)
            yield _varint(page, at)[0]
        except IndexError:
            continue


def _cells(page: bytes) -> Iterator[int]:
    """Where the rows of a page begin; none where it is no leaf."""
    if page[:1] != bytes([LEAF]):
        return
    many = min(int.from_bytes(page[3:5], "big"), (len(page) - 8) // CELL_BYTES)
    for (cell,) in struct.iter_unpack(">H", page[8 : 8 + 2 * many]):
        yield cell


def _local(length: int, usable: int) -> int:
    """How many bytes of a row lie in its leaf page."""
    most, least = usable - 35, (usable - 12) * 32 // 255 - 23
    if length <= most:
        return length
    some = least + (length - least) % (usable - 4)
    return some if some <= most else least


def _message(number: int, payload: bytes) -> MessageRow | None:
    end, at = _varint(payload, 0)
    kinds = []
    while at < end:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] or kinds[1] not in INTEGERS or kinds[2] not in INTEGERS:
        return None
    if kinds[3] < FIRST_BLOB or kinds[3] % 2:
        return None
    topic_id, at = _integer(payload, end, kinds[1])
    time_ns, at = _integer(payload, at, kinds[2])
    data = payload[at:]
    whole = len(data) == (kinds[3] - FIRST_BLOB) // 2 and time_ns >= 0
    return MessageRow(number, topic_id, time_ns, data) if whole else None


def _integer(payload: bytes, at: int, kind: int) -> tuple[int, int]:
    size = INTEGERS[kind]
    return (int.from_bytes(payload[at : at + size], "big", signed=True) if size else kind - 8), at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """SQLite's: up to nine bytes, seven bits each but for the last, which has eight; two's complement. IndexError past the end."""
    value = 0
    for count in range(8):
        byte = data[at + count]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + count + 1
    value = value << 8 | data[at + 8]
    return value - (1 << 64) if value >> 63 else value, at + 9
