"""What the topics of a log show, judged segment by segment, and what is remembered of each topic from one segment to the next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from vilp_data.check.action_fit import MAX_STEPS, Trajectory
from vilp_data.check.cameras import camera_findings
from vilp_data.check.control_clock import on_control_clock, ticks_s
from vilp_data.check.findings import Evidence, Finding, Place, placed
from vilp_data.check.motion import Series, idle_ends, idle_findings, moved_between, series_findings
from vilp_data.check.report import Steps, Timeline
from vilp_data.check.roles import Roles
from vilp_data.check.timing import (
    Timing,
    drift_findings,
    joined,
    measure,
    silence_findings,
    timing_findings,
)
from vilp_data.check.tracks import TopicSamples, Track, runs_on_header
from vilp_data.errors import number_of
from vilp_data.sources import MessageError
from vilp_data.spec import TaskSpec
from vilp_data.types import LogEpisode

SPOILS = ("stuck", "stuck-joint")
"""A state that stands still by mistake does not tell whether the action drives it."""

MAX_COMMAND_HZ = 30.0
"""The control clock of the action's fit: faster steps would only look at smaller parts of the same motion."""

TRIM = "`vilp-data trim` takes idle ends off ingested episodes"


@dataclass
class TopicSoFar:
    """What is known of one topic after the segments so far; `first_ns`, `last_ns` are of the demonstration at hand."""

    timing: Timing | None = None
    timeline: Timeline = field(default_factory=Timeline)
    first_ns: int | None = None
    last_ns: int | None = None
    malformed: int = 0
    first_malformed: MessageError | None = None


@dataclass(frozen=True)
class Segment:
    """A part of a demonstration, as much as memory holds: `name` of the demonstration, None where its log holds no other; `first` and
    `last`: whether it is where the demonstration begins, and where it ends."""

    episode: LogEpisode
    name: str | None
    first: bool
    last: bool


