"""The demonstrations in a log as a task cuts it: reads what `demonstrations` needs to know, and no more of the log than that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.decode.field_paths import fields_here, follow
from vilp_data.decode.message_body import member_names, set_members
from vilp_data.demonstrations import (
    LOG_TAG,
    Marker,
    Span,
    named,
    out_of_reach,
    refuse_overlaps,
    spans_between_gaps,
    spans_by_value,
    spans_of_rows,
    within,
)
from vilp_data.episodes_spec import EpisodesSpec
from vilp_data.errors import DecodeError, LogError, nearest
from vilp_data.keys import digest
from vilp_data.sources import IndexedLog, open_log
from vilp_data.spec import TaskSpec
from vilp_data.topic_times import times_in_index, times_of
from vilp_data.types import I64, LogEpisode, Message

RULES_VERSION = 1
"""Raised when the same log and the same rule give other spans than before: what is remembered of logs then counts no more."""

BOUNCE_S = 0.001
"""What a topic's value marks for less than this is a switch that bounces, whatever `min_duration_s` says."""

EMPTY_MEMBER = "structure_needs_at_least_one_member"  # how ROS 2 spells a message without fields

Remember = Callable[[str, Callable[[], Any]], Any]
"""(what, how to find it) -> plain data, found once for as long as the log looks untouched."""


@dataclass
class Cuts:
    """`demonstrations` in order of time; `native` name of each -> the demonstration of the log's own that it lies in; `notes`:
    sentences about what was left out."""

    demonstrations: list[LogEpisode] = field(default_factory=list)
    native: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class CutPreview:
    """One demonstration, before it is ingested. `messages`: how many of the task's topics; None where the log has no index to tell."""

    log: str
    name: str
    start_ns: int
    start_s: float
    duration_s: float
    messages: int | None
    tags: dict[str, str]


def cut_log(log: IndexedLog, spec: TaskSpec, path: Path, remember: Remember = lambda what, find: find()) -> Cuts:
    """The log's demonstrations by `spec.episodes`. Those it has of its own are cut further, never joined.

    Raises LogError where the log lacks a topic that tells them apart, DecodeError where that topic's values cannot be told."""
    natives, rule = log.episodes(), spec.episodes
    if rule.kind == "file" or not natives:
        return Cuts(natives, {native.name: native.name for native in natives})
    start_ns, end_ns = natives[0].start_ns, natives[-1].end_ns
    cuts = Cuts()
    if rule.kind == "ranges":
        spans = spans_of_rows(rule.rows, path.name, start_ns=start_ns)
        if spec.split.group_by != LOG_TAG:
            refuse_overlaps(spans, log=path.name)
        cuts.notes += [f"{path}: ranges {note}" for note in out_of_reach(spans, natives)]
    else:
        settings = digest([RULES_VERSION, rule.ingest_fields(), sorted(_watched(spec)), start_ns, end_ns])
        found = remember(settings, lambda: [asdict(span) for span in _spans(log, spec, start_ns, end_ns)])
        spans = [Span(**span) for span in found]
    for native in natives:
        inside = _leave_out_short(within(spans, native), rule, path, cuts)
        for cut in named(inside, native, log=path.name, start_ns=start_ns, alone=len(natives) == 1):
            cuts.demonstrations.append(cut)
            cuts.native[cut.name] = native.name
    if not cuts.demonstrations and not cuts.notes:
        cuts.notes.append(f"{path}: [episodes] finds no demonstration in it")
    return cuts


