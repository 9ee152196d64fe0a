"""Windows over a dataset folder as a torch Dataset: mapped files in, uint8 and float16 batches out.

Opening reads the index alone. An episode's files are mapped when a window first needs them, and pages are read as they
are touched, so memory does not grow with the dataset; values are handed out as stored, and models normalise inside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset

from vilp_data import shards, windows
from vilp_data.dataset_split import side_episodes
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.latents import latents_path, open_latents
from vilp_data.spec import WindowSpec
from vilp_data.types import I64

# Linux allows a process 65,530 maps (vm.max_map_count); half of them are left to everything else.
MAX_MAPS = 32_768
_ENCODE = "run `vilp-data latents`"
_ALIGNMENT = 64

_Layout = dict[str, tuple[tuple[int, ...], torch.dtype]]


@dataclass(frozen=True)
class WindowTensors:
    """B windows as torch tensors, as stored.

    frames        view -> uint8 [B,H,W,3]: the observation's image at the window's first step t; empty without frames
    latents       view -> float16 [B,N,c,h,w]: planned frames t+Δt … t+NΔt, before quantisation
    latent_mask   bool [B,N]: False where the planned frame lies past the end and repeats the last one
    low_dim       float32 [B,L] at t
    action        float32 [B,NΔt,A] at t … t+NΔt-1, zero where masked; None when no episode at hand has actions
    action_mask   bool [B,NΔt]: False past the end, and for episodes without actions
    episode       int64 [B], index into the dataset's `episode_ids`; step int64 [B]: where each window begins
    """

    frames: dict[str, torch.Tensor]
    latents: dict[str, torch.Tensor]
    latent_mask: torch.Tensor
    low_dim: torch.Tensor
    action: torch.Tensor | None
    action_mask: torch.Tensor
    episode: torch.Tensor
    step: torch.Tensor

    def __len__(self) -> int:
        return len(self.step)

    def to(self, device: torch.device | str) -> Self:
        """The same windows on another device; copies from pinned memory do not block."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=True))

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Self:
        """The same windows with `function` applied to every tensor."""
        moved: dict[str, Any] = {}
        for name in (item.name for item in fields(self)):
            value = getattr(self, name)
            if isinstance(value, dict):
                moved[name] = {view: function(tensor) for view, tensor in value.items()}
            else:
                moved[name] = None if value is None else function(value)
        return type(self)(**moved)


@dataclass(frozen=True, slots=True)
class _View:
    """One view of an open episode: which stored frame each step sees, then the stored frames' latents and images."""

    source_index: npt.NDArray[np.int32]
    latents: npt.NDArray[np.float16]
    frames: npt.NDArray[np.uint8] | None


@dataclass(frozen=True, slots=True)
class _Open:
    """The mapped arrays of one episode, views in the dataset's order."""

    views: tuple[_View, ...]
    low_dim: npt.NDArray[np.float32]
    action: npt.NDArray[np.float32] | None


@dataclass(frozen=True)
class _Shapes:
    """Shapes of one window's values, without the axes of the batch, of planned frames and of actions."""

    latents: dict[str, tuple[int, ...]]
    frames: dict[str, tuple[int, ...]]
    low_dim: tuple[int, ...]
    action: tuple[int, ...] | None


