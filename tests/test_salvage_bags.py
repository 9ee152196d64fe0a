"""Salvage of ROS 1 bags into MCAP."""

from __future__ import annotations

import bz2
import random
import struct
from collections import Counter
from pathlib import Path
from typing import Literal

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


# --- descriptions -----------------------------------------------------------------------------------------------------


def write_numbers(path: Path, topic: str, *, n: int = 20) -> list[Sent]:
    """A bag of `n` std_msgs/Int32 on one topic, as connection 0."""
    sent = []
    with Writer(path) as writer:
        connection = writer.add_connection(topic, "std_msgs/msg/Int32", typestore=STORE)
        for k in range(n):
            writer.write(connection, 7_000_000_000 + k, struct.pack("<i", k))
            sent.append(Sent(topic, 7_000_000_000 + k, 7_000_000_000 + k, 0, struct.pack("<i", k)))
    return sent


def test_two_bags_in_one_file_keep_their_topics_and_types(tmp_path: Path) -> None:
    """As `cat` leaves them: both have a connection 0."""
    sent = write_bag(tmp_path / "run.bag", n=20) + write_numbers(tmp_path / "other.bag", "/numbers")
    path = tmp_path / "both.bag"
    found, report = salvaged(path, (tmp_path / "run.bag").read_bytes() + (tmp_path / "other.bag").read_bytes())
    assert Counter(found) == Counter(sent)
    assert report is not None
    assert not report.complete
    assert any("described twice" in doubt and "/numbers" in doubt for doubt in report.doubts)
    assert {name: topic.schema for name, topic in report.topics.items()}["/numbers"] == "std_msgs/Int32"
    with open_log(path.with_suffix(".salvaged")) as log:
        assert [message.body.data for message in log.messages(["/numbers"])] == list(range(20))


def test_real_bags_in_one_file_keep_their_topics_and_types(tmp_path: Path) -> None:
    folder = real_data("logs/webviz_bags")
    names = ("only-a-cube", "bag-with-empty-message-definition")
    paths = [folder / f"packages_webviz-core_public_fixtures_{name}.bag" for name in names]
    found, _ = salvaged(tmp_path / "both.bag", b"".join(path.read_bytes() for path in paths))
    alone = [message for path in paths for message in salvaged(tmp_path / "one.bag", path.read_bytes())[0]]
    assert Counter(found) == Counter(alone)


def test_a_connection_whose_number_changed_takes_no_messages_with_it(tmp_path: Path) -> None:
    """Connection 1 is first described as 2, and so is 2 itself: what comes before the right description cannot be told."""
    path = tmp_path / "run.bag"
    sent = write_bag(path)
    content = bytearray(path.read_bytes())
    place = content.index(b"conn=\x01\x00\x00\x00", content.index(b"topic=/t1") - 60) + 5
    content[place] = 2
    found, report = salvaged(path, bytes(content))
    assert report is not None
    assert Counter(found) == Counter(sent)
    assert not report.complete
    assert any("described twice" in doubt for doubt in report.doubts)


def test_messages_before_their_description_wait_for_the_index(tmp_path: Path) -> None:
    """The first chunk describes the connections, and is lost; the index at the end repeats them."""
    for compression in COMPRESSIONS:
        path = tmp_path / "run.bag"
        sent = write_bag(path, compression=compression)
        content = bytearray(path.read_bytes())
        first = content.index(b"op=\x05")
        begin = content.index(b"BZh", first) if compression == "bz2" else first + 60
        content[begin : begin + 600] = bytes(600)
        found, report = salvaged(path, bytes(content))
        assert report is not None
        assert len(found) > len(sent) * 3 // 4
        assert not Counter(found) - Counter(sent)
        assert not report.complete
