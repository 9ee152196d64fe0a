"""What an ingest has to do: which stored episode each demonstration is, which are fresh, and what must not be mixed.

A demonstration is known by its bytes: by the log's where it is alone in its log (`HashCache.of_log`), by its own rows or messages where
it is one of several (`cut_identity`). The same bytes are the same episode, whatever the log is called now. For bytes that are not stored:

- A demonstration that is cut from a log, and overlaps the range of a known one that the same log still holds, is that one, cut otherwise
  since: its log has grown, or its line in a ranges file was edited. It replaces the episode, and labels stay. Which log is the same is
  said in `ingest_sources.Sources`.
- A log of many demonstrations of its own whose name is known, and in which at least half of the episodes stored from that name are found
  unchanged, is the same log grown or edited: demonstrations of a new name are added, those of a known name replace their episode,
  unless another log of this call holds that episode. `Plan.replaced` names what is replaced.
- What was removed on purpose (`removed`) is known in the same ways, and stays out.
- Anything else is new. Where its name is taken it gets the first digits of its hash as a suffix: logs of several days may all be
  called run.mcap, and none may overwrite another. `Plan.notes` says so. Whether it shows the same as a known episode, its log having
  been written anew in other bytes, is seen once it is decoded: `Plan.known`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

from vilp_data.cut_identity import Cut
from vilp_data.demonstrations import CUT_TAG, LOG_TAG
from vilp_data.edits import Edits, edits_of, restated
from vilp_data.episode_entry import free_id
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, some_of
from vilp_data.ingest_sources import KnownCut, Source, Sources, read_sources
from vilp_data.keys import episode_key, first_difference
from vilp_data.log_hashes import HashCache
from vilp_data.removed import Removed, RemovedEpisode, read_removed
from vilp_data.spec import TaskSpec
from vilp_data.types import is_rollout, outcome_of


@dataclass(frozen=True)
class Planned:
    """A demonstration that is to be ingested, as the episode `id`; `edits` are what people did to it since its last ingest. `is_new`: it
    is no episode that is known by its bytes or its place in a log."""

    id: str
    source: Source
    key: str
    edits: Edits | None = None
    is_new: bool = True


@dataclass(frozen=True)
class KnownContent:
    """What shows an episode to be a known one: `tick_ns` is the time of its step `step`, None where nobody remembers. `removed`: what
    people had decided about one that was removed, None for a stored one."""

    id: str
    step: int
    tick_ns: int | None = None
    removed: Edits | None = None


@dataclass
class Plan:
    """`todo` in order of logs; ids of what is fresh, left out as a failure, a policy's `rollouts` left out, `removed` on purpose before,
    `replaced` by what is to do; `restated`: entries of fresh ones of which the task says something else now; what could not be read
    (name, why); sentences about names that are not what they were; `rate_hz` of the episodes that stay, None where none do;
    `known`: content hash -> the episodes of that content that are stored, or were removed."""

    todo: list[Planned] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    rollouts: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    replaced: set[str] = field(default_factory=set)
    restated: list[EpisodeEntry] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    rate_hz: float | None = None
    known: dict[str, tuple[KnownContent, ...]] = field(default_factory=dict)


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
    plan, fields = Plan(), spec.ingest_fields()
    present, removed = {entry.id: entry for entry in store.index()}, read_removed(store.root)
    _refuse_another_task(store, spec, present)
    sources = read_sources(logs, spec, cache, known_cuts(present.values(), removed))
    plan.failed, plan.notes = sources.failed, sources.notes
    for source, episode_id in identify(sources, list(present.values()), plan, removed):
        entry, gone = present.get(episode_id), removed.get(episode_id)
        if entry is None and gone is not None and not again:
            plan.removed.append(episode_id)
            continue
        edits = _edits_to_keep(episode_id, entry or gone, source, plan)
        if entry is not None and _is_fresh(store, entry, source, fields):
            plan.fresh.append(episode_id)
            plan.notes += _restate(entry, source, plan, spec)
        elif is_rollout(source.demonstration.tags) and not with_rollouts:
            plan.rollouts.append(episode_id)
        elif not include_failures and _failed(source, edits):
            plan.left_out.append(episode_id)
        else:
            key = episode_key(
                source_sha256=source.sha256, source_episode=source.demonstration.name, ingest_fields=fields
            )
            plan.todo.append(Planned(episode_id, source, key, edits, is_new=entry is None and gone is None))
    settled = {*plan.fresh, *(planned.id for planned in plan.todo)}
    staying = [entry for entry in present.values() if entry.id not in settled]
    plan.notes += _no_longer_cut(sources.found, staying, spec)
    _refuse_another_spec(store, staying, fields)
    plan.replaced &= {planned.id for planned in plan.todo}
    plan.rate_hz = next((entry.rate_hz for entry in present.values() if entry.ingest == fields), None)
    at_rest = present.keys() - {planned.id for planned in plan.todo}
    plan.known = known_contents([present[id] for id in sorted(at_rest)], removed)
    return plan


def known_cuts(entries: Iterable[EpisodeEntry], removed: Removed) -> list[KnownCut]:
    """Every cut that is stored or was removed."""
    rows = [(entry.id, entry.source, entry.source_sha256, entry.cut) for entry in entries]
    rows += [(id, one.source, one.source_sha256, one.cut) for id, one in removed.items()]
    return [KnownCut(id, log, sha256, cut) for id, log, sha256, table in rows if (cut := Cut.from_json(table))]


def known_contents(entries: Iterable[EpisodeEntry], removed: Removed) -> dict[str, tuple[KnownContent, ...]]:
    """Content hash, as ingest gives it -> what is known to show that."""
    found: dict[str, tuple[KnownContent, ...]] = {}
    for entry in entries:
        one = KnownContent(entry.id, entry.first_step)
        found[entry.ingest_content] = (*found.get(entry.ingest_content, ()), one)
    for id, gone in removed.items():
        step = int(gone.edits.get("trim", {}).get("first_step", 0))
        one = KnownContent(id, step, gone.tick_ns, edits_of(gone.edits))
        found[gone.ingest_content] = (*found.get(gone.ingest_content, ()), one)
    return found


def identify(
    sources: Sources, entries: Sequence[EpisodeEntry], plan: Plan, removed: Removed | None = None
) -> list[tuple[Source, str]]:
    """The episode id of each source, by the rule above; fills `plan.replaced` and `plan.notes`. What was removed keeps its id."""
    removed = removed or {}
    by_hash = {episode.source_sha256: id for id, episode in removed.items()}
    by_hash |= {entry.source_sha256: entry.id for entry in entries}
    claimed = {by_hash[source.sha256] for source in sources.found if source.sha256 in by_hash}
    taken = {*removed, *(entry.id for entry in entries)}
    found: list[tuple[Source, str]] = []
    for log, group in groupby(sources.found, key=lambda source: source.log):
        members = list(group)
        unclaimed = [entry for entry in entries if entry.source == log.name and entry.id not in claimed]
        replaceable = _replaceable(members, entries, unclaimed)
        replaceable |= _overlapped(members, [one for one in sources.held.get(log, ()) if one.id not in claimed])
        new: list[str] = []
        for source in members:
            name = source.demonstration.name
            if source.sha256 in by_hash:
                episode_id = by_hash[source.sha256]
            elif name in replaceable:
                episode_id = replaceable[name]
                plan.replaced |= {episode_id} - removed.keys()
            else:
                episode_id = free_id(_name_of(source), taken, source.sha256)
                new.append(episode_id)
            taken.add(episode_id)
            found.append((source, episode_id))
        known = any(source.sha256 in by_hash or source.demonstration.name in replaceable for source in members)
        if new and unclaimed and not known:
            ids = new[0] if len(new) == 1 else f"{new[0]} and {len(new) - 1} more"
            plan.notes.append(f"{log}: not the {log.name} ingested before; both are kept, this one as {ids}")
    return found


def _is_fresh(store: EpisodeStore, entry: EpisodeEntry, source: Source, fields: Mapping[str, object]) -> bool:
    """Whether the store holds just what an ingest of the source would give today."""
    same = entry.source_sha256 == source.sha256 and first_difference(entry.ingest, fields) is None
    return same and store.frames_fit(entry)


def _restate(entry: EpisodeEntry, source: Source, plan: Plan, spec: TaskSpec) -> list[str]:
    """What the task says of a stored cut today goes into `plan.restated`; what it means, in words. The name of its log stays: of the same
    bytes under two names none is righter."""
    if source.cut is None:
        return []
    tags, name = dict(source.demonstration.tags), source.demonstration.name
    tags |= {LOG_TAG: entry.tags[LOG_TAG]} if LOG_TAG in entry.tags else {}
    today = replace(restated(entry, tags), source_episode=name)
    if today == entry:
        return []
    plan.restated.append(today)
    notes = []
    if name != entry.source_episode:
        notes.append(f"{entry.id}: called {name} in {spec.episodes.by} now; the episode keeps its id")
    if today.outcome == "failure" != entry.outcome:
        notes.append(
            f"{entry.id}: a failure now, and still stored; `vilp-data remove {entry.id}` takes it out of training"
        )
    return notes


def _edits_to_keep(id: str, known: EpisodeEntry | RemovedEpisode | None, source: Source, plan: Plan) -> Edits | None:
    """What people did to the known episode, where this source is the same demonstration. Of one that is cut otherwise now, the labels;
    where it is another, none. A note says what is lost."""
    edits = edits_of(known.edits) if known is not None else Edits()
    if known is None or not edits.any:
        return None
    was = Cut.from_json(known.cut)
    cut_otherwise = was is not None and source.cut is not None and was.range != source.cut.range
    other_topics = was is not None and source.cut is not None and was.topics != source.cut.topics
    if known.source_sha256 == source.sha256 or (other_topics and not cut_otherwise):
        return edits
    lost = ["its labels"] * (bool(edits.set or edits.unset) and not cut_otherwise)
    lost += ["its trim"] * (edits.start_ns is not None)
    if lost:
        plan.notes.append(
            f"{id}: {'it is cut otherwise now' if cut_otherwise else 'the log changed'}, so {' and '.join(lost)} no longer "
            f"{'holds' if lost == ['its trim'] else 'hold'}; `vilp-data undo` brings the episode back as it was"
        )
    return replace(edits, start_ns=None, end_ns=None) if cut_otherwise else None


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
    if members[0].alone or members[0].cut is not None or kept == 0 or 2 * kept < len(same_name):
        return {}
    return {entry.source_episode: entry.id for entry in unclaimed}


def _overlapped(members: Sequence[Source], held: Sequence[KnownCut]) -> dict[str, str]:
    """Demonstration name -> the known cut that it overlaps longest, each of them once."""
    pairs = sorted(
        (-overlap_ns, source.demonstration.name, known.id)
        for source in members
        for known in held
        if source.cut is not None and (overlap_ns := source.cut.overlap_ns(known.cut)) > 0
    )
    found: dict[str, str] = {}
    for _, name, id in pairs:
        if name not in found and id not in found.values():
            found[name] = id
    return found


def _name_of(source: Source) -> str:
    """The log's name, with the demonstration's where there are several; made a visible file name."""
    name = source.log.stem if source.alone else f"{source.log.stem}-{source.demonstration.name}"
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name).lstrip(".") or "episode"


def _no_longer_cut(sources: Sequence[Source], others: Sequence[EpisodeEntry], spec: TaskSpec) -> list[str]:
    """Stored demonstrations of today's logs whose range is in the ranges file no more."""
    given, stated = {source.log.name for source in sources}, {row.text for row in spec.episodes.rows}
    gone = [
        entry.id for entry in others
        if entry.source in given and spec.episodes.kind == "ranges" and entry.tags.get(CUT_TAG, "") not in (*stated, "")
    ]  # fmt: skip
    return (
        [f"{some_of(gone, 5)}: stored, and no longer in {spec.episodes.by}; `vilp-data remove` takes them out"]
        if gone
        else []
    )


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
