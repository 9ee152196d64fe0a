"""What every format's writer is given, and what it tells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Literal

import numpy as np

from vilp_data.episodes import EpisodeStore
from vilp_data.export.segments import Chosen, Rows, Segment, Shapes, read_segments
from vilp_data.export.video import frame_rate
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.vector_parts import shared_names, vector_parts

Images = Literal["h264", "h264-420", "lossless", "png"]

TASK_TAGS = ("instruction", "language_instruction", "task")
"""Tags that say in words what an episode shows; else it is the task's name."""

Step = Callable[[int], None]
"""Told how many rows more are done."""


@dataclass(frozen=True)
class Column:
    """A part of a vector: its name, a label for each of its numbers, and where it lies in the vector."""

    name: str
    labels: tuple[str, ...]
    first: int

    @property
    def span(self) -> slice:
        return slice(self.first, self.first + len(self.labels))


@dataclass(frozen=True)
class ExportJob:
    """One export. `crf` None is the default of `images`; `step` is told of rows as they are done."""

    store: EpisodeStore
    spec: TaskSpec
    chosen: Chosen
    shapes: Shapes
    rate_hz: float
    images: Images
    crf: int | None
    marked: bool
    step: Step

    @cached_property
    def fps(self) -> Fraction:
        return frame_rate(self.rate_hz)

    @cached_property
    def low_dim(self) -> tuple[Column, ...]:
        return self._columns(self.shapes.low_dim, self.spec.low_dim, "low_dim")

    @cached_property
    def action(self) -> tuple[Column, ...]:
        return self._columns(self.shapes.action or 0, self.spec.action, "action")

    def _columns(self, width: int, parts: Mapping[str, ActionSpec | VectorSpec], vector: str) -> tuple[Column, ...]:
        """The parts of a vector of `width` numbers, in order; one part, called as the vector is, where nothing tells their widths."""
        names = shared_names((segment.entry.column_names for segment in self.chosen.segments), vector)
        columns, first = [], 0
        for name, (labels, _) in vector_parts(np.empty((0, width), np.float32), parts, names).items():
            columns.append(Column(name or (next(iter(parts)) if len(parts) == 1 else vector), tuple(labels), first))
            first += len(labels)
        return tuple(columns)

    def read(self) -> Iterator[tuple[Segment, Rows]]:
        """Every segment with its rows, in the order of the export."""
        for segment, rows in read_segments(self.store, self.chosen.segments, self.shapes.action):
            yield segment, rows
            self.step(segment.n_rows)

    def task_of(self, segment: Segment) -> str:
        """What the segment shows, in words."""
        return next((segment.entry.tags[tag] for tag in TASK_TAGS if segment.entry.tags.get(tag)), self.spec.name)

    def depth_views(self) -> set[str]:
        """Views of one channel."""
        return {view for view, shape in self.shapes.views.items() if shape[-1] == 1}

    def segment_bytes(self, segment: Segment) -> int:
        """What a segment's rows would take without any compression."""
        numbers = 4 * (self.shapes.low_dim + (self.shapes.action or 0)) + 8 * (self.shapes.state or 0) + 32
        return segment.n_rows * (numbers + sum(int(np.prod(shape)) for shape in self.shapes.views.values()))

    @property
    def raw_bytes(self) -> int:
        """The same of all rows."""
        return sum(self.segment_bytes(segment) for segment in self.chosen.segments)


@dataclass
class ViewWritten:
    """How a view was written, and how near it came. `psnr_db`, `psnr_min_db`: of all pixels, and of the worst frame, against the stored
    frames; None where every pixel is equal."""

    where: str
    coding: str
    n_images: int
    n_bytes: int = 0
    psnr_db: float | None = None
    psnr_min_db: float | None = None


@dataclass
class Written:
    """What a writer did. `carried`: what -> where it lies; `not_carried`: what -> why, and how much."""

    views: dict[str, ViewWritten] = field(default_factory=dict)
    carried: dict[str, str] = field(default_factory=dict)
    not_carried: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
