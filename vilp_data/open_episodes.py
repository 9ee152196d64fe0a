"""The episodes that a dataset reads from, mapped when they are first needed and checked against each other.

Opening looks at the index and at one episode's headers. An episode's files are mapped on first use, and pages are read
as they are touched, so memory does not grow with the dataset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data import shards, windows
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.latents import latents_path, open_latents
from vilp_data.types import F16, F32, I64, U8, Bool

# Linux allows a process 65,530 maps (vm.max_map_count); half of them are left to everything else.
MAX_MAPS = 32_768
_ENCODE = "run `vilp-data latents`"


@dataclass(frozen=True, slots=True)
class OpenEpisode:
    """The mapped arrays of one episode, by view where a view has them.

    source_index  view -> int32 [F]: the stored frame that each step sees, which is the row of its latents and of its image
    latents       view -> float16 [n,c,h,w], before quantisation
    frames        view -> uint8 [n,H,W,3]
    low_dim       float32 [F,L]; action float32 [F,A], None where there is none or nobody asked
    """

    source_index: Mapping[str, npt.NDArray[np.int32]]
    latents: Mapping[str, F16]
    frames: Mapping[str, U8]
    low_dim: F32
    action: F32 | None


@dataclass(frozen=True)
class StepShapes:
    """Shapes of one step's values: of views that are read, and of actions where any episode at hand has them."""

    latents: Mapping[str, tuple[int, ...]]
    frames: Mapping[str, tuple[int, ...]]
    low_dim: tuple[int, ...]
    action: tuple[int, ...] | None


class OpenEpisodes:
    """`episodes[number]` is the opened episode of `entries[number]`; its arrays have the shapes of `shapes`.

    Pickling leaves the maps behind: a worker process opens its own.
    """

    def __init__(
        self,
        store: EpisodeStore,
        entries: Sequence[EpisodeEntry],
        *,
        latent_keys: Mapping[str, str],
        frame_views: Iterable[str],
        has_action: Bool,
        labels: LabelledEpisodes | None = None,
    ) -> None:
        """`latent_keys` names the encoder key of each view whose latents are read, `frame_views` the views whose images are,
        and `has_action` [E] says whose actions are. With `labels` steps are opened through them alone, which refuse episodes that are
        not of their action set.

        Raises UsageError for a view that does not exist, and StoreError where latents are missing. Files that do not belong
        together (latents or frames of another ingest, arrays of other lengths) are a StoreError when an episode is first
        needed, by what their headers say; bytes that changed on disk are found by whole reads alone (see `episode_files`).
        """
        self._store, self._entries, self._labels = store, entries, labels
        self._latent_keys, self._frame_views = dict(latent_keys), tuple(frame_views)
        self._has_action = has_action
        for view in (*self._latent_keys, *self._frame_views):
            _require_view(store.root, entries, view)
        _require_latents(store.root, entries, self._latent_keys)
        self.shapes = self._shapes_from_headers() if entries else StepShapes({}, {}, (0,), None)
        self._open = self._opener()

    def __getitem__(self, number: int) -> OpenEpisode:
        return self._open(number)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_open"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open = self._opener()

    def _opener(self) -> Callable[[int], OpenEpisode]:
        maps = 1 + len(self._latent_keys) + len(self._frame_views)
        return lru_cache(maxsize=MAX_MAPS // maps)(self._open_episode)

    def _open_episode(self, number: int) -> OpenEpisode:
        entry, store = self._entries[number], self._store
        views = dict.fromkeys((*self._latent_keys, *self._frame_views))
        steps = self._steps(entry, views)
        opened = OpenEpisode(
            source_index={view: steps[f"source_index/{view}"] for view in views},
            latents={view: open_latents(store.root, entry, view, key) for view, key in self._latent_keys.items()},
            frames={view: open_frames(store, entry, view) for view in self._frame_views},
            low_dim=steps["low_dim"],
            action=steps.get("action") if self._has_action[number] else None,
        )
        self._require_shapes(entry, opened)
        return opened

    def valid_runs(self) -> tuple[I64, I64]:
        """The episode [R] of each run of valid steps int64 [R,2]; only episodes with invalid steps are opened for it."""
        episode, runs = [], []
        for number, entry in enumerate(self._entries):
            found = [(0, entry.n_steps)]
            if entry.n_valid < entry.n_steps:
                found = [(first, end) for first, end in windows.valid_runs(self._steps(entry)["valid"]).tolist()]
            episode += [number] * len(found)
            runs += found
        return np.array(episode, np.int64), np.array(runs, np.int64).reshape(-1, 2)

    def _steps(self, entry: EpisodeEntry, views: Iterable[str] = ()) -> dict[str, npt.NDArray[Any]]:
        """The only way to a steps file from here."""
        return open_steps(self._store, entry, views) if self._labels is None else self._labels.open_steps(entry, views)

    def _shapes_from_headers(self) -> StepShapes:
        """From the first episode (for actions, the first that has them)."""
        first, root = self._entries[0], self._store.root
        latents = {
            view: shards.read_header(latents_path(root, view, key, first.id)).tensors["latents"].shape[1:]
            for view, key in self._latent_keys.items()
        }
        frames = {
            view: shards.read_header(self._store.frames_path(view, first.id)).tensors["frames"].shape[1:]
            for view in self._frame_views
        }
        low_dim = shards.read_header(self._store.steps_path(first.id)).tensors["low_dim"].shape[1:]
        action = None
        if self._has_action.any():
            acting = self._entries[int(self._has_action.argmax())]
            action = shards.read_header(self._store.steps_path(acting.id)).tensors["action"].shape[1:]
        return StepShapes(latents, frames, low_dim, action)

    def _require_shapes(self, entry: EpisodeEntry, opened: OpenEpisode) -> None:
        shapes = StepShapes(
            {view: array.shape[1:] for view, array in opened.latents.items()},
            {view: array.shape[1:] for view, array in opened.frames.items()},
            opened.low_dim.shape[1:],
            self.shapes.action if opened.action is None else opened.action.shape[1:],
        )
        if shapes != self.shapes:
            raise StoreError(
                "an episode of other shapes than the rest of its dataset",
                where=entry.id,
                found=f"{shapes} instead of {self.shapes}",
                remedy="ingest every log with one task file, then run `vilp-data latents`",
            )


def _require_view(root: Path, entries: Sequence[EpisodeEntry], view: str) -> None:
    if entries and view not in entries[0].frames_sha256:
        raise UsageError(f"no view called {view!r}", where=root, remedy=nearest(view, entries[0].frames_sha256))


def _require_latents(root: Path, entries: Sequence[EpisodeEntry], latent_keys: Mapping[str, str]) -> None:
    """One listing a view; whether a shard fits its episode's frames is seen when it is opened."""
    for view, key in latent_keys.items():
        folder = root / "latents" / view / key
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        missing = [entry.id for entry in entries if f"{entry.id}.safetensors" not in there]
        if missing:
            found = f"{len(missing)} of {len(entries)} episodes are not encoded, such as {missing[0]}"
            raise StoreError("latents are missing", where=folder, found=found, remedy=_ENCODE)
