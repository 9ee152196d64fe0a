"""The episode store: one steps file and one frames file a view for each episode, each immutable; the steps file is the commit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vilp_data import shards
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.keys import FORMAT_VERSION, content_digest
from vilp_data.spec import TaskSpec, task_from_dict
from vilp_data.types import U8, Episode, Outcome


@dataclass(frozen=True)
class Origin:
    """Where an episode came from: the log's file name, which demonstration in it, the SHA-256 of the log (of that demonstration's own
    rows where the log can tell them apart), and the ingest spec used."""

    source: str
    source_sha256: str
    source_episode: str
    key: str
    ingest_fields: Mapping[str, Any]


@dataclass(frozen=True)
class EpisodeEntry:
    """What the index knows of an episode without opening its arrays."""

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


class EpisodeStore:
    """The episodes of one dataset folder. Reading needs no lock; writing belongs inside `shards.writer_lock(root)`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    # --- where things are

    @property
    def index_path(self) -> Path:
        return self.root / "episodes" / "index.parquet"

    def steps_path(self, episode_id: str) -> Path:
        return self.root / "episodes" / "steps" / f"{episode_id}.safetensors"

    def frames_path(self, view: str, episode_id: str) -> Path:
        return self.root / "episodes" / "frames" / view / f"{episode_id}.safetensors"

    # --- the dataset's spec

    def spec(self) -> TaskSpec:
        """The resolved spec this dataset was ingested with. Raises UsageError where `root` is no dataset."""
        path = self.root / "dataset.json"
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise UsageError(
                "not a dataset: it has no dataset.json",
                where=self.root,
                remedy="make one with `vilp-data ingest LOGS… --task NAME`",
            ) from error
        except ValueError as error:
            raise StoreError(
                "damaged", where=path, found=str(error), remedy="run `vilp-data ingest` again: it writes this file anew"
            ) from error
        if table.get("format") != FORMAT_VERSION:
            raise StoreError(
                "written by another version",
                where=path,
                found=f"format {table.get('format')}, this is {FORMAT_VERSION}",
                remedy="ingest the logs again into a new folder",
            )
        return task_from_dict(table["spec"], where=str(path))

    def task_name(self) -> str | None:
        """The name of the task this dataset was ingested for; None where dataset.json is missing or damaged, as after a crash."""
        try:
            table = json.loads((self.root / "dataset.json").read_text(encoding="utf-8"))
            return str(table["spec"]["name"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None

    def write_spec(self, spec: TaskSpec) -> None:
        table = {"format": FORMAT_VERSION, "spec": spec.model_dump(mode="json", by_alias=True)}
        data = (
            json.dumps(table, indent=2) + "\n"
        ).encode()  # never sorted: the order of action and low_dim parts is the order of columns
        path = self.root / "dataset.json"
        if not path.is_file() or path.read_bytes() != data:
            shards.write_atomic(path, data)

    # --- writing

    def write(self, episode: Episode, origin: Origin) -> None:
        """Write an episode's frames, then its steps. A crash in between leaves no episode, only frames that the next run replaces."""
        frames_sha256 = {view: content_digest(frames) for view, frames in episode.frames.items()}
        steps = self.steps_path(episode.id)
        if steps.is_file():
            steps.unlink()  # the commit goes first, and comes back last
            shards.sync_folder(steps.parent)
        for view, frames in episode.frames.items():
            header = {"format": str(FORMAT_VERSION), "key": origin.key, "frames_sha256": frames_sha256[view]}
            shards.write_shard(self.frames_path(view, episode.id), {"frames": frames}, header)
        tensors: dict[str, Any] = {
            "log_time_ns": episode.log_time_ns,
            "low_dim": episode.low_dim,
            "valid": episode.valid,
        }
        tensors |= {f"source_index/{view}": index for view, index in episode.source_index.items()}
        tensors |= {f"age_s/{topic}": age for topic, age in episode.age_s.items()}
        tensors |= {"action": episode.action} if episode.action is not None else {}
        tensors |= {"state": episode.state} if episode.state is not None else {}
        shards.write_shard(steps, tensors, _steps_header(episode, origin, frames_sha256))

    def remove_index(self) -> None:
        """Before episodes change: an index that is not there is rebuilt, one that is wrong is believed."""
        self.index_path.unlink(missing_ok=True)

    def write_index(self) -> None:
        """Write episodes/index.parquet from the headers; nothing where there is no episode."""
        if not self._steps_files():
            return
        rows = [_to_row(entry, self.steps_path(entry.id).stat().st_size) for entry in self._entries_from_headers()]
        with shards.atomic_file(self.index_path) as file:
            pq.write_table(pa.Table.from_pylist(rows, schema=_INDEX_SCHEMA), file)

    # --- reading

    def index(self) -> list[EpisodeEntry]:
        """Every committed episode, sorted by id. Read from index.parquet where that fits the folder, else from the headers."""
        sizes = {path.name.removesuffix(".safetensors"): path.stat().st_size for path in self._steps_files()}
        if self.index_path.is_file():
            try:
                rows = pq.read_table(self.index_path, use_threads=False).to_pylist()
            except (pa.ArrowException, OSError):
                rows = []  # derived and damaged: the headers know better
            if {row["id"]: row["file_bytes"] for row in rows} == sizes:
                return [_from_row(row) for row in rows]
        return self._entries_from_headers()

    def entry(self, episode_id: str) -> EpisodeEntry:
        """The entry of one episode. Raises UsageError naming the nearest id."""
        entries = {entry.id: entry for entry in self.index()}
        if episode_id not in entries:
            raise UsageError(f"no episode called {episode_id!r}", where=self.root, remedy=nearest(episode_id, entries))
        return entries[episode_id]

    def read(self, episode_id: str) -> Episode:
        """One whole episode in memory, checksums verified. Raises UsageError for an unknown id, StoreError for damage."""
        entry = self.entry(episode_id)
        steps = shards.read_shard(self.steps_path(episode_id)).arrays
        return Episode(
            id=entry.id,
            frames={view: self.read_frames(view, entry) for view in entry.frames_sha256},
            source_index={view: steps[f"source_index/{view}"] for view in entry.frames_sha256},
            log_time_ns=steps["log_time_ns"],
            low_dim=steps["low_dim"],
            action=steps.get("action"),
            state=steps.get("state"),
            valid=steps["valid"],
            age_s={name.removeprefix("age_s/"): array for name, array in steps.items() if name.startswith("age_s/")},
            rate_hz=entry.rate_hz,
            tags=entry.tags,
            outcome=entry.outcome,
            findings=entry.findings,
        )

    def read_frames(self, view: str, entry: EpisodeEntry) -> U8:
        """uint8 [n,H,W,3] of one view, checked to be the frames that the episode was committed with."""
        shard = shards.read_shard(self.frames_path(view, entry.id))
        if shard.metadata["frames_sha256"] != entry.frames_sha256[view]:
            raise StoreError(
                "not the frames this episode was committed with",
                where=self.frames_path(view, entry.id),
                remedy="run `vilp-data ingest` on its log again",
            )
        return cast(U8, shard.arrays["frames"])

    def frames_fit(self, entry: EpisodeEntry) -> bool:
        """Whether every view's frames file is there, whole by its size, and the one that the episode was committed with. Reads
        headers only: a flipped pixel shows in `read_frames`."""
        try:
            headers = {view: shards.read_header(self.frames_path(view, entry.id)) for view in entry.frames_sha256}
        except StoreError:
            return False
        return all(header.metadata.get("frames_sha256") == entry.frames_sha256[v] for v, header in headers.items())

    def _steps_files(self) -> list[Path]:
        return sorted((self.root / "episodes" / "steps").glob("[!.]*.safetensors"))

    def entry_from_header(self, path: Path) -> EpisodeEntry:
        """The entry that a steps file's own header gives. Raises StoreError for damage or another format version."""
        metadata = shards.read_header(path).metadata
        if metadata.get("format") != str(FORMAT_VERSION):
            found = f"format {metadata.get('format')}, this is {FORMAT_VERSION}"
            raise StoreError(
                "written by another version", where=path, found=found, remedy="ingest the logs again into a new folder"
            )
        return _from_row(metadata)

    def _entries_from_headers(self) -> list[EpisodeEntry]:
        return sorted((self.entry_from_header(path) for path in self._steps_files()), key=lambda entry: entry.id)


# One flat row of strings and numbers per episode, the same in a steps file's header and in index.parquet.
_JSON_FIELDS = ("ingest", "tags", "findings", "frames_sha256", "n_frames")
_INDEX_SCHEMA = pa.schema(
    [
        (name, pa.string())
        for name in (
            "id",
            "source",
            "source_sha256",
            "source_episode",
            "key",
            "outcome",
            "content_sha256",
            *_JSON_FIELDS,
        )
    ]
    + [("n_steps", pa.int64()), ("n_valid", pa.int64()), ("file_bytes", pa.int64()), ("rate_hz", pa.float64())]
    + [("has_action", pa.bool_()), ("has_state", pa.bool_())]
)


def _steps_header(episode: Episode, origin: Origin, frames_sha256: Mapping[str, str]) -> dict[str, str]:
    arrays = [episode.low_dim, episode.valid, *(episode.source_index[view] for view in sorted(episode.source_index))]
    arrays += [episode.action] if episode.action is not None else []
    row: dict[str, Any] = {
        "format": FORMAT_VERSION, "id": episode.id, "source": origin.source, "source_sha256": origin.source_sha256,
        "source_episode": origin.source_episode, "key": origin.key, "ingest": dict(origin.ingest_fields),
        "n_steps": episode.n_steps, "n_valid": int(np.count_nonzero(episode.valid)), "rate_hz": episode.rate_hz,
        "outcome": episode.outcome, "tags": dict(episode.tags), "findings": list(episode.findings),
        "frames_sha256": dict(frames_sha256), "n_frames": {view: len(frames) for view, frames in episode.frames.items()},
        "content_sha256": content_digest(*arrays) + "".join(frames_sha256[view] for view in sorted(frames_sha256)),
        "has_action": int(episode.action is not None), "has_state": int(episode.state is not None),
    }  # fmt: skip
    row["content_sha256"] = content_digest(np.frombuffer(row["content_sha256"].encode(), np.uint8))
    return {key: json.dumps(value, sort_keys=True) if key in _JSON_FIELDS else str(value) for key, value in row.items()}


def _to_row(entry: EpisodeEntry, file_bytes: int) -> dict[str, Any]:
    row = {**entry.__dict__, "file_bytes": file_bytes}
    return {key: json.dumps(value, sort_keys=True) if key in _JSON_FIELDS else value for key, value in row.items()}


@lru_cache(maxsize=4096)
def _parsed(text: str) -> Any:
    """JSON, parsed once for all the episodes that share it (every one its ingest spec). Read-only by agreement."""
    return json.loads(text)


def _from_row(row: Mapping[str, Any]) -> EpisodeEntry:
    parsed = {key: _parsed(row[key]) for key in _JSON_FIELDS}
    return EpisodeEntry(
        **{key: row[key] for key in ("id", "source", "source_sha256", "source_episode", "key", "outcome", "content_sha256")},
        ingest=parsed["ingest"], tags=parsed["tags"], findings=tuple(parsed["findings"]),
        frames_sha256=parsed["frames_sha256"], n_frames=parsed["n_frames"],
        n_steps=int(row["n_steps"]), n_valid=int(row["n_valid"]), rate_hz=float(row["rate_hz"]),
        has_action=bool(int(row["has_action"])), has_state=bool(int(row["has_state"])),
    )  # fmt: skip
