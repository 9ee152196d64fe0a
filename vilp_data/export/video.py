"""Frames to H.264 and back: several episodes in one file, frame k at exactly k / fps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from vilp_data.errors import UsageError
from vilp_data.export.compare import came_out_wrong
from vilp_data.types import U8

KEY_EVERY = 10
"""Frames between key frames: whoever asks for one frame decodes at most so many."""

BT601 = 6
"""SMPTE 170M in the numbers of H.264: what decoders assume of small pictures that say nothing, written down all the same."""

LIMITED = 1


@dataclass(frozen=True)
class Coding:
    """How frames become H.264. `crf` None: without loss."""

    encoder: str
    pixels: str
    crf: int | None

    @property
    def options(self) -> dict[str, str]:
        """No B-frames, so that frames lie in the file in the order of their times; closed groups, so that each can be decoded alone."""
        gop = {"g": str(KEY_EVERY), "bf": "0", "forced-idr": "1", "preset": "medium"}
        return gop | ({"qp": "0"} if self.crf is None else {"crf": str(self.crf)})

    def __str__(self) -> str:
        return f"H.264, {self.pixels}, {'lossless' if self.crf is None else f'CRF {self.crf}'}"


CODINGS = {
    "h264": Coding("libx264", "yuv444p", 18),
    "h264-420": Coding("libx264", "yuv420p", 18),
    "lossless": Coding("libx264rgb", "rgb24", None),
}


def frame_rate(rate_hz: float) -> Fraction:
    """The rate as a fraction, such as 30000/1001: the nearest with a small denominator that is within a millionth."""
    for limit in (1, 1001, 100_000):
        rate = Fraction(rate_hz).limit_denominator(limit)
        if rate and abs(float(rate) / rate_hz - 1) < 1e-6:
            return rate
    raise UsageError(
        "a rate that no video has", found=f"{rate_hz} Hz", remedy="state rate_hz in the task TOML, and ingest again"
    )


class VideoWriter:
    """One MP4 file. `append` adds an episode, which begins with a key frame; `close` ends the file."""

    def __init__(self, path: Path, *, height: int, width: int, fps: Fraction, coding: Coding) -> None:
        if coding.pixels == "yuv420p" and (height % 2 or width % 2):
            found = f"{width} x {height}"
            raise UsageError("4:2:0 needs an even width and height", found=found, remedy="--images h264 keeps any size")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self._coding, self._fps = path, coding, fps
        self.n_frames, self.n_bytes = 0, 0  # bytes: without what the encoder still holds back
        self._container: Any = av.open(str(path), "w", format="mp4")
        stream: Any = self._container.add_stream(coding.encoder, rate=fps, options=coding.options)
        self._stream, context = stream, stream.codec_context
        stream.width, stream.height, stream.pix_fmt = width, height, coding.pixels
        context.time_base, context.thread_count = 1 / fps, 1  # one thread: the same bytes on every machine
        if coding.pixels != "rgb24":
            context.color_range, context.colorspace, context.color_primaries, context.color_trc = (
                LIMITED,
                BT601,
                BT601,
                BT601,
            )

    def append(self, images: Iterable[U8]) -> None:
        """Add the frames of one episode, uint8 [H,W,3] each, or [H,W,1] as grey."""
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(rgb(image), format="rgb24")
            if self._coding.pixels != "rgb24":
                frame = frame.reformat(
                    format=self._coding.pixels, dst_colorspace=Colorspace.ITU601, dst_color_range=ColorRange.MPEG
                )
            frame.pts, frame.time_base = self.n_frames, 1 / self._fps
            if number == 0:
                frame.pict_type = av.video.frame.PictureType.I
            packets = self._stream.encode(frame)
            self._container.mux(packets)
            self.n_frames += 1
            self.n_bytes += sum(packet.size for packet in packets)

    def close(self) -> None:
        if self._container is not None:
            self._container.mux(self._stream.encode())
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._container is not None:
            self._container.close()
            self._container = None


def rgb(image: U8) -> U8:
    """uint8 [H,W,3]: a picture of one channel repeated."""
    return np.ascontiguousarray(image if image.shape[-1] == 3 else np.repeat(image, 3, axis=-1))


def read_video(path: Path, fps: Fraction) -> Iterator[U8]:
    """Every frame of a file in order, uint8 [H,W,3]. StoreError where frame k is not at exactly k / fps."""
    with av.open(str(path)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            time_s = None if frame.pts is None or frame.time_base is None else frame.pts * frame.time_base
            if time_s != number / fps:
                found = f"frame {number} at {time_s} s instead of {number / fps} s"
                raise came_out_wrong("a video that came out with other times", path, found=found)
            yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
