"""MCAP: what was written comes back, in order, whole; and what cannot be trusted is refused."""

from __future__ import annotations

import hashlib
import json
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from tests.real_data import real_data
from tests.synthetic import ACTION_TOPIC, HEADER_LAG_NS, JOINT_TOPIC, START_NS, STORE, Encoding, image_topic, write_mcap
from tests.synthetic_bags import ROS1_STORE
from vilp_data.decode import decode_vector, header_time_ns
from vilp_data.errors import LogError
from vilp_data.sources import MessageError, open_log
from vilp_data.types import Message

ENCODINGS: tuple[Encoding, ...] = ("cdr", "protobuf", "json")


def read(path: Path, topics: list[str] | None = None, **bounds: int) -> list[Message]:
    with open_log(path) as log:
        return list(log.messages([t.name for t in log.topics()] if topics is None else topics, **bounds))


def write_json(
    path: Path, times: list[int], topic: str = "/t", *, before: Callable[[Writer], Any] = lambda w: None, **options: Any
) -> Path:
    """A log of small JSON messages at these log times, in this order."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("", "test")
        before(writer)
        channel = writer.register_channel(topic, "json", writer.register_schema("s", "jsonschema", b"{}"))
        for sequence, time in enumerate(times):
            writer.add_message(channel, time, json.dumps({"n": sequence}).encode(), time, sequence)
        writer.finish()
    return path


# --- reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_gives_back_the_vectors_and_times_written(tmp_path: Path, encoding: Encoding) -> None:
    log = write_mcap(tmp_path / "run.mcap", encoding=encoding, jitter_s=0.004)
    messages = read(log.path, [JOINT_TOPIC])
    assert np.array_equal(np.stack([decode_vector(m) for m in messages]), log.joints)
    assert [m.log_time_ns for m in messages] == (log.joint_times_ns + HEADER_LAG_NS).tolist()
    assert [m.publish_time_ns for m in messages] == (log.joint_times_ns + HEADER_LAG_NS // 2).tolist()


@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_compression_is_read(tmp_path: Path, compression: CompressionType) -> None:
    log = write_mcap(tmp_path / "run.mcap", compression=compression)
    assert len(read(log.path, [JOINT_TOPIC])) == len(log.joints)


def test_topics_carry_schema_encoding_and_count_sorted_by_name(tmp_path: Path) -> None:
    with open_log(write_mcap(tmp_path / "run.mcap", cameras=("front", "side"), n_frames=6).path) as log:
        topics = log.topics()
    assert [t.name for t in topics] == [ACTION_TOPIC, image_topic("front"), image_topic("side"), JOINT_TOPIC]
    assert (topics[1].schema, topics[1].encoding, topics[1].message_count) == (
        "sensor_msgs/msg/CompressedImage",
        "cdr",
        6,
    )


def test_only_the_topics_asked_for_are_read(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    assert {m.topic for m in read(log.path, [ACTION_TOPIC, JOINT_TOPIC])} == {ACTION_TOPIC, JOINT_TOPIC}


def test_time_range_includes_its_start_and_excludes_its_end(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [10, 20, 30, 40], chunk_size=60)
    assert [m.log_time_ns for m in read(path, start_ns=20, end_ns=40)] == [20, 30]
    assert [m.log_time_ns for m in read(path, start_ns=21)] == [30, 40]
    assert read(path, start_ns=41) == []


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False},
    ],
)
def test_messages_come_in_order_of_log_time_however_they_were_written_and_indexed(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    times = random.Random(0).sample(range(1000), 200)
    path = write_json(tmp_path / "run.mcap", times, chunk_size=200, **options)
    messages = read(path)
    assert [m.log_time_ns for m in messages] == sorted(times)
    assert [times[m.body["n"]] for m in messages] == sorted(times)
    with open_log(path) as log:
        assert log.topics()[0].message_count == 200
        assert (log.episodes()[0].start_ns, log.episodes()[0].end_ns) == (min(times), max(times) + 1)


@pytest.mark.parametrize("use_chunking", [True, False])
def test_messages_of_one_time_keep_the_order_of_the_file(tmp_path: Path, use_chunking: bool) -> None:
    path = write_json(tmp_path / "run.mcap", [5] * 100, chunk_size=200, use_chunking=use_chunking)
    assert [m.body["n"] for m in read(path)] == list(range(100))


def test_an_unknown_topic_is_refused_with_the_nearest_one(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(LogError, match="did you mean '/joint_states'"):
        read(log.path, ["/joint_state"])


def test_the_file_is_one_episode_whose_name_survives_renaming_and_whose_tags_are_its_metadata(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "take_07.mcap", tags={"success": "true", "seed": "7"})
    with open_log(log.path) as reader:
        (episode,) = reader.episodes()
        assert reader.metadata() == {"episode": {"success": "true", "seed": "7"}}
    assert (episode.name, episode.tags) == ("whole", {"success": "true", "seed": "7"})
    assert episode.start_ns == START_NS + HEADER_LAG_NS
    assert len(read(log.path, start_ns=episode.start_ns, end_ns=episode.end_ns)) == len(read(log.path))


def test_a_log_without_messages_has_no_episode(tmp_path: Path) -> None:
    with open_log(write_json(tmp_path / "run.mcap", [])) as log:
        assert log.episodes() == []
        assert list(log.messages([])) == []


def test_sha256_is_that_of_the_file(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", enable_data_crcs=True)
    with open_log(log.path) as reader:
        assert reader.sha256() == hashlib.sha256(log.path.read_bytes()).hexdigest()


# --- damage -----------------------------------------------------------------------------------------------------------


def contents(messages: list[Message]) -> list[tuple[str, int, int, str]]:
    return [(m.topic, m.log_time_ns, m.publish_time_ns, json.dumps(m.body)) for m in messages]


def damaged_copies(path: Path, content: bytes, changes: list[tuple[int, int]]) -> Iterator[Path]:
    for position, bits in changes:
        changed = bytearray(content)
        changed[position] ^= bits
        path.write_bytes(changed)
        yield path


@pytest.mark.parametrize("options", [{}, {"compression": CompressionType.NONE}, {"compression": CompressionType.LZ4}])
def test_a_flipped_byte_gives_an_error_or_the_exact_messages(tmp_path: Path, options: dict[str, Any]) -> None:
    log = write_mcap(
        tmp_path / "run.mcap",
        encoding="json",
        n_frames=3,
        height=16,
        width=16,
        chunk_size=2000,
        tags={"a": "b"},
        **options,
    )
    content, expected = log.path.read_bytes(), contents(read(log.path))
    rng = random.Random(1)
    positions = rng.sample(range(len(content)), 150) + list(range(len(content) - 120, len(content)))
    caught = 0
    for path in damaged_copies(tmp_path / "flipped.mcap", content, [(p, 1 << rng.randrange(8)) for p in positions]):
        try:
            assert contents(read(path)) == expected
        except LogError as error:
            caught += 1
            assert error.remedy
            assert str(path) in str(error)
    assert caught > len(positions) // 2


def test_a_flipped_byte_in_a_chunk_names_the_file_and_the_way_out(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", compression=CompressionType.NONE)
    content = log.path.read_bytes()
    where = content.index(b"shoulder", len(content) // 3)
    (path,) = damaged_copies(tmp_path / "flipped.mcap", content, [(where, 4)])
    with pytest.raises(
        LogError, match=r"flipped\.mcap: the log is damaged at the chunk at byte .*\n.*CRC(.|\n)*vilp-data salvage"
    ):
        read(path)


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"index_types": IndexType.NONE}])
def test_without_an_index_a_flipped_byte_is_caught_by_the_data_checksum(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = write_json(
        tmp_path / "run.mcap", list(range(50)), enable_data_crcs=True, compression=CompressionType.NONE, **options
    )
    content = path.read_bytes()
    (flipped,) = damaged_copies(tmp_path / "flipped.mcap", content, [(content.index(b'{"n": 30}') + 6, 1)])
    with pytest.raises(LogError, match="CRC"):
        read(flipped)


def test_hashing_checks_the_data_checksum_that_reading_by_index_skips(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", enable_data_crcs=True, tags={"object": "cube"})
    content = log.path.read_bytes()
    (flipped,) = damaged_copies(tmp_path / "flipped.mcap", content, [(content.index(b"cube"), 1)])
    with open_log(flipped) as reader, pytest.raises(LogError, match="the data section"):
        reader.sha256()


def test_every_cut_off_file_says_how_much_is_intact(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", chunk_size=4000)
    content = log.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in [*range(1, 60), *range(60, len(content), 331), *range(len(content) - 40, len(content))]:
        cut.write_bytes(content[:size])
        with pytest.raises(LogError, match="cut off") as caught:
            open_log(cut)
        assert caught.value.remedy
    assert "chunks" in str(caught.value.found)


@pytest.mark.parametrize("use_statistics", [True, False])
def test_messages_between_indexed_chunks_are_read_too(tmp_path: Path, use_statistics: bool) -> None:
    """Chunks and loose messages may be mixed; a reader that trusts the chunk index alone drops the loose ones in silence."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100, use_statistics=use_statistics)
        writer.start("", "test")
        channel = writer.register_channel("/t", "json", 0)
        for time in range(20):
            chunks = writer._Writer__chunk_builder  # type: ignore[attr-defined]
            if time in (7, 13):
                writer._Writer__chunk_builder = None  # type: ignore[attr-defined]
            writer.add_message(channel, time, b"{}", time)
            writer._Writer__chunk_builder = chunks  # type: ignore[attr-defined]
        writer.finish()
    assert [m.log_time_ns for m in read(path)] == list(range(20))
    with open_log(path) as log:
        assert log.topics()[0].message_count == 20


