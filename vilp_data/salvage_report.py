"""What a salvage got back and what it did not: counts by topic, bytes passed over, in words. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from vilp_data.errors import number_of

SHOWN_PLACES = 12


@dataclass
class TopicLoss:
    """One topic. Times are log times of what was recovered.

    suspicious  recovered from bytes whose checksum fails; they are in the output unless they were to be left out
    unverified  recovered from bytes that no checksum covers, in a log that is not whole
    lost        None where nothing tells how many; then at least `known_lost`
    """

    name: str
    schema: str = ""
    recovered: int = 0
    suspicious: int = 0
    unverified: int = 0
    known_lost: int = 0
    lost: int | None = 0
    start_ns: int | None = None
    end_ns: int | None = None

    def add(self, first_ns: int, last_ns: int, count: int) -> None:
        self.recovered += count
        self.start_ns = first_ns if self.start_ns is None else min(self.start_ns, first_ns)
        self.end_ns = last_ns if self.end_ns is None else max(self.end_ns, last_ns)


@dataclass(frozen=True)
class Skipped:
    """Bytes of the log that gave nothing."""

    begin: int
    end: int
    what: str


@dataclass
class SalvageReport:
    """A whole salvage. `complete`: nothing was lost, and nothing is in doubt. `whole`: the log had no damage at all."""

    source: str
    output: str
    format: str
    size_bytes: int
    whole: bool = False
    repaired: str = ""
    topics: dict[str, TopicLoss] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)
    attachments: int = 0
    attachments_lost: int = 0
    attachments_suspicious: int = 0
    metadata_records: int = 0
    suspicious_left_out: int = 0
    ended: bool = False
    """The log's own end was found, so nothing was written after what is here."""
    amount_known: bool = True
    """Every loss could be counted."""
    expected: dict[str, int] | None = None
    """Messages by topic as the log's own statistics count them."""
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    """Notes that keep the salvage from being complete."""

    # --- while reading

    def topic(self, name: str, schema: str = "") -> TopicLoss:
        if name not in self.topics:
            self.topics[name] = TopicLoss(name, schema)
        return self.topics[name]

    def skip(self, begin: int, end: int, what: str) -> None:
        """Bytes that gave nothing; neighbours of one kind are joined."""
        if end <= begin:
            return
        if self.skipped and self.skipped[-1].end == begin and self.skipped[-1].what == what:
            begin = self.skipped.pop().begin
        self.skipped.append(Skipped(begin, end, what))

    def lose(self, begin: int, end: int, what: str, *, messages: bool = True) -> None:
        """Bytes that gave nothing, and may have held messages (or else `messages` is False): behind the log's end there are none."""
        self.skip(begin, end, f"{what}; behind the last message, where a log keeps none" if self.ended else what)
        if messages and not self.ended:
            self.amount_known = False
            self.doubt("bytes are missing or unreadable where the log keeps its messages")

    def doubt(self, text: str) -> None:
        if text not in self.doubts:
            self.doubts.append(text)

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def settle(self) -> None:
        """Once all is read: what each topic lost, and whether the log is whole."""
        for name in self.expected or {}:
            self.topic(name)
        for topic in self.topics.values():
            expected = None if self.expected is None else self.expected.get(topic.name, 0)
            if expected is not None and topic.recovered > expected:
                surplus = f"{topic.name}: {number_of(topic.recovered, 'message')} where the log's own statistics count {expected:,}"
                self.doubt(surplus)
            if expected is not None and expected >= topic.recovered:
                topic.lost = topic.known_lost = expected - topic.recovered
            else:
                topic.lost = topic.known_lost if self.amount_known and self.ended else None
        self.topics = dict(sorted(self.topics.items()))
        self.whole = self.complete and not self.notes and not self.skipped
        if self.whole:
            for topic in self.topics.values():
                topic.unverified = 0

    # --- when done

    @property
    def recovered(self) -> int:
        return sum(topic.recovered for topic in self.topics.values())

    @property
    def suspicious(self) -> int:
        return sum(topic.suspicious for topic in self.topics.values())

    @property
    def unverified(self) -> int:
        return sum(topic.unverified for topic in self.topics.values())

    @property
    def lost(self) -> int | None:
        """Messages lost, None where some topic's loss is not known."""
        counts = [topic.lost for topic in self.topics.values()]
        if not self.topics and not (self.ended and self.amount_known):
            return None
        return None if None in counts else sum(count or 0 for count in counts)

    @property
    def skipped_bytes(self) -> int:
        return sum(place.end - place.begin for place in self.skipped)

    @property
    def complete(self) -> bool:
        nothing = self.lost == 0 and not self.suspicious and not self.suspicious_left_out and not self.doubts
        return nothing and not self.attachments_lost and not self.attachments_suspicious

    def as_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        table = asdict(self)
        table["topics"] = list(table["topics"].values())
        for name in ("complete", "recovered", "suspicious", "unverified", "lost", "skipped_bytes"):
            table[name] = getattr(self, name)
        return table


