"""Messages of a damaged MCAP file into the clean one, each once something describes its channel.

A recorder describes channels before their messages; where that description is lost, another may follow, in the summary at the latest.
Until then a message's place is kept (16 bytes), not the message.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import NamedTuple

from vilp_data import limits
from vilp_data.salvage_report import SalvageReport
from vilp_data.sources.file_bytes import FileBytes
from vilp_data.sources.inflate import Inflated, inflate_prefix
from vilp_data.sources.mcap_chunk_records import Entry
from vilp_data.sources.mcap_clean import CleanMcap
from vilp_data.sources.mcap_descriptions import Descriptions
from vilp_data.sources.mcap_hints import Hints
from vilp_data.sources.mcap_plausible import ChunkHead
from vilp_data.sources.mcap_records import LAST_NS, MESSAGE_HEAD


def inflated(source: FileBytes, head: ChunkHead) -> Inflated:
    """What comes out of a chunk, up to what its header says, its end, or the end of the file."""
    packed_size = min(head.data_end, source.size) - head.data_begin
    packed = source.at(head.data_begin, min(packed_size, limits.CHUNK_BYTES))
    return inflate_prefix(packed, head.compression, min(head.size, limits.CHUNK_BYTES))


class _Waiting(NamedTuple):
    """Messages that nothing describes yet; `places`: where the content of each begins and ends, in turn, in the chunk's data or (None)
    in the file."""

    chunk: ChunkHead | None
    suspicious: bool
    verified: bool
    places: array[int]


class MessageWriter:
    """Writes messages and counts them by topic.

    suspicious   a checksum over the message fails, or nothing vouches for it in a file whose own checksum fails
    verified     the checksum of its chunk is right
    """

    def __init__(
        self,
        source: FileBytes,
        clean: CleanMcap,
        report: SalvageReport,
        descriptions: Descriptions,
        hints: Hints,
        *,
        drop_suspicious: bool,
    ) -> None:
        self._source = source
        self._clean = clean
        self._report = report
        self._descriptions = descriptions
        self._hints = hints
        self._drop = drop_suspicious
        self._waiting: list[_Waiting] = []

    def loose(self, begin: int, content: bytes) -> None:
        """A message outside chunks, whose record's content lies at byte `begin` of the file."""
        channel_id = MESSAGE_HEAD.unpack_from(content)[0]
        if self._descriptions.out_id(channel_id) is not None:
            self._write(channel_id, content, suspicious=False, verified=False)
            return
        if not self._waiting or self._waiting[-1].chunk is not None:
            self._waiting.append(_Waiting(None, False, False, array("q")))
        self._waiting[-1].places.extend((begin, begin + len(content)))

    def in_chunk(
        self, chunk: ChunkHead, data: bytes, messages: Iterable[Entry], *, suspicious: bool, verified: bool
    ) -> None:
        """Messages of a chunk that inflates to `data`."""
        waiting = _Waiting(chunk, suspicious, verified, array("q"))
        for channel_id, begin, end in messages:
            if self._descriptions.out_id(channel_id) is None:
                waiting.places.extend((begin, end))
            else:
                self._write(channel_id, data[begin:end], suspicious=suspicious, verified=verified)
        if waiting.places:
            self._waiting.append(waiting)

    def write_waiting(self) -> None:
        """Write what waited, now that every description there is has been seen, and say what nothing describes."""
        waiting, self._waiting = self._waiting, []
        self._descriptions.believe_damaged_chunks()
        lost: set[int] = set()
        for chunk, suspicious, verified, places in waiting:
            data = b"" if chunk is None else inflated(self._source, chunk).data
            for begin, end in zip(places[::2], places[1::2], strict=True):
                content = self._source.at(begin, end - begin) if chunk is None else data[begin:end]
                channel_id = MESSAGE_HEAD.unpack_from(content)[0]
                if self._descriptions.out_id(channel_id) is None:
                    lost.add(channel_id)
                else:
                    self._write(channel_id, content, suspicious=suspicious, verified=verified)
        if lost:
            self._report.amount_known = False
            numbers = ", ".join(map(str, sorted(lost)))
            self._report.doubt(
                f"messages of channel {numbers} are left out: the record that says what they are is lost"
            )

    def _write(self, channel_id: int, content: bytes, *, suspicious: bool, verified: bool) -> None:
        out = self._descriptions.out_id(channel_id)
        assert out is not None  # callers ask first
        vouched = verified and channel_id not in self._descriptions.unsure
        suspicious = suspicious or channel_id in self._descriptions.doubted
        suspicious = suspicious or (not verified and self._hints.data_is_intact is False)
        if suspicious and self._drop:
            self._report.suspicious_left_out += 1
            return
        topic = self._report.topic(*self._descriptions.topic_of(channel_id))
        log_time = MESSAGE_HEAD.unpack_from(content)[2]
        if log_time > LAST_NS:
            topic.known_lost += 1
            self._report.doubt("messages past the year 2262 are left out: their times are damaged")
            return
        topic.add(log_time, log_time, 1)
        topic.suspicious += suspicious
        topic.unverified += not (suspicious or vouched or self._hints.data_is_intact)
        self._clean.message(out, content)
