"""LeRobot datasets: the frame of a row is the one at its time, each episode stands alone, damage is said in words."""

from __future__ import annotations

import json
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.lerobot_folders import CAMERA, LeRobotFolder, number_of, write_v3, write_v21, write_video
from tests.real_data import real_data
from vilp_data import limits
from vilp_data.decode import decode_image
from vilp_data.errors import LogError
from vilp_data.log_summary import format_summary, summarise
from vilp_data.sources import IndexedLog, lerobot_table, open_log
from vilp_data.types import LogEpisode

NTSC = Fraction(30_000, 1001)


def shown(log: IndexedLog, episode: LogEpisode) -> list[int]:
    """The numbers that an episode's pictures show, in order."""
    messages = log.messages([CAMERA], start_ns=episode.start_ns, end_ns=episode.end_ns)
    return [number_of(decode_image(message)) for message in messages]


def states(log: IndexedLog, episode: LogEpisode) -> list[int]:
    messages = log.messages(["observation.state"], start_ns=episode.start_ns, end_ns=episode.end_ns)
    return [int(message.body[0]) for message in messages]


@pytest.mark.parametrize("b_frames", [0, 3])
@pytest.mark.parametrize("rate", [Fraction(30), NTSC, Fraction(50)], ids=["30", "29.97", "50"])
def test_row_k_gets_frame_k(tmp_path: Path, rate: Fraction, b_frames: int) -> None:
    folder = write_v21(tmp_path / "set", lengths=(70, 40), rate=rate, b_frames=b_frames)
    with open_log(folder.path) as log:
        for episode, start, length in zip(log.episodes(), folder.starts, folder.lengths, strict=True):
            assert shown(log, episode) == states(log, episode) == list(range(start, start + length))


@pytest.mark.parametrize("b_frames", [0, 3])
@pytest.mark.parametrize("rate", [Fraction(30), NTSC], ids=["30", "29.97"])
@pytest.mark.parametrize("gop", [1, 5, 250])
def test_episodes_that_share_a_file_get_their_own_rows_and_frames(
    tmp_path: Path, rate: Fraction, b_frames: int, gop: int
) -> None:
    folder = write_v3(tmp_path / "set", rate=rate, b_frames=b_frames, gop=gop)
    with open_log(folder.path) as log:
        for episode, start, length in zip(log.episodes(), folder.starts, folder.lengths, strict=True):
            assert shown(log, episode) == states(log, episode) == list(range(start, start + length))


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["libx264", "libsvtav1"])
def test_every_window_of_an_episode_begins_at_its_frame(tmp_path: Path, codec: str) -> None:
    folder = write_v21(tmp_path / "set", lengths=(60,), b_frames=3 if codec == "libx264" else 0, codec=codec)
    with open_log(folder.path) as log:
        for first in range(60):
            start_ns = round(first * 1e9 / 30)
            message = next(iter(log.messages([CAMERA], start_ns=start_ns)))
            assert (message.log_time_ns, number_of(message.body)) == (start_ns, first)


