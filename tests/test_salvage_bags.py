"""Salvage of ROS 1 bags and db3 files into MCAP."""

from __future__ import annotations

import bz2
import random
import sqlite3
import struct
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from tests.damage import Sent, cuts, invented, mutated, read_log, salvaged
from tests.real_data import real_data
from vilp_data.errors import LogError
from vilp_data.salvage import salvage_log
from vilp_data.salvage_report import format_report
from vilp_data.sources import open_log

Compression = Literal["none", "bz2", "lz4"]
COMPRESSIONS: tuple[Compression, ...] = ("none", "bz2", "lz4")
STEPS = [pytest.param(12, id="some"), pytest.param(100, id="every percent", marks=pytest.mark.slow)]
STORE = get_typestore(Stores.ROS1_NOETIC)


def write_bag(path: Path, *, compression: Compression = "none", n: int = 150, chunk_bytes: int = 5000) -> list[Sent]:
    """A bag of `n` std_msgs/String on three topics."""
    rng, sent = random.Random(0), []
    path.unlink(missing_ok=True)
    writer = Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = [writer.add_connection(f"/t{i}", "std_msgs/msg/String", typestore=STORE) for i in range(3)]
        for k in range(n):
            text = "".join(rng.choices("abcdefgh", k=rng.randrange(200))) + "x" * rng.randrange(100)
            data = bytes(STORE.serialize_ros1(STORE.types["std_msgs/msg/String"](text), "std_msgs/msg/String"))
            time_ns = 5_000_000_000 + 10_000_000 * k
            writer.write(connections[k % 3], time_ns, data)
            sent.append(Sent(f"/t{k % 3}", time_ns, time_ns, 0, data))
    return sent


def rosbags_count(path: Path) -> int:
    """Messages that rosbags gets out before it gives up."""
    count = 0
    try:
        with Reader(path) as reader:
            for _ in reader.messages():
                count += 1
    except Exception:
        return count
    return count


def field(header: bytes, name: bytes) -> bytes | None:
    place = header.find(name + b"=")
    return None if place < 0 else header[place + len(name) + 1 :]


def inflatable(content: bytes) -> int:
    """Whole messages in a cut bag, counted by walking it and inflating its last chunk as far as the libraries do."""

    def walk(data: bytes, position: int, top: bool) -> int:
        count = 0
        while position + 4 <= len(data):
            (length,) = struct.unpack_from("<I", data, position)
            header = data[position + 4 : position + 4 + length]
            if position + 8 + length > len(data):
                break
            (size,) = struct.unpack_from("<I", data, position + 4 + length)
            body = data[position + 8 + length : position + 8 + length + size]
            op = field(header, b"op")
            if op is not None and op[0] == 2:
                count += len(body) == size
            elif op is not None and op[0] == 5 and top:
                how = field(header, b"compression") or b""
                if how.startswith(b"bz2"):
                    body = bz2.BZ2Decompressor().decompress(body)
                elif how.startswith(b"lz4"):
                    body = lz4.frame.LZ4FrameDecompressor().decompress(body)
                count += walk(body, 0, False)
            position += 8 + length + size
        return count

    return walk(content, 13, True)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_whole_bag_becomes_an_mcap_with_every_message(tmp_path: Path, compression: Compression) -> None:
    path = tmp_path / "run.bag"
    sent = write_bag(path, compression=compression)
    found, report = salvaged(path)
    assert found == sent
    assert report is not None
    assert report.whole
    assert "is whole (150 messages); copied as it is, into MCAP" in format_report(report)
    with open_log(path.with_suffix(".salvaged")) as log:
        messages = list(log.messages(["/t1"]))
        assert (messages[0].schema, messages[0].body.data) == ("std_msgs/msg/String", sent[1].data[4:].decode())


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_cut_bag_gives_every_message_that_inflates_and_never_fewer_as_more_bytes_are_there(
    tmp_path: Path, compression: Compression, steps: int
) -> None:
    path, before = tmp_path / "run.bag", 0
    sent = write_bag(path, compression=compression, n=400, chunk_bytes=20_000)
    for part in cuts(path.read_bytes(), steps=steps):
        cut = tmp_path / "cut.bag"
        found, report = salvaged(cut, part)
        assert found == sent[: len(found)]
        assert len(found) >= max(before, inflatable(part), rosbags_count(cut))
        assert report is None or report.complete == (len(part) == path.stat().st_size)
        before = len(found)
    assert before == len(sent)


