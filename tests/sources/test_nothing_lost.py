"""What a log's own indexes say is not believed alone: a number that was changed is an error or a doubt, and never a shorter log."""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer

from tests.synthetic import write_mcap
from tests.synthetic_bags import ROS1_STORE, raw_messages, with_files, write_rosbag1, write_rosbag2
from vilp_data.errors import LogError
from vilp_data.sources import open_log

Sent = list[tuple[str, int]]


@pytest.fixture(scope="module")
def sent(bag: Path) -> Sent:
    found = handed_out(bag)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ros1")
    return write_rosbag1(folder / "run.bag", write_mcap(folder / "run.mcap", n_frames=6, height=16, width=24))


@pytest.fixture(scope="module")
def db3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ros2")
    return write_rosbag2(folder / "run", write_mcap(folder / "run.mcap", n_frames=6, height=16, width=24)) / "run.db3"


def handed_out(path: Path) -> Sent | None:
    """(topic, log time) of every message, read topic by topic and by halves of the time; None where an error or a doubt comes."""
    try:
        with open_log(path) as log:
            if log.doubts():
                return None
            found = []
            for topic in log.topics():
                for episode in log.episodes():
                    middle = (episode.start_ns + episode.end_ns) // 2
                    for start, end in ((episode.start_ns, middle), (middle, episode.end_ns)):
                        messages = log.messages([topic.name], start_ns=start, end_ns=end)
                        found += [(message.topic, message.log_time_ns) for message in messages]
    except LogError as error:
        assert error.remedy
        return None
    return found


# --- ROS 1 ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", [b"conn_count=", b"chunk_count="])
def test_a_bag_is_read_by_no_other_count_of_its_index(bag: Path, sent: Sent, tmp_path: Path, field: bytes) -> None:
    content = bag.read_bytes()
    place = content.index(field) + len(field)
    (count,) = struct.unpack_from("<I", content, place)
    path = tmp_path / "run.bag"
    for other in range(count + 3):
        path.write_bytes(content[:place] + struct.pack("<I", other) + content[place + 4 :])
        assert handed_out(path) == (sent if other == count else None)


def test_no_bit_of_a_bags_index_makes_it_shorter(bag: Path, sent: Sent, tmp_path: Path) -> None:
    """Of the bag header and every chunk info: counts, offsets, connections, times. Bits of a topic's or a type's name are not among
    them: the chunks repeat those."""
    content = bag.read_bytes()
    (index,) = struct.unpack_from("<Q", content, content.index(b"index_pos=") + len(b"index_pos="))
    infos = content.index(b"chunk_pos=", index) - 60
    rng, path = random.Random(0), tmp_path / "run.bag"
    places = [*range(13, 120), *range(infos, min(infos + 300, len(content))), *range(len(content) - 100, len(content))]
    for place in places[::3]:
        changed = bytearray(content)
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        assert handed_out(path) in (None, sent), place


def test_a_chunk_that_the_index_lists_twice_is_an_error(bag: Path, tmp_path: Path) -> None:
    content = bytearray(bag.read_bytes())
    places = [place + 10 for place in _all(bytes(content), b"chunk_pos=")]
    content[places[1] : places[1] + 8] = content[places[0] : places[0] + 8]
    (tmp_path / "run.bag").write_bytes(content)
    assert handed_out(tmp_path / "run.bag") is None


