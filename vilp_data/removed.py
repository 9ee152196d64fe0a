"""Episodes that were taken out on purpose: `removed.json`, so that the next ingest or merge does not bring them back without a word."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vilp_data.dataset_state import dumps
from vilp_data.episode_entry import EpisodeEntry
from vilp_data.errors import StoreError

REMOVED_FORMAT = 1


@dataclass(frozen=True)
class RemovedEpisode:
    """What is still known of an episode that was removed: where it came from, its content, why and by which operation it went.

    edits  what people had decided about it, as `EpisodeEntry.edits`: kept, should it be wanted again
    cut    its range of the log, as `EpisodeEntry.cut`
    tick_ns  the time of its first step (of the first that a trim had left); None in files of an older version"""

    source: str
    source_sha256: str
    source_episode: str
    ingest_key: str
    ingest_content: str
    reason: str
    operation: int
    edits: Mapping[str, Any] = field(default_factory=dict)
    cut: Mapping[str, Any] = field(default_factory=dict)
    tick_ns: int | None = None


Removed = Mapping[str, RemovedEpisode]
"""By id. No other episode is given a removed one's id: its side of the split, and what was trained on it, go by that."""


def removed_path(root: Path) -> Path:
    return root / "removed.json"


def read_removed(root: Path) -> dict[str, RemovedEpisode]:
    """What was removed from the dataset. Raises StoreError where the file is damaged."""
    path = removed_path(root)
    try:
        table = json.loads(path.read_bytes())
        if table["format"] != REMOVED_FORMAT:
            raise ValueError(f"format {table['format']!r}, this is {REMOVED_FORMAT}")
        return {id: RemovedEpisode(**episode) for id, episode in table["episodes"].items()}
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        remedy = "restore it from history/held/, or delete it: the next ingest then brings back what was removed"
        raise StoreError("not a list of removed episodes", where=path, found=repr(error), remedy=remedy) from error


def removed_bytes(removed: Removed) -> bytes:
    """The file for these episodes: the same bytes for the same ones."""
    return dumps({"format": REMOVED_FORMAT, "episodes": {id: asdict(episode) for id, episode in removed.items()}})


def removed_episode(entry: EpisodeEntry, *, tick_ns: int, reason: str, operation: int) -> RemovedEpisode:
    return RemovedEpisode(
        entry.source,
        entry.source_sha256,
        entry.source_episode,
        entry.ingest_key,
        entry.ingest_content,
        reason,
        operation,
        dict(entry.edits),
        dict(entry.cut),
        tick_ns,
    )
