"""What holds in a demonstration although it was said before it: static transforms, and the last word on each topic of vectors.

A demonstration that is cut out of the middle of a log begins with a command in force and with states that are known. Only what came
in the same demonstration of the log's own is looked for: the rows of another one are another robot's past.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from vilp_data.cut_identity import RULES_VERSION, HoldsMessages, messages_sha256
from vilp_data.decode.vectors import concerns
from vilp_data.errors import DecodeError, LogError
from vilp_data.keys import digest
from vilp_data.sources import IndexedLog
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.topic_times import times_in_index
from vilp_data.transforms import STATIC
from vilp_data.types import I64, LogEpisode, Message
from vilp_data.vector_tracks import VectorTable, reads_transforms, vector_tables
from vilp_data.video_start import packets_before

LEAST_LOOK_S = 1.0
"""Stamps lie this much before the recorder's time at most, as a rule: what was said in the first image's instant may have arrived
before the cut."""

LONGEST_LOOK_S = 64.0
"""How far back a command is looked for where the log's index does not tell when the last one came, or not of which joint."""

_static: WeakKeyDictionary[IndexedLog, dict[str, list[Message]]] = WeakKeyDictionary()
_static_sha256: WeakKeyDictionary[IndexedLog, dict[str, str]] = WeakKeyDictionary()
_times: WeakKeyDictionary[IndexedLog, dict[str, I64 | None]] = WeakKeyDictionary()


def static_messages(log: IndexedLog, topics: Collection[str]) -> Iterator[Message]:
    """Every message of these topics in the log, read once for all of its demonstrations. Static transforms are few."""
    known = _static.setdefault(log, {})
    have = {topic.name for topic in log.topics() if topic.message_count != 0}
    for topic in sorted(have.intersection(topics)):
        if topic not in known:
            known[topic] = list(log.messages([topic]))
        yield from known[topic]


def messages_before(
    log: IndexedLog, demonstration: LogEpisode, spec: TaskSpec, topics: Collection[str]
) -> Iterator[Message]:
    """Messages of `topics` from before the demonstration, in order of time on each: as far back as one may still count, and of absolute
    commands so far that there is a last one, if any was ever given."""
    begin_ns = _begin_of_native(log, demonstration)
    for topic in topics:
        tables = [table for table in vector_tables(spec).values() if table.topic == topic]
        if tables and begin_ns < demonstration.start_ns:
            yield from _look_back(log, topic, tables, begin_ns, demonstration.start_ns)


def _begin_of_native(log: IndexedLog, demonstration: LogEpisode) -> int:
    """Where the log's own demonstration begins that this one is cut from."""
    starts = (native.start_ns for native in log.episodes() if native.start_ns <= demonstration.start_ns < native.end_ns)
    return max(starts, default=demonstration.start_ns)


def _look_back(log: IndexedLog, topic: str, tables: list[VectorTable], begin_ns: int, end_ns: int) -> Iterator[Message]:
    look_s = max([LEAST_LOOK_S, *(table.stale_after_s for table in tables if isinstance(table, VectorSpec))])
    commands = [table for table in tables if isinstance(table, ActionSpec) and table.kind == "absolute"]
    found: list[Message] = []
    from_ns = end_ns
    while look_s and from_ns > begin_ns:
        until_ns, from_ns = from_ns, max(begin_ns, from_ns - round(look_s * 1e9))
        found = [*log.messages([topic], start_ns=from_ns, end_ns=until_ns), *found]
        if _all_told(commands, found):
            break
        looked_s = (end_ns - from_ns) / 1e9
        look_s = 3 * looked_s if 4 * looked_s <= LONGEST_LOOK_S else 0.0
        if not found and (silent_s := _silence_s(log, topic, begin_ns, from_ns)) is not None:
            look_s = silent_s
    yield from found


def _all_told(commands: list[ActionSpec], found: list[Message]) -> bool:
    """Whether each command has a message; the way between two frames takes many, and nobody tells which."""
    return all(
        not reads_transforms(command) and any(concerns(message, command.names) for message in found)
        for command in commands
    )


def _silence_s(log: IndexedLog, topic: str, begin_ns: int, from_ns: int) -> float | None:
    """How far back a topic's last message before `from_ns` lies, and a little more, as publishers come in groups; 0 where there is none,
    None where the index does not tell."""
    known = _times.setdefault(log, {})
    if topic not in known:
        found = times_in_index(log, [topic]).get(topic)
        known[topic] = None if found is None else np.sort(found)
    times_ns = known[topic]
    if times_ns is None:
        return None
    place = int(np.searchsorted(times_ns, from_ns))
    last_ns = int(times_ns[place - 1]) if place else begin_ns - 1
    return (from_ns - last_ns) / 1e9 + LEAST_LOOK_S if last_ns >= begin_ns else 0.0


# --- what a cut is made of besides its own messages ----------------------------------------------------------------------------


def held_sha256(
    log: IndexedLog, demonstration: LogEpisode, spec: TaskSpec, native_sha256: str,
    remember: Callable[[str, Callable[[], Any]], Any],
) -> str:  # fmt: skip
    """SHA-256 of what the log holds outside a cut's range and an ingest of the cut takes in: static transforms, what was said shortly
    before, the packets and parameters that a video's decoder needs first. "" where that is nothing, and of a log of rows, whose
    `native_sha256` tells. Where it cannot be read, it is taken to be that hash too."""

    def find() -> str:
        if not isinstance(log, HoldsMessages):
            return ""
        try:
            held = _held(log, log, demonstration, spec)
        except (LogError, DecodeError):  # said when it is ingested
            return native_sha256
        return digest(held) if held else ""

    span = [demonstration.start_ns, demonstration.end_ns]
    return str(remember(digest(["held", RULES_VERSION, span, spec.ingest_fields(), native_sha256]), find))


def _held(log: IndexedLog, raw: HoldsMessages, demonstration: LogEpisode, spec: TaskSpec) -> dict[str, Any]:
    """By topic. What is decoded only says from when on messages count; these are then hashed as they lie in the log."""
    have = {topic.name for topic in log.topics() if topic.message_count != 0}
    tables = vector_tables(spec).values()
    held: dict[str, Any] = {
        topic: _static_hash(log, raw, topic)
        for topic in sorted(have & {f"{table.topic}{STATIC}" for table in tables if reads_transforms(table)})
    }
    for topic in sorted(have.intersection(spec.topics())):
        first = next(messages_before(log, demonstration, spec, [topic]), None)
        if first is not None:
            held[topic] = _from(raw, topic, first, demonstration)
    for topic in sorted(have & {view.topic for view in spec.views.values()}):
        start = packets_before(log, topic, demonstration)
        if start is not None:
            first = next(iter(start.packets), None)
            parameters = [[kind, data.hex()] for kind, data in sorted(start.parameters.items())]
            held[topic] = [parameters, "" if first is None else _from(raw, topic, first, demonstration)]
    return held


def _from(raw: HoldsMessages, topic: str, first: Message, demonstration: LogEpisode) -> str:
    return messages_sha256(raw, [topic], start_ns=first.log_time_ns, end_ns=demonstration.start_ns)


def _static_hash(log: IndexedLog, raw: HoldsMessages, topic: str) -> str:
    known = _static_sha256.setdefault(log, {})
    if topic not in known:
        known[topic] = messages_sha256(raw, [topic])
    return known[topic]
