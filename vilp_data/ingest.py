"""Logs + a task spec -> the episode store: which demonstrations are new, which are fresh, and what kept the others out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data import shards
from vilp_data.assemble import assemble_episode, outcome_of
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import AlignError, DecodeError, LogError, SpecError, UsageError, VilpDataError
from vilp_data.keys import episode_key
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import LogEpisode

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
                raise UsageError(
                    "no logs in this folder",
                    where=path,
                    found="no *.mcap file and no *.zarr folder",
                    remedy="give the logs themselves, or their folder",
                )
            found.update(dict.fromkeys(inside))
        else:
            found[path] = None
    return list(found)


def plan_jobs(
    paths: Sequence[Path], store: EpisodeStore, spec: TaskSpec, report: IngestReport, *, include_failures: bool
) -> list[IngestJob]:
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
        if not demonstrations:
            report.failed.append(
                (path.name, str(LogError("the log holds no message", where=path, remedy="leave it out")))
            )
        todo: list[tuple[str, LogEpisode]] = []
        for demonstration in demonstrations:
            origin = (sha256, demonstration.name)
            episode_id = by_origin.get(origin) or _free_id(
                path, demonstration, sha256, present.keys() | by_origin.values(), only=len(demonstrations) == 1
            )
            key = episode_key(source_sha256=sha256, source_episode=demonstration.name, ingest_fields=fields)
            if episode_id in present and present[episode_id].key == key:
                report.fresh.append(episode_id)
            elif outcome_of(demonstration.tags) == "failure" and not include_failures:
                report.left_out.append(episode_id)
            elif origin not in by_origin or episode_id in present:
                todo.append((episode_id, demonstration))
            by_origin[origin] = episode_id
        jobs += [
            IngestJob(store.root, spec, path, sha256, tuple(todo[i : i + EPISODES_PER_JOB]))
            for i in range(0, len(todo), EPISODES_PER_JOB)
        ]
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
                episode = assemble_episode(log, demonstration, job.spec, episode_id=episode_id)
            except (LogError, DecodeError, AlignError, SpecError) as error:
                results.append(error)
                continue
            fields = job.spec.ingest_fields()
            key = episode_key(source_sha256=job.log_sha256, source_episode=demonstration.name, ingest_fields=fields)
            store.write(episode, Origin(job.log.name, job.log_sha256, demonstration.name, key, fields))
            results.append(episode.findings)
    return results
