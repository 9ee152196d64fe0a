"""What an ingest has to do: which stored episode each demonstration is, which are fresh, and what must not be mixed.

A demonstration is known by its bytes: by the log's where it is alone in its log (`HashCache.of_log`), by its own rows or messages where
it is one of several (`cut_identity`). The same bytes are the same episode, whatever the log is called now; where only what a cut takes in
from before it changed (`held_messages.held_sha256`), it is made anew in its place. For bytes that are not stored:

- A demonstration that is cut from a log, and overlaps the range of a known one that the same log still holds, is that one, cut otherwise
  since: its log has grown, or its line in a ranges file was edited. It replaces the episode, and labels stay. Which log is the same is
  said in `ingest_sources.Sources`.
- A log of many demonstrations of its own whose name is known, and in which at least half of the episodes stored from that name are found
  unchanged, is the same log grown or edited: demonstrations of a new name are added, those of a known name replace their episode,
  unless another log of this call holds that episode. `Plan.replaced` names what is replaced.
- What was removed on purpose (`removed`) is known in the same ways, and stays out.
- Anything else is new, under the first free name: where its own is taken, with the first digits of its hash, for logs of several days
  may all be called run.mcap. Whether it shows the same as a known episode is seen once it is decoded: `known_content`.
- A new demonstration that failed, or a policy's own, is left out unless it is asked for; one that is stored is never left out: what its
  log says of it today is stored too, and said.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Literal

from vilp_data.assemble import column_names
from vilp_data.cut_identity import Cut
from vilp_data.demonstrations import CUT_TAG, LOG_TAG
from vilp_data.edits import Edits, edits_of, restated
from vilp_data.episode_entry import free_id
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, some_of
from vilp_data.ingest_sources import KnownCut, Source, Sources, held_of, read_sources, tags_said_otherwise
from vilp_data.keys import episode_key, first_difference
from vilp_data.known_content import KnownContent, known_contents, written_anew
from vilp_data.log_hashes import HashCache
from vilp_data.removed import Removed, RemovedEpisode, read_removed
from vilp_data.spec import TaskSpec
from vilp_data.types import ColumnNames, is_rollout, outcome_of

Unwanted = Literal["left_out", "rollouts"]


@dataclass(frozen=True)
class Planned:
    """A demonstration that is to be ingested, as the episode `id`; `edits` are what people did to it since its last ingest. `is_new`: it
    is no episode that is known by its bytes or its place in a log; `may_be`: stored ones whose log may have been written anew as this
    one's. `unwanted`: unless it is one of these, it is left out, as a failure or as a policy's rollout."""

    id: str
    source: Source
    key: str
    edits: Edits | None = None
    is_new: bool = True
    may_be: frozenset[str] = frozenset()
    unwanted: Unwanted | None = None


@dataclass
class Plan:
    """`todo` in order of logs; ids of what is fresh, left out as a failure, a policy's `rollouts` left out, `removed` on purpose before,
    `replaced` by what is to do; `restated`: entries of fresh ones of which the task or the log says something else now; what could not be
    read (name, why); sentences; `rate_hz` of the episodes that stay, None where none do; `known`: content hash -> the episodes of that
    content that some of `todo` may be, or that were removed; `others`: log -> ids of what is new in it though its name was known."""

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
    others: dict[Path, list[str]] = field(default_factory=dict)


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
    dataset is of another task, cut by another rule, or where episodes ingested by another spec would stay in it."""
    plan, fields = Plan(), spec.ingest_fields()
    present, removed = {entry.id: entry for entry in store.index()}, read_removed(store.root)
    _refuse_another_task(store, spec, present)
    _refuse_another_rule(store, fields, present)
    sources = read_sources(logs, spec, cache, known_cuts(present.values(), removed))
    plan.failed, plan.notes = sources.failed, sources.notes
    removed = {id: one for id, one in removed.items() if id not in present}  # a killed ingest had brought it back
    identified = identify(sources, list(present.values()), plan, removed)
    unclaimed = [present[id] for id in sorted(present.keys() - {id for _, id in identified})]
    for source, episode_id in identified:
        entry, gone = present.get(episode_id), removed.get(episode_id)
        if entry is None and gone is not None and not again:
            plan.removed.append(episode_id)
            continue
        edits = _edits_to_keep(episode_id, entry or gone, source, plan)
        if entry is not None and _is_fresh(store, entry, source, fields):
            plan.fresh.append(episode_id)
            today, notes = told_today(entry, source, spec)
            plan.restated += [today] * (today != entry)
            plan.notes += notes
            continue
        is_new, unwanted = entry is None and gone is None, None
        if entry is None:
            unwanted = _unwanted(source, edits, include_failures=include_failures, with_rollouts=with_rollouts)
        else:
            same_spec = first_difference(entry.ingest, fields) is None
            plan.replaced |= {episode_id} if same_spec and held_of(entry.cut) != source.held else set()
            plan.notes += [failure_note(episode_id)] * (_failed(source, edits) and entry.outcome != "failure")
        may_be = written_anew(source, sources.found, unclaimed) if is_new else frozenset()
        if unwanted is not None and not may_be:
            (plan.left_out if unwanted == "left_out" else plan.rollouts).append(episode_id)
            continue
        key = episode_key(
            source_sha256=source.key_sha256, source_episode=source.demonstration.name, ingest_fields=fields
        )
        plan.todo.append(Planned(episode_id, source, key, edits, is_new, may_be, unwanted))
    settled = {*plan.fresh, *(planned.id for planned in plan.todo)}
    staying = [entry for entry in present.values() if entry.id not in settled]
    plan.notes += _no_longer_cut(sources.found, staying, spec)
    _refuse_another_spec(store, staying, fields)
    plan.rate_hz = next((entry.rate_hz for entry in present.values() if entry.ingest == fields), None)
    candidates = frozenset[str]().union(*(planned.may_be for planned in plan.todo))
    plan.known = known_contents(
        [present[id] for id in sorted(candidates)], {id: one for id, one in removed.items() if id not in settled}
    )
    return plan


