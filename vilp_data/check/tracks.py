"""One topic of a log while it is read: stamps, numbers and a few images, kept until the segment they belong to is judged.

Memory is bounded by the segment, not by the log: `taken` hands out what was gathered and forgets it.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vilp_data import geometry
from vilp_data.check.cameras import SAMPLE_HZ, FrameSample, sample_frame
from vilp_data.check.columns import Columns, columns_of, stamp_reader
from vilp_data.check.pictures import PictureReader, is_camera
from vilp_data.errors import DecodeError
from vilp_data.types import F64, I64, U8, Message, TopicInfo

NUMBERS_HZ = 100.0
"""Rows of numbers a second that are kept: joints do nothing that faster ones would show."""

PICTURE_ROWS = 96
PICTURE_COLUMNS = 192
"""The largest picture of a contact sheet."""

PICTURES = 24
"""Pictures of a contact sheet."""

GIVE_UP = 3
"""Images that cannot be decoded, without any that could: the topic is none to look at."""


@dataclass(frozen=True)
class TopicSamples:
    """What a segment gathered of one topic.

    log_ns     int64 [n]; header_ns int64 [n] or None where messages carry no stamp
    row_index  int64 [m]: which of the n messages each row of numbers is from; rows float64 [m,D]
    samples    sampled images, their times in seconds of log time since the start of the demonstration
    """

    log_ns: I64
    header_ns: I64 | None
    row_index: I64
    rows: F64
    samples: list[FrameSample]


@dataclass
class Track:
    """Gathers one topic."""

    info: TopicInfo
    camera: bool | None = None  # not known before the first message
    columns: Columns | None = None
    first_error: DecodeError | None = None
    n_undecoded: int = 0
    n_sampled: int = 0
    odd_rows: int = 0  # messages whose numbers were of another shape than the first one's
    seen: list[FrameSample] = field(default_factory=list)  # every sampled image of this demonstration
    pictures: list[tuple[int, U8]] = field(default_factory=list)  # log time, picture
    _stamp: Callable[[Message], int] | None = None
    _log: array[int] = field(default_factory=lambda: array("q"))
    _header: array[int] = field(default_factory=lambda: array("q"))
    _index: array[int] = field(default_factory=lambda: array("q"))
    _values: array[float] = field(default_factory=lambda: array("d"))
    _samples: list[FrameSample] = field(default_factory=list)
    _next_sample_ns: int = 0
    _next_row_ns: int = 0
    _next_picture_ns: int = 0
    _origin_ns: int = 0
    _picture_step_ns: int | None = 0
    _pictures: PictureReader = field(default_factory=PictureReader)

    def begin(self, origin_ns: int, picture_step_ns: int | None) -> None:
        """A demonstration begins: its images are sampled anew, and a picture kept every so often (None: none of it)."""
        self._origin_ns, self._picture_step_ns = origin_ns, picture_step_ns
        self._next_sample_ns = self._next_row_ns = self._next_picture_ns = origin_ns
        self.seen = []

    def add(self, message: Message) -> None:
        """Take one message in."""
        if self.camera is None:
            self._look_at_first(message)
        log_ns = message.log_time_ns
        self._log.append(log_ns)
        if self._stamp is not None:
            try:
                self._header.append(self._stamp(message))
            except (AttributeError, TypeError, OverflowError):
                self._header.append(0)
        if self.camera:
            if log_ns >= self._next_sample_ns:
                self._sample(message)
        elif self.columns is not None and log_ns >= self._next_row_ns:
            self._take_row(message)

    @property
    def image(self) -> str | None:
        """`480x640 jpeg` for a camera, as soon as an image was decoded."""
        return self._pictures.image

    @property
    def held(self) -> int:
        """How many numbers are kept at present."""
        return len(self._log) + len(self._header) + len(self._values)

    def taken(self) -> TopicSamples:
        """What was gathered since the last call."""
        width = len(self.columns.names) if self.columns else 0
        gathered = TopicSamples(
            np.array(self._log, np.int64),
            np.array(self._header, np.int64) if self._stamp is not None else None,
            np.array(self._index, np.int64),
            np.array(self._values, np.float64).reshape(-1, width) if width else np.empty((0, 0)),
            self._samples,
        )
        self._log, self._header, self._index = array("q"), array("q"), array("q")
        self._values, self._samples = array("d"), []
        return gathered

    def _look_at_first(self, message: Message) -> None:
        self.camera = is_camera(message)
        self._stamp = stamp_reader(message)
        if not self.camera:
            try:
                self.columns = columns_of(message.body, self.info.names)
            except (AttributeError, TypeError, KeyError):
                self.columns = None

    def _take_row(self, message: Message) -> None:
        assert self.columns is not None
        try:
            row = self.columns.read(message.body)
            if len(row) == len(self.columns.names):
                self._values.extend(row)
                self._index.append(len(self._log) - 1)
                self._next_row_ns = message.log_time_ns + int(0.9e9 / NUMBERS_HZ)
                return
        except (AttributeError, KeyError, TypeError, ValueError):
            whole = len(self._index) * len(self.columns.names)
            del self._values[whole:]  # what a row that broke off left
        self.odd_rows += 1

    def _sample(self, message: Message) -> None:
        period_ns = int(1e9 / SAMPLE_HZ)
        if self.n_sampled == 0 and self.n_undecoded >= GIVE_UP:
            return
        try:
            frame = self._pictures.read(message)
        except DecodeError as error:
            frame, self.n_undecoded = None, self.n_undecoded + 1
            self.first_error = self.first_error or error
        else:
            if frame is None:
                return  # the next message may be a keyframe
        self._next_sample_ns = (
            message.log_time_ns + period_ns - (message.log_time_ns - self._next_sample_ns) % period_ns
        )
        if frame is None:
            return
        self.n_sampled += 1
        seen = sample_frame(frame, (message.log_time_ns - self._origin_ns) / 1e9)
        self._samples.append(seen)
        self.seen.append(seen)
        if self._picture_step_ns is not None and message.log_time_ns >= self._next_picture_ns:
            self._next_picture_ns = message.log_time_ns + self._picture_step_ns - period_ns // 2
            self.pictures.append((message.log_time_ns, picture_of(frame)))


def picture_of(frame: U8) -> U8:
    """A picture of a contact sheet, at most PICTURE_ROWS x PICTURE_COLUMNS."""
    stride = max(min(frame.shape[0] // (2 * PICTURE_ROWS), frame.shape[1] // (2 * PICTURE_COLUMNS)), 1)
    frame = np.ascontiguousarray(frame[::stride, ::stride])  # the filter below needs no more than twice the size
    height, width = frame.shape[:2]
    scale = min(PICTURE_ROWS / height, PICTURE_COLUMNS / width, 1.0)
    small = geometry.fit_image(frame, max(round(height * scale), 1), max(round(width * scale), 1), "stretch")
    return small if small.ndim == 3 else small[..., None]


def runs_on_header(gathered: TopicSamples) -> bool:
    """Whether header stamps tell when things happened: set, in order, and on the recorder's clock."""
    header = gathered.header_ns
    if header is None or not len(header) or not header.all():
        return False
    near = abs(int(np.median(gathered.log_ns - header))) < 1_000_000_000
    return near and bool((np.diff(header) >= 0).all())
