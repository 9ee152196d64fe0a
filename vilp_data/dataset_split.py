"""The split of a dataset folder: split.lock.json read, drawn from the stored episodes, written.

A policy's own episodes (`types.is_rollout`) may be stored and viewed, but are on neither side: no model learns from them, and
none is judged by them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from vilp_data import history, shards
from vilp_data.duplicates import thumbnails
from vilp_data.episode_files import open_frames
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import SplitError
from vilp_data.removed import read_removed
from vilp_data.split import RatioOrigin, SplitEpisode, check_split, draw_split
from vilp_data.split_lock import Side, SplitLock, assignment_hash
from vilp_data.twins import twin_hashes
from vilp_data.types import is_rollout
from vilp_data.writer_lock import writer_lock


def lock_path(root: Path) -> Path:
    return root / "split.lock.json"


def read_split(root: Path) -> SplitLock:
    """The dataset's split. Raises SplitError where none was drawn, or the lock was changed by hand."""
    lock = find_split(root)
    if lock is None:
        raise SplitError("this dataset has no split yet", where=root, remedy=f"run `vilp-data split {root}`")
    if not lock.is_intact:
        raise SplitError(
            "the assignment does not match its recorded hash: it was changed by hand",
            where=lock_path(root),
            remedy="put the file back as it was, or `vilp-data split --redraw` (trained models then no longer fit it)",
        )
    return lock


def find_split(root: Path) -> SplitLock | None:
    path = lock_path(root)
    return SplitLock.from_json(path.read_bytes(), where=path) if path.is_file() else None


def side_episodes(store: EpisodeStore, side: Side) -> list[EpisodeEntry]:
    """The stored episodes on one side of the split, sorted by id.

    Raises SplitError as `read_split` does, and where a stored episode has no side yet."""
    lock, entries = read_split(store.root), store.index()
    unassigned = [entry.id for entry in entries if entry.id not in lock.assignment and not is_rollout(entry.tags)]
    if unassigned:
        raise SplitError(
            "the split does not cover every episode",
            where=lock_path(store.root),
            found=f"{len(unassigned)} without a side, such as {unassigned[0]}",
            remedy=f"run `vilp-data split {store.root}`: it places what is new and moves nothing",
        )
    return [entry for entry in entries if lock.assignment.get(entry.id) == side]


def update_split(
    root: Path,
    *,
    ratio: float,
    ratio_from: RatioOrigin,
    seed: int,
    group_by: str | None,
    strata: tuple[str, ...],
    redraw: bool,
) -> SplitLock:
    """Draw or extend the split over all stored episodes and write it where it changed. A lock that cannot be read is no hindrance to a
    `redraw`, and waits in history/held/. Raises as `split.draw_split` does."""
    with writer_lock(root):
        previous = _earlier_split(root, redraw=redraw)
        lock = draw_split(
            list(split_episodes(EpisodeStore(root), group_by, strata, known=previous)),
            ratio=ratio,
            seed=seed,
            ratio_from=ratio_from,
            group_by=group_by,
            strata=strata,
            previous=previous,
            redraw=redraw,
        )
        data = lock.to_json()
        path = lock_path(root)
        if not path.is_file() or path.read_bytes() != data:
            staged = history.stage(root, path.name)
            shards.write_atomic(staged, data)
            note = _in_words(lock, previous, redraw=redraw)
            history.begin(root).perform("split", history.Changes({path.name: staged}), note)
    return lock


def _earlier_split(root: Path, *, redraw: bool) -> SplitLock | None:
    if redraw:
        try:
            return find_split(root)
        except SplitError:
            return None
    return read_split(root) if lock_path(root).is_file() else None


def _in_words(lock: SplitLock, previous: SplitLock | None, *, redraw: bool) -> str:
    sides = f"{len(lock.ids('train'))} training, {len(lock.ids('val'))} validation"
    if previous is None or redraw:
        return f"drawn{' anew' if previous else ''}: {sides}"
    return f"{len(lock.assignment.keys() - previous.assignment.keys())} episodes placed: {sides}"


def check_dataset_split(root: Path) -> list[str]:
    """What is wrong with the dataset's split, one sentence each."""
    lock = find_split(root)
    if lock is None:
        return ["no split yet: run `vilp-data split`"]
    here = list(split_episodes(EpisodeStore(root), lock.group_by, lock.strata, known=lock))
    # What was removed on purpose is no finding: it keeps its side, should it come back.
    away = read_removed(root).keys() - {episode.id for episode in here}
    if away and lock.is_intact:
        kept = {id: side for id, side in lock.assignment.items() if id not in away}
        lock = replace(lock, assignment=kept, hash=assignment_hash(kept))
    return check_split(lock, here)


def split_episodes(
    store: EpisodeStore, group_by: str | None, strata: tuple[str, ...], *, known: SplitLock | None = None
) -> Iterator[SplitEpisode]:
    """What the split needs to know of each stored episode that is to have a side. `known` is what it was told before."""
    for entry in store.index():
        if is_rollout(entry.tags):
            continue
        for tag in (*strata, *([group_by] if group_by else [])):
            if tag not in entry.tags:
                raise SplitError(
                    f"no tag {tag!r}, which the split groups or spreads by",
                    where=entry.id,
                    found=f"tags {', '.join(sorted(entry.tags)) or '(none)'}",
                    remedy=f"`vilp-data relabel {entry.id} --set {tag}=…`, or name another tag in [split]",
                )
        yield SplitEpisode(
            id=entry.id,
            content_hash=entry.ingest_content,
            twin_hash=twin_hashes(store, [entry], known).get(entry.id),
            group=entry.tags[group_by] if group_by else None,
            strata=tuple(entry.tags[tag] for tag in strata),
            thumbnails=_thumbnails(store, entry),
        )


def split_by(entries: Iterable[EpisodeEntry], lock: SplitLock) -> list[SplitEpisode]:
    """What decides of each episode with a side where it belongs, by the lock's own rule: its content, and its group's tag."""
    return [
        SplitEpisode(entry.id, entry.ingest_content, group=entry.tags.get(lock.group_by) if lock.group_by else None)
        for entry in entries
        if not is_rollout(entry.tags)
    ]


def _thumbnails(store: EpisodeStore, entry: EpisodeEntry) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]] | None:
    """The first, middle and last frame of every view, small and grey: float32 [3V,8,8]; None for an episode without views."""
    rows = []
    for view in sorted(entry.frames_sha256):
        rows.append(thumbnails(open_frames(store, entry, view)))
    return np.concatenate(rows) if rows else None
