"""What flows through the pipeline: shapes, dtypes and ranges, stated once, here.

Axes: F steps of the control clock, n stored frames, H height, W width, C channels, L low_dim, A action, S simulator state,
N planned frames (n_plan_frames), c h w latent channels, height and width, B windows in a batch, V views.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from types import TracebackType
from typing import Any, Literal, Protocol, Self, TypeAlias

import numpy as np
import numpy.typing as npt

U8 = npt.NDArray[np.uint8]
F16 = npt.NDArray[np.float16]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

RATE_TOLERANCE = 0.02
"""How far the rate of an episode may lie from the others' where the spec states none: cameras are not exact."""

Clock = Literal["header", "log", "publish"]
Outcome = Literal["success", "failure", "unknown"]

ColumnNames: TypeAlias = Mapping[str, Mapping[str, Sequence[str]]]
"""Vector ("low_dim", "action") -> part -> the names of its numbers."""


# --- logs -----------------------------------------------------------------------------------------------------------


EPISODE_RECORD = "episode"
"""Name of the metadata record in which a log says what it shows (task, seed, success, …): it becomes the episode's tags."""

MADE_FROM_RECORD = "made_from"
"""Name of the metadata record by which a recorder knows its finished logs again. No dataset stores it."""

ROLLOUT_TAG = ("source", "rollout")
"""The tag of an episode that a policy under trial made. Demonstrations (people's, scripted experts') do not bear it."""


def is_rollout(tags: Mapping[str, str]) -> bool:
    """Whether these are the tags of a policy's own episode: it may be stored and viewed, but never gets a side of the split, so no
    model learns from it or is judged by it."""
    name, value = ROLLOUT_TAG
    return tags.get(name) == value


OUTCOME_TAG = "success"


def outcome_of(tags: Mapping[str, str]) -> Outcome:
    """What tags say of an episode: the tag `success`, "true" or "false"."""
    outcomes: dict[str, Outcome] = {"true": "success", "false": "failure"}
    return outcomes.get(tags.get(OUTCOME_TAG, "").lower(), "unknown")


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a log. `schema` is the name the log uses (`foxglove.CompressedImage`, `array`), of ROS types always the form
    `sensor_msgs/msg/Image`; `encoding` is how its messages are written (`cdr`, `ros1`, `protobuf`, `json`, `array`);
    `message_count` is None where the log has no index to tell. `names`: of an array's numbers, where the log says them."""

    name: str
    schema: str
    encoding: str
    message_count: int | None
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Message:
    """One timestamped message. Times are integer nanoseconds. `body` is the deserialised message: an object with the
    schema's attributes (CDR, protobuf), a dict (JSON), or an array (zarr); only `decode` looks inside."""

    topic: str
    schema: str
    log_time_ns: int
    publish_time_ns: int
    body: Any


@dataclass(frozen=True, slots=True)
class LogEpisode:
    """A demonstration inside a log: messages with start_ns <= log time < end_ns. `name` is unique within the log
    and does not depend on what the file is called."""

    name: str
    start_ns: int
    end_ns: int
    tags: Mapping[str, str] = field(default_factory=dict)


class LogReader(Protocol):
    """What `sources.open_log(path)` returns, whatever the format. Use it as a context manager; it never writes."""

    @property
    def path(self) -> PurePath: ...
    @property
    def format(self) -> str:
        """Short name of the format: `mcap`, `rosbag1`, `rosbag2`, `zarr`, …"""
        ...

    def sha256(self) -> str:
        """SHA-256 of the log's bytes (a folder: of its sorted relative paths and their bytes), lower-case hex."""
        ...

    def topics(self) -> list[TopicInfo]:
        """Every topic, sorted by name."""
        ...

    def metadata(self) -> dict[str, dict[str, str]]:
        """Named metadata records that the log carries about itself; empty where it has none."""
        ...

    def episodes(self) -> list[LogEpisode]:
        """The demonstrations in this log, in order of time. An MCAP file is one, unless something says otherwise."""
        ...

    def messages(
        self, topics: Collection[str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages of `topics` with start_ns <= log time < end_ns, in order of log time, checksums verified.

        Raises LogError where the log lacks a topic (naming the nearest one), is cut off, or fails a checksum."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


# --- episodes -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Episode:
    """One demonstration on one control clock, ready to store.

    frames        view name -> uint8 [n,H,W,3], RGB, or [n,H,W,1] of a depth view (0: no reading); top row first; each camera image
                  once, in order of time
    source_index  view name -> int32 [F]: which of the n frames is the observation at each step
    log_time_ns   int64 [F]: the control ticks
    low_dim       float32 [F,L]
    action        float32 [F,A], or None for an episode that is only watched
    state         float64 [F,S] simulator state for replaying, never given to a model; or None
    valid         bool [F]: False where an observation or action is missing, stale or not finite
    age_s         topic -> float32 [F]: tick time minus the time of the message used; NaN where there was none
    column_names  "low_dim", "action" -> part -> what its log calls each of its numbers, of the parts where that is more than
                  the task says
    """

    id: str
    frames: Mapping[str, U8]
    source_index: Mapping[str, I32]
    log_time_ns: I64
    low_dim: F32
    action: F32 | None
    state: F64 | None
    valid: Bool
    age_s: Mapping[str, F32]
    rate_hz: float
    tags: Mapping[str, str]
    outcome: Outcome
    findings: tuple[str, ...] = ()
    column_names: ColumnNames = field(default_factory=dict)

    @property
    def n_steps(self) -> int:
        return len(self.log_time_ns)
