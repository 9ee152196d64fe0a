"""What a check hands on: findings, and the figures and pictures that a page shows beside them. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from vilp_data.check.action_fit import ActionFit, Trajectory
from vilp_data.check.findings import Finding
from vilp_data.check.timing import Timing
from vilp_data.types import F32, F64, RATE_TOLERANCE, U8

BINS = 360
"""Intervals and lags of a topic are kept as so many bins along the log, whatever its length: what a page can draw."""


@dataclass
class Timeline:
    """A topic along its log, in BINS even bins of its time: the longest interval and the mean lag of each (s), NaN where none was."""

    longest_s: F64 = field(default_factory=lambda: np.full(BINS, np.nan))
    lag_sum_s: F64 = field(default_factory=lambda: np.zeros(BINS))
    lag_count: F64 = field(default_factory=lambda: np.zeros(BINS))

    def add_intervals(self, share: F64, intervals_s: F64) -> None:
        """Intervals float64 [n] (s), each at `share` of the log (0 … 1)."""
        np.fmax.at(self.longest_s, _bins(share), intervals_s)

    def add_lags(self, share: F64, lags_s: F64) -> None:
        np.add.at(self.lag_sum_s, bins := _bins(share), lags_s)
        np.add.at(self.lag_count, bins, 1.0)

    @property
    def lag_s(self) -> F64:
        return np.where(self.lag_count > 0, self.lag_sum_s / np.maximum(self.lag_count, 1), np.nan)


def _bins(share: F64) -> npt.NDArray[np.int64]:
    return np.clip((share * BINS).astype(np.int64), 0, BINS - 1)


@dataclass(frozen=True)
class TopicFacts:
    """One topic (or view, or vector of a dataset). `image`: `96x160 jpeg`; `note`: why there are no figures."""

    name: str
    schema: str
    n_messages: int | None
    timing: Timing | None = None
    image: str | None = None
    note: str | None = None
    timeline: Timeline | None = None


@dataclass(frozen=True)
class Sheet:
    """A contact sheet: a camera's pictures along the recording, each with its label, uint8 [h,w,C]."""

    topic: str
    pictures: Sequence[tuple[str, U8]]


@dataclass(frozen=True)
class Fit:
    """How well the actions of a topic explain the motion."""

    topic: str
    fit: ActionFit
    rate_hz: float


@dataclass(frozen=True)
class Steps:
    """States and actions of demonstrations on one control clock. `topic`: where the actions come from; `certain`: a task said so."""

    topic: str
    rate_hz: float
    certain: bool
    trajectories: tuple[Trajectory, ...]

    def fits(self, other: Steps) -> bool:
        """Whether both can be judged together: the same topics and widths, and steps of one length. At two rates a step late is two
        different times."""
        one, two = self.trajectories[0], other.trajectories[0]
        widths = [(first.state.shape[1], first.action.shape[1]) for first in (one, two)]
        alike = (self.topic, self.certain, widths[0]) == (other.topic, other.certain, widths[1])
        return alike and abs(self.rate_hz / other.rate_hz - 1) <= RATE_TOLERANCE


@dataclass(frozen=True)
class Checked:
    """One log or dataset, looked at. `thumbnails` (name of each demonstration -> float32 [m,8,8]) and `steps` are for judging it together
    with others."""

    source: str
    kind: Literal["log", "dataset"]
    format: str
    findings: tuple[Finding, ...]
    size_bytes: int = 0
    n_episodes: int = 0
    duration_s: float = 0.0
    topics: tuple[TopicFacts, ...] = ()
    sheets: tuple[Sheet, ...] = ()
    thumbnails: Mapping[str, F32] = field(default_factory=dict)
    steps: Steps | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON: no pictures."""
        return {
            "source": self.source,
            "kind": self.kind,
            "format": self.format,
            "size_bytes": self.size_bytes,
            "n_episodes": self.n_episodes,
            "duration_s": self.duration_s,
            "findings": [finding.as_dict() for finding in self.findings],
            "topics": [_topic_dict(topic) for topic in self.topics],
        }


def _topic_dict(topic: TopicFacts) -> dict[str, Any]:
    plain = {"name": topic.name, "schema": topic.schema, "n_messages": topic.n_messages}
    plain |= {"image": topic.image, "note": topic.note}
    return plain | (asdict(topic.timing) if topic.timing else {})
