"""The stored episodes of an action set: what a model that learns by the set can open, and nothing else.

Datasets and statistics of such a model read steps through this alone. An episode that gives video only is refused before its file is
opened, so its actions never reach the model, whatever asks for them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.action_set_lock import ActionSetLock
from vilp_data.action_sets import repeats
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import ActionSetError
from vilp_data.stats import ChannelStats
from vilp_data.types import I64


class LabelledEpisodes:
    """The episodes of a set that was found to hold (`dataset_action_sets.read_action_set`), sorted by id."""

    def __init__(self, store: EpisodeStore, lock: ActionSetLock, stored: Sequence[EpisodeEntry]) -> None:
        """`stored` are the dataset's episodes of today."""
        self._store, self.lock = store, lock
        self.entries = [entry for entry in stored if entry.id in lock.episodes]

    @property
    def name(self) -> str:
        return self.lock.name

    @property
    def key(self) -> str:
        """SHA-256 of what a model learns from; see `ActionSetLock.key`."""
        return self.lock.key

    @property
    def action(self) -> ChannelStats:
        """Statistics of the valid actions of these episodes alone, as they were locked."""
        return self.lock.action

    def of_side(self, side: str) -> list[EpisodeEntry]:
        """All of them, for they are on the training side. Raises ActionSetError for another."""
        if side != "train":
            what = f"the episodes of the action set {self.name!r} are training episodes"
            raise ActionSetError(
                what, found=f"asked for those of {side!r}", remedy="leave the set out to judge a model"
            )
        return self.entries

    def repeats(self) -> I64:
        """int64 [E]: how often each sample of each of `entries` occurs in an epoch, by the weights of their sources."""
        sources = self.lock.sources
        times = dict(zip((source.name for source in sources), repeats([s.weight for s in sources]), strict=True))
        by_id = {id: times[source.name] for source in sources for id in source.episodes}
        return np.array([by_id[entry.id] for entry in self.entries], np.int64)

    def source_of(self, episode_id: str) -> str:
        """The source that an episode of the set is in. Raises ActionSetError for another."""
        for source in self.lock.sources:
            if episode_id in source.episodes:
                return source.name
        raise self._refusal(episode_id)

    def open_steps(self, entry: EpisodeEntry, views: Iterable[str] = ()) -> dict[str, npt.NDArray[Any]]:
        """As `episode_files.open_steps`, of an episode of the set. Raises ActionSetError for any other, or for one that is not as it
        was locked, before its file is touched."""
        then = self.lock.episodes.get(entry.id)
        if then is None or (then.key, then.content) != (entry.key, entry.content_sha256):
            raise self._refusal(entry.id)
        return open_steps(self._store, entry, views)

    def _refusal(self, episode_id: str) -> ActionSetError:
        return ActionSetError(
            f"the action set {self.name!r} does not give the actions of {episode_id!r}",
            where=self._store.root,
            found=f"{len(self.lock.episodes)} episodes in the set; this one gives video only, or was changed since",
            remedy="choose a set that holds it: `vilp-data actions --recipe FILE.toml`",
        )
