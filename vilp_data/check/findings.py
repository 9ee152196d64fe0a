"""What a check finds, and how findings are put in order: worst first, the same complaint about many places told once. Pure.

The judges themselves are `timing`, `cameras`, `motion` and `action`; each takes arrays and yields findings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Worst first. An error: data that cannot be read, or that would train something wrong. A warning: data that ingest will mask, or that
deserves a look. A note: nothing wrong, worth knowing."""

TOLD_APART = ("unreadable", "damaged", "copies", "action-set")
"""Kinds that say only that something cannot be read, is there several times, or does not hold: what, or why, is in the sentence."""

Evidence = Mapping[str, float | int | str]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where: a log (or dataset) as the user named it, a topic (or view, or column), a demonstration, and a range of seconds from the
    start of the demonstration, or of the log where no demonstration is named. None: all of it."""

    source: str | None = None
    topic: str | None = None
    episode: str | None = None
    start_s: float | None = None
    end_s: float | None = None

    def __str__(self) -> str:
        span = ""
        if self.start_s is not None:
            start_s = round(self.start_s, 2) + 0.0  # no -0.00
            span = f"at {start_s:.2f} s"
            if self.end_s is not None and self.end_s - self.start_s >= 0.005:
                span = f"{start_s:.2f} to {self.end_s:.2f} s"
        return ", ".join(part for part in (self.source, self.episode, self.topic, span) if part)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    kind      a stable name of what was looked for: "gap", "black", "action-shift"
    what      one sentence
    evidence  the numbers it rests on, by name, units in the names
    remedy    what to do: a command, a line of the task TOML, or an act; None where there is nothing to do
    """

    severity: Severity
    kind: str
    place: Place
    what: str
    evidence: Evidence = field(default_factory=dict)
    remedy: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Group:
    """Findings of one kind and severity: `first` is told in full, `others` by their places. Never empty."""

    findings: tuple[Finding, ...]

    @property
    def first(self) -> Finding:
        return self.findings[0]

    @property
    def others(self) -> tuple[Finding, ...]:
        return self.findings[1:]


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """By severity; within one, in the order they came."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def grouped(findings: Iterable[Finding]) -> list[Group]:
    """Worst first; findings of one kind and severity become one group, at the place of its first. Of those TOLD_APART every
    sentence is a group."""
    groups: dict[tuple[Severity, str, str], list[Finding]] = {}
    for finding in worst_first(findings):
        cause = finding.what if finding.kind in TOLD_APART else ""
        groups.setdefault((finding.severity, finding.kind, cause), []).append(finding)
    return [Group(tuple(members)) for members in groups.values()]


def counts(findings: Iterable[Finding]) -> dict[Severity, int]:
    """How many of each severity, every severity present."""
    found = [finding.severity for finding in findings]
    return {severity: found.count(severity) for severity in SEVERITIES}


def verdict(findings: Sequence[Finding]) -> str:
    """`2 errors, 1 warning, 3 notes`, or `nothing to complain about`."""
    numbers = counts(findings)
    parts = [f"{n} {severity}{'' if n == 1 else 's'}" for severity, n in numbers.items() if n]
    return ", ".join(parts) or "nothing to complain about"


def placed(findings: Iterable[Finding], source: str, episode: str | None = None) -> list[Finding]:
    """The findings of a judge that knows neither log nor demonstration, with both filled in."""
    return [
        replace(finding, place=replace(finding.place, source=source, episode=finding.place.episode or episode))
        for finding in findings
    ]
