"""The lock of an action set, a plain value and its JSON: exact episodes, their statistics, and the proof that none validates.

The proof is the whole split as it was: labels, video only and validation together are the assignment that `split_hash` is the hash
of, so the file alone shows that no validation episode is among the labels. `check_action_set` compares it with the dataset of today.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vilp_data.action_sets import ActionRecipe, recipe_from_dict
from vilp_data.episode_entry import EpisodeEntry
from vilp_data.errors import ActionSetError, SpecError, StoreError
from vilp_data.keys import digest, ingest_key
from vilp_data.spec import PRESETS
from vilp_data.split_lock import Side, SplitLock, assignment_hash
from vilp_data.stats import ChannelStats

LOCK_FORMAT = 1
DIGITS = 12
"""Of a set's key, as people read it."""


@dataclass(frozen=True)
class LockedSource:
    """One source of a set: how often an epoch of the set goes over the samples of its episodes, and which they are.

    n_steps           valid ones
    effective_epochs  passes over them while as many samples are drawn from the set as it has (by steps)
    """

    name: str
    weight: int
    episodes: tuple[str, ...]
    n_steps: int
    effective_epochs: float


@dataclass(frozen=True)
class LockedEpisode:
    """An episode as it was when the set was locked: `EpisodeEntry.key` and `content_sha256`."""

    key: str
    content: str


@dataclass(frozen=True)
class ActionSetLock:
    """An action set of a dataset.

    recipe      what it was chosen by; `given` is how that was named on the command line: "small", "mine.toml --preset tiny"
    sources     in the recipe's order; no episode is in two
    episodes    id -> what it was, of all sources
    video_only  training episodes that give no labels; validation: those that train nothing. Vanished ones included, as in the split
    split_hash  of the split it was chosen in
    action      statistics of the valid actions of its episodes, and of no others
    seal        SHA-256 of all of this, as recorded; `is_intact` says whether it still fits
    """

    name: str
    given: str
    recipe: ActionRecipe
    sources: tuple[LockedSource, ...]
    episodes: Mapping[str, LockedEpisode]
    video_only: tuple[str, ...]
    validation: tuple[str, ...]
    split_hash: str
    action: ChannelStats
    seal: str = ""

    @property
    def key(self) -> str:
        """SHA-256 of what a model learns from: the episodes as they were, and their weights. Not the name, nor the rest of the
        dataset: a set stays the same when the dataset grows."""
        learnt = {id: [episode.key, episode.content] for id, episode in self.episodes.items()}
        return digest({"episodes": learnt, "weights": self.weights})

    @property
    def weights(self) -> dict[str, int]:
        """Episode id -> the weight of its source."""
        return {id: source.weight for source in self.sources for id in source.episodes}

    @property
    def is_intact(self) -> bool:
        return self.seal == digest(self._table())

    def sealed(self) -> ActionSetLock:
        """The same with its seal."""
        return ActionSetLock(**{**self.__dict__, "seal": digest(self._table())})

    def assignment(self) -> dict[str, Side]:
        """The split it was chosen in."""
        sides: dict[str, Side] = dict.fromkeys((*self.episodes, *self.video_only), "train")
        return sides | dict.fromkeys(self.validation, "val")

    def to_json(self) -> bytes:
        """The lock file: the same bytes for the same set."""
        table = {**self._table(), "key": self.key, "seal": self.seal}
        # Not sorted: the order of sources decides whose an episode is that fits several. All else is in order as it is.
        return (json.dumps(table, indent=1, ensure_ascii=False) + "\n").encode()

    def _table(self) -> dict[str, Any]:
        return {
            "format": LOCK_FORMAT,
            "name": self.name,
            "given": self.given,
            "recipe": self.recipe.model_dump(mode="json"),
            "sources": [{**source.__dict__, "episodes": list(source.episodes)} for source in self.sources],
            "episodes": {id: dict(episode.__dict__) for id, episode in self.episodes.items()},
            "video_only": list(self.video_only),
            "validation": list(self.validation),
            "split_hash": self.split_hash,
            "action": json.loads(self.action.to_json()),
        }

    @classmethod
    def from_json(cls, data: bytes, *, name: str, dataset: object, where: object) -> ActionSetLock:
        """Read the lock of the set `name` of the folder `dataset` back. ActionSetError where it is no lock, of another format version,
        lacks a key, or holds what no lock can: text for a number, or a number that is none.

        One that was changed by hand is read as it stands: `check_action_set` tells."""
        try:
            table = json.loads(data, parse_constant=_finite, parse_float=_finite)
            if not isinstance(table, dict):
                raise TypeError(f"a {type(table).__name__}, not a table")
            if table["format"] != LOCK_FORMAT:
                raise ValueError(f"format {table['format']!r}, this is {LOCK_FORMAT}")
            lock = cls(
                name=_text(table["name"]),
                given=_text(table["given"]),
                recipe=recipe_from_dict(table["recipe"], where=str(where)),
                sources=tuple(map(_source, table["sources"])),
                episodes={
                    id: LockedEpisode(**{field: _text(value) for field, value in episode.items()})
                    for id, episode in table["episodes"].items()
                },
                video_only=_ids(table["video_only"]),
                validation=_ids(table["validation"]),
                split_hash=_text(table["split_hash"]),
                action=_stats(table["action"], where),
                seal=_text(table["seal"]),
            )
            lock.sealed().to_json()  # what cannot be written never was: numbers that are none, text that is no UTF-8
            return lock
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError, SpecError, StoreError) as error:
            remedy = f"restore the file from a backup, or choose the set anew with `{actions_command(dataset, name, '--redraw')}`"
            raise ActionSetError(
                "not the lock of an action set that can be read",
                where=where,
                found=_unread(error),
                remedy=f"{remedy} ({name}.toml, where it was chosen by a file)",
            ) from error