def test_fewer_messages_than_the_statistics_count_are_an_error(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [10, 20, 30], enable_crcs=False)
    content = path.read_bytes()
    for three, four in (
        (struct.pack("<QH", 3, 1), struct.pack("<QH", 4, 1)),
        (struct.pack("<HQ", 1, 3), struct.pack("<HQ", 1, 4)),
    ):
        place = content.rindex(three)  # the statistics record: total, then this channel's count
        content = content[:place] + four + content[place + len(three) :]
    path.write_bytes(content)
    with pytest.raises(LogError, match="3 messages where the file's own index counts 4"):
        read(path)


def with_statistics_from(path: Path, start_ns: int) -> Path:
    """The log with statistics that begin at another time, as rosbag2's rewriter leaves them."""
    content = path.read_bytes()
    place = content.rindex(
        struct.pack("<BQ", Opcode.STATISTICS, 56)
    )  # its length with one channel; times come at its 26th byte
    begin = place + 9 + 26
    path.write_bytes(content[:begin] + struct.pack("<Q", start_ns) + content[begin + 8 :])
    return path


def test_statistics_that_begin_after_the_first_message_cut_nothing_off(tmp_path: Path) -> None:
    path = with_statistics_from(write_json(tmp_path / "run.mcap", [0, 10, 20], chunk_size=60, enable_crcs=False), 10)
    with open_log(path) as log:
        (episode,) = log.episodes()
        assert (episode.start_ns, episode.end_ns) == (0, 21)
        whole = list(log.messages(["/t"], start_ns=episode.start_ns, end_ns=episode.end_ns))
    assert [m.log_time_ns for m in whole] == [0, 10, 20]


