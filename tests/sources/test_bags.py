"""ROS bags of every kind give the messages that were written, whole and in order."""

from __future__ import annotations

import hashlib
import os
import shutil
import tracemalloc
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer

from tests.synthetic import HEADER_LAG_NS, JOINT_TOPIC, START_NS, SyntheticLog, image_topic, write_mcap
from tests.synthetic_bags import ROS1_STORE, raw_messages, with_files, write_rosbag1, write_rosbag2
from vilp_data.decode import decode_image, decode_vector, header_time_ns, is_image
from vilp_data.errors import LogError
from vilp_data.sources import open_log
from vilp_data.sources.rosbag1_log import Rosbag1Log
from vilp_data.sources.rosbag2_log import Rosbag2Log
from vilp_data.types import LogReader, Message

Compression = Literal["none", "bz2", "lz4"]


def read_all(log: LogReader, **bounds: int) -> list[Message]:
    return list(log.messages([topic.name for topic in log.topics()], **bounds))


def assert_same_messages(bag: LogReader, log: SyntheticLog) -> None:
    messages = read_all(bag)
    assert [(m.topic, m.log_time_ns, m.schema) for m in messages] == [
        (raw.topic, raw.log_time_ns, raw.type) for raw in raw_messages(log)
    ]
    joints = [m for m in messages if m.topic == JOINT_TOPIC]
    assert np.array_equal(np.stack([decode_vector(m) for m in joints]), log.joints)
    assert [header_time_ns(m) for m in joints] == log.joint_times_ns.tolist()
    images = [m for m in messages if m.topic == image_topic("front")]
    assert all(is_image(m) for m in images)
    assert np.array_equal(np.stack([decode_image(m) for m in images]), log.frames["front"])


# --- reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_ros1_bag_gives_back_what_was_recorded(tmp_path: Path, log: SyntheticLog, compression: Compression) -> None:
    with open_log(write_rosbag1(tmp_path / "run.bag", log, compression=compression)) as reader:
        assert reader.format == "rosbag1"
        assert_same_messages(reader, log)


