"""One demonstration of a log -> one Episode: the place where sources, decode, align and geometry meet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from vilp_data import align, decode, geometry
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, UsageError, nearest
from vilp_data.spec import ActionSpec, TaskSpec, TopicSpec, VectorSpec, ViewSpec
from vilp_data.types import F32, F64, I32, I64, U8, Bool, Episode, LogEpisode, LogReader, Message, Outcome

DAMAGED_SHARE = 0.5
"""More damaged images than this among those that steps use, and the episode is refused: that is no glitch."""

HELD_LONG_S = 1.0
"""A command in force for longer than this is worth a word: its publisher may have died."""

FAR_S = 60.0
"""Commands this far outside an episode were stamped by another clock."""


@dataclass(frozen=True)
class Track:
    """One topic's messages in order of its clock.

    stamps_ns  int64 [M]
    images     for a camera: each image, still compressed, or uint8 [H,W,3] at its stored size
    vectors    for other topics: "low_dim.<part>", "action.<part>" or "state" -> float64 [M,D]
    """

    stamps_ns: I64
    images: Sequence[Message | U8]
    vectors: Mapping[str, F64]


Tracks: TypeAlias = Mapping[str, Track]
VectorReader: TypeAlias = Callable[[Message], F64]


def assemble_episode(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, *, episode_id: str) -> Episode:
    """One demonstration on one control clock.

    Raises LogError, DecodeError, AlignError or SpecError, each saying what in the log or the spec is wrong."""
    where = f"{log.path}, {demonstration.name}"
    tracks = collect(log, demonstration, spec, available_topics(log, spec))
    view_stamps = {view: tracks[view_spec.topic].stamps_ns for view, view_spec in spec.views.items()}
    rate_hz = spec.rate_hz or min(align.median_rate_hz(stamps) for stamps in view_stamps.values())
    refuse_short_stride(spec, view_stamps, rate_hz)
    ticks = align.control_ticks(view_stamps, rate_hz)
    if len(ticks) < 2:
        raise AlignError("an episode of one step holds no motion to learn", where=where, remedy="leave this log out")

    views = {view: _observe_images(tracks[table.topic], ticks, table) for view, table in spec.views.items()}
    low_dim = {name: _observe_vector(table, f"low_dim.{name}", tracks, ticks) for name, table in spec.low_dim.items()}
    state = _observe_vector(spec.state, "state", tracks, ticks) if spec.state and spec.state.topic in tracks else None
    action = _actions(spec, tracks, ticks, low_dim, rate_hz)

    valid = {f"view {view}": images.valid for view, images in views.items()}
    valid |= {f"low_dim {name}": part.valid for name, part in low_dim.items()}
    valid |= {f"action {name}": part.valid for name, part in action.items()}
    findings = tuple(_findings(valid, views, action))
    usable: Bool = np.logical_and.reduce(list(valid.values()))
    if not usable.any():
        raise AlignError(
            "no step can be used",
            where=where,
            found="; ".join(findings),
            remedy="`vilp-data inspect` shows the clocks and gaps",
        )
    ages = {spec.views[view].topic: images.age_s for view, images in views.items()}
    ages |= {spec.low_dim[name].topic: part.age_s for name, part in low_dim.items()}
    ages |= {topic: part.age_s for name, part in action.items() if (topic := spec.action[name].topic) is not None}
    return Episode(
        id=episode_id,
        frames={view: images.frames for view, images in views.items()},
        source_index={view: images.source_index for view, images in views.items()},
        log_time_ns=ticks,
        low_dim=_columns(low_dim, len(ticks)),
        action=_columns(action, len(ticks)) if action else None,
        state=None if state is None else state.values,
        valid=usable,
        age_s=ages,
        rate_hz=float(rate_hz),
        tags=dict(demonstration.tags),
        outcome=outcome_of(demonstration.tags),
        findings=findings,
    )


def outcome_of(tags: Mapping[str, str]) -> Outcome:
    """What the log says of itself: its `success` tag, "true" or "false"."""
    outcomes: dict[str, Outcome] = {"true": "success", "false": "failure"}
    return outcomes.get(tags.get("success", "").lower(), "unknown")


# --- reading ------------------------------------------------------------------------------------------------------------


def available_topics(log: LogReader, spec: TaskSpec) -> list[str]:
    """The spec's topics that this log has messages on. Cameras and low_dim must all be there; commands all or none; the state
    may be absent. A topic that was announced and never used is absent."""
    have = {topic.name for topic in log.topics() if topic.message_count != 0}
    required = [view.topic for view in spec.views.values()] + [part.topic for part in spec.low_dim.values()]
    commands = [part.topic for part in spec.action.values() if part.topic is not None]
    if have.intersection(commands):
        required += commands
    for topic in required:
        if topic not in have:
            raise LogError(f"the log has no messages on topic {topic!r}", where=log.path, remedy=nearest(topic, have))
    return [topic for topic in spec.topics() if topic in have]


def collect(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, topics: Sequence[str]) -> dict[str, Track]:
    """Read a demonstration's messages once, each topic in order of its own clock.

    Vectors are read as they come. Compressed images wait as bytes until it is known which of them steps use; raw ones are
    resized as they come, so that an hour of raw video does not have to fit in memory."""
    views = {view.topic: view for view in spec.views.values()}
    clocks, readers = spec.clocks(), _vector_readers(spec)
    stamps: dict[str, list[int]] = {topic: [] for topic in topics}
    images: dict[str, list[Message | U8]] = {topic: [] for topic in topics}
    rows: dict[str, dict[str, list[F64]]] = {topic: {part: [] for part in readers.get(topic, {})} for topic in topics}
    for message in log.messages(topics, start_ns=demonstration.start_ns, end_ns=demonstration.end_ns):
        topic = message.topic
        stamps[topic].append(stamp_ns(message, clocks[topic]))
        if topic in views:
            waits = message.schema in decode.COMPRESSED_IMAGES
            images[topic].append(message if waits else stored_image(message, views[topic]))
        for part, read in readers.get(topic, {}).items():
            rows[topic][part].append(read(message))
    for topic in topics:
        if not stamps[topic]:
            where, remedy = (
                f"{log.path}, {demonstration.name}",
                "leave this log out, or take the topic out of the task TOML",
            )
            raise LogError(f"no message on topic {topic!r}", where=where, remedy=remedy)
    return {topic: _track(topic, stamps[topic], images[topic], rows[topic]) for topic in topics}


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


def _vector_readers(spec: TaskSpec) -> dict[str, dict[str, VectorReader]]:
    """topic -> part -> how to read that part's vector from a message."""
    tables: list[tuple[str, VectorSpec | ActionSpec]] = [
        (f"low_dim.{name}", table) for name, table in spec.low_dim.items()
    ]
    tables += [(f"action.{name}", table) for name, table in spec.action.items()]
    tables += [("state", spec.state)] if spec.state else []
    readers: dict[str, dict[str, VectorReader]] = {}
    for part, table in tables:
        if table.topic is not None:
            readers.setdefault(table.topic, {})[part] = decode.compile_fields(table.fields, table.names)
    return readers


