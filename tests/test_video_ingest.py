"""Compressed video in a log: the step sees the frame of its own moment, wherever the demonstration begins in the stream."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.synthetic import START_NS
from tests.video_logs import PERIOD_NS, VIDEO, Row, joints, spec_of, write_log, write_video
from tests.video_packets import GROUP, Encoded, encode, number_of, numbered_frames, parted, video_message
from vilp_data import video_start, view_frames
from vilp_data.assemble import assemble_episode
from vilp_data.decode.video_packet import packet_of
from vilp_data.errors import AlignError, DecodeError, SpecError
from vilp_data.log_summary import summarise
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import Episode, LogEpisode
from vilp_data.view_frames import Ticks, ViewFrames

FRAMES = 40


def assembled(path: Path, spec: TaskSpec, *, first: int = 0, last: int = FRAMES) -> Episode:
    """The demonstration of the frames first <= i < last."""
    cut = LogEpisode("cut", START_NS + first * PERIOD_NS, START_NS + last * PERIOD_NS)
    with open_log(path) as log:
        return assemble_episode(log, cut, spec, episode_id="x")


def seen(episode: Episode) -> list[int]:
    """The number of the frame that each step sees."""
    return [number_of(episode.frames["camera"][i]) for i in episode.source_index["camera"]]


@pytest.mark.parametrize("name", ["h264", "h264 with B frames", "h265 with B frames", "vp9", "av1"])
def test_each_step_sees_the_frame_of_its_own_moment(tmp_path: Path, name: str) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(FRAMES), name), name)
    episode = assembled(path, spec_of(VIDEO))
    assert seen(episode) == np.rint(episode.low_dim[:, 0] * 10).astype(int).tolist() == list(range(FRAMES))
    assert episode.valid.all()
    assert episode.findings == ()


@pytest.mark.parametrize("name", ["h264", "h265", "vp9", "av1"])
@pytest.mark.parametrize("first", [GROUP - 1, GROUP, GROUP + 5])
def test_a_demonstration_that_begins_in_mid_stream_reads_from_the_keyframe_before_it(
    tmp_path: Path, name: str, first: int
) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(FRAMES), name), name)
    episode = assembled(path, spec_of(VIDEO), first=first, last=FRAMES - 3)
    assert seen(episode) == list(range(first, FRAMES - 3))
    assert episode.valid.all()
    assert episode.findings == ()


def log_of_bare_keyframes(path: Path, *, parameters: str) -> Path:
    """H.264 whose parameters are messages of their own, before each keyframe ("alone") or in mid-group too ("often"); or that come
    with the first keyframe only ("once")."""
    rows = []
    for number, sent in enumerate(encode(numbered_frames(FRAMES), "h264")):
        time_ns, data = START_NS + number * PERIOD_NS, sent.data
        if sent.keyframe:
            alone, bare = parted(data, packet_of(video_message(data, "h264")).parameters.values())
            data = data if parameters == "once" and number == 0 else bare
        if parameters != "once" and (sent.keyframe or (parameters == "often" and number % 5 == 0)):
            rows.append(Row(time_ns - 1000, VIDEO, video_message(alone, "h264").body))
        rows.append(Row(time_ns, VIDEO, video_message(data, "h264").body))
    return write_log(path, [*rows, *joints(FRAMES)])


@pytest.mark.parametrize("first", [0, GROUP, GROUP + 5, 2 * GROUP - 1])
@pytest.mark.parametrize("parameters", ["alone", "often", "once"])
def test_a_cut_of_a_stream_whose_keyframes_bring_no_parameters_loses_no_picture(
    tmp_path: Path, parameters: str, first: int
) -> None:
    path = log_of_bare_keyframes(tmp_path / "run.mcap", parameters=parameters)
    episode = assembled(path, spec_of(VIDEO), first=first)
    assert seen(episode) == list(range(first, FRAMES))
    assert episode.valid.all()
    assert episode.findings == ()


def test_parameters_from_far_back_are_found_at_the_beginning_of_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = log_of_bare_keyframes(tmp_path / "run.mcap", parameters="once")
    monkeypatch.setattr(video_start, "FIRST_LOOK_S", 1.0)
    episode = assembled(path, spec_of(VIDEO), first=2 * GROUP + 3)
    assert seen(episode) == list(range(2 * GROUP + 3, FRAMES))


@pytest.mark.parametrize("name", ["h264 with B frames", "h265 with B frames"])
def test_a_clock_that_tells_when_packets_were_sent_is_refused_for_b_frames(tmp_path: Path, name: str) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(FRAMES), name), name)
    with pytest.raises(AlignError, match='not in the order of their stamps.*\n.*\n.*clock = "header"'):
        assembled(path, spec_of(VIDEO, clock="log"))


def test_a_jittering_clock_is_not_taken_for_b_frames(tmp_path: Path) -> None:
    sent = encode(numbered_frames(FRAMES), "h264")
    rows = [
        Row(
            START_NS + n * PERIOD_NS,
            VIDEO,
            video_message(p.data, "h264").body,
            START_NS + round((n + 0.7 * (-1) ** n) * PERIOD_NS),
        )
        for n, p in enumerate(sent)
    ]
    path = write_log(tmp_path / "run.mcap", [*rows, *joints(FRAMES)])
    assert assembled(path, spec_of(VIDEO)).n_steps > FRAMES - 4


@pytest.mark.parametrize("table", [{"levels": (0, 4095)}, {"depth": {"unit": "mm", "near_m": 0.1, "far_m": 1.0}}])
def test_video_in_a_view_of_another_kind_is_refused_by_the_name_of_its_table(
    tmp_path: Path, table: dict[str, object]
) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(GROUP), "h264"), "h264")
    (name,) = table
    with pytest.raises(SpecError, match=f"{VIDEO}.*`{name}`"):
        assembled(path, spec_of(VIDEO, **table))


def test_frames_before_the_first_keyframe_of_the_log_mask_their_steps_and_are_counted(tmp_path: Path) -> None:
    sent = encode(numbered_frames(FRAMES), "h264")[5:]
    path = write_video(tmp_path / "run.mcap", [replace(p, shows=p.shows - 5) for p in sent], "h264")
    episode = assembled(path, spec_of(VIDEO))
    lost = GROUP - 5
    assert episode.valid.tolist() == [False] * lost + [True] * (FRAMES - 5 - lost)
    assert seen(episode)[lost:] == list(range(GROUP, FRAMES))
    said = f"view camera: {lost} damaged images passed over, {lost} of them video before its first keyframe"
    assert said in episode.findings


def test_video_without_any_keyframe_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(GROUP), "h264")[1:], "h264")
    with pytest.raises(DecodeError, match="before the first keyframe.*\n.*keyframes more often"):
        assembled(path, spec_of(VIDEO))


def test_a_long_video_without_any_keyframe_is_not_read_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_frames, "HOPELESS_S", 5)
    view = ViewFrames("camera", spec_of(VIDEO).views["camera"], Ticks(10.0, 1))
    message = video_message(encode(numbered_frames(2), "h264")[1].data, "h264")
    read = 0
    with pytest.raises(DecodeError, match="before the first keyframe"):
        for number in range(FRAMES * 10):
            view.add(message, START_NS + number * PERIOD_NS)
            read = number
    assert read == 50


def test_a_video_keeps_a_few_bytes_of_each_image_besides_the_frames_that_steps_see() -> None:
    view = ViewFrames("camera", spec_of(VIDEO).views["camera"], Ticks(0.1, 1, start_ns=START_NS))
    messages = [video_message(p.data, "h264") for p in encode(numbered_frames(GROUP), "h264")]
    tracemalloc.start()
    try:
        for number in range(3 * GROUP):
            view.add(messages[number % GROUP], START_NS + number * PERIOD_NS)
        before = tracemalloc.get_traced_memory()[0]
        for number in range(3 * GROUP, 90 * GROUP):
            view.add(messages[number % GROUP], START_NS + number * PERIOD_NS)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    frames = (90 - 3) * GROUP // 100 * 64 * 96 * 3
    assert grown - frames < 40 * (90 - 3) * GROUP


def test_a_torn_packet_freezes_the_picture_up_to_the_next_keyframe_and_no_step_is_shifted(tmp_path: Path) -> None:
    sent = encode(numbered_frames(FRAMES), "h264")
    torn = GROUP + 7
    sent[torn] = Encoded(torn, sent[torn].data[: len(sent[torn].data) // 2], False)
    episode = assembled(write_video(tmp_path / "run.mcap", sent, "h264"), spec_of(VIDEO))
    held = [min(n, torn - 1) if n < 2 * GROUP else n for n in range(FRAMES)]
    assert seen(episode) == held
    assert f"view camera: {2 * GROUP - torn} damaged images passed over" in episode.findings


def test_fewer_steps_than_frames_see_the_latest_frame(tmp_path: Path) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(FRAMES), "h264 with B frames"), "h264")
    episode = assembled(path, spec_of(VIDEO, rate_hz=3.0))
    assert seen(episode) == [int(k * 10 / 3 + 1e-6) for k in range(12)]
    assert len(episode.frames["camera"]) == 12


def test_inspect_tells_size_and_codec(tmp_path: Path) -> None:
    path = write_video(tmp_path / "run.mcap", encode(numbered_frames(6), "vp9"), "vp9")
    (topic,) = (topic for topic in summarise(path).topics if topic.name == VIDEO)
    assert topic.image == "64x96 vp9"
