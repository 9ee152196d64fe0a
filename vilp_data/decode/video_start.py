"""Where a demonstration that begins in the middle of a video's stream has to begin to be read: at a keyframe before it."""

from __future__ import annotations

from vilp_data.decode.images import COMPRESSED_IMAGES
from vilp_data.decode.video import VIDEO_PACKETS, Packet, is_video, packet_of
from vilp_data.errors import DecodeError
from vilp_data.types import LogEpisode, LogReader, Message

FIRST_LOOK_S, LONGEST_LOOK_S = 4.0, 64.0
"""How far back a keyframe is looked for: cameras send one every second or so, some every ten, and some never again."""


def packets_before(log: LogReader, topic: str, demonstration: LogEpisode) -> list[Message]:
    """The topic's packets before the demonstration from which its first frames can be decoded: from the last keyframe on, or, where
    pictures after that may need the one before it (an open group), from that one on. Empty where the demonstration begins with
    a keyframe, where the topic is no video, and where no keyframe is within LONGEST_LOOK_S."""
    schema = next((info.schema for info in log.topics() if info.name == topic), "")
    if schema not in VIDEO_PACKETS | COMPRESSED_IMAGES:
        return []
    first = next(iter(log.messages([topic], start_ns=demonstration.start_ns, end_ns=demonstration.end_ns)), None)
    if first is None or not is_video(first) or ((packet := _packet(first)) is not None and packet.closed):
        return []
    wanted = 1 if packet is not None and packet.keyframe else 2
    found: list[Message] = []
    end_ns, look_s = demonstration.start_ns, FIRST_LOOK_S
    while end_ns > 0 and look_s <= LONGEST_LOOK_S:
        begin_ns = max(0, end_ns - round(look_s * 1e9))
        found = [*log.messages([topic], start_ns=begin_ns, end_ns=end_ns), *found]
        begin = _begin(found, wanted)
        if begin is not None:
            return found[begin:]
        end_ns, look_s = begin_ns, 2 * look_s
    begin = _begin(found, 1)
    return [] if begin is None else found[begin:]


def _begin(messages: list[Message], keyframes: int) -> int | None:
    """The last closed keyframe, or the `keyframes`-th from the end, whichever is later."""
    for place in range(len(messages) - 1, -1, -1):
        packet = _packet(messages[place])
        if packet is not None and packet.keyframe:
            keyframes -= 1
            if packet.closed or keyframes == 0:
                return place
    return None


def _packet(message: Message) -> Packet | None:
    try:
        return packet_of(message)
    except DecodeError:
        return None
