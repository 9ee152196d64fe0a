"""ROS bags of every kind give the messages that were written, whole and in order; and say what is wrong with damaged ones."""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import sqlite3
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer

from tests.synthetic import HEADER_LAG_NS, JOINT_TOPIC, START_NS, SyntheticLog, image_topic, write_mcap
from tests.synthetic_bags import ROS1_STORE, raw_messages, with_files, write_rosbag1, write_rosbag2
from vilp_data.decode import decode_image, decode_vector, header_time_ns, is_image
from vilp_data.errors import LogError
from vilp_data.sources import MessageError, open_log
from vilp_data.sources.rosbag1_log import Rosbag1Log
from vilp_data.sources.rosbag2_log import Rosbag2Log
from vilp_data.types import LogReader, Message

Compression = Literal["none", "bz2", "lz4"]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    folder = tmp_path_factory.mktemp("source")
    return write_mcap(folder / "run.mcap", image_codec="png", n_frames=6, height=16, width=24, jitter_s=0.004)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, log: SyntheticLog) -> Path:
    return write_rosbag1(tmp_path_factory.mktemp("ros1") / "run.bag", log)


@pytest.fixture(scope="module")
def db3(tmp_path_factory: pytest.TempPathFactory, log: SyntheticLog) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("ros2") / "run", log) / "run.db3"


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


# --- types ------------------------------------------------------------------------------------------------------------


def write_ros1_topic(path: Path, message_type: str, definition: str, data: bytes) -> Path:
    with Rosbag1Writer(path) as writer:
        good = writer.add_connection("/good", "std_msgs/msg/Int32", typestore=ROS1_STORE)
        other = writer.add_connection("/other", message_type, msgdef=definition, md5sum="0" * 32)
        writer.write(good, 1, b"\1\0\0\0")
        writer.write(other, 2, data)
    return path


@pytest.mark.parametrize(
    ("message_type", "definition", "says"),
    [
        ("my_msgs/msg/Thing", "", "no definition of it"),
        ("my_msgs/msg/Thing", "my_msgs/Other other", "refers to my_msgs/msg/Other"),
        ("my_msgs/msg/Thing", "int32[ broken", "Could not parse"),
        ("my_msgs/msg/Thing", "my_msgs/Thing thing", "contains itself"),
        ("my_msgs/msg/Thing", "string[1000000000] words", "1,000,000,000 fields"),
        (
            "my_msgs/msg/Thing",
            f"my_msgs/Nothing[] nothings\n{'=' * 80}\nMSG: my_msgs/Nothing\nint32 ONE=1\n",
            "without members",
        ),
    ],
)
def test_a_topic_of_an_unknown_type_is_listed_and_keeps_no_other_back(
    tmp_path: Path, message_type: str, definition: str, says: str
) -> None:
    path = write_ros1_topic(tmp_path / "run.bag", message_type, definition, b"\xff\xff\xff\xff")
    with open_log(path) as reader:
        assert [(t.name, t.schema, t.message_count) for t in reader.topics()] == [
            ("/good", "std_msgs/msg/Int32", 1),
            ("/other", "my_msgs/msg/Thing", 1),
        ]
        assert [m.body.data for m in reader.messages(["/good"])] == [1]
        with pytest.raises(LogError, match=f"/other(.|\n)*{says}"):
            list(reader.messages(["/other"]))


def test_a_custom_type_is_read_by_the_definition_in_the_bag(tmp_path: Path) -> None:
    definition = f"my_msgs/Point[2] corners\n{'=' * 80}\nMSG: my_msgs/Point\nfloat32 x\nfloat32 y\n"
    data = struct.pack("<4f", 1, 2, 3, 4)
    with open_log(write_ros1_topic(tmp_path / "run.bag", "my_msgs/msg/Shape", definition, data)) as reader:
        (message,) = reader.messages(["/other"])
    assert decode_vector(message, ["corners.x"]).tolist() == [1, 3]


def test_a_stock_type_without_a_definition_is_read_all_the_same(tmp_path: Path) -> None:
    data = ROS1_STORE.serialize_ros1(
        ROS1_STORE.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0), "geometry_msgs/msg/Point"
    )
    path = write_ros1_topic(tmp_path / "run.bag", "geometry_msgs/msg/Point", "", bytes(data))
    with open_log(path) as reader:
        (message,) = reader.messages(["/other"])
    assert decode_vector(message).tolist() == [1, 2, 3]


@pytest.mark.parametrize("distro", ["humble", "", "a release of the future"])
def test_a_db3_without_definitions_is_read_by_the_stock_types(
    db3: Path, tmp_path: Path, distro: str, log: SyntheticLog
) -> None:
    path = tmp_path / "old.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
        if distro:
            database.execute("UPDATE schema SET ros_distro = ?", (distro,))
        else:
            database.execute("DROP TABLE schema")
    with open_log(path) as reader:
        assert_same_messages(reader, log)


