"""SHA-256 of every demonstration of a log, remembered for as long as the log's files look untouched.

So a run that has nothing to do does not read terabytes again. As in git's index, "untouched" is size, time of change and inode of
every file; a file that changed within the last seconds is never remembered, since it may change again within one tick of the clock.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from vilp_data import shards
from vilp_data.keys import digest
from vilp_data.sources.folder_hash import log_files
from vilp_data.types import LogEpisode, LogReader

SETTLED_AFTER_S = 2.0


@runtime_checkable
class HashesDemonstrations(Protocol):
    """A log that can tell its demonstrations apart by content, so that one more does not change the others."""

    def demonstration_sha256(self, name: str) -> str: ...


class HashCache:
    """What is remembered, in `<dataset>/.sha256-cache.json`: derived, and safe to delete."""

    def __init__(self, root: Path) -> None:
        self._path = root / ".sha256-cache.json"
        try:
            table = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            table = {}
        self._known: dict[str, Any] = table if isinstance(table, dict) else {}
        self._changed = False

    def of_log(self, log: LogReader, path: Path, demonstrations: list[LogEpisode]) -> dict[str, str]:
        """Demonstration name -> SHA-256, lower-case hex: of the log, where it holds only one; else of its part of the log."""
        names = [demonstration.name for demonstration in demonstrations]
        place, (stats, newest) = str(path.resolve()), _file_stats(path)
        known = self._known.get(place)
        if isinstance(known, dict) and known.get("files") == stats and list(known.get("sha256", ())) == names:
            return dict(known["sha256"])
        hashes = _hash(log, names)
        if time.time() - newest > SETTLED_AFTER_S:
            self._known[place] = {"files": stats, "sha256": hashes}
            self._changed = True
        return hashes

    def remembered(self, path: Path, what: str, find: Callable[[], Any]) -> Any:
        """Plain data about a log that `of_log` was asked for: `find()`, remembered under `what`."""
        known = self._known.get(str(path.resolve()))
        if not isinstance(known, dict) or known.get("files") != _file_stats(path)[0]:
            return find()
        found = known.setdefault("found", {})
        if what not in found:
            found[what] = find()
            self._changed = True
        return found[what]

    def save(self) -> None:
        """Write what was learnt, if anything was."""
        if self._changed:
            shards.write_atomic(self._path, json.dumps(self._known, indent=1).encode())
            self._changed = False


def _hash(log: LogReader, names: list[str]) -> dict[str, str]:
    if isinstance(log, HashesDemonstrations):
        return {name: log.demonstration_sha256(name) for name in names}
    whole = log.sha256()
    return {name: whole if len(names) == 1 else digest({"log": whole, "demonstration": name}) for name in names}


def _file_stats(path: Path) -> tuple[str, float]:
    """Names, sizes, times and inodes of a log's files as one digest; and when the newest of them changed (Unix seconds)."""
    stats = [(name, file.stat()) for name, file in log_files(path).items()]
    rows = [[name, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino] for name, stat in stats]
    return digest(rows), max((stat.st_mtime for _, stat in stats), default=0.0)
