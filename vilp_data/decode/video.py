"""Topics of compressed video into RGB frames, each with the message that it came from. Pure: packets in, arrays out.

A packet means little without those before it, so they are fed in order, from a keyframe on. Decoders give frames late and, with B
frames, in another order than they took packets: every packet carries its number as its time stamp, which comes back with its frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vilp_data import limits
from vilp_data.decode.images import COMPRESSED_IMAGES, payload
from vilp_data.decode.message_body import cannot_decode, member
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message

if TYPE_CHECKING:
    import av

Frame: TypeAlias = "av.VideoFrame"
Frames: TypeAlias = "Iterable[tuple[int, av.VideoFrame]]"

VIDEO_PACKETS = frozenset(
    {
        "foxglove.CompressedVideo",
        "foxglove::CompressedVideo",
        "foxglove_msgs/msg/CompressedVideo",
        "foxglove_msgs/CompressedVideo",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "ffmpeg_image_transport_msgs/FFMPEGPacket",
    }
)
# What formats are called, by what their names begin with (an encoder's name stands for what it writes).
_NAMES = {
    "h264": ("h264", "avc", "libx264", "x264", "libopenh264"),
    "hevc": ("h265", "hevc", "libx265", "x265"),
    "vp9": ("vp9", "libvpx-vp9"),
    "av1": ("av1", "libaom", "libsvtav1", "librav1e"),
}
_DECODERS = {"h264": "h264", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}
BEFORE_KEYFRAME = "before the first keyframe"


@dataclass(frozen=True)
class Packet:
    """What a packet says by itself. `keyframe`: decoding may begin with it; `closed`: and nothing after it needs what came before;
    `referred`: pictures after it may need it."""

    data: bytes
    keyframe: bool
    closed: bool
    referred: bool = True


def is_video(message: Message) -> bool:
    """Whether a message is one packet of compressed video, as far as its schema or, for a compressed image, its format says."""
    return message.schema in VIDEO_PACKETS or (message.schema in COMPRESSED_IMAGES and _codec(message) is not None)


def video_codec(message: Message) -> str:
    """`h264`, `hevc`, `vp9` or `av1`. DecodeError for another format."""
    codec = _codec(message)
    if codec is None:
        found, remedy = repr(_format(message)), "record H.264 or H.265 (Annex B), VP9 or AV1"
        raise cannot_decode(message, "compressed video in a format that is not read", found, remedy)
    return codec


def packet_of(message: Message) -> Packet:
    """The packet in a message. DecodeError where it is none of its format."""
    codec, data = video_codec(message), payload(message).tobytes()
    if codec in ("h264", "hevc"):
        if not data.startswith((b"\0\0\1", b"\0\0\0\1")):
            remedy = "record Annex B packets (start codes, not lengths, before each unit)"
            raise cannot_decode(
                message, f"not a packet of {codec} in Annex B", f"begins with {data[:8].hex(' ')}", remedy
            )
        return _packet_of_units(codec, data)
    keyframe = _vp9_keyframe(data) if codec == "vp9" else _av1_sequence(data)
    return Packet(data, keyframe, keyframe)


class VideoDecoder:
    """Decodes one topic's packets, numbered as they are fed.

        for number, message in enumerate(messages):
            for frame in decoder.feed(number, message): ...
        for frame in decoder.rest(): ...

    A packet that gives no frame (before the first keyframe, damaged, or of references that are missing) is named by `lost`. A packet
    cut off within a picture shows in H.264 and AV1; decoders of H.265 and VP9 fill in what is not there, and the log's own checksums
    must catch that."""

    def __init__(self) -> None:
        self._context: av.VideoCodecContext | None = None
        self._codec = ""
        self._first: int | None = None
        self._waiting: dict[int, str] = {}
        self._keys: list[int] = []
        self._fed: list[tuple[int, bool]] = []  # number, referred
        self.lost: dict[int, DecodeError] = {}

    def feed(self, number: int, message: Message) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames that this packet completes, each with the number of its packet."""
        import av

        try:
            packet = packet_of(message)
        except DecodeError as error:
            self.lost[number] = error
            self._fed.append((number, True))
            return
        place = f"{message.topic} at {message.log_time_ns} ns"
        if packet.keyframe:
            self._keys.append(number)
        if not self._keys:
            self.lost[number] = _lost(place, BEFORE_KEYFRAME)
            return
        context = self._context_for(message)
        self._fed.append((number, packet.referred))
        self._first = number if self._first is None else self._first
        sent = av.Packet(packet.data)
        sent.pts = sent.dts = number - self._first
        self._waiting[number] = place
        try:
            yield from self._whole(context.decode(sent))
        except av.error.FFmpegError as error:
            self._waiting.pop(number, None)
            self.lost[number] = _lost(place, str(error.strerror))

    def rest(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames that the decoder still holds; afterwards it is as new, and whatever gave no frame is in `lost`."""
        import av

        if self._context is not None:
            try:
                yield from self._whole(self._context.decode(None))
            except av.error.FFmpegError as error:
                reason = str(error.strerror)
            else:
                reason = "the decoder gave no frame for it"
            self.lost |= {number: _lost(place, reason) for number, place in self._waiting.items()}
        self._context, self._waiting = None, {}

    def smeared(self) -> list[int]:
        """The packets whose pictures are made of one that was lost: those after it, up to the next keyframe. They join `lost`.

        What a log lacks altogether cannot be told by this."""
        keys, broken, found = set(self._keys), False, []
        for number, referred in self._fed:
            broken = broken and number not in keys
            if number in self.lost:
                broken = broken or referred
            elif broken:
                self.lost[number] = _lost(f"packet {number}", "made of one that was lost")
                found.append(number)
        return found

    def _context_for(self, message: Message) -> av.VideoCodecContext:
        import av

        codec = video_codec(message)
        if self._context is None:
            context = av.CodecContext.create(_DECODERS[codec], "r")
            assert isinstance(context, av.VideoCodecContext)
            context.thread_count = 1  # demonstrations are spread over processes
            context.options = {"max_pixels": str(limits.IMAGE_PIXELS)}
            self._codec, self._context = codec, context
        elif codec != self._codec:
            found, remedy = f"{self._codec}, then {codec}", "cut the log where the camera was changed"
            raise cannot_decode(message, "the video's format changes within the topic", found, remedy)
        return self._context

    def _whole(self, frames: list[av.VideoFrame]) -> Iterator[tuple[int, av.VideoFrame]]:
        for frame in frames:
            number = (self._first or 0) + int(frame.pts or 0)
            place = self._waiting.pop(number, None)
            if place is None or frame.pts is None:
                continue  # a packet shows one picture: of several that it claims, the first
            if frame.is_corrupt:
                self.lost[number] = _lost(place, "damaged, or of references that are missing")
                continue
            yield number, frame


class RgbReader:
    """Turns decoded frames of one stream into RGB, by the matrix and range that the stream states for itself. Where it states none:
    BT.601 of limited range, as ffmpeg and OpenCV take it."""

    def __init__(self) -> None:
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()

    def rgb(self, frame: av.VideoFrame) -> U8:
        """uint8 [H,W,3], top row first."""
        picture = self._reformatter.reformat(frame, format="rgb24", interpolation="BILINEAR", threads=1)
        return np.asarray(picture.to_ndarray(), np.uint8)


def _lost(place: str, found: str) -> DecodeError:
    return DecodeError("a video packet without a picture", where=place, found=found, remedy="it is passed over")


def _codec(message: Message) -> str | None:
    said = _format(message).partition(";")[0].strip().lower()
    return next((codec for codec, names in _NAMES.items() if said.startswith(names)), None)


def _format(message: Message) -> str:
    return str(member(message.body, "format", "") or member(message.body, "encoding", ""))


# --- what a packet says by itself ------------------------------------------------------------------------------------------


def _packet_of_units(codec: str, data: bytes) -> Packet:
    """H.264: an instantaneous refresh (5) is a closed keyframe; a sequence's parameters (7) before another picture let decoding begin
    at one that is not. H.265: random access pictures are keyframes, of which CRA (21) is open. Pictures that no other needs are
    those of reference number 0 in H.264; in H.265 those that are skipped after an open keyframe (8, 9), and even types below 16."""
    heads = list(_unit_heads(codec, data))
    if codec == "h264":
        kinds = {head & 0x1F for head in heads}
        return Packet(data, bool(kinds & {5, 7}), 5 in kinds, bool(heads and heads[-1] >> 5 & 3))
    kinds = {head >> 1 & 0x3F for head in heads}
    last = heads[-1] >> 1 & 0x3F if heads else 0
    referred = last not in (8, 9) and (last > 15 or last % 2 == 1)
    return Packet(data, any(16 <= kind <= 23 for kind in kinds), any(16 <= kind <= 20 for kind in kinds), referred)


def _unit_heads(codec: str, data: bytes) -> Iterator[int]:
    """The first byte of each NAL unit of a packet, up to its first slice."""
    place = data.find(b"\0\0\1")
    while 0 <= place < len(data) - 3:
        head = data[place + 3]
        yield head
        if 1 <= head & 0x1F <= 5 if codec == "h264" else head >> 1 & 0x3F < 32:
            return
        place = data.find(b"\0\0\1", place + 3)


def _vp9_keyframe(data: bytes) -> bool:
    """The uncompressed header's first bits: marker (2), profile (2, and a reserved one for 3), show existing, frame type (0: key)."""
    if not data or data[0] >> 6 != 2:
        return False
    bits = data[0] << 2 & 0xFF  # past the marker
    profile_3 = bits >> 6 == 3
    at = 5 if profile_3 else 4
    show_existing, kind = data[0] >> (7 - at) & 1, data[0] >> (6 - at) & 1
    return not show_existing and not kind


def _av1_sequence(data: bytes) -> bool:
    """Whether one of the open bitstream units is a sequence header, which every keyframe brings."""
    place = 0
    while place < len(data):
        kind, extended, sized = data[place] >> 3 & 0xF, data[place] >> 2 & 1, data[place] >> 1 & 1
        if kind == 1:
            return True
        place += 1 + extended
        if not sized:
            return False
        size = shift = 0
        while place < len(data) and shift < 56:
            size |= (data[place] & 0x7F) << shift
            place, shift = place + 1, shift + 7
            if not data[place - 1] & 0x80:
                break
        place += size
    return False
