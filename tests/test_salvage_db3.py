"""Salvage of ROS 2 bags in SQLite into MCAP: every row that is left, and none lost in silence."""

from __future__ import annotations

import random
import sqlite3
import struct
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from tests.damage import Sent, cuts, invented, mutated, read_log, salvaged, write_db3, write_two_tables
from tests.real_data import real_data
from vilp_data import limits
from vilp_data.errors import LogError
from vilp_data.salvage import salvage_log
from vilp_data.sources import open_log
from vilp_data.sources.sqlite_pages import LEAF

HUMBLE = get_typestore(Stores.ROS2_HUMBLE)
STEPS = [pytest.param(12, id="some"), pytest.param(100, id="every percent", marks=pytest.mark.slow)]
SHAPES: dict[str, dict[str, Any]] = {
    "many small rows": {"n": 1500, "longest": 40},
    "rows of about a page": {"n": 300},
    "rows of several pages": {"n": 40, "longest": 20_000},
    "the smallest pages": {"n": 100, "page": 512},
    "the largest pages": {"n": 30, "longest": 60_000, "page": 65536},
    "bytes that are not SQLite's": {"n": 100, "page": 1024, "reserved": 40},
}


def test_a_whole_db3_becomes_an_mcap_that_carries_its_definitions(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path)
    found, report = salvaged(path)
    assert found == sent
    assert report is not None
    assert report.whole
    with open_log(path.with_suffix(".salvaged")) as log:
        assert next(iter(log.messages(["/t0"]))).body.data == sent[0].data[8:-1].decode()


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_cut_db3_gives_every_row_whose_pages_are_there_and_never_fewer_as_more_bytes_are_there(
    tmp_path: Path, shape: str, steps: int
) -> None:
    path, before = tmp_path / "run.db3", 0
    sent = write_db3(path, **SHAPES[shape])
    content = path.read_bytes()
    ends = [last_byte(content, message.data) for message in sent]
    page = SHAPES[shape].get("page", 4096)
    for part in cuts(content, steps=steps):
        found, report = salvaged(tmp_path / "cut.db3", part)
        assert not invented(found, sent)
        assert found == sorted(found, key=lambda message: message.log_time_ns)
        there = len(part) // page * page
        assert len(found) >= max(before, sum(end <= there for end in ends))
        assert report is None or report.complete == (len(part) == len(content))
        before = len(found)
    assert before == len(sent)


def last_byte(content: bytes, data: bytes) -> int:
    """Where a message ends in a file, piece by piece, found by its bytes alone: the latest place where a piece is in several."""
    done = last = 0
    while done < len(data):
        place = content.rindex(data[done : done + 24])
        same = 0
        while done + same < len(data) and content[place + same] == data[done + same]:
            same += 1
        done, last = done + same, max(last, place + same)
    return last


def test_what_a_journal_holds_of_a_cut_db3_comes_back_and_nothing_else_behind_the_cut(tmp_path: Path) -> None:
    """The journal's pages go where they belong, behind the cut; between them lies nothing, nor in the page that is cut."""
    sent, content, journal = write_journalled(tmp_path / "run.db3", n=100, more=20)
    ends = [last_byte(content, message.data) for message in sent[:100]]
    for page in range(40, 50):
        (tmp_path / "cut.db3-wal").write_bytes(journal)
        found, report = salvaged(tmp_path / "cut.db3", content[: page * 4096 + 4000])
        assert not invented(found, sent)
        assert found[-20:] == sent[-20:]
        assert sum(end <= page * 4096 for end in ends) <= len(found) - 20 < 100
        assert report is not None
        assert not report.complete
        assert "cut off" in report.doubts[0]


