"""A log looked at once, from start to end, in memory that does not grow with it: stretches are gathered, judged and let go.

Every message is read (so damage shows), two images a second are decoded, numbers are kept up to a hundred times a second.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data import align
from vilp_data.check.action import MAX_STEPS, Stretch
from vilp_data.check.cameras import camera_findings, thumbnails_of
from vilp_data.check.findings import Finding, Place, placed, worst_first
from vilp_data.check.motion import Series, idle_ends, idle_findings, moved_between, series_findings
from vilp_data.check.report import Checked, Sheet, Steps, Timeline, TopicFacts
from vilp_data.check.roles import Roles, guessed_roles, roles_of
from vilp_data.check.timing import (
    Timing,
    drift_findings,
    joined,
    log_order_findings,
    measure,
    silence_findings,
    timing_findings,
)
from vilp_data.check.tracks import PICTURES, Gathered, Track, runs_on_header
from vilp_data.errors import LogError, VilpDataError
from vilp_data.sources import IndexedLog, MessageError, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, I64, LogEpisode, Message

STRETCH_NUMBERS = 4_000_000
"""Numbers held at a time, all topics together (32 MB): then the stretch is judged and let go."""

KEPT_BLOCK = 24 << 20
"""Bytes of a block that is taken and freed once, untouched: glibc then keeps blocks up to that size for reuse, where it would give
each chunk's megabytes back to the kernel and have them zeroed again. Reading takes a third of the time."""

LOOK_EVERY = 2048  # messages between looks at how much is held
DAMAGE = re.compile(r"damaged|cut off|CRC|checksum|crc|truncated|inflate", re.IGNORECASE)
SALVAGED = (".mcap", ".bag", ".db3", ".active", ".zstd")
"""What errors about damaged bytes speak of, and the files that `salvage` reads."""

SPOILS = ("stuck", "stuck-joint")
"""A state that stands still by mistake does not tell whether the action drives it."""

STALE_S = 0.5  # as the task's stale_after_s is by default
MAX_COMMAND_HZ = 30.0
"""The control clock of the action's fit: faster steps would only look at smaller parts of the same motion."""


def check_log(path: Path, *, spec: TaskSpec | None = None, progress: Callable[[float], None] | None = None) -> Checked:
    """Everything that is wrong with a log. With a task, its actions and low_dim are known; else they are guessed by their names.

    Never raises for what is in the log: a log that cannot be read is a finding. UsageError where there is none at `path`.
    `progress` gets the share of the log's time that was read."""
    source = str(path)
    try:
        log = open_log(path, array_rate_hz=(spec.rate_hz if spec else None) or 10.0)
    except LogError as error:
        return Checked(source, "log", "unreadable", (_unreadable(error, source),), size_bytes=_size(path))
    np.empty(KEPT_BLOCK, np.uint8)
    with log:
        return _Pass(log, path, spec, progress).run()


def _unreadable(error: VilpDataError, source: str, *, kind: str = "unreadable", at: Place | None = None) -> Finding:
    evidence = {"found": str(error.found)} if error.found is not None else {}
    remedy = error.remedy
    if DAMAGE.search(f"{error.what} {error.found}") and source.endswith(SALVAGED) and "mangled" not in error.what:
        name = Path(source)
        remedy = (
            f"`vilp-data salvage {source} -o {name.with_name(name.stem + '-salvaged.mcap')}` gets back what is there"
        )
    return Finding(
        severity="error", kind=kind, place=at or Place(source=source), what=error.what, evidence=evidence, remedy=remedy
    )


@dataclass
class _Kept:
    """What is known of one topic after the stretches so far."""

    timing: Timing | None = None
    timeline: Timeline = field(default_factory=Timeline)
    last_ns: int | None = None  # of the demonstration at hand
    first_ns: int | None = None
    malformed: int = 0
    first_malformed: MessageError | None = None


