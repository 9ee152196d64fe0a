"""One demonstration of a log -> one Episode: the place where sources, decode, align and geometry meet."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vilp_data import align
from vilp_data.errors import AlignError, LogError, SpecError, nearest
from vilp_data.held_messages import messages_before, static_messages
from vilp_data.sources import IndexedLog
from vilp_data.spec import ActionSpec, TaskSpec, VectorSpec
from vilp_data.types import F32, F64, I64, Bool, ColumnNames, Episode, LogEpisode, LogReader, outcome_of
from vilp_data.vector_tracks import FieldsTrack, Track, Tracks, VectorTracks, age_names, no_message, stamp_ns
from vilp_data.video_start import packets_before
from vilp_data.view_frames import Seen, Ticks, ViewFrames

HELD_LONG_S = 1.0
"""A command in force for longer than this is worth a word: its publisher may have died."""

FAR_S = 60.0
"""Commands this far outside an episode were stamped by another clock."""


@dataclass(frozen=True)
class Collected:
    """What was read of a demonstration: the stamps of each view's images, int64 [M] in order, its frames, and each part's vectors."""

    stamps_ns: Mapping[str, I64]
    frames: Mapping[str, ViewFrames]
    tracks: Tracks


def assemble_episode(
    log: IndexedLog, demonstration: LogEpisode, spec: TaskSpec, *, episode_id: str, scratch: Path | None = None
) -> Episode:
    """One demonstration on one control clock. What of its frames does not fit in memory lies in an unnamed file in `scratch`, and is
    mapped.

    Raises LogError, DecodeError, AlignError or SpecError, each saying what in the log or the spec is wrong."""
    where = f"{log.path}, {demonstration.name}"
    topics, guess = available_topics(log, spec), Ticks(spec.rate_hz, len(spec.views))
    collected = collect(log, demonstration, spec, topics, guess, scratch=scratch)
    rate_hz = spec.rate_hz or min(align.median_rate_hz(stamps) for stamps in collected.stamps_ns.values())
    refuse_short_stride(spec, collected.stamps_ns, rate_hz)
    by_view = {f"view {view}": stamps for view, stamps in collected.stamps_ns.items()}
    ticks = align.control_ticks(by_view or _vector_stamps(collected.tracks), rate_hz)
    if (
        spec.views and guess.start_ns != ticks[0] and guess.rate_hz is not None
    ):  # a first image came late: some were left out that steps see
        known = Ticks(rate_hz, len(spec.views), start_ns=int(ticks[0]))
        collected = collect(log, demonstration, spec, topics, known, scratch=scratch)
    if len(ticks) < 2:
        raise AlignError("an episode of one step holds no motion to learn", where=where, remedy="leave this log out")

    tracks = collected.tracks
    views = {view: collected.frames[view].observe(ticks) for view in spec.views}
    low_dim = {name: _observe_vector(table, tracks[f"low_dim.{name}"], ticks) for name, table in spec.low_dim.items()}
    state = _observe_vector(spec.state, tracks["state"], ticks) if spec.state and "state" in tracks else None
    action = _actions(spec, tracks, ticks, low_dim, rate_hz)

    valid = {f"view {view}": images.valid for view, images in views.items()}
    valid |= {f"low_dim {name}": part.valid for name, part in low_dim.items()}
    valid |= {f"action {name}": part.valid for name, part in action.items()}
    findings = (*_findings(valid, views, action), *_named_two_ways(tracks))
    usable: Bool = np.logical_and.reduce(list(valid.values()))
    if not usable.any():
        raise AlignError(
            "no step can be used",
            where=where,
            found="; ".join(findings),
            remedy="`vilp-data inspect` shows the clocks and gaps",
        )
    ages = {spec.views[view].topic: images.age_s for view, images in views.items()}
    vectors = {f"low_dim.{name}": part for name, part in low_dim.items()}
    vectors |= {f"action.{name}": part for name, part in action.items()}
    ages |= {name: vectors[part].age_s for part, name in age_names(spec).items() if part in vectors}
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
        column_names=column_names(spec, {part: tracks[part].column_names for part in tracks}, has_action=bool(action)),
    )


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


def collect(
    log: IndexedLog,
    demonstration: LogEpisode,
    spec: TaskSpec,
    topics: Sequence[str],
    ticks: Ticks,
    *,
    scratch: Path | None = None,
) -> Collected:
    """Read a demonstration's messages once: each part's in order of its topic's clock, and each view's images as far as steps see them;
    and of what came before it, what still holds.

    Vectors are read and images decoded as they come, so that the log does not have to fit in memory."""
    views = {
        table.topic: ViewFrames(view, table, ticks, scratch=scratch)
        for view, table in sorted(spec.views.items())
        if table.topic in topics
    }
    for topic, view in views.items():
        view.warm_up(packets_before(log, topic, demonstration))
    vectors = VectorTracks(spec, topics, demonstration, {topic.name: topic.names for topic in log.topics()})
    _add_held(log, demonstration, spec, vectors, topics)
    for message in log.messages(topics, start_ns=demonstration.start_ns, end_ns=demonstration.end_ns):
        if (camera := views.get(message.topic)) is not None:
            camera.add(message, stamp_ns(message, camera.spec))
        vectors.add(message)
    while missed := vectors.read_again():
        _add_held(log, demonstration, spec, vectors, missed)
        for message in log.messages(missed, start_ns=demonstration.start_ns, end_ns=demonstration.end_ns):
            vectors.add(message)
    where = f"{log.path}, {demonstration.name}"
    in_order: dict[str, I64] = {}
    for topic, view in views.items():
        if not len(view.stamps_ns):
            raise no_message(topic, where)
        stamps_ns, order = align.in_time(view.stamps_ns, topic=topic)
        in_order[view.view] = stamps_ns[order]
    return Collected(in_order, {view.view: view for view in views.values()}, vectors.tracks(where))


def _add_held(
    log: IndexedLog, demonstration: LogEpisode, spec: TaskSpec, vectors: VectorTracks, topics: Collection[str]
) -> None:
    """Static transforms are of all of the log; the rest came before the demonstration."""
    for message in static_messages(log, vectors.static_topics):
        vectors.add_static(message)
    for message in messages_before(log, demonstration, spec, topics):
        vectors.add(message)


def _vector_stamps(tracks: Tracks) -> dict[str, I64]:
    """What a task without views takes its steps from: the stamps of its low_dim parts."""
    stamps = {part: track.known_ns() for part, track in tracks.items() if part.startswith("low_dim.")}
    if short := [part for part, times in stamps.items() if not len(times)]:
        found = "nothing that ever changes, or no number"
        raise AlignError(
            f"{short[0]} tells no time", found=found, remedy="give the task a view, or another low_dim part"
        )
    return stamps


# --- one value a step ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Vector:
    """A vector at every tick: values float64 [F,D], where it may be used bool [F], its age float32 [F]."""

    values: F64
    valid: Bool
    age_s: F32


def _observe_vector(spec: VectorSpec, track: Track, ticks: I64) -> _Vector:
    latest = track.at(ticks + align.TOLERANCE_NS)
    age_s = latest.age_s(ticks)
    fresh = np.nan_to_num(age_s, nan=np.inf) <= spec.stale_after_s
    return _Vector(latest.values, fresh & _storable(latest.values), age_s.astype(np.float32))


def _actions(
    spec: TaskSpec, tracks: Tracks, ticks: I64, low_dim: Mapping[str, _Vector], rate_hz: float
) -> dict[str, _Vector]:
    """The action's parts at every tick; empty for a log without commands, which may still be watched."""
    if any(part.topic is not None and f"action.{name}" not in tracks for name, part in spec.action.items()):
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
    track = tracks[name]
    _refuse_foreign_commands(part, track, ticks, period_ns)
    if not isinstance(track, FieldsTrack) or part.kind == "absolute":
        latest = track.at(align.last_instants(ticks, period_ns=period_ns))
        return _Vector(latest.values, _storable(latest.values), latest.age_s(ticks).astype(np.float32))
    stamps, values = track.stamps_ns, track.values
    if part.kind == "delta":
        moved = align.sum_deltas(stamps, values, ticks, period_ns=period_ns)
    elif values.shape[1] == 3:
        moved = align.compose_rotations(stamps, values, ticks, period_ns=period_ns, tool_frame=part.frame == "tool")
    else:
        found, remedy = f"{values.shape[1]} numbers", "name its three fields"
        raise SpecError(
            "a delta_rotation is an axis-angle vector of three numbers", where=part.topic, found=found, remedy=remedy
        )
    return _Vector(moved, _storable(moved), np.zeros(len(ticks), np.float32))


