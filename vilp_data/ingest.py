"""Logs + a task spec -> episodes: read, decode, align, resize, store. The one place where sources, decode and align meet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vilp_data import align, decode, geometry, shards
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, UsageError, VilpDataError, nearest
from vilp_data.keys import episode_key
from vilp_data.sources import open_log
from vilp_data.spec import ActionSpec, TaskSpec, TopicSpec, VectorSpec, ViewSpec
from vilp_data.types import F32, F64, I32, I64, U8, Bool, Episode, LogEpisode, LogReader, Message, Outcome

EPISODES_PER_JOB = 8
"""Demonstrations of one log that a worker takes at a time: few enough to share the work, many enough to open the log seldom."""


@dataclass(frozen=True)
class IngestJob:
    """Some demonstrations of one log, for one worker."""

    root: Path
    spec: TaskSpec
    log: Path
    log_sha256: str
    episodes: tuple[tuple[str, LogEpisode], ...]


@dataclass
class IngestReport:
    """What became of every demonstration found in the logs."""

    written: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    findings: dict[str, tuple[str, ...]] = field(default_factory=dict)


# --- the whole ---------------------------------------------------------------------------------------------------------


def ingest_logs(
    logs: Sequence[Path], root: Path, spec: TaskSpec, *, workers: int, include_failures: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> IngestReport:  # fmt: skip
    """Ingest every demonstration of `logs` into the dataset at `root`. What is there under today's key is left alone; what cannot
    be read is reported and keeps nothing else back. `progress(done, total)` counts demonstrations.

    Raises UsageError where no log is found at a path, BusyError where another process writes the dataset."""
    paths = find_logs(logs)
    store = EpisodeStore(root)
    report = IngestReport()
    with shards.writer_lock(root):
        store.write_spec(spec)
        jobs = plan_jobs(paths, store, spec, report, include_failures=include_failures)
        total = sum(len(job.episodes) for job in jobs)
        if total:
            store.remove_index()
        done = 0
        for job, results in map_unordered(ingest_job, jobs, workers=workers if total > 1 else 1):
            for (episode_id, _), result in zip(job.episodes, results, strict=True):
                done += 1
                if isinstance(result, VilpDataError):
                    report.failed.append((episode_id, str(result)))
                else:
                    report.written.append(episode_id)
                    if result:
                        report.findings[episode_id] = result
            if progress is not None:
                progress(done, total)
        if not store.index_path.is_file():
            store.write_index()
    report.written.sort()
    report.failed.sort()
    return report


def find_logs(paths: Sequence[Path]) -> list[Path]:
    """The logs at `paths`: a path that is a log itself, or every log in a folder. Sorted; UsageError for a path without any."""
    found: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise UsageError("no such file or folder", where=path, remedy="check the path")
        if path.is_dir() and not (path / ".zgroup").is_file() and not (path / "zarr.json").is_file():
            inside = [*sorted(path.rglob("*.mcap")), *sorted(p.parent for p in path.rglob("*.zarr/.zgroup"))]
            if not inside:
                raise UsageError("no logs in this folder", where=path, found="no *.mcap file and no *.zarr folder", remedy="give the logs themselves, or their folder")
            found.update(dict.fromkeys(inside))
        else:
            found[path] = None
    return list(found)


def plan_jobs(paths: Sequence[Path], store: EpisodeStore, spec: TaskSpec, report: IngestReport, *, include_failures: bool) -> list[IngestJob]:
    """What there is to do; fills `report` with what there is not (fresh, left out, unreadable)."""
    fields = spec.ingest_fields()
    present = {entry.id: entry for entry in store.index()}
    by_origin = {(entry.source_sha256, entry.source_episode): entry.id for entry in present.values()}
    jobs: list[IngestJob] = []
    for path in paths:
        try:
            with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
                sha256, demonstrations = log.sha256(), log.episodes()
        except LogError as error:
            report.failed.append((path.name, str(error)))
            continue
        todo: list[tuple[str, LogEpisode]] = []
        for demonstration in demonstrations:
            origin = (sha256, demonstration.name)
            episode_id = by_origin.get(origin) or _free_id(path, demonstration, sha256, present.keys() | by_origin.values(), only=len(demonstrations) == 1)
            key = episode_key(source_sha256=sha256, source_episode=demonstration.name, ingest_fields=fields)
            if episode_id in present and present[episode_id].key == key:
                report.fresh.append(episode_id)
            elif outcome_of(demonstration.tags) == "failure" and not include_failures:
                report.left_out.append(episode_id)
            elif origin not in by_origin or episode_id in present:
                todo.append((episode_id, demonstration))
            by_origin[origin] = episode_id
        jobs += [IngestJob(store.root, spec, path, sha256, tuple(todo[i : i + EPISODES_PER_JOB])) for i in range(0, len(todo), EPISODES_PER_JOB)]
    return jobs


def _free_id(path: Path, demonstration: LogEpisode, sha256: str, taken: set[str], *, only: bool) -> str:
    name = path.stem if only else f"{path.stem}-{demonstration.name}"
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
    return name if name not in taken else f"{name}-{sha256[:8]}"


def ingest_job(job: IngestJob) -> list[tuple[str, ...] | VilpDataError]:
    """Ingest and store each demonstration of a job: its findings, or the error that kept it out."""
    store = EpisodeStore(job.root)
    results: list[tuple[str, ...] | VilpDataError] = []
    with open_log(job.log, array_rate_hz=job.spec.rate_hz or 10.0) as log:
        for episode_id, demonstration in job.episodes:
            try:
                episode = read_episode(log, demonstration, job.spec, episode_id=episode_id)
            except (LogError, DecodeError, AlignError, SpecError) as error:
                results.append(error)
                continue
            fields = job.spec.ingest_fields()
            key = episode_key(source_sha256=job.log_sha256, source_episode=demonstration.name, ingest_fields=fields)
            store.write(episode, Origin(job.log.name, job.log_sha256, demonstration.name, key, fields))
            results.append(episode.findings)
    return results


# --- one demonstration ---------------------------------------------------------------------------------------------------


def read_episode(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, *, episode_id: str) -> Episode:
    """One demonstration on one control clock. Raises LogError, DecodeError or AlignError, each saying what in the log is wrong."""
    wanted = available_topics(log, spec)
    messages = collect(log, demonstration, spec, wanted)
    views = {view: Track.of(messages[view_spec.topic], view_spec) for view, view_spec in spec.views.items()}
    rate_hz = spec.rate_hz or min(align.median_rate_hz(track.stamps_ns) for track in views.values())
    _refuse_short_stride(spec, views, rate_hz)
    ticks = align.control_ticks({view: track.stamps_ns for view, track in views.items()}, rate_hz)
    if len(ticks) < 2:
        raise AlignError("an episode of one step holds no motion to learn", where=f"{log.path}, {demonstration.name}", remedy="leave this log out")

    seen = {view: align.observe(track.stamps_ns, ticks, stale_after_s=spec.views[view].stale_after_s) for view, track in views.items()}
    ages = {spec.views[view].topic: observed.age_s for view, observed in seen.items()}
    valid: Bool = np.logical_and.reduce([observed.valid for observed in seen.values()])
    low_dim_parts, low_dim_ages, low_dim_valid = _observe_vectors(spec.low_dim, messages, ticks)
    state = _observe_state(spec.state, messages, ticks) if spec.state and spec.state.topic in messages else None
    action, action_valid = _actions(spec, messages, ticks, low_dim_parts, rate_hz)
    valid = valid & low_dim_valid & action_valid
    low_dim = np.concatenate([*low_dim_parts.values(), np.zeros((len(ticks), 0))], axis=1).astype(np.float32)
    frames, source_index = {}, {}
    for view, track in views.items():
        frames[view], source_index[view] = _stored_frames(track, seen[view].index, spec.views[view])
    return Episode(
        id=episode_id, frames=frames, source_index=source_index, log_time_ns=ticks, low_dim=np.nan_to_num(low_dim),
        action=None if action is None else np.nan_to_num(action).astype(np.float32), state=state, valid=valid, age_s={**ages, **low_dim_ages},
        rate_hz=float(rate_hz), tags=dict(demonstration.tags), outcome=outcome_of(demonstration.tags),
        findings=tuple(_findings(spec, seen, low_dim_valid, action_valid, valid)),
    )  # fmt: skip


@dataclass(frozen=True)
class Track:
    """One topic's messages in order of its clock: stamps int64 [M] and the values, in the same order."""

    stamps_ns: I64
    values: list[Message | U8]

    @classmethod
    def of(cls, collected: Sequence[tuple[Message, Message | U8]], spec: TopicSpec | ActionSpec) -> Track:
        stamps = np.array([stamp_ns(message, spec) for message, _ in collected], np.int64)
        order = align.order_of(stamps, topic=str(spec.topic))
        return cls(stamps[order], [collected[i][1] for i in order])

    def vectors(self, spec: VectorSpec | ActionSpec) -> F64:
        read = decode.compile_fields(spec.fields, spec.names)
        rows = [read(value) for value in self.values if isinstance(value, Message)]
        if len({len(row) for row in rows}) > 1:
            raise DecodeError("vectors of different lengths", where=spec.topic, found=f"lengths {sorted({len(row) for row in rows})}", remedy="name the fields to read, or the joints by `names`")
        return np.asarray(rows, np.float64).reshape(len(rows), -1)


