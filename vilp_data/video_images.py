"""A view's packets of compressed video -> its images, in the order in which they are shown, each by the number of its message."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

from vilp_data.decode.video import Frame, RgbReader, VideoDecoder
from vilp_data.errors import AlignError, DecodeError, SpecError
from vilp_data.spec import ViewSpec
from vilp_data.types import U8, Message
from vilp_data.video_start import VideoStart


class VideoImages:
    """`feed` each of a demonstration's messages; then `end`. `stamps_ns` are those of its images so far, by the view's clock: whoever
    feeds one has counted it there. Images that a decoder gives late come with a later message."""

    def __init__(self, view: ViewSpec, stamps_ns: Sequence[int], start: VideoStart) -> None:
        """Takes in what comes before the demonstration. Raises SpecError where the view's table is not of pictures."""
        if view.depth is not None or view.levels is not None:
            table = "depth" if view.depth is not None else "levels"
            remedy = f"take `{table}` out of the view's table, or name a topic of single images"
            raise SpecError(
                f"compressed video is not read with `{table}`",
                where=view.topic,
                found="packets of video",
                remedy=remedy,
            )
        self._view, self._stamps, self._decoder = view, stamps_ns, VideoDecoder(start.parameters)
        self._rgb: RgbReader | None = None
        self._before = 0  # packets fed of before the demonstration
        for message in start.packets:
            for _ in self._decoder.feed(self._before, message):
                pass
            self._before += 1
        self._decoder.lost.clear()
        self._shown = -1
        self._reordered = self._fell_back = 0

    def feed(self, message: Message) -> Iterator[tuple[int, Callable[[], U8]]]:
        """(number, what gives it as uint8 [H,W,3]) of each image that is known to be whole by now."""
        yield from self._numbered(self._decoder.feed(self._before + len(self._stamps) - 1, message))

    def end(self) -> Iterator[tuple[int, Callable[[], U8]]]:
        """The images that are left. Raises AlignError where the stamps were not in the order in which the pictures are shown."""
        yield from self._numbered(self._decoder.rest())
        if self._fell_back > self._reordered / 2:
            found = f'clock = "{self._view.clock}", {self._fell_back} pictures stamped before the one that is shown before them'
            remedy = "this clock tells when packets were sent, and B frames are sent after later pictures: " + (
                "record without B frames"
                if self._view.clock == "header"
                else 'set clock = "header" for this topic, or record without B frames'
            )
            raise AlignError(
                "the video's pictures are not in the order of their stamps",
                where=self._view.topic,
                found=found,
                remedy=remedy,
            )

    def losses(self) -> Iterator[tuple[int, DecodeError]]:
        """(number, why) of the images that are known to be lost since this was asked last."""
        lost, self._decoder.lost = self._decoder.lost, {}
        for number, error in lost.items():
            if number >= self._before:
                yield number - self._before, error

    def _numbered(self, frames: Iterable[tuple[int, Frame]]) -> Iterator[tuple[int, Callable[[], U8]]]:
        for shown, frame in frames:
            number = shown - self._before
            if number < 0:
                continue
            if number < self._shown:  # B frames; without them, stamps that fall back are a clock's jitter
                self._reordered += 1
                self._fell_back += self._stamps[number] < self._stamps[self._shown]
            self._shown = number
            yield number, partial(self._as_rgb, frame)

    def _as_rgb(self, frame: Frame) -> U8:
        self._rgb = self._rgb or RgbReader()
        return self._rgb.rgb(frame)
