"""An episode's files, mapped and checked to belong together: to the entry that names them, and to each other.

Mapping reads headers and compares what they say: keys, hashes and lengths. The bytes of the arrays are checksummed only by
whole reads (`EpisodeStore.read`, `EpisodeStore.read_frames`, `shards.verify_shard`), which a map exists to avoid.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import numpy.typing as npt

from vilp_data import shards
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError
from vilp_data.types import U8

INGEST_AGAIN = "run `vilp-data ingest` on its log again"


def open_steps(store: EpisodeStore, entry: EpisodeEntry, views: Iterable[str] = ()) -> dict[str, npt.NDArray[Any]]:
    """The mapped arrays of an episode's steps, by name; `source_index` of `views` checked against the frames there are.

    Raises StoreError where the file is missing, is of another ingest than `entry`, or points past the stored frames."""
    path = store.steps_path(entry.id)
    shard = shards.open_shard(path)
    for field, expected in (("key", entry.key), ("content_sha256", entry.content_sha256)):
        if shard.metadata.get(field) != expected:
            found = f"{field} {shard.metadata.get(field)} instead of {expected}"
            remedy = f"open the dataset again if it was ingested anew meanwhile, else {INGEST_AGAIN}"
            raise StoreError("not the episode that the index knows", where=path, found=found, remedy=remedy)
    for name in ("valid", *(f"source_index/{view}" for view in views)):
        if len(shard.arrays[name]) != entry.n_steps:
            found = f"{len(shard.arrays[name])} of {name}, {entry.n_steps} steps"
            raise StoreError(
                "arrays that do not cover the episode's steps", where=path, found=found, remedy=INGEST_AGAIN
            )
    for view in views:
        used = shard.arrays[f"source_index/{view}"][shard.arrays["valid"]]
        if used.size and (used.min() < 0 or used.max() >= entry.n_frames[view]):
            found = f"frames {used.min()} to {used.max()} of {entry.n_frames[view]} of view {view!r}"
            raise StoreError("steps that point past the stored frames", where=path, found=found, remedy=INGEST_AGAIN)
    return shard.arrays


def open_frames(store: EpisodeStore, entry: EpisodeEntry, view: str) -> U8:
    """The mapped frames uint8 [n,H,W,C] of one view; of a trimmed episode those that are left. Raises StoreError where they are
    missing, or not those that the episode was committed with."""
    path = store.frames_path(view, entry.id)
    shard = shards.open_shard(path)
    frames = shard.arrays["frames"]
    stored, first = entry.stored_frames(view), entry.first_frame(view)
    if shard.metadata.get("frames_sha256") != entry.frames_sha256[view] or len(frames) != stored:
        found = f"{len(frames)} frames; the episode has {stored}"
        raise StoreError("not the frames this episode was committed with", where=path, found=found, remedy=INGEST_AGAIN)
    return cast(U8, frames[first : first + entry.n_frames[view]])
