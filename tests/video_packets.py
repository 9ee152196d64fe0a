"""Small videos whose frames say their own number, encoded into the packets that a log holds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

from vilp_data.types import U8, Message

HEIGHT, WIDTH, BITS, BLOCK = 64, 96, 8, 10
GROUP = 12  # frames from one keyframe to the next

ENCODERS = {
    "h264": ("libx264", {"preset": "veryfast", "bf": "0", "threads": "1", "sc_threshold": "0"}),
    "h264 with B frames": ("libx264", {"preset": "veryfast", "bf": "3", "threads": "1", "sc_threshold": "0"}),
    "h265": ("libx265", {"preset": "ultrafast", "x265-params": "bframes=0:open-gop=0"}),
    "h265 with B frames": ("libx265", {"preset": "ultrafast", "x265-params": "bframes=3"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8"}),
    "vp9 with hidden frames": ("libvpx-vp9", {"cpu-used": "5", "lag-in-frames": "16", "auto-alt-ref": "1"}),
    "av1": ("libsvtav1", {"preset": "12"}),
}
X265 = f":keyint={GROUP}:min-keyint={GROUP}:scenecut=0:pools=none:frame-threads=1:log-level=none"


@dataclass(frozen=True)
class Encoded:
    """A packet: which frame it shows, its bytes, and whether the encoder calls it a keyframe."""

    shows: int
    data: bytes
    keyframe: bool


def numbered_frames(count: int) -> list[U8]:
    """Grey frames, each with its number in BITS black or white blocks, least significant first."""
    frames = []
    for number in range(count):
        frame = np.full((HEIGHT, WIDTH, 3), 110, np.uint8)
        for bit in range(BITS):
            frame[16:40, 8 + bit * BLOCK : 8 + (bit + 1) * BLOCK] = 235 if number >> bit & 1 else 20
        frames.append(frame)
    return frames


def number_of(frame: U8) -> int:
    """What `numbered_frames` wrote into a frame of any size."""
    height, width = frame.shape[0] / HEIGHT, frame.shape[1] / WIDTH
    rows = slice(round(20 * height), round(36 * height))
    blocks = [slice(round((10 + b * BLOCK) * width), round((16 + b * BLOCK) * width)) for b in range(BITS)]
    return sum(1 << bit for bit, columns in enumerate(blocks) if frame[rows, columns].mean() > 127)


def encode(
    frames: Sequence[U8],
    name: str,
    *,
    matrix: Colorspace | None = None,
    full_range: bool = False,
    quality: dict[str, str] | None = None,
) -> list[Encoded]:
    """The packets of a video, one a message, in the order that the encoder gives them. `matrix` None: its colours are not described."""
    encoder, options = ENCODERS[name]
    options = {"g": str(GROUP)} | options | (quality or {})
    if encoder == "libx265":
        options["x265-params"] += X265
    context = av.CodecContext.create(encoder, "w")
    context.height, context.width, context.pix_fmt = *frames[0].shape[:2], "yuv420p"
    context.time_base, context.framerate, context.options = Fraction(1, 30), Fraction(30), options
    colour_range = ColorRange.JPEG if full_range else ColorRange.MPEG
    if matrix is not None:
        context.colorspace, context.color_range = matrix.value, colour_range.value
    packets = []
    for number, frame in enumerate([*frames, None]):
        picture = None
        if frame is not None:
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(
                format="yuv420p",
                dst_colorspace=matrix or Colorspace.ITU601,
                src_color_range=ColorRange.JPEG,
                dst_color_range=colour_range,
            )
            picture.pts, picture.time_base = number, Fraction(1, 30)
        packets += [Encoded(int(p.pts), bytes(p), bool(p.is_keyframe)) for p in context.encode(picture)]
    return packets


def parted(data: bytes, units: Iterable[bytes]) -> tuple[bytes, bytes]:
    """These units of a packet of H.264 or H.265, and the packet without them."""
    rest = data
    for unit in units:
        assert unit in rest
        rest = rest.replace(unit, b"", 1)
    start = rest.find(b"\0\0\1")
    return b"".join(units), b"\0" + rest[start:]


def video_message(data: bytes, name: str, *, number: int = 0, topic: str = "/video") -> Message:
    """A foxglove.CompressedVideo message that holds a packet."""
    body = CompressedVideo(data=data, format=name.partition(" ")[0], frame_id="camera")
    time_ns = 10**9 + number * 10**8
    body.timestamp.FromNanoseconds(time_ns)
    return Message(topic, "foxglove.CompressedVideo", time_ns, time_ns, body)