def preview(path: Path, spec: TaskSpec) -> tuple[list[CutPreview], list[str]]:
    """What `ingest` would take from a log, and sentences about what it would leave out; nothing is written."""
    with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
        cuts = cut_log(log, spec, path)
        topics = [topic.name for topic in log.topics() if topic.name in spec.topics()]
        times = times_in_index(log, topics)
        known = [np.sort(stamps) for stamps in times.values()] if len(times) == len(topics) else []
        natives, doubts = log.episodes(), [f"{path}: {doubt}" for doubt in log.doubts()]
    start_ns = natives[0].start_ns if natives else 0
    found = [
        CutPreview(
            log=str(path),
            name=cut.name,
            start_ns=cut.start_ns,
            start_s=(cut.start_ns - start_ns) / 1e9,
            duration_s=(cut.end_ns - cut.start_ns) / 1e9,
            messages=sum(_count(stamps, cut) for stamps in known) if known else None,
            tags=dict(cut.tags),
        )
        for cut in cuts.demonstrations
    ]
    return found, [*cuts.notes, *doubts]


def _count(stamps: I64, cut: LogEpisode) -> int:
    first, stop = np.searchsorted(stamps, [cut.start_ns, cut.end_ns])
    return int(stop - first)


def _leave_out_short(spans: list[Span], rule: EpisodesSpec, path: Path, cuts: Cuts) -> list[Span]:
    """The spans that last long enough; a note says how many do not. Before they get names, for short ones come in swarms."""
    least_s = max(rule.min_duration_s, BOUNCE_S if rule.kind == "topic" else 0.0)
    long = [span for span in spans if span.end_ns - span.start_ns >= least_s * 1e9]
    if short := len(spans) - len(long):
        least = f"min_duration_s = {least_s:g}" if rule.min_duration_s >= least_s else f"{least_s:g} s"
        cuts.notes.append(f"{path}: {short} cut{'s' if short > 1 else ''} shorter than {least} left out")
    return long


# --- reading ------------------------------------------------------------------------------------------------------------


def _watched(spec: TaskSpec) -> list[str]:
    return list(spec.episodes.topics) or spec.topics()


def _spans(log: IndexedLog, spec: TaskSpec, start_ns: int, end_ns: int) -> list[Span]:
    rule = spec.episodes
    if rule.kind == "gap":
        return spans_between_gaps(_times(log, _watched(spec), required=rule.topics), float(rule.gap_s or 0))
    markers = _markers(log, str(rule.topic), rule.field, stops=False)
    markers += [] if rule.stop_topic is None else _markers(log, rule.stop_topic, None, stops=True)
    return spans_by_value(markers, rule, start_ns=start_ns, end_ns=end_ns)


def _times(log: IndexedLog, topics: list[str], *, required: tuple[str, ...]) -> I64:
    """The log times of every message of the topics, from the index where it tells them all."""
    have = {topic.name for topic in log.topics()}
    for topic in required:
        if topic not in have:
            raise _no_topic(log, topic)
    return times_of(log, [topic for topic in topics if topic in have])


def _markers(log: IndexedLog, topic: str, path: str | None, *, stops: bool) -> list[Marker]:
    if topic not in {known.name for known in log.topics()}:
        raise _no_topic(log, topic)
    return [
        Marker(message.log_time_ns, True if stops else marker_value(message, path), stops)
        for message in log.messages([topic])
    ]


def marker_value(message: Message, path: str | None) -> bool | int | float | str:
    """The value by which a message marks demonstrations: at `path`, else the message's only one; True for one without any, which marks
    by coming. DecodeError where that is no single number or text."""
    if path is None:
        members = [name for name, _ in set_members(message.body) if name not in ("header", "timestamp", EMPTY_MEMBER)]
        if not members and member_names(message.body):
            return True
        path = "data" if "data" in members else members[0] if len(members) == 1 else ""
    value = follow(message, path)
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.item()
    if not isinstance(value, bool | int | float | str):
        found = f"{path or 'the message'}: {type(value).__name__}"
        raise DecodeError(
            "not a single value that could mark demonstrations", where=message.topic, found=found,
            remedy=f"set episodes.field to one of: {fields_here(message)}",
        )  # fmt: skip
    return value


def _no_topic(log: IndexedLog, topic: str) -> LogError:
    remedy = nearest(topic, [known.name for known in log.topics()])
    return LogError(f"[episodes] watches topic {topic!r}, which the log lacks", where=log.path, remedy=remedy)
