"""Frames as an MP4 that every player shows in the right colours: H.264, 4:2:0, BT.709, limited range, tagged as such."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from vilp_data.errors import UsageError
from vilp_data.shards import atomic_file
from vilp_data.types import U8

CRF = "16"
"""x264's constant rate factor: the eye sees no difference, and a 96x96 episode of 30 s is well under 1 MB."""


def write_mp4(path: Path, frames: Iterable[U8], *, fps: float, scale: int = 1) -> None:
    """Write RGB frames, uint8 [H,W,3] each, to `path`, whole or not at all, each pixel enlarged to scale x scale. They are taken one by
    one: a generator of them may be longer than the memory.

    H.264 at 4:2:0 needs even sides: an odd one is filled up with its last row or column. Raises UsageError where there is no
    frame, StoreError where the file cannot be written."""
    rest = iter(frames)
    start = next(rest, None)
    if start is None:
        raise UsageError("no frames to make a video of", where=path)
    with atomic_file(path) as file, av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options={"crf": CRF})
        first = enlarged(start, scale)
        stream.height, stream.width, stream.pix_fmt = *first.shape[:2], "yuv420p"
        # Without tags a player guesses the matrix from the size, and small videos turn out a little too green.
        stream.codec_context.colorspace = Colorspace.ITU709.value
        stream.codec_context.color_primaries = ColorPrimaries.BT709.value
        stream.codec_context.color_trc = ColorTrc.BT709.value
        stream.codec_context.color_range = ColorRange.MPEG.value
        for frame in chain([start], rest):
            container.mux(stream.encode(_yuv(enlarged(frame, scale))))
        container.mux(stream.encode())


def enlarged(frame: U8, scale: int) -> U8:
    """uint8 [H,W,3] with every pixel repeated scale x scale times, then sides made even by repeating the last row or column."""
    large = frame.repeat(scale, axis=0).repeat(scale, axis=1)
    odd = [(0, side % 2) for side in large.shape[:2]]
    return np.pad(large, (*odd, (0, 0)), mode="edge") if any(n for _, n in odd) else large


def _yuv(frame: U8) -> av.VideoFrame:
    """4:2:0 in BT.709, from RGB of full range."""
    image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
    return image.reformat(
        format="yuv420p",
        dst_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
    )