def actions_command(dataset: object, recipe: str, *options: str) -> str:
    """The whole command that locks a set of the folder `dataset`, to be pasted into a shell."""
    return shlex.join(["vilp-data", "actions", str(dataset), "--recipe", recipe, *options])


def redraw_command(lock: ActionSetLock, dataset: object) -> str:
    """The command that chooses the set anew, by the recipe and preset that it was chosen by."""
    recipe, _, preset = lock.given.rpartition(" --preset ")
    named = (recipe, "--preset", preset) if recipe and preset in PRESETS else (lock.given,)
    return actions_command(dataset, *named, "--redraw")


def _source(table: Mapping[str, Any]) -> LockedSource:
    for field, kind in (("weight", int), ("n_steps", int), ("effective_epochs", int | float)):
        if not isinstance(table[field], kind):
            raise TypeError(f"{field} {table[field]!r} of a source")
    return LockedSource(**{**table, "name": _text(table["name"]), "episodes": _ids(table["episodes"])})


def _stats(table: object, where: object) -> ChannelStats:
    stats = ChannelStats.from_json(json.dumps(table).encode(), where=where)[0]
    if stats.count < 1 or (stats.sum_sq < 0).any():
        raise ValueError("statistics that no actions have")
    return stats


def _ids(values: object) -> tuple[str, ...]:
    if not isinstance(values, list):
        raise TypeError(f"{values!r} where a list of episodes belongs")
    return tuple(map(_text, values))


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} where a text belongs")
    return value


def _finite(text: str) -> float:
    """Of JSON's numbers and of what Python takes for one. ValueError for NaN and infinities, as which 1e999 is read, too."""
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text}, which is no number")
    return value


def _unread(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError | UnicodeDecodeError):
        return f"not JSON: {error}"
    return f"it lacks {error}" if isinstance(error, KeyError) else str(error)


