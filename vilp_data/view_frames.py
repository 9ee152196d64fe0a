"""A view's images as a log gives them -> the frames that steps see, each once, decoded and at their stored size.

Which images steps see is known for sure only at the end, when every stamp is. Waiting for that would hold an hour of images in
memory, and decoding all of them would waste most of a fast camera's. So an image is decoded when the next one has come, if a step may
fall between the two. `Ticks` guesses the steps from the first stamps; where the guess turns out wrong, the log is read once more.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from vilp_data import align, geometry
from vilp_data.decode import depth as decode_depth
from vilp_data.decode.images import decode_image, range_of_one
from vilp_data.decode.video import BEFORE_KEYFRAME
from vilp_data.decode.video_packet import holds_picture, is_video
from vilp_data.errors import DecodeError, SpecError, UsageError
from vilp_data.frame_spool import FrameSpool
from vilp_data.spec import ViewSpec
from vilp_data.types import F32, I32, I64, U8, Bool, Message
from vilp_data.video_images import VideoImages
from vilp_data.video_start import VideoStart

DAMAGED_SHARE = 0.5
"""More damaged images than this among those that steps use, and the episode is refused: that is no glitch."""

HOPELESS = 20
"""So many damaged images before the first whole one end the reading: the topic holds something else."""

HOPELESS_S = 600
"""So long without a keyframe, and a video's reading ends: cameras send one every second or so, a recording's first may be late."""

PASSED_BY = 4
"""Images that no step asked for are kept, so many, until a later one is known to be whole."""

UNREAD, DAMAGED = -1, -2
"""In place of an image's row among the frames."""


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
        self._stamps, self._rows = array("q"), array("q")  # of each image, as its message came
        self._spool = FrameSpool(scratch)
        self._first_damage: DecodeError | None = None
        self._n_damaged = self._n_early = 0
        self._latest: _Arrived | None = None
        self._passed_by: deque[_Arrived] = deque(maxlen=PASSED_BY)
        self._floats = False
        self._video: VideoImages | None = None

    def warm_up(self, start: VideoStart | None) -> None:
        """Give a video what its decoder must have had before the demonstration: its first frames need it."""
        if start is not None:
            self._video = VideoImages(self.spec, self._stamps, start)

    def add(self, message: Message, stamp_ns: int) -> None:
        """Raises DecodeError once nothing but damaged images came, SpecError where the view's table is of another kind of camera."""
        if (
            not self._stamps and self._video is None
        ):  # told by the first message: asking each would cost as much as reading it
            self._floats = message.schema == "array" and np.asarray(message.body).dtype.kind == "f"
            if is_video(message):
                self.warm_up(VideoStart({}, ()))
        if self._video is not None:
            if holds_picture(message):
                self._counted(stamp_ns)
            self._take(self._video, self._video.feed(message))
            return
        self._arrive(_Arrived(self._counted(stamp_ns), stamp_ns, partial(stored_image, message, self.spec)))

    @property
    def stamps_ns(self) -> I64:
        """int64 [M] of its images, as the messages came. A video's messages without a picture are none."""
        return np.array(self._stamps, np.int64)

    def observe(self, ticks_ns: I64) -> Seen:
        """What the view shows at each tick. A damaged image is one that never came: the step sees the one before it.

        Raises DecodeError where more than DAMAGED_SHARE of the images that steps would see are damaged, and AlignError where a
        video's frames are not in the order of their stamps."""
        self._end(ticks_ns)
        stamps, rows = self.stamps_ns, np.array(self._rows, np.int64)
        order = align.order_of(stamps, topic=self.spec.topic)
        wanted = order[np.unique(np.maximum(self._seen_at(stamps[order], ticks_ns).index, 0))]
        self._refuse_damaged(int(np.count_nonzero(rows[wanted] == DAMAGED)), len(wanted))
        whole = order[rows[order] >= 0]
        observed = self._seen_at(stamps[whole], ticks_ns)
        used, source_index = np.unique(np.maximum(observed.index, 0), return_inverse=True)
        frames = self._spool.take(rows[whole[used]])
        if self._floats and frames.any() and frames.max() <= 1:
            raise range_of_one(self.spec.topic, f"nothing above 1 in {len(frames)} images")
        index = source_index.astype(np.int32)
        return Seen(frames, index, observed.valid, observed.age_s, self._n_damaged, self._n_early)

    def _seen_at(self, stamps_ns: I64, ticks_ns: I64) -> align.Observed:
        return align.observe(stamps_ns, ticks_ns, stale_after_s=self.spec.stale_after_s)

    def _end(self, ticks_ns: I64) -> None:
        if self._video is not None:
            self._take(self._video, self._video.end())
        if self._latest is not None:
            self._decide(self._latest, int(ticks_ns[-1]) + 2 * align.TOLERANCE_NS)
            self._latest = None

    def _refuse_damaged(self, damaged: int, wanted: int) -> None:
        first = self._first_damage
        if first is not None and damaged > DAMAGED_SHARE * wanted:
            found = f"{damaged} of {wanted}; the first, {first.where}: {first.what}, {first.found}"
            what = "too many of the images that steps would see are damaged"
            raise DecodeError(what, where=f"view {self.view}", found=found, remedy=first.remedy)

    # --- one image

    def _counted(self, stamp_ns: int) -> int:
        """The number of an image that is there now."""
        self._stamps.append(stamp_ns)
        self._rows.append(UNREAD)
        self.ticks.saw(self.view, stamp_ns)
        return len(self._stamps) - 1

    def _take(self, video: VideoImages, images: Iterable[tuple[int, Callable[[], U8]]]) -> None:
        for number, rgb in images:
            self._arrive(_Arrived(number, self._stamps[number], partial(_fitted_rgb, rgb, self.spec)))
        for number, error in video.losses():
            self._note_damage(number, error)

    def _arrive(self, image: _Arrived) -> None:
        """The latest image by its stamp waits for the next one: a step may fall between the two. One that comes late is decoded at
        once, for the interval that it cuts in two was decided already."""
        if self._latest is not None and image.stamp_ns < self._latest.stamp_ns:
            self._decode(image)
            return
        before, self._latest = self._latest, image
        if before is not None:
            self._decide(before, image.stamp_ns)

    def _decide(self, image: _Arrived, until_ns: int) -> None:
        """Decode an image if a step may see it; where it is damaged, the one before it, which nobody had asked for."""
        if not self.ticks.may_fall_in(image.stamp_ns, until_ns):
            self._passed_by.append(image)
            return
        while not self._decode(image) and self._passed_by:
            image = self._passed_by.pop()
        self._passed_by.clear()

    def _decode(self, image: _Arrived) -> bool:
        try:
            self._rows[image.number] = self._spool.append(image.decode())
        except DecodeError as error:
            self._note_damage(image.number, error)
            return False
        return True

    def _note_damage(self, number: int, error: DecodeError) -> None:
        self._rows[number] = DAMAGED
        self._first_damage = self._first_damage or error
        self._n_damaged += 1
        self._n_early += error.found == BEFORE_KEYFRAME
        waited_s = abs(self._stamps[number] - self._stamps[0]) / 1e9
        if not len(self._spool) and (self._n_damaged - self._n_early > HOPELESS or waited_s > HOPELESS_S):
            raise self._first_damage


def stored_image(message: Message, view: ViewSpec) -> U8:
    """The image as it is stored: uint8 [H,W,C] at the view's size."""
    if view.depth is None:
        return _fitted(decode_image(message, levels=view.levels, dark=True), view)
    metres = decode_depth.decode_depth(message, view.depth)
    try:
        fitted = geometry.fit_depth(metres, view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=view.topic, remedy=error.remedy) from error
    return decode_depth.depth_levels(fitted, view.depth)


def _fitted_rgb(rgb: Callable[[], U8], view: ViewSpec) -> U8:
    return _fitted(rgb(), view)


def _fitted(image: U8, view: ViewSpec) -> U8:
    try:
        return geometry.fit_image(image, view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=view.topic, remedy=error.remedy) from error