def test_real_log_whose_statistics_begin_late_is_read_whole() -> None:
    path = real_data("logs/rosbag2_tests/rosbag2_py/test/resources/mcap/convert_a/rewriter_a_0.mcap")
    with open_log(path) as log:
        (episode,) = log.episodes()
        topics = log.topics()
        messages = list(log.messages([t.name for t in topics], start_ns=episode.start_ns, end_ns=episode.end_ns))
    assert episode.start_ns == 0
    assert len(messages) == sum(t.message_count or 0 for t in topics)


def test_two_channels_on_one_topic_are_told_together(tmp_path: Path) -> None:
    """`mcap merge` keeps a channel for each file."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        channels = [writer.register_channel("/t", "json", 0) for _ in range(2)]
        for time in range(10):
            writer.add_message(channels[time % 2], time, b"{}", time)
        writer.finish()
    with open_log(path) as log:
        times, complete = log.message_times()
        assert log.topics()[0].message_count == 10
    assert times["/t"].tolist() == list(range(10))
    assert complete


@pytest.mark.parametrize("lacking", [(), (0,), (1,), (0, 1)])
def test_times_are_not_sold_as_all_where_a_chunks_index_lacks_a_channel(
    tmp_path: Path, lacking: tuple[int, ...]
) -> None:
    """And nobody is handed the channel's other messages as if they were all."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=10_000)
        writer.start("", "test")
        channels = [writer.register_channel(topic, "json", 0) for topic in ("/a", "/b")]
        for time in range(20):
            writer.add_message(channels[time % 2], time, b"{}", time)
            if time == 9:
                indexes = writer._Writer__chunk_builder.message_indices  # type: ignore[attr-defined]
                for number in lacking:
                    del indexes[channels[number]]
                writer._Writer__finalize_chunk()  # type: ignore[attr-defined]
        writer.finish()
    with open_log(path) as log:
        _, complete = log.message_times()
        assert complete == (not lacking)
        for number, topic in enumerate(("/a", "/b")):
            if number in lacking and len(lacking) == 1:
                with pytest.raises(LogError, match="5 messages where the file's own index counts 10"):
                    list(log.messages([topic]))
            else:
                assert [message.log_time_ns for message in log.messages([topic])] == list(range(number, 20, 2))


