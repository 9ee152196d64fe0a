"""A simulated episode as a log: one tick after another, on the topics that the task's spec reads.

    t_k = t_0 + k / rate     the cameras, low_dim and the simulator's state are taken, then action k is issued; all stamped t_k

The last tick holds the final observation and the action that keeps still, so every tick has both.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.recorder import NO_LATENCY, EpisodeRecorder
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.types import F32, F64

START_NS = 1_000_000_000
"""Simulated clocks begin at one second: some readers take a zero stamp for a missing one."""

TickWriter = Callable[[EpisodeRecorder, int, Mapping[str, Any], Mapping[str, Any], F32], None]
"""Writes one tick: the recorder, the tick's stamp in ns, the observation and info at it, and the action issued then."""

_INDEX = re.compile(r"(?:data)?\[(\d+)(?::(\d+))?\]")
_WHOLE = ((), ("data",))


def tick_writer(spec: TaskSpec, env: Any) -> TickWriter:
    """How an environment's ticks are written: by its own `write_tick` where it has one (topics of several message types), else
    each view as an image and each vector's topic as one bare array.

    Raises UsageError where neither gives what the spec reads: the environment must then write its messages itself."""
    own: TickWriter | None = getattr(env.unwrapped, "write_tick", None)
    return own if own is not None else array_writer(spec)


def array_writer(spec: TaskSpec) -> TickWriter:
    """Views as JPEG images, vectors as std_msgs/msg/Float64MultiArray, such that the spec reads back what was observed and done.

    Raises UsageError where a topic's fields are not those of a bare array."""
    layouts = {topic: _layout(spec, topic) for topic in spec.topics() if topic not in _view_topics(spec)}
    offsets_ns = {topic: round(table.offset_s * 1e9) for topic, table in spec.clocks().items()}

    def write(
        log: EpisodeRecorder, stamp_ns: int, observation: Mapping[str, Any], info: Mapping[str, Any], action: F32
    ) -> None:
        for view, table in spec.views.items():
            log.image(table.topic, stamp_ns - offsets_ns[table.topic], observation[view], latency=NO_LATENCY)
        sources = {"state": info["state"], "low_dim": observation["low_dim"], "action": action}
        for topic, layout in layouts.items():
            log.vector(topic, stamp_ns - offsets_ns[topic], layout(sources))

    return write


Layout = Callable[[Mapping[str, Any]], F64]
"""From the vectors "state", "low_dim" and "action" to the numbers of one topic's message."""


def _layout(spec: TaskSpec, topic: str) -> Layout:
    if spec.clocks()[topic].clock == "header":
        raise _needs_own_writer(topic, 'clock = "header", which an array does not have')
    if spec.state is not None and spec.state.topic == topic and spec.state.fields in _WHOLE:
        return lambda sources: np.asarray(sources["state"], np.float64)
    kinds: dict[str, Mapping[str, VectorSpec] | Mapping[str, ActionSpec]] = {
        "low_dim": spec.low_dim,
        "action": spec.action,
    }
    reading = [kind for kind, parts in kinds.items() if any(part.topic == topic for part in parts.values())]
    if len(reading) != 1:
        raise _needs_own_writer(topic, "the state in part, or several of low_dim, action and state")
    (kind,) = reading
    return _scattered(kind, kinds[kind], topic)


def _scattered(kind: str, parts: Mapping[str, VectorSpec] | Mapping[str, ActionSpec], topic: str) -> Layout:
    """The message that holds the columns of a vector's parts where their fields look for them."""
    (first, *more) = parts.values()
    if not more and first.fields in _WHOLE:
        return lambda sources: np.asarray(sources[kind], np.float64)
    columns: list[int] = []  # of the vector, beside the place in the message
    places: list[int] = []
    column = 0
    for name, part in parts.items():
        indices = _indices(f"{kind}.{name}", part)
        if part.topic == topic:
            columns += range(column, column + len(indices))
            places += indices
        column += len(indices)

    def layout(sources: Mapping[str, Any]) -> F64:
        data = np.zeros(max(places) + 1)
        data[places] = np.asarray(sources[kind], np.float64)[columns]
        return data

    return layout


def _indices(name: str, part: VectorSpec | ActionSpec) -> list[int]:
    """Which numbers of a bare array a part reads."""
    found: list[int] = []
    for field in part.fields:
        match = _INDEX.fullmatch(field)
        if match is None:
            raise _needs_own_writer(name, f"field {field!r}, which is not of a bare array")
        first, stop = match.groups()
        found += range(int(first), int(stop) if stop else int(first) + 1)
    if not found:
        raise _needs_own_writer(name, "no fields, beside other parts of the vector")
    return found


def _view_topics(spec: TaskSpec) -> set[str]:
    return {view.topic for view in spec.views.values()}


def _needs_own_writer(where: str, found: str) -> UsageError:
    return UsageError(
        "an episode of this task cannot be written as plain arrays",
        where=where,
        found=found,
        remedy="give its environment a method write_tick(log, stamp_ns, observation, info, action), as ArmEnv has",
    )
