"""Topics of compressed video into RGB frames, each with the message that it came from. Pure: packets in, arrays out.

A packet means little without those before it, so they are fed in order, from a keyframe on. Decoders give frames late and, with B
frames, in another order than they took packets: every packet carries its number as its time stamp, which comes back with its frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vilp_data import limits
from vilp_data.decode.message_body import cannot_decode
from vilp_data.decode.video_packet import Parameters, packet_of, video_codec
from vilp_data.errors import DecodeError
from vilp_data.types import U8, Message

if TYPE_CHECKING:
    import av

Frame: TypeAlias = "av.VideoFrame"
Frames: TypeAlias = "Iterable[tuple[int, av.VideoFrame]]"

_DECODERS = {"h264": "h264", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}
LATE = 24
"""Packets after which one that gave no frame is lost: encoders put at most 16 frames between a packet and the one it is shown after."""

BEFORE_KEYFRAME = "before the first keyframe"
NO_FRAME = "the decoder gave no frame for it"
SMEARED = "made of one that was lost"
_REMEDIES = {BEFORE_KEYFRAME: "begin the demonstration later, or let the camera send keyframes more often"}
_RECORD_AGAIN = "`vilp-data check` names what the log lacks of the camera; leave this log out, or record it again"


class _Fed(NamedTuple):
    """A packet of which it is not known yet whether its picture is whole."""

    number: int
    log_time_ns: int
    keyframe: bool
    referred: bool


class VideoDecoder:
    """Decodes one topic's packets, numbered upwards as they are fed.

        for number, message in enumerate(messages):
            for frame in decoder.feed(number, message): ...
        for frame in decoder.rest(): ...

    Frames come in the order in which they are shown. A packet that gives none (before the first keyframe, damaged, of references that
    are missing, or made of a picture that was lost) joins `lost`, which whoever reads a long log empties as it goes; nothing else
    here grows with the stream. Messages of parameters alone give no frame and are not lost. A packet cut off within a picture shows
    in H.264 and AV1; decoders of H.265 and VP9 fill in what is not there, and the log's own checksums must catch that.

    `parameters`: the stream's, where its first keyframe may not bring them."""

    def __init__(self, parameters: Parameters | None = None) -> None:
        self._context: av.VideoCodecContext | None = None
        self._topic, self._codec = "", ""
        self._first: int | None = None
        self._unsent = dict(parameters or {})
        self._fed: deque[_Fed] = deque()
        self._waiting: set[int] = set()  # of those fed: gave no frame yet
        self._failed: set[int] = set()  # of those fed: never will
        self._broken = False  # a picture that others are made of was lost, since the last keyframe
        self._shown: deque[tuple[int, Frame]] = deque()
        self._smeared: set[int] = set()  # of those shown
        self.lost: dict[int, DecodeError] = {}

    def feed(self, number: int, message: Message) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames that are known to be whole by now, each with the number of its packet."""
        import av

        self._topic = message.topic
        try:
            packet = packet_of(message)
        except DecodeError as error:
            self._fed.append(_Fed(number, message.log_time_ns, keyframe=False, referred=True))
            self._failed.add(number)
            self.lost[number] = error
            return
        if not packet.picture:
            self._unsent |= packet.parameters
            return
        packet = packet.after(self._unsent)
        if self._first is None and not packet.keyframe:
            self._unsent |= packet.parameters
            self.lost[number] = self._loss(message.log_time_ns, BEFORE_KEYFRAME)
            return
        context = self._context_for(message)
        self._unsent = {}
        self._first = number if self._first is None else self._first
        fed = _Fed(number, message.log_time_ns, packet.keyframe, packet.referred)
        self._fed.append(fed)
        self._waiting.add(number)
        sent = av.Packet(packet.data)
        sent.pts = sent.dts = number - self._first
        try:
            self._take(context.decode(sent))
        except av.error.FFmpegError as error:
            self._fail(fed, str(error.strerror))
        yield from self._whole()

    def rest(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames that the decoder still holds; whatever gave none is in `lost`. Afterwards it is as new."""
        import av

        reason = NO_FRAME
        if self._context is not None:
            try:
                self._take(self._context.decode(None))
            except av.error.FFmpegError as error:
                reason = str(error.strerror)
        for fed in self._fed:
            if fed.number in self._waiting:
                self._fail(fed, reason)
        yield from self._whole()
        self._context, self._first, self._broken = None, None, False

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

    def _take(self, frames: list[av.VideoFrame]) -> None:
        for frame in frames:
            number = (self._first or 0) + int(frame.pts or 0)
            if frame.pts is None or number not in self._waiting:
                continue  # a packet shows one picture: of several that it claims, the first
            if frame.is_corrupt:
                fed = next(fed for fed in self._fed if fed.number == number)
                self._fail(fed, "damaged, or of references that are missing")
                continue
            self._waiting.remove(number)
            self._shown.append((number, frame))

    def _whole(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames shown so far whose packets, and all before them, have had their answer: one made of a lost one is lost too, up to
        the next keyframe. What a log lacks altogether cannot be told by this."""
        while self._fed:
            fed = self._fed[0]
            if fed.number in self._waiting:
                if len(self._fed) <= LATE:
                    break
                self._fail(fed, NO_FRAME)
            self._fed.popleft()
            self._broken = self._broken and not fed.keyframe
            if fed.number in self._failed:
                self._failed.remove(fed.number)
                self._broken = self._broken or fed.referred
            elif self._broken:
                self._smeared.add(fed.number)
                self.lost[fed.number] = self._loss(fed.log_time_ns, SMEARED)
        while self._shown and (not self._fed or self._shown[0][0] < self._fed[0].number):
            number, frame = self._shown.popleft()
            if number in self._smeared:
                self._smeared.remove(number)
            else:
                yield number, frame

    def _fail(self, fed: _Fed, reason: str) -> None:
        self._waiting.discard(fed.number)
        self._failed.add(fed.number)
        self.lost[fed.number] = self._loss(fed.log_time_ns, reason)

    def _loss(self, log_time_ns: int, found: str) -> DecodeError:
        where, remedy = f"{self._topic} at {log_time_ns} ns", _REMEDIES.get(found, _RECORD_AGAIN)
        return DecodeError("a video packet without a picture", where=where, found=found, remedy=remedy)


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