def test_raw_images_of_ros1_are_pictures(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", image_codec="raw", n_frames=3, height=16, width=24)
    with open_log(write_rosbag1(tmp_path / "run.bag", log)) as reader:
        assert {t.name: t.schema for t in reader.topics()}[image_topic("front")] == "sensor_msgs/msg/Image"
        assert_same_messages(reader, log)


@pytest.mark.parametrize("compression", ["none", "file", "message"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("parts", [1, 3])
def test_a_ros2_bag_gives_back_what_was_recorded(
    tmp_path: Path, log: SyntheticLog, storage: str, compression: str, parts: int
) -> None:
    bag = write_rosbag2(tmp_path / "run", log, storage=storage, compression=compression, parts=parts)  # type: ignore[arg-type]
    with open_log(bag) as reader:
        assert_same_messages(reader, log)
        times, complete = reader.message_times()
        counts = {topic.name: topic.message_count for topic in reader.topics()}
        assert complete
        assert {topic: len(values) for topic, values in times.items()} == counts
        (episode,) = reader.episodes()
        assert len(read_all(reader, start_ns=episode.start_ns, end_ns=episode.end_ns)) == len(raw_messages(log))
        assert (
            len(read_all(reader, start_ns=episode.start_ns + 1, end_ns=episode.end_ns - 1))
            == len(raw_messages(log)) - 2
        )
        assert [len(reader.first_messages(topic, 2)) for topic in counts] == [2, 2, 2]


@pytest.mark.parametrize("compression", ["none", "file", "message"])
def test_a_part_of_a_bag_stands_alone(tmp_path: Path, log: SyntheticLog, compression: str) -> None:
    folder = write_rosbag2(tmp_path / "run", log, compression=compression, parts=2)  # type: ignore[arg-type]
    parts = sorted(file for file in folder.iterdir() if file.name != "metadata.yaml")
    (folder / "metadata.yaml").unlink()
    found = []
    for part in parts:
        with open_log(part) as reader:
            found += [(m.topic, m.log_time_ns) for m in read_all(reader)]
    assert found == [(raw.topic, raw.log_time_ns) for raw in raw_messages(log)]


def test_parts_that_overlap_in_time_are_joined_in_order(tmp_path: Path) -> None:
    logs = [
        write_mcap(tmp_path / f"{seed}.mcap", n_frames=4, height=16, width=24, jitter_s=0.01, seed=seed)
        for seed in (1, 2)
    ]
    folder = write_rosbag2(tmp_path / "bag", logs[0])
    other = write_rosbag2(tmp_path / "other", logs[1], storage="mcap")
    shutil.move(other / "other.mcap", folder / "other.mcap")
    metadata = folder / "metadata.yaml"
    metadata.write_text(with_files(metadata.read_text(), ["bag.db3", "other.mcap"]))
    with open_log(folder) as reader:
        times = [m.log_time_ns for m in read_all(reader)]
    assert times == sorted(raw.log_time_ns for one in logs for raw in raw_messages(one))


def test_only_files_whose_messages_are_due_are_open(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, parts=6)

    def open_files() -> int:
        links = [Path("/proc/self/fd", name) for name in os.listdir("/proc/self/fd")]
        return sum(os.path.realpath(link).startswith(str(folder)) for link in links if link.is_symlink())

    with open_log(folder) as reader:
        assert open_files() == 0
        assert max(open_files() for _ in reader.messages([JOINT_TOPIC])) == 1
    assert open_files() == 0


@pytest.mark.parametrize("kind", ["rosbag1", "sqlite3", "split", "message"])
def test_memory_does_not_grow_with_a_bag(tmp_path: Path, kind: str) -> None:
    log = write_mcap(
        tmp_path / "run.mcap", image_codec="raw", n_frames=200, height=64, width=96, joint_hz=1, action_hz=1
    )
    if kind == "rosbag1":
        path = write_rosbag1(tmp_path / "run.bag", log, chunk_bytes=50_000)
    else:
        compression: Literal["none", "message"] = "message" if kind == "message" else "none"
        path = write_rosbag2(tmp_path / "run", log, parts=4 if kind == "split" else 1, compression=compression)
    with open_log(path) as reader:
        topics = [topic.name for topic in reader.topics()]
        next(reader.messages(topics))
        tracemalloc.start()
        size = sum(getattr(message.body, "data", np.empty(0)).nbytes for message in reader.messages(topics))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert size == 200 * 64 * 96 * 3
    assert peak < size / 5


def test_inflated_copies_are_removed(tmp_path: Path, log: SyntheticLog, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    folder = write_rosbag2(tmp_path / "run", log, compression="file", parts=2)
    with open_log(folder) as reader:
        next(reader.messages([JOINT_TOPIC]))
        read_all(reader)
    assert os.listdir(tmp_path / "tmp") == []


def test_a_ros1_bag_whose_chunks_overlap_is_read_in_order(tmp_path: Path) -> None:
    """As merging bags leaves them. Ties keep the order of the file."""
    times = [0, 10, 5, 5, 7, 20, 3, 12, 12, 1]
    with Rosbag1Writer(tmp_path / "run.bag") as writer:
        writer.chunk_threshold = 1
        connection = writer.add_connection("/n", "std_msgs/msg/Int32", typestore=ROS1_STORE)
        for number, time in enumerate(times):
            body = ROS1_STORE.types["std_msgs/msg/Int32"](number)
            writer.write(connection, time, ROS1_STORE.serialize_ros1(body, "std_msgs/msg/Int32"))
    with open_log(tmp_path / "run.bag") as reader:
        found = [(m.log_time_ns, m.body.data) for m in reader.messages(["/n"])]
        assert reader.message_times()[0]["/n"].tolist() == times
    assert found == sorted((time, number) for number, time in enumerate(times))


def test_a_topic_of_two_publishers_is_counted_and_read_as_one(tmp_path: Path) -> None:
    with Rosbag1Writer(tmp_path / "run.bag") as writer:
        for caller in ("/one", "/other"):
            connection = writer.add_connection("/n", "std_msgs/msg/Int32", typestore=ROS1_STORE, callerid=caller)
            writer.write(connection, 1 if caller == "/one" else 0, b"\1\0\0\0")
    with open_log(tmp_path / "run.bag") as reader:
        assert [topic.message_count for topic in reader.topics()] == [2]
        assert [m.log_time_ns for m in reader.messages(["/n"])] == [0, 1]
        assert reader.message_times()[0]["/n"].tolist() == [0, 1]


def test_the_hash_is_that_of_the_file_or_of_all_files_and_their_names(tmp_path: Path, log: SyntheticLog) -> None:
    bag = write_rosbag1(tmp_path / "run.bag", log)
    with open_log(bag) as reader:
        assert reader.sha256() == hashlib.sha256(bag.read_bytes()).hexdigest()
    folder = write_rosbag2(tmp_path / "run", log, parts=2)
    with open_log(folder) as reader:
        before = reader.sha256()
    (folder / "run_1.db3").touch()
    with open_log(folder) as reader:
        assert reader.sha256() == before
    (folder / "notes.txt").write_text("x")
    with open_log(folder) as reader:
        assert reader.sha256() != before


def test_custom_data_of_the_recorder_become_the_tags(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, custom={"success": "true", "object": "cube"})
    with open_log(folder) as reader:
        assert reader.episodes()[0].tags == {"success": "true", "object": "cube"}


def test_a_folder_of_one_plain_file_stands_for_the_file(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log)
    with open_log(folder) as by_folder, open_log(folder / "run.db3") as by_file:
        assert by_folder.sha256() == by_file.sha256()
        assert by_folder.path == by_file.path


def test_an_unknown_topic_is_refused_with_the_nearest_one(
    bag: Path, db3: Path, tmp_path: Path, log: SyntheticLog
) -> None:
    for path in (bag, db3, write_rosbag2(tmp_path / "split", log, parts=2)):
        with open_log(path) as reader, pytest.raises(LogError, match="did you mean '/joint_states'"):
            reader.messages(["/joint_state"])


# --- beside rosbags' own reader ---------------------------------------------------------------------------------------


def test_order_and_bytes_are_those_of_rosbags(bag: Path) -> None:
    with Rosbag1Reader(bag) as theirs:
        expected = [(connection.topic, time) for connection, time, _ in theirs.messages()]
    with Rosbag1Log(bag) as ours:
        assert sorted((m.topic, m.log_time_ns) for m in read_all(ours)) == sorted(expected)


def test_readers_are_made_anew_from_a_path_in_another_process(tmp_path: Path, log: SyntheticLog) -> None:
    """What a worker is given is the path: two readers of one bag do not disturb each other."""
    folder = write_rosbag2(tmp_path / "run", log, parts=2)
    with Rosbag2Log(folder) as one, Rosbag2Log(folder) as other:
        pairs: list[Any] = list(zip(one.messages([JOINT_TOPIC]), other.messages([JOINT_TOPIC]), strict=True))
    assert len(pairs) == len(log.joints)
    assert all(a.log_time_ns == b.log_time_ns >= START_NS + HEADER_LAG_NS - 4_000_000 for a, b in pairs)
