"""Logs that are copies of each other, byte for byte: one finding for each set. Pure.

Nothing less is called the same: a check keeps too little of a log (sampled pictures, no long arrays, no texts) to say so of other bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vilp_data.check.findings import Finding, Place
from vilp_data.check.report import Checked
from vilp_data.errors import some_of

SHOWN = 12
"""Names that a finding spells out."""


def same_logs(checked: Sequence[Checked], sha256_of: Callable[[Checked], str]) -> list[list[str]]:
    """The sources of each set of logs that are the same, in the order given. `sha256_of` is asked for logs of one size and length alone."""
    alike: dict[tuple[object, ...], list[Checked]] = {}
    for one in checked:
        if one.kind == "log" and one.size_bytes and one.format != "unreadable":
            alike.setdefault((one.format, one.size_bytes, one.n_episodes, one.duration_s), []).append(one)
    by_bytes: dict[str, list[str]] = {}
    for candidates in alike.values():
        for one in candidates if len(candidates) > 1 else ():
            by_bytes.setdefault(sha256_of(one), []).append(one.source)
    return [sources for sources in by_bytes.values() if len(sources) > 1]


def copies_finding(sources: Sequence[str]) -> Finding:
    """What is said of one set."""
    return Finding(
        severity="warning", kind="copies", place=Place(source=sources[0]),
        what=f"the same log, byte for byte: {some_of(sources, SHOWN)}", evidence={"n_copies": len(sources)},
        remedy="keep one of them; `vilp-data ingest` takes what is the same byte for byte once",
    )  # fmt: skip
