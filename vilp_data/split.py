"""Which episodes train and which validate: drawn once, locked, and only ever added to.

A lock is a plain value: this module neither reads nor writes files. Three rules hold whatever the input:

- Episodes of one group, episodes of identical content, and twins (`twins`) are on one side.
- What the lock has assigned stays assigned, for episodes that have vanished too: one that comes back, or comes back
  renamed, must not change sides, since a checkpoint may have trained on it.
- Each side has at least one episode.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy.typing as npt

from vilp_data.duplicates import NearDuplicate, near_duplicates
from vilp_data.errors import SplitError
from vilp_data.split_lock import RatioOrigin, Side, SplitLock, assignment_hash

__all__ = [
    "NearDuplicate",
    "RatioOrigin",
    "Side",
    "SplitEpisode",
    "SplitLock",
    "assignment_hash",
    "check_split",
    "draw_split",
    "leaks",
]

NEAR_LIMIT = 1000  # pairs reported at most: a scene that hardly moves would otherwise fill the lock


@dataclass(frozen=True)
class SplitEpisode:
    """What the split needs to know of an episode.

    content_hash  equal for two episodes exactly when they show the same thing
    group         value of the tag that the task groups by; None where it groups by nothing
    strata        values of the tags to spread evenly, in the task's order
    twin_hash     equal for two episodes exactly when the same was done and measured in them, whatever they show; None without actions
    thumbnails    [..., 8, 8] grey levels (see `duplicates.thumbnails`) to find near-identical episodes by; or None
    """

    id: str
    content_hash: str
    group: str | None = None
    strata: tuple[str, ...] = ()
    twin_hash: str | None = None
    thumbnails: npt.NDArray[Any] | None = field(default=None, compare=False)


def draw_split(
    episodes: Sequence[SplitEpisode],
    *,
    ratio: float,
    seed: int,
    ratio_from: RatioOrigin = "task",
    group_by: str | None = None,
    strata: tuple[str, ...] = (),
    previous: SplitLock | None = None,
    redraw: bool = False,
) -> SplitLock:
    """Assign every episode to a side; the order of `episodes` does not matter.

    Groups are ranked by a hash keyed with `seed`, and the first of them go to validation until it holds exactly
    round((1 - ratio) * n) of the n episodes, at least 1 and at most n - 1. Where groups hold several episodes and no
    set of whole groups adds up to that number, it is the nearest one that some set does (the lower of two). Strata
    share it by largest remainder, strata of a single group pooled into one; a group counts in the stratum that most of
    its episodes have. Where uneven groups cannot meet both the number and the shares, the number is met.

    With a `previous` lock its assignments and its seed stay, a newcomer goes with its group, and only new groups are
    placed, so as to come nearest to the ratio over all episodes that are present. `redraw` forgets the assignments.
    A ratio from the command line outranks the task's in all later runs, those that redraw included.

    Raises SplitError with fewer than two episodes or two groups, for a name that occurs twice, for a newcomer that
    belongs to groups on both sides, and where keeping the lock would leave a side empty.
    """
    if not 0 < ratio < 1:
        raise SplitError(
            "a split ratio lies between 0 and 1", found=ratio, remedy="0.9 keeps nine of ten episodes for training"
        )
    episodes = sorted(episodes, key=lambda episode: episode.id)
    _require_distinct(episodes)
    if previous is not None and previous.ratio_from == "command line" and ratio_from == "task":
        ratio, ratio_from = previous.ratio, "command line"
    locked = previous if previous is not None and not redraw else None
    known = dict(locked.assignment) if locked else {}
    seed = locked.seed if locked else seed

    groups = _joined(episodes, locked)
    assignment = known | _newcomers_of_known_groups(groups, known)
    assignment |= _place(groups, assignment, ratio=ratio, seed=seed)
    return SplitLock(
        assignment=dict(sorted(assignment.items())),
        hash=assignment_hash(assignment),
        seed=seed,
        ratio=ratio,
        ratio_from=ratio_from,
        group_by=group_by,
        strata=strata,
        groups=(dict(locked.groups) if locked else {}) | {episode.id: _label(episode) for episode in episodes},
        contents=(dict(locked.contents) if locked else {}) | {episode.id: episode.content_hash for episode in episodes},
        twins=(dict(locked.twins) if locked else {}) | _twins(episodes),
        duplicates=_duplicates(episodes),
        near_duplicates=_near_duplicates(episodes, assignment),
    )


def check_split(lock: SplitLock, episodes: Sequence[SplitEpisode]) -> list[str]:
    """What is wrong with a lock for the episodes at hand, one sentence each; empty when nothing is.

    Looks for a changed assignment, episodes without a side, episodes that the lock knows and the dataset lacks, a group,
    identical content or twins on both sides, an empty side, and a validation share further from the ratio than whole groups
    force it to be.
    """
    findings = []
    if not lock.is_intact:
        findings.append("the assignment does not match its recorded hash: it was changed by hand")
    present = {episode.id for episode in episodes}
    unassigned = sorted(present - set(lock.assignment))
    if unassigned:
        findings.append(f"{_listed(unassigned)} without a side: run `vilp-data split`")
    vanished = sorted(set(lock.assignment) - present)
    if vanished:
        findings.append(f"{_listed(vanished)} in the lock but not in the dataset: kept, to return to the same side")
    findings += leaks(lock, episodes)
    findings += _drift(lock, [episode for episode in episodes if episode.id in lock.assignment])
    return findings


# --- groups ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Group:
    """Episodes that stay together, `present` in the dataset or `vanished` from it. `stratum` is the usual one."""

    key: str
    present: tuple[str, ...]
    vanished: tuple[str, ...]
    stratum: tuple[str, ...]


def _joined(episodes: Sequence[SplitEpisode], locked: SplitLock | None) -> list[_Group]:
    """Connected components over equal groups, equal contents and twins, vanished episodes included, sorted by key."""
    present = {episode.id: episode for episode in episodes}
    vanished = sorted(set(locked.assignment) - set(present)) if locked else []
    links = {episode.id: (_label(episode), episode.content_hash, episode.twin_hash) for episode in episodes}
    if locked:
        links |= {id: (locked.groups.get(id, id), locked.contents.get(id, ""), locked.twins.get(id)) for id in vanished}

    root: dict[tuple[str, str], tuple[str, str]] = {}

    def find(node: tuple[str, str]) -> tuple[str, str]:
        root.setdefault(node, node)
        while root[node] != node:
            root[node] = root[root[node]]
            node = root[node]
        return node

    for id, (label, content, twin) in links.items():
        root[find(("group", label))] = find(("content", content or id))
        root[find(("group", label))] = find(("twin", twin or id))
    members: dict[tuple[str, str], list[str]] = defaultdict(list)
    for id in sorted(links):
        members[find(("group", links[id][0]))].append(id)
    groups = []
    for ids in members.values():
        strata = Counter(present[id].strata for id in ids if id in present)
        groups.append(
            _Group(
                key=min(links[id][0] for id in ids),
                present=tuple(id for id in ids if id in present),
                vanished=tuple(id for id in ids if id not in present),
                stratum=min(strata, key=lambda stratum: (-strata[stratum], stratum), default=()),
            )
        )
    return sorted((group for group in groups if group.present), key=lambda group: group.key)


def _newcomers_of_known_groups(groups: Iterable[_Group], known: Mapping[str, Side]) -> dict[str, Side]:
    """New episodes whose group has a side already. SplitError where it has two."""
    placed: dict[str, Side] = {}
    for group in groups:
        members = group.present + group.vanished
        new = [id for id in group.present if id not in known]
        sides = sorted({known[id] for id in members if id in known})
        if new and len(sides) > 1:
            raise SplitError(
                "a new episode belongs with episodes on both sides",
                where=_listed(new),
                found=f"same group, content or actions as {_listed([id for id in members if id in known])}",
                remedy="take the new episode out, or draw a new split with `vilp-data split --redraw`",
            )
        if sides:
            placed |= dict.fromkeys(new, sides[0])
    return placed


# --- placing --------------------------------------------------------------------------------------------------------


def _place(groups: Sequence[_Group], assignment: Mapping[str, Side], *, ratio: float, seed: int) -> dict[str, Side]:
    """Sides for the groups that have none."""
    pools = _pooled(groups)
    n = sum(len(group.present) for group in groups)
    locked = Counter(assignment[id] for group in groups for id in group.present if id in assignment)
    free = {name: [g for g in pool if g.present[0] not in assignment] for name, pool in pools.items()}
    for pool in free.values():
        pool.sort(key=lambda group: _rank(group.key, seed))
    sizes = {name: [len(group.present) for group in pool] for name, pool in free.items()}
    reachable = _sums([size for name in free for size in sizes[name]])

    wanted = _validation_count(n, ratio)
    n_free = n - locked["train"] - locked["val"]
    lowest, highest = int(locked["val"] == 0), n_free - int(locked["train"] == 0)
    total = _nearest_sum(reachable, wanted - locked["val"], lowest, highest)
    if total is None:
        raise SplitError(
            "one side of the split would be empty",
            found=f"{n} episodes in {len(groups)} groups; locked: {locked['train']} train, {locked['val']} val",
            remedy="add episodes, group by another tag, or draw a new split with `vilp-data split --redraw`",
        )
    shares = _largest_remainder({name: sum(len(g.present) for g in pool) for name, pool in pools.items()}, wanted)
    for name, pool in pools.items():
        shares[name] -= sum(assignment.get(id) == "val" for group in pool for id in group.present)
    return _choose(free, shares, total)


def _pooled(groups: Sequence[_Group]) -> dict[tuple[str, ...], list[_Group]]:
    """Groups by stratum, strata of a single group pooled into one; sorted."""
    strata: dict[tuple[str, ...], list[_Group]] = defaultdict(list)
    for group in groups:
        strata[group.stratum].append(group)
    pooled: dict[tuple[str, ...], list[_Group]] = {}
    rest: list[_Group] = []
    for name in sorted(strata):
        if len(strata[name]) > 1:
            pooled[name] = strata[name]
        else:
            rest += strata[name]
    if rest:
        pooled[("", "single-group strata")] = rest
    return pooled


def _choose(
    free: Mapping[tuple[str, ...], list[_Group]], shares: Mapping[tuple[str, ...], int], total: int
) -> dict[str, Side]:
    """Send groups that add up to `total` to validation, each stratum near its share, best ranks first."""
    names = list(free)
    sizes = [[len(group.present) for group in free[name]] for name in names]
    after = [_sums([size for later in sizes[place + 1 :] for size in later]) for place in range(len(names))]
    placed: dict[str, Side] = {}
    for place, name in enumerate(names):
        own = _sums(sizes[place])
        fits = [s for s in range(min(total, sum(sizes[place])) + 1) if own >> s & 1 and after[place] >> (total - s) & 1]
        count = min(fits, key=lambda s: (abs(s - shares[name]), s))
        for group, taken in zip(free[name], _first_subset(sizes[place], count), strict=True):
            placed |= dict.fromkeys(group.present, "val" if taken else "train")
        total -= count
    return placed


def _first_subset(sizes: Sequence[int], total: int) -> list[bool]:
    """Which of `sizes` to take to add up to `total`, the earliest that can be; some subset must add up to it."""
    later = [1]
    for size in reversed(sizes[1:]):
        later.append(later[-1] | later[-1] << size)
    taken = []
    for size, rest in zip(sizes, reversed(later), strict=False):
        take = size <= total and bool(rest >> (total - size) & 1)
        total -= size * take
        taken.append(take)
    return taken


def _sums(sizes: Iterable[int]) -> int:
    """Bit s is set where some subset of `sizes` adds up to s."""
    reachable = 1
    for size in sizes:
        reachable |= reachable << size
    return reachable


def _nearest_sum(reachable: int, wanted: int, lowest: int, highest: int) -> int | None:
    sums = [s for s in range(lowest, highest + 1) if reachable >> s & 1]
    return min(sums, key=lambda s: (abs(s - wanted), s), default=None)


def _validation_count(n: int, ratio: float) -> int:
    return min(max(round((1 - ratio) * n), 1), n - 1)


def _largest_remainder(sizes: Mapping[tuple[str, ...], int], total: int) -> dict[tuple[str, ...], int]:
    """`total` shared in proportion to `sizes`, adding up exactly (Hamilton's method; ties go to the smaller name)."""
    n = sum(sizes.values())
    shares = {name: total * size // n for name, size in sizes.items()}
    by_remainder = sorted(sizes, key=lambda name: (-(total * sizes[name] % n), name))
    for name in by_remainder[: total - sum(shares.values())]:
        shares[name] += 1
    return shares


def _rank(key: str, seed: int) -> bytes:
    return hashlib.blake2b(key.encode(), key=str(seed).encode()[:64], digest_size=16).digest()


# --- reporting ------------------------------------------------------------------------------------------------------


def _duplicates(episodes: Iterable[SplitEpisode]) -> tuple[tuple[str, ...], ...]:
    same: dict[str, list[str]] = defaultdict(list)
    for episode in episodes:
        same[episode.content_hash].append(episode.id)
    return tuple(sorted(tuple(sorted(ids)) for ids in same.values() if len(ids) > 1))


def _twins(episodes: Iterable[SplitEpisode]) -> dict[str, str]:
    return {episode.id: episode.twin_hash for episode in episodes if episode.twin_hash is not None}


def _near_duplicates(episodes: Sequence[SplitEpisode], assignment: Mapping[str, Side]) -> tuple[NearDuplicate, ...]:
    content = {episode.id: episode.content_hash for episode in episodes}
    pairs = near_duplicates({episode.id: episode.thumbnails for episode in episodes if episode.thumbnails is not None})
    different = [pair for pair in pairs if content[pair.first] != content[pair.second]]
    different.sort(key=lambda pair: assignment[pair.first] == assignment[pair.second])
    return tuple(different[:NEAR_LIMIT])


def leaks(lock: SplitLock, episodes: Sequence[SplitEpisode]) -> list[str]:
    """Groups, contents and twins on both sides, among the episodes at hand and those the lock remembers."""
    groups = dict(lock.groups) | {episode.id: _label(episode) for episode in episodes}
    contents = dict(lock.contents) | {episode.id: episode.content_hash for episode in episodes}
    twins = dict(lock.twins) | _twins(episodes)
    findings = []
    for what, labels in (("group", groups), ("identical content", contents), ("identical actions", twins)):
        sides: dict[str, dict[Side, list[str]]] = defaultdict(lambda: defaultdict(list))
        for id, side in sorted(lock.assignment.items()):
            if id in labels:
                sides[labels[id]][side].append(id)
        for label, by_side in sorted(sides.items()):
            if len(by_side) > 1:
                trains, validates = _listed(by_side["train"]), _listed(by_side["val"])
                findings.append(f"{what} {label[:40]!r} on both sides: {trains} in training, {validates} in validation")
    return findings


def _drift(lock: SplitLock, episodes: Sequence[SplitEpisode]) -> list[str]:
    if len(episodes) < 2:
        return []
    counts = Counter(lock.assignment[episode.id] for episode in episodes)
    empty = [side for side in get_args(Side) if not counts[side]]
    if empty:
        return [f"no {empty[0]} episode is left: add episodes, or draw a new split with `vilp-data split --redraw`"]
    wanted = _validation_count(len(episodes), lock.ratio)
    # Whole groups need not come nearer than half of the largest.
    slack = max(len(group.present) for group in _joined(episodes, None)) / 2
    if abs(counts["val"] - wanted) <= slack:
        return []
    return [
        f"{counts['val']} of {len(episodes)} episodes validate where ratio {lock.ratio:g} asks for {wanted}: "
        "locked episodes never move; `vilp-data split --redraw` starts over"
    ]


def _label(episode: SplitEpisode) -> str:
    return episode.id if episode.group is None else episode.group


def _listed(ids: Sequence[str], limit: int = 5) -> str:
    more = f" and {len(ids) - limit} more" if len(ids) > limit else ""
    return ", ".join(ids[:limit]) + more


def _require_distinct(episodes: Sequence[SplitEpisode]) -> None:
    if len(episodes) < 2:
        raise SplitError(
            "a split needs at least two episodes", found=f"{len(episodes)}", remedy="ingest more episodes first"
        )
    twice = [id for id, count in Counter(episode.id for episode in episodes).items() if count > 1]
    if twice:
        raise SplitError(
            "two episodes of one name", found=_listed(twice), remedy="rebuild the index; names must be unique"
        )
