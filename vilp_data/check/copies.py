"""Logs that are copies of each other, byte for byte, and demonstrations that say the same in other bytes: one finding for each set. Pure.

What a demonstration says is told by its `imprint`: when each message came, counted from its start, the numbers that a check keeps, and the
sampled pictures. Two recordings do not share the microseconds of their messages; tables, whose rows keep a clock, do not share the numbers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence

from vilp_data.check.findings import Finding, Place
from vilp_data.check.report import Checked
from vilp_data.check.tracks import Track
from vilp_data.errors import some_of

SHOWN = 12
"""Names that a finding spells out."""

COPIES = "keep one of them; `vilp-data ingest` takes what is the same byte for byte once"
TWINS = (
    "keep one of them: ingest stores each, all on one side of the split, and training sees that one so much more often"
)


def imprint_of(tracks: Mapping[str, Track]) -> str | None:
    """The imprint of the demonstration that the tracks read last; None where it has neither numbers nor pictures, only times."""
    if not any(track.n_told for track in tracks.values()):
        return None
    heard = [(topic, track.imprint) for topic, track in sorted(tracks.items()) if track.n_heard]
    return hashlib.sha256(repr(heard).encode()).hexdigest()


def copies(checked: Sequence[Checked], sha256_of: Callable[[Checked], str]) -> Iterator[Finding]:
    """A finding for each set of logs that are the same, and of demonstrations that say the same. `sha256_of` is asked for logs of one
    size and length alone."""
    alike: dict[tuple[object, ...], list[Checked]] = {}
    for one in checked:
        if one.kind == "log" and one.size_bytes and one.format != "unreadable":
            alike.setdefault((one.format, one.size_bytes, one.n_episodes, one.duration_s), []).append(one)
    again: set[str] = set()
    for candidates in alike.values():
        by_bytes: dict[str, list[str]] = {}
        for one in candidates if len(candidates) > 1 else ():
            by_bytes.setdefault(sha256_of(one), []).append(one.source)
        for sources in by_bytes.values():
            if len(sources) > 1:
                again |= set(sources[1:])
                yield _finding(
                    sources[0], f"the same log, byte for byte: {some_of(sources, SHOWN)}", len(sources), COPIES
                )
    yield from _twins([one for one in checked if one.source not in again])


def _twins(checked: Sequence[Checked]) -> Iterator[Finding]:
    saying: dict[str, list[tuple[str, str]]] = {}
    for one in checked:
        for episode, imprint in one.imprints.items():
            saying.setdefault(imprint, []).append((one.source, episode))
    sets: dict[tuple[str, ...], list[list[str]]] = {}
    for members in saying.values():
        if len(members) > 1:
            sources = tuple(source for source, _ in members)
            sets.setdefault(sources, []).append([episode for _, episode in members])
    for sources, episodes in sets.items():
        held = "the same episode" if len(episodes) == 1 else f"the same {len(episodes)} episodes"
        if len(set(sources)) == 1:
            what = (
                f"{some_of(episodes[0], SHOWN)} say the same"
                if len(episodes) == 1
                else f"it holds {held} {len(sources)} times"
            )
        else:
            what = f"hold {held}, in other bytes: {some_of(list(dict.fromkeys(sources)), SHOWN)}"
        yield _finding(sources[0], what, len(sources), TWINS)


def _finding(source: str, what: str, count: int, remedy: str) -> Finding:
    return Finding(
        severity="warning", kind="copies", place=Place(source=source), what=what, evidence={"n_copies": count}, remedy=remedy
    )  # fmt: skip
