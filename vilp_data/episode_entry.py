"""What is known of an episode without opening its arrays: one flat row, the same in a steps file's header and in index.parquet."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import pyarrow as pa

from vilp_data import keys
from vilp_data.keys import FORMAT_VERSION
from vilp_data.types import ColumnNames, Outcome


@dataclass(frozen=True)
class Origin:
    """Where an episode came from: the log's file name, which demonstration in it, the SHA-256 of the log (of that demonstration's own
    rows or messages where it is one of several), the ingest spec used, and of a cut its range, as `EpisodeEntry.cut`."""

    source: str
    source_sha256: str
    source_episode: str
    key: str
    ingest_fields: Mapping[str, Any]
    cut: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EpisodeEntry:
    """What the index knows of an episode without opening its arrays.

    `n_steps`, `n_valid`, `n_frames`, `key` and `content_sha256` are those of what there is to read: of a trimmed episode, the part
    that was kept. `edits` is empty for an episode as its log gave it; else it says what was changed since, see `edits`. `cut` is empty
    unless the task cut it out of its log: {"start_ns", "end_ns", "topics"}, the messages that `source_sha256` is of; "held", where it was
    made of others too, their SHA-256. `column_names` as in `types.Episode`."""

    id: str
    source: str
    source_sha256: str
    source_episode: str
    key: str
    ingest: Mapping[str, Any]
    n_steps: int
    n_valid: int
    rate_hz: float
    outcome: Outcome
    tags: Mapping[str, str]
    findings: tuple[str, ...]
    frames_sha256: Mapping[str, str]
    n_frames: Mapping[str, int]
    content_sha256: str
    has_action: bool
    has_state: bool
    edits: Mapping[str, Any] = field(default_factory=dict)
    cut: Mapping[str, Any] = field(default_factory=dict)
    column_names: ColumnNames = field(default_factory=dict)

    @property
    def is_trimmed(self) -> bool:
        return "trim" in self.edits

    @property
    def ingest_key(self) -> str:
        """The key that ingest gave it, whatever was trimmed since."""
        return keys.ingest_key(self.key)

    @property
    def ingest_content(self) -> str:
        """The content hash that ingest gave it: a trimmed episode still shows what the whole one does."""
        return str(self.edits.get("ingest_content", self.content_sha256))

    @property
    def first_step(self) -> int:
        """Which of the steps that ingest gave it is its first one now."""
        return int(self.edits.get("trim", {}).get("first_step", 0))

    @property
    def whole_steps(self) -> int:
        """How many steps ingest gave it."""
        return int(self.edits.get("trim", {}).get("of_steps", self.n_steps))

    def first_frame(self, view: str) -> int:
        """Which of the stored frames is the first one that there is to read."""
        return int(self.edits.get("first_frame", {}).get(view, 0))

    def stored_frames(self, view: str) -> int:
        """How many frames the view's file holds, and its latents: more than `n_frames` where the episode was trimmed."""
        return int(self.edits.get("stored_frames", self.n_frames)[view])

    def frames_id(self, view: str) -> str:
        """Names the pixels there are to read: the hash of the stored frames, with the range of a trimmed episode."""
        first, count = self.first_frame(view), self.n_frames[view]
        sha256 = self.frames_sha256[view]
        return sha256 if count == self.stored_frames(view) else f"{sha256}[{first}:{first + count}]"


_JSON_FIELDS = ("ingest", "tags", "findings", "frames_sha256", "n_frames", "edits", "cut", "column_names")
_OFTEN_EMPTY = ("edits", "cut", "column_names")
_TEXT_FIELDS = ("id", "source", "source_sha256", "source_episode", "key", "outcome", "content_sha256")
INDEX_SCHEMA = pa.schema(
    [(name, pa.string()) for name in (*_TEXT_FIELDS, *_JSON_FIELDS)]
    + [("n_steps", pa.int64()), ("n_valid", pa.int64()), ("file_bytes", pa.int64()), ("rate_hz", pa.float64())]
    + [("has_action", pa.bool_()), ("has_state", pa.bool_())]
)


def free_id(name: str, taken: Collection[str], *hashes: str) -> str:
    """`name`, or where that is taken `name` with the first digits of the first hash, else with a whole one."""
    suffixes = ("", f"-{hashes[0][:8]}", *(f"-{sha256}" for sha256 in hashes))
    return next(name + suffix for suffix in suffixes if name + suffix not in taken)


def header_of(entry: EpisodeEntry) -> dict[str, str]:
    """The header of the entry's steps file. What is often empty is left out where it is: edits, the cut, names."""
    row: dict[str, Any] = {"format": FORMAT_VERSION, **entry.__dict__}
    row |= {"has_action": int(entry.has_action), "has_state": int(entry.has_state)}
    return {
        name: json.dumps(value, sort_keys=True) if name in _JSON_FIELDS else str(value)
        for name, value in row.items()
        if value or name not in _OFTEN_EMPTY
    }


def row_of(entry: EpisodeEntry, file_bytes: int) -> dict[str, Any]:
    """The entry's row of index.parquet; `file_bytes` is the size of its steps file."""
    row = {**entry.__dict__, "file_bytes": file_bytes}
    return {name: json.dumps(value, sort_keys=True) if name in _JSON_FIELDS else value for name, value in row.items()}


def entry_of(row: Mapping[str, Any]) -> EpisodeEntry:
    """The entry of a steps file's header, or of a row of index.parquet. Raises KeyError or ValueError for something else."""
    parsed = {name: _parsed(row.get(name) or "{}" if name in _OFTEN_EMPTY else row[name]) for name in _JSON_FIELDS}
    return EpisodeEntry(
        **{name: row[name] for name in _TEXT_FIELDS},
        ingest=parsed["ingest"], tags=parsed["tags"], findings=tuple(parsed["findings"]),
        frames_sha256=parsed["frames_sha256"], n_frames=parsed["n_frames"], edits=parsed["edits"], cut=parsed["cut"],
        column_names=parsed["column_names"],
        n_steps=int(row["n_steps"]), n_valid=int(row["n_valid"]), rate_hz=float(row["rate_hz"]),
        has_action=bool(int(row["has_action"])), has_state=bool(int(row["has_state"])),
    )  # fmt: skip


@lru_cache(maxsize=4096)
def _parsed(text: str) -> Any:
    """JSON, parsed once for all the episodes that share it (every one its ingest spec). Read-only by agreement."""
    return json.loads(text)
