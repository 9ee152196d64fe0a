"""Twins: episodes that differ in their pictures alone. Their actions and low_dim are the same, bit for bit, step for step.

A content hash cannot see them, since it is of frames too. But whoever trained on the one has the labels of the other: an expert that draws
from its seed alone does the same on a gray and on a purple block, and one log drawn twice gives the same actions beside other pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy.typing as npt

from vilp_data.episode_entry import EpisodeEntry
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeStore
from vilp_data.keys import content_digest
from vilp_data.split_lock import SplitLock


def twin_hash(steps: Mapping[str, npt.NDArray[Any]]) -> str | None:
    """Equal for twins. None for an episode that has no labels to give away: one without actions, or in which nothing ever moves."""
    if "action" not in steps or all((column == column[:1]).all() for column in (steps["action"], steps["low_dim"])):
        return None
    return content_digest(steps["action"], steps["low_dim"])


def twin_hashes(store: EpisodeStore, entries: Iterable[EpisodeEntry], known: SplitLock | None) -> dict[str, str]:
    """Episode id -> `twin_hash`, of those of `entries` that have actions; of a trimmed one that of the whole, where the split knows it.

    Steps are read only of what the split does not know as it is. Raises StoreError where such a file cannot be read."""
    hashes = {}
    for entry in entries:
        hash_then = None if known is None else known.twins.get(entry.id)
        if hash_then is None or known is None or known.contents.get(entry.id) != entry.ingest_content:
            hash_then = twin_hash(open_steps(store, entry)) if entry.has_action else None
        if hash_then is not None:
            hashes[entry.id] = hash_then
    return hashes
