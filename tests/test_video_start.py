"""A demonstration may begin at any packet of a stream: what is read before it is enough for every one of its pictures."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import pytest

from tests.video_logs import spec_of
from tests.video_packets import ENCODERS, GROUP, Encoded, encode, number_of, numbered_frames, parted, video_message
from vilp_data.decode.video_packet import packet_of
from vilp_data.types import LogEpisode, LogReader, Message, TopicInfo
from vilp_data.video_start import packets_before
from vilp_data.view_frames import Ticks, ViewFrames

VIDEO, PERIOD_NS = "/video", 10**8
FRAMES, LENGTH = 3 * GROUP, 8  # of a stream, and of the demonstrations cut from it


class Sent(NamedTuple):
    """A message of the stream, and the number of the frame that it shows; None of parameters by themselves."""

    message: Message
    shows: int | None


class StreamLog:
    """A log of these messages and nothing else."""

    def __init__(self, stream: Sequence[Sent]) -> None:
        self._messages = [sent.message for sent in stream]

    def topics(self) -> list[TopicInfo]:
        return [TopicInfo(VIDEO, self._messages[0].schema, "protobuf", len(self._messages))]

    def messages(
        self, _: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        first, end = start_ns or 0, 1 << 63 if end_ns is None else end_ns
        return (message for message in self._messages if first <= message.log_time_ns < end)


def stream_of(video: Sequence[Encoded], name: str, parameters: str) -> list[Sent]:
    """A video's messages. Its parameters come within its keyframes' packets ("within"), in messages of their own before each keyframe
    ("before each"), or in one before the first ("once")."""
    stream: list[Sent] = []

    def send(data: bytes, shows: int | None) -> None:
        stream.append(Sent(video_message(data, name, number=len(stream), topic=VIDEO), shows))

    for number, encoded in enumerate(video):
        data = encoded.data
        brought = packet_of(video_message(data, name)).parameters.values()
        if brought and parameters != "within":
            alone, data = parted(data, brought)
            if parameters == "before each" or number == 0:
                send(alone, None)
        send(data, encoded.shows)
    return stream


def seen(stream: Sequence[Sent], first: int, end: int) -> tuple[list[int], int]:
    """The frames that a demonstration of the messages first <= i < end sees at its pictures' own moments, and how many were lost."""
    cut = LogEpisode("cut", stream[first].message.log_time_ns, stream[end - 1].message.log_time_ns + 1)
    view = ViewFrames("camera", spec_of(VIDEO).views["camera"], Ticks(None, 1))
    view.warm_up(packets_before(cast("LogReader", StreamLog(stream)), VIDEO, cut))
    for message, shows in stream[first:end]:
        view.add(message, (shows or 0) * PERIOD_NS)
    of_view = view.observe(np.sort(view.stamps_ns))
    return [number_of(of_view.frames[row]) for row in of_view.source_index], of_view.damaged


def assert_each_cut_sees_its_own(stream: Sequence[Sent], *, since: int = 0) -> None:
    """Of those that begin with the message `since` or a later one."""
    for first in range(since, len(stream) - 2):
        end = min(first + LENGTH, len(stream))
        expected = sorted(shows for _, shows in stream[first:end] if shows is not None)
        assert seen(stream, first, end) == (expected, 0), first


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        (name, parameters)
        for name in ENCODERS
        for parameters in ("within", "before each", "once")
        if name.startswith("h26") or parameters == "within"
    ],
)
def test_a_demonstration_may_begin_at_any_packet_and_loses_no_picture(name: str, parameters: str) -> None:
    assert_each_cut_sees_its_own(stream_of(encode(numbered_frames(FRAMES), name), name, parameters))


def test_a_demonstration_is_decoded_with_the_parameters_of_its_own_part_of_the_stream() -> None:
    """As a camera that was set anew leaves it. The parameters at the beginning of the log describe none of the second part."""
    frames, half = numbered_frames(FRAMES), 2 * GROUP
    later = encode(frames[half:], "h264", quality={"preset": "ultrafast"})
    video = [*encode(frames[:half], "h264"), *(replace(packet, shows=packet.shows + half) for packet in later)]
    assert_each_cut_sees_its_own(stream_of(video, "h264", "before each"))


def test_an_open_keyframe_is_known_by_the_parameters_sent_before_it() -> None:
    """Where no remark says that decoding may begin there, and no closed one comes before: this log begins with the second group."""
    sent = encode(numbered_frames(FRAMES), "h264 with B frames", quality={"x264-params": "open-gop=1"})
    video = [replace(packet, data=without_remarks(packet.data)) for packet in sent]
    stream = stream_of(video, "h264", "before each")
    _, second, third = (number for number, message in enumerate(stream) if message.shows is None)
    assert_each_cut_sees_its_own(stream[second:], since=third - second)


def without_remarks(data: bytes) -> bytes:
    """A packet of H.264 without its units of kind 6."""
    before, *units = data.split(b"\0\0\1")
    return b"\0\0\1".join([before, *(unit for unit in units if unit[0] & 31 != 6)])