class WindowDataset(Dataset[WindowTensors]):
    """Planner windows of the episodes on one side of the split, numbered by episode and step.

    `dataset[i]` is a batch of one, `dataset.read([i, j, …])` a batch in that order. `loader.Loader` calls the latter; a
    torch DataLoader finds it as `__getitems__` and needs `collate_fn=lambda batch: batch`.
    """

    def __init__(
        self,
        root: Path | str,
        *,
        split: Literal["train", "val", "all"],
        latent_keys: Mapping[str, str],
        window: WindowSpec,
        with_frames: bool = True,
        with_actions: bool = True,
    ) -> None:
        """Open the dataset at `root`. `latent_keys` names the encoder key of each view to read.

        Raises SplitError without a split that covers the episodes, UsageError for a view that does not exist, and
        StoreError where latents are missing or no window fits. Files that do not belong together (latents or frames of
        another ingest, arrays of other lengths) are a StoreError when a window first needs them, by what their headers
        say; bytes that changed on disk are found by whole reads alone (see `episode_files`).
        """
        self._store = EpisodeStore(Path(root))
        self._window = window
        self._latent_keys = dict(latent_keys)
        self._with_frames = with_frames
        self._entries = self._store.index() if split == "all" else side_episodes(self._store, split)
        _require_latents(self._store.root, self._entries, self._latent_keys)
        self._n_steps = np.array([entry.n_steps for entry in self._entries], np.int64)
        self._has_action = np.array([entry.has_action and with_actions for entry in self._entries], np.bool_)
        episode, runs = _valid_runs(self._store, self._entries)
        starts = windows.plan_windows(
            runs,
            self._n_steps[episode],
            n_plan_frames=window.n_plan_frames,
            frame_stride=window.frame_stride,
            max_goal_frames=window.max_goal_frames,
        )
        self._index = windows.WindowIndex.of(episode, starts)
        if not len(self._index):
            raise StoreError(
                "no window fits any episode",
                where=self._store.root,
                found=f"{len(self._entries)} episodes of at most {self._n_steps.max(initial=0)} steps",
                remedy="lower n_plan_frames or frame_stride, or raise max_goal_frames, in the task's [window]",
            )
        self._shapes = self._shapes_from_headers()
        self._open = self._opener()

    @property
    def episode_ids(self) -> list[str]:
        """What `WindowTensors.episode` counts through."""
        return [entry.id for entry in self._entries]

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, number: int) -> WindowTensors:
        return self.read([number])

    def __getitems__(self, numbers: Sequence[int]) -> WindowTensors:
        return self.read(numbers)

    def read(self, numbers: Sequence[int] | I64, *, pin_memory: bool = False) -> WindowTensors:
        """Windows `numbers`, in that order, in memory of their own; `pin_memory` makes it page-locked.

        Raises IndexError outside 0 … len - 1, and StoreError for files that are missing, cut off, stale or foreign."""
        episode, step = self._index.locate(np.asarray(numbers, np.int64))
        n_plan_frames, frame_stride = self._window.n_plan_frames, self._window.frame_stride
        n_steps = self._n_steps[episode]
        planned, latent_mask = windows.plan_steps(step, n_steps, n_plan_frames=n_plan_frames, frame_stride=frame_stride)
        acted, action_mask = windows.action_steps(step, n_steps, n_plan_frames=n_plan_frames, frame_stride=frame_stride)
        action_mask &= self._has_action[episode, None]

        batch = self._empty_batch(len(step), pin_memory=pin_memory)
        for tensor, values in (
            (batch.latent_mask, latent_mask),
            (batch.action_mask, action_mask),
            (batch.episode, episode),
            (batch.step, step),
        ):
            tensor.numpy()[:] = values
        self._copy_windows(batch, planned, acted)
        return batch

    def _copy_windows(self, batch: WindowTensors, planned: I64, acted: I64) -> None:
        """Fill what comes from files: the batch's episodes and steps say where, `planned` and `acted` which steps."""
        latents = [tensor.numpy() for tensor in batch.latents.values()]
        frames = [tensor.numpy() for tensor in batch.frames.values()]
        low_dim = batch.low_dim.numpy()
        action = None if batch.action is None else batch.action.numpy()
        for row, (number, first) in enumerate(zip(batch.episode.tolist(), batch.step.tolist(), strict=True)):
            arrays = self._open(number)
            low_dim[row] = arrays.low_dim[first]
            # mode="clip" lets take() write in place. It hides no error: opening the episode checked that the steps cover it and
            # that valid steps point at stored frames, and windows hold valid steps alone.
            if action is not None and arrays.action is not None:
                arrays.action.take(acted[row], axis=0, out=action[row], mode="clip")
            for place, view in enumerate(arrays.views):
                view.latents.take(view.source_index[planned[row]], axis=0, out=latents[place][row], mode="clip")
                if view.frames is not None:
                    frames[place][row] = view.frames[view.source_index[first]]
        if action is not None:
            action[~batch.action_mask.numpy()] = 0

    def __getstate__(self) -> dict[str, Any]:
        """Maps stay behind: a worker process opens its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_open"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open = self._opener()

    # --- opening

    def _opener(self) -> Callable[[int], _Open]:
        maps = 1 + len(self._latent_keys) * (1 + self._with_frames)
        return lru_cache(maxsize=MAX_MAPS // maps)(self._open_episode)

    def _open_episode(self, number: int) -> _Open:
        entry = self._entries[number]
        steps = open_steps(self._store, entry, self._latent_keys)
        action = steps.get("action") if self._has_action[number] else None
        views = tuple(self._open_view(entry, view, steps) for view in self._latent_keys)
        opened = _Open(views, steps["low_dim"], action)
        self._require_shapes(entry, opened)
        return opened

    def _open_view(self, entry: EpisodeEntry, view: str, steps: Mapping[str, npt.NDArray[Any]]) -> _View:
        latents = open_latents(self._store.root, entry, view, self._latent_keys[view])
        frames = open_frames(self._store, entry, view) if self._with_frames else None
        return _View(steps[f"source_index/{view}"], latents, frames)

    # --- shapes

    def _shapes_from_headers(self) -> _Shapes:
        """Shapes of one window's arrays, from the first episode (for actions, the first that has them)."""
        first, root = self._entries[0], self._store.root
        latents = {
            view: shards.read_header(latents_path(root, view, key, first.id)).tensors["latents"].shape[1:]
            for view, key in self._latent_keys.items()
        }
        frames = {
            view: shards.read_header(self._store.frames_path(view, first.id)).tensors["frames"].shape[1:]
            for view in (self._latent_keys if self._with_frames else ())
        }
        low_dim = shards.read_header(self._store.steps_path(first.id)).tensors["low_dim"].shape[1:]
        action = None
        if self._has_action.any():
            acting = self._entries[int(self._has_action.argmax())]
            action = shards.read_header(self._store.steps_path(acting.id)).tensors["action"].shape[1:]
        return _Shapes(latents, frames, low_dim, action)

    def _require_shapes(self, entry: EpisodeEntry, opened: _Open) -> None:
        views = dict(zip(self._latent_keys, opened.views, strict=True))
        shapes = _Shapes(
            {view: arrays.latents.shape[1:] for view, arrays in views.items()},
            {view: arrays.frames.shape[1:] for view, arrays in views.items() if arrays.frames is not None},
            opened.low_dim.shape[1:],
            self._shapes.action if opened.action is None else opened.action.shape[1:],
        )
        if shapes != self._shapes:
            raise StoreError(
                "an episode of other shapes than the rest of its dataset",
                where=entry.id,
                found=f"{shapes} instead of {self._shapes}",
                remedy="ingest every log with one task file, then run `vilp-data latents`",
            )

    def _empty_batch(self, size: int, *, pin_memory: bool) -> WindowTensors:
        n_plan_frames, shapes = self._window.n_plan_frames, self._shapes
        n_actions = n_plan_frames * self._window.frame_stride
        layout: _Layout = {
            "latent_mask": ((size, n_plan_frames), torch.bool),
            "low_dim": ((size, *shapes.low_dim), torch.float32),
            "action_mask": ((size, n_actions), torch.bool),
            "episode": ((size,), torch.int64),
            "step": ((size,), torch.int64),
        }
        if shapes.action is not None:
            layout["action"] = ((size, n_actions, *shapes.action), torch.float32)
        layout |= {f"frames/{view}": ((size, *shape), torch.uint8) for view, shape in shapes.frames.items()}
        latents = {view: ((size, n_plan_frames, *shape), torch.float16) for view, shape in shapes.latents.items()}
        layout |= {f"latents/{view}": value for view, value in latents.items()}
        tensors = _allocated(layout, pin_memory=pin_memory)
        return WindowTensors(
            frames={view: tensors[f"frames/{view}"] for view in shapes.frames},
            latents={view: tensors[f"latents/{view}"] for view in shapes.latents},
            latent_mask=tensors["latent_mask"],
            low_dim=tensors["low_dim"],
            action=tensors.get("action"),
            action_mask=tensors["action_mask"],
            episode=tensors["episode"],
            step=tensors["step"],
        )


