"""A log looked at once, from start to end, in memory that does not grow with it: segments are gathered, judged and let go.

Every message is read (so damage shows), two images a second are decoded, numbers are kept up to a hundred times a second.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.check.cameras import thumbnails_of
from vilp_data.check.findings import Finding, Place, Severity, placed, worst_first
from vilp_data.check.log_judge import LogJudge, Segment
from vilp_data.check.report import Checked, Sheet, TopicFacts
from vilp_data.check.roles import Roles, guessed_roles, roles_of
from vilp_data.check.timing import log_order_findings
from vilp_data.check.tracks import PICTURES, Track
from vilp_data.errors import LogError, VilpDataError, salvage_command
from vilp_data.message_rate import rate_by_count
from vilp_data.sources import IndexedLog, MessageError, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, I64, LogEpisode, Message

SEGMENT_NUMBERS = 4_000_000
"""Numbers held at a time, all topics together (32 MB): then the segment is judged and let go."""

KEPT_BLOCK = 24 << 20
"""Bytes of a block that is taken and freed once, untouched: glibc then keeps blocks up to that size for reuse, where it would give
each chunk's megabytes back to the kernel and have them zeroed again. Reading takes a third of the time."""

LOOK_EVERY = 2048  # messages between looks at how much is held
DAMAGE = re.compile(r"damaged|cut off|CRC|checksum|crc|truncated|inflate", re.IGNORECASE)
SALVAGED = (".mcap", ".bag", ".db3", ".active", ".zstd")
"""What errors about damaged bytes speak of, and the files that `salvage` reads."""


def check_log(path: Path, *, spec: TaskSpec | None = None, progress: Callable[[float], None] | None = None) -> Checked:
    """Everything that is wrong with a log. With a task, its actions and low_dim are known, and nothing is said of topics that it does not
    read; else they are guessed by their names.

    Never raises for what is in the log: a log that cannot be read is a finding. UsageError where there is none at `path`.
    `progress` gets the share of the log's time that was read."""
    source = str(path)
    try:
        log = open_log(path, array_rate_hz=(spec.rate_hz if spec else None) or 10.0)
    except LogError as error:
        return Checked(source, "log", "unreadable", (_unreadable(error, source),), size_bytes=_size(path))
    np.empty(KEPT_BLOCK, np.uint8)
    with log:
        return _Reading(log, path, spec, progress).run()


def _unreadable(error: VilpDataError, source: str, *, kind: str = "unreadable", at: Place | None = None) -> Finding:
    evidence = {"found": str(error.found)} if error.found is not None else {}
    remedy = error.remedy
    told = "vilp-data salvage" in (remedy or "")
    if not told and DAMAGE.search(f"{error.what} {error.found}") and source.endswith(SALVAGED):
        remedy = f"{salvage_command(Path(source))} gets back what is there"
    return Finding(
        severity="error", kind=kind, place=at or Place(source=source), what=error.what, evidence=evidence, remedy=remedy
    )


