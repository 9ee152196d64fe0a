"""Where a demonstration that begins in the middle of a video's stream has to begin to be read: at a keyframe before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from typing import NamedTuple

from vilp_data.decode.images import COMPRESSED_IMAGES
from vilp_data.decode.video_packet import VIDEO_PACKETS, Packet, Parameters, describes, is_video, packet_of
from vilp_data.errors import DecodeError
from vilp_data.types import LogEpisode, LogReader, Message

FIRST_LOOK_S, LONGEST_LOOK_S = 4.0, 64.0
"""How far back a keyframe is looked for: cameras send one every second or so, some every ten, and some never again."""

OPENING = 100
"""Packets at the beginning of a log, among which its parameters are looked for: some cameras send them once."""


@dataclass(frozen=True)
class VideoStart:
    """What a decoder must have had before a demonstration's own packets: parameters, then packets in order of log time."""

    parameters: Parameters
    packets: Iterable[Message]


class _Keyframe(NamedTuple):
    log_time_ns: int
    closed: bool
    parameters: Parameters


def packets_before(log: LogReader, topic: str, demonstration: LogEpisode) -> VideoStart | None:
    """What comes before the demonstration from which its first frames can be decoded: from the last keyframe on, or, where pictures
    after that may need the one before it (an open group), from that one on; no packets where no keyframe is within
    LONGEST_LOOK_S. None where the demonstration begins with a closed keyframe that says everything, and where the topic is no video."""
    schema = next((info.schema for info in log.topics() if info.name == topic), "")
    if schema not in VIDEO_PACKETS | COMPRESSED_IMAGES:
        return None
    inside = iter(log.messages([topic], start_ns=demonstration.start_ns, end_ns=demonstration.end_ns))
    first = next(inside, None)
    if first is None or not is_video(first):
        return None
    _, opening = next(_Stream().pictures(chain([first], inside)), (None, None))
    if opening is None or (opening.closed and opening.described):
        return None
    wanted = 2 if not opening.keyframe else 0 if opening.closed else 1
    keyframe, parameters = _look_back(log, topic, demonstration.start_ns, wanted)
    if not describes(opening.codec, parameters):
        parameters = {**_first_parameters(log, topic), **parameters}
    if keyframe is None:
        return VideoStart(parameters, ())
    begin_ns = keyframe.log_time_ns
    return VideoStart(parameters, log.messages([topic], start_ns=begin_ns, end_ns=demonstration.start_ns))


def _look_back(log: LogReader, topic: str, end_ns: int, wanted: int) -> tuple[_Keyframe | None, Parameters]:
    """The last closed keyframe before `end_ns`, or the `wanted`-th from the end, whichever is later; none where none is wanted. And the
    parameters in force at it, or else at `end_ns`, as far as they were sent shortly before."""
    found: _Keyframe | None = None
    in_force: Parameters = {}
    look_s = FIRST_LOOK_S
    while end_ns > 0 and look_s <= LONGEST_LOOK_S:
        begin_ns = max(0, end_ns - round(look_s * 1e9))
        stream = _Stream()
        keyframes = [
            _Keyframe(message.log_time_ns, packet.closed, dict(stream.parameters))
            for message, packet in stream.pictures(log.messages([topic], start_ns=begin_ns, end_ns=end_ns))
            if packet.keyframe
        ]
        in_force = in_force or stream.parameters
        while keyframes and wanted:
            found = keyframes.pop()
            wanted = 0 if found.closed else wanted - 1
        if not wanted:
            break
        end_ns, look_s = begin_ns, 2 * look_s
    return found, found.parameters if found else in_force


def _first_parameters(log: LogReader, topic: str) -> Parameters:
    stream = _Stream()
    for _ in stream.pictures(islice(log.messages([topic]), OPENING)):
        pass
    return stream.parameters


class _Stream:
    """Reads packets in order: each picture after the parameters that came by themselves before it; `parameters`: those in force."""

    def __init__(self) -> None:
        self.parameters: dict[int, bytes] = {}
        self._alone: dict[int, bytes] = {}

    def pictures(self, messages: Iterable[Message]) -> Iterator[tuple[Message, Packet]]:
        for message in messages:
            try:
                packet = packet_of(message)
            except DecodeError:
                continue
            self.parameters |= packet.parameters
            if packet.picture:
                yield message, packet.after(self._alone)
                self._alone = {}
            else:
                self._alone |= packet.parameters