def _allocated(layout: _Layout, *, pin_memory: bool) -> dict[str, torch.Tensor]:
    """Uninitialised tensors that share one block of memory: many blocks of several MB a batch would fragment the heap."""
    begins, end = [], 0
    for shape, dtype in layout.values():
        begins.append(end)
        end += -(-math.prod(shape) * dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
    block = _block(end, pin_memory=pin_memory)
    return {
        name: block[begin : begin + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)
        for begin, (name, (shape, dtype)) in zip(begins, layout.items(), strict=True)
    }


def _block(n_bytes: int, *, pin_memory: bool) -> torch.Tensor:
    if pin_memory:
        return torch.empty(n_bytes, dtype=torch.uint8, pin_memory=True)
    # torch would ask for aligned memory, and glibc's heap grows on that instead of reusing what was freed: 50 MB more
    return torch.from_numpy(np.empty(n_bytes, np.uint8))


def _valid_runs(store: EpisodeStore, entries: Sequence[EpisodeEntry]) -> tuple[I64, I64]:
    """The episode [R] of each run of valid steps int64 [R,2]; only episodes with invalid steps are opened for it."""
    episode, runs = [], []
    for number, entry in enumerate(entries):
        found = [(0, entry.n_steps)]
        if entry.n_valid < entry.n_steps:
            valid = open_steps(store, entry)["valid"]
            found = [(first, end) for first, end in windows.valid_runs(valid).tolist()]
        episode += [number] * len(found)
        runs += found
    return np.array(episode, np.int64), np.array(runs, np.int64).reshape(-1, 2)


def _require_latents(root: Path, entries: Sequence[EpisodeEntry], latent_keys: Mapping[str, str]) -> None:
    """One listing a view; whether a shard fits its episode's frames is seen when it is opened."""
    for view, key in latent_keys.items():
        if entries and view not in entries[0].frames_sha256:
            raise UsageError(f"no view called {view!r}", where=root, remedy=nearest(view, entries[0].frames_sha256))
        folder = root / "latents" / view / key
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        missing = [entry.id for entry in entries if f"{entry.id}.safetensors" not in there]
        if missing:
            found = f"{len(missing)} of {len(entries)} episodes are not encoded, such as {missing[0]}"
            raise StoreError("latents are missing", where=folder, found=found, remedy=_ENCODE)
