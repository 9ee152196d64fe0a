"""Logs + a task spec -> the episode store: do what the plan says, and report what became of every demonstration."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Literal

from vilp_data import shards
from vilp_data.assemble import assemble_episode
from vilp_data.edits import edits_of
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeEntry, EpisodeStore, Origin, describe
from vilp_data.errors import (
    AlignError,
    DecodeError,
    LogError,
    SpecError,
    UsageError,
    VilpDataError,
    some_of,
)
from vilp_data.history import Recording, recording
from vilp_data.ingest_plan import Plan, Planned, make_plan, notes_on_others, told_today
from vilp_data.known_content import KnownContent, shown_by
from vilp_data.log_files import find_logs
from vilp_data.log_hashes import HashCache
from vilp_data.removed import read_removed, removed_bytes, removed_path
from vilp_data.sources import IndexedLog, open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import RATE_TOLERANCE, Episode
from vilp_data.vector_parts import names_that_differ
from vilp_data.writer_lock import remove_leftovers, writer_lock

EPISODES_PER_JOB = 8
"""Demonstrations of one log that a worker takes at a time: few enough to share the work, many enough to open the log seldom."""


@dataclass(frozen=True)
class IngestJob:
    """Some demonstrations of one log, for one worker. `rate_hz`: that of the dataset's other episodes, None for the first. `known`: what
    a new demonstration may turn out to be, by content. `hold`: where files are kept that are replaced."""

    root: Path
    spec: TaskSpec
    episodes: tuple[Planned, ...]
    rate_hz: float | None
    known: Mapping[str, tuple[KnownContent, ...]] = field(default_factory=dict)
    hold: Path | None = None


@dataclass(frozen=True)
class Ingested:
    """An episode that was stored, as `id`; or that is a known one in other bytes of its log, stored or removed on purpose; or that is
    unwanted, and none of these. Only of a new one was anything written."""

    id: str
    rate_hz: float
    findings: tuple[str, ...] = ()
    was: Literal["new", "stored", "removed", "left_out", "rollouts"] = "new"


@dataclass
class IngestReport:
    """What became of every demonstration found in the logs.

    written, fresh, left_out  ids of episodes: stored now, there already, and not wanted since they failed
    rollouts     ids of a policy's own episodes, not wanted unless asked for
    removed      ids of episodes that were removed on purpose, not wanted unless asked for
    replaced     those of `written` that took the place of an episode with other content, since their log changed
    restated     those of `fresh` of which the task or their log says something else now: another name, other tags
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
        write_spec, met = partial(_write_spec, store, spec, work), _Met()
        with closing(
            _ingest(plan, plan.todo, root, spec, workers, work.hold)
        ) as results:  # no worker outlives the lock
            _enter(results, report, met, on_first=write_spec, progress=progress, total=len(plan.todo))
        if again and met.removed:
            todo = _come_back(met.removed, root)
            with closing(_ingest(plan, todo, root, spec, workers, work.hold)) as results:
                _enter(results, report, met, on_first=write_spec, progress=None, total=len(todo))
        _keep_removed(root, plan.removed, report, met, work)
        _adopt(store, met, report, spec, work)
        store.ensure_index()
        stored = store.index() if report.written or report.restated else []
        report.notes += [*notes_on_others(plan, report.written), *_twins(stored, report.written)]
        report.notes += names_that_differ(entry.column_names for entry in stored)
        report.written.sort()
        report.failed.sort()
        report.replaced = sorted(plan.replaced.intersection(report.written))
    return report


@dataclass
class _Met:
    """Known episodes that demonstrations in other bytes turned out to be: of a stored one the only such, of a removed one all."""

    stored: dict[str, Planned] = field(default_factory=dict)
    removed: dict[str, list[Planned]] = field(default_factory=dict)


def _enter(
    results: Iterable[tuple[Planned, Ingested | VilpDataError]], report: IngestReport, met: _Met, *,
    on_first: Callable[[], None], progress: Callable[[int, int], None] | None, total: int,
) -> None:  # fmt: skip
    """Enter what came of each demonstration into the report, and which known episodes were met. `on_first` is called before the first one
    that was stored: a spec that fits no log must not become the dataset's."""
    for done, (planned, result) in enumerate(results, start=1):
        if isinstance(result, VilpDataError):
            report.failed.append((planned.id, str(result)))
        elif result.was == "stored":
            met.stored[result.id] = planned
        elif result.was == "removed":
            met.removed.setdefault(result.id, []).append(planned)
        elif result.was != "new":
            (report.left_out if result.was == "left_out" else report.rollouts).append(result.id)
        else:
            if not report.written:
                on_first()
            report.written.append(result.id)
            report.findings |= {result.id: result.findings} if result.findings else {}
        if progress is not None:
            progress(done, total)


def _come_back(met: dict[str, list[Planned]], root: Path) -> list[Planned]:
    """What is to be stored where removed episodes are wanted again, met in other bytes: each once, as it was; what shows the same as one
    that comes back already is a twin of its own. Takes it out of `met`."""
    removed, todo = read_removed(root), list[Planned]()
    while met:
        id, planned = met.popitem()
        first, *others = sorted(planned, key=_bytes_of)
        todo += [replace(first, id=id, edits=edits_of(removed[id].edits), is_new=False)]
        todo += [replace(other, is_new=False) for other in others]
    return sorted(todo, key=lambda planned: planned.source.log)


def _bytes_of(planned: Planned) -> tuple[str, str]:
    return planned.source.made_of


