"""Topics of every type: listed, read by the definition that the bag has or by the stock one, refused where there is none."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer

from tests.sources.test_bags import assert_same_messages
from tests.synthetic import JOINT_TOPIC, SyntheticLog
from tests.synthetic_bags import ROS1_STORE
from vilp_data.decode import decode_vector
from vilp_data.errors import LogError
from vilp_data.sources import MessageError, open_log


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