def _track(topic: str, stamps: list[int], images: list[Message | U8], rows: Mapping[str, list[F64]]) -> Track:
    stamps_ns = np.array(stamps, np.int64)
    if len(stamps) > 1 and stamps_ns.min() == stamps_ns.max():
        found = f"{len(stamps)} messages, all stamped {stamps[0]} ns"
        raise AlignError("its stamps tell no time", where=topic, found=found, remedy='set clock = "log" for this topic')
    order = align.order_of(stamps_ns, topic=topic)
    vectors = {part: _stacked(topic, values)[order] for part, values in rows.items()}
    return Track(stamps_ns[order], [images[i] for i in order] if images else [], vectors)


def _stacked(topic: str, rows: Sequence[F64]) -> F64:
    if len(lengths := {len(row) for row in rows}) > 1:
        raise DecodeError(
            "vectors of different lengths",
            where=topic,
            found=f"lengths {sorted(lengths)}",
            remedy="say which fields to read, or which joints by `names`",
        )
    return np.asarray(rows, np.float64).reshape(len(rows), -1)


# --- one value a step ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Vector:
    """A vector at every tick: values float64 [F,D], where it may be used bool [F], its age float32 [F]."""

    values: F64
    valid: Bool
    age_s: F32


@dataclass(frozen=True)
class _Images:
    """A view's images that steps use, each once, uint8 [n,H,W,3]; which of them each step sees, int32 [F]; where it may be used
    and its age, bool and float32 [F]; how many images were damaged and passed over."""

    frames: U8
    source_index: I32
    valid: Bool
    age_s: F32
    damaged: int


