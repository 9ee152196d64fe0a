"""What EpisodeRecorder writes is what a reader, ours or another's, gets back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from tests.synthetic import card_frame, psnr
from vilp_data.decode import decode_image, decode_vector
from vilp_data.errors import StoreError, UsageError
from vilp_data.recorder import CAMERA_LATENCY, EpisodeRecorder, Latency
from vilp_data.sources import open_log
from vilp_data.types import Message

TICK_NS = 100_000_000
N_TICKS = 12


def record(path: Path, *, seed: int = 0, latency: Latency = CAMERA_LATENCY) -> Path:
    """Twelve ticks of every kind of message."""
    with EpisodeRecorder(path, metadata={"task": "card", "seed": str(seed)}, seed=seed) as log:
        for tick in range(N_TICKS):
            stamp_ns = (tick + 1) * TICK_NS
            log.image("/camera/front/image", stamp_ns, card_frame(tick), latency=latency)
            log.joint_state("/joint_states", stamp_ns, ["elbow", "wrist"], [tick, -tick], [0.5, 0.25])
            log.pose("/ee_pose", stamp_ns, [tick, 2, 3], [0, 0, 0.6, 0.8], frame_id="base")
            log.twist("/action/ee_delta", stamp_ns, [0.01 * tick, 0, 0], [0, 0, 0.5], frame_id="base")
            log.vector("/sim/state", stamp_ns, np.arange(5) + tick / 3)
        log.metadata["success"] = "true"
    return path


def messages(path: Path, topic: str) -> list[Message]:
    with open_log(path) as log:
        return list(log.messages([topic]))


def test_images_come_back_upright_in_their_colours(tmp_path: Path) -> None:
    read = [decode_image(message) for message in messages(record(tmp_path / "a.mcap"), "/camera/front/image")]
    assert len(read) == N_TICKS
    for tick, image in enumerate(read):
        right = psnr(image, card_frame(tick))
        assert right > 34
        for wrong in (image[::-1], image[:, ::-1], image[..., ::-1], read[tick - 1]):
            assert psnr(np.ascontiguousarray(wrong), card_frame(tick)) < right - 3


def test_jpeg_keeps_colour_at_full_resolution(tmp_path: Path) -> None:
    body = messages(record(tmp_path / "a.mcap"), "/camera/front/image")[0].body
    data = np.frombuffer(body.data, np.uint8)
    start_of_frame = body.data.index(b"\xff\xc0")
    components = np.frombuffer(body.data[start_of_frame + 10 : start_of_frame + 19], np.uint8).reshape(3, 3)
    assert components[:, 1].tolist() == [0x11, 0x11, 0x11]  # luma and both chromas sampled alike: 4:4:4
    assert cv2.imdecode(data, cv2.IMREAD_COLOR) is not None


@pytest.mark.parametrize(
    ("topic", "fields", "expected"),
    [
        ("/joint_states", ["position", "velocity"], lambda tick: [tick, -tick, 0.5, 0.25]),
        ("/ee_pose", ["pose.position.x", "pose.orientation.z", "pose.orientation.w"], lambda tick: [tick, 0.6, 0.8]),
        ("/action/ee_delta", ["twist.linear.x", "twist.angular.z"], lambda tick: [0.01 * tick, 0.5]),
        ("/sim/state", ["data"], lambda tick: (np.arange(5) + tick / 3).tolist()),
    ],
)
def test_numbers_come_back_exactly(
    tmp_path: Path, topic: str, fields: list[str], expected: Callable[[int], list[float]]
) -> None:
    for tick, message in enumerate(messages(record(tmp_path / "a.mcap"), topic)):
        assert decode_vector(message, fields).tolist() == expected(tick)


def test_stamps_are_capture_times_and_log_times_come_a_latency_later(tmp_path: Path) -> None:
    images = messages(record(tmp_path / "a.mcap"), "/camera/front/image")
    stamps = [message.body.timestamp.ToNanoseconds() for message in images]
    assert stamps == [(tick + 1) * TICK_NS for tick in range(N_TICKS)]
    delays_s = (np.array([message.log_time_ns for message in images]) - stamps) / 1e9
    assert (delays_s >= CAMERA_LATENCY.least_s).all()
    assert (delays_s <= CAMERA_LATENCY.least_s + CAMERA_LATENCY.jitter_s).all()
    assert len(set(delays_s)) > 1
    states = messages(tmp_path / "a.mcap", "/sim/state")
    assert [message.log_time_ns for message in states] == stamps


def test_messages_lie_in_the_file_in_order_of_log_time(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", latency=Latency(0.25))  # later than two further ticks of everything else
    with path.open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_the_file_is_indexed_checked_and_says_what_it_holds(tmp_path: Path) -> None:
    with record(tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        records = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        assert len(list(reader.iter_messages())) == 5 * N_TICKS
    assert summary is not None
    assert summary.chunk_indexes
    assert all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)
    assert records == {"episode": {"task": "card", "seed": "0", "success": "true"}}
    schema_of = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert schema_of["/camera/front/image"].name == "foxglove.CompressedImage"
    assert schema_of["/ee_pose"].name == "geometry_msgs/msg/PoseStamped"
    assert b"MSG: geometry_msgs/Quaternion" in schema_of["/ee_pose"].data  # complete: no message definitions to install


def test_a_flipped_byte_is_found(tmp_path: Path) -> None:
    data = bytearray(record(tmp_path / "a.mcap").read_bytes())
    data[len(data) // 3] ^= 0x10
    (tmp_path / "b.mcap").write_bytes(data)
    with pytest.raises(Exception, match=r"(?i)crc|checksum|damaged"):
        messages(tmp_path / "b.mcap", "/camera/front/image")


def test_same_messages_give_the_same_bytes_and_another_seed_other_latencies(tmp_path: Path) -> None:
    first = record(tmp_path / "a.mcap").read_bytes()
    assert record(tmp_path / "b.mcap").read_bytes() == first
    assert record(tmp_path / "c.mcap", seed=1).read_bytes() != first


def test_nothing_is_left_when_the_episode_breaks_off(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(RuntimeError, match="arm fell off"), EpisodeRecorder(path, metadata={}) as log:
        log.vector("/sim/state", TICK_NS, [1.0])
        raise RuntimeError("arm fell off")
    assert list(tmp_path.iterdir()) == []


def test_a_file_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with EpisodeRecorder(path, metadata={}) as log:
        log.vector("/sim/state", TICK_NS, [1.0])
        assert not path.exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file, not a folder")
    with pytest.raises(StoreError, match="logs"):
        record(tmp_path / "logs" / "a.mcap")


def test_wrong_images_and_mixed_topics_are_refused(tmp_path: Path) -> None:
    with EpisodeRecorder(tmp_path / "a.mcap", metadata={}) as log:
        with pytest.raises(UsageError, match=r"uint8 \[H,W,3\] RGB"):
            log.image("/camera", TICK_NS, np.zeros((4, 4, 3), np.float32))
        log.vector("/state", TICK_NS, [1.0])
        with pytest.raises(UsageError, match="one kind of message"):
            log.joint_state("/state", TICK_NS, ["a"], [1.0])
