"""Logs + a task spec -> the episode store: do what the plan says, and report what became of every demonstration."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Literal

from vilp_data import shards
from vilp_data.assemble import assemble_episode
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeEntry, EpisodeStore, Origin, describe
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, StoreError, UsageError, VilpDataError
from vilp_data.history import Recording, recording
from vilp_data.ingest_plan import KnownContent, Plan, Planned, make_plan
from vilp_data.log_files import find_logs
from vilp_data.log_hashes import HashCache
from vilp_data.removed import read_removed, removed_bytes, removed_path
from vilp_data.sources import IndexedLog, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import I64, RATE_TOLERANCE, Episode
from vilp_data.writer_lock import remove_leftovers, writer_lock

EPISODES_PER_JOB = 8
"""Demonstrations of one log that a worker takes at a time: few enough to share the work, many enough to open the log seldom."""


@dataclass(frozen=True)
class IngestJob:
    """Some demonstrations of one log, for one worker. `rate_hz`: that of the dataset's other episodes, None for the first. `known`: what
    a new demonstration may turn out to be, by content. `again`: what was removed is wanted. `hold`: where files are kept that are
    replaced."""

    root: Path
    spec: TaskSpec
    episodes: tuple[Planned, ...]
    rate_hz: float | None
    known: Mapping[str, tuple[KnownContent, ...]] = field(default_factory=dict)
    again: bool = False
    hold: Path | None = None


@dataclass(frozen=True)
class Ingested:
    """An episode that was stored, as `id`; or that is a known one in other bytes of its log, which is left as it is: stored, or removed on
    purpose."""

    id: str
    rate_hz: float
    findings: tuple[str, ...] = ()
    was: Literal["new", "stored", "removed"] = "new"


@dataclass
class IngestReport:
    """What became of every demonstration found in the logs.

    written, fresh, left_out  ids of episodes: stored now, there already, and not wanted since they failed
    rollouts     ids of a policy's own episodes, not wanted unless asked for
    removed      ids of episodes that were removed on purpose, not wanted unless asked for
    replaced     those of `written` that took the place of an episode with other content, since their log changed
    restated     those of `fresh` of which the task says something else now: another name, other tags
    failed       (id, or name of a log) and why nothing came of it
    findings     id -> what was masked or repeated in it
    notes        sentences about logs whose name was met before with other content
    passed_over  what is in the folders given and looks like a log, but is left open by its recorder, or a link that leads nowhere
    """

    written: list[str] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)
    restated: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    rollouts: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    findings: dict[str, tuple[str, ...]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    passed_over: list[str] = field(default_factory=list)


def ingest_logs(
    logs: Sequence[Path], root: Path, spec: TaskSpec, *, workers: int, include_failures: bool = False, with_rollouts: bool = False,
    again: bool = False, progress: Callable[[int, int], None] | None = None,
) -> IngestReport:  # fmt: skip
    """Ingest every demonstration of `logs` into the dataset at `root`. What is there under today's key is left alone; what cannot
    be read is reported and keeps nothing else back. `progress(done, total)` counts demonstrations. Which stored episode a changed
    log belongs to is said in `ingest_plan`. What was removed on purpose stays out, unless it is wanted `again`. It is one operation
    of the dataset's history, where it changes anything.

    Raises UsageError where no log is found at a path, or the dataset is of another task or spec, BusyError where another process
    writes it."""
    found = find_logs(logs)
    store = EpisodeStore(root)
    with writer_lock(root), recording(root, "ingest") as work:
        remove_leftovers(root)
        cache = HashCache(root)
        plan = make_plan(
            found.logs, store, spec, cache, include_failures=include_failures, with_rollouts=with_rollouts, again=again
        )
        cache.save()
        report = IngestReport(
            fresh=plan.fresh, left_out=plan.left_out, rollouts=plan.rollouts, removed=plan.removed, failed=plan.failed,
            notes=plan.notes, passed_over=[str(path) for path in found.passed_over],
        )  # fmt: skip
        if plan.fresh:
            _write_spec(store, spec, work)
        if plan.todo or plan.restated:
            work.begin()
            store.remove_index()
        report.restated = _rewrite(store, plan.restated, work)
        given = frozenset(plan.fresh)
        with closing(_ingest(plan, root, spec, workers, work.hold, again)) as results:  # no worker outlives the lock
            write_spec = partial(_write_spec, store, spec, work)
            met = _enter(results, report, on_first=write_spec, progress=progress, total=len(plan.todo))
        _keep_removed(root, [*report.written, *report.fresh], met, work)
        report.notes += _adopt(store, met, given, work)
        store.ensure_index()
        report.written.sort()
        report.failed.sort()
        report.replaced = sorted(plan.replaced.intersection(report.written))
    return report


def _enter(
    results: Iterable[tuple[Planned, Ingested | VilpDataError]], report: IngestReport, *, on_first: Callable[[], None],
    progress: Callable[[int, int], None] | None, total: int,
) -> dict[str, Planned]:  # fmt: skip
    """Enter what came of each demonstration into the report. The known episodes that some turned out to be, by id. `on_first` is called
    before the first one that was stored: a spec that fits no log must not become the dataset's."""
    met: dict[str, Planned] = {}
    for done, (planned, result) in enumerate(results, start=1):
        if isinstance(result, VilpDataError):
            report.failed.append((planned.id, str(result)))
        elif result.was != "new":
            met[result.id] = planned
            (report.fresh if result.was == "stored" else report.removed).append(result.id)
        else:
            if not report.written:
                on_first()
            report.written.append(result.id)
            report.findings |= {result.id: result.findings} if result.findings else {}
        if progress is not None:
            progress(done, total)
    return met


