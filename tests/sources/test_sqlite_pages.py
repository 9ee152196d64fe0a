"""Rows of a SQLite file without its trees: what lies in pages that nothing leads to, or that lie."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.damage import Sent, write_db3, write_two_tables
from vilp_data.sources.sqlite_pages import LEAF, OPEN, MessagePages, MessageRow, file_head, longest_ascending

SHAPES: dict[str, dict[str, Any]] = {
    "small pages": {"page": 512, "longest": 3000},
    "small pages with bytes that are not SQLite's": {"page": 512, "reserved": 32, "longest": 3000},
    "usual pages": {"longest": 9000},
    "large pages": {"page": 65536, "longest": 100_000, "n": 12},
}


def rows_of(content: bytes, *, whole: int | None = None, largest: int = 1 << 30) -> list[MessageRow]:
    return list(pages_of(content, whole=whole, largest=largest).rows())


def pages_of(content: bytes, *, whole: int | None = None, **options: Any) -> MessagePages:
    whole = len(content) if whole is None else whole
    return MessagePages(io.BytesIO(content), len(content), whole=whole, **({"largest": 1 << 30} | options))


def as_sent(rows: list[MessageRow]) -> list[Sent]:
    return [Sent(f"/t{row.topic_id - 1}", row.time_ns, row.time_ns, 0, row.data) for row in rows]


@pytest.mark.parametrize("shape", SHAPES)
def test_every_row_is_found_in_order_though_every_page_above_the_leaves_is_gone(tmp_path: Path, shape: str) -> None:
    options = {"n": 60} | SHAPES[shape]
    sent = write_db3(tmp_path / "run.db3", **options)
    content = bytearray((tmp_path / "run.db3").read_bytes())
    page = options.get("page", 4096)
    for place in range(page, len(content), page):
        if content[place] in (2, 5, 10):  # of an index, or inside a tree
            content[place : place + page] = bytes(page)
    assert as_sent(rows_of(bytes(content))) == sent


def test_leaves_that_lie_in_another_order_than_their_rows_give_them_in_order(tmp_path: Path) -> None:
    """A recorder's leaves change places when SQLite uses pages again; here two do."""
    sent = write_db3(tmp_path / "run.db3", n=120, longest=300)
    content = bytearray((tmp_path / "run.db3").read_bytes())
    first, *_, last = (
        place for place in range(2 * 4096, len(content), 4096) if content[place] == LEAF and content[place + 4] > 2
    )
    content[first : first + 4096], content[last : last + 4096] = (
        content[last : last + 4096],
        content[first : first + 4096],
    )
    assert as_sent(rows_of(bytes(content))) == sent


def test_a_row_above_the_limit_is_left_out(tmp_path: Path) -> None:
    sent = write_db3(tmp_path / "run.db3", n=50)
    content = (tmp_path / "run.db3").read_bytes()
    rows = rows_of(content, largest=1000)
    assert 0 < len(rows) < 50
    assert set(as_sent(rows)) == {message for message in sent if len(message.data) < 990}


def test_rows_that_were_deleted_do_not_come_back(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=120)
    database = sqlite3.connect(path)
    database.execute("PRAGMA secure_delete = OFF")
    database.execute("DELETE FROM messages WHERE id BETWEEN 31 AND 90")
    database.commit()
    database.close()
    content = path.read_bytes()
    assert sent[60].data[:100] in content
    assert as_sent(rows_of(content)) == sent[:30] + sent[90:]