def _columns(parts: Mapping[str, _Vector], n_steps: int) -> F32:
    """The parts side by side, float32 [F,·]; zero where a value is not known (those steps are masked)."""
    values = _as_stored(np.concatenate([*(part.values for part in parts.values()), np.zeros((n_steps, 0))], axis=1))
    return np.where(np.isfinite(values), values, np.float32(0))


def _storable(values: F64) -> Bool:
    """bool [F]: rows that hold numbers only, when stored too: what is beyond any float32 is no reading."""
    return np.asarray(np.isfinite(_as_stored(values)).all(axis=1))


def _as_stored(values: F64) -> F32:
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def column_names(spec: TaskSpec, told: Mapping[str, Sequence[str]], *, has_action: bool) -> ColumnNames:
    """`Episode.column_names`, of what is told of the parts ("low_dim.<name>", "action.<name>") that are read from messages."""
    found: dict[str, dict[str, list[str]]] = {}
    for part in spec.low_dim:
        if names := told.get(f"low_dim.{part}"):
            found.setdefault("low_dim", {})[part] = list(names)
    for part, table in spec.action.items() if has_action else ():
        if names := told.get(f"low_dim.{table.from_}" if table.from_ else f"action.{part}"):
            found.setdefault("action", {})[part] = list(names)
    return found