def _rewrite(store: EpisodeStore, entries: Sequence[EpisodeEntry], work: Recording) -> list[str]:
    for entry in entries:
        store.rewrite_entry(entry, hold=work.hold)
    return sorted(entry.id for entry in entries)


def _adopt(store: EpisodeStore, met: Mapping[str, Planned], given: Set[str], work: Recording) -> Iterator[str]:
    """Stored episodes that were met in other bytes of their log are known by those from now on, so that these are not decoded again;
    unless the log they came from was given too. A sentence about each."""
    entries = {entry.id: entry for entry in store.index()} if met else {}
    for id in sorted(met.keys() & entries.keys()):
        entry, source = entries[id], met[id].source
        if id in given:
            yield f"{source.log}, {source.demonstration.name}: shows the same as {id}; taken once"
            continue
        log, name = source.log.name, source.demonstration.name
        today = replace(entry, source=log, source_sha256=source.sha256, source_episode=name, cut=source.place)
        store.rewrite_entry(today, hold=work.hold)
        yield f"{source.log}, {source.demonstration.name}: is {id}, in other bytes than before"


def _write_spec(store: EpisodeStore, spec: TaskSpec, work: Recording) -> None:
    if not store.has_spec(spec):
        work.begin()
        work.keep("dataset.json")
        store.write_spec(spec)


def _keep_removed(root: Path, stored: Sequence[str], met: Mapping[str, Planned], work: Recording) -> None:
    """What is stored is not removed any more, having been wanted again. What was met in other bytes of its log is known by those too."""
    removed = read_removed(root)
    left = {id: episode for id, episode in removed.items() if id not in stored}
    for id in left.keys() & met.keys():
        source = met[id].source
        left[id] = replace(left[id], source=source.log.name, source_sha256=source.sha256, cut=source.place)
    if left != removed:
        work.begin()
        work.keep(removed_path(root).name)
        shards.write_atomic(removed_path(root), removed_bytes(left))


