"""Compressed video in a log: the step sees the frame of its own moment, wherever the demonstration begins in the stream."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.synthetic import START_NS
from tests.video_logs import PERIOD_NS, VIDEO, spec_of, write_video
from tests.video_packets import GROUP, Encoded, encode, number_of, numbered_frames
from vilp_data.assemble import assemble_episode
from vilp_data.errors import DecodeError
from vilp_data.log_summary import summarise
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import Episode, LogEpisode

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
    with pytest.raises(DecodeError, match="before the first keyframe"):
        assembled(path, spec_of(VIDEO))


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