def _observe_images(track: Track, ticks: I64, view: ViewSpec) -> _Images:
    """What the view shows at each tick. A damaged image is one that never came: the step sees the one before it."""
    kept = np.arange(len(track.stamps_ns))
    decoded: dict[int, U8] = {}
    while True:
        observed = align.observe(track.stamps_ns[kept], ticks, stale_after_s=view.stale_after_s)
        used, source_index = np.unique(np.maximum(observed.index, 0), return_inverse=True)
        damaged, error = _decode_missing(track, kept[used], view, decoded)
        if error is None:
            break
        if len(damaged) > DAMAGED_SHARE * len(used):
            raise error
        kept = kept[~np.isin(kept, damaged)]
    frames = np.stack([decoded[int(i)] for i in kept[used]])
    passed_over = len(track.stamps_ns) - len(kept)
    return _Images(frames, source_index.astype(np.int32), observed.valid, observed.age_s, passed_over)


def _decode_missing(
    track: Track, wanted: align.Index, view: ViewSpec, decoded: dict[int, U8]
) -> tuple[list[int], DecodeError | None]:
    """Decode what is not decoded yet; the indices of damaged images, and the first one's error."""
    damaged: list[int] = []
    first: DecodeError | None = None
    for i in map(int, wanted):
        image = track.images[i]
        if i in decoded:
            continue
        if not isinstance(image, Message):
            decoded[i] = image
            continue
        try:
            decoded[i] = stored_image(image, view)
        except DecodeError as error:
            damaged.append(i)
            first = first or error
    return damaged, first


def _observe_vector(spec: VectorSpec, part: str, tracks: Tracks, ticks: I64) -> _Vector:
    track = tracks[spec.topic]
    observed = align.observe(track.stamps_ns, ticks, stale_after_s=spec.stale_after_s)
    values = track.vectors[part][np.maximum(observed.index, 0)]
    values[observed.index < 0] = np.nan
    return _Vector(values, observed.valid & _finite(values), observed.age_s)


def _actions(
    spec: TaskSpec, tracks: Tracks, ticks: I64, low_dim: Mapping[str, _Vector], rate_hz: float
) -> dict[str, _Vector]:
    """The action's parts at every tick; empty for a log without commands, which may still be watched."""
    if any(part.topic is not None and part.topic not in tracks for part in spec.action.values()):
        return {}
    period_ns = round(1e9 / rate_hz)
    return {
        name: _action_part(part, f"action.{name}", tracks, ticks, low_dim, period_ns)
        for name, part in spec.action.items()
    }


