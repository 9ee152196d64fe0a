"""The episode store: one steps file and one frames file a view for each episode, each immutable; the steps file is the commit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from vilp_data import journal, shards
from vilp_data.edits import Arrays, Edits, content_hash, edited
from vilp_data.episode_entry import INDEX_SCHEMA, EpisodeEntry, Origin, entry_of, header_of, row_of
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.keys import FORMAT_VERSION, content_digest
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import task_from_dict
from vilp_data.types import U8, Episode
from vilp_data.writer_lock import await_settled

__all__ = ["EpisodeEntry", "EpisodeStore", "Origin"]


class EpisodeStore:
    """The episodes of one dataset folder. Reading needs no lock; writing belongs inside `writer_lock(root)`."""

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
            if not isinstance(table, dict):
                raise TypeError("JSON, but no table")
        except FileNotFoundError as error:
            raise UsageError(
                "not a dataset: it has no dataset.json",
                where=self.root,
                remedy="make one with `vilp-data ingest LOGS… --task NAME`",
            ) from error
        except (ValueError, TypeError) as error:
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
        return task_from_dict(table.get("spec", {}), where=str(path))

    def task_name(self) -> str | None:
        """The name of the task this dataset was ingested for; None where dataset.json is missing or damaged, as after a crash."""
        try:
            table = json.loads((self.root / "dataset.json").read_text(encoding="utf-8"))
            return str(table["spec"]["name"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None

    def write_spec(self, spec: TaskSpec) -> None:
        if not self.has_spec(spec):
            shards.write_atomic(self.root / "dataset.json", _spec_bytes(spec))

    def has_spec(self, spec: TaskSpec) -> bool:
        """Whether dataset.json says just this."""
        path = self.root / "dataset.json"
        return path.is_file() and path.read_bytes() == _spec_bytes(spec)

    # --- writing

    def write(self, episode: Episode, origin: Origin, *, edits: Edits | None = None, hold: Path | None = None) -> None:
        """Write an episode. See `commit`."""
        entry, steps = describe(episode, origin)
        self.commit(entry, steps, episode.frames, edits=edits, hold=hold)

    def commit(
        self, entry: EpisodeEntry, steps: Arrays, frames: Mapping[str, U8], *, edits: Edits | None = None, hold: Path | None = None
    ) -> None:  # fmt: skip
        """Write an episode's frames, then its steps. A crash in between leaves no episode, only frames that the next run replaces.

        `edits` are what people decided about an earlier ingest of the same log: they are done to this one too. `hold` is the folder
        in which files that are replaced stay for an undo. Raises UsageError where a trim leaves too little, before anything is written."""
        key = entry.key
        if edits is not None:
            entry, steps = edited(entry, steps, edits)
        path = self.steps_path(entry.id)
        for replaced in (path, *(self.frames_path(view, entry.id) for view in frames)):
            if hold is not None and replaced.is_file():
                journal.keep_link(replaced, hold / replaced.relative_to(self.root))
        if path.is_file():
            path.unlink()  # the commit goes first, and comes back last
            shards.sync_folder(path.parent)
        for view, images in frames.items():
            header = {"format": str(FORMAT_VERSION), "key": key, "frames_sha256": entry.frames_sha256[view]}
            shards.write_shard(self.frames_path(view, entry.id), {"frames": images}, header)
        write_steps(path, entry, steps)

    def rewrite_entry(self, entry: EpisodeEntry, *, hold: Path | None = None) -> None:
        """Write an episode's steps file anew under another entry, its arrays as they are. `hold` as in `commit`."""
        path = self.steps_path(entry.id)
        steps = shards.read_shard(path).arrays
        if hold is not None:
            journal.keep_link(path, hold / path.relative_to(self.root))
        write_steps(path, entry, steps)

    def remove_index(self) -> None:
        """Before episodes change: an index that is not there is rebuilt, one that is wrong is believed."""
        self.index_path.unlink(missing_ok=True)

    def write_index(self) -> None:
        """Write episodes/index.parquet from the headers; nothing where there is no episode."""
        if not self._steps_files():
            return
        rows = [row_of(entry, self.steps_path(entry.id).stat().st_size) for entry in self._entries_from_headers()]
        with shards.atomic_file(self.index_path) as file:
            pq.write_table(pa.Table.from_pylist(rows, schema=INDEX_SCHEMA), file)

    def ensure_index(self) -> bool:
        """Write the index where a writer that was stopped could not any more; whether there was none."""
        if self.index_path.is_file() or not self._steps_files():
            return False
        self.write_index()
        return True

    # --- reading

    def index(self) -> list[EpisodeEntry]:
        """Every committed episode, sorted by id. Read from index.parquet where that fits the folder, else from the headers."""
        await_settled(self.root)
        sizes = {path.name.removesuffix(".safetensors"): path.stat().st_size for path in self._steps_files()}
        if self.index_path.is_file():
            try:
                rows = pq.read_table(self.index_path, use_threads=False).to_pylist()
            except (pa.ArrowException, OSError):
                rows = []  # derived and damaged: the headers know better
            if {row["id"]: row["file_bytes"] for row in rows} == sizes:
                return [entry_of(row) for row in rows]
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
            column_names=entry.column_names,
        )

    def read_frames(self, view: str, entry: EpisodeEntry) -> U8:
        """uint8 [n,H,W,3] of one view, checked to be the frames that the episode was committed with; of a trimmed episode those that
        are left."""
        first = entry.first_frame(view)
        return self.read_stored_frames(view, entry)[first : first + entry.n_frames[view]]

    def read_stored_frames(self, view: str, entry: EpisodeEntry) -> U8:
        """As `read_frames`, with the frames that were trimmed off: row i of a latent shard belongs to frame i of these."""
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
        return entry_of(metadata)

    def _entries_from_headers(self) -> list[EpisodeEntry]:
        return sorted((self.entry_from_header(path) for path in self._steps_files()), key=lambda entry: entry.id)