def test_after_a_message_that_does_not_fit_its_type_the_next_one_can_be_had(db3: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        (second,) = database.execute(
            "SELECT messages.id FROM messages JOIN topics ON topic_id = topics.id WHERE name = ? LIMIT 1 OFFSET 1",
            (JOINT_TOPIC,),
        ).fetchone()
        database.execute("UPDATE messages SET data = ? WHERE id = ?", (b"\0\1\0\0nonsense", second))
    with open_log(path) as reader:
        messages = reader.messages([JOINT_TOPIC])
        first = next(messages)
        with pytest.raises(MessageError, match=f"a message of {JOINT_TOPIC} at"):
            next(messages)
        assert next(messages).log_time_ns > first.log_time_ns


# --- damage -----------------------------------------------------------------------------------------------------------


def test_a_bag_without_an_index_leads_to_salvage(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    place = content.index(b"index_pos=") + len(b"index_pos=")
    path = tmp_path / "run.bag.active"
    path.write_bytes(content[:place] + bytes(8) + content[place + 8 :])
    with pytest.raises(LogError, match=r"run\.bag\.active: the bag has no index(.|\n)*vilp-data salvage"):
        open_log(path)


def test_an_encrypted_bag_is_named_as_such(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    (length,) = struct.unpack_from("<I", content, 13)
    field = b"encryptor=rosbag/AesCbcEncryptor"
    header = content[17 : 17 + length] + struct.pack("<I", len(field)) + field
    path = tmp_path / "run.bag"
    path.write_bytes(content[:13] + struct.pack("<I", len(header)) + header + content[17 + length :])
    with pytest.raises(LogError, match=r"encrypted(.|\n)*AesCbc"):
        open_log(path)


@pytest.mark.parametrize("kind", ["bag", "db3", "file"])
def test_a_bag_cut_anywhere_is_an_error_with_a_way_out(
    tmp_path: Path, bag: Path, db3: Path, log: SyntheticLog, kind: str
) -> None:
    path = {"bag": bag, "db3": db3}.get(kind)
    if path is None:
        path = next(write_rosbag2(tmp_path / "run", log, compression="file").glob("*.zstd"))
    content, cut = path.read_bytes(), tmp_path / f"cut.{kind}"
    for size in [*range(1, 100, 9), *range(100, len(content), len(content) // 40), len(content) - 1]:
        cut.write_bytes(content[:size])
        with pytest.raises(LogError) as caught, open_log(cut) as reader:
            read_all(reader)
        assert caught.value.remedy
        assert str(cut) in str(caught.value)


def flipped(content: bytes, path: Path, count: int) -> Iterator[Path]:
    """Copies with one bit changed; those ends that hold headers and indexes more often than the messages between."""
    rng = random.Random(3)
    for _ in range(count):
        changed = bytearray(content)
        size = len(content)
        place = rng.choice(
            [rng.randrange(size), rng.randrange(min(size, 200)), size - 1 - rng.randrange(min(size, 2000))]
        )
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        yield path


@pytest.mark.parametrize("kind", ["none", "lz4", "bz2", "db3"])
def test_a_flipped_bit_gives_messages_or_an_error_in_words(
    tmp_path: Path, log: SyntheticLog, db3: Path, kind: str
) -> None:
    source = db3 if kind == "db3" else write_rosbag1(tmp_path / "run.bag", log, compression=kind)  # type: ignore[arg-type]
    caught = 0
    for path in flipped(source.read_bytes(), tmp_path / f"flipped.{kind}", 60):
        try:
            with open_log(path) as reader:
                for topic in reader.topics():
                    list(reader.messages([topic.name]))
        except LogError as error:
            caught += 1
            assert error.remedy
            assert str(path) in str(error)
    assert caught > 0


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_a_compressed_chunk_that_is_damaged_names_its_place(
    tmp_path: Path, log: SyntheticLog, compression: Compression
) -> None:
    path = write_rosbag1(tmp_path / "run.bag", log, compression=compression)
    content = bytearray(path.read_bytes())
    place = content.index(b"compression=") + 200
    content[place] ^= 0x55
    path.write_bytes(content)
    with (
        open_log(path) as reader,
        pytest.raises(LogError, match=f"the chunk at byte (.|\n)*{compression}(.|\n)*salvage"),
    ):
        read_all(reader)


def test_a_chunk_that_inflates_to_more_than_it_claims_is_refused(tmp_path: Path, log: SyntheticLog) -> None:
    path = write_rosbag1(tmp_path / "run.bag", log, compression="bz2")
    content = bytearray(path.read_bytes())
    place = content.index(b"size=") + len(b"size=")
    struct.pack_into("<I", content, place, 100)
    path.write_bytes(content)
    with open_log(path) as reader, pytest.raises(LogError, match="more than 100 bytes"):
        read_all(reader)


def test_messages_that_the_index_does_not_count_are_an_error(tmp_path: Path) -> None:
    path = write_ros1_topic(tmp_path / "run.bag", "std_msgs/msg/Int32", "int32 data", b"\1\0\0\0")
    content = bytearray(path.read_bytes())
    place = content.rindex(struct.pack("<II", 0, 1))  # connection 0 has one message
    struct.pack_into("<II", content, place, 0, 2)
    path.write_bytes(content)
    with pytest.raises(LogError, match="1 messages of connection 0, 2 by the bag's"):
        open_log(path)


def test_an_index_of_a_chunk_that_disagrees_with_the_bags_own_is_damage(tmp_path: Path, bag: Path) -> None:
    content = bytearray(bag.read_bytes())
    place = content.index(b"ver=") - 200
    while content[place : place + 5] != b"conn=" or b"count=" not in content[place : place + 60]:
        place += 1
    struct.pack_into("<I", content, place + 5, 77)
    path = tmp_path / "run.bag"
    path.write_bytes(content)
    with pytest.raises(LogError, match="0 messages of connection 0, 3 by the bag's"):
        open_log(path)


def test_files_that_a_bag_lacks_are_named(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, parts=3)
    (folder / "run_1.db3").unlink()
    with pytest.raises(LogError, match=r"run_1\.db3(.|\n)*ros2 bag reindex"):
        open_log(folder)


@pytest.mark.parametrize(
    "text",
    [
        "rosbag2_bagfile_information:\n",
        "rosbag2_bagfile_information: [1, 2]\n",
        "rosbag2_bagfile_information:\n  relative_file_paths: run.db3\n",
        "rosbag2_bagfile_information:\n\t- {\n",
        "rosbag2_bagfile_information: !!python/object/apply:os.system ['true']\n",
    ],
)
def test_metadata_that_cannot_be_understood_is_an_error_with_a_way_out(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=r"metadata\.yaml cannot be understood(.|\n)*reindex"):
        open_log(tmp_path)


def test_metadata_cannot_lead_out_of_the_folder(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log)
    shutil.copy(folder / "run.db3", tmp_path / "elsewhere.db3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(with_files(metadata.read_text(), ["../elsewhere.db3"]))
    with pytest.raises(LogError, match="missing"):
        open_log(folder)


def test_a_database_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "shop.db3") as database:
        database.execute("CREATE TABLE orders (id INTEGER)")
    with pytest.raises(LogError, match="no bag of ROS 2"):
        open_log(tmp_path / "shop.db3")


def test_a_view_in_place_of_a_table_is_never_run(tmp_path: Path, db3: Path) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE messages RENAME TO kept")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
            " SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM n"
        )
    with pytest.raises(LogError, match="no bag of ROS 2"):
        open_log(path)


@pytest.mark.parametrize(("column", "value"), [("timestamp", "'soon'"), ("data", "5"), ("topic_id", "99")])
def test_rows_of_another_kind_are_damage(tmp_path: Path, db3: Path, column: str, value: str) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    with sqlite3.connect(path) as database:
        database.execute(f"UPDATE messages SET {column} = {value} WHERE id = 7")
    with pytest.raises(LogError, match="damaged"), open_log(path) as reader:
        reader.episodes()
        read_all(reader)


def test_a_bag_that_its_recorder_did_not_close_is_not_read_in_part(tmp_path: Path, db3: Path) -> None:
    path = tmp_path / "run.db3"
    shutil.copy(db3, path)
    (tmp_path / "run.db3-wal").write_bytes(b"x" * 100)
    with pytest.raises(LogError, match=r"journal(.|\n)*run\.db3-wal(.|\n)*salvage"):
        open_log(path)


def test_reading_writes_nothing_beside_a_bag(tmp_path: Path, log: SyntheticLog) -> None:
    folder = write_rosbag2(tmp_path / "run", log, parts=2)
    before = sorted(os.listdir(folder))
    with open_log(folder) as reader:
        read_all(reader)
    assert sorted(os.listdir(folder)) == before


def test_a_small_file_cannot_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vilp_data.sources.rosbag2_log.FREE_RATIO_BYTES", 1000)
    path = tmp_path / "bomb.db3.zstd"
    path.write_bytes(zstandard.ZstdCompressor().compress(bytes(10_000_000)))
    with pytest.raises(LogError, match="larger than any recording"):
        open_log(path)


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