def test_a_row_that_goes_on_in_a_page_of_zeros_behind_the_cut_is_missing_and_one_before_it_is_not(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.db3"
    write_db3(path, n=20, longest=2)
    database = sqlite3.connect(path)
    database.execute("UPDATE messages SET data = zeroblob(6000) WHERE id = 7")  # a black picture
    database.commit()
    database.close()
    content = path.read_bytes()
    assert [row.number for row in rows_of(content)] == list(range(1, 21))
    assert [row.number for row in rows_of(content, whole=len(content) - 4096)] == [*range(1, 7), *range(8, 21)]


# --- trees ------------------------------------------------------------------------------------------------------------


def test_rows_of_another_tables_tree_are_none_and_those_of_the_messages_tree_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent, roots = write_two_tables(path)
    own, content = roots.pop("messages"), bytearray(path.read_bytes())
    rows = list(pages_of(bytes(content), own=own, others=roots.values()).rows())
    assert as_sent(rows) == sent
    assert all(row.led_to for row in rows)
    content[own * 512 - 512 : own * 512] = bytes(512)
    rows = list(pages_of(bytes(content), own=own, others=roots.values()).rows())
    assert as_sent(rows) == sent
    assert not any(row.led_to for row in rows)


def test_a_leaf_to_which_two_trees_lead_is_of_none_for_sure(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent, roots = write_two_tables(path)
    own, content = roots["messages"], path.read_bytes()
    rows = list(pages_of(content, own=own, others=roots.values()).rows())
    assert as_sent(rows) == sent
    assert not any(row.led_to for row in rows)


def test_trees_that_lead_in_circles_end(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent, roots = write_two_tables(path)
    own, content = roots.pop("messages"), bytearray(path.read_bytes())
    content[own * 512 - 512 + 8 : own * 512 - 512 + 12] = own.to_bytes(4, "big")  # its last page is itself
    rows = list(pages_of(bytes(content), own=own, others=roots.values()).rows())
    assert as_sent(rows) == sent
    assert {row.led_to for row in rows} == {True, False}


# --- row ids ----------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 12), max_size=9))
def test_the_longest_ascending_part_is_found(numbers: list[int]) -> None:
    kept = longest_ascending(numbers)
    chosen = [numbers[place] for place in kept]
    assert list(kept) == sorted(set(kept))
    assert chosen == sorted(set(chosen))
    parts = (part for size in range(len(numbers) + 1) for part in combinations(numbers, size))
    assert len(chosen) == max(len(part) for part in parts if list(part) == sorted(set(part)))


def leaf_of(*ids: int, data: bytes = b"") -> bytes:
    """A leaf of 4 kB with a message under each id."""
    record = bytes([7, 0, 9, 6, *varint(12 + 2 * len(data))]) + bytes(8) + data
    cells = [varint(len(record)) + varint(number) + record for number in ids]
    at, pointers = 4096, b""
    for cell in cells:
        at -= len(cell)
        pointers += struct.pack(">H", at)
    head = bytes([LEAF, 0, 0]) + struct.pack(">H", len(ids)) + bytes(3)
    return (head + pointers).ljust(at, b"\0") + b"".join(reversed(cells))


def file_of(*leaves: bytes) -> bytes:
    head = bytearray(4096)
    head[16:18] = (4096).to_bytes(2, "big")
    return bytes(head) + b"".join(leaves)


def test_rows_come_in_order_of_their_ids_though_leaves_share_a_range() -> None:
    pages = pages_of(file_of(leaf_of(4, 6, 7, 20), leaf_of(1, 2, 6, 9), leaf_of(10, 11)))
    assert [row.number for row in pages.rows()] == [1, 2, 4, 6, 6, 7, 9, 10, 11, 20]
    assert pages.left_out == 0


@pytest.mark.parametrize("ids", [(1, 2, 900, 4, 5), (1, 2, 3, 0, 5), (900, 2, 3, 4), (1, 2, 3, 3)])
def test_a_row_id_that_does_not_ascend_costs_its_row_alone(ids: tuple[int, ...]) -> None:
    pages = pages_of(file_of(leaf_of(6, 7), leaf_of(*ids)))
    assert len([row for row in pages.rows() if row.number < 6]) == len(ids) - 1
    assert pages.left_out == 1


def test_no_more_leaves_are_held_at_a_time_than_a_few_and_those_that_end_first_are_kept() -> None:
    """Each reaches over all that begin after it."""
    pages = pages_of(file_of(*(leaf_of(k, 9000 - k) for k in range(1, OPEN + 11))))
    numbers = [row.number for row in pages.rows()]
    assert numbers[: OPEN + 10] == list(range(1, OPEN + 11))
    assert numbers[OPEN + 10 :] == [9000 - k for k in range(OPEN + 10, 10, -1)]
    assert pages.left_out == 10


# --- pages that lie ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("leads", [lambda page: page, lambda page: page + 1, lambda page: 0], ids=["itself", "on", "0"])
def test_chains_that_lead_astray_cost_the_rows_they_are_of_and_end(tmp_path: Path, leads: Callable[[int], int]) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=60, longest=9000, page=512)
    damaged = bytearray(path.read_bytes())
    for place in range(7 * 512, len(damaged), 512):
        if damaged[place] not in (LEAF, 5, 10, 2):
            damaged[place : place + 4] = leads(place // 512 + 1).to_bytes(4, "big")
    rows = rows_of(bytes(damaged))
    assert len(rows) < len(sent)
    assert set(as_sent(rows)) < set(sent)


def test_cells_that_share_their_bytes_give_no_more_than_a_page_holds() -> None:
    """A page of 4 kB may hold rows one inside the other, each the data of the one around it."""
    cell, starts = b"", []
    for number in range(150, 0, -1):
        record = bytes([7, 0, 9, 6, *varint(12 + 2 * len(cell))]) + bytes(8) + cell
        cell = varint(len(record)) + varint(number) + record
        starts.append(4096 - len(cell))
    leaf = bytes([LEAF, 0, 0]) + struct.pack(">H3x150H", 150, *reversed(starts))
    pages = pages_of(file_of(leaf.ljust(starts[-1], b"\0") + cell))
    rows = list(pages.rows())
    assert rows
    assert sum(len(row.data) for row in rows) < 4096
    assert pages.left_out == 150 - len(rows)


def test_rows_that_share_their_chains_give_no_more_than_a_few_times_what_the_file_holds() -> None:
    """Fifty leaves of eight rows each, all of which go on in the same fifty pages."""
    length, local = 489 + 50 * 4092, 489
    record = bytes([7, 0, 1, 6, *varint(12 + 2 * (length - 16)), 1]) + bytes(8)
    cell = varint(length) + b"\1" + record.ljust(local, b"x") + (52).to_bytes(4, "big")
    starts = [4096 - len(cell) * k for k in range(1, 9)]
    leaf = bytes([LEAF, 0, 0, 0, 8, 0, 0, 0]) + struct.pack(">8H", *starts)
    leaf = leaf.ljust(4096 - 8 * len(cell), b"\0") + cell * 8
    chain = [(page + 1 if page < 101 else 0).to_bytes(4, "big") + b"x" * 4092 for page in range(52, 102)]
    head = bytearray(4096)
    head[16:18] = (4096).to_bytes(2, "big")
    content = bytes(head) + leaf * 50 + b"".join(chain)
    rows = rows_of(content)
    assert {len(row.data) for row in rows} == {length - 16}
    assert sum(len(row.data) for row in rows) <= 2 * len(content)


def varint(value: int) -> bytes:
    """SQLite's, in three bytes."""
    return bytes([value >> 14 | 128, value >> 7 & 127 | 128, value & 127])


def test_a_head_that_no_sqlite_writes_has_no_pages() -> None:
    good = bytearray(100)
    good[16:18] = b"\0\1"
    found = file_head(bytes(good))
    assert found is not None
    assert found.page_size == 65536
    for place, value in ((16, 3), (17, 3), (20, 255)):
        bad = bytearray(good)
        bad[16:18] = b"\2\0"
        bad[place] = value
        assert file_head(bytes(bad)) is None
    assert file_head(bytes(good[:99])) is None
    assert rows_of(bytes(50)) == []
