"""[episodes] of a task: where one demonstration of a log ends and the next begins."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from vilp_data.errors import SpecError, nearest
from vilp_data.types import OUTCOME_TAG

ABSOLUTE_NS = 10**15
"""A whole number in `start` or `end` from here on is absolute nanoseconds: as seconds it would be thirty million years."""

LATEST = 2**63
"""Nanoseconds from here on fit no clock."""

_YES, _NO = ("true", "yes", "1", "success"), ("false", "no", "0", "failure")
_COLUMNS = ("start", "end", "start_s", "end_s", "start_ns", "end_ns", "name", "log", "success")

MarkerValue = bool | int | float | str


class RangeRow(BaseModel):
    """One line of a ranges file: [start, end) in seconds from the log's first message, or in absolute nanoseconds of log time.

    `log` names the only log it is of (file name, with or without its suffix); None: every log. `tags` become the episode's."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: float | int
    end: float | int
    absolute_ns: bool = False
    name: str | None = None
    log: str | None = None
    tags: dict[str, str] = {}

    @property
    def text(self) -> str:
        """The range as it was stated: what an episode keeps as its tag `cut`."""
        return f"{self.start}-{self.end} ns" if self.absolute_ns else f"{self.start:g}-{self.end:g} s"


class EpisodesSpec(BaseModel):
    """How the demonstrations in a log are told apart. Times are log times.

    by              "file": as the log has them (a file of messages is one); "gap", "topic", or the path of a ranges file ending in .csv
    min_duration_s  cuts shorter than this are left out and counted
    gap:    gap_s   no message for longer than this, on any of `topics` (default: every topic of the task), ends a demonstration
    topic:  topic   a demonstration lasts while its value is true (not 0, not empty, not "false"), or from a message whose value is
                    `start` to the next whose value is `stop`; one of them alone divides the log at each such message
            field   where the value is; needed for messages of several fields
            stop_topic  every message on it ends the demonstration that a message on `topic` began
            tag     the episode gets this tag, with the value; another value begins another demonstration
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    by: str = "file"
    min_duration_s: float = Field(default=0.0, ge=0)
    gap_s: float | None = Field(default=None, gt=0)
    topics: tuple[str, ...] = ()
    topic: str | None = None
    field: str | None = None
    start: MarkerValue | None = None
    stop: MarkerValue | None = None
    stop_topic: str | None = None
    tag: str | None = None
    rows: tuple[RangeRow, ...] = ()

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        kind = self.kind
        keys: Mapping[str, tuple[str, ...]] = {
            "file": (), "gap": ("gap_s", "topics"), "ranges": ("rows",),
            "topic": ("topic", "field", "start", "stop", "stop_topic", "tag"),
        }  # fmt: skip
        if kind not in keys:
            raise ValueError(f'by = {self.by!r}: it is "file", "gap", "topic", or a path that ends in .csv')
        allowed = {"by", *keys[kind], *(("min_duration_s",) if kind != "file" else ())}
        for name in sorted(self.model_fields_set - allowed):
            if getattr(self, name) not in (None, (), 0.0):
                raise ValueError(
                    f"`{name}` says nothing where by = {self.by!r}; there: {', '.join(sorted(allowed - {'by'})) or 'nothing'}"
                )
        if kind == "gap" and self.gap_s is None:
            raise ValueError('by = "gap" needs gap_s: how long a silence parts two demonstrations')
        if kind == "topic" and self.topic is None:
            raise ValueError('by = "topic" needs `topic`: whose values say when a demonstration runs')
        if self.stop_topic is not None and (self.stop is not None or self.tag is not None):
            raise ValueError("every message on stop_topic ends a demonstration: leave `stop` and `tag` out")
        if self.tag is not None and (self.start is not None or self.stop is not None):
            raise ValueError(
                "`tag` is for a topic whose every value is a demonstration of its own: leave `start` and `stop` out"
            )
        return self

    @model_serializer(mode="wrap")
    def _as_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        left_out = ("min_duration_s",) if not self.min_duration_s else ()
        stated = ((name, value) for name, value in plain(self).items() if value is not None and name not in left_out)
        return {name: value for name, value in stated if not isinstance(value, list | tuple) or value}

    @property
    def kind(self) -> str:
        """ "file", "gap", "topic" or "ranges"."""
        return "ranges" if self.by.endswith(".csv") else self.by

    def ingest_fields(self) -> dict[str, Any] | None:
        """What decides where every episode begins and ends; None where the log itself does. The rows of a ranges file are left out:
        each is part of its own episode's key, so that one more does not touch the others."""
        if self.kind == "file":
            return None
        fields = self.model_dump(mode="json", exclude={"rows", "by"})
        return {"by": self.kind, **fields}