def test_a_journal_that_is_too_far_behind_the_cut_is_not_said_to_be_taken_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "RECORD_BYTES", 1 << 16)
    sent, content, journal = write_journalled(tmp_path / "run.db3", n=200, more=2)
    (tmp_path / "cut.db3-wal").write_bytes(journal)
    found, report = salvaged(tmp_path / "cut.db3", content[: len(content) // 10])
    assert 10 < len(found) < 30
    assert not invented(found, sent)
    assert report is not None
    assert "cut.db3-wal could not be taken in" in report.doubts[-1]
    assert not report.notes


def write_journalled(path: Path, *, n: int, more: int) -> tuple[list[Sent], bytes, bytes]:
    """What was sent, a file of `n` messages, and a journal of `more`, which no checkpoint has put into the file."""
    sent = write_db3(path, n=n, longest=9000)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA journal_mode=WAL")
    for k in range(n, n + more):
        data = bytes([k]) * 9000
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", (1000 + k, data))
        sent.append(Sent("/t0", 1000 + k, 1000 + k, 0, data))
    content, journal = path.read_bytes(), path.with_name("run.db3-wal").read_bytes()
    database.close()
    return sent, content, journal


def test_a_rolled_back_transaction_of_a_cut_db3_leaves_no_row(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=200, longest=9000)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA cache_size = 5")  # so that pages are written before the commit
    database.execute("BEGIN")
    database.execute("UPDATE messages SET data = zeroblob(9000)")
    content, journal = path.read_bytes(), path.with_name("run.db3-journal").read_bytes()
    database.close()
    path.with_name("cut.db3-journal").write_bytes(journal)
    found, report = salvaged(tmp_path / "cut.db3", content[: len(content) // 2])
    assert report is not None
    assert not invented(found, sent)
    assert len(found) > 80


def test_a_head_that_claims_the_most_pages_there_can_be_costs_no_row_and_no_time(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path)
    content = bytearray(path.read_bytes())
    content[28:32] = b"\xff" * 4
    begin = time.monotonic()
    found, report = salvaged(path, bytes(content))
    assert time.monotonic() - begin < 5
    assert found == sent
    assert report is not None
    assert not report.complete


def test_a_journal_that_makes_the_file_a_terabyte_costs_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rolling back restores the size that a journal names; a file system stores no zeros for it."""
    monkeypatch.setattr(limits, "RECORD_BYTES", 1 << 24)
    path = tmp_path / "run.db3"
    write_db3(path, n=50)
    content = path.read_bytes()
    head = bytes.fromhex("d9d505f920a163d7") + struct.pack(">5I", 0, 1, 1 << 28, 512, 4096)
    path.with_name("run.db3-journal").write_bytes(head.ljust(512, b"\0"))
    begin = time.monotonic()
    found, report = salvaged(path, content[: len(content) // 2])
    assert time.monotonic() - begin < 5
    assert 10 < len(found) < 50
    assert report is not None
    assert "VILP_MAX_RECORD_BYTES" in report.doubts[-1]


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


def test_a_message_above_the_limit_costs_no_other_one_of_a_sound_db3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = write_db3(tmp_path / "run.db3", n=60, longest=9000)
    monkeypatch.setattr(limits, "RECORD_BYTES", 8500)
    found, report = salvaged(tmp_path / "run.db3")
    assert report is not None
    assert not report.complete
    assert found == [message for message in sent if len(message.data) < 8480]
    assert 40 < len(found) < 60


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


def test_a_definition_or_a_name_that_is_not_all_there_is_none(tmp_path: Path) -> None:
    """SQLite answers with zeros for bytes that a file lacks."""
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=30)
    database = sqlite3.connect(path)
    database.execute(
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,"
        " encoded_message_definition TEXT, type_description_hash TEXT)"
    )
    damaged = "string data\n" + "\0" * 50
    database.execute("INSERT INTO message_definitions VALUES(1, 'std_msgs/msg/String', 'ros2msg', ?, '')", (damaged,))
    database.execute("UPDATE topics SET name = ? WHERE id = 2", ("/t\0\0",))
    database.commit()
    database.close()
    found, report = salvaged(path)
    assert found == [message for message in sent if message.topic != "/t1"]
    assert report is not None
    assert not report.complete
    text = " ".join(report.doubts)
    assert "'std_msgs/msg/String' is damaged" in text
    assert "a topic's row is damaged" in text
    with open_log(path.with_suffix(".salvaged")) as log:
        assert next(iter(log.messages(["/t0"]))).body.data == sent[0].data[8:-1].decode()


# --- rows that are no messages ----------------------------------------------------------------------------------------


def written_beside_thumbs(path: Path, *, topic_id: int, without_roots: bool) -> tuple[list[Sent], bytes]:
    """What was sent, and a bag that lacks its last page; it has another table of the same shape, with rows of topic `topic_id` under
    the same ids. `without_roots`: nothing leads to the leaves of either."""
    sent, roots = write_two_tables(path, topic_id=topic_id)
    content = bytearray(path.read_bytes()[:-512])
    for root in (roots["messages"], roots["thumbs"]) if without_roots else ():
        content[root * 512 - 512 : root * 512] = bytes(512)
    return sent, bytes(content)


def test_rows_of_another_table_are_no_messages(tmp_path: Path) -> None:
    sent, content = written_beside_thumbs(tmp_path / "run.db3", topic_id=1, without_roots=False)
    found, report = salvaged(tmp_path / "cut.db3", content)
    assert report is not None
    assert found == sent[: len(found)]
    assert len(found) > 110
    assert len(report.doubts) == 1


def test_rows_of_another_table_to_which_nothing_leads_replace_no_message(tmp_path: Path) -> None:
    sent, content = written_beside_thumbs(tmp_path / "run.db3", topic_id=1, without_roots=True)
    found, report = salvaged(tmp_path / "cut.db3", content)
    assert report is not None
    assert len(set(found) & set(sent)) > 110
    told = " ".join(report.doubts)
    assert f"{len(found)} messages in pages that the table of messages no longer leads to" in told
    assert "rows under the id of another one that is unlike it" in told


def test_rows_whose_topic_is_not_known_stand_for_no_message(tmp_path: Path) -> None:
    sent, content = written_beside_thumbs(tmp_path / "run.db3", topic_id=99, without_roots=True)
    found, report = salvaged(tmp_path / "cut.db3", content)
    assert report is not None
    assert found == sent[: len(found)]
    assert len(found) > 110
    assert any("180 messages are left out" in doubt for doubt in report.doubts)


def test_of_two_unlike_rows_under_one_id_that_of_the_messages_tree_is_taken(tmp_path: Path) -> None:
    """Nothing leads to the other table's rows, which lie before the messages; 60 of them have ids of their own."""
    path = tmp_path / "run.db3"
    sent, roots = write_two_tables(path)
    content = bytearray(path.read_bytes())
    content[roots["thumbs"] * 512 - 512 : roots["thumbs"] * 512] = bytes(512)
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert found[:120] == sent
    assert len(found) == 180
    told = " ".join(report.doubts)
    assert "60 messages in pages that" in told
    assert "120 rows under the id of another one" in told


def test_a_row_that_lies_in_two_pages_is_one_message(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=60)
    content = bytearray(path.read_bytes())
    pages = [bytes(content[place : place + 4096]) for place in range(4096, len(content), 4096)]
    content += b"".join(page for page in pages if page[0] == LEAF)
    content[28:32] = (1000).to_bytes(4, "big")  # pages, as if more had been cut off
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert found == sent
    assert len(report.doubts) == 1


def test_a_table_of_messages_whose_name_is_damaged_is_no_other_table(tmp_path: Path) -> None:
    sent = write_db3(tmp_path / "run.db3", n=60)
    content = (tmp_path / "run.db3").read_bytes()[:-4096].replace(b"tablemessages", b"tablemessagez")
    found, report = salvaged(tmp_path / "cut.db3", content)
    assert report is not None
    assert found == sent[: len(found)]
    assert len(found) > 50
    assert any(f"{len(found)} messages in pages that" in doubt for doubt in report.doubts)


def test_deleted_rows_whose_pages_the_cut_file_no_longer_lists_as_free_are_doubted(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    sent = write_db3(path, n=300)
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA secure_delete = OFF")
        database.execute("DELETE FROM messages WHERE id > 250")  # the first page that comes free lists the others
        database.execute("DELETE FROM messages WHERE id <= 100")
        database.commit()
    content = path.read_bytes()
    (lists,) = struct.unpack_from(">I", content, 32)
    found, report = salvaged(tmp_path / "cut.db3", content[: (lists - 1) * 4096])
    assert report is not None
    again = len(set(found) & {*sent[:100], *sent[250:]})
    assert again
    assert any(f"{again} messages in pages that" in doubt and "deleted" in doubt for doubt in report.doubts)


@pytest.mark.slow
def test_pages_full_of_row_ids_at_random_cost_no_time(tmp_path: Path) -> None:
    rng, path = random.Random(0), tmp_path / "run.db3"
    write_db3(path, n=1, page=65536)
    content = bytearray(path.read_bytes())
    record = bytes([5, 0, 9, 8, 12])
    for _ in range(64):
        cells = [
            b"\x05" + struct.pack(">I", rng.getrandbits(32) | 0x80808000)[:3] + bytes([rng.randrange(128)]) + record
            for _ in range(5000)
        ]
        pointers = struct.pack(">5000H", *range(65536 - 10 * 5000, 65536, 10))
        content += (bytes([LEAF, 0, 0]) + struct.pack(">H", 5000) + bytes(3) + pointers).ljust(
            65536 - 10 * 5000, b"\0"
        ) + b"".join(cells)
    content[28:32] = (len(content) // 65536 + 10).to_bytes(4, "big")
    begin = time.process_time()
    found, report = salvaged(path, bytes(content))
    assert time.process_time() - begin < 10
    assert len(found) > 100
    assert report is not None
    assert any("left out, whose ids do not fit" in doubt for doubt in report.doubts)