def format_report(report: SalvageReport) -> str:
    """The report for a terminal."""
    return "\n".join(_lines(report))


def _lines(report: SalvageReport) -> Iterable[str]:
    found = number_of(report.recovered, "message")
    if report.whole:
        yield f"{report.output}: {report.source} is whole ({found}); copied as it is" + (
            "" if report.format == "mcap" else ", into MCAP"
        )
    else:
        yield f"{report.output}: {found} recovered from {report.source} ({report.format}), {_loss(report)}"
    if report.repaired:
        yield f"  {report.repaired}"
    yield from _table(report.topics.values())
    others = [
        _count(report.metadata_records, "metadata record"),
        _count(report.attachments, "attachment"),
        _count(report.attachments_lost, "attachment", " lost"),
        _count(report.attachments_suspicious, "attachment", " with a wrong checksum"),
    ]
    if any(others):
        yield "  beside messages: " + ", ".join(other for other in others if other)
    if report.suspicious:
        yield f"  suspicious: {number_of(report.suspicious, 'message')} in place, over which a checksum fails;"
        yield "    --drop-suspicious leaves them out"
    if report.unverified:
        yield f"  covered by no checksum: {number_of(report.unverified, 'message')}, for whose bytes nothing vouches"
    if report.suspicious_left_out:
        yield f"  left out, since a checksum over them fails: {number_of(report.suspicious_left_out, 'message')}"
    if report.skipped:
        yield f"  {report.skipped_bytes:,} of {report.size_bytes:,} bytes gave nothing:"
        for place in report.skipped[:SHOWN_PLACES]:
            yield f"    {place.begin:,} to {place.end:,}: {place.what}"
        if len(report.skipped) > SHOWN_PLACES:
            yield f"    … and {len(report.skipped) - SHOWN_PLACES} more places (--json lists them)"
    yield from (f"  {text}" for text in (*report.doubts, *report.notes))


def _loss(report: SalvageReport) -> str:
    if report.complete:
        return "none lost"
    if report.lost is None:
        known = sum(topic.known_lost for topic in report.topics.values())
        return f"at least {known:,} lost, nothing tells how many" if known else "how many are lost, nothing tells"
    return f"{report.lost:,} lost"


def _count(number: int, what: str, more: str = "") -> str:
    return number_of(number, what) + more if number else ""


def _table(topics: Iterable[TopicLoss]) -> Iterable[str]:
    rows = [("topic", "recovered", "suspicious", "lost", "from ns", "to ns")]
    rows += [
        (
            topic.name,
            f"{topic.recovered:,}",
            f"{topic.suspicious:,}" if topic.suspicious else "",
            "?" if topic.lost is None else f"{topic.lost:,}",
            "" if topic.start_ns is None else str(topic.start_ns),
            "" if topic.end_ns is None else str(topic.end_ns),
        )
        for topic in topics
    ]
    if len(rows) == 1:
        return
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        yield "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