class _Reading:
    """One log, read once."""

    def __init__(
        self, log: IndexedLog, path: Path, spec: TaskSpec | None, progress: Callable[[float], None] | None
    ) -> None:
        self.log, self.path, self.source, self.spec, self.progress = log, path, str(path), spec, progress
        self.findings: list[Finding] = []
        self.notes: dict[str, str] = {}  # topic -> why it was not looked at
        self.tracks: dict[str, Track] = {}
        self.thumbnails: dict[str, F32] = {}

    def run(self) -> Checked:
        episodes, roles = list[LogEpisode](), Roles()
        try:
            episodes = self.log.episodes()
            for doubt in self.log.doubts():
                self._say(
                    "error", "incomplete", doubt, "look for the rest: copy the log again from where it was recorded"
                )
            self._find_topics()
            roles = self._roles()
        except LogError as error:
            self.findings.append(_unreadable(error, self.source))
            episodes = []
        if not episodes and not self.findings:
            self._say("error", "empty", "the log holds no message", "leave it out, or record it again")
        span = (episodes[0].start_ns, max(episode.end_ns for episode in episodes)) if episodes else (0, 1)
        judge = LogJudge(self.source, self.tracks, roles, self.spec, span)
        whole: list[str] = getattr(self.log, "whole", None) or [episode.name for episode in episodes]
        pictures = {name: _pictures(number, len(whole)) for number, name in enumerate(whole)}
        for episode in episodes:
            self._read(judge, episode, pictures.get(episode.name), several=len(episodes) > 1)
        judge.finish()
        self._say_notes()
        found = [*self.findings, *judge.findings]
        if self.spec is not None:
            read = self.spec.topics()
            found = [finding for finding in found if finding.place.topic in (None, *read)]
        return Checked(
            source=self.source, kind="log", format=self.log.format,
            findings=tuple(worst_first(found)), size_bytes=_size(self.path),
            n_episodes=len(episodes), duration_s=(span[1] - span[0]) / 1e9 if episodes else 0.0,
            topics=tuple(self._facts(judge)), sheets=tuple(self._sheets(span[0], episodes)),
            thumbnails=self.thumbnails, steps=judge.steps,
        )  # fmt: skip

    # --- before reading

    def _find_topics(self) -> None:
        """The topics that can be read; a note on each that cannot. Log times in file order are judged here: the index has them."""
        for topic in self.log.topics():
            if topic.message_count == 0:
                self.notes[topic.name] = "announced, but without a message"
                continue
            try:
                self.log.first_messages(topic.name, 1)
            except MessageError:
                pass  # one message, not the topic: counted when it is met
            except LogError as error:
                try:
                    self.log.messages([topic.name])
                except LogError:
                    self.notes[topic.name] = error.what + (f" ({error.found})" if error.found else "")
                    continue
            self.tracks[topic.name] = Track(topic)
        for name, times in self.log.message_times()[0].items():
            if name in self.tracks:
                self.findings += placed(log_order_findings(name, times), self.source)

    def _roles(self) -> Roles:
        """Which topics are commands and states. What the task names and the log has not is an error."""
        if not self.spec:
            return guessed_roles(self.tracks)
        roles = roles_of(self.spec)
        for missing in sorted({*roles.commands, *roles.states} - self.tracks.keys()):
            remedy = f"topics here: {', '.join(sorted(self.tracks)[:8])}"
            self._say("error", "missing-topic", f"the task reads {missing!r}, which is not in this log", remedy)
        return roles

    def _say(self, severity: Severity, kind: str, what: str, remedy: str | None, **place: Any) -> None:
        at = Place(source=self.source, **place)
        self.findings.append(Finding(severity=severity, kind=kind, place=at, what=what, remedy=remedy))

    # --- reading

    def _read(self, judge: LogJudge, episode: LogEpisode, pictures: int | None, *, several: bool) -> None:
        """Read and judge one demonstration, as far as it can be read, keeping about so many pictures of each camera, None none."""
        name = episode.name if several else None
        step = None if pictures is None else max((episode.end_ns - episode.start_ns) // pictures, 1)
        for track in self.tracks.values():
            track.begin(episode.start_ns, step)
        judge.begin()
        whole, first, count = True, True, 0
        stream = iter(self.log.messages(list(self.tracks), start_ns=episode.start_ns, end_ns=episode.end_ns))
        while True:
            try:
                message = next(stream, None)
                if message is None:
                    break
                self.tracks[message.topic].add(message)
            except MessageError as error:
                topic = next((name for name in self.tracks if str(error.where).endswith(f"topic {name}")), None)
                if topic is not None:
                    judge.malformed(topic, error)
                continue
            except LogError as error:
                at = Place(source=self.source, episode=name)
                self.findings.append(_unreadable(error, self.source, kind="damaged", at=at))
                whole = False
                break
            count += 1
            if count % LOOK_EVERY == 0:
                self._report(message, judge.span_ns)
                if sum(track.held for track in self.tracks.values()) > SEGMENT_NUMBERS:
                    judge.segment(Segment(episode, name, first, last=False))
                    first = False
        judge.segment(Segment(episode, name, first, last=whole))
        if whole and count:
            judge.silences(name)
        parts = [small for track in self.tracks.values() if (small := thumbnails_of(track.seen)) is not None]
        if parts:
            self.thumbnails[episode.name] = np.concatenate(parts)

    def _report(self, message: Message, span: tuple[int, int]) -> None:
        if self.progress is not None:
            self.progress((message.log_time_ns - span[0]) / max(span[1] - span[0], 1))

    # --- at the end

    def _say_notes(self) -> None:
        for topic, note in sorted(self.notes.items()):
            what = f"not looked at: {note}" if "announced" not in note else note
            self._say("note", "not-decoded" if "announced" not in note else "silent-topic", what, None, topic=topic)

    def _facts(self, judge: LogJudge) -> Iterator[TopicFacts]:
        for info in self.log.topics():
            known, track = judge.topics.get(info.name), self.tracks.get(info.name)
            timing = known.timing if known else None
            if timing is not None and not timing.periodic:
                duration_s = (judge.span_ns[1] - judge.span_ns[0]) / 1e9
                timing = replace(timing, rate_hz=rate_by_count(timing.n_messages, duration_s))
            yield TopicFacts(
                info.name, info.schema, timing.n_messages if timing else info.message_count, timing,
                track.image if track else None, self.notes.get(info.name), known.timeline if known and timing else None,
            )  # fmt: skip

    def _sheets(self, start_ns: int, episodes: list[LogEpisode]) -> Iterator[Sheet]:
        starts = np.array([episode.start_ns for episode in episodes])
        for topic, track in self.tracks.items():
            if track.pictures:
                chosen = track.pictures[:: -(-len(track.pictures) // PICTURES)]
                yield Sheet(
                    topic, [(_label(time_ns, start_ns, starts, episodes), picture) for time_ns, picture in chosen]
                )


def _pictures(number: int, of: int) -> int | None:
    """How many pictures to keep of the demonstration of that number; None for one of which there is to be none."""
    return None if number % -(-of // PICTURES) else max(PICTURES // of, 1)


def _label(time_ns: int, start_ns: int, starts: I64, episodes: list[LogEpisode]) -> str:
    if len(episodes) == 1:
        return f"{(time_ns - start_ns) / 1e9:.1f} s"
    episode = episodes[int(np.searchsorted(starts, time_ns, side="right")) - 1]
    return f"{episode.name}, {(time_ns - episode.start_ns) / 1e9:.1f} s"


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size