@pytest.fixture(scope="module")
def alike(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag whose topics are of one type: a message fits any of them, so decoding tells nothing of where it belongs."""
    path = tmp_path_factory.mktemp("alike") / "run.bag"
    with Rosbag1Writer(path) as writer:
        writer.chunk_threshold = 200
        connections = [writer.add_connection(f"/t{n}", "std_msgs/msg/Int32", typestore=ROS1_STORE) for n in range(3)]
        for n in range(9):
            writer.write(connections[n % 3], 10**18 + n * 10**8, struct.pack("<i", n))
    return path


def test_a_bags_message_under_another_connection_or_time_is_an_error(alike: Path, tmp_path: Path) -> None:
    """One bit of each byte of both, in chunks that nothing compresses and no checksum guards."""
    content, path = alike.read_bytes(), tmp_path / "run.bag"
    assert handed_out(alike) is not None
    messages = list(_all(content, b"op=\x02"))
    assert len(messages) == 9
    for record in messages:
        for field, size in ((b"conn=", 4), (b"time=", 8)):
            begin = content.index(field, record) + len(field)
            for place in range(begin, begin + size):
                changed = bytearray(content)
                changed[place] ^= 1 << place % 8
                path.write_bytes(changed)
                assert handed_out(path) is None, (record, field, place - begin)


def test_a_bags_topic_or_type_by_another_name_is_an_error(alike: Path, tmp_path: Path) -> None:
    """Whether in the bag's index or in a chunk: each tells of the other. A topic's name stands twice in each; the second is for nobody."""
    content, path, expected = alike.read_bytes(), tmp_path / "run.bag", handed_out(alike)
    caught = []
    for name, other in ((b"topic=/t1", b"topic=/t2"), (b"type=std_msgs/Int32", b"type=std_msgs/UInt8")):
        for place in _all(content, name):
            path.write_bytes(content[:place] + other + content[place + len(name) :])
            found = handed_out(path)
            assert found in (None, expected), (name, place)
            caught += [name] if found is None else []
    assert caught.count(b"topic=/t1") == 2
    assert caught.count(b"type=std_msgs/Int32") == 6


def test_a_bag_behind_a_bag_is_not_passed_over(alike: Path, tmp_path: Path) -> None:
    """As two parts put one after the other, which no bag is made of, though each is whole."""
    path = tmp_path / "run.bag"
    path.write_bytes(alike.read_bytes() * 2)
    with pytest.raises(LogError, match=f"{alike.stat().st_size:,} bytes behind what the bag header counts"):
        open_log(path)


def test_a_bag_with_zeros_behind_it_is_whole(bag: Path, sent: Sent, tmp_path: Path) -> None:
    """As a copy to a block device leaves it."""
    (tmp_path / "run.bag").write_bytes(bag.read_bytes() + bytes(5000))
    assert handed_out(tmp_path / "run.bag") == sent


def _all(content: bytes, part: bytes) -> Iterator[int]:
    place = content.find(part)
    while place >= 0:
        yield place
        place = content.find(part, place + 1)


# --- ROS 2 ------------------------------------------------------------------------------------------------------------


def index_root(path: Path) -> int:
    """Where the page of the index of times begins."""
    with sqlite3.connect(path) as database:
        ((page,),) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'timestamp_idx'").fetchall()
        ((size,),) = database.execute("PRAGMA page_size").fetchall()
    return int((page - 1) * size)


def test_an_index_of_times_that_lacks_rows_does_not_halve_a_db3(db3: Path, tmp_path: Path) -> None:
    content = bytearray(db3.read_bytes())
    root = index_root(db3)
    (cells,) = struct.unpack_from(">H", content, root + 3)
    assert cells > 2
    struct.pack_into(">H", content, root + 3, cells // 2)
    path = tmp_path / "run.db3"
    path.write_bytes(content)
    with open_log(path) as log:
        topics = log.topics()
        assert sum(topic.message_count or 0 for topic in topics) == len(handed_out(db3) or ())
        with pytest.raises(LogError, match=r"index timestamp_idx(.|\n)*salvage"):
            list(log.messages([topic.name for topic in topics]))


def test_no_byte_of_a_db3_page_head_makes_it_shorter(db3: Path, tmp_path: Path) -> None:
    content, whole = db3.read_bytes(), handed_out(db3)
    (size,) = struct.unpack_from(">H", content, 16)
    path, rng = tmp_path / "run.db3", random.Random(0)
    for page in range(0, len(content), size):
        for place in range(page + (100 if page == 0 else 0), page + (112 if page == 0 else 12)):
            changed = bytearray(content)
            changed[place] ^= 1 << rng.randrange(8)
            path.write_bytes(changed)
            assert handed_out(path) in (None, whole), place


def test_a_file_that_metadata_lists_twice_is_refused(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "run", write_mcap(tmp_path / "run.mcap", n_frames=4), parts=2)
    metadata = folder / "metadata.yaml"
    metadata.write_text(with_files(metadata.read_text(), ["run_0.db3", "./run_0.db3"]))
    with pytest.raises(LogError, match=r"twice(.|\n)*run_0\.db3(.|\n)*reindex"):
        open_log(folder)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_with_fewer_messages_than_its_metadata_counts_says_so(tmp_path: Path, storage: str) -> None:
    """Whether it is opened by its folder or by its file."""
    log = write_mcap(tmp_path / "run.mcap", n_frames=4)
    folder = write_rosbag2(tmp_path / "run", log, storage=storage)  # type: ignore[arg-type]
    count = len(raw_messages(log))
    for path in (folder, next(file for file in folder.iterdir() if file.suffix != ".yaml")):
        with open_log(path) as reader:
            assert reader.doubts() == []
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"message_count: {count}", f"message_count: {count + 7}"))
    for path in (folder, next(file for file in folder.iterdir() if file.suffix != ".yaml")):
        with open_log(path) as reader:
            (doubt,) = reader.doubts()
        assert f"{count + 7} messages" in doubt
        assert f"{count} are" in doubt


def test_a_part_with_fewer_messages_than_its_metadata_counts_is_named(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "run", write_mcap(tmp_path / "run.mcap", n_frames=4), parts=2)
    with open_log(folder) as reader:
        assert reader.doubts() == []
    with sqlite3.connect(folder / "run_1.db3") as database:
        database.execute("DELETE FROM messages WHERE id > 3")
    with open_log(folder) as reader:
        (doubt,) = reader.doubts()
    assert "messages in run_1.db3, where 3 are" in doubt


# --- MCAP -------------------------------------------------------------------------------------------------------------


def test_times_of_a_file_without_message_indexes_are_not_sold_as_all(tmp_path: Path) -> None:
    from mcap.writer import IndexType

    log = write_mcap(tmp_path / "run.mcap", index_types=IndexType.ALL & ~IndexType.MESSAGE, chunk_size=2000)
    with open_log(log.path) as reader:
        times, complete = reader.message_times()
        assert sum(topic.message_count or 0 for topic in reader.topics()) == len(raw_messages(log))
    assert times == {}
    assert not complete


def test_messages_outside_all_chunks_are_read_in_order_and_their_times_known(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", use_chunking=False, n_frames=6)
    with open_log(log.path) as reader:
        found = [(m.topic, m.log_time_ns) for m in reader.messages([topic.name for topic in reader.topics()])]
        times, complete = reader.message_times()
    assert found == [(raw.topic, raw.log_time_ns) for raw in raw_messages(log)]
    assert complete
    assert {topic: len(values) for topic, values in times.items()} == {
        topic: sum(known == topic for known, _ in found) for topic in times
    }


def test_a_file_without_chunks_keeps_nothing_of_a_single_message(tmp_path: Path) -> None:
    import tracemalloc

    from mcap.writer import Writer

    path, n = tmp_path / "run.mcap", 8_000
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        channels = [writer.register_channel(f"/t{k}", "json", 0) for k in range(2)]
        for k in range(n):
            writer.add_message(channels[k % 2], k ^ 1, b"{}", k)  # never quite in order
        writer.finish()
    tracemalloc.start()
    with open_log(path) as log:
        held, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        found = [m.log_time_ns for m in log.messages(["/t0", "/t1"])]
    assert held < 200_000
    assert most < 2 << 20
    assert found == list(range(n))


def test_a_message_that_is_none_any_more_is_missed_in_a_file_without_checksums(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", use_chunking=False, n_frames=6)
    content = bytearray(log.path.read_bytes())
    place = content.index(b"\x05", content.index(b"sensor_msgs/msg/CompressedImage"))
    while struct.unpack_from("<Q", content, place + 1)[0] > 10_000:
        place = content.index(b"\x05", place + 1)
    content[place] = 0x85  # an opcode of somebody's own
    log.path.write_bytes(content)
    with pytest.raises(LogError, match="messages where the file's own statistics count"):
        open_log(log.path)


# --- what is there beside ---------------------------------------------------------------------------------------------


def test_a_doubt_is_shown_by_inspect_and_repeated_by_check_and_ingest(tmp_path: Path) -> None:
    from tests.synthetic import task_spec
    from vilp_data.check.log import check_log
    from vilp_data.ingest import ingest_logs
    from vilp_data.log_summary import format_summary, summarise

    log = write_mcap(tmp_path / "run.mcap", n_frames=12)
    folder = write_rosbag2(tmp_path / "run", log)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: ", "message_count: 9"))
    shutil.move(log.path, tmp_path / "elsewhere")
    assert "metadata.yaml counts" in format_summary(summarise(folder))
    assert [found.kind for found in check_log(folder).findings if found.severity == "error"] == ["incomplete"]
    report = ingest_logs([folder], tmp_path / "data", task_spec(log), workers=1)
    assert report.written
    assert any("metadata.yaml counts" in note for note in report.notes)
