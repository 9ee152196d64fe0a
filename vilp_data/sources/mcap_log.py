"""MCAP logs: ROS 2 CDR, Foxglove protobuf and JSON messages. One file is one episode."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from mcap.records import ChunkIndex

from vilp_data.errors import LogError, nearest
from vilp_data.sources.mcap_file import McapFile, RawMessage
from vilp_data.sources.message_decoders import MALFORMED, Decoder, MessageError, decoder_for
from vilp_data.types import EPISODE_RECORD, I64, LogEpisode, Message, TopicInfo

END_OF_TIME_NS = 1 << 64  # past every MCAP time stamp
WHOLE_FILE = "whole"  # the one demonstration's name: a renamed log must still be known as the same
INDEXED_CHUNKS = 5000  # message indexes read by message_times: about 0.3 s


class _OpenChannel(NamedTuple):
    """A channel whose messages can be read."""

    topic: str
    schema: str
    encoding: str
    decode: Decoder


class McapLog:
    """A `LogReader` over one MCAP file. Opening reads the index only; LogError where the file is cut off or its index damaged."""

    format = "mcap"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = McapFile(path)
        self._channels: dict[int, _OpenChannel] = {}
        self._decoders: dict[tuple[str, int], Decoder] = {}  # by message encoding and schema id
        self._glanced: tuple[int, list[RawMessage]] | None = None  # place and messages of the chunk last glanced at

    def sha256(self) -> str:
        digest = hashlib.sha256()
        self._file.pass_bytes_to(digest.update)
        return digest.hexdigest()

    def topics(self) -> list[TopicInfo]:
        by_topic: dict[str, TopicInfo] = {}
        index = self._file.index
        for channel_id, channel in index.channels.items():
            schema = index.schemas.get(channel.schema_id)
            count = None if index.counts is None else index.counts[channel_id]
            if (known := by_topic.get(channel.topic)) is not None and count is not None:
                count += known.message_count or 0
            by_topic[channel.topic] = TopicInfo(
                channel.topic, schema.name if schema else "", channel.message_encoding, count
            )
        return sorted(by_topic.values(), key=lambda topic: topic.name)

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
        channel_ids = self._channels_of(topics)
        start = 0 if start_ns is None else start_ns
        end = END_OF_TIME_NS if end_ns is None else end_ns
        for channel_id in channel_ids:
            self._opened(channel_id)  # an unreadable topic is refused before the first message of any
        # `map` goes on after an error of `_decoded`, which a generator would not.
        return map(self._decoded, self._file.messages(channel_ids, start, end))

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
        channel_ids = self._channels_of([topic])
        for chunk in self._file.index.chunks:
            if chunk.message_index_offsets and channel_ids.isdisjoint(chunk.message_index_offsets):
                continue
            found = [raw for raw in self._glance_at(chunk) if raw.channel_id in channel_ids]
            if found:
                return [self._decoded(raw) for raw in found[:limit]]
        loose = self._file.messages(channel_ids, 0, END_OF_TIME_NS) if self._file.index.loose else iter(())
        return [self._decoded(raw) for raw in islice(loose, limit)]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _channels_of(self, topics: Collection[str]) -> set[int]:
        channels = self._file.index.channels
        known = {channel.topic for channel in channels.values()}
        for topic in topics:
            if topic not in known:
                raise LogError(f"no topic {topic!r} in this log", where=self.path, remedy=nearest(topic, known))
        return {channel_id for channel_id, channel in channels.items() if channel.topic in topics}

    def _glance_at(self, chunk: ChunkIndex) -> list[RawMessage]:
        """Every message of a chunk; the latest chunk is kept, for most topics are glanced at in the same one."""
        if self._glanced is None or self._glanced[0] != chunk.chunk_start_offset:
            found = self._file.chunk_messages(chunk, self._file.index.channels, 0, END_OF_TIME_NS)
            self._glanced = chunk.chunk_start_offset, found
        return self._glanced[1]

    def _opened(self, channel_id: int) -> _OpenChannel:
        """The channel with its decoder; LogError where its messages cannot be read."""
        if channel_id not in self._channels:
            channel = self._file.index.channels[channel_id]
            schema = self._file.index.schemas.get(channel.schema_id)
            key = channel.message_encoding, channel.schema_id
            if key not in self._decoders:
                where = f"{self.path}, topic {channel.topic}"
                self._decoders[key] = decoder_for(channel.message_encoding, schema, where=where)
            name = schema.name if schema else ""
            self._channels[channel_id] = _OpenChannel(
                channel.topic, name, channel.message_encoding, self._decoders[key]
            )
        return self._channels[channel_id]

    def _decoded(self, raw: RawMessage) -> Message:
        channel = self._opened(raw.channel_id)
        try:
            body = channel.decode(raw.data)
        except MALFORMED as error:
            raise MessageError(
                f"a message of {channel.topic} at {raw.log_time_ns} ns does not fit its schema",
                where=f"{self.path}, topic {channel.topic}",
                found=f"{channel.encoding} {channel.schema or '(no schema)'}, {len(raw.data)} bytes: {error}",
                remedy="leave the topic out of the task, or record it with a matching schema",
            ) from error
        return Message(channel.topic, channel.schema, raw.log_time_ns, raw.publish_time_ns, body)
