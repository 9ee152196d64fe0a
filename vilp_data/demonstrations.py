"""Cutting a log into demonstrations: by silence, by the value of a topic, by given ranges. Pure: times and values in, spans out.

Every span is [start, end) in nanoseconds of log time, and is named after its start, counted from the log's own: so a cut that stays
where it is keeps its name, whatever becomes of the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from vilp_data.episodes_spec import EpisodesSpec, RangeRow
from vilp_data.errors import SpecError, some_of
from vilp_data.types import I64, LogEpisode

LOG_TAG = "log"
"""The tag that every cut demonstration gets, the name of its log: `group_by = "log"` keeps those of one log on one side of the split."""

CUT_TAG = "cut"
"""The tag that keeps the range as a ranges file stated it: a line that was changed or taken out is noticed by it."""

SMALL_CHANGE_NS = 100_000_000
"""A range that reaches so little past the log's end was rounded."""

SHOWN_RANGES = 5

FALSE_WORDS = frozenset({"", "0", "false", "off", "no", "none", "stop", "stopped", "idle"})


@dataclass(frozen=True)
class Span:
    """A demonstration: [start_ns, end_ns), with the tags that only it has, and the name that was given to it, if one was. `stated_ns`:
    the start that a ranges file states, which names it even where the log begins later."""

    start_ns: int
    end_ns: int
    tags: dict[str, str] = field(default_factory=dict)
    name: str | None = None
    stated_ns: int | None = None


@dataclass(frozen=True)
class Marker:
    """A value that came at a time. `stops`: it came on the topic that ends demonstrations."""

    time_ns: int
    value: Any
    stops: bool = False


def spans_between_gaps(times_ns: I64, gap_s: float) -> list[Span]:
    """A span from the first to the last message of each burst; bursts are parted by more than `gap_s` without any."""
    times = np.sort(times_ns)
    if not len(times):
        return []
    breaks = np.flatnonzero(np.diff(times) > gap_s * 1e9)
    firsts, lasts = np.append(0, breaks + 1), np.append(breaks, len(times) - 1)
    return [Span(int(times[first]), int(times[last]) + 1) for first, last in zip(firsts, lasts, strict=True)]


def spans_by_value(markers: Sequence[Marker], spec: EpisodesSpec, *, start_ns: int, end_ns: int) -> list[Span]:
    """The spans that the values of a topic mark, as `EpisodesSpec` says; `start_ns` and `end_ns` are the log's."""
    ordered = sorted(markers, key=lambda marker: marker.time_ns)
    if spec.stop_topic is not None or spec.start is not None or spec.stop is not None:
        return _between_marks(ordered, spec, start_ns, end_ns)
    spans: list[Span] = []
    begun: Marker | None = None
    for marker in ordered:
        true = is_true(marker.value)
        if begun is not None and (not true or (spec.tag is not None and marker.value != begun.value)):
            spans.append(_marked(begun, marker.time_ns, spec))
            begun = None
        if true and begun is None:
            begun = marker
    return spans if begun is None else [*spans, _marked(begun, end_ns, spec)]


def _between_marks(markers: Sequence[Marker], spec: EpisodesSpec, start_ns: int, end_ns: int) -> list[Span]:
    """From each start to the next stop or start. Without a value for starting, the log's start and every stop begin the next one."""
    starts_itself = spec.start is None and spec.stop_topic is None
    spans: list[Span] = []
    begun: int | None = start_ns if starts_itself else None
    for marker in markers:
        begins = not marker.stops and not starts_itself and (spec.start is None or equals(marker.value, spec.start))
        ends = marker.stops or (spec.stop is not None and equals(marker.value, spec.stop))
        if begun is not None and (ends or begins):
            spans.append(Span(begun, marker.time_ns))
            begun = marker.time_ns if starts_itself else None
        if begins:
            begun = marker.time_ns
    open_end = begun is not None and not starts_itself  # what follows the last stop was not marked as a demonstration
    return [*spans, Span(begun, end_ns)] if open_end and begun is not None else spans


def spans_of_rows(rows: Iterable[RangeRow], log: str, *, start_ns: int) -> list[Span]:
    """The spans of the rows that are of this log, by its file name; seconds are counted from `start_ns`."""
    spans = []
    for row in rows:
        if row.log is not None and row.log not in (log, stem(log)):
            continue
        first, last = (
            (row.start, row.end) if row.absolute_ns else (start_ns + round(t * 1e9) for t in (row.start, row.end))
        )
        spans.append(Span(int(first), int(last), {**row.tags, CUT_TAG: row.text}, row.name, int(first)))
    return spans