def outcome_of(tags: Mapping[str, str]) -> Outcome:
    """What the log says of itself: its `success` tag, "true" or "false"."""
    return {"true": "success", "false": "failure"}.get(tags.get("success", "").lower(), "unknown")  # type: ignore[return-value]


def stamp_ns(message: Message, spec: TopicSpec | ActionSpec) -> int:
    """The message's time by the clock that the spec names, offset included."""
    if spec.clock == "header":
        stamp = decode.header_time_ns(message)
        if stamp is None:
            raise DecodeError("its messages carry no stamp of their own", where=message.topic, found=message.schema, remedy='set clock = "log" for this topic')
    else:
        stamp = message.log_time_ns if spec.clock == "log" else message.publish_time_ns
    return stamp + round(spec.offset_s * 1e9)


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


def collect(log: LogReader, demonstration: LogEpisode, spec: TaskSpec, topics: Sequence[str]) -> dict[str, list[tuple[Message, Message | U8]]]:
    """Read a demonstration's messages once. Compressed images wait as bytes until it is known which are used; raw ones are
    resized as they come, so that an hour of raw video does not have to fit in memory."""
    views = {view.topic: view for view in spec.views.values()}
    out: dict[str, list[tuple[Message, Message | U8]]] = {topic: [] for topic in topics}
    for message in log.messages(topics, start_ns=demonstration.start_ns, end_ns=demonstration.end_ns):
        view = views.get(message.topic)
        if view is None or decode.is_compressed(message):
            out[message.topic].append((message, message))
        else:
            out[message.topic].append((_without_body(message), _stored_image(message, view)))
    for topic, messages in out.items():
        if not messages:
            raise LogError(f"no message on topic {topic!r}", where=f"{log.path}, {demonstration.name}", remedy="leave this log out, or take the topic out of the task TOML")
    return out


