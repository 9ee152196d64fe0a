"""Salvage of ROS 2 bags in SQLite into MCAP: every row that is left, and none lost in silence."""

from __future__ import annotations

import random
import sqlite3
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from tests.damage import Sent, cuts, invented, mutated, read_log, salvaged
from tests.real_data import real_data
from vilp_data.errors import LogError
from vilp_data.salvage import salvage_log
from vilp_data.sources import open_log
from vilp_data.sources.db3_salvage import RowRanges

HUMBLE = get_typestore(Stores.ROS2_HUMBLE)


def write_db3(
    path: Path, *, n: int = 400, journal: str = "DELETE", longest: int = 2000, page: int = 4096, distro: str = ""
) -> list[Sent]:
    """A file as rosbag2 writes it, of std_msgs/String."""
    rng, sent = random.Random(0), []
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute(f"PRAGMA page_size={page}")
    database.execute(f"PRAGMA journal_mode={journal}")
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    for i in range(3):
        database.execute("INSERT INTO topics VALUES(?, ?, 'std_msgs/msg/String', 'cdr', '')", (i + 1, f"/t{i}"))
    if distro:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
        database.execute("INSERT INTO schema VALUES(4, ?)", (distro,))
    database.execute("BEGIN")
    for k in range(n):
        text = "".join(rng.choices("abcdefgh", k=rng.randrange(1, longest))).encode() + b"\0"
        data = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (k % 3 + 1, 1000 + k, data))
        sent.append(Sent(f"/t{k % 3}", 1000 + k, 1000 + k, 0, data))
    database.execute("COMMIT")
    if journal == "WAL":
        kept = path.with_name("kept-wal")
        kept.write_bytes(path.with_name(path.name + "-wal").read_bytes())
        main = path.read_bytes()
        database.close()
        path.write_bytes(main)
        kept.rename(path.with_name(path.name + "-wal"))
    else:
        database.close()
    return sent


def test_a_whole_db3_becomes_an_mcap_that_carries_its_definitions(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path)
    found, report = salvaged(path)
    assert found == sent
    assert report is not None
    assert report.whole
    with open_log(path.with_suffix(".salvaged")) as log:
        assert next(iter(log.messages(["/t0"]))).body.data == sent[0].data[8:-1].decode()


def test_a_db3_cut_short_gives_the_rows_that_are_left(tmp_path: Path) -> None:
    path, before = tmp_path / "run.db3", -1
    sent = write_db3(path)
    content = path.read_bytes()
    for part in cuts(content, steps=8)[1:]:
        found, report = salvaged(tmp_path / "cut.db3", part)
        assert invented(found, sent) == 0
        assert len(found) >= before
        assert report is None or report.complete == (len(part) == len(content))
        before = len(found)
    assert before == len(sent)


def test_a_damaged_page_costs_the_rows_in_it(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path)
    content = bytearray(path.read_bytes())
    place = content.index(sent[200].data[:100]) // 4096 * 4096
    content[place : place + 4096] = bytes(4096)
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert invented(found, sent) == 0
    assert len(sent) - 20 < len(found) < len(sent)
    assert not report.complete


def test_what_lies_in_the_journal_of_a_killed_recorder_is_taken_in_and_the_bag_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, journal="WAL")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    assert len(before) == 2
    report: Any = salvage_log(path, tmp_path / "out.mcap")
    assert read_log(tmp_path / "out.mcap") == sent
    assert report.complete
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.name != "out.mcap"} == before


def test_an_sqlite_file_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE a(b)")
    database.commit()
    database.close()
    with pytest.raises(LogError, match="no bag of ROS 2"):
        salvage_log(path, tmp_path / "out.mcap")


# --- what SQLite itself does not notice -------------------------------------------------------------------------------


def test_rows_that_the_index_of_times_lacks_come_back(tmp_path: Path) -> None:
    """One count in the index is halved: SQLite answers every question about times without the other half, and says nothing."""
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=60)
    content = bytearray(path.read_bytes())
    place = (root_page(path, "timestamp_idx") - 1) * 4096 + 3
    content[place : place + 2] = struct.pack(">H", struct.unpack_from(">H", content, place)[0] // 2)
    path.write_bytes(content)
    with sqlite3.connect(path) as database:
        assert database.execute("SELECT COUNT(*) FROM messages WHERE timestamp >= 0").fetchone() == (30,)
    found, report = salvaged(path)
    assert found == sent
    assert report is not None
    assert not report.complete
    assert "check of the file fails" in report.doubts[0]


def test_the_real_bag_whose_index_lost_half_its_rows_comes_back(tmp_path: Path) -> None:
    (source,) = [path for path in real_data("logs/rosbag2_tests").rglob("talker.db3") if path.parent.name == "talker"]
    path = tmp_path / "talker.db3"
    content = bytearray(source.read_bytes())
    place = (root_page(source, "timestamp_idx") - 1) * 4096 + 3
    content[place : place + 2] = b"\0\x0a"
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert (len(found), report.complete) == (20, False)


def root_page(path: Path, name: str) -> int:
    with sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True) as database:
        return int(database.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (name,)).fetchone()[0])


