"""Every log of the real folder: what `inspect` says of it agrees with the count of the field's own readers; damaged ones get their error.

The expectations are rules, not a list of files: a log that the mcap package or rosbags reads is read with the same topics and counts,
and one that they refuse is refused in words."""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import ReaderError as Rosbag1Error
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import ReaderError as Rosbag2Error

from tests.real_data import ROOT, real_data
from vilp_data.decode.usual_fields import usual_fields
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import LogError
from vilp_data.ingest import ingest_logs
from vilp_data.log_summary import LogSummary, format_summary, summarise
from vilp_data.sources import open_log
from vilp_data.task_toml import parse_task

SUFFIXES = (".mcap", ".bag", ".db3")
METADATA_ALONE = (
    "rosbags judges a bag by its metadata.yaml alone, which names another serialisation than the file holds"
)


def real_logs() -> list[str]:
    """Files and bag folders, relative to the folder of logs; empty where it is absent."""
    try:
        base = real_data("logs")
    except pytest.skip.Exception:
        return []
    files = [path for path in base.rglob("*") if path.suffix in SUFFIXES or (path / "metadata.yaml").is_file()]
    return sorted(path.relative_to(base).as_posix() for path in files)


@cache
def counted(path: Path) -> Counter[str] | None:
    """Topic -> messages by the field's own reader, topics without any left out; None where it refuses the log."""
    try:
        if path.suffix == ".mcap":
            with path.open("rb") as stream:
                return Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())
        if path.suffix == ".bag":
            with Rosbag1Reader(path) as bag:
                return +Counter({topic: info.msgcount for topic, info in bag.topics.items()})
        with Rosbag2Reader(path) as reader:
            return +Counter({topic: info.msgcount for topic, info in reader.topics.items()})
    except (McapError, Rosbag1Error, Rosbag2Error):
        return None


@cache
def summary_of(path: Path) -> LogSummary:
    return summarise(path)


@pytest.mark.parametrize("name", real_logs() or [None])
def test_inspect_agrees_with_the_fields_own_readers(name: str | None) -> None:
    if name is None:
        pytest.skip(f"real data not present: {ROOT.parent / 'shared' / 'data' / 'logs'} (set VILP_TEST_DATA)")
    path = real_data("logs") / name
    expected = counted(path)
    if expected is None and "wrong_rmw_test" in name and path.is_dir():
        pytest.skip(METADATA_ALONE)
    if expected is None:
        with pytest.raises(LogError) as caught:
            summarise(path)
        assert caught.value.remedy
        return
    summary = summary_of(path)
    assert {topic.name: topic.n_messages for topic in summary.topics if topic.n_messages} == expected
    assert format_summary(summary)
    assert summary.doubts == ()
    assert (summary.n_episodes, summary.duration_s > 0) == ((1, True) if expected else (0, False))


@pytest.mark.parametrize("name", real_logs() or [None])
def test_every_topic_without_a_note_is_read_whole(name: str | None) -> None:
    """And where the schema of one topic is not understood, the others are not kept back."""
    if name is None:
        pytest.skip(f"real data not present: {ROOT.parent / 'shared' / 'data' / 'logs'} (set VILP_TEST_DATA)")
    path = real_data("logs") / name
    if counted(path) is None:
        pytest.skip("a log that cannot be read, or " + METADATA_ALONE)
    readable = Counter(
        {topic.name: topic.n_messages or 0 for topic in summary_of(path).topics if topic.n_messages and not topic.note}
    )
    with open_log(path) as log:
        messages = list(log.messages(list(readable)))
    assert Counter(message.topic for message in messages) == readable
    times = [message.log_time_ns for message in messages]
    assert times == sorted(times)


def test_one_recording_in_three_compressions_gives_the_same_messages() -> None:
    """A real bag in lz4 and in bz2 (the uncompressed one of the folder is another take of the same scene)."""
    bags = [
        real_data("logs/webviz_bags") / f"packages_webviz-core_public_fixtures_{end}"
        for end in ("example-bz2.bag", "example.lz4.bag")
    ]
    read = []
    for bag in bags:
        with open_log(bag) as log:
            topics = [topic.name for topic in log.topics() if topic.name.endswith("/pose")]
            read.append([(m.topic, m.log_time_ns, m.body.x, m.body.theta) for m in log.messages(topics)])
    assert read[0] == read[1]
    assert len(read[0]) == 2688


def test_a_split_bag_is_the_same_in_both_storages() -> None:
    found = []
    for storage in ("mcap", "sqlite3"):
        with open_log(real_data(f"logs/rosbag2_tests/rosbag2_py/test/resources/{storage}/wbag")) as log:
            messages = list(log.messages([topic.name for topic in log.topics()]))
        found.append(sorted((m.log_time_ns, m.topic, m.body.data) for m in messages))
    assert found[0] == found[1]
    assert len(found[0]) == 6074


TURTLE = """
name = "turtle"
rate_hz = 10

[low_dim.pose]
topic = "/turtle1/pose"
clock = "log"
fields = ["x", "y", "theta"]

[action.velocity]
topic = "/turtle1/cmd_vel"
clock = "log"
"""


def test_a_real_bag_is_ingested_by_a_spec_of_a_dozen_lines(tmp_path: Path) -> None:
    """Each step holds the latest pose at or before its tick, as rosbags reads it."""
    path = real_data("logs/webviz_bags/packages_webviz-core_public_fixtures_example.lz4.bag")
    report = ingest_logs([path], tmp_path, parse_task(TURTLE, where="turtle.toml"), workers=1)
    episode = EpisodeStore(tmp_path).read(*report.written)
    with AnyReader([path]) as bag:
        chosen = [connection for connection in bag.connections if connection.topic == "/turtle1/pose"]
        read = [(time, bag.deserialize(data, connection.msgtype)) for connection, time, data in bag.messages(chosen)]
    times = np.array([time for time, _ in read])
    poses = np.array([(pose.x, pose.y, pose.theta) for _, pose in read], np.float32)  # type: ignore[attr-defined]
    latest = np.searchsorted(times, episode.log_time_ns, side="right") - 1
    assert np.array_equal(episode.low_dim, poses[latest])
    assert episode.action is not None
    assert episode.action.shape == (episode.n_steps, 6)
    assert episode.valid.mean() > 0.9


@pytest.mark.slow
def test_every_type_with_usual_numbers_is_ingested_from_every_real_log(tmp_path: Path) -> None:
    taken = 0
    for name in real_logs() or [real_data("logs").name]:
        path = real_data("logs") / name
        try:
            topics = {t.schema: t.name for t in summary_of(path).topics if t.n_messages and usual_fields(t.schema)}
        except LogError:
            continue
        for number, topic in enumerate(topics.values()):
            text = f'name = "t"\nrate_hz = 10\n[low_dim.v]\ntopic = "{topic}"\nclock = "log"\nstale_after_s = 60\n'
            root = tmp_path / f"{taken}-{number}"
            report = ingest_logs([path], root, parse_task(text, where=name), workers=1)
            assert (len(report.written), report.failed) == (1, []), f"{name} {topic}"
            taken += 1
    assert taken > 0