class LogJudge:
    """Judges the segments of one log, whose first and last message are at `span_ns`; `findings` grow as it goes."""

    def __init__(
        self, source: str, tracks: Mapping[str, Track], roles: Roles, spec: TaskSpec | None, span_ns: tuple[int, int]
    ) -> None:
        self.source, self.tracks, self.roles, self.spec, self.span_ns = source, tracks, roles, spec, span_ns
        self.findings: list[Finding] = []
        self.topics = {topic: TopicSoFar() for topic in tracks}
        self.trajectories: list[Trajectory] = []
        self.control_hz = 0.0

    @property
    def steps(self) -> Steps | None:
        """Commands and states on one control clock, where there are both."""
        if not self.trajectories:
            return None
        return Steps(", ".join(self.roles.commands), self.control_hz, self.spec is not None, tuple(self.trajectories))

    def begin(self) -> None:
        """A demonstration begins."""
        for known in self.topics.values():
            known.first_ns = known.last_ns = None

    def malformed(self, topic: str, error: MessageError) -> None:
        """A message of `topic` does not fit its schema."""
        known = self.topics[topic]
        known.malformed += 1
        known.first_malformed = known.first_malformed or error

    def segment(self, segment: Segment) -> None:
        """Judge what the tracks gathered since the last segment, and let it go."""
        origin_ns = segment.episode.start_ns
        gathered = {topic: track.taken() for topic, track in self.tracks.items()}
        series = self._series(gathered, origin_ns)
        found: list[Finding] = []
        for topic, part in gathered.items():
            if len(part.log_ns):
                found += self._judge_stamps(topic, part, origin_ns)
        commands = [series[topic] for topic in self.roles.commands if topic in series]
        states = [series[topic] for topic in self.roles.states if topic in series]
        for topic, one in series.items():
            if self.roles.judged(topic):
                found += series_findings(one, busy=commands[0] if commands and topic in self.roles.states else None)

        def moved(start_s: float, end_s: float) -> bool | None:
            return any(moved_between(one, start_s, end_s) for one in states) if states else None

        for topic, part in gathered.items():
            found += camera_findings(topic, part.samples, moved=moved)
        self.findings += placed(found, self.source, segment.name)
        if segment.first and segment.last and states:
            self._note_idle(segment, [*states, *commands])
        spoilt = [finding.place for finding in found if finding.kind in SPOILS]
        self._take_steps(segment.episode, states, commands, spoilt)

    def _series(self, gathered: Mapping[str, TopicSamples], origin_ns: int) -> dict[str, Series]:
        """Every topic's numbers, all on one clock: a lag between two would look like an action that is early or late."""
        by_header = all(
            runs_on_header(part) for topic, part in gathered.items() if self.roles.judged(topic) and len(part.rows)
        )
        series = {}
        for topic, part in gathered.items():
            columns = self.tracks[topic].columns
            if not len(part.rows) or columns is None:
                continue
            on_header = by_header and part.header_ns is not None and runs_on_header(part)
            stamps = part.header_ns if on_header and part.header_ns is not None else part.log_ns
            at_s = (stamps[part.row_index] - origin_ns) / 1e9
            series[topic] = Series(topic, columns.names, at_s, part.rows, command=topic in self.roles.commands)
        return series

    def _judge_stamps(self, topic: str, part: TopicSamples, origin_ns: int) -> Iterator[Finding]:
        known, track = self.topics[topic], self.tracks[topic]
        figures = measure(part.log_ns, part.header_ns)
        known.timing = joined(known.timing, figures)
        known.first_ns = int(part.log_ns[0]) if known.first_ns is None else known.first_ns
        log_ns = part.log_ns if known.last_ns is None else np.concatenate([[known.last_ns], part.log_ns])
        known.last_ns = int(part.log_ns[-1])
        start_ns, length = self.span_ns[0], max(self.span_ns[1] - self.span_ns[0], 1)
        if len(log_ns) > 1:
            known.timeline.add_intervals((log_ns[1:] - start_ns) / length, np.diff(log_ns) / 1e9)
        if part.header_ns is not None and figures.header_clock in ("wall", "simulated"):
            known.timeline.add_lags((part.log_ns - start_ns) / length, (part.log_ns - part.header_ns) / 1e9)
        return timing_findings(
            topic, part.log_ns, part.header_ns, origin_ns=origin_ns, camera=bool(track.camera),
            matters=self._matters(topic),
        )  # fmt: skip

    def _matters(self, topic: str) -> bool:
        """Whether a topic's timing does: a camera's, or that of a state, which every step of an episode needs."""
        return bool(self.tracks[topic].camera) or topic in self.roles.states

    def _note_idle(self, segment: Segment, motion: Iterable[Series]) -> None:
        """Ends in which neither states nor commands move, as `trim` will see them."""
        ends = [idle for one in motion if (idle := idle_ends(one.values, one.at_s)) is not None]
        if not ends:
            return
        idle = min(start for start, _ in ends), min(end for _, end in ends)
        length_s = (segment.episode.end_ns - segment.episode.start_ns) / 1e9
        self.findings += placed(idle_findings(idle, length_s, TRIM), self.source, segment.name)

    # --- action and motion

    def _take_steps(
        self, episode: LogEpisode, states: list[Series], commands: list[Series], spoilt: list[Place]
    ) -> None:
        """Put commands and states on one control clock, for the fit at the end."""
        if not states or not commands or sum(len(one.valid) for one in self.trajectories) > MAX_STEPS:
            return
        together = [*states, *commands]
        self.control_hz = self.control_hz or self._control_hz([one.topic for one in together])
        taken = on_control_clock(episode.name, states, commands, self.control_hz)
        if taken is not None:
            at_s = ticks_s(together, len(taken.valid), self.control_hz)
            for place in spoilt:
                taken.valid[(at_s >= (place.start_s or 0.0)) & (at_s <= (place.end_s or 0.0))] = False
            self.trajectories.append(taken)

    def _control_hz(self, topics: list[str]) -> float:
        """The task's rate; else that of the slowest of these topics and of the cameras, as ingest chooses it, up to MAX_COMMAND_HZ."""
        if self.spec and self.spec.rate_hz:
            return self.spec.rate_hz
        cameras = [topic for topic, track in self.tracks.items() if track.camera]
        figures = [self.topics[topic].timing for topic in [*topics, *cameras]]
        rates = [timing.rate_hz for timing in figures if timing is not None and timing.periodic and timing.rate_hz]
        return min([*rates, MAX_COMMAND_HZ])

    # --- at the end of a demonstration, and of the log

    def silences(self, name: str | None) -> None:
        """Topics that began late or ended early in the demonstration that was read, against all that were heard in it."""
        heard = {
            topic: (known, known.first_ns, known.last_ns)
            for topic, known in self.topics.items()
            if known.first_ns is not None and known.last_ns is not None
        }
        if not heard:
            return
        span_ns = min(first for _, first, _ in heard.values()), max(last for _, _, last in heard.values())
        for topic, (known, first_ns, last_ns) in heard.items():
            timing = known.timing
            if self._matters(topic) and timing is not None and timing.periodic and timing.rate_hz:
                found = silence_findings(topic, first_ns, last_ns, span_ns=span_ns, rate_hz=timing.rate_hz)
                self.findings += placed(found, self.source, name)

    def finish(self) -> None:
        """What only the whole log shows."""
        for topic, known in self.topics.items():
            n_bins = len(known.timeline.longest_s)
            at_s = (np.arange(n_bins) + 0.5) / n_bins * (self.span_ns[1] - self.span_ns[0]) / 1e9
            self.findings += placed(drift_findings(topic, at_s, known.timeline.lag_s), self.source)
            self.findings += [*self._malformed(topic, known), *self._undecoded(topic, self.tracks[topic])]

    def _malformed(self, topic: str, known: TopicSoFar) -> Iterator[Finding]:
        error = known.first_malformed
        if error is not None:
            evidence: Evidence = {"n_messages": known.malformed, "first": str(error.found)}
            yield Finding(
                severity="error", kind="malformed", place=Place(source=self.source, topic=topic),
                what=f"not fitting their schema: {number_of(known.malformed, 'message')}", evidence=evidence, remedy=error.remedy,
            )  # fmt: skip

    def _undecoded(self, topic: str, track: Track) -> Iterator[Finding]:
        error, none = track.first_error, track.n_sampled == 0
        if error is not None:
            evidence: Evidence = {
                "n_failed": track.n_undecoded, "n_decoded": track.n_sampled, "found": str(error.found)
            }  # fmt: skip
            yield Finding(
                severity="note" if none else "warning", kind="images-not-decoded" if none else "images-damaged",
                place=Place(source=self.source, topic=topic), what=error.what, evidence=evidence, remedy=error.remedy,
            )  # fmt: skip
