"""The frames of a video file that belong to given times: decoded in order, matched by time stamp, never by counting.

A frame counts as the one of a time only within TOLERANCE_NS of it. So a video that lacks frames, starts late or runs at another rate
than its table is an error at the first row that has no frame, and never a shift.
"""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from vilp_data import limits
from vilp_data.errors import LogError, copy_again, reason
from vilp_data.types import U8

TOLERANCE_NS = 2_000_000
"""How far a frame's time may lie from its row's: rounding of time stamps stays far below, a quarter of a frame at 120 Hz is above."""

RECOPY = copy_again("video", leave="this episode")
BROKEN = (av.FFmpegError, ValueError, RuntimeError, OSError, EOFError, IndexError)
_THREADS = 1  # ingest has a process on every core


def frames_at(path: Path, times_ns: Sequence[int], *, where: str) -> Iterator[U8]:
    """The frame at each of `times_ns` (rising, on the video's own clock) as uint8 [H,W,3], RGB, top row first.

    Decodes once, from the last key frame before the first time on, and holds one frame at a time. LogError, which names `where`: no
    video there, not readable, damaged, or without a frame at one of the times."""
    if not len(times_ns):
        return
    matched = 0
    for from_start in (False, True):
        for pixels in _matched_frames(path, times_ns, where, from_start=from_start):
            if pixels is None:  # seeking went past the first time: begin at the beginning
                break
            matched += 1
            yield pixels
        else:
            break
    if matched < len(times_ns):
        raise LogError(
            "the video is shorter than its table",
            where=where,
            found=f"no frame at {times_ns[matched] / 1e9:.4f} s, row {matched} of {len(times_ns)}; its last frames are missing",
            remedy=RECOPY,
        )


def _matched_frames(path: Path, times_ns: Sequence[int], where: str, *, from_start: bool) -> Iterator[U8 | None]:
    row, last_ns, reformatter = 0, None, VideoReformatter()
    with _opened(path, where) as container, closing(_decoded(container, times_ns[0], where, from_start)) as frames:
        for time_ns, frame in frames:
            if last_ns is not None and time_ns <= last_ns:
                found = f"{time_ns / 1e9:.4f} s after {last_ns / 1e9:.4f} s"
                raise LogError("the times of the video's frames do not rise", where=where, found=found, remedy=RECOPY)
            if time_ns > times_ns[row] + TOLERANCE_NS:
                if last_ns is None and not from_start:
                    yield None
                    return
                raise _no_frame(where, times_ns, row, last_ns, time_ns)
            last_ns = time_ns
            if time_ns < times_ns[row] - TOLERANCE_NS:
                continue
            if frame.is_corrupt:
                found = f"the frame at {time_ns / 1e9:.4f} s"
                raise LogError("the video is damaged", where=where, found=found, remedy=RECOPY)
            yield _rgb(frame, reformatter, where)
            row += 1
            if row == len(times_ns):
                return


def _decoded(
    container: Any, first_ns: int, where: str, from_start: bool
) -> Generator[tuple[int, av.VideoFrame], None, None]:
    """(time, frame) in order of presentation, from the last key frame before `first_ns` on."""
    stream = _video_stream(container, where)
    base = stream.time_base or Fraction(1, av.time_base)
    try:
        if not from_start and first_ns > TOLERANCE_NS:
            container.seek(int(Fraction(first_ns, 10**9) / base), stream=stream, backward=True)
        for frame in container.decode(stream):
            if frame.pts is None:
                raise LogError("a frame of the video carries no time", where=where, remedy=RECOPY)
            yield round(frame.pts * (frame.time_base or base) * 10**9), frame
    except LogError:
        raise
    except BROKEN as error:
        raise LogError("the video cannot be decoded", where=where, found=reason(error), remedy=RECOPY) from error


def video_sha256(path: Path, start_ns: int, end_ns: int, *, where: str) -> str:
    """SHA-256 of the packets with start_ns <= time < end_ns, their times counted from start_ns: what a video shows then, whatever
    else the file holds. LogError where it cannot be read."""
    digest = hashlib.sha256()
    with _opened(path, where) as container:
        stream = _video_stream(container, where)
        base = stream.time_base or Fraction(1, av.time_base)
        digest.update(stream.codec_context.extradata or b"")
        try:
            if start_ns > TOLERANCE_NS:
                container.seek(int(Fraction(start_ns, 10**9) / base), stream=stream, backward=True)
            for packet in container.demux(stream):
                if packet.pts is None:
                    continue
                time_ns = round(packet.pts * base * 10**9)
                if start_ns - TOLERANCE_NS <= time_ns < end_ns - TOLERANCE_NS:
                    digest.update(f"{(time_ns - start_ns + 500) // 1000} {packet.size};".encode())
                    digest.update(bytes(packet))
                elif packet.dts is not None and round(packet.dts * base * 10**9) >= end_ns:
                    break
        except BROKEN as error:
            raise LogError("the video cannot be read", where=where, found=reason(error), remedy=RECOPY) from error
    return digest.hexdigest()


def _opened(path: Path, where: str) -> Any:
    if not path.is_file():
        remedy = "download it; `vilp-data ingest` takes the other episodes without it"
        raise LogError("the video is missing", where=where, found=f"no file {path}", remedy=remedy)
    try:
        # Local files only, and none that a playlist in the file could name.
        return av.open(str(path), options={"protocol_whitelist": "file"})
    except BROKEN as error:
        raise LogError("the video cannot be opened", where=where, found=reason(error), remedy=RECOPY) from error


def _video_stream(container: Any, where: str) -> Any:
    if not container.streams.video:
        raise LogError("the file holds no video", where=where, found=container.format.name, remedy=RECOPY)
    stream = container.streams.video[0]
    context = stream.codec_context
    if context is None:
        raise LogError("the video's codec is not known", where=where, remedy="encode it as H.264 or AV1")
    limits.check("a frame of the video", "IMAGE_PIXELS", context.width * context.height, where=where)
    context.options = {"err_detect": "explode"}  # else H.264 fills in what it cannot read, and says nothing
    context.thread_count = _THREADS
    return stream


def _rgb(frame: av.VideoFrame, reformatter: VideoReformatter, where: str) -> U8:
    limits.check("a frame of the video", "IMAGE_PIXELS", frame.width * frame.height, where=where)
    try:
        picture = reformatter.reformat(frame, format="rgb24", interpolation="BILINEAR", threads=_THREADS)
        return np.asarray(picture.to_ndarray(), np.uint8)
    except BROKEN as error:
        raise LogError("a frame of the video is no picture", where=where, found=reason(error), remedy=RECOPY) from error


def _no_frame(where: str, times_ns: Sequence[int], row: int, before_ns: int | None, after_ns: int) -> LogError:
    before = "none before" if before_ns is None else f"{before_ns / 1e9:.4f} s"
    return LogError(
        "the video has no frame at the time of a row",
        where=where,
        found=f"row {row} is at {times_ns[row] / 1e9:.4f} s; the nearest frames: {before}, {after_ns / 1e9:.4f} s",
        remedy="frames were lost, or the video runs at another rate or start than its table: encode it again from its images",
    )