def test_av1_is_decoded(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", lengths=(12,), codec="libsvtav1")
    with open_log(folder.path) as log:
        assert shown(log, log.episodes()[0]) == list(range(12))


def test_colours_and_their_places_survive(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", lengths=(3,))
    with open_log(folder.path) as log:
        image = log.first_messages(CAMERA, 1)[0].body
    width = image.shape[1]
    assert np.abs(image[-4, 4].astype(int) - (220, 30, 30)).max() < 12
    assert np.abs(image[-4, width - 4].astype(int) - (30, 30, 220)).max() < 12


def test_messages_of_all_topics_come_together_in_order_of_time(tmp_path: Path) -> None:
    folder = write_v3(tmp_path / "set")
    with open_log(folder.path) as log:
        second = log.episodes()[1]
        messages = list(
            log.messages([CAMERA, "action"], start_ns=second.start_ns, end_ns=second.start_ns + 100_000_000)
        )
    assert [(m.topic, m.log_time_ns) for m in messages] == [
        (topic, round((20 + k) * 1e9 / 30)) for k in range(3) for topic in ("action", CAMERA)
    ]
    assert [float(m.body[0]) for m in messages[::2]] == [20.5, 21.5, 22.5]
    assert [number_of(m.body) for m in messages[1::2]] == [20, 21, 22]


def test_features_are_topics_and_tasks_are_tags(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    with open_log(folder.path) as log:
        assert {(t.name, t.message_count) for t in log.topics()} == {
            ("observation.state", 47), ("action", 47), (CAMERA, 47)
        }  # fmt: skip
        assert [(e.name, dict(e.tags)) for e in log.episodes()] == [
            (f"episode_{n:06d}", {"task": f"task {n % 2}", "robot": "two_joints"}) for n in range(3)
        ]
        assert log.metadata()["names"] == {"observation.state": "one, two", "action": "one"}


def test_images_inside_parquet_are_read(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", images="image")
    with open_log(folder.path) as log:
        assert [shown(log, episode) for episode in log.episodes()] == [
            list(range(start, start + length)) for start, length in zip(folder.starts, folder.lengths, strict=True)
        ]


def test_a_grown_dataset_keeps_the_hashes_of_its_episodes(tmp_path: Path) -> None:
    """In v3 new episodes go into files that others are in already."""
    old = write_v3(tmp_path / "old", lengths=(20, 15), gop=1)
    new = write_v3(tmp_path / "new", lengths=(20, 15, 9), gop=1)
    with open_log(old.path) as one, open_log(new.path) as other:
        hashes = [other.demonstration_sha256(e.name) for e in other.episodes()]  # type: ignore[attr-defined]
        assert [one.demonstration_sha256(e.name) for e in one.episodes()] == hashes[:2]  # type: ignore[attr-defined]
    assert len(set(hashes)) == 3


def test_another_picture_or_number_is_another_hash(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    name = "episode_000001"
    with open_log(folder.path) as log:
        before = log.demonstration_sha256(name)  # type: ignore[attr-defined]
    write_video(folder.video(1), range(100, 115), folder.rate)
    with open_log(folder.path) as log:
        after = log.demonstration_sha256(name)  # type: ignore[attr-defined]
    table = pq.read_table(folder.table(1))
    column = table.schema.get_field_index("action")
    pq.write_table(
        table.set_column(column, "action", table["action"].combine_chunks().take(list(range(14, -1, -1)))),
        folder.table(1),
    )
    with open_log(folder.path) as log:
        assert len({before, after, log.demonstration_sha256(name)}) == 3  # type: ignore[attr-defined]


# --- what is missing or damaged stops its own episode only ---------------------------------------------------------------------


def assert_only_episode_1_fails(folder: LeRobotFolder, says: str) -> None:
    with open_log(folder.path) as log:
        first, second, third = log.episodes()[:3]
        for episode, start in ((first, folder.starts[0]), (third, folder.starts[2])):
            assert shown(log, episode)[0] == start
        with pytest.raises(LogError, match=says) as caught:
            shown(log, second)
    assert "episode 1" in str(caught.value)
    assert caught.value.remedy


def test_a_list_of_episodes_that_was_cut_off_is_doubted(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    with open_log(folder.path) as log:
        assert log.doubts() == []
    listed = folder.path / "meta" / "episodes.jsonl"
    lines = listed.read_text().splitlines(keepends=True)
    listed.write_text(lines[0])
    with open_log(folder.path) as log:
        assert len(log.episodes()) == 1
        assert "meta/info.json counts 3 episodes, the list of episodes holds 1" in log.doubts()
    listed.write_text(lines[0] + lines[2])
    with open_log(folder.path) as log:
        assert "the list of episodes leaves out 1 of them, from episode 1 on" in log.doubts()


def test_the_headline_counts_what_is_there(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    folder.video(1).unlink()
    folder.table(2).unlink()
    summary = summarise(folder.path)
    text = format_summary(summary)
    assert "1 of 3 episodes have all their files" in text.splitlines()[0]
    counts = {topic.name: topic.n_messages for topic in summary.topics}
    first, second, _ = folder.lengths
    assert (counts[CAMERA], counts["observation.state"]) == (first, first + second)
    assert f"1 of 3 episodes lack their video {CAMERA}" in text
    assert "1 of 3 episodes lack their table" in text


def test_rows_too_wide_for_memory_are_read_a_few_at_a_time_or_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_v21(tmp_path / "set", lengths=(40,))
    monkeypatch.setattr(lerobot_table, "BATCH_BYTES", 100)
    with open_log(folder.path) as log:
        assert states(log, log.episodes()[0]) == list(range(40))
    monkeypatch.setattr(limits, "ARRAY_CHUNK_BYTES", 7)
    with open_log(folder.path) as log, pytest.raises(LogError, match="VILP_MAX_ARRAY_CHUNK_BYTES"):
        states(log, log.episodes()[0])


def test_a_missing_video(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    folder.video(1).unlink()
    assert_only_episode_1_fails(folder, "the video is missing")
    with open_log(folder.path) as log:
        assert len(states(log, log.episodes()[1])) == 15  # its numbers can be had
        assert log.doubts() == [f"1 of 3 episodes lack their video {CAMERA}"]


def test_a_missing_table(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    folder.table(1).unlink()
    assert_only_episode_1_fails(folder, "table is missing")


@pytest.mark.parametrize("kept", [0, 3, 100, 0.5, 0.98])
def test_a_table_that_is_cut_off(tmp_path: Path, kept: float) -> None:
    folder = write_v21(tmp_path / "set")
    data = folder.table(1).read_bytes()
    folder.table(1).write_bytes(data[: int(kept * len(data)) if 0 < kept < 1 else int(kept)])
    assert_only_episode_1_fails(folder, "the table cannot be read")


@pytest.mark.parametrize("kept", [0, 20, 0.5, 0.8])
def test_a_video_that_is_cut_off(tmp_path: Path, kept: float) -> None:
    folder = write_v21(tmp_path / "set")
    data = folder.video(1).read_bytes()
    folder.video(1).write_bytes(data[: int(kept * len(data)) if 0 < kept < 1 else int(kept)])
    assert_only_episode_1_fails(folder, "the video (cannot be|is shorter)")


@pytest.mark.parametrize("b_frames", [0, 3])
def test_a_video_cut_anywhere_gives_its_first_frames_in_their_places_or_an_error(tmp_path: Path, b_frames: int) -> None:
    """With its index first, as files for streaming have it, so that the rest can be decoded as far as it goes."""
    folder = write_v21(tmp_path / "set", lengths=(24,), b_frames=b_frames)
    index_first = tmp_path / "index_first.mp4"
    with (
        av.open(str(folder.video(0))) as given,
        av.open(str(index_first), "w", options={"movflags": "faststart"}) as out,
    ):
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    data, counts = index_first.read_bytes(), set()
    for kept in range(len(data) // 12, len(data), len(data) // 12):
        folder.video(0).write_bytes(data[:kept])
        seen: list[int] = []
        with open_log(folder.path) as log, pytest.raises(LogError, match="the video"):
            for message in log.messages([CAMERA]):
                seen.append(number_of(message.body))
        assert seen == list(range(len(seen)))
        counts.add(len(seen))
    assert len(counts) > 2


def test_a_video_with_fewer_frames_than_rows(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    write_video(folder.video(1), range(20, 34), folder.rate, b_frames=2)
    assert_only_episode_1_fails(folder, "shorter than its table(.|\n)*row 14 of 15")


def test_a_video_that_starts_late_is_not_shifted(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    source, late = folder.video(1), tmp_path / "late.mp4"
    with av.open(str(source)) as given, av.open(str(late), "w") as written:
        stream = written.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is None:
                continue
            packet.pts += round(1 / folder.rate / packet.time_base)
            packet.dts += round(1 / folder.rate / packet.time_base)
            packet.stream = stream
            written.mux(packet)
    shutil.move(late, source)
    assert_only_episode_1_fails(folder, "no frame at the time of a row(.|\n)*row 0 is at 0.0000")


def test_a_video_of_another_rate_than_its_table(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", lengths=(20, 90, 20))
    write_video(folder.video(1), range(20, 110), NTSC)
    assert_only_episode_1_fails(folder, "no frame at the time of a row")


def test_damage_inside_a_video(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    data = bytearray(folder.video(1).read_bytes())
    start = data.index(b"mdat") + 8
    middle = start + (data.index(b"moov") - start) * 3 // 4 if data.index(b"moov") > start else start + 400
    data[middle : middle + 60] = bytes(60)
    folder.video(1).write_bytes(bytes(data))
    assert_only_episode_1_fails(folder, "video")


def test_a_table_of_other_rows_than_meta_says(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    pq.write_table(pq.read_table(folder.table(1)).slice(1), folder.table(1))
    assert_only_episode_1_fails(folder, "14 rows of this episode in the file, 15 by meta/")


def test_the_table_of_another_episode(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", lengths=(20, 15, 15))
    shutil.copy(folder.table(2), folder.table(1))
    assert_only_episode_1_fails(folder, "0 rows of this episode in the file")


def with_timestamps(folder: LeRobotFolder, episode: int, seconds: np.ndarray) -> None:
    table = pq.read_table(folder.table(episode))
    column = table.schema.get_field_index("timestamp")
    pq.write_table(table.set_column(column, "timestamp", [seconds.astype(np.float32)]), folder.table(episode))


def test_time_stamps_that_do_not_rise(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    with_timestamps(folder, 1, np.array([*range(8), 7, *range(9, 15)]) / 30)
    assert_only_episode_1_fails(folder, "do not rise(.|\n)*at row 8")


def test_time_stamps_of_another_rate_than_the_dataset(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    with_timestamps(folder, 1, np.arange(15) / 15)
    assert_only_episode_1_fails(folder, "do not fit the dataset's fps")


def test_rows_of_another_width_than_stated(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set")
    info = json.loads((folder.path / "meta/info.json").read_text())
    info["features"]["observation.state"]["shape"] = [3]
    (folder.path / "meta/info.json").write_text(json.dumps(info))
    with open_log(folder.path) as log, pytest.raises(LogError, match="another shape than stated"):
        list(log.messages(["observation.state"]))


# --- meta/ that cannot be used ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"codebase_version": "v1.6"}, "version that is not read(.|\n)*v1.6"),
        ({"fps": 0}, "states no rate"),
        ({"fps": "fast"}, "info.json cannot be used"),
        ({"data_path": "../../{episode_index:06d}.parquet"}, "leads out of the dataset"),
        ({"data_path": "/etc/{episode_index}"}, "leads out of the dataset"),
        ({"video_path": "{secret}.mp4"}, "secret"),
        ({"features": []}, "info.json cannot be used"),
    ],
)
def test_an_info_that_cannot_be_used(tmp_path: Path, change: dict[str, object], says: str) -> None:
    folder = write_v21(tmp_path / "set", images="image", lengths=(3,))
    path = folder.path / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["extra"] = {"dtype": "video", "shape": [4, 4, 3]}
    path.write_text(json.dumps(info | change))
    with pytest.raises(LogError, match=says):
        open_log(folder.path)


def test_format_fields_of_a_path_are_only_numbers(tmp_path: Path) -> None:
    """Python's own str.format would look up attributes, and pad to any width."""
    folder = write_v21(tmp_path / "set", images="image", lengths=(3,))
    path = folder.path / "meta/info.json"
    info = json.loads(path.read_text()) | {"data_path": "data/{episode_index.real:0999999999d}.parquet"}
    path.write_text(json.dumps(info))
    with open_log(folder.path) as log, pytest.raises(LogError, match="table is missing"):
        list(log.messages(["action"]))


def test_a_damaged_list_of_episodes_names_its_line(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "set", images="image", lengths=(3, 3))
    path = folder.path / "meta/episodes.jsonl"
    path.write_text(path.read_text()[:-10])
    with pytest.raises(LogError, match="line 2"):
        open_log(folder.path)


def test_real_g1_reads_the_episodes_that_are_there_and_names_what_is_not() -> None:
    with open_log(real_data("g1_inspire_lerobot")) as log:
        episodes = {episode.name: episode for episode in log.episodes()}
        assert len(episodes) == 100
        assert episodes["episode_000028"].tags["task"] == "Pick up the yellow bottle on the table."
        there = episodes["episode_000028"]
        first = list(log.messages([CAMERA_G1, "action"], start_ns=there.start_ns, end_ns=there.start_ns + 200_000_000))
        assert [m.topic for m in first] == ["action", CAMERA_G1] * 6
        assert first[1].body.shape == (480, 640, 3)
        for name, says in (("episode_000000", "the video is missing"), ("episode_000001", "table is missing")):
            absent = episodes[name]
            with pytest.raises(LogError, match=says):
                list(log.messages([CAMERA_G1], start_ns=absent.start_ns, end_ns=absent.end_ns))


CAMERA_G1 = "observation.images.cam_high"
