"""ROS 2 bags of several files, joined in time, and files of bags that are compressed whole. One bag is one episode.

Messages that rosbag2 compressed one by one are inflated where they are decoded (`message_decoders`)."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from heapq import heappop, heappush
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
import zstandard

from vilp_data.errors import LogError, copy_or_salvage, nearest
from vilp_data.sources.channels import WHOLE_FILE, RawMessage
from vilp_data.sources.db3_log import MAGIC as SQLITE_MAGIC
from vilp_data.sources.db3_log import Db3Log
from vilp_data.sources.file_bytes import first_bytes
from vilp_data.sources.folder_hash import file_sha256, folder_sha256
from vilp_data.sources.inflate import LARGEST_WINDOW
from vilp_data.sources.mcap_log import McapLog
from vilp_data.sources.mcap_records import MAGIC as MCAP_MAGIC
from vilp_data.sources.message_decoders import ZSTD_MAGIC
from vilp_data.sources.rosbag2_metadata import COMPRESSED_SUFFIX, missing_from_file, missing_messages, read_metadata
from vilp_data.types import EPISODE_RECORD, I64, LogEpisode, Message, TopicInfo

LISTED_TIMES = 1_000_000  # log times read by message_times, over all files
FREE_RATIO_BYTES = 1 << 30
LARGEST_RATIO = 2000
"""How much larger a file may become when inflated, beyond its first gigabyte: what zstd makes of a black camera, and more than of any
recording. It bounds what a small file can put on the disk."""

PartLog = McapLog | Db3Log


class Rosbag2Log:
    """A `LogReader` over a bag's folder (its metadata.yaml says which files, each MCAP or SQLite), or over one compressed file of a bag.

    Opening opens each file once and closes it again; a compressed one is inflated into a temporary folder (TMPDIR), and again when
    it is read, unless it is the only one. LogError where metadata.yaml or a file cannot be read."""

    format = "rosbag2"

    def __init__(self, path: Path) -> None:
        self.path = path
        self._metadata = read_metadata(path) if path.is_dir() else None
        files = self._metadata.files if self._metadata else (path,)
        self._stack = ExitStack()
        try:
            self._parts = [_Part(file, self._stack if len(files) == 1 else None) for file in files]
        except BaseException:
            self._stack.close()
            raise

    def sha256(self) -> str:
        return folder_sha256(self.path) if self.path.is_dir() else file_sha256(self.path)

    def topics(self) -> list[TopicInfo]:
        merged: dict[str, TopicInfo] = {}
        for topic in (topic for part in self._parts for topic in part.topics.values()):
            count = topic.message_count
            if (known := merged.get(topic.name)) is not None:
                count = None if count is None or known.message_count is None else count + known.message_count
            merged[topic.name] = TopicInfo(topic.name, topic.schema, topic.encoding, count)
        return sorted(merged.values(), key=lambda topic: topic.name)

    def metadata(self) -> dict[str, dict[str, str]]:
        """What the first file says of itself; the recorder's custom data as the record `episode`; release and compression."""
        with self._parts[0].opened() as log:
            records = log.metadata()
        records.pop("rosbag2", None)  # a copy of metadata.yaml, as it was when the first file was closed
        if self._metadata is not None:
            if self._metadata.custom:
                records[EPISODE_RECORD] = records.get(EPISODE_RECORD, {}) | self._metadata.custom
            stated = {"release": self._metadata.release, "compression": self._metadata.compression}
            records["bag"] = {"files": str(len(self._parts))} | {name: value for name, value in stated.items() if value}
        return records

    def episodes(self) -> list[LogEpisode]:
        """The whole bag as one; none where it holds no message. Tags are its `episode` metadata record."""
        spans = [part.span for part in self._parts if part.span is not None]
        if not spans:
            return []
        tags = self.metadata().get(EPISODE_RECORD, {})
        return [LogEpisode(WHOLE_FILE, min(first for first, _ in spans), max(end for _, end in spans), tags)]

    def doubts(self) -> list[str]:
        """Where the files hold other than as many messages as metadata.yaml counts."""
        if self._metadata is None:
            return missing_from_file(self.path, self._parts[0].count)
        return missing_messages(self._metadata, {part.path: part.count for part in self._parts})

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """As `LogReader.messages`. After a MessageError the iterator can be asked for the next message.

        An unreadable topic is refused before the first message where the first file with that topic tells so."""
        return map(_decoded, self._serialised(set(topics), start_ns, end_ns))

    def raw_messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages that `messages` gives, still serialised; channels are numbered in each file by itself."""
        return (message.raw for message in self._serialised(set(topics), start_ns, end_ns))

    def by_topic(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, RawMessage]]:
        """The messages that `raw_messages` gives, each with its topic."""
        return (
            (message.log.topic_of(message.raw), message.raw)
            for message in self._serialised(set(topics), start_ns, end_ns)
        )

    def message_times(self) -> tuple[dict[str, I64], bool]:
        """Topic -> log times [n], file after file; and whether they are all (else the first part)."""
        parts: dict[str, list[I64]] = {}
        listed, complete = 0, True
        for part in self._parts:
            if listed >= LISTED_TIMES:
                complete = False
                break
            with part.opened() as log:
                times, all_of_it = log.message_times()
            complete = complete and all_of_it
            for topic, values in times.items():
                parts.setdefault(topic, []).append(values)
                listed += len(values)
        return {topic: np.concatenate(found) for topic, found in parts.items()}, complete

    def first_messages(self, topic: str, limit: int) -> list[Message]:
        """Up to `limit` early messages from the first file that holds the topic."""
        for part in self._parts:
            if topic in part.topics and part.topics[topic].message_count != 0:
                with part.opened() as log:
                    if found := log.first_messages(topic, limit):
                        return found
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _serialised(self, topics: set[str], start_ns: int | None, end_ns: int | None) -> Iterator[_Serialised]:
        known = {name for part in self._parts for name in part.topics}
        for topic in sorted(topics - known):
            raise LogError(f"no topic {topic!r} in this log", where=self.path, remedy=nearest(topic, known))
        self._require_decoders(topics)
        return self._joined(topics, start_ns, end_ns)

    def _require_decoders(self, topics: set[str]) -> None:
        for part in self._parts:
            if here := topics.intersection(part.topics):
                with part.opened() as log:
                    log.raw_messages(here)
                topics = topics - here

    def _joined(self, topics: set[str], start_ns: int | None, end_ns: int | None) -> Iterator[_Serialised]:
        """The files' messages in order of log time, ties in the order of files. A file is open while its messages are due, so as
        many at a time as overlap."""
        waiting = sorted(
            (part.span[0], number)
            for number, part in enumerate(self._parts)
            if part.span is not None
            and topics.intersection(part.topics)
            and (start_ns is None or part.span[1] > start_ns)
            and (end_ns is None or part.span[0] < end_ns)
        )
        due: list[tuple[int, int, _Serialised, Iterator[_Serialised]]] = []
        while waiting or due:
            while waiting and (not due or waiting[0][0] <= due[0][0]):
                _, number = waiting.pop(0)
                _push(due, number, self._parts[number].serialised(topics, start_ns, end_ns))
            if due:
                _, number, message, rest = heappop(due)
                yield message
                _push(due, number, rest)


class _Serialised(NamedTuple):
    """A message that is not decoded yet, and the log that can."""

    log: PartLog
    raw: RawMessage


def _decoded(message: _Serialised) -> Message:
    return message.log.decoded(message.raw)


def _push(
    due: list[tuple[int, int, _Serialised, Iterator[_Serialised]]], number: int, rest: Iterator[_Serialised]
) -> None:
    message = next(rest, None)
    if message is not None:
        heappush(due, (message.raw.log_time_ns, number, message, rest))


class _Part:
    """One file of a bag: its topics by name, its span [first log time, last + 1), None where it holds no message, and how many it holds,
    None where nothing tells. Kept open by `stack`, else only while it is read."""

    def __init__(self, path: Path, stack: ExitStack | None) -> None:
        self.path = path
        self._kept = stack.enter_context(_open_part(path)) if stack is not None else None
        with self.opened() as log:
            self.topics = {topic.name: topic for topic in log.topics()}
            episodes = log.episodes()
        counts = [topic.message_count for topic in self.topics.values()]
        self.count = None if None in counts else sum(count or 0 for count in counts)
        self.span = (episodes[0].start_ns, episodes[0].end_ns) if episodes else None

    @contextmanager
    def opened(self) -> Iterator[PartLog]:
        if self._kept is not None:
            yield self._kept
        else:
            with _open_part(self.path) as log:
                yield log

    def serialised(self, topics: set[str], start_ns: int | None, end_ns: int | None) -> Iterator[_Serialised]:
        with self.opened() as log:
            for raw in log.raw_messages(topics.intersection(self.topics), start_ns=start_ns, end_ns=end_ns):
                yield _Serialised(log, raw)


@contextmanager
def _open_part(path: Path) -> Iterator[PartLog]:
    """The reader of one file of a bag, inflated before where it is compressed."""
    with ExitStack() as stack:
        file = path
        if first_bytes(path).startswith(ZSTD_MAGIC):
            folder = stack.enter_context(TemporaryDirectory(prefix="vilp-bag-"))
            file = Path(folder) / path.name.removesuffix(COMPRESSED_SUFFIX)
            _inflate_file(path, file)
        head = first_bytes(file)
        if head.startswith(MCAP_MAGIC):
            yield stack.enter_context(McapLog(file, named=path))
        elif head.startswith(SQLITE_MAGIC):
            yield stack.enter_context(Db3Log(file, named=path))
        else:
            found = f"it begins with {head!r}" if head else "0 bytes"
            raise LogError(
                "a file of the bag is neither MCAP nor SQLite", where=path, found=found, remedy=copy_or_salvage(path)
            )


def _inflate_file(packed: Path, plain: Path) -> None:
    largest = FREE_RATIO_BYTES + LARGEST_RATIO * packed.stat().st_size
    try:
        with packed.open("rb") as source, plain.open("wb") as target:
            reader = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW).stream_reader(
                source, read_across_frames=True
            )
            size = 0
            while block := reader.read(1 << 20):
                size += len(block)
                if size > largest:
                    raise LogError(
                        "a compressed file becomes larger than any recording",
                        where=packed,
                        found=f"more than {largest:,} bytes of {packed.stat().st_size:,}",
                        remedy="inflate it with `zstd -d` if you trust it",
                    )
                target.write(block)
    except zstandard.ZstdError as error:
        raise LogError(
            "the compressed file is damaged", where=packed, found=str(error), remedy=copy_or_salvage(packed)
        ) from error
    except OSError as error:
        remedy = "a compressed bag needs room in the temporary folder: set TMPDIR to one on a larger disk"
        raise LogError("cannot be inflated", where=packed, found=error.strerror, remedy=remedy) from error
