"""ROS 1 bags, uncompressed or in bz2 or lz4. One file is one episode."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from mcap.records import Schema

from vilp_data.sources.channels import WHOLE_FILE, Channel, Channels, RawMessage
from vilp_data.sources.rosbag1_file import BagChunk, Rosbag1File
from vilp_data.types import I64, LogEpisode, Message, TopicInfo

END_OF_TIME_NS = 1 << 63  # past every ROS 1 time stamp
INDEXED_CHUNKS = 5000  # index records read by message_times: about 4 GB of a bag


class Rosbag1Log:
    """A `LogReader` over one bag. Opening reads the index only; LogError where the bag has none, or is cut off.

    Publish times are not recorded: they are the log times. Chunks carry no checksum but that of bz2 and lz4."""

    format = "rosbag1"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = Rosbag1File(path)
        self._channels = Channels(
            path,
            {
                number: Channel(topic, "ros1", Schema(id=number, data=definition, encoding="ros1msg", name=name))
                for number, (topic, name, definition) in self._file.connections.items()
            },
        )
        self._glanced: tuple[int, list[RawMessage]] | None = None  # place and messages of the chunk last glanced at

    def sha256(self) -> str:
        digest = hashlib.sha256()
        self._file.pass_bytes_to(digest.update)
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        return self._channels.topics(self._file.counts())

    def metadata(self) -> dict[str, dict[str, str]]:
        return {}

    def episodes(self) -> list[LogEpisode]:
        """The whole bag as one; none where it holds no message."""
        filled = [chunk for chunk in self._file.chunks if any(chunk.counts.values())]
        if not filled:
            return []
        first_ns, last_ns = min(chunk.first_ns for chunk in filled), max(chunk.last_ns for chunk in filled)
        return [LogEpisode(WHOLE_FILE, first_ns, last_ns + 1)]

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """As `LogReader.messages`. After a MessageError the iterator can be asked for the next message."""
        connections = self._channels.ids_of(topics)
        self._channels.require_decoders(connections)  # an unreadable topic is refused before the first message of any
        raw = self._file.messages(connections, start_ns or 0, END_OF_TIME_NS if end_ns is None else end_ns)
        return map(self._channels.decoded, raw)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order, from the index; and whether they are all (else the first part).

        Of a topic with several connections the times are sorted: their order in the file is not told."""
        parts: dict[str, list[I64]] = {}
        for connection, values in self._file.message_times(INDEXED_CHUNKS).items():
            parts.setdefault(self._file.connections[connection].topic, []).append(values)
        times = {
            topic: found[0] if len(found) == 1 else np.sort(np.concatenate(found)) for topic, found in parts.items()
        }
        return times, len(self._file.chunks) <= INDEXED_CHUNKS

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` messages from the first chunk that holds the topic."""
        connections = self._channels.ids_of([topic])
        for chunk in self._file.chunks:
            if any(chunk.counts.get(connection) for connection in connections):
                found = [raw for raw in self._glance_at(chunk) if raw.channel_id in connections]
                return [self._channels.decoded(raw) for raw in found[:limit]]
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _glance_at(self, chunk: BagChunk) -> list[RawMessage]:
        """Every message of a chunk; the latest chunk is kept, for most topics are glanced at in the same one."""
        if self._glanced is None or self._glanced[0] != chunk.offset:
            self._glanced = chunk.offset, self._file.chunk_messages(chunk, self._file.connections)
        return self._glanced[1]
