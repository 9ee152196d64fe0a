"""Whether a demonstration that is known by nothing shows the same, at the same time, as a known episode: its log was written anew.

    the known episode                                                     becomes of the new demonstration
    was removed; whatever log and name it came from                       it stays out; wanted `again`, it comes back with its decisions
    is stored, and a log of this call has its bytes                       is stored beside it, and said to be a twin
    is stored; no log of this call has its bytes; the one log of          is that episode: not stored twice, with its labels as the log
      this call that has its log's name holds it at the same place          states them today and those set by hand on top
    is stored, and came from a log of another name, or of a name that     is stored beside it, and said to be a twin
      two logs of this call have

Twins are on one side of the split. Nothing of this looks at episodes that are new in this call, nor at their order, so an ingest that was
killed goes on as it began; and logs of two names give the same episodes together and one after the other.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from vilp_data import shards
from vilp_data.cut_identity import Cut
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError
from vilp_data.ingest_sources import Source
from vilp_data.removed import Removed
from vilp_data.types import I64


@dataclass(frozen=True)
class KnownContent:
    """What shows an episode to be a known one, stored or removed: `tick_ns` is the time of its step `step`, None where nobody remembers,
    and of a stored one."""

    id: str
    step: int
    tick_ns: int | None = None
    removed: bool = False


def known_contents(entries: Iterable[EpisodeEntry], removed: Removed) -> dict[str, tuple[KnownContent, ...]]:
    """Content hash, as ingest gives it -> what is known to show that."""
    found: dict[str, tuple[KnownContent, ...]] = {}
    for entry in entries:
        one = KnownContent(entry.id, entry.first_step)
        found[entry.ingest_content] = (*found.get(entry.ingest_content, ()), one)
    for id, gone in removed.items():
        step = int(gone.edits.get("trim", {}).get("first_step", 0))
        one = KnownContent(id, step, gone.tick_ns, removed=True)
        found[gone.ingest_content] = (*found.get(gone.ingest_content, ()), one)
    return found


def written_anew(source: Source, found: Sequence[Source], unclaimed: Sequence[EpisodeEntry]) -> frozenset[str]:
    """The stored episodes whose log may have been written anew as the source's: see the table above."""
    if len({other.log for other in found if other.log.name == source.log.name}) > 1:
        return frozenset()
    return frozenset(
        entry.id for entry in unclaimed if entry.source == source.log.name and _at_the_same_place(entry, source)
    )


def _at_the_same_place(entry: EpisodeEntry, source: Source) -> bool:
    was = Cut.from_json(entry.cut)
    if was is None or source.cut is None:
        return was is None and source.cut is None and entry.source_episode == source.demonstration.name
    return was.range == source.cut.range


def shown_by(
    alike: Iterable[KnownContent], ticks: I64, store: EpisodeStore, *, may_be: Collection[str], removed: bool
) -> KnownContent | None:
    """The first of those of the same content that is at the same time too; of stored ones, those that it `may_be`."""
    for one in alike:
        if not (removed if one.removed else one.id in may_be):
            continue
        tick_ns = one.tick_ns
        if not one.removed:
            try:
                tick_ns = int(shards.read_shard(store.steps_path(one.id)).arrays["log_time_ns"][0])
            except StoreError:  # damaged: nobody can tell
                continue
        if tick_ns is None or tick_ns == ticks[one.step]:
            return one
    return None
