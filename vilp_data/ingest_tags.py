"""Tags of stored episodes whose logs do not say what they show: from whoever ingests them, or from a task that got its [tags] later.

What is ingested with the task's tags has them as if its log said so (`ingest_sources.read_sources`)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

from vilp_data.edits import edits_of
from vilp_data.episodes import EpisodeStore
from vilp_data.spec import TaskSpec
from vilp_data.surgery.operations import relabel_episodes


def tag_episodes(root: Path, spec: TaskSpec, episodes: Iterable[str], labels: Mapping[str, str]) -> list[str]:
    """Give the stored `episodes` these labels, and those of the task's `tags` that neither the log nor a person spoke of. Returns the
    ids of those that changed; they are relabelled as by `vilp-data relabel`.

    Raises UsageError for a label that cannot be set, BusyError where another process writes the dataset."""
    wanted, named = defaultdict(list), set(episodes)
    for entry in EpisodeStore(root).index():
        if entry.id in named:
            said = {*entry.tags, *edits_of(entry.edits).unset}
            given = {tag: value for tag, value in spec.tags_of(entry.source).items() if tag not in said} | dict(labels)
            if any(entry.tags.get(tag) != value for tag, value in given.items()):
                wanted[tuple(sorted(given.items()))].append(entry.id)
    changed: list[str] = []
    for pairs, ids in sorted(wanted.items()):
        changed += relabel_episodes(root, ids, labels=dict(pairs)).changed
    return sorted(changed)