def named(spans: Sequence[Span], native: LogEpisode, *, log: str, start_ns: int, alone: bool) -> list[LogEpisode]:
    """Spans, each within `native`, the log's own demonstration, as demonstrations with its tags and theirs, in order of time. `alone`:
    the log has no other of its own. SpecError where two spans were given one name."""
    found: dict[str, LogEpisode] = {}
    for span in sorted(spans, key=lambda span: (span.start_ns, span.end_ns)):
        prefix = "" if alone else f"{native.name}-"
        after_ns = (span.start_ns if span.stated_ns is None else span.stated_ns) - start_ns
        names = [prefix + (span.name or _name(after_ns, digits)) for digits in (3, 6, 9)]
        free = [name for name in names if name not in found]
        if not free:
            raise SpecError(
                f"two ranges are called {names[0]!r}", where=log, remedy="give each its own name in the ranges file"
            )
        tags = {**native.tags, LOG_TAG: stem(log), **span.tags}
        found[free[0]] = LogEpisode(free[0], span.start_ns, span.end_ns, tags)
    return list(found.values())


def _name(after_ns: int, digits: int) -> str:
    """`at-00012.346s`; with more digits where two cuts begin in the same millisecond, as a bouncing button makes them."""
    return f"at-{after_ns / 1e9:0{6 + digits}.{digits}f}s"


def within(spans: Sequence[Span], *natives: LogEpisode) -> list[Span]:
    """The parts of spans that lie in these of the log's own demonstrations."""
    parts = (
        replace(span, start_ns=max(span.start_ns, native.start_ns), end_ns=min(span.end_ns, native.end_ns))
        for span in spans
        for native in natives
    )
    return [part for part in parts if part.start_ns < part.end_ns]


def refuse_overlaps(spans: Sequence[Span], *, log: str) -> None:
    """SpecError where two ranges share time: their frames would be learnt from on one side of the split and judged by on the other."""
    for one, two in pairwise(sorted(spans, key=lambda span: (span.start_ns, span.end_ns))):
        if two.start_ns < one.end_ns:
            raise SpecError(
                "two ranges overlap, so their frames could come to lie on both sides of the split",
                where=log,
                found=f"{_text(one)} and {_text(two)}",
                remedy='end one where the other begins, or keep all cuts of a log together: [split] group_by = "log"',
            )


def out_of_reach(spans: Sequence[Span], natives: Sequence[LogEpisode]) -> list[str]:
    """Sentences about ranges of which some, or all, lies outside the log's demonstrations."""
    outside, cut = [], []
    for span in spans:
        inside_ns = sum(part.end_ns - part.start_ns for part in within([span], *natives))
        if not inside_ns:
            outside.append(_text(span))
        elif span.end_ns - span.start_ns - inside_ns > SMALL_CHANGE_NS:
            cut.append(_text(span))
    whole = f"the log's {(natives[-1].end_ns - natives[0].start_ns) / 1e9:.1f} s"
    whole += f" of {len(natives)} demonstrations" * (len(natives) > 1)
    return [
        *([f"outside {whole}, and left out: {some_of(outside, SHOWN_RANGES)}"] if outside else []),
        *([f"reaching outside {whole}, and cut there: {some_of(cut, SHOWN_RANGES)}"] if cut else []),
    ]


def _text(span: Span) -> str:
    stated = span.tags.get(CUT_TAG, "")
    return f"{span.name} ({stated})" if span.name else stated


def stem(log: str) -> str:
    """A log's file name without its suffix."""
    return log.rpartition(".")[0] or log


def is_true(value: Any) -> bool:
    """Whether a marker's value says that a demonstration runs: not zero, not NaN, no word that denies."""
    if isinstance(value, str):
        return value.strip().lower() not in FALSE_WORDS
    return bool(value) and not (isinstance(value, float) and math.isnan(value))


def equals(value: Any, wanted: Any) -> bool:
    """Whether a marker's value is the one that the task names; "3" and 3 are, for JSON has both."""
    return bool(value == wanted) or str(value) == str(wanted)


def _marked(begun: Marker, end_ns: int, spec: EpisodesSpec) -> Span:
    tags = {} if spec.tag is None else {spec.tag: str(begun.value)}
    return Span(begun.time_ns, end_ns, tags)
