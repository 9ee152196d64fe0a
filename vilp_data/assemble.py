"""One demonstration of a log -> one Episode: the place where sources, decode, align and geometry meet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from vilp_data import align, decode, geometry
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, UsageError, nearest
from vilp_data.spec import ActionSpec, TaskSpec, TopicSpec, VectorSpec, ViewSpec
from vilp_data.types import F32, F64, I32, I64, U8, Bool, Episode, LogEpisode, LogReader, Message, Outcome


@dataclass(frozen=True)
class Track:
    """One topic's messages in order of its clock: stamps int64 [M], and for each the message, or the image at its stored size."""

    stamps_ns: I64
    values: Sequence[Message | U8]


Tracks: TypeAlias = Mapping[str, Track]


def assemble_episode(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, *, episode_id: str) -> Episode:
    """One demonstration on one control clock.

    Raises LogError, DecodeError, AlignError or SpecError, each saying what in the log or the spec is wrong."""
    tracks = collect(log, demonstration, spec, available_topics(log, spec))
    view_stamps = {view: tracks[view_spec.topic].stamps_ns for view, view_spec in spec.views.items()}
    rate_hz = spec.rate_hz or min(align.median_rate_hz(stamps) for stamps in view_stamps.values())
    refuse_short_stride(spec, view_stamps, rate_hz)
    ticks = align.control_ticks(view_stamps, rate_hz)
    if len(ticks) < 2:
        raise AlignError(
            "an episode of one step holds no motion to learn",
            where=f"{log.path}, {demonstration.name}",
            remedy="leave this log out",
        )

    seen = {
        view: align.observe(view_stamps[view], ticks, stale_after_s=view_spec.stale_after_s)
        for view, view_spec in spec.views.items()
    }
    images = {
        view: _stored_images(tracks[view_spec.topic], seen[view].index, view_spec)
        for view, view_spec in spec.views.items()
    }
    low_dim = {name: _observe_vector(part, tracks, ticks) for name, part in spec.low_dim.items()}
    state = _observe_vector(spec.state, tracks, ticks) if spec.state and spec.state.topic in tracks else None
    action = _actions(spec, tracks, ticks, low_dim, rate_hz)

    low_dim_values = np.concatenate([*(part.values for part in low_dim.values()), np.zeros((len(ticks), 0))], axis=1)
    valid: dict[str, Bool] = {f"view {view}": observed.valid for view, observed in seen.items()}
    valid |= {f"low_dim {name}": part.valid for name, part in low_dim.items()}
    if action is not None:
        valid["action"] = np.asarray(np.isfinite(action).all(axis=1))
    ages = {spec.views[view].topic: observed.age_s for view, observed in seen.items()}
    ages |= {spec.low_dim[name].topic: part.age_s for name, part in low_dim.items()}
    return Episode(
        id=episode_id,
        frames={view: frames for view, (frames, _) in images.items()},
        source_index={view: index for view, (_, index) in images.items()},
        log_time_ns=ticks,
        low_dim=np.nan_to_num(low_dim_values).astype(np.float32),
        action=None if action is None else np.nan_to_num(action).astype(np.float32),
        state=None if state is None else state.values,
        valid=np.logical_and.reduce(list(valid.values())),
        age_s=ages,
        rate_hz=float(rate_hz),
        tags=dict(demonstration.tags),
        outcome=outcome_of(demonstration.tags),
        findings=tuple(_findings(valid, images)),
    )


def outcome_of(tags: Mapping[str, str]) -> Outcome:
    """What the log says of itself: its `success` tag, "true" or "false"."""
    outcomes: dict[str, Outcome] = {"true": "success", "false": "failure"}
    return outcomes.get(tags.get("success", "").lower(), "unknown")


# --- reading -------------------------------------------------------------------------------------------------------------


def available_topics(log: LogReader, spec: TaskSpec) -> list[str]:
    """The spec's topics that this log has. Cameras and low_dim must all be there; commands all or none; the state may be absent."""
    have = {topic.name for topic in log.topics()}
    required = [view.topic for view in spec.views.values()] + [part.topic for part in spec.low_dim.values()]
    commands = [part.topic for part in spec.action.values() if part.topic is not None]
    if have.intersection(commands):
        required += commands
    for topic in required:
        if topic not in have:
            raise LogError(f"the log has no topic {topic!r}", where=log.path, remedy=nearest(topic, have))
    return [topic for topic in spec.topics() if topic in have]


def collect(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, topics: Sequence[str]) -> dict[str, Track]:
    """Read a demonstration's messages once, each topic in order of its own clock.

    Compressed images wait as bytes until it is known which of them steps use; raw ones are resized as they come, so that an hour
    of raw video does not have to fit in memory."""
    views = {view.topic: view for view in spec.views.values()}
    clocks = spec.clocks()
    found: dict[str, list[tuple[int, Message | U8]]] = {topic: [] for topic in topics}
    for message in log.messages(topics, start_ns=demonstration.start_ns, end_ns=demonstration.end_ns):
        view = views.get(message.topic)
        waits = view is None or message.schema in decode.COMPRESSED_IMAGES
        value = message if view is None or waits else stored_image(message, view)
        found[message.topic].append((stamp_ns(message, clocks[message.topic]), value))
    for topic, entries in found.items():
        if not entries:
            raise LogError(
                f"no message on topic {topic!r}",
                where=f"{log.path}, {demonstration.name}",
                remedy="leave this log out, or take the topic out of the task TOML",
            )
    return {topic: _track(entries, topic) for topic, entries in found.items()}