def _action_part(
    part: ActionSpec, name: str, tracks: Tracks, ticks: I64, low_dim: Mapping[str, _Vector], period_ns: int
) -> _Vector:
    if part.topic is None:
        source = low_dim[str(part.from_)]
        ahead = np.minimum(np.arange(len(ticks)) + part.shift, len(ticks) - 1)
        return _Vector(source.values[ahead], source.valid[ahead], np.zeros(len(ticks), np.float32))
    stamps, values = tracks[part.topic].stamps_ns, tracks[part.topic].vectors[name]
    _refuse_foreign_commands(part, stamps, ticks, period_ns)
    if part.kind == "absolute":
        index = align.command_in_force(stamps, ticks, period_ns=period_ns)
        held = values[np.maximum(index, 0)]
        held[index < 0] = np.nan
        age = np.where(index < 0, np.nan, np.maximum(ticks - stamps[np.maximum(index, 0)], 0) / 1e9)
        return _Vector(held, _finite(held), age.astype(np.float32))
    if part.kind == "delta":
        moved = align.sum_deltas(stamps, values, ticks, period_ns=period_ns)
    elif values.shape[1] == 3:
        moved = align.compose_rotations(stamps, values, ticks, period_ns=period_ns, tool_frame=part.frame == "tool")
    else:
        found, remedy = f"{values.shape[1]} numbers", "name its three fields"
        raise SpecError(
            "a delta_rotation is an axis-angle vector of three numbers", where=part.topic, found=found, remedy=remedy
        )
    return _Vector(moved, _finite(moved), np.zeros(len(ticks), np.float32))


def _columns(parts: Mapping[str, _Vector], n_steps: int) -> F32:
    """The parts side by side, float32 [F,·]; zero where a value is not known (those steps are masked)."""
    values = np.concatenate([*(part.values for part in parts.values()), np.zeros((n_steps, 0))], axis=1)
    return np.where(np.isfinite(values), values, 0).astype(np.float32)


def _finite(values: F64) -> Bool:
    """bool [F]: rows that hold numbers only."""
    return np.asarray(np.isfinite(values).all(axis=1))


# --- what the user should know ------------------------------------------------------------------------------------------


def _refuse_foreign_commands(part: ActionSpec, stamps: I64, ticks: I64, period_ns: int) -> None:
    """AlignError where no command falls into the episode: deltas would all be zero, and a target held from a minute before, or
    still to come, was stamped by another clock than the cameras."""
    inside = (stamps >= ticks[0] - align.TOLERANCE_NS) & (stamps < ticks[-1] + period_ns)
    if inside.any():
        return
    away_s = min(abs(int(stamps[-1]) - int(ticks[0])), abs(int(stamps[0]) - int(ticks[-1]))) / 1e9
    if part.kind != "absolute" or away_s > FAR_S or stamps[0] >= ticks[-1]:
        raise AlignError(
            "none of the commands falls into the time of the images",
            where=part.topic,
            found=f"{len(stamps)} commands, the nearest {away_s:.1f} s away",
            remedy='compare the clocks with `vilp-data inspect`; set clock = "log", or offset_s, for this topic',
        )


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


def _findings(valid: Mapping[str, Bool], views: Mapping[str, _Images], action: Mapping[str, _Vector]) -> Iterator[str]:
    """Plain sentences about what was masked, repeated, damaged or held, with counts."""
    for name, usable in valid.items():
        if masked := int(np.count_nonzero(~usable)):
            where = f"{masked} of {len(usable)} steps, first at step {int(np.argmin(usable))}"
            yield f"{name}: missing, stale or not finite at {where}; those steps are masked"
    for view, images in views.items():
        if images.damaged:
            yield f"view {view}: {images.damaged} damaged images passed over"
        repeated, n_steps = int(np.count_nonzero(np.diff(images.source_index) == 0)), len(images.source_index)
        if repeated:
            advice = (
                "; a camera at the control rate does that when its clock jitters: lower rate_hz"
                if repeated > n_steps // 10
                else ""
            )
            yield f"view {view}: {repeated} of {n_steps} steps see the image of the step before{advice}"
    for name, part in action.items():
        if held := int(np.count_nonzero(part.age_s > HELD_LONG_S)):
            yield f"action {name}: the command in force is older than {HELD_LONG_S:g} s at {held} of {len(part.age_s)} steps"