class _Pass:
    """One pass over one log."""

    def __init__(
        self, log: IndexedLog, path: Path, spec: TaskSpec | None, progress: Callable[[float], None] | None
    ) -> None:
        self.log, self.path, self.source, self.spec, self.progress = log, path, str(path), spec, progress
        self.findings: list[Finding] = []
        self.notes: dict[str, str] = {}
        self.tracks: dict[str, Track] = {}
        self.kept: dict[str, _Kept] = {}
        self.stretches: list[Stretch] = []
        self.control_hz = 0.0
        self.thumbnails: dict[str, F32] = {}
        self.roles: Roles = roles_of(spec) if spec else Roles()

    def run(self) -> Checked:
        try:
            episodes = self.log.episodes()
            self._find_topics()
        except LogError as error:
            self.findings.append(_unreadable(error, self.source))
            episodes = []
        if not episodes and not self.findings:
            self._say("error", "empty", "the log holds no message", "leave it out, or record it again")
        span = (episodes[0].start_ns, max(episode.end_ns for episode in episodes)) if episodes else (0, 1)
        for number, episode in enumerate(episodes):
            self._read(episode, number, len(episodes), span)
        self._judge_all(span)
        return Checked(
            source=self.source, kind="log", format=self.log.format, findings=tuple(worst_first(self.findings)),
            size_bytes=_size(self.path), n_episodes=len(episodes), duration_s=(span[1] - span[0]) / 1e9 if episodes else 0.0,
            topics=self._facts(), sheets=tuple(self._sheets(span[0], episodes)),
            thumbnails=self.thumbnails, steps=self._steps(),
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
            self.tracks[topic.name], self.kept[topic.name] = Track(topic), _Kept()
        if not self.spec:
            self.roles = guessed_roles(self.tracks)
        else:
            for missing in sorted({*self.roles.commands, *self.roles.states} - self.tracks.keys()):
                remedy = f"topics here: {', '.join(sorted(self.tracks)[:8])}"
                self._say("error", "missing-topic", f"the task reads {missing!r}, which is not in this log", remedy)
        for name, times in self.log.message_times()[0].items():
            if name in self.tracks:
                self.findings += placed(log_order_findings(name, times), self.source)

    def _say(self, severity: Any, kind: str, what: str, remedy: str | None, **place: Any) -> None:
        at = Place(source=self.source, **place)
        self.findings.append(Finding(severity=severity, kind=kind, place=at, what=what, remedy=remedy))

    # --- reading

    def _read(self, episode: LogEpisode, number: int, of: int, span: tuple[int, int]) -> None:
        """Read and judge one demonstration, as far as it can be read."""
        step = self._picture_step(episode, number, of)
        for track in self.tracks.values():
            track.begin(episode.start_ns, step)
        for kept in self.kept.values():
            kept.first_ns = kept.last_ns = None
        whole, first, count = True, True, 0
        stream = iter(self.log.messages(list(self.tracks), start_ns=episode.start_ns, end_ns=episode.end_ns))
        while True:
            try:
                message = next(stream, None)
                if message is None:
                    break
                self.tracks[message.topic].add(message)
            except MessageError as error:
                self._malformed(error)
                continue
            except LogError as error:
                place = Place(source=self.source, episode=episode.name if of > 1 else None)
                self.findings.append(_unreadable(error, self.source, kind="damaged", at=place))
                whole = False
                break
            count += 1
            if count % LOOK_EVERY == 0:
                self._report(message, span)
                if sum(track.held for track in self.tracks.values()) > STRETCH_NUMBERS:
                    self._judge_stretch(episode, of, span, first=first, last=False)
                    first = False
        self._judge_stretch(episode, of, span, first=first, last=whole)
        if whole and count:
            self._judge_silences(episode, of)
        parts = [small for track in self.tracks.values() if (small := thumbnails_of(track.seen)) is not None]
        if parts:
            self.thumbnails[episode.name] = np.concatenate(parts)

    def _picture_step(self, episode: LogEpisode, number: int, of: int) -> int | None:
        """Nanoseconds between pictures kept of a demonstration; None for one of which there is to be none."""
        every = -(-of // PICTURES)
        if number % every:
            return None
        return max((episode.end_ns - episode.start_ns) // max(PICTURES // of, 1), 1)

    def _report(self, message: Message, span: tuple[int, int]) -> None:
        if self.progress is not None:
            self.progress((message.log_time_ns - span[0]) / max(span[1] - span[0], 1))

    def _malformed(self, error: MessageError) -> None:
        topic = next((name for name in self.tracks if str(error.where).endswith(f"topic {name}")), None)
        if topic is not None:
            kept = self.kept[topic]
            kept.malformed += 1
            kept.first_malformed = kept.first_malformed or error

    # --- judging a stretch

    def _judge_stretch(self, episode: LogEpisode, of: int, span: tuple[int, int], *, first: bool, last: bool) -> None:
        name = episode.name if of > 1 else None
        gathered = {topic: track.taken() for topic, track in self.tracks.items()}
        # One clock for all of them: a lag between two would look like an action that is early or late.
        by_header = all(
            runs_on_header(part) for topic, part in gathered.items() if self.roles.judged(topic) and len(part.rows)
        )
        series = {
            topic: self._series(topic, part, episode.start_ns, by_header)
            for topic, part in gathered.items()
            if len(part.rows)
        }
        found: list[Finding] = []
        for topic, part in gathered.items():
            if len(part.log_ns):
                found += self._judge_stamps(topic, part, episode, span)
        busy = next((series[topic] for topic in self.roles.commands if topic in series), None)
        for topic, one in series.items():
            if self.roles.judged(topic):
                found += series_findings(one, busy=busy if topic in self.roles.states else None)
        motion = [series[topic] for topic in self.roles.states if topic in series]

        def moved(start_s: float, end_s: float) -> bool | None:
            return any(moved_between(one, start_s, end_s) for one in motion) if motion else None

        for topic, part in gathered.items():
            found += camera_findings(topic, part.glances, moved=moved)
        self.findings += placed(found, self.source, name)
        self._note_idle(episode, name, motion, first=first, last=last)
        spoilt = [finding.place for finding in found if finding.kind in SPOILS]
        self._take_steps(episode, series, spoilt)

    def _series(self, topic: str, found: Gathered, origin_ns: int, by_header: bool) -> Series:
        columns = self.tracks[topic].columns
        assert columns is not None
        stamps = (
            found.header_ns if by_header and found.header_ns is not None and runs_on_header(found) else found.log_ns
        )
        at_s = (stamps[found.row_index] - origin_ns) / 1e9
        return Series(topic, columns.names, at_s, found.rows, command=topic in self.roles.commands)

    def _judge_stamps(
        self, topic: str, part: Gathered, episode: LogEpisode, span: tuple[int, int]
    ) -> Iterator[Finding]:
        kept, track = self.kept[topic], self.tracks[topic]
        figures = measure(part.log_ns, part.header_ns)
        kept.timing = joined(kept.timing, figures)
        kept.first_ns = int(part.log_ns[0]) if kept.first_ns is None else kept.first_ns
        log_ns = part.log_ns if kept.last_ns is None else np.concatenate([[kept.last_ns], part.log_ns])
        kept.last_ns = int(part.log_ns[-1])
        length = max(span[1] - span[0], 1)
        if len(log_ns) > 1:
            kept.timeline.add_intervals((log_ns[1:] - span[0]) / length, np.diff(log_ns) / 1e9)
        if part.header_ns is not None and figures.header_clock in ("wall", "simulated"):
            kept.timeline.add_lags((part.log_ns - span[0]) / length, (part.log_ns - part.header_ns) / 1e9)
        return timing_findings(
            topic, part.log_ns, part.header_ns, origin_ns=episode.start_ns, camera=bool(track.camera),
            matters=self._matters(topic),
        )  # fmt: skip

    def _matters(self, topic: str) -> bool:
        """Whether a topic's timing does: a camera's, or that of a state, which every step of an episode needs."""
        return bool(self.tracks[topic].camera) or topic in self.roles.states

    def _judge_silences(self, episode: LogEpisode, of: int) -> None:
        """Topics that began late or ended early in this demonstration, against all that were heard in it."""
        heard = {
            topic: kept for topic, kept in self.kept.items() if kept.first_ns is not None and kept.last_ns is not None
        }
        if not heard:
            return
        span = (
            min(int(kept.first_ns or 0) for kept in heard.values()),
            max(int(kept.last_ns or 0) for kept in heard.values()),
        )
        for topic, kept in heard.items():
            timing = kept.timing
            if self._matters(topic) and timing is not None and timing.periodic and timing.rate_hz:
                found = silence_findings(
                    topic, int(kept.first_ns or 0), int(kept.last_ns or 0), span_ns=span, rate_hz=timing.rate_hz
                )
                self.findings += placed(found, self.source, episode.name if of > 1 else None)

    def _note_idle(
        self, episode: LogEpisode, name: str | None, motion: list[Series], *, first: bool, last: bool
    ) -> None:
        ends = [idle for one in motion if (idle := idle_ends(one)) is not None]
        if not ends or not (first and last):
            return
        idle = min(start for start, _ in ends), min(end for _, end in ends)
        length_s = (episode.end_ns - episode.start_ns) / 1e9
        self.findings += placed(idle_findings(idle, length_s, TRIM), self.source, name)

    # --- action and motion

    def _take_steps(self, episode: LogEpisode, series: Mapping[str, Series], spoilt: list[Place]) -> None:
        """Put commands and states on one control clock, for the fit at the end."""
        states = [_positions(series[topic]) for topic in self.roles.states if topic in series]
        commands = [series[topic] for topic in self.roles.commands if topic in series]
        if not states or not commands or sum(len(stretch.valid) for stretch in self.stretches) > MAX_STEPS:
            return
        self.control_hz = self.control_hz or self._control_hz([one.topic for one in [*states, *commands]])
        stretch = on_control_clock(episode.name, states, commands, self.control_hz)
        if stretch is not None:
            ticks_s = max(one.at_s[0] for one in [*states, *commands]) + np.arange(len(stretch.valid)) / self.control_hz
            for place in spoilt:
                stretch.valid[(ticks_s >= (place.start_s or 0.0)) & (ticks_s <= (place.end_s or 0.0))] = False
            self.stretches.append(stretch)

    def _control_hz(self, topics: list[str]) -> float:
        """The task's rate; else that of the slowest of these topics and of the cameras, as ingest chooses it, up to MAX_COMMAND_HZ."""
        if self.spec and self.spec.rate_hz:
            return self.spec.rate_hz
        cameras = [topic for topic, track in self.tracks.items() if track.camera]
        figures = [self.kept[topic].timing for topic in [*topics, *cameras]]
        rates = [timing.rate_hz for timing in figures if timing is not None and timing.periodic and timing.rate_hz]
        return min([*rates, MAX_COMMAND_HZ])

    # --- at the end

    def _judge_all(self, span: tuple[int, int]) -> None:
        for topic, kept in self.kept.items():
            seconds = (
                (np.arange(len(kept.timeline.longest_s)) + 0.5)
                / len(kept.timeline.longest_s)
                * (span[1] - span[0])
                / 1e9
            )
            self.findings += placed(drift_findings(topic, seconds, kept.timeline.lag_s), self.source)
            if kept.first_malformed is not None:
                self._say_malformed(topic, kept)
            self._say_undecoded(topic, self.tracks[topic])
        for topic, note in sorted(self.notes.items()):
            what = f"not looked at: {note}" if "announced" not in note else note
            self._say("note", "not-decoded" if "announced" not in note else "silent-topic", what, None, topic=topic)

    def _say_malformed(self, topic: str, kept: _Kept) -> None:
        error = kept.first_malformed
        assert error is not None
        place = Place(source=self.source, topic=topic)
        evidence: dict[str, float | int | str] = {"n_messages": kept.malformed, "first": str(error.found)}
        what = f"{kept.malformed} messages do not fit their schema"
        self.findings.append(
            Finding(severity="error", kind="malformed", place=place, what=what, evidence=evidence, remedy=error.remedy)
        )

    def _say_undecoded(self, topic: str, track: Track) -> None:
        if track.first_error is None:
            return
        error, none = track.first_error, track.n_sampled == 0
        self.findings.append(Finding(
            severity="note" if none else "warning", kind="images-not-decoded" if none else "images-damaged",
            place=Place(source=self.source, topic=topic), what=error.what,
            evidence={"n_failed": track.n_undecoded, "n_decoded": track.n_sampled, "found": str(error.found)}, remedy=error.remedy,
        ))  # fmt: skip

    def _facts(self) -> tuple[TopicFacts, ...]:
        facts = []
        for info in self.log.topics():
            kept, track = self.kept.get(info.name), self.tracks.get(info.name)
            seen = kept.timing.n_messages if kept and kept.timing else info.message_count
            facts.append(TopicFacts(
                info.name, info.schema, seen, kept.timing if kept else None, track.image if track else None,
                self.notes.get(info.name), kept.timeline if kept and kept.timing else None,
            ))  # fmt: skip
        return tuple(facts)

    def _steps(self) -> Steps | None:
        if not self.stretches:
            return None
        return Steps(", ".join(self.roles.commands), self.control_hz, self.spec is not None, tuple(self.stretches))

    def _sheets(self, start_ns: int, episodes: list[LogEpisode]) -> Iterator[Sheet]:
        starts = np.array([episode.start_ns for episode in episodes])
        for topic, track in self.tracks.items():
            if track.pictures:
                chosen = track.pictures[:: -(-len(track.pictures) // PICTURES)]
                yield Sheet(
                    topic, [(_label(time_ns, start_ns, starts, episodes), picture) for time_ns, picture in chosen]
                )


TRIM = "`vilp-data trim` takes idle ends off ingested episodes"


def _label(time_ns: int, start_ns: int, starts: I64, episodes: list[LogEpisode]) -> str:
    if len(episodes) == 1:
        return f"{(time_ns - start_ns) / 1e9:.1f} s"
    episode = episodes[int(np.searchsorted(starts, time_ns, side="right")) - 1]
    return f"{episode.name}, {(time_ns - episode.start_ns) / 1e9:.1f} s"


def _positions(series: Series) -> Series:
    """The columns that say where a robot is: of joint states their positions, not what they weigh or how fast they are."""
    chosen = [i for i, name in enumerate(series.names) if name.startswith("position")]
    if not chosen or len(chosen) == len(series.names):
        return series
    return Series(series.topic, [series.names[i] for i in chosen], series.at_s, series.values[:, chosen])


def on_control_clock(name: str, states: list[Series], commands: list[Series], rate_hz: float) -> Stretch | None:
    """States and commands at the ticks of a control clock over the time that all of them cover, by ingest's own rules; None where that
    is too short. Pure."""
    start_s = max(one.at_s[0] for one in [*states, *commands])
    end_s = min(one.at_s[-1] for one in states)
    count = int((end_s - start_s) * rate_hz) + 1
    if count < 2:
        return None
    ticks = np.round((start_s + np.arange(count) / rate_hz) * 1e9).astype(np.int64)
    valid = np.ones(count, np.bool_)
    state, action = [], []
    for one in states:
        seen = align.observe(_stamps(one), ticks, stale_after_s=STALE_S)
        state.append(one.values[np.maximum(seen.index, 0)])
        valid &= seen.valid
    for one in commands:
        held = align.command_in_force(_stamps(one), ticks, period_ns=round(1e9 / rate_hz))
        action.append(one.values[np.maximum(held, 0)])
        valid &= held >= 0
    return Stretch(name, np.concatenate(state, axis=1), np.concatenate(action, axis=1), valid)


def _stamps(series: Series) -> I64:
    return np.round(series.at_s * 1e9).astype(np.int64)


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size
