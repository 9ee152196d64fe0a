"""A view's images as a log gives them -> the frames that steps see, each once, decoded and at their stored size.

Which images steps see is known for sure only at the end, when every stamp is. Waiting for that would hold an hour of images in
memory, and decoding all of them would waste most of a fast camera's. So an image is decoded when the next one has come, if a step may
fall between the two. `Ticks` guesses the steps from the first stamps; where the guess turns out wrong, the log is read once more.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from vilp_data import align, geometry
from vilp_data.decode import depth as decode_depth
from vilp_data.decode import video as decode_video
from vilp_data.decode.images import decode_image
from vilp_data.errors import DecodeError, SpecError, UsageError
from vilp_data.frame_spool import FrameSpool
from vilp_data.spec import ViewSpec
from vilp_data.types import F32, I32, I64, U8, Bool, Message

DAMAGED_SHARE = 0.5
"""More damaged images than this among those that steps use, and the episode is refused: that is no glitch."""

HOPELESS = 20
"""So many damaged images before the first whole one end the reading: the topic holds something else."""

PASSED_BY = 4
"""Images that no step asked for are kept, so many, until a later one is known to be whole."""


@dataclass
class Ticks:
    """When steps may be, as far as it is known while a log is read: at `rate_hz` from the moment that every view has an image.

    `rate_hz` None: anywhere. `start_ns` given: it was known before."""

    rate_hz: float | None
    views: int
    start_ns: int | None = None
    first_ns: dict[str, int] = field(default_factory=dict)

    def saw(self, view: str, stamp_ns: int) -> None:
        if view not in self.first_ns:
            self.first_ns[view] = stamp_ns
            if self.start_ns is None and len(self.first_ns) == self.views:
                self.start_ns = max(self.first_ns.values())

    def may_fall_in(self, begin_ns: int, end_ns: int) -> bool:
        """Whether a step may see an image that is the latest from `begin_ns` until `end_ns`. In doubt it may."""
        if self.rate_hz is None or self.start_ns is None:
            return True
        begin_ns, end_ns = begin_ns - align.TOLERANCE_NS, end_ns - align.TOLERANCE_NS
        near = int((begin_ns - self.start_ns) * self.rate_hz / 1e9)
        for number in range(max(0, near - 1), max(0, near + 2) + 1):  # the first at or after `begin_ns` is among these
            tick_ns = self.start_ns + round(number * (1e9 / self.rate_hz))
            if tick_ns >= begin_ns:
                return tick_ns < end_ns
        return True


@dataclass(frozen=True)
class Seen:
    """A view's images that steps see, each once, uint8 [n,H,W,C]; which of them each step sees, int32 [F]; where it may be used
    and its age, bool and float32 [F]; how many images were damaged and passed over, and of those how many video packets before
    the first keyframe."""

    frames: U8
    source_index: I32
    valid: Bool
    age_s: F32
    damaged: int
    before_keyframe: int = 0


@dataclass(frozen=True)
class _Arrived:
    """An image that is there and not decoded yet. `number`: as its message came."""

    number: int
    stamp_ns: int
    decode: Callable[[], U8]


class ViewFrames:
    """Collects one view. `add` each of its messages with its stamp, in the log's order; then `observe`."""

    def __init__(self, view: str, spec: ViewSpec, ticks: Ticks, *, scratch: Path | None = None) -> None:
        self.view, self.spec, self.ticks = view, spec, ticks
        self._stamps = array("q")
        self._spool, self._rows = FrameSpool(scratch), dict[int, int]()
        self._damaged: dict[int, DecodeError] = {}
        self._latest: _Arrived | None = None
        self._passed_by: deque[_Arrived] = deque(maxlen=PASSED_BY)
        self._video: bool | None = None  # told by the first message: asking each would cost as much as reading it
        self._decoder: decode_video.VideoDecoder | None = None
        self._rgb: decode_video.RgbReader | None = None

    def warm_up(self, packets: list[Message]) -> None:
        """Feed a video's packets of before the demonstration, from a keyframe on: its first frames need them."""
        if not packets:
            return
        self._decoder = decode_video.VideoDecoder()
        for number, message in enumerate(packets, start=-len(packets)):
            for _ in self._decoder.feed(number, message):
                pass

    def add(self, message: Message, stamp_ns: int) -> None:
        """Raises DecodeError once nothing but damaged images came."""
        number = len(self._stamps)
        self._stamps.append(stamp_ns)
        self.ticks.saw(self.view, stamp_ns)
        if self._video is None:
            self._video = decode_video.is_video(message)
        if self._video:
            self._decoder = self._decoder or decode_video.VideoDecoder()
            self._take_video(self._decoder.feed(number, message))
        else:
            self._arrive(_Arrived(number, stamp_ns, partial(stored_image, message, self.spec)))
        if len(self._damaged) > HOPELESS and not self._rows:
            raise next(iter(self._damaged.values()))

    @property
    def stamps_ns(self) -> I64:
        """int64 [M], as the messages came."""
        return np.array(self._stamps, np.int64)

    def observe(self, ticks_ns: I64) -> Seen:
        """What the view shows at each tick. A damaged image is one that never came: the step sees the one before it.

        Raises DecodeError where more than DAMAGED_SHARE of the images that steps would see are damaged."""
        self._end(ticks_ns)
        stamps = self.stamps_ns
        order = align.order_of(stamps, topic=self.spec.topic)
        wanted = order[np.unique(_used(stamps[order], ticks_ns, self.spec))]
        bad = [number for number in wanted.tolist() if number in self._damaged]
        if len(bad) > DAMAGED_SHARE * len(wanted):
            raise self._damaged[bad[0]]
        kept = order
        while True:
            kept = kept[[int(number) in self._rows for number in kept]] if len(bad) else kept
            observed = align.observe(stamps[kept], ticks_ns, stale_after_s=self.spec.stale_after_s)
            used, source_index = np.unique(np.maximum(observed.index, 0), return_inverse=True)
            bad = [int(number) for number in kept[used] if int(number) not in self._rows]
            if not bad:
                break
        rows = np.array([self._rows[int(number)] for number in kept[used]], np.int64)
        early = sum(error.found == decode_video.BEFORE_KEYFRAME for error in self._damaged.values())
        index = source_index.astype(np.int32)
        return Seen(self._spool.take(rows), index, observed.valid, observed.age_s, len(self._damaged), early)

    def _end(self, ticks_ns: I64) -> None:
        if self._decoder is not None:
            self._take_video(self._decoder.rest())
            for number in self._decoder.smeared():
                self._rows.pop(number, None)
            self._damaged |= {number: error for number, error in self._decoder.lost.items() if number >= 0}
        if self._latest is not None:
            self._decide(self._latest, int(ticks_ns[-1]) + 2 * align.TOLERANCE_NS)
            self._latest = None

    # --- one image

    def _take_video(self, frames: decode_video.Frames) -> None:
        for number, frame in frames:
            if number >= 0:
                self._arrive(_Arrived(number, self._stamps[number], partial(self._stored_frame, frame)))

    def _arrive(self, image: _Arrived) -> None:
        """The latest image by its stamp waits for the next one; one that comes late is decided at once."""
        if self._latest is not None and image.stamp_ns < self._latest.stamp_ns:
            self._decide(image, self._latest.stamp_ns)
            return
        before, self._latest = self._latest, image
        if before is not None:
            self._decide(before, image.stamp_ns)

    def _decide(self, image: _Arrived, until_ns: int) -> None:
        """Decode an image if a step may see it; where it is damaged, one before it that nobody had asked for."""
        if not self.ticks.may_fall_in(image.stamp_ns, until_ns):
            self._passed_by.append(image)
            return
        while not self._decode(image):
            if not self._passed_by:
                return
            image = self._passed_by.pop()
        self._passed_by.clear()

    def _decode(self, image: _Arrived) -> bool:
        try:
            self._rows[image.number] = self._spool.append(image.decode())
        except DecodeError as error:
            self._damaged[image.number] = error
            return False
        return True

    def _stored_frame(self, frame: decode_video.Frame) -> U8:
        if self.spec.depth is not None or self.spec.levels is not None:
            remedy = "take `depth` or `levels` out of the view's table"
            raise DecodeError("compressed video holds no depth", where=self.spec.topic, remedy=remedy)
        self._rgb = self._rgb or decode_video.RgbReader()
        return _fitted(self._rgb.rgb(frame), self.spec)


def stored_image(message: Message, view: ViewSpec) -> U8:
    """The image as it is stored: uint8 [H,W,C] at the view's size."""
    if view.depth is None:
        return _fitted(decode_image(message, levels=view.levels), view)
    metres = decode_depth.decode_depth(message, view.depth)
    try:
        fitted = geometry.fit_depth(metres, view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=view.topic, remedy=error.remedy) from error
    return decode_depth.depth_levels(fitted, view.depth)


def _fitted(image: U8, view: ViewSpec) -> U8:
    try:
        return geometry.fit_image(image, view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=view.topic, remedy=error.remedy) from error


def _used(stamps_ns: I64, ticks_ns: I64, view: ViewSpec) -> align.Index:
    return np.maximum(align.observe(stamps_ns, ticks_ns, stale_after_s=view.stale_after_s).index, 0)
