"""Logs that keep their messages in chunks, in order of log time: the part that MCAP files and ROS 1 bags have in common."""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from vilp_data.errors import LogError
from vilp_data.sources.channels import WHOLE_FILE, Channel, Channels, RawMessage, SerialisedLog
from vilp_data.sources.rosbag2_metadata import missing_from_file
from vilp_data.types import EPISODE_RECORD, I64, LogEpisode, Message, TopicInfo

END_OF_TIME_NS = 1 << 64  # past every time stamp of either format
INDEXED_CHUNKS = 5000  # whose indexes message_times reads: 0.3 s, and some gigabytes of a log

_log_time = attrgetter("log_time_ns")


@dataclass(frozen=True, slots=True)
class MessageChunk:
    """Messages that are read together: log times of the first and the last; the channels that have messages in it, None where nothing
    tells."""

    offset: int
    first_ns: int
    last_ns: int
    channels: Collection[int] | None

    def may_hold(self, channel_ids: Collection[int]) -> bool:
        return self.channels is None or any(channel_id in self.channels for channel_id in channel_ids)


class ChunkedFile(Protocol):
    """An open file. `chunks` in file order; `counts` (channel id -> messages) as its index tells them, else None; `span`: log times of the
    first and the last message, None where there is none."""

    @property
    def chunks(self) -> Sequence[Any]: ...
    @property
    def counts(self) -> Mapping[int, int] | None: ...
    @property
    def span(self) -> tuple[int, int] | None: ...

    def chunk_messages(self, chunk: Any, channel_ids: Collection[int], start_ns: int, end_ns: int) -> list[RawMessage]:
        """Messages of these channels with start_ns <= log time < end_ns, in file order, the chunk's checksum verified."""
        ...

    def chunk_times(self, chunk: Any) -> Mapping[int, I64] | None:
        """Channel id -> log times [n] in file order, without inflating the chunk; None where the file has no index of it."""
        ...

    def pass_bytes_to(self, update: Callable[[bytes], object]) -> None:
        """Hand every byte of the file to `update`, in order."""
        ...

    def damaged(self, where: str, found: str) -> LogError: ...
    def close(self) -> None: ...


File = TypeVar("File", bound=ChunkedFile)


class ChunkedLog(SerialisedLog, Generic[File]):
    """A `LogReader` over one open file, which it closes. The file is one episode."""

    def __init__(self, path: Path, file: File, channels: Mapping[int, Channel]) -> None:
        self.path = path
        self._file = file
        self._channels = Channels(path, channels)
        self._held: tuple[int, list[RawMessage]] | None = None  # place and messages of the chunk that is kept

    def sha256(self) -> str:
        digest = hashlib.sha256()
        self._file.pass_bytes_to(digest.update)
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        return self._channels.topics(self._file.counts)

    def metadata(self) -> dict[str, dict[str, str]]:
        return {}

    def episodes(self) -> list[LogEpisode]:
        """The whole file as one; none where it holds no message. Tags are its `episode` metadata record."""
        if self._file.span is None:
            return []
        first_ns, last_ns = self._file.span
        return [LogEpisode(WHOLE_FILE, first_ns, last_ns + 1, self.metadata().get(EPISODE_RECORD, {}))]

    def doubts(self) -> list[str]:
        """Where the file is a part of a bag whose metadata.yaml counts other than as many messages in it."""
        counts = self._file.counts
        return missing_from_file(self.path, None if counts is None else sum(counts.values()))

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; an unreadable topic is refused before the first of any."""
        channel_ids = self._channels.ids_of(topics)
        self._channels.require_decoders(channel_ids)
        return self.in_order(channel_ids, start_ns or 0, END_OF_TIME_NS if end_ns is None else end_ns)

    def in_order(self, channel_ids: Collection[int], start_ns: int, end_ns: int) -> Iterator[RawMessage]:
        """Messages of these channels with start_ns <= log time < end_ns, by log time, ties as they lie in the file.

        Memory holds one chunk, and those that overlap it in time. Where the whole file was asked for, the messages found are counted
        against the file's own index at the end: LogError where they are others."""
        seen: Counter[int] = Counter()
        wanted = [
            chunk
            for chunk in self._file.chunks
            if chunk.first_ns < end_ns and chunk.last_ns >= start_ns and chunk.may_hold(channel_ids)
        ]
        pending: list[RawMessage] = []
        for chunk in sorted(wanted, key=lambda chunk: (chunk.first_ns, chunk.offset)):
            ready = bisect_right(pending, chunk.first_ns, key=_log_time)
            yield from pending[:ready]
            found = self._file.chunk_messages(chunk, channel_ids, start_ns, end_ns)
            seen.update(message.channel_id for message in found)
            pending = pending[ready:] + found
            pending.sort(key=_log_time)  # stable, and nearly in order already
        yield from pending
        first_ns, last_ns = self._file.span or (0, 0)
        if start_ns <= first_ns and last_ns < end_ns:
            self._compare_counts(seen, channel_ids)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order, from the indexes of the chunks; and whether they are all (else the first part).

        Of a topic with several channels, as merging logs leaves them, the times are sorted: their order in the file is not told."""
        parts: dict[int, list[I64]] = {}
        read = 0
        for chunk in self._file.chunks[:INDEXED_CHUNKS]:
            times = self._file.chunk_times(chunk)
            if times is None:
                break
            read += 1
            for channel_id, values in times.items():
                parts.setdefault(channel_id, []).append(values)
        found = {channel_id: np.concatenate(values) for channel_id, values in parts.items()}
        by_topic: dict[str, list[I64]] = {}
        for channel_id, topic in self._channels.names().items():
            if channel_id in found:
                by_topic.setdefault(topic, []).append(found[channel_id])
        joined = {
            topic: values[0] if len(values) == 1 else np.sort(np.concatenate(values))
            for topic, values in by_topic.items()
        }
        return joined, read == len(self._file.chunks) and self._are_all(found)

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` messages from the first chunk that holds the topic: opens that one alone, where the index tells which it is."""
        channel_ids = self._channels.ids_of([topic])
        for chunk in self._file.chunks:
            if chunk.may_hold(channel_ids):
                found = [raw for raw in self._all_of(chunk) if raw.channel_id in channel_ids]
                if found:
                    return [self.decoded(raw) for raw in found[:limit]]
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _compare_counts(self, seen: Counter[int], channel_ids: Collection[int]) -> None:
        if (counts := self._file.counts) is None:
            return
        for channel_id in channel_ids:
            if counts.get(channel_id, 0) != seen[channel_id]:
                found = f"{seen[channel_id]} messages where the file's own index counts {counts.get(channel_id, 0)}"
                raise self._file.damaged(f"topic {self._channels.names()[channel_id]}", found)

    def _are_all(self, times: Mapping[int, I64]) -> bool:
        """Whether as many times are known as the file counts messages; True where it counts none."""
        counts = self._file.counts
        return counts is None or all(len(times.get(channel_id, ())) == count for channel_id, count in counts.items())

    def _all_of(self, chunk: MessageChunk) -> list[RawMessage]:
        """Every message of a chunk; the latest chunk is kept, for most topics are first met in the same one."""
        if self._held is None or self._held[0] != chunk.offset:
            every = self._channels.names()
            self._held = chunk.offset, self._file.chunk_messages(chunk, every, 0, END_OF_TIME_NS)
        return self._held[1]
