"""MCAP logs: ROS 1 and ROS 2 messages, Foxglove protobuf and JSON. One file is one episode."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from mcap.records import ChunkIndex

from vilp_data.sources.channels import WHOLE_FILE, Channel, Channels, RawMessage
from vilp_data.sources.mcap_file import McapFile
from vilp_data.types import EPISODE_RECORD, I64, LogEpisode, Message, TopicInfo

END_OF_TIME_NS = 1 << 64  # past every MCAP time stamp
INDEXED_CHUNKS = 5000  # message indexes read by message_times: about 0.3 s


class McapLog:
    """A `LogReader` over one MCAP file. Opening reads the index only; LogError where the file is cut off or its index damaged.

    `named` is the path that errors name, where the file is an inflated copy of another."""

    format = "mcap"

    def __init__(self, path: Path, *, named: Path | None = None) -> None:
        self.path = named or path
        self._file = McapFile(path, named=self.path)
        index = self._file.index
        self._channels = Channels(
            self.path,
            {
                channel_id: Channel(channel.topic, channel.message_encoding, index.schemas.get(channel.schema_id))
                for channel_id, channel in index.channels.items()
            },
        )
        self._glanced: tuple[int, list[RawMessage]] | None = None  # place and messages of the chunk last glanced at

    def sha256(self) -> str:
        digest = hashlib.sha256()
        self._file.pass_bytes_to(digest.update)
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        return self._channels.topics(self._file.index.counts)

    def metadata(self) -> dict[str, dict[str, str]]:
        return self._file.metadata()

    def episodes(self) -> list[LogEpisode]:
        """The whole file as one; none where it holds no message. Tags are its `episode` metadata record."""
        index = self._file.index
        if index.first_ns is None or index.last_ns is None:
            return []
        return [LogEpisode(WHOLE_FILE, index.first_ns, index.last_ns + 1, self.metadata().get(EPISODE_RECORD, {}))]

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """As `LogReader.messages`. After a MessageError the iterator can be asked for the next message."""
        # `map` goes on after an error of `decoded`, which a generator would not.
        return map(self.decoded, self.raw_messages(topics, start_ns=start_ns, end_ns=end_ns))

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; an unreadable topic is refused before the first of any."""
        channel_ids = self._channels.ids_of(topics)
        self._channels.require_decoders(channel_ids)
        return self._file.messages(channel_ids, start_ns or 0, END_OF_TIME_NS if end_ns is None else end_ns)

    def decoded(self, raw: RawMessage) -> Message:
        """The message of some bytes; MessageError where they do not fit its schema."""
        return self._channels.decoded(raw)

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n] in file order, from the message indexes; and whether they are all (else the first part).

        Of a topic with several channels, as merging logs leaves them, the times are sorted: their order in the file is not told."""
        channels = self._file.index.channels
        parts: dict[str, list[I64]] = {}
        for channel_id, values in self._file.message_times(INDEXED_CHUNKS).items():
            if channel_id in channels:
                parts.setdefault(channels[channel_id].topic, []).append(values)
        times = {
            topic: found[0] if len(found) == 1 else np.sort(np.concatenate(found)) for topic, found in parts.items()
        }
        return times, len(self._file.index.chunks) <= INDEXED_CHUNKS

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` messages from the first chunk that holds the topic: a glance that opens one chunk."""
        channel_ids = self._channels.ids_of([topic])
        for chunk in self._file.index.chunks:
            if chunk.message_index_offsets and channel_ids.isdisjoint(chunk.message_index_offsets):
                continue
            found = [raw for raw in self._glance_at(chunk) if raw.channel_id in channel_ids]
            if found:
                return [self.decoded(raw) for raw in found[:limit]]
        loose = self._file.messages(channel_ids, 0, END_OF_TIME_NS) if self._file.index.loose else iter(())
        return [self.decoded(raw) for raw in islice(loose, limit)]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _glance_at(self, chunk: ChunkIndex) -> list[RawMessage]:
        """Every message of a chunk; the latest chunk is kept, for most topics are glanced at in the same one."""
        if self._glanced is None or self._glanced[0] != chunk.chunk_start_offset:
            found = self._file.chunk_messages(chunk, self._file.index.channels, 0, END_OF_TIME_NS)
            self._glanced = chunk.chunk_start_offset, found
        return self._glanced[1]