def known_cuts(entries: Iterable[EpisodeEntry], removed: Removed) -> list[KnownCut]:
    """Every cut that is stored or was removed."""
    rows = [(entry.id, entry.source, entry.source_sha256, entry.cut) for entry in entries]
    rows += [(id, one.source, one.source_sha256, one.cut) for id, one in removed.items()]
    return [KnownCut(id, log, sha256, cut) for id, log, sha256, table in rows if (cut := Cut.from_json(table))]


def identify(
    sources: Sources, entries: Sequence[EpisodeEntry], plan: Plan, removed: Removed | None = None
) -> list[tuple[Source, str]]:
    """The episode id of each source, by the rule above; fills `plan.replaced` and `plan.others`. What was removed keeps its id."""
    removed = removed or {}
    by_bytes = _known_by_bytes(sources.found, entries, removed)
    claimed = set(by_bytes.values())
    taken = {*removed, *(entry.id for entry in entries)}
    found: list[tuple[Source, str]] = []
    for log, group in groupby(sources.found, key=lambda source: source.log):
        members = list(group)
        unclaimed = [entry for entry in entries if entry.source == log.name and entry.id not in claimed]
        unknown = [source for source in members if source.made_of not in by_bytes]
        replaceable = _replaceable(members, entries, unclaimed)
        replaceable |= _overlapped(unknown, [one for one in sources.held.get(log, ()) if one.id not in claimed])
        new: list[str] = []
        for source in members:
            name = source.demonstration.name
            if source.made_of in by_bytes:
                episode_id = by_bytes[source.made_of]
            elif name in replaceable:
                episode_id = replaceable[name]
                plan.replaced |= {episode_id} - removed.keys()
            else:
                episode_id = free_id(_name_of(source), taken, source.sha256)
                new.append(episode_id)
            taken.add(episode_id)
            found.append((source, episode_id))
        if unclaimed and len(new) == len(members):
            plan.others[log] = new
    return found


def _known_by_bytes(
    found: Sequence[Source], entries: Sequence[EpisodeEntry], removed: Removed
) -> dict[tuple[str, str], str]:
    """What a source is made of -> the known episode that is made of that, else one of the same messages, before which others came."""
    rows = [(id, one.source_sha256, held_of(one.cut)) for id, one in removed.items()]
    rows += [(entry.id, entry.source_sha256, held_of(entry.cut)) for entry in entries]
    exactly = {(sha256, held): id for id, sha256, held in rows}
    known = {source.made_of: exactly[source.made_of] for source in found if source.made_of in exactly}
    rest: dict[str, list[str]] = {}
    for id, sha256, _ in rows:
        if id not in known.values():
            rest.setdefault(sha256, []).append(id)
    for source in found:
        if source.made_of not in known and rest.get(source.sha256):
            known[source.made_of] = rest[source.sha256].pop()
    return known