@pytest.mark.parametrize("rounds", [pytest.param(20, id="some"), pytest.param(600, id="many", marks=pytest.mark.slow)])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_no_message_is_invented_and_none_is_lost_in_silence(
    tmp_path: Path, compression: Compression, rounds: int
) -> None:
    """An uncompressed bag carries no checksum at all: there a changed byte inside a message cannot be seen, by anyone."""
    path, rng = tmp_path / "run.bag", random.Random(4)
    sent = write_bag(path, compression=compression, n=60, chunk_bytes=3000)
    content = path.read_bytes()
    for _ in range(rounds):
        found, report = salvaged(tmp_path / "damaged.bag", mutated(content, rng))
        if report is None:
            continue
        assert not report.complete or len(found) == len(sent)
        if compression == "bz2":
            assert invented(found, sent) <= report.suspicious + report.unverified


def test_a_bag_whose_recorder_was_killed_gives_its_open_chunk_too(tmp_path: Path) -> None:
    """rosbag writes a chunk's sizes, and the place of the index, when it is done with them."""
    for compression in COMPRESSIONS:
        path = tmp_path / "run.bag"
        sent = write_bag(path, compression=compression, n=200, chunk_bytes=30_000)
        content = bytearray(path.read_bytes())
        index = content.index(b"index_pos=") + 10
        end = struct.unpack_from("<Q", content, index)[0]
        content[index : index + 8] = bytes(8)
        last = content.rindex(b"compression=", 0, end)
        start = max(content.rindex(b"\x04\x00\x00\x00op=\x05", 0, end), last)
        (header_begin,) = [s for s in range(start - 60, start) if _chunk_header_at(content, s)][:1]
        (length,) = struct.unpack_from("<I", content, header_begin)
        content[header_begin + 4 + length : header_begin + 8 + length] = bytes(4)
        size = content.index(b"size=", header_begin) + 5
        content[size : size + 4] = bytes(4)
        cut = bytes(content[: end - 200])
        found, report = salvaged(tmp_path / "open.bag", cut)
        assert report is not None
        assert found == sent[: len(found)]
        assert len(found) > len(sent) // 2 if compression != "bz2" else found
        assert rosbags_count(tmp_path / "open.bag") == 0
        assert "no index" in format_report(report)


def _chunk_header_at(content: bytearray, place: int) -> bool:
    (length,) = struct.unpack_from("<I", content, place)
    header = bytes(content[place + 4 : place + 4 + length])
    return 30 < length < 80 and b"op=\x05" in header and b"compression=" in header and header[4:].find(b"=") > 0


def test_behind_a_bad_record_in_a_bag_reading_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    sent = write_bag(path)
    content = bytearray(path.read_bytes())
    place = content.index(sent[20].data) - 4
    content[place : place + 4] = b"\xff" * 4
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert found == sent[:20] + sent[21:]
    assert (report.lost, report.complete) == (1, False)


def test_real_bags_give_the_messages_that_rosbags_reads(tmp_path: Path) -> None:
    folder = real_data("logs/webviz_bags")
    for path in sorted([*folder.glob("*fixtures_only*.bag"), *folder.glob("*.lz4.bag")]):
        out = tmp_path / "out.mcap"
        report = salvage_log(path, out, force=True)
        with Reader(path) as reader:
            theirs = Counter((c.topic, time, bytes(data)) for c, time, data in reader.messages())
        assert Counter((m.topic, m.log_time_ns, m.data) for m in read_log(out)) == theirs
        assert report.whole, format_report(report)


def test_the_real_bag_without_a_body_says_so(tmp_path: Path) -> None:
    path = real_data("logs/webviz_bags/packages_webviz-core_src_dataSources_bag_invalid.bag")
    with pytest.raises(LogError, match="nothing can be recovered"):
        salvage_log(path, tmp_path / "out.mcap")


# --- db3 --------------------------------------------------------------------------------------------------------------


def write_db3(path: Path, *, n: int = 400, journal: str = "DELETE") -> list[Sent]:
    """A file as rosbag2 writes it, of std_msgs/String."""
    rng, sent = random.Random(0), []
    path.unlink(missing_ok=True)
    database = sqlite3.connect(path, isolation_level=None)
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
    database.execute("BEGIN")
    for k in range(n):
        text = "".join(rng.choices("abcdefgh", k=rng.randrange(1, 2000))).encode() + b"\0"
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
