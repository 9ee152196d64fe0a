"""What a log holds, told quickly: topics, rates, gaps, image sizes, clocks. Reads the index and a few early messages, never all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.decode import decode_image, header_time_ns, image_encoding, is_image, is_wall_clock
from vilp_data.decode.depth import is_depth, is_grey16, measured_depth
from vilp_data.decode.video import VideoDecoder
from vilp_data.decode.video_packet import is_video, video_codec
from vilp_data.errors import VilpDataError, number_of
from vilp_data.message_rate import keeps_rate, rate_by_count
from vilp_data.sources import IndexedLog, open_log
from vilp_data.sources.folder_hash import log_files
from vilp_data.types import I64, Message, TopicInfo

SAMPLED = 20  # messages of a topic that are decoded
MOST_TOPICS = 60  # beyond it topics of one message are only counted in the terminal
FAR_APART_S = 1.0  # a header this far from the log time is worth a word
SHOWN_METADATA = 60  # characters of a metadata value in the terminal
RELATIVE = ("hdf5", "lerobot")  # formats that count time from the first demonstration's start
CLOCKS = {
    "wall": "wall clock",
    "simulated": "simulated clock",
    "relative": "counted from the first demonstration",
    "none": "the row's number over an assumed rate",
}


@dataclass(frozen=True)
class TopicSummary:
    """One topic. Figures that nothing tells are None: `note` then says why.

    n_messages      from the log's statistics
    rate_hz         1 / median interval of log times; of a topic that comes on events or in bursts, messages over the log's duration
    max_gap_s       the longest interval; backward_jumps how often log time fell
    image           `96x160 jpeg` for image topics, from the first image
    header_clock    "none", "wall", "simulated" (starting before the year 2000) or "zero" (stamps left unset)
    header_lag_s    median of log time minus header stamp over the first messages; positive where the recorder came later
    """

    name: str
    schema: str
    encoding: str
    n_messages: int | None
    rate_hz: float | None
    max_gap_s: float | None
    backward_jumps: int | None
    image: str | None
    header_clock: str | None
    header_lag_s: float | None
    note: str | None


@dataclass(frozen=True)
class LogSummary:
    """A whole log. `sampled` names the figures that rest on a part of it only; `doubts` are sentences on what seems to be missing.

    n_whole         how many of its episodes have all their files, where they are kept in files of their own; else None
    log_clock       "wall", "simulated" (starting before the year 2000), "relative" to the first demonstration's start, or "none"
                    for logs whose rows carry no time
    assumed_rate_hz the rate that stands in for time where rows carry none, so rates and durations follow from it; else None
    """

    path: str
    format: str
    size_bytes: int
    n_episodes: int
    n_whole: int | None
    start_ns: int | None
    duration_s: float
    log_clock: str
    assumed_rate_hz: float | None
    topics: tuple[TopicSummary, ...]
    metadata: dict[str, dict[str, str]]
    sampled: tuple[str, ...]
    doubts: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return asdict(self)


def summarise(path: Path, *, array_rate_hz: float = 10.0) -> LogSummary:
    """Look at a log. Raises what `open_log` raises; a topic that cannot be read is not an error but gets a note."""
    with open_log(path, array_rate_hz=array_rate_hz) as log:
        times, complete = log.message_times()
        episodes = log.episodes()
        start_ns = episodes[0].start_ns if episodes else None
        duration_s = (max(episode.end_ns for episode in episodes) - episodes[0].start_ns) / 1e9 if episodes else 0.0
        covered_s = duration_s if complete or start_ns is None else _covered_s(times, start_ns)
        starts_ns = np.array([episode.start_ns for episode in episodes], np.int64)
        topics = tuple(_topic(log, topic, times.get(topic.name), covered_s, starts_ns) for topic in log.topics())
        assumed_rate_hz = getattr(log, "assumed_rate_hz", None)
        return LogSummary(
            path=str(path),
            format=log.format,
            size_bytes=_size(path),
            n_episodes=len(episodes),
            n_whole=None if (whole := getattr(log, "whole", None)) is None else len(whole),
            start_ns=start_ns,
            duration_s=duration_s,
            log_clock=_log_clock(log.format, start_ns, assumed_rate_hz),
            assumed_rate_hz=assumed_rate_hz,
            topics=topics,
            metadata=log.metadata(),
            sampled=_sampled(complete, covered_s),
            doubts=tuple(log.doubts()),
        )


def _covered_s(times: dict[str, I64], start_ns: int) -> float:
    """How much of a log the times of its first part cover."""
    return (max((int(values.max()) for values in times.values() if len(values)), default=start_ns) - start_ns) / 1e9


def _sampled(complete: bool, covered_s: float) -> tuple[str, ...]:
    columns = f"image and header columns: the first {SAMPLED} messages of each topic at most"
    return (columns,) if complete else (f"rates and gaps: the first {covered_s:.0f} s", columns)


def _topic(log: IndexedLog, topic: TopicInfo, times: I64 | None, covered_s: float, starts_ns: I64) -> TopicSummary:
    rate_hz, max_gap_s, jumps = _intervals(times, covered_s, starts_ns)
    image = clock = lag_s = note = None
    if times is None and topic.message_count:
        note = "no message index: rate not known without reading the log"
    if topic.message_count != 0:
        try:
            messages = log.first_messages(topic.name, SAMPLED)
            clock, lag_s = _header_clock(messages)
            image = _image(messages)
        except VilpDataError as error:
            note = f"{error.what}: {error.found}" if error.found else error.what
    return TopicSummary(
        name=topic.name,
        schema=topic.schema,
        encoding=topic.encoding,
        n_messages=topic.message_count,
        rate_hz=rate_hz,
        max_gap_s=max_gap_s,
        backward_jumps=jumps,
        image=image,
        header_clock=clock,
        header_lag_s=lag_s,
        note=note,
    )


def _intervals(times: I64 | None, covered_s: float, starts_ns: I64) -> tuple[float | None, float | None, int | None]:
    """(rate, longest gap, backward jumps) of log times in file order, which cover so much time; no rate below two messages. What lies
    between two demonstrations, which begin at `starts_ns`, is no gap."""
    if times is None or len(times) < 2:
        return None, None, None if times is None else 0
    jumps = int((np.diff(times) < 0).sum())
    stamps = np.sort(times)
    within = np.diff(np.searchsorted(starts_ns, stamps, side="right")) == 0
    gaps_s = np.diff(stamps)[within] / 1e9
    rate_hz = 1 / float(np.median(gaps_s)) if keeps_rate(gaps_s) else rate_by_count(len(times), covered_s)
    return rate_hz, float(gaps_s.max()) if len(gaps_s) else None, jumps


def _image(messages: list[Message]) -> str | None:
    if not messages:
        return None
    first = messages[0]
    if is_video(first):
        return _video(messages)
    if not is_image(first):
        return None
    numbers = is_depth(first) or is_grey16(first)
    height, width = (measured_depth(first) if numbers else decode_image(first)).shape[:2]
    return f"{height}x{width} {image_encoding(first)}"


def _video(messages: list[Message]) -> str:
    """The size of the first picture that these packets give."""
    decoder, codec = VideoDecoder(), video_codec(messages[0])
    for number, message in enumerate(messages):
        for _, frame in decoder.feed(number, message):
            return f"{frame.height}x{frame.width} {codec}"
    for _, frame in decoder.rest():
        return f"{frame.height}x{frame.width} {codec}"
    return f"{codec}, no picture in the first {len(messages)} messages"


def _header_clock(messages: list[Message]) -> tuple[str | None, float | None]:
    """(kind of header clock, median log time minus header time in s)."""
    stamps = [(header, message.log_time_ns) for message in messages if (header := header_time_ns(message)) is not None]
    if not stamps:
        return ("none", None) if messages else (None, None)
    if not any(header for header, _ in stamps):
        return "zero", None
    return _clock_kind(stamps[0][0]), float(np.median([log_time - header for header, log_time in stamps])) / 1e9


def _log_clock(log_format: str, start_ns: int | None, assumed_rate_hz: float | None) -> str:
    if start_ns is None or assumed_rate_hz is not None:
        return "none"
    return "relative" if log_format in RELATIVE else _clock_kind(start_ns)


def _clock_kind(time_ns: int) -> str:
    return "wall" if is_wall_clock(time_ns) else "simulated"


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in log_files(path).values())


# --- for the terminal -----------------------------------------------------------------------------------------------


def format_summary(summary: LogSummary) -> str:
    """The summary as a table for the terminal, warnings about clocks below it."""
    duration = f"{summary.duration_s:.2f} s"
    episodes = number_of(summary.n_episodes, "episode")
    if summary.n_whole not in (None, summary.n_episodes):
        episodes, duration = f"{summary.n_whole} of {episodes} have all their files", f"{duration} listed"
    start = "" if summary.start_ns is None else f", from {summary.start_ns} ns ({CLOCKS[summary.log_clock]})"
    size = f"{summary.size_bytes / 1e6:.1f} MB"
    lines = [f"{summary.path}: {summary.format}, {size}, {episodes}, {duration}{start}", ""]
    head = ("topic", "schema", "encoding", "messages", "rate Hz", "max gap s", "image", "header clock", "lag s")
    shown = _shown(summary.topics)
    lines += _table([head, *(_row(topic) for topic in shown)])
    if folded := len(summary.topics) - len(shown):
        lines.append(f"and {number_of(folded, 'topic')} of one message or none (--json lists them)")
    lines += _section("Worth knowing", _warnings(summary))
    lines += _section("Metadata", _metadata_lines(summary.metadata))
    lines += _section("From a sample", summary.sampled)
    return "\n".join(lines)


def _shown(topics: Sequence[TopicSummary]) -> Sequence[TopicSummary]:
    """All of them; of very many only those that say something more than once, where there are such."""
    if len(topics) <= MOST_TOPICS:
        return topics
    return [topic for topic in topics if topic.n_messages is None or topic.n_messages > 1] or topics[:MOST_TOPICS]


def _row(topic: TopicSummary) -> tuple[str, ...]:
    return (
        topic.name,
        topic.schema,
        topic.encoding,
        "?" if topic.n_messages is None else str(topic.n_messages),
        _number(topic.rate_hz, ".1f"),
        _number(topic.max_gap_s, ".3f"),
        topic.image or "",
        topic.header_clock or "",
        _number(topic.header_lag_s, ".3f"),
    )


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _section(title: str, lines: Iterable[str]) -> list[str]:
    body = [f"  {line}" for line in lines]
    return ["", f"{title}:", *body] if body else []


def _warnings(summary: LogSummary) -> list[str]:
    lines = list(summary.doubts)
    if summary.log_clock == "simulated":
        lines.append("log time starts before the year 2000: simulated time, or a recorder whose clock was never set")
    if summary.assumed_rate_hz is not None:
        lines.append(
            f"its rows carry no time: {summary.assumed_rate_hz:g} rows a second are assumed, and rates, gaps and duration follow"
            " from that; a task's rate_hz takes their place"
        )
    for topic in summary.topics:
        if topic.note:
            lines.append(f"{topic.name}: {topic.note}")
        if topic.backward_jumps:
            lines.append(
                f"{topic.name}: log time falls {topic.backward_jumps} times; messages are read in order of log time"
            )
        if topic.header_clock == "zero":
            lines.append(f'{topic.name}: header stamps are all zero; set clock = "log" for it')
        if topic.header_clock == "simulated" and summary.log_clock == "wall":
            lines.append(
                f"{topic.name}: header stamps are simulated time, log time is wall time; do not mix them in one task"
            )
        elif topic.header_lag_s is not None and abs(topic.header_lag_s) > FAR_APART_S:
            lines.append(f"{topic.name}: {header_gap(topic.header_lag_s)}; another clock?")
    return lines


def header_gap(lag_s: float) -> str:
    """How far header stamps lie from log time, in words. `lag_s`: log time minus header stamp."""
    return f"header stamps lie {abs(lag_s):.1f} s {'before' if lag_s >= 0 else 'after'} log time"


def _metadata_lines(metadata: dict[str, dict[str, str]]) -> list[str]:
    return [
        f"{name}.{key} = {value[:SHOWN_METADATA]!r}{' …' if len(value) > SHOWN_METADATA else ''}"
        for name, record in sorted(metadata.items())
        for key, value in sorted(record.items())
    ]
