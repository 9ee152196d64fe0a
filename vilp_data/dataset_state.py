"""What a dataset is at one moment, in few words: which files, their checksums, and of each episode what people ask about.

Checksums come from the files' own headers, so a state costs the reading of headers alone. Latents, runs and logs are no part of it:
they are derived, or nobody's to change.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vilp_data import shards
from vilp_data.episode_entry import EpisodeEntry, entry_of
from vilp_data.errors import SplitError, StoreError
from vilp_data.keys import digest
from vilp_data.split_lock import SplitLock

FILES = ("dataset.json", "split.lock.json", "removed.json")
"""The files beside the episodes that make up a dataset."""

_STEPS, _FRAMES = "episodes/steps", "episodes/frames"
_SUFFIX = ".safetensors"

Overlay = Mapping[str, Path | None]
"""Name below the dataset -> the file that is to be there instead, None for no file: a state that is still to come."""


@dataclass(frozen=True)
class EpisodeState:
    """One episode: checksums of its steps file and of each view's frames file ("" where one is missing or damaged), the hash of its
    content, and what it is called and counted by. `side` is None where the split gives it none."""

    steps: str
    frames: Mapping[str, str]
    content: str
    source: str
    n_steps: int
    outcome: str
    tags: Mapping[str, str]
    side: str | None = None


@dataclass(frozen=True)
class DatasetState:
    """Episodes by id, and the SHA-256 of each of FILES that is there."""

    episodes: Mapping[str, EpisodeState] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """SHA-256 of the whole: two states with equal digests are the same bytes."""
        return digest(asdict(self))

    @property
    def n_steps(self) -> int:
        return sum(episode.n_steps for episode in self.episodes.values())

    def checksums(self) -> dict[str, str]:
        """Every file of the state by its name below the dataset."""
        named = dict(self.files)
        for id, episode in self.episodes.items():
            named[steps_name(id)] = episode.steps
            named |= {frames_name(view, id): checksum for view, checksum in episode.frames.items()}
        return named

    def to_json(self) -> dict[str, Any]:
        """Plain data; `from_json` reads it back."""
        return asdict(self)

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> DatasetState:
        """Raises KeyError or TypeError where `table` is no state."""
        episodes = {id: EpisodeState(**episode) for id, episode in table["episodes"].items()}
        return cls(episodes, dict(table["files"]))


def steps_name(episode_id: str) -> str:
    return f"{_STEPS}/{episode_id}{_SUFFIX}"


def frames_name(view: str, episode_id: str) -> str:
    return f"{_FRAMES}/{view}/{episode_id}{_SUFFIX}"


def read_state(root: Path, overlay: Overlay | None = None) -> DatasetState:
    """The dataset at `root` as it is, or as it will be with `overlay`. Raises StoreError where a steps file is damaged."""
    overlay = overlay or {}

    def place(name: str) -> Path | None:
        return overlay.get(name, root / name)

    files = {name: checksum for name in FILES if (checksum := _sha256(place(name)))}
    sides = _sides(place("split.lock.json"))
    steps = {path.name.removesuffix(_SUFFIX) for path in (root / _STEPS).glob(f"[!.]*{_SUFFIX}")}
    steps |= {Path(name).name.removesuffix(_SUFFIX) for name in overlay if name.startswith(f"{_STEPS}/")}
    episodes = {}
    for id in sorted(steps):
        path = place(steps_name(id))
        if path is not None:
            header = shards.read_header(path)
            entry = entry_of(header.metadata)
            frames = {view: file_checksum(place(frames_name(view, id))) for view in sorted(entry.frames_sha256)}
            episodes[id] = _episode_state(entry, header.metadata.get("sha256", ""), frames, sides.get(id))
    return DatasetState(episodes, files)


def file_checksum(path: Path | None) -> str:
    """The checksum that a file of a state has: of a shard the one in its header, of another file that of its bytes; "" for none."""
    if path is None or not path.name.endswith(_SUFFIX):
        return _sha256(path)
    with contextlib.suppress(StoreError):
        return shards.read_header(path).metadata.get("sha256", "")
    return ""


def _episode_state(entry: EpisodeEntry, steps: str, frames: Mapping[str, str], side: str | None) -> EpisodeState:
    return EpisodeState(
        steps=steps, frames=frames, content=entry.content_sha256, source=entry.source, n_steps=entry.n_steps,
        outcome=entry.outcome, tags=dict(entry.tags), side=side,
    )  # fmt: skip


def _sides(path: Path | None) -> dict[str, str]:
    if path is None or not path.is_file():
        return {}
    try:
        return dict(SplitLock.from_json(path.read_bytes(), where=path).assignment)
    except SplitError:  # damaged: the split's own verbs say so
        return {}


def _sha256(path: Path | None) -> str:
    if path is None or not path.is_file():
        return ""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def state_text(state: DatasetState) -> str:
    """A few words: `12 episodes, 1840 steps`."""
    many = "1 episode" if len(state.episodes) == 1 else f"{len(state.episodes)} episodes"
    return f"{many}, {state.n_steps} steps"


def dumps(table: Mapping[str, Any]) -> bytes:
    """JSON as the history's files have it."""
    return (json.dumps(table, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()
