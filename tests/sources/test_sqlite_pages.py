"""Rows of a SQLite file without its trees: what lies in pages that nothing leads to, or that lie."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.damage import Sent, write_db3
from vilp_data.sources.sqlite_pages import LEAF, MessageRow, file_head, message_rows

SHAPES: dict[str, dict[str, Any]] = {
    "small pages": {"page": 512, "longest": 3000},
    "small pages with bytes that are not SQLite's": {"page": 512, "reserved": 32, "longest": 3000},
    "usual pages": {"longest": 9000},
    "large pages": {"page": 65536, "longest": 100_000, "n": 12},
}


def rows_of(content: bytes, *, whole: int | None = None, largest: int = 1 << 30) -> list[MessageRow]:
    whole = len(content) if whole is None else whole
    return list(message_rows(io.BytesIO(content), len(content), whole=whole, largest=largest))


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
    """A page of 4 kB may point at one row of 2 kB six hundred times."""
    record = bytes([7, 0, 1, 6, *varint(12 + 2 * 1900), 1]) + bytes(8) + bytes(1900)
    cell = varint(len(record)) + b"\1" + record
    head = bytearray(4096)
    head[16:18] = (4096).to_bytes(2, "big")
    many = (4096 - 8 - len(cell)) // 2
    leaf = bytes([LEAF, 0, 0, *many.to_bytes(2, "big"), 0, 0, 0]) + struct.pack(">H", 4096 - len(cell)) * many
    rows = rows_of(bytes(head) + leaf + bytes(4096 - len(leaf) - len(cell)) + cell)
    assert 0 < len(rows) <= 2


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