def test_after_a_message_that_does_not_fit_its_schema_the_next_one_can_be_had(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [1, 3], before=lambda w: bad_message(w, 2))
    with open_log(path) as log:
        messages = log.messages(["/t", "/bad"])
        assert next(messages).log_time_ns == 1
        with pytest.raises(MessageError, match="does not fit"):
            next(messages)
        assert next(messages).log_time_ns == 3


def bad_message(writer: Writer, time: int) -> None:
    writer.add_message(writer.register_channel("/bad", "json", 0), time, b"{not json", time)


def test_bytes_that_do_not_fit_their_schema_name_topic_and_time(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [1], before=lambda w: bad_message(w, 77))
    assert len(read(path, ["/t"])) == 1
    with pytest.raises(LogError, match="a message of /bad at 77 ns does not fit its schema"):
        read(path, ["/bad"])


def write_cdr(path: Path, schema: tuple[str, str, bytes], data: bytes) -> Path:
    return write_messages(path, "cdr", schema, data)


def write_messages(path: Path, encoding: str, schema: tuple[str, str, bytes], data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        writer.add_message(writer.register_channel("/t", encoding, writer.register_schema(*schema)), 1, data, 1)
        writer.finish()
    return path


POINT_IDL = b"""module geometry_msgs { module msg { struct Point { double x; double y; double z; }; }; };"""
POINT_CDR = bytes(STORE.serialize_cdr(STORE.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0), "geometry_msgs/msg/Point"))