def _is_fresh(store: EpisodeStore, entry: EpisodeEntry, source: Source, fields: Mapping[str, object]) -> bool:
    """Whether the store holds just what an ingest of the source would give today."""
    made_of = entry.source_sha256, held_of(entry.cut)
    return made_of == source.made_of and first_difference(entry.ingest, fields) is None and store.frames_fit(entry)


def told_today(entry: EpisodeEntry, source: Source, spec: TaskSpec) -> tuple[EpisodeEntry, list[str]]:
    """The entry of a stored episode with what its log and the task say of it today; what that means, in words. A log of another name that
    holds the same changes nothing: of two that say otherwise none is righter, and which came last must not decide."""
    tags, name = dict(source.demonstration.tags), entry.source_episode
    if source.cut is not None:
        name = source.demonstration.name
        tags |= {LOG_TAG: entry.tags[LOG_TAG]} if LOG_TAG in entry.tags else {}
    names, notes = _names_today(entry, source, spec), []
    today = replace(restated(entry, tags), source_episode=name, column_names=names)
    if source.log.name != entry.source:
        told = tags_said_otherwise(today.tags, entry.tags)
        note = f"{source.log}: holds {entry.id} of {entry.source}, whose labels stay: {told}; `vilp-data relabel {entry.id}` changes them"
        return entry, [note] * bool(told)
    if name != entry.source_episode:
        notes.append(f"{entry.id}: called {name} in {spec.episodes.by} now; the episode keeps its id")
    if today.outcome == "failure" != entry.outcome:
        notes.append(failure_note(entry.id))
    return today, notes


def _names_today(entry: EpisodeEntry, source: Source, spec: TaskSpec) -> ColumnNames:
    """The entry's names with those that its log gives today beside its messages; the others are of its messages, and the same."""
    stored = {
        f"{vector}.{part}": names for vector, parts in entry.column_names.items() for part, names in parts.items()
    }
    told = {part: names or [""] * len(stored.get(part, ())) for part, names in source.told.items()}
    return column_names(spec, stored | told, has_action=entry.has_action)


def failure_note(id: str) -> str:
    return f"{id}: a failure now, and still stored; `vilp-data remove {id}` takes it out of training"


def notes_on_others(plan: Plan, written: Collection[str]) -> list[str]:
    """About logs whose name was known, and of which something was stored beside what came from that name before."""
    notes = []
    for log, new in plan.others.items():
        if kept := [id for id in new if id in written]:
            ids = kept[0] if len(kept) == 1 else f"{kept[0]} and {len(kept) - 1} more"
            notes.append(f"{log}: not the {log.name} ingested before; both are kept, this one as {ids}")
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


def _unwanted(source: Source, edits: Edits | None, *, include_failures: bool, with_rollouts: bool) -> Unwanted | None:
    if is_rollout(source.demonstration.tags) and not with_rollouts:
        return "rollouts"
    return "left_out" if _failed(source, edits) and not include_failures else None


def _failed(source: Source, edits: Edits | None) -> bool:
    """Whether the log says that the demonstration failed, and no label says otherwise."""
    return outcome_of(source.demonstration.tags) == "failure" and not (edits and edits.calls_it_no_failure)


def _replaceable(
    members: Sequence[Source], entries: Sequence[EpisodeEntry], unclaimed: Sequence[EpisodeEntry]
) -> dict[str, str]:
    """Demonstration name -> the episode it replaces, where `members` are the same log grown or edited; else nothing."""
    known = {entry.source_episode for entry in entries if entry.source == members[0].log.name}
    changed = {entry.source_episode for entry in unclaimed}  # one that was stored beside such a one is of another log
    if members[0].alone or members[0].cut is not None or known == changed or 2 * len(known - changed) < len(known):
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


def _refuse_another_rule(
    store: EpisodeStore, fields: Mapping[str, object], present: Mapping[str, EpisodeEntry]
) -> None:
    """Cut by another rule, demonstrations are others, with names, labels and sides of their own: whether each of them happens to lie over
    a stored one must not decide whether they take the place of these."""
    for entry in present.values():
        difference = first_difference(_rule_of(entry.ingest), _rule_of(fields))
        if difference is not None:
            raise UsageError(
                "the dataset's demonstrations are cut out of their logs by another rule",
                where=store.root,
                found=f"{difference} ({entry.id} of {entry.source})",
                remedy="another rule makes another dataset: name another folder with --into, or delete this one first",
            )


def _rule_of(fields: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in fields.items() if name == "episodes"}


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