def _without_body(message: Message) -> Message:
    return Message(message.topic, message.schema, message.log_time_ns, message.publish_time_ns, decode.header_of(message))


def _stored_image(message: Message, view: ViewSpec) -> U8:
    try:
        return geometry.fit_image(decode.decode_image(message), view.height, view.width, view.fit)
    except UsageError as error:
        raise SpecError(error.what, where=message.topic, remedy=error.remedy) from error


def _stored_frames(track: Track, index: align.Index, view: ViewSpec) -> tuple[U8, I32]:
    """The images that steps use, each once, uint8 [n,H,W,3], and which of them each step sees, int32 [F]."""
    used, source_index = np.unique(np.maximum(index, 0), return_inverse=True)
    frames: U8 = np.empty((len(used), view.height, view.width, 3), np.uint8)
    for row, i in enumerate(used):
        value = track.values[i]
        frames[row] = _stored_image(value, view) if isinstance(value, Message) else value
    return frames, source_index.astype(np.int32)


def _observe_vectors(parts: Mapping[str, VectorSpec], messages: Mapping[str, Sequence[tuple[Message, Message | U8]]], ticks: I64) -> tuple[dict[str, F64], dict[str, F32], Bool]:
    values: dict[str, F64] = {}
    ages: dict[str, F32] = {}
    valid: Bool = np.ones(len(ticks), np.bool_)
    for name, spec in parts.items():
        track = Track.of(messages[spec.topic], spec)
        observed = align.observe(track.stamps_ns, ticks, stale_after_s=spec.stale_after_s)
        values[name] = track.vectors(spec)[np.maximum(observed.index, 0)]
        ages[spec.topic] = observed.age_s
        valid &= observed.valid & np.isfinite(values[name]).all(axis=1)
    return values, ages, valid