@pytest.mark.parametrize(
    "schema",
    [
        ("geometry_msgs/msg/Point", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z\n"),
        ("geometry_msgs/Point", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z\n"),
        ("geometry_msgs/msg/Point", "ros2idl", POINT_IDL),
        ("geometry_msgs/msg/Point", "ros2msg", b""),
        ("geometry_msgs/msg/Point", "", b""),
    ],
    ids=["msg", "short name", "idl", "empty text of a stock type", "no schema of a stock type"],
)
def test_every_way_to_describe_a_ros_type_is_understood(tmp_path: Path, schema: tuple[str, str, bytes]) -> None:
    (message,) = read(write_cdr(tmp_path / "run.mcap", schema, POINT_CDR))
    assert decode_vector(message, ["x", "y", "z"]).tolist() == [1, 2, 3]


def test_ros1_messages_are_read_by_their_ros1_schema_and_named_as_in_ros2(tmp_path: Path) -> None:
    types = ROS1_STORE.types
    header = types["std_msgs/msg/Header"](7, types["builtin_interfaces/msg/Time"](12, 34), "base")
    vector = types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    body = types["geometry_msgs/msg/Vector3Stamped"](header, vector)
    definition = ROS1_STORE.generate_msgdef(body.__msgtype__)[0].encode()
    data = bytes(ROS1_STORE.serialize_ros1(body, body.__msgtype__))
    schema = ("geometry_msgs/Vector3Stamped", "ros1msg", definition)
    (message,) = read(write_messages(tmp_path / "run.mcap", "ros1", schema, data))
    assert message.schema == "geometry_msgs/msg/Vector3Stamped"
    assert decode_vector(message, ["vector"]).tolist() == [1, 2, 3]
    assert header_time_ns(message) == 12_000_000_034


@pytest.mark.parametrize("encoding", ["flatbuffer", "cbor", "msgpack", ""])
def test_a_topic_in_an_encoding_that_is_not_read_is_listed_and_keeps_no_other_back(
    tmp_path: Path, encoding: str
) -> None:
    path = write_json(tmp_path / "run.mcap", [1, 2], before=lambda w: other_message(w, encoding))
    assert [m.topic for m in read(path, ["/t"])] == ["/t", "/t"]
    with open_log(path) as log:
        assert [(t.name, t.message_count) for t in log.topics()] == [("/other", 1), ("/t", 2)]
        with pytest.raises(LogError, match=f"/other: (.|\n)*encoding that is not read(.|\n)*{encoding}"):
            log.messages(["/other"])


def other_message(writer: Writer, encoding: str) -> None:
    schema = writer.register_schema("foxglove.Pose", encoding, b"\x01")
    writer.add_message(writer.register_channel("/other", encoding, schema), 5, b"\x02", 5)


def test_json_of_any_depth_is_a_message_or_an_error(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [1], before=lambda w: deep_message(w, 100_000))
    assert len(read(path, ["/t"])) == 1
    with pytest.raises(MessageError, match="/deep"):
        read(path, ["/deep"])


def deep_message(writer: Writer, depth: int) -> None:
    writer.add_message(writer.register_channel("/deep", "json", 0), 5, b"[" * depth + b"]" * depth, 5)


@pytest.mark.parametrize(
    "schema",
    [
        ("my_msgs/msg/Thing", "ros2msg", b"float64 x\nmy_msgs/Other other\n"),
        ("my_msgs/msg/Thing", "ros2msg", b"this is no definition"),
        ("my_msgs/msg/Thing", "flatbuffer", b"\x01"),
        ("my_msgs/msg/Thing", "ros2msg", b"\xff\xfe"),
    ],
    ids=["a part is missing", "no definition", "another encoding", "no text"],
)
def test_a_schema_that_cannot_be_understood_is_refused_before_the_first_message(
    tmp_path: Path, schema: tuple[str, str, bytes]
) -> None:
    path = write_cdr(tmp_path / "run.mcap", schema, POINT_CDR)
    with open_log(path) as log, pytest.raises(LogError, match="cannot be understood"):
        log.messages(["/t"])


# --- real logs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "relative",
    [
        "logs/rosbags_rs_testbags/tests/test_bags/test_bag_mcap/test_bag_mcap.mcap",
        "logs/rosbag2_tests/rosbag2_tests/resources/mcap/cdr_test/cdr_test_0.mcap",
        "logs/rosbag2_tests/rosbag2_py/test/resources/mcap/talker/talker.mcap",
        "logs/rosbag2_tests/rosbag2_py/test/resources/mcap/convert_a/rewriter_a_0.mcap",
        "logs/keelson/test.e50a33.mcap",
        "logs/lichtblick/e2e_fixtures_assets_custom-camera-model.mcap",
        "logs/lichtblick/e2e_fixtures_assets_example_logs.mcap",
    ],
)
def test_real_logs_are_decoded_whole_and_in_the_order_of_the_mcap_library(relative: str) -> None:
    path = real_data(relative)
    ours = [(m.topic, m.log_time_ns, m.publish_time_ns) for m in read(path)]
    with path.open("rb") as stream:
        theirs = [(c.topic, m.log_time, m.publish_time) for _, c, m in make_reader(stream).iter_messages()]
    assert ours == theirs


def test_real_log_without_statistics_counts_its_messages() -> None:
    with open_log(real_data("logs/rosbags_rs_testbags/tests/test_bags/test_bag_mcap/test_bag_mcap.mcap")) as log:
        topics = log.topics()
    assert len(topics) == 94
    assert {t.message_count for t in topics} == {2}


def test_wrong_serialisation_is_refused_only_when_asked_for() -> None:
    with open_log(
        real_data("logs/rosbag2_tests/rosbag2_tests/resources/mcap/wrong_rmw_test/wrong_rmw_test_0.mcap")
    ) as log:
        assert len(log.topics()) == 2
        with pytest.raises(LogError, match="wrong_format") as caught:
            log.messages(["/test_topic"])
    assert "/test_topic" in str(caught.value)


def test_a_service_schema_is_refused_only_when_asked_for() -> None:
    path = real_data("logs/rosbag2_tests/rosbag2_cpp/test/rosbag2_cpp/bags/topics_and_services.mcap")
    assert len(read(path, ["/parameter_events"])) == 7
    with pytest.raises(LogError, match="schema cannot be understood"):
        read(path, ["/add_two_ints/_service_event"])