# --- what the user should know ------------------------------------------------------------------------------------------


def _refuse_foreign_commands(part: ActionSpec, track: Track, ticks: I64, period_ns: int) -> None:
    """AlignError where no command falls into the episode: deltas would all be zero, and a target held from a minute before, or
    still to come, was stamped by another clock than the cameras; unless the recorder too received it so long before."""
    stamps = track.stamps_ns
    inside = (stamps >= ticks[0] - align.TOLERANCE_NS) & (stamps < ticks[-1] + period_ns)
    if inside.any():
        return
    away_s = min(abs(int(stamps[-1]) - int(ticks[0])), abs(int(stamps[0]) - int(ticks[-1]))) / 1e9
    if part.kind != "absolute" or away_s > FAR_S + track.held_s or stamps[0] >= ticks[-1]:
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


def _named_two_ways(tracks: Tracks) -> Iterator[str]:
    for part, track in tracks.items():
        if track.names_differ:
            yield (
                f"{part.replace('.', ' ')}: messages of its topic name their numbers differently, so its columns may not mean the same"
                " throughout; `names` in the task reads joints in one order"
            )


def _findings(valid: Mapping[str, Bool], views: Mapping[str, Seen], action: Mapping[str, _Vector]) -> Iterator[str]:
    """Plain sentences about what was masked, repeated, damaged or held, with counts."""
    for name, usable in valid.items():
        if masked := int(np.count_nonzero(~usable)):
            where = f"{masked} of {len(usable)} steps, first at step {int(np.argmin(usable))}"
            yield f"{name}: missing, stale or not finite at {where}; those steps are masked"
    for view, images in views.items():
        if images.damaged:
            early = (
                f", {images.before_keyframe} of them video before its first keyframe" if images.before_keyframe else ""
            )
            yield f"view {view}: {images.damaged} damaged images passed over{early}"
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