def read_ranges(text: str, *, where: str) -> tuple[RangeRow, ...]:
    """The rows of a ranges file. SpecError naming line and column."""
    table = csv.DictReader(text.removeprefix("\ufeff").splitlines(keepends=True), skipinitialspace=True)
    columns = [column.strip() for column in table.fieldnames or ()]
    table.fieldnames = columns
    pair = next(
        (
            names
            for names in (("start", "end"), ("start_s", "end_s"), ("start_ns", "end_ns"))
            if set(names) <= {*columns}
        ),
        None,
    )
    if pair is None:
        wanted = "columns start and end (seconds from the log's start), or start_ns and end_ns"
        raise SpecError(
            "a ranges file needs a header line with " + wanted, where=where, found=", ".join(columns) or "nothing"
        )
    rows = [
        _row(
            {key: (value or "").strip() for key, value in line.items() if key}, pair, f"{where}, line {table.line_num}"
        )
        for line in table
    ]
    if not rows:
        raise SpecError(
            "a ranges file without ranges", where=where, remedy="give each demonstration a line: start, end"
        )
    return tuple(rows)


def _row(line: Mapping[str, str], pair: tuple[str, str], where: str) -> RangeRow:
    start, end = (_time(line[column], column, where) for column in pair)
    large = [abs(time) >= ABSOLUTE_NS for time in (start, end)]
    absolute = pair[0] == "start_ns" or all(large)
    if absolute and not (isinstance(start, int) and isinstance(end, int)):
        raise SpecError(
            "absolute times are whole nanoseconds",
            where=where,
            found=f"{start}, {end}",
            remedy="e.g. 1700000000500000000",
        )
    if any(large) and not absolute:
        raise SpecError(
            "start and end are not of one kind: one is in nanoseconds, the other in seconds",
            where=where,
            found=f"{start}, {end}",
            remedy="give both as seconds from the log's start, or both as nanoseconds",
        )
    if end <= start:
        raise SpecError(
            "a range must end after it starts",
            where=where,
            found=f"start {start}, end {end}",
            remedy="correct that line",
        )
    tags = {name: value for name, value in line.items() if value and name not in _COLUMNS}
    if outcome := line.get("success", "").lower():
        if outcome not in (*_YES, *_NO):
            raise SpecError(
                "success is true or false", where=where, found=repr(outcome), remedy=nearest(outcome, (*_YES, *_NO))
            )
        tags[OUTCOME_TAG] = "true" if outcome in _YES else "false"
    return RangeRow(
        start=start,
        end=end,
        absolute_ns=absolute,
        name=line.get("name") or None,
        log=line.get("log") or None,
        tags=tags,
    )


def _time(text: str, column: str, where: str) -> float | int:
    """A whole number as such, anything else in seconds. "inf" is no end: a range past the log's end is cut there anyway."""
    try:
        time = int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        time = math.nan
    if not abs(time) < LATEST:
        raise SpecError(f"{column} is no number", where=where, found=repr(text), remedy="correct that line")
    return time
