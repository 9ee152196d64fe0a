"""The channels of one log, and what becomes of their messages: the part that MCAP files and bags have in common.

A channel is what a recorder wrote of one publisher: topic, encoding, schema. Several may carry one topic."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import NamedTuple

from mcap.records import Schema

from vilp_data.errors import LogError, nearest, reason
from vilp_data.sources.message_decoders import MALFORMED, ROS_ENCODINGS, Decoder, MessageError, decoder_for, ros_name
from vilp_data.types import Message, TopicInfo

WHOLE_FILE = "whole"
"""Name of the one demonstration in a log that holds one: a renamed log must still be known as the same."""


class RawMessage(NamedTuple):
    """A message as the file holds it: times in nanoseconds, data still serialised."""

    log_time_ns: int
    publish_time_ns: int
    channel_id: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """`encoding` is that of the messages (`cdr`, `ros1`, `protobuf`, `json`), `schema` what their types are in; None where the log
    has none."""

    topic: str
    encoding: str
    schema: Schema | None

    @property
    def schema_name(self) -> str:
        """The schema's name; ROS types always as `pkg/msg/Type`."""
        name = self.schema.name if self.schema else ""
        return ros_name(name) if self.encoding in ROS_ENCODINGS else name


class Channels:
    """Channels by id. `path` is what errors name, `distro` the ROS 2 release for types that the log does not define."""

    def __init__(self, path: PurePath, channels: Mapping[int, Channel], *, distro: str = "") -> None:
        self._path = path
        self._channels = channels
        self._distro = distro
        self._decoders: dict[int, Decoder] = {}
        self._shared: dict[
            tuple[str, int], Decoder
        ] = {}  # by encoding and schema: keelson's logs have 600 topics of one

    def ids_of(self, topics: Collection[str]) -> set[int]:
        """The channels of these topics; LogError where the log lacks one, with the nearest name."""
        known = {channel.topic for channel in self._channels.values()}
        for topic in topics:
            if topic not in known:
                raise LogError(f"no topic {topic!r} in this log", where=self._path, remedy=nearest(topic, known))
        return {channel_id for channel_id, channel in self._channels.items() if channel.topic in topics}

    def names(self) -> dict[int, str]:
        """Channel -> its topic."""
        return {channel_id: channel.topic for channel_id, channel in self._channels.items()}

    def topic_of(self, raw: RawMessage) -> str:
        return self._channels[raw.channel_id].topic

    def topics(self, counts: Mapping[int, int] | None) -> list[TopicInfo]:
        """Every topic, sorted by name; `counts` by channel, None where nothing tells them."""
        by_topic: dict[str, TopicInfo] = {}
        for channel_id, channel in self._channels.items():
            count = None if counts is None else counts.get(channel_id, 0)
            if (known := by_topic.get(channel.topic)) is not None and count is not None:
                count += known.message_count or 0
            by_topic[channel.topic] = TopicInfo(channel.topic, channel.schema_name, channel.encoding, count)
        return sorted(by_topic.values(), key=lambda topic: topic.name)

    def require_decoders(self, channel_ids: Collection[int]) -> None:
        """LogError where the messages of one of these channels cannot be read."""
        for channel_id in channel_ids:
            self._decoder(channel_id)

    def decoded(self, raw: RawMessage) -> Message:
        """The message of some bytes; MessageError where they do not fit its schema."""
        channel, decode = self._channels[raw.channel_id], self._decoder(raw.channel_id)
        try:
            body = decode(raw.data)
        except MALFORMED as error:
            raise MessageError(
                f"a message of {channel.topic} at {raw.log_time_ns} ns does not fit its schema",
                where=f"{self._path}, topic {channel.topic}",
                found=f"{channel.encoding} {channel.schema_name or '(no schema)'}, {len(raw.data)} bytes: {reason(error)}",
                remedy="leave the topic out of the task, or record it with a matching schema",
            ) from error
        return Message(channel.topic, channel.schema_name, raw.log_time_ns, raw.publish_time_ns, body)

    def _decoder(self, channel_id: int) -> Decoder:
        if channel_id not in self._decoders:
            channel = self._channels[channel_id]
            key = channel.encoding, channel.schema.id if channel.schema else 0
            if key not in self._shared:
                where = f"{self._path}, topic {channel.topic}"
                self._shared[key] = decoder_for(channel.encoding, channel.schema, where=where, distro=self._distro)
            self._decoders[channel_id] = self._shared[key]
        return self._decoders[channel_id]


class SerialisedLog:
    """What a `LogReader` is made of whose `raw_messages` are the serialised ones of `_channels`."""

    _channels: Channels

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; an unreadable topic is refused before the first of any."""
        raise NotImplementedError

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """As `LogReader.messages`. After a MessageError the iterator can be asked for the next message."""
        # `map` goes on after an error of `decoded`, which a generator would not.
        return map(self.decoded, self.raw_messages(topics, start_ns=start_ns, end_ns=end_ns))

    def by_topic(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, RawMessage]]:
        """The messages that `raw_messages` gives, each with its topic."""
        return ((self.topic_of(raw), raw) for raw in self.raw_messages(topics, start_ns=start_ns, end_ns=end_ns))

    def topic_of(self, raw: RawMessage) -> str:
        return self._channels.topic_of(raw)

    def decoded(self, raw: RawMessage) -> Message:
        """The message of some bytes; MessageError where they do not fit its schema."""
        return self._channels.decoded(raw)