def _observe_state(spec: VectorSpec, messages: Mapping[str, Sequence[tuple[Message, Message | U8]]], ticks: I64) -> F64:
    track = Track.of(messages[spec.topic], spec)
    observed = align.observe(track.stamps_ns, ticks, stale_after_s=spec.stale_after_s)
    state = track.vectors(spec)[np.maximum(observed.index, 0)]
    state[~observed.valid] = np.nan
    return state


def _actions(
    spec: TaskSpec, messages: Mapping[str, Sequence[tuple[Message, Message | U8]]], ticks: I64, low_dim: Mapping[str, F64], rate_hz: float
) -> tuple[F64 | None, Bool]:
    """float64 [F,A] and where it is known; None for a log without commands, which is then valid for watching."""
    everywhere: Bool = np.ones(len(ticks), np.bool_)
    if not spec.action or any(part.topic is not None and part.topic not in messages for part in spec.action.values()):
        return None, everywhere
    columns = [_action_part(part, messages, ticks, low_dim, round(1e9 / rate_hz)) for part in spec.action.values()]
    action = np.concatenate(columns, axis=1)
    return action, np.isfinite(action).all(axis=1)


def _action_part(part: ActionSpec, messages: Mapping[str, Sequence[tuple[Message, Message | U8]]], ticks: I64, low_dim: Mapping[str, F64], period_ns: int) -> F64:
    """float64 [F,D]; NaN where no command is known."""
    if part.from_ is not None:
        state = low_dim[part.from_]
        ahead = state[np.minimum(np.arange(len(ticks)) + part.shift, len(ticks) - 1)]
        return ahead
    assert part.topic is not None
    track = Track.of(messages[part.topic], part)
    values = track.vectors(part)
    if part.kind == "delta":
        return align.sum_deltas(track.stamps_ns, values, ticks, period_ns=period_ns)
    if part.kind == "delta_rotation":
        if values.shape[1] != 3:
            raise SpecError("a delta_rotation is an axis-angle vector of three numbers", where=part.topic, found=f"{values.shape[1]} numbers", remedy="name its three fields")
        return align.compose_rotations(track.stamps_ns, values, ticks, period_ns=period_ns, tool_frame=part.frame == "tool")
    index = align.command_in_force(track.stamps_ns, ticks, period_ns=period_ns)
    held = values[np.maximum(index, 0)]
    held[index < 0] = np.nan
    return held


def _refuse_short_stride(spec: TaskSpec, views: Mapping[str, Track], rate_hz: float) -> None:
    stride_s = spec.window.frame_stride / rate_hz
    for view, track in views.items():
        period_s = 1 / align.median_rate_hz(track.stamps_ns) if len(track.stamps_ns) > 1 else 0.0
        if stride_s < 0.95 * period_s:
            raise SpecError(
                f"planned frames {stride_s:.3f} s apart are closer than view {view!r} takes images, every {period_s:.3f} s",
                remedy="raise window.frame_stride (a planner would learn to copy frames), or lower rate_hz",
            )


def _findings(spec: TaskSpec, seen: Mapping[str, align.Observed], low_dim_valid: Bool, action_valid: Bool, valid: Bool) -> Iterator[str]:
    """Plain sentences about what was masked or repeated, with counts."""
    for view, observed in seen.items():
        if stale := int(np.count_nonzero(~observed.valid)):
            yield f"view {view}: no image younger than {spec.views[view].stale_after_s} s at {stale} of {len(valid)} steps"
        if repeated := int(np.count_nonzero(np.diff(observed.index) == 0)):
            yield f"view {view}: {repeated} of {len(valid)} steps see the image of the step before"
    if missing := int(np.count_nonzero(~low_dim_valid)):
        yield f"low_dim: missing, stale or not finite at {missing} of {len(valid)} steps"
    if missing := int(np.count_nonzero(~action_valid)):
        yield f"action: missing or not finite at {missing} of {len(valid)} steps"
    if masked := int(np.count_nonzero(~valid)):
        yield f"{masked} of {len(valid)} steps are masked; first at step {int(np.argmin(valid))}"
