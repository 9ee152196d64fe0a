"""Labels that whoever ingests gives to what is ingested, whatever the logs say. Tags of a task are as if a log said them
(`ingest_sources.read_sources`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from vilp_data.episodes import EpisodeStore
from vilp_data.surgery.operations import relabel_episodes


def tag_episodes(root: Path, episodes: Iterable[str], labels: Mapping[str, str]) -> list[str]:
    """Give the stored `episodes` these labels. Returns the ids of those that changed; they are relabelled as by `vilp-data relabel`.

    Raises UsageError for a label that cannot be set, BusyError where another process writes the dataset."""
    named = set(episodes)
    other = [
        entry.id
        for entry in EpisodeStore(root).index()
        if entry.id in named and any(entry.tags.get(tag) != value for tag, value in labels.items())
    ]
    return sorted(relabel_episodes(root, other, labels=labels).changed) if other else []
