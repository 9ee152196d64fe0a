"""The records inside an inflated chunk, whole or damaged. Pure: bytes in, places out."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode

from vilp_data.sources.mcap_records import MESSAGE_HEAD, RECORD_HEAD

_MESSAGE = re.compile(rb"(?=\x05.{5}\x00\x00\x00)", re.DOTALL)
_SMALLEST = RECORD_HEAD.size + MESSAGE_HEAD.size


class Entry(NamedTuple):
    """A message's place: its content lies at [begin, end) of the chunk's data."""

    channel_id: int
    begin: int
    end: int


@dataclass
class ChunkContents:
    """`entries`: channel -> (log time, offset) in file order; `definitions`: (opcode, begin, end) of schemas and channels; `places`:
    every message in file order. Everything before `end` was records that follow each other."""

    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    definitions: list[tuple[int, int, int]] = field(default_factory=list)
    places: list[Entry] = field(default_factory=list)
    end: int = 0

    def span(self) -> tuple[int, int]:
        """Log times of the earliest and the latest message."""
        times = [time for entries in self.entries.values() for time, _ in entries]
        return min(times), max(times)


def walk_chunk(data: bytes, begin: int = 0) -> ChunkContents:
    """The records of a chunk up to the first that makes no sense, or to the end."""
    contents, position, size = ChunkContents(), begin, len(data)
    entries, places = contents.entries, contents.places
    while position + 9 <= size:
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        content, end = position + 9, position + 9 + length
        if end > size:
            break
        if opcode == 5:
            if length < 22:
                break
            channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, content)
            if channel_id in entries:
                entries[channel_id].append((log_time, position))
            else:
                entries[channel_id] = [(log_time, position)]
            places.append(Entry(channel_id, content, end))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            contents.definitions.append((opcode, content, end))
        elif opcode < 0x80:
            break
        position = end
    contents.end = position
    return contents


def rescued_messages(
    data: bytes,
    contents: ChunkContents,
    index: Mapping[int, Collection[tuple[int, int]]],
    channels: Collection[int],
    span: tuple[int, int],
    *,
    suspicious: bool,
) -> Iterator[Entry]:
    """Messages of a chunk that is damaged or cut off.

    With the chunk's message index, those alone that it lists: channel, log time and place must agree. Without one, those that follow
    each other from the start, and behind damage those from where a run of messages of known channels, with log times in the chunk's
    own `span`, reaches the end of the data. Of a chunk that is only cut off (not `suspicious`) all are right as they are."""
    if index:
        yield from _listed(data, index)
        return
    for entry in contents.places:
        if not suspicious or _fits(data, entry.begin, channels, span):
            yield entry
    if contents.end < len(data) and suspicious:
        behind = _next_run(data, contents.end + 1, channels, span)
        yield from walk_chunk(data, behind).places


def _listed(data: bytes, index: Mapping[int, Collection[tuple[int, int]]]) -> Iterator[Entry]:
    expected = sorted((offset, channel_id, time) for channel_id, entries in index.items() for time, offset in entries)
    for number, (offset, channel_id, time) in enumerate(expected):
        if offset + _SMALLEST > len(data):
            return
        opcode, length = RECORD_HEAD.unpack_from(data, offset)
        begin, end = offset + RECORD_HEAD.size, offset + RECORD_HEAD.size + length
        following = expected[number + 1][0] if number + 1 < len(expected) else len(data)
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size or end > following:
            continue
        found_channel, _, found_time, _ = MESSAGE_HEAD.unpack_from(data, begin)
        if (found_channel, found_time) == (channel_id, time):
            yield Entry(channel_id, begin, end)


def _fits(data: bytes, begin: int, channels: Collection[int], span: tuple[int, int]) -> bool:
    channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, begin)
    return channel_id in channels and span[0] <= log_time <= span[1]


def _next_run(data: bytes, begin: int, channels: Collection[int], span: tuple[int, int]) -> int:
    """Where messages begin that follow each other to the end of the data; its length where none do."""
    for match in _MESSAGE.finditer(data, begin):
        place = match.start()
        if place + _SMALLEST > len(data):
            break
        content = place + RECORD_HEAD.size
        if not _fits(data, content, channels, span):
            continue
        run = walk_chunk(data, place)
        if (
            run.places
            and run.end == len(data)
            and all(_fits(data, entry.begin, channels, span) for entry in run.places)
        ):
            return place
    return len(data)