def check_action_set(
    lock: ActionSetLock,
    split: SplitLock,
    entries: Sequence[EpisodeEntry],
    *,
    twins: Mapping[str, str],
    dataset: object,
    where: object,
) -> Iterator[ActionSetError]:
    """Everything that is wrong with a lock for the split and the stored episodes of today; nothing where it holds.

    It holds where the file is as it was written, where its own lists prove that no validation episode gives labels, where the split
    still has every episode on the side that it had (it may have grown), and where every episode of the set is stored, unchanged,
    with actions, with the tags that its source asks for, not among those that validate by another name, and twin of none of them: `twins`
    are the hashes (`twins.twin_hashes`) of the stored episodes that are labelled or validate. `dataset` is the folder, `where` the lock."""
    again = f"choose anew with `{redraw_command(lock, dataset)}`, and train again"

    def wrong(what: str, found: Sequence[str] | str, remedy: str) -> ActionSetError:
        words = found if isinstance(found, str) else _listed(found)
        return ActionSetError(f"action set {lock.name!r}: {what}", where=where, found=words, remedy=remedy)

    if not lock.is_intact:
        yield wrong("the lock was changed by hand", "a seal that does not fit", f"put the file back, or {again}")
    if unproved := list(_own_proof(lock)):
        yield from (wrong(what, found, again) for what, found in unproved)
        return
    moved = [
        f"{id} ({side} then, {split.assignment[id]} now)"
        for id, side in sorted(lock.assignment().items())
        if split.assignment.get(id, side) != side
    ]
    if moved:
        yield wrong("the split was drawn anew since", moved, f"put split.lock.json back (`vilp-data undo`), or {again}")
    stored = {entry.id: entry for entry in entries}
    if gone := sorted(id for id in lock.episodes if id not in stored):
        yield wrong(
            "episodes of it are gone",
            gone,
            f"bring them back (`vilp-data undo`, or ingest their logs again), or {again}",
        )
    if changed := [
        f"{id}: {how}" for id in sorted(lock.episodes) if id in stored and (how := _change(lock, stored[id]))
    ]:
        yield wrong("episodes of it changed", changed, f"put them back as they were (`vilp-data undo`), or {again}")
    strangers = [
        f"{id} is not {lock.recipe.source[source.name]}"
        for source in lock.sources
        for id in source.episodes
        if id in stored and not lock.recipe.source[source.name].fits(stored[id].tags)
    ]
    if strangers:
        yield wrong("episodes of it lost the tags of their source", strangers, f"relabel them as they were, or {again}")
    validating = [entry for entry in entries if split.assignment.get(entry.id) == "val"]
    if leaked := _leaks(lock, stored, validating):
        yield wrong(
            "episodes of it validate by another name", leaked, f"take the copies out (`vilp-data remove`), or {again}"
        )
    elif doubled := _twins(lock, twins, validating):
        yield wrong(
            "validation episodes have the same actions as episodes of it, step for step",
            doubled,
            f"take one of each two out (`vilp-data remove`), or draw a split that keeps them on one side "
            f"(`{shlex.join(['vilp-data', 'split', str(dataset), '--redraw'])}`) and {again}",
        )


def _own_proof(lock: ActionSetLock) -> Iterator[tuple[str, str]]:
    if [source.name for source in lock.sources] != list(lock.recipe.source):
        yield "its sources are not those of its recipe", ", ".join(source.name for source in lock.sources)
    listed = [id for source in lock.sources for id in source.episodes]
    if sorted(listed) != sorted(lock.episodes):
        yield "its sources and its episodes are not the same", f"{len(listed)} in sources, {len(lock.episodes)} in all"
    if both := sorted(lock.episodes.keys() & {*lock.video_only, *lock.validation}):
        yield "episodes that give labels are listed as giving none", _listed(both)
    if assignment_hash(lock.assignment()) != lock.split_hash:
        yield "its lists are not the split that it was chosen in", f"split {lock.split_hash[:DIGITS]}"


def _change(lock: ActionSetLock, entry: EpisodeEntry) -> str | None:
    then = lock.episodes[entry.id]
    if not entry.has_action:
        return "has no actions any more"
    if entry.key != then.key:
        return f"key {then.key[:DIGITS]}… then, {entry.key[:DIGITS]}… now"
    if entry.content_sha256 != then.content:
        return f"content {then.content[:DIGITS]}… then, {entry.content_sha256[:DIGITS]}… now"
    return None


def _leaks(lock: ActionSetLock, stored: Mapping[str, EpisodeEntry], validating: Sequence[EpisodeEntry]) -> list[str]:
    keys = {ingest_key(episode.key): id for id, episode in lock.episodes.items()}
    contents = {stored[id].ingest_content: id for id in lock.episodes if id in stored}
    found = ((entry.id, keys.get(entry.ingest_key) or contents.get(entry.ingest_content)) for entry in validating)
    return [f"{id} is {labelled}" for id, labelled in found if labelled is not None]


def _twins(lock: ActionSetLock, twins: Mapping[str, str], validating: Sequence[EpisodeEntry]) -> list[str]:
    labelled = {twins[id]: id for id in lock.episodes if id in twins}
    found = ((entry.id, labelled.get(twins.get(entry.id, ""))) for entry in validating)
    return [f"{id} does what {one} does" for id, one in found if one is not None]


def _listed(items: Sequence[str], limit: int = 5) -> str:
    return ", ".join(items[:limit]) + (f" and {len(items) - limit} more" if len(items) > limit else "")