def _ingest(
    plan: Plan, root: Path, spec: TaskSpec, workers: int, hold: Path | None, again: bool
) -> Generator[tuple[Planned, Ingested | VilpDataError], None, None]:
    """Do what is to do. Where the spec states no rate, the first episode by id sets it for the dataset, and so goes before the
    others: which are refused must not depend on the order in which workers end."""
    rate_hz, todo = plan.rate_hz, list(plan.todo)
    while spec.rate_hz is None and rate_hz is None and todo:
        first = min(todo, key=lambda planned: planned.id)
        todo.remove(first)
        (result,) = ingest_job(IngestJob(root, spec, (first,), None, plan.known, again, hold))
        rate_hz = None if isinstance(result, VilpDataError) else result.rate_hz
        yield first, result
    jobs: list[IngestJob] = []
    for _, group in groupby(todo, key=lambda planned: planned.source.log):
        episodes = list(group)
        parts = [tuple(episodes[i : i + EPISODES_PER_JOB]) for i in range(0, len(episodes), EPISODES_PER_JOB)]
        jobs += [IngestJob(root, spec, part, rate_hz, plan.known, again, hold) for part in parts]
    with closing(map_unordered(ingest_job, jobs, workers=workers if len(jobs) > 1 else 1)) as finished:
        for job, results in finished:
            yield from zip(job.episodes, results, strict=True)


def ingest_job(job: IngestJob) -> list[Ingested | VilpDataError]:
    """Ingest and store each demonstration of a job: what came of it, or the error that kept it out."""
    try:
        with open_log(job.episodes[0].source.log, array_rate_hz=job.spec.rate_hz or 10.0) as log:
            return [_ingest_one(log, planned, job) for planned in job.episodes]
    except (LogError, UsageError) as error:  # it was readable when the plan was made
        return [error] * len(job.episodes)


def _ingest_one(log: IndexedLog, planned: Planned, job: IngestJob) -> Ingested | VilpDataError:
    source = planned.source
    try:
        episode = assemble_episode(log, source.demonstration, job.spec, episode_id=planned.id, scratch=job.root)
        _refuse_another_rate(episode, job.rate_hz, source.log)
    except (LogError, DecodeError, AlignError, SpecError) as error:
        return error
    except MemoryError:
        where = f"{source.log}, {source.demonstration.name}"
        return LogError(
            "does not fit in memory", where=where, remedy="fewer --workers, smaller views, or a shorter log"
        )
    fields = job.spec.ingest_fields()
    origin = Origin(source.log.name, source.sha256, source.demonstration.name, planned.key, fields, source.place)
    entry, steps = describe(episode, origin)
    store, edits = EpisodeStore(job.root), planned.edits
    known = _known(store, job, planned, entry, steps["log_time_ns"])
    if known is not None:
        if known.removed is None or not job.again:
            return Ingested(known.id, episode.rate_hz, was="stored" if known.removed is None else "removed")
        entry, edits = replace(entry, id=known.id), known.removed
    try:
        store.commit(entry, steps, episode.frames, edits=edits, hold=job.hold)
    except UsageError as error:  # what was trimmed before leaves too little on today's clock
        return error
    return Ingested(entry.id, episode.rate_hz, episode.findings)


def _known(
    store: EpisodeStore, job: IngestJob, planned: Planned, entry: EpisodeEntry, ticks: I64
) -> KnownContent | None:
    """The known episode that a new one shows the same as, at the same time: its log was written anew."""
    for one in job.known.get(entry.content_sha256, ()) if planned.is_new else ():
        tick_ns = one.tick_ns
        if one.removed is None:
            try:
                tick_ns = int(shards.read_shard(store.steps_path(one.id)).arrays["log_time_ns"][0])
            except StoreError:  # damaged: nobody can tell
                continue
        if tick_ns is None or tick_ns == ticks[one.step]:
            return one
    return None


def _refuse_another_rate(episode: Episode, rate_hz: float | None, path: Path) -> None:
    if rate_hz is not None and abs(episode.rate_hz / rate_hz - 1) > RATE_TOLERANCE:
        raise AlignError(
            f"its slowest camera runs at {episode.rate_hz:.4g} Hz, while the dataset's episodes have {rate_hz:.4g} steps a second",
            where=f"{path}, {episode.id}",
            remedy="state rate_hz in the task TOML, so that all are put on one clock",
        )
