"""The rows of a SQLite file page by page: what is left of a table whose upper pages are gone, or lie.

A table's rows lie in leaf pages, each complete in itself but for long values, which go on in a chain of overflow pages. Layout as in
SQLite's "Database File Format", sections 1.3 (the file's head), 1.5 (free pages), 1.6 (b-tree pages) and 2.1 (records). Only what
rosbag2's `messages` look like is taken: (id, which is the row id and so NULL; integer; time, 0 or above; blob).

Where the trees are left they say which leaves are of the messages, and which of other tables. Rows come in order of their ids, so that
of two under one id the second comes right after the first, and nothing need be remembered of the others.

Time and memory are bounded whatever the pages say: the cells of a page share no bytes, all chains together read a page twice, and OPEN
leaves are held at a time.
"""

from __future__ import annotations

import struct
from array import array
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush, heapreplace
from itertools import pairwise
from typing import BinaryIO, NamedTuple

import numpy as np

HEAD_SIZE = 100
WINDOW = 1 << 20  # bytes looked through at a time for leaves
LEAF, INNER = 0x0D, 0x05  # the kinds of pages of a table's tree: those that hold rows, and those that lead to them
OPEN = 32  # leaves held at a time: those of a sound table share no ids, and one is enough
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
    """`number` is the row id; `led_to`: whether the tree of the messages, and of nothing else, leads to its leaf."""

    number: int
    topic_id: int
    time_ns: int
    data: bytes
    led_to: bool


@dataclass
class _Leaf:
    """A page whose rows are being read. `ids`: row id and place of each cell that is still to come, the next one last; `left`: bytes of
    the page that no cell has taken yet."""

    page: bytes
    led_to: bool
    ids: list[tuple[int, int]]
    left: int


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


class MessagePages:
    """The messages in the first `size` bytes of a SQLite file. One of more than `largest` bytes is left out.

    `own` is the root page of the messages' tree (0: not known), `others` those of other tables. Behind the first `whole` bytes a page of
    zeros counts as missing, and so do the rows that go on in it. `left_out` counts rows whose ids no sound page can have: they do not
    ascend, or more than OPEN leaves share them."""

    def __init__(
        self, stream: BinaryIO, size: int, *, whole: int, largest: int, own: int = 0, others: Collection[int] = ()
    ) -> None:
        self.left_out = 0
        found = file_head(stream.read(HEAD_SIZE))
        head = found or FileHead(512, 512, 0, 0)
        self._stream, self._head, self._usable = stream, head, head.usable
        self._count = size // head.page_size if found else 0
        self._whole = whole // head.page_size
        self._own, self._others = own, others
        self._zeros = bytes(head.usable)
        self._largest = min(largest, size)
        self._overflow_pages = 2 * self._count  # to read: in a whole file each is of one row, in a hostile one of many

    def rows(self) -> Iterator[MessageRow]:
        """Every message in order of row ids; of several under one id those that the tree leads to first. 16 bytes are held of each leaf."""
        opened: list[tuple[int, bool, int, _Leaf]] = []  # a heap, by the next row's id
        for first, number, led_to in self._leaves():
            while opened and opened[0][0] < first:
                yield from self._next_row(opened)
            page = self._read(number)
            ids = list(row_ids(page))
            kept = longest_ascending([row for row, _ in ids])
            self.left_out += len(ids) - len(kept)
            if kept:
                leaf = _Leaf(page, led_to, [ids[place] for place in reversed(kept)], self._usable)
                heappush(opened, (leaf.ids[-1][0], not led_to, number, leaf))
            if len(opened) > OPEN:  # let go what would be held for longest, if it can be what no tree leads to
                farthest = max(opened, key=lambda one: (one[1], one[0]))
                opened.remove(farthest)
                heapify(opened)
                self.left_out += len(farthest[-1].ids)
        while opened:
            yield from self._next_row(opened)

    def _next_row(self, opened: list[tuple[int, bool, int, _Leaf]]) -> Iterator[MessageRow]:
        """The first row of the open leaves, if it is a message."""
        _, unled, number, leaf = opened[0]
        row, used = self._row(leaf)
        leaf.left -= used
        if leaf.left < 0:
            self.left_out += 1 + len(leaf.ids)
            row = None
        if leaf.ids and leaf.left >= 0:
            heapreplace(opened, (leaf.ids[-1][0], unled, number, leaf))
        else:
            heappop(opened)
        if row is not None:
            yield row

    def _leaves(self) -> Iterator[tuple[int, int, bool]]:
        """First row id and number of each leaf that may be of the messages, and whether their tree leads to it; in order of those ids."""
        kinds, numbers, firsts = bytearray(self._count + 1), array("q"), array("q")
        size, at_once = self._head.page_size, WINDOW // self._head.page_size
        for start in range(0, self._count, at_once):
            self._stream.seek(start * size)
            window = self._stream.read(min(at_once, self._count - start) * size)
            for place in range(0, len(window), size):
                number = start + place // size + 1
                kinds[number] = window[place]
                ids = [row for row, _ in row_ids(window[place : place + self._usable])] if window[place] == LEAF else []
                if kept := longest_ascending(ids):
                    numbers.append(number)
                    firsts.append(ids[kept[0]])
        spare, own = self._free(), bytearray(self._count + 1)
        self._mark(spare, kinds, self._others)
        self._mark(own, kinds, [self._own])
        for place in np.argsort(np.asarray(firsts), kind="stable"):
            number = numbers[place]
            if own[number] or not spare[number]:
                yield firsts[place], number, bool(own[number] and not spare[number])

    def _mark(self, mark: bytearray, kinds: bytearray, roots: Collection[int]) -> None:
        """Set 1 for each page of these trees that is not yet marked."""
        pending, led_to = list[int](), list(roots)
        while led_to or pending:
            for number in led_to:
                if 0 < number <= self._count and not mark[number]:
                    mark[number] = 1
                    pending.append(number)
            number = pending.pop() if pending else 0
            page = self._read(number) if kinds[number] == INNER else b""
            led_to = [int.from_bytes(page[at : at + 4], "big") for at in (8, *_cells(page, 12))] if page else []

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

    def _row(self, leaf: _Leaf) -> tuple[MessageRow | None, int]:
        """The next message of a leaf, None where it is none or not all of it is there; and how many bytes of the page it takes."""
        number, at = leaf.ids.pop()
        page, local = leaf.page, 0
        try:
            length, at = _varint(page, at)
            _, at = _varint(page, at)
            if not 0 < length <= self._largest:
                return None, 0
            local = _local(length, self._usable)
            payload = page[at : at + local]
            if local < length:
                (overflow,) = struct.unpack_from(">I", page, at + local)
                payload += self._chain(overflow, length - local)
            return (_message(number, payload, leaf.led_to) if len(payload) == length else None), local
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


