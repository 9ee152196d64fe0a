"""The summary tells what is in a log, without reading it all and without failing on one bad topic."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.lerobot_folders import write_v21
from tests.real_data import real_data
from tests.synthetic import HEADER_LAG_NS, JOINT_TOPIC, START_NS, image_topic, write_mcap, write_zarr
from vilp_data import log_summary
from vilp_data.check.log import check_log
from vilp_data.log_summary import MOST_TOPICS, LogSummary, TopicSummary, format_summary, summarise


def topic(summary: LogSummary, name: str) -> TopicSummary:
    return next(topic for topic in summary.topics if topic.name == name)


def write_stamped(path: Path, times: list[int], stamps: list[int]) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        channel = writer.register_channel("/t", "json", writer.register_schema("s", "jsonschema", b"{}"))
        for time, stamp in zip(times, stamps, strict=True):
            body = {"header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}}
            writer.add_message(channel, time, json.dumps(body).encode(), time)
        writer.finish()
    return path


def test_rates_counts_images_and_clocks_are_told(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", encoding="protobuf", n_frames=20, height=48, width=64, tags={"seed": "3"})
    summary = summarise(log.path)
    camera, joints = topic(summary, image_topic("front")), topic(summary, JOINT_TOPIC)
    assert (camera.schema, camera.encoding, camera.n_messages, camera.image) == (
        "foxglove.CompressedImage",
        "protobuf",
        20,
        "48x64 jpeg",
    )
    assert camera.rate_hz == pytest.approx(10)
    assert joints.rate_hz == pytest.approx(50)
    assert joints.image is None
    assert (camera.header_clock, summary.log_clock) == ("wall", "wall")
    assert camera.header_lag_s == pytest.approx(HEADER_LAG_NS / 1e9)
    assert summary.duration_s == pytest.approx(1.98)
    assert summary.metadata == {"episode": {"seed": "3"}}


def test_a_gap_is_found(tmp_path: Path) -> None:
    times = [START_NS + i * 10**8 for i in range(20)] + [START_NS + 5 * 10**9]
    found = topic(summarise(write_stamped(tmp_path / "run.mcap", times, times)), "/t")
    assert found.max_gap_s == pytest.approx(3.1)
    assert found.rate_hz == pytest.approx(10)


def test_a_topic_that_comes_in_bursts_has_the_rate_of_its_messages_over_the_log(tmp_path: Path) -> None:
    times = [START_NS + burst * 500_000_000 + i * 500_000 for burst in range(20) for i in range(30)]
    path = write_stamped(tmp_path / "run.mcap", times, times)
    (checked,) = check_log(path).topics
    assert topic(summarise(path), "/t").rate_hz == pytest.approx(599 / 9.5145)
    assert checked.timing is not None
    assert checked.timing.rate_hz == topic(summarise(path), "/t").rate_hz


def test_two_messages_at_once_are_no_fast_topic(tmp_path: Path) -> None:
    times = [START_NS, START_NS + 2, START_NS + 10 * 10**9]
    assert topic(summarise(write_stamped(tmp_path / "run.mcap", times, times)), "/t").rate_hz == pytest.approx(0.2)
    assert topic(summarise(write_stamped(tmp_path / "all.mcap", [START_NS] * 3, times)), "/t").rate_hz is None


def test_very_many_topics_of_one_message_are_only_counted_in_the_terminal(tmp_path: Path) -> None:
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        schema = writer.register_schema("s", "jsonschema", b"{}")
        for number in range(MOST_TOPICS + 1):
            channel = writer.register_channel(f"/t{number}", "json", schema)
            for i in range(2 if number == 7 else 1):
                writer.add_message(channel, START_NS + i, b"{}", START_NS + i)
        writer.finish()
    text = format_summary(summarise(tmp_path / "run.mcap"))
    assert [line.split()[0] for line in text.splitlines()[1:] if line.startswith("/t")] == ["/t7"]
    assert f"and {MOST_TOPICS} topics of one message or none" in text


def test_episodes_that_are_absent_are_no_gap(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "robot", lengths=(20, 15, 12))
    folder.table(1).unlink()
    found = topic(summarise(folder.path), "action")
    assert (found.max_gap_s, found.rate_hz) == (pytest.approx(1 / 30), pytest.approx(30))


def test_a_log_clock_that_jumps_back_is_told(tmp_path: Path) -> None:
    times = [START_NS + t for t in (0, 100, 200, 150, 300, 50)]
    summary = summarise(write_stamped(tmp_path / "run.mcap", times, times))
    assert topic(summary, "/t").backward_jumps == 2
    assert "log time falls 2 times" in format_summary(summary)


@pytest.mark.parametrize(
    ("stamps", "clock", "says"),
    [
        ([10**9, 2 * 10**9], "simulated", "simulated time, log time is wall time"),
        ([0, 0], "zero", 'set clock = "log"'),
        ([START_NS - 60 * 10**9, START_NS - 59 * 10**9], "wall", "60.0 s before log time"),
    ],
)
def test_header_clocks_that_need_care_are_told(tmp_path: Path, stamps: list[int], clock: str, says: str) -> None:
    summary = summarise(write_stamped(tmp_path / "run.mcap", [START_NS, START_NS + 10**9], stamps))
    assert topic(summary, "/t").header_clock == clock
    assert says in format_summary(summary)


def test_only_the_first_part_of_a_long_log_is_looked_at_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_mcap(tmp_path / "run.mcap", chunk_size=2000)
    assert not any("rates" in figure for figure in summarise(log.path).sampled)
    monkeypatch.setattr("vilp_data.sources.chunked_log.INDEXED_CHUNKS", 2)
    sampled = summarise(log.path).sampled
    assert any("rates and gaps: the first" in figure for figure in sampled)


def test_few_chunks_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_mcap(tmp_path / "run.mcap", n_frames=60, chunk_size=2000)
    opened: set[int] = set()
    from vilp_data.sources.mcap_records import RecordReader

    original = RecordReader.chunk_data

    def counted(self: RecordReader, chunk: object) -> bytes:
        opened.add(chunk.chunk_start_offset)  # type: ignore[attr-defined]
        return original(self, chunk)  # type: ignore[arg-type]

    monkeypatch.setattr(RecordReader, "chunk_data", counted)
    summarise(log.path)
    assert len(opened) <= 3


def test_zarr_is_summarised_with_its_rate(tmp_path: Path) -> None:
    store = write_zarr(tmp_path / "z.zarr")
    summary = summarise(store.path, array_rate_hz=20.0)
    assert topic(summary, "img").image == "32x32 float32"
    assert topic(summary, "state").rate_hz == pytest.approx(20)
    assert (summary.n_episodes, summary.log_clock) == (3, "none")


def test_the_rate_of_rows_without_time_is_said_to_be_assumed(tmp_path: Path) -> None:
    summary = summarise(write_zarr(tmp_path / "z.zarr").path, array_rate_hz=20.0)
    assert summary.assumed_rate_hz == 20.0
    assert "20 rows a second are assumed" in format_summary(summary)
    assert summarise(write_mcap(tmp_path / "run.mcap").path).assumed_rate_hz is None


def test_a_topic_of_two_channels_has_its_whole_rate(tmp_path: Path) -> None:
    path = tmp_path / "merged.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        channels = [writer.register_channel("/t", "json", 0) for _ in range(2)]
        for index in range(40):
            time = START_NS + index * 50_000_000
            writer.add_message(channels[index % 2], time, b"{}", time)
        writer.finish()
    found = topic(summarise(path), "/t")
    assert found.rate_hz == pytest.approx(20)
    assert (found.n_messages, found.backward_jumps) == (40, 0)


def test_the_summary_is_plain_data_and_a_readable_table(tmp_path: Path) -> None:
    summary = summarise(write_mcap(tmp_path / "run.mcap", tags={"seed": "3"}).path)
    assert json.loads(json.dumps(summary.as_dict()))["topics"][0]["name"] == "/action"
    text = format_summary(summary)
    assert "/camera/front/image" in text
    assert "episode.seed = '3'" in text
    assert f"the first {log_summary.SAMPLED} messages" in text


def test_real_log_with_unreadable_topics_is_summarised_with_notes() -> None:
    path = real_data("logs/rosbag2_tests/rosbag2_tests/resources/mcap/wrong_rmw_test/wrong_rmw_test_0.mcap")
    summary = summarise(path)
    assert [t.n_messages for t in summary.topics] == [4, 3]
    assert all(t.note and "wrong_format" in t.note for t in summary.topics)


@pytest.mark.parametrize(
    "name", ["logs/keelson/test.mcap", "logs/keelson/test.e50a33.mcap", "pusht/pusht_cchi_v7_replay.zarr"]
)
def test_real_logs_are_summarised(name: str) -> None:
    assert format_summary(summarise(real_data(name)))
