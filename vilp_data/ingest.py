"""Logs + a task spec -> the episode store: do what the plan says, and report what became of every demonstration."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from vilp_data import shards
from vilp_data.assemble import assemble_episode
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, UsageError, VilpDataError
from vilp_data.ingest_plan import Plan, Planned, make_plan
from vilp_data.log_files import find_logs
from vilp_data.log_hashes import HashCache
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.surgery.history import Recording, recording
from vilp_data.surgery.removed import read_removed, removed_bytes, removed_path
from vilp_data.types import Episode, LogReader

EPISODES_PER_JOB = 8
"""Demonstrations of one log that a worker takes at a time: few enough to share the work, many enough to open the log seldom."""

RATE_TOLERANCE = 0.02
"""How far the rate of an episode may lie from the others' where the spec states none: cameras are not exact."""


@dataclass(frozen=True)
class IngestJob:
    """Some demonstrations of one log, for one worker. `rate_hz`: that of the dataset's other episodes, None for the first. `hold`: where
    files are kept that are replaced."""

    root: Path
    spec: TaskSpec
    episodes: tuple[Planned, ...]
    rate_hz: float | None
    hold: Path | None = None


@dataclass(frozen=True)
class Ingested:
    """An episode that was stored."""

    rate_hz: float
    findings: tuple[str, ...]


@dataclass
class IngestReport:
    """What became of every demonstration found in the logs.

    written, fresh, left_out  ids of episodes: stored now, there already, and not wanted since they failed
    rollouts     ids of a policy's own episodes, not wanted unless asked for
    removed      ids of episodes that were removed on purpose, not wanted unless asked for
    replaced     those of `written` that took the place of an episode with other content, since their log changed
    failed       (id, or name of a log) and why nothing came of it
    findings     id -> what was masked or repeated in it
    notes        sentences about logs whose name was met before with other content
    passed_over  files in the folders given that look like logs of a format that is not read
    """

    written: list[str] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)
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
    with shards.writer_lock(root), recording(root, "ingest") as work:
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
        if plan.todo:
            work.begin()
            store.remove_index()
        with closing(_ingest(plan, root, spec, workers, work.hold)) as results:  # so that no worker outlives the lock
            for done, (planned, result) in enumerate(results, start=1):
                if isinstance(result, VilpDataError):
                    report.failed.append((planned.id, str(result)))
                else:
                    if not report.written:
                        _write_spec(
                            store, spec, work
                        )  # not before: a spec that fits no log must not become the dataset's
                    report.written.append(planned.id)
                    report.findings |= {planned.id: result.findings} if result.findings else {}
                if progress is not None:
                    progress(done, len(plan.todo))
        _take_off_removed(root, [*report.written, *report.fresh], work)
        if not store.index_path.is_file():
            store.write_index()
        report.written.sort()
        report.failed.sort()
        report.replaced = sorted(plan.replaced.intersection(report.written))
    return report


def _write_spec(store: EpisodeStore, spec: TaskSpec, work: Recording) -> None:
    if not store.has_spec(spec):
        work.begin()
        work.keep("dataset.json")
        store.write_spec(spec)


def _take_off_removed(root: Path, stored: Sequence[str], work: Recording) -> None:
    """What is stored is not removed any more, having been wanted again."""
    removed = read_removed(root)
    left = {id: episode for id, episode in removed.items() if id not in stored}
    if len(left) < len(removed):
        work.begin()
        work.keep(removed_path(root).name)
        shards.write_atomic(removed_path(root), removed_bytes(left))


def _ingest(
    plan: Plan, root: Path, spec: TaskSpec, workers: int, hold: Path | None
) -> Generator[tuple[Planned, Ingested | VilpDataError], None, None]:
    """Do what is to do. Where the spec states no rate, the first episode by id sets it for the dataset, and so goes before the
    others: which are refused must not depend on the order in which workers end."""
    rate_hz, todo = plan.rate_hz, list(plan.todo)
    while spec.rate_hz is None and rate_hz is None and todo:
        first = min(todo, key=lambda planned: planned.id)
        todo.remove(first)
        (result,) = ingest_job(IngestJob(root, spec, (first,), None, hold))
        rate_hz = None if isinstance(result, VilpDataError) else result.rate_hz
        yield first, result
    jobs: list[IngestJob] = []
    for _, group in groupby(todo, key=lambda planned: planned.source.log):
        episodes = list(group)
        parts = [tuple(episodes[i : i + EPISODES_PER_JOB]) for i in range(0, len(episodes), EPISODES_PER_JOB)]
        jobs += [IngestJob(root, spec, part, rate_hz, hold) for part in parts]
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


def _ingest_one(log: LogReader, planned: Planned, job: IngestJob) -> Ingested | VilpDataError:
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
    origin = Origin(source.log.name, source.sha256, source.demonstration.name, planned.key, fields)
    try:
        EpisodeStore(job.root).write(episode, origin, edits=planned.edits, hold=job.hold)
    except UsageError as error:  # what was trimmed before leaves too little on today's clock
        return error
    return Ingested(episode.rate_hz, episode.findings)


def _refuse_another_rate(episode: Episode, rate_hz: float | None, path: Path) -> None:
    if rate_hz is not None and abs(episode.rate_hz / rate_hz - 1) > RATE_TOLERANCE:
        raise AlignError(
            f"its slowest camera runs at {episode.rate_hz:.4g} Hz, while the dataset's episodes have {rate_hz:.4g} steps a second",
            where=f"{path}, {episode.id}",
            remedy="state rate_hz in the task TOML, so that all are put on one clock",
        )