def _spec_bytes(spec: TaskSpec) -> bytes:
    table = {"format": FORMAT_VERSION, "spec": spec.model_dump(mode="json", by_alias=True)}
    # Never sorted: the order of action and low_dim parts is the order of columns.
    return (json.dumps(table, indent=2) + "\n").encode()


def write_steps(path: Path, entry: EpisodeEntry, steps: Arrays) -> None:
    """Write an episode's steps file: its arrays by name, under the entry as header."""
    shards.write_shard(path, steps, header_of(entry))


def describe(episode: Episode, origin: Origin) -> tuple[EpisodeEntry, dict[str, npt.NDArray[Any]]]:
    """The entry and the arrays of an episode as its log gives it. Hashes every frame."""
    frames_sha256 = {view: content_digest(frames) for view, frames in episode.frames.items()}
    steps: dict[str, npt.NDArray[Any]] = {
        "log_time_ns": episode.log_time_ns,
        "low_dim": episode.low_dim,
        "valid": episode.valid,
    }
    steps |= {f"source_index/{view}": index for view, index in episode.source_index.items()}
    steps |= {f"age_s/{topic}": age for topic, age in episode.age_s.items()}
    steps |= {"action": episode.action} if episode.action is not None else {}
    steps |= {"state": episode.state} if episode.state is not None else {}
    entry = EpisodeEntry(
        id=episode.id, source=origin.source, source_sha256=origin.source_sha256, source_episode=origin.source_episode,
        key=origin.key, ingest=dict(origin.ingest_fields), n_steps=episode.n_steps,
        n_valid=int(np.count_nonzero(episode.valid)), rate_hz=episode.rate_hz, outcome=episode.outcome,
        tags=dict(episode.tags), findings=tuple(episode.findings), frames_sha256=frames_sha256,
        n_frames={view: len(frames) for view, frames in episode.frames.items()}, content_sha256="",
        has_action=episode.action is not None, has_state=episode.state is not None, cut=dict(origin.cut),
        column_names=dict(episode.column_names),
    )  # fmt: skip
    return replace(entry, content_sha256=content_hash(entry, steps)), steps