def _rewrite(store: EpisodeStore, entries: Sequence[EpisodeEntry], work: Recording) -> list[str]:
    for entry in entries:
        store.rewrite_entry(entry, hold=work.hold)
    return sorted(entry.id for entry in entries)


def _adopt(store: EpisodeStore, met: _Met, report: IngestReport, spec: TaskSpec, work: Recording) -> None:
    """Stored episodes whose log was written anew are known by the new bytes from now on, and say of themselves what the log says now."""
    entries = {entry.id: entry for entry in store.index()} if met.stored else {}
    for id, planned in sorted(met.stored.items()):
        entry, source = entries[id], planned.source
        today, notes = told_today(entry, source, spec)
        report.notes += [f"{source.log}, {source.demonstration.name}: is {id}, in other bytes than before", *notes]
        report.fresh.append(id)
        report.restated += [id] * (today != entry)
        bytes_now = replace(today, source_sha256=source.sha256, cut=source.place)
        store.rewrite_entry(bytes_now, hold=work.hold)
    report.restated.sort()


def _twins(stored: Sequence[EpisodeEntry], written: Sequence[str]) -> Iterator[str]:
    """A sentence about each episode stored now that shows the same as others."""
    alike: dict[str, list[str]] = {}
    for entry in stored:
        alike.setdefault(entry.ingest_content, []).append(entry.id)
    for ids in alike.values():
        if len(ids) > 1 and not set(ids).isdisjoint(written):
            yield f"{some_of(ids, 5)}: show the same; each is kept, all on one side of the split"


def _write_spec(store: EpisodeStore, spec: TaskSpec, work: Recording) -> None:
    if not store.has_spec(spec):
        work.begin()
        work.keep("dataset.json")
        store.write_spec(spec)


def _keep_removed(root: Path, matched: Sequence[str], report: IngestReport, met: _Met, work: Recording) -> None:
    """What is stored is not removed any more, having been wanted again. What was met in other bytes of its log is known by those, unless
    a log of this call has the bytes that it is known by (`matched`)."""
    removed, stored = read_removed(root), {*report.written, *report.fresh}
    left = {id: episode for id, episode in removed.items() if id not in stored}
    for id in sorted(met.removed.keys() & left.keys()):
        if id not in matched:
            source = min(met.removed[id], key=_bytes_of).source
            left[id] = replace(left[id], source=source.log.name, source_sha256=source.sha256, cut=source.place)
            report.removed.append(id)
    if left != removed:
        work.begin()
        work.keep(removed_path(root).name)
        shards.write_atomic(removed_path(root), removed_bytes(left))


def _ingest(
    plan: Plan, planned: Sequence[Planned], root: Path, spec: TaskSpec, workers: int, hold: Path | None
) -> Generator[tuple[Planned, Ingested | VilpDataError], None, None]:
    """Do what is planned. Where the spec states no rate, the first episode by id sets it for the dataset, and so goes before the
    others: which are refused must not depend on the order in which workers end."""
    rate_hz, todo = plan.rate_hz, list(planned)
    while spec.rate_hz is None and rate_hz is None and todo:
        first = min(todo, key=lambda planned: planned.id)
        todo.remove(first)
        (result,) = ingest_job(IngestJob(root, spec, (first,), None, plan.known, hold))
        rate_hz = result.rate_hz if isinstance(result, Ingested) and result.was == "new" else None
        yield first, result
    jobs: list[IngestJob] = []
    for _, group in groupby(todo, key=lambda planned: planned.source.log):
        episodes = list(group)
        parts = [tuple(episodes[i : i + EPISODES_PER_JOB]) for i in range(0, len(episodes), EPISODES_PER_JOB)]
        jobs += [IngestJob(root, spec, part, rate_hz, plan.known, hold) for part in parts]
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
        return error if planned.unwanted is None else Ingested(planned.id, 0.0, was=planned.unwanted)
    except MemoryError:
        where = f"{source.log}, {source.demonstration.name}"
        return LogError(
            "does not fit in memory", where=where, remedy="fewer --workers, smaller views, or a shorter log"
        )
    fields = job.spec.ingest_fields()
    origin = Origin(source.log.name, source.sha256, source.demonstration.name, planned.key, fields, source.place)
    entry, steps = describe(episode, origin)
    store = EpisodeStore(job.root)
    alike = job.known.get(entry.content_sha256, ()) if planned.is_new else ()
    known = shown_by(alike, steps["log_time_ns"], store, may_be=planned.may_be, removed=planned.unwanted is None)
    if known is not None:
        return Ingested(known.id, episode.rate_hz, was="removed" if known.removed else "stored")
    if planned.unwanted is not None:
        return Ingested(planned.id, episode.rate_hz, was=planned.unwanted)
    try:
        store.commit(entry, steps, episode.frames, edits=planned.edits, hold=job.hold)
    except UsageError as error:  # what was trimmed before leaves too little on today's clock
        return error
    return Ingested(entry.id, episode.rate_hz, episode.findings)


def _refuse_another_rate(episode: Episode, rate_hz: float | None, path: Path) -> None:
    if rate_hz is not None and abs(episode.rate_hz / rate_hz - 1) > RATE_TOLERANCE:
        raise AlignError(
            f"its slowest camera runs at {episode.rate_hz:.4g} Hz, while the dataset's episodes have {rate_hz:.4g} steps a second",
            where=f"{path}, {episode.id}",
            remedy="state rate_hz in the task TOML, so that all are put on one clock",
        )