def stamp_ns(message: Message, spec: TopicSpec | ActionSpec) -> int:
    """The message's time by the clock that the spec names, offset included."""
    if spec.clock == "header":
        stamp = decode.header_time_ns(message)
        if stamp is None:
            raise DecodeError(
                "its messages carry no stamp of their own",
                where=message.topic,
                found=message.schema,
                remedy='set clock = "log" for this topic',
            )
    else:
        stamp = message.log_time_ns if spec.clock == "log" else message.publish_time_ns
    return stamp + round(spec.offset_s * 1e9)


def stored_image(message: Message, view: ViewSpec) -> U8:
    """The image as it is stored: uint8 [H,W,3] at the view's size."""
    try:
        return geometry.fit_image(decode.decode_image(message), view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=message.topic, remedy=error.remedy) from error


def _track(entries: list[tuple[int, Message | U8]], topic: str) -> Track:
    stamps = np.array([stamp for stamp, _ in entries], np.int64)
    order = align.order_of(stamps, topic=topic)
    return Track(stamps[order], [entries[i][1] for i in order])


def _vectors(track: Track, spec: VectorSpec | ActionSpec) -> F64:
    """float64 [M,D] of a topic's messages."""
    read = decode.compile_fields(spec.fields, spec.names)
    rows = [read(message) for message in track.values if isinstance(message, Message)]
    if len(lengths := {len(row) for row in rows}) > 1:
        raise DecodeError(
            "vectors of different lengths",
            where=spec.topic,
            found=f"lengths {sorted(lengths)}",
            remedy="say which fields to read, or which joints by `names`",
        )
    return np.asarray(rows, np.float64).reshape(len(rows), -1)


# --- one value a step --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Vector:
    """A vector at every tick: values float64 [F,D], where it may be used bool [F], its age float32 [F]."""

    values: F64
    valid: Bool
    age_s: F32


def _observe_vector(spec: VectorSpec, tracks: Tracks, ticks: I64) -> _Vector:
    track = tracks[spec.topic]
    observed = align.observe(track.stamps_ns, ticks, stale_after_s=spec.stale_after_s)
    values = _vectors(track, spec)[np.maximum(observed.index, 0)]
    values[observed.index < 0] = np.nan
    return _Vector(values, observed.valid & np.isfinite(values).all(axis=1), observed.age_s)


def _stored_images(track: Track, index: align.Index, view: ViewSpec) -> tuple[U8, I32]:
    """The images that steps use, each once, uint8 [n,H,W,3]; and which of them each step sees, int32 [F]."""
    used, source_index = np.unique(np.maximum(index, 0), return_inverse=True)
    frames: U8 = np.empty((len(used), view.height, view.width, 3), np.uint8)
    for row, i in enumerate(used):
        value = track.values[i]
        frames[row] = stored_image(value, view) if isinstance(value, Message) else value
    return frames, source_index.astype(np.int32)


def _actions(spec: TaskSpec, tracks: Tracks, ticks: I64, low_dim: Mapping[str, _Vector], rate_hz: float) -> F64 | None:
    """float64 [F,A], NaN where no command is known; None for a log without commands, which may still be watched."""
    if not spec.action or any(part.topic is not None and part.topic not in tracks for part in spec.action.values()):
        return None
    period_ns = round(1e9 / rate_hz)
    return np.concatenate(
        [_action_part(part, tracks, ticks, low_dim, period_ns) for part in spec.action.values()], axis=1
    )


def _action_part(part: ActionSpec, tracks: Tracks, ticks: I64, low_dim: Mapping[str, _Vector], period_ns: int) -> F64:
    if part.topic is None:
        ahead = np.minimum(np.arange(len(ticks)) + part.shift, len(ticks) - 1)
        return low_dim[str(part.from_)].values[ahead]
    track = tracks[part.topic]
    values = _vectors(track, part)
    if part.kind == "delta":
        return align.sum_deltas(track.stamps_ns, values, ticks, period_ns=period_ns)
    if part.kind == "delta_rotation":
        if values.shape[1] != 3:
            raise SpecError(
                "a delta_rotation is an axis-angle vector of three numbers",
                where=part.topic,
                found=f"{values.shape[1]} numbers",
                remedy="name its three fields",
            )
        return align.compose_rotations(
            track.stamps_ns, values, ticks, period_ns=period_ns, tool_frame=part.frame == "tool"
        )
    index = align.command_in_force(track.stamps_ns, ticks, period_ns=period_ns)
    held = values[np.maximum(index, 0)]
    held[index < 0] = np.nan
    return held


# --- what the user should know -------------------------------------------------------------------------------------------


def refuse_short_stride(spec: TaskSpec, view_stamps: Mapping[str, I64], rate_hz: float) -> None:
    """SpecError where planned frames would lie closer than a camera's images: a planner would learn to copy."""
    stride_s = spec.window.frame_stride / rate_hz
    for view, stamps in view_stamps.items():
        period_s = 1 / align.median_rate_hz(stamps) if len(stamps) > 1 else 0.0
        if stride_s < 0.95 * period_s:
            raise SpecError(
                f"planned frames {stride_s:.3f} s apart are closer than view {view!r} takes images, every {period_s:.3f} s",
                remedy="raise window.frame_stride, or lower rate_hz",
            )


def _findings(valid: Mapping[str, Bool], images: Mapping[str, tuple[U8, I32]]) -> Iterator[str]:
    """Plain sentences about what was masked or repeated, with counts."""
    for name, usable in valid.items():
        if masked := int(np.count_nonzero(~usable)):
            where = f"{masked} of {len(usable)} steps, first at step {int(np.argmin(usable))}"
            yield f"{name}: missing, stale or not finite at {where}; those steps are masked"
    for view, (_, index) in images.items():
        if repeated := int(np.count_nonzero(np.diff(index) == 0)):
            yield f"view {view}: {repeated} of {len(index)} steps see the image of the step before"
