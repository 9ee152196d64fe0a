"""What an ingest has to do: which stored episode each demonstration is, which are fresh, and what must not be mixed.

A demonstration is known by its bytes (`HashCache.of_log`): by the log's where it is alone in its log, by its own rows where a log
holds many. The same bytes are the same episode, whatever the log is called now. For bytes that are not stored:

- A log of many demonstrations whose name is known, and in which at least half of the episodes stored from that name are found
  unchanged, is the same log grown or edited: demonstrations of a new name are added, those of a known name replace their episode,
  unless another log of this call holds that episode. `Plan.replaced` names them.
- What was removed on purpose (`removed`) is known by its bytes too, and stays out.
- Anything else is new. Where its name is taken it gets the first digits of its hash as a suffix: logs of several days may all be
  called run.mcap, and none may overwrite another. `Plan.notes` says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path

from vilp_data.cut_log import cut_log
from vilp_data.demonstrations import CUT_TAG
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import DecodeError, LogError, SpecError, UsageError
from vilp_data.keys import digest, episode_key, first_difference
from vilp_data.log_hashes import HashCache
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.surgery.edits import Edits, edits_of
from vilp_data.surgery.removed import Removed, read_removed
from vilp_data.types import LogEpisode, is_rollout, outcome_of


@dataclass(frozen=True)
class Source:
    """One demonstration of one log, before it is known which episode it is. `alone`: its log holds no other."""

    log: Path
    demonstration: LogEpisode
    sha256: str
    alone: bool


@dataclass(frozen=True)
class Planned:
    """A demonstration that is to be ingested, as the episode `id`; `edits` are what people did to it since its last ingest."""

    id: str
    source: Source
    key: str
    edits: Edits | None = None


@dataclass
class Plan:
    """`todo` in order of logs; ids of what is fresh, left out as a failure, a policy's `rollouts` left out, `removed` on purpose before,
    `replaced` by what is to do; what could not be read (name, why); sentences about names that are not what they were; `rate_hz` of
    the episodes that stay, None where none do."""

    todo: list[Planned] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    rollouts: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
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
    again: bool = False,
) -> Plan:
    """Compare logs with the store. What was removed on purpose stays out, unless it is wanted `again`. Raises UsageError where the
    dataset is of another task, or where episodes ingested by another spec would stay in it."""
    plan = Plan()
    fields = spec.ingest_fields()
    present = {entry.id: entry for entry in store.index()}
    _refuse_another_task(store, spec, present)
    sources, removed = read_sources(logs, spec, cache, plan), read_removed(store.root)
    for source, episode_id in identify(sources, list(present.values()), plan, removed):
        entry = present.get(episode_id)
        if entry is None and episode_id in removed and not again:
            plan.removed.append(episode_id)
            continue
        edits = _edits_to_keep(entry, source, plan)
        name = source.demonstration.name
        if entry is not None and entry.source_sha256 == source.sha256:
            name = entry.source_episode  # a store past its thousandth demonstration counts them with one more digit
        key = episode_key(source_sha256=source.sha256, source_episode=name, ingest_fields=fields)
        if entry is not None and entry.ingest_key == key and store.frames_fit(entry):
            plan.fresh.append(episode_id)
        elif is_rollout(source.demonstration.tags) and not with_rollouts:
            plan.rollouts.append(episode_id)
        elif not include_failures and _failed(source, edits):
            plan.left_out.append(episode_id)
        else:
            key = episode_key(
                source_sha256=source.sha256, source_episode=source.demonstration.name, ingest_fields=fields
            )
            plan.todo.append(Planned(episode_id, source, key, edits))
    settled = {*plan.fresh, *(planned.id for planned in plan.todo)}
    plan.notes += _no_longer_cut(sources, [entry for entry in present.values() if entry.id not in settled], spec)
    _refuse_another_spec(store, [entry for entry in present.values() if entry.id not in settled], fields)
    plan.replaced &= {planned.id for planned in plan.todo}
    plan.rate_hz = next((entry.rate_hz for entry in present.values() if entry.ingest == fields), None)
    return plan


def read_sources(logs: Sequence[Path], spec: TaskSpec, cache: HashCache, plan: Plan) -> list[Source]:
    """Every demonstration of the logs, with the tags that the task gives it, those with the same bytes once; logs that cannot be read
    go to `plan.failed`."""
    sources: dict[str, Source] = {}
    for path in logs:
        try:
            with open_log(path, array_rate_hz=spec.rate_hz or 10.0) as log:
                natives = log.episodes()
                hashes = cache.of_log(log, path, natives)
                cuts = cut_log(log, spec, path, partial(cache.of_look, path))
        except (LogError, DecodeError, SpecError) as error:
            plan.failed.append((path.name, str(error)))
            continue
        plan.notes += cuts.notes
        if not natives:
            empty = LogError("the log holds no message", where=path, remedy="leave it out")
            plan.failed.append((path.name, str(empty)))
        is_cut = spec.episodes.kind != "file"
        for demonstration in cuts.demonstrations:
            sha256 = hashes[cuts.native[demonstration.name]]
            if is_cut:  # known by its own range of the log's bytes
                sha256 = digest({"log": sha256, "start_ns": demonstration.start_ns, "end_ns": demonstration.end_ns})
            tags = {**spec.tags_of(path.name), **demonstration.tags}
            source = Source(path, replace(demonstration, tags=tags), sha256, alone=len(natives) == 1 and not is_cut)
            first = sources.setdefault(sha256, source)
            if first is not source:
                copied = "" if first.alone else f", {first.demonstration.name}"
                plan.notes.append(f"{path}: a copy of {first.log}{copied}, byte for byte; taken once")
    return list(sources.values())


def identify(
    sources: Sequence[Source], entries: Sequence[EpisodeEntry], plan: Plan, removed: Removed | None = None
) -> list[tuple[Source, str]]:
    """The episode id of each source, by the rule above; fills `plan.replaced` and `plan.notes`. What was removed keeps its id."""
    removed = removed or {}
    stored = {entry.source_sha256: entry for entry in entries}
    gone = {episode.source_sha256: id for id, episode in removed.items()}
    claimed = {stored[source.sha256].id for source in sources if source.sha256 in stored}
    taken = {*removed, *(entry.id for entry in entries)}
    found: list[tuple[Source, str]] = []
    for log, group in groupby(sources, key=lambda source: source.log):
        members = list(group)
        unclaimed = [entry for entry in entries if entry.source == log.name and entry.id not in claimed]
        replaceable = _replaceable(members, entries, unclaimed)
        new: list[str] = []
        for source in members:
            if source.sha256 in stored:
                episode_id = stored[source.sha256].id
            elif source.sha256 in gone:
                episode_id = gone[source.sha256]
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


def _edits_to_keep(entry: EpisodeEntry | None, source: Source, plan: Plan) -> Edits | None:
    """What people did to the stored episode, where this source is the same demonstration; where it is another, a note says it is lost."""
    edits = edits_of(entry) if entry is not None else Edits()
    if entry is None or not edits.any:
        return None
    if entry.source_sha256 == source.sha256:
        return edits
    lost = " and ".join(["its labels"] * bool(edits.set or edits.unset) + ["its trim"] * (edits.start_ns is not None))
    plan.notes.append(
        f"{entry.id}: the log changed, so {lost} no longer hold; `vilp-data undo` brings the episode back as it was"
    )
    return None


def _failed(source: Source, edits: Edits | None) -> bool:
    """Whether the log says that the demonstration failed, and no label says otherwise."""
    return outcome_of(source.demonstration.tags) == "failure" and not (edits and edits.calls_it_no_failure)


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


def _no_longer_cut(sources: Sequence[Source], others: Sequence[EpisodeEntry], spec: TaskSpec) -> list[str]:
    """Stored demonstrations of today's logs whose range is in the ranges file no more."""
    given, stated = {source.log.name for source in sources}, {row.text for row in spec.episodes.rows}
    gone = [
        entry.id for entry in others
        if entry.source in given and spec.episodes.kind == "ranges" and entry.tags.get(CUT_TAG, "") not in (*stated, "")
    ]  # fmt: skip
    listed = ", ".join(gone[:5]) + (f" and {len(gone) - 5} more" if len(gone) > 5 else "")
    return [f"{listed}: stored, and no longer in {spec.episodes.by}; `vilp-data remove` takes them out"] if gone else []


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
            remedy="name another folder with --into, or take out what is cut otherwise now (`vilp-data remove`; all of it: the folder)"
            if difference.startswith("episodes")
            else "give the logs of all its episodes, to ingest them anew, or name another folder with --into",
        )