def row_ids(page: bytes) -> Iterator[tuple[int, int]]:
    """The row id of each cell of a leaf, and where that begins; but of those that are damaged."""
    for cell in _cells(page, 8):
        try:
            _, at = _varint(page, cell)
            yield _varint(page, at)[0], cell
        except IndexError:
            continue


def longest_ascending(numbers: Sequence[int]) -> Sequence[int]:
    """The places of as many of the numbers as ascend: a damaged one costs itself, not those after it."""
    if all(number < following for number, following in pairwise(numbers)):
        return range(len(numbers))
    ends: list[
        int
    ] = []  # the lowest number on which a run of 1, 2, … ends, its place, and of each place the one before it
    places: list[int] = []
    before: list[int] = []
    for place, number in enumerate(numbers):
        at = bisect_left(ends, number)
        before.append(places[at - 1] if at else -1)
        ends[at : at + 1], places[at : at + 1] = [number], [place]
    kept, place = [], places[-1]
    while place >= 0:
        kept.append(place)
        place = before[place]
    return kept[::-1]


def _cells(page: bytes, at: int) -> Iterator[int]:
    """Where the cells of a page of a table begin, whose pointers to them begin at `at`."""
    many = min(int.from_bytes(page[3:5], "big"), (len(page) - at) // CELL_BYTES)
    for (cell,) in struct.iter_unpack(">H", page[at : at + 2 * max(many, 0)]):
        yield cell


def _local(length: int, usable: int) -> int:
    """How many bytes of a row lie in its leaf page."""
    most, least = usable - 35, (usable - 12) * 32 // 255 - 23
    if length <= most:
        return length
    some = least + (length - least) % (usable - 4)
    return some if some <= most else least


def _message(number: int, payload: bytes, led_to: bool) -> MessageRow | None:
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
    return MessageRow(number, topic_id, time_ns, data, led_to) if whole else None


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