@pytest.mark.parametrize(
    "step", [pytest.param(61, id="some"), pytest.param(1, id="every byte", marks=pytest.mark.slow)]
)
def test_a_damaged_byte_of_a_pages_head_or_of_the_schema_never_loses_rows_in_silence(tmp_path: Path, step: int) -> None:
    """A topic's name is data: nothing tells that it changed."""
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=60, longest=60, page=512)
    content = path.read_bytes()
    places = [
        *range(100),
        *range(100, 1024),
        *(page + byte for page in range(0, len(content), 512) for byte in range(24)),
    ]
    for place in places[::step]:
        for value in (content[place] ^ 1, content[place] ^ 128, content[place] // 2, 0):
            if value == content[place]:
                continue
            changed = bytearray(content)
            changed[place] = value
            found, report = salvaged(tmp_path / "damaged.db3", bytes(changed))
            if report is not None:
                same = Counter(m[1:] for m in found) == Counter(m[1:] for m in sent)
                assert same or not report.complete, f"byte {place} became {value}"


@pytest.mark.parametrize("rounds", [pytest.param(25, id="some"), pytest.param(1500, id="many", marks=pytest.mark.slow)])
def test_no_message_is_lost_in_silence(tmp_path: Path, rounds: int) -> None:
    """SQLite keeps no checksum: a changed byte inside a message cannot be seen, a missing message can."""
    path, rng = tmp_path / "run.db3", random.Random(4)
    sent = write_db3(path, n=60, longest=200, page=1024)
    content = path.read_bytes()
    for _ in range(rounds):
        found, report = salvaged(tmp_path / "damaged.db3", mutated(content, rng))
        if report is not None:
            assert not report.complete or len(found) == len(sent)
            with open_log(tmp_path / "damaged.salvaged") as log:
                assert sum(topic.message_count or 0 for topic in log.topics()) == len(found)


def test_damage_in_several_places_costs_the_rows_there(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path)
    content = bytearray(path.read_bytes())
    for row in (50, 200, 399):
        place = content.index(sent[row].data[:100]) // 4096 * 4096
        content[place : place + 4096] = bytes(4096)
    found, report = salvaged(path, bytes(content))
    assert invented(found, sent) == 0
    assert len(sent) - 40 < len(found) < len(sent)
    assert report is not None
    assert report.lost is None


# --- definitions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distro", "has_variance"), [("", False), ("humble", False), ("jazzy", True)])
def test_a_type_that_the_bag_does_not_define_is_that_of_its_own_release(
    tmp_path: Path, distro: str, has_variance: bool
) -> None:
    """sensor_msgs/Range has a field more since ROS 2 Iron; a bag that names no release is read as Humble."""
    path = tmp_path / "run.db3"
    store = get_typestore(Stores.ROS2_JAZZY) if has_variance else HUMBLE
    write_db3(path, n=3, distro=distro)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    fields = {"radiation_type": 1, "field_of_view": 0.1, "min_range": 0.2, "max_range": 3.0, "range": 1.5}
    fields |= {"variance": 0.5} if has_variance else {}
    body = types["sensor_msgs/msg/Range"](header=types["std_msgs/msg/Header"](stamp, "f"), **fields)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE topics SET type = 'sensor_msgs/msg/Range'")
        database.execute("UPDATE messages SET data = ?", (bytes(store.serialize_cdr(body, "sensor_msgs/msg/Range")),))
    _, report = salvaged(path)
    assert report is not None
    assert report.whole
    for file in (path, path.with_suffix(".salvaged")):
        with open_log(file) as log:
            (message,) = log.messages(["/t0"])
        assert message.body.range == 1.5
        assert hasattr(message.body, "variance") == has_variance


# --- what is remembered -----------------------------------------------------------------------------------------------


@given(st.lists(st.integers(-5, 40)))
def test_ranges_of_rows_know_what_a_set_knows(numbers: list[int]) -> None:
    ranges, seen = RowRanges(), set[int]()
    for number in numbers:
        assert ranges.add(number) == (number not in seen)
        seen.add(number)
    assert len(ranges) == sum(number - 1 not in seen for number in seen)
