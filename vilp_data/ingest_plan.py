"""What an ingest has to do: which stored episode each demonstration is, which are fresh, and what must not be mixed.

A demonstration is known by its bytes (`HashCache.of_log`): by the log's where it is alone in its log, by its own rows where a log
holds many. The same bytes are the same episode, whatever the log is called now. For bytes that are not stored:

- A log of many demonstrations whose name is known, and in which at least half of the episodes stored from that name are found
  unchanged, is the same log grown or edited: demonstrations of a new name are added, those of a known name replace their episode,
  unless another log of this call holds that episode. `Plan.replaced` names them.
- Anything else is new. Where its name is taken it gets the first digits of its hash as a suffix: logs of several days may all be
  called run.mcap, and none may overwrite another. `Plan.notes` says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from vilp_data.assemble import outcome_of
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import LogError, UsageError
from vilp_data.keys import episode_key, first_difference
from vilp_data.log_hashes import HashCache
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import LogEpisode, is_rollout


@dataclass(frozen=True)
class Source:
    """One demonstration of one log, before it is known which episode it is. `alone`: its log holds no other."""

    log: Path
    demonstration: LogEpisode
    sha256: str
    alone: bool


@dataclass(frozen=True)
class Planned:
    """A demonstration that is to be ingested, as the episode `id`."""

    id: str
    source: Source
    key: str


@dataclass
class Plan:
    """`todo` in order of logs; ids of what is fresh, left out as a failure, a policy's `rollouts` left out, `replaced` by what is to
    do; what could not be read (name, why); sentences about names that are not what they were; `rate_hz` of the episodes that
    stay, None where none do."""

    todo: list[Planned] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    rollouts: list[str] = field(default_factory=list)
    replaced: set[str] = field(default_factory=set)
    failed: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    rate_hz: float | None = None


def make_plan(
    logs: Sequence[Path],
    store: EpisodeStore,
    spec: TaskSpec,
    cache: HashCache,
    *,
    include_failures: bool,
    with_rollouts: bool,
) -> Plan:
    """Compare logs with the store. Raises UsageError where the dataset is of another task, or where episodes ingested by another
    spec would stay in it."""
    plan = Plan()
    fields = spec.ingest_fields()
    present = {entry.id: entry for entry in store.index()}
    _refuse_another_task(store, spec, present)
    sources = read_sources(logs, spec, cache, plan)
    for source, episode_id in identify(sources, list(present.values()), plan):
        entry = present.get(episode_id)
        name = source.demonstration.name
        if entry is not None and entry.source_sha256 == source.sha256:
            name = entry.source_episode  # a store past its thousandth demonstration counts them with one more digit
        key = episode_key(source_sha256=source.sha256, source_episode=name, ingest_fields=fields)
        if entry is not None and entry.key == key and store.frames_fit(entry):
            plan.fresh.append(episode_id)
        elif is_rollout(source.demonstration.tags) and not with_rollouts:
            plan.rollouts.append(episode_id)
        elif outcome_of(source.demonstration.tags) == "failure" and not include_failures:
            plan.left_out.append(episode_id)
        else:
            key = episode_key(
                source_sha256=source.sha256, source_episode=source.demonstration.name, ingest_fields=fields
            )
            plan.todo.append(Planned(episode_id, source, key))
    settled = {*plan.fresh, *(planned.id for planned in plan.todo)}
    _refuse_another_spec(store, [entry for entry in present.values() if entry.id not in settled], fields)
    plan.replaced &= {planned.id for planned in plan.todo}
    plan.rate_hz = next((entry.rate_hz for entry in present.values() if entry.ingest == fields), None)
    return plan


def read_sources(logs: Sequence[Path], spec: TaskSpec, cache: HashCache, plan: Plan) -> list[Source]:
    """Every demonstration of the logs, those with the same bytes once; logs that cannot be read go to `plan.failed`."""
    sources: dict[str, Source] = {}
    for path in logs:
        try:
            with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
                demonstrations = log.episodes()
                hashes = cache.of_log(log, path, demonstrations)
        except LogError as error:
            plan.failed.append((path.name, str(error)))
            continue
        if not demonstrations:
            empty = LogError("the log holds no message", where=path, remedy="leave it out")
            plan.failed.append((path.name, str(empty)))
        for demonstration in demonstrations:
            sha256 = hashes[demonstration.name]
            source = Source(path, demonstration, sha256, alone=len(demonstrations) == 1)
            first = sources.setdefault(sha256, source)
            if first is not source:
                copied = "" if first.alone else f", {first.demonstration.name}"
                plan.notes.append(f"{path}: a copy of {first.log}{copied}, byte for byte; taken once")
    return list(sources.values())


def identify(sources: Sequence[Source], entries: Sequence[EpisodeEntry], plan: Plan) -> list[tuple[Source, str]]:
    """The episode id of each source, by the rule above; fills `plan.replaced` and `plan.notes`."""
    stored = {entry.source_sha256: entry for entry in entries}
    claimed = {stored[source.sha256].id for source in sources if source.sha256 in stored}
    taken = {entry.id for entry in entries}
    found: list[tuple[Source, str]] = []
    for log, group in groupby(sources, key=lambda source: source.log):
        members = list(group)
        unclaimed = [entry for entry in entries if entry.source == log.name and entry.id not in claimed]
        replaceable = _replaceable(members, entries, unclaimed)
        new: list[str] = []
        for source in members:
            if source.sha256 in stored:
                episode_id = stored[source.sha256].id
            elif source.demonstration.name in replaceable:
                episode_id = replaceable[source.demonstration.name]
                plan.replaced.add(episode_id)
            else:
                episode_id = _free_id(source, taken)
                new.append(episode_id)
            taken.add(episode_id)
            found.append((source, episode_id))
        if new and unclaimed and not any(source.sha256 in stored for source in members):
            ids = new[0] if len(new) == 1 else f"{new[0]} and {len(new) - 1} more"
            plan.notes.append(f"{log}: not the {log.name} ingested before; both are kept, this one as {ids}")
    return found


def _replaceable(
    members: Sequence[Source], entries: Sequence[EpisodeEntry], unclaimed: Sequence[EpisodeEntry]
) -> dict[str, str]:
    """Demonstration name -> the episode it replaces, where `members` are the same log grown or edited; else nothing."""
    hashes = {source.sha256 for source in members}
    same_name = [entry for entry in entries if entry.source == members[0].log.name]
    kept = sum(entry.source_sha256 in hashes for entry in same_name)
    if members[0].alone or kept == 0 or 2 * kept < len(same_name):
        return {}
    return {entry.source_episode: entry.id for entry in unclaimed}


def _free_id(source: Source, taken: set[str]) -> str:
    """The log's name, with the demonstration's where there are several; made a visible file name, and unique."""
    name = source.log.stem if source.alone else f"{source.log.stem}-{source.demonstration.name}"
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).lstrip(".") or "episode"
    candidates = (name, f"{name}-{source.sha256[:8]}", f"{name}-{source.sha256}")
    return next(candidate for candidate in candidates if candidate not in taken)


# --- what must not be mixed ------------------------------------------------------------------------------------------------


def _refuse_another_task(store: EpisodeStore, spec: TaskSpec, present: Mapping[str, EpisodeEntry]) -> None:
    name = store.task_name()
    if present and name is not None and name != spec.name:
        raise UsageError(
            "the dataset is of another task",
            where=store.root,
            found=f"task {name!r}, not {spec.name!r}",
            remedy="name another folder with --into",
        )


def _refuse_another_spec(store: EpisodeStore, staying: Sequence[EpisodeEntry], fields: Mapping[str, object]) -> None:
    compared = [(entry, first_difference(entry.ingest, fields)) for entry in staying]
    differing = [(entry, difference) for entry, difference in compared if difference is not None]
    if differing:
        entry, difference = differing[0]
        raise UsageError(
            "one dataset cannot hold episodes of two specs",
            where=store.root,
            found=f"{difference} ({entry.id} of {entry.source}, one of {len(differing)} that would stay as they are)",
            remedy="give the logs of all its episodes, to ingest them anew, or name another folder with --into",
        )
