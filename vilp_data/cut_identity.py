"""What a demonstration that was cut out of a log is known by: its own messages, so that a log may grow, be salvaged or be written anew
around it. What holds in it from before is said in `held_messages.held_sha256`."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from vilp_data.errors import LogError
from vilp_data.keys import digest
from vilp_data.sources.channels import RawMessage
from vilp_data.types import TopicInfo

RULES_VERSION = 2
"""Raised when the same messages get another hash than before: what is remembered of logs then counts no more."""

_HEAD = struct.Struct("<QqI")


@runtime_checkable
class HoldsMessages(Protocol):
    """A log that gives its messages without decoding them, in order of log time; `by_topic` each with its topic."""

    def topics(self) -> list[TopicInfo]: ...

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]: ...

    def by_topic(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, RawMessage]]: ...


@dataclass(frozen=True)
class Cut:
    """[start_ns, end_ns) of a log's time, and the topics that were looked at, sorted."""

    start_ns: int
    end_ns: int
    topics: tuple[str, ...]

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> Cut | None:
        """What `EpisodeEntry.cut` says; None for an episode that is no cut."""
        return cls(int(table["start_ns"]), int(table["end_ns"]), tuple(table["topics"])) if table else None

    @property
    def range(self) -> tuple[int, int]:
        return self.start_ns, self.end_ns

    def to_json(self) -> dict[str, Any]:
        return {"start_ns": self.start_ns, "end_ns": self.end_ns, "topics": list(self.topics)}

    def overlap_ns(self, other: Cut) -> int:
        """How long both last at the same time; not positive where they do not."""
        return min(self.end_ns, other.end_ns) - max(self.start_ns, other.start_ns)


def cut_sha256(log: object, cut: Cut, native_sha256: str, remember: Callable[[str, Callable[[], Any]], Any]) -> str:
    """SHA-256 of the range and of what the log holds in it. Of a log of rows, or where the range cannot be read, what it holds is taken
    to be `native_sha256`, the hash of the log's own demonstration that the range lies in."""

    def find() -> str:
        held = native_sha256
        if isinstance(log, HoldsMessages):
            try:
                held = messages_sha256(log, cut.topics, start_ns=cut.start_ns, end_ns=cut.end_ns)
            except LogError:  # said when it is ingested
                held = native_sha256
        return digest({"cut": cut.to_json(), "held": held})

    return str(remember(digest(["cut", RULES_VERSION, cut.to_json(), native_sha256]), find))


def messages_sha256(
    log: HoldsMessages, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
) -> str:
    """SHA-256 of the messages of these topics in [start_ns, end_ns): topic by topic, with its name and type, as ingest reads them. How
    messages of several topics lie among each other is the writer's business, and so are the numbers of channels."""
    kinds = {topic.name: [topic.name, topic.schema, topic.encoding] for topic in log.topics()}
    hashes: dict[str, Any] = {}
    for topic, raw in log.by_topic(topics, start_ns=start_ns, end_ns=end_ns):
        sha = hashes.setdefault(topic, hashlib.sha256())
        sha.update(_HEAD.pack(raw.log_time_ns, raw.publish_time_ns, len(raw.data)))
        sha.update(raw.data)
    return digest([[*kinds[topic], hashes[topic].hexdigest()] for topic in sorted(hashes)])
