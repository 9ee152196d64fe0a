"""Pairs of frames with the actions between them, which is what the low-level policy learns from.

A pair is the steps k and k+Δt of one episode, all of whose steps between are valid and recorded: nothing is repeated and
nothing is masked. Episodes without actions have none. Values are handed out as stored, as in `dataset`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch.utils.data import Dataset

from vilp_data import windows
from vilp_data.batches import TensorBatch, allocated
from vilp_data.dataset_split import side_episodes
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.open_episodes import OpenEpisodes
from vilp_data.types import I64


@dataclass(frozen=True)
class PairTensors(TensorBatch):
    """B pairs as torch tensors, as stored.

    frames   view -> uint8 [B,2,H,W,3]: the images at k and at k+Δt; empty without frames
    latents  view -> float16 [B,2,c,h,w]: the same frames, before quantisation; empty without `latent_keys`
    low_dim  float32 [B,L] at k
    action   float32 [B,Δt,A] at k … k+Δt-1
    episode  int64 [B], index into the dataset's `episode_ids`; step int64 [B]: k
    """

    frames: dict[str, torch.Tensor]
    latents: dict[str, torch.Tensor]
    low_dim: torch.Tensor
    action: torch.Tensor
    episode: torch.Tensor


class PairDataset(Dataset[PairTensors]):
    """Pairs of the episodes with actions on one side of the split, numbered by episode and step.

    Read as `dataset.WindowDataset` is: `dataset[i]`, `dataset.read([i, j, …])`, `loader.Loader`.
    """

    def __init__(
        self,
        root: Path | str,
        *,
        split: Literal["train", "val", "all"],
        frame_stride: int,
        latent_keys: Mapping[str, str] | None = None,
        views: Sequence[str] | None = None,
        with_frames: bool = True,
        labels: LabelledEpisodes | None = None,
        where: Mapping[str, str] | None = None,
    ) -> None:
        """Open the dataset at `root`. `views` are those whose images are read, all of them for None; `latent_keys` names the
        encoder key of each view whose latents are read too, none for None. `labels` leaves an action set's episodes alone of the
        training side, and gives each of their pairs as many numbers as an epoch of the set goes over it. `where` leaves the
        episodes of a side that have these tags; an action set has its own, so it is not asked for beside `labels`.

        Raises UsageError for both, SplitError without a split that covers the episodes, and StoreError where no episode has actions or
        no pair fits. What else is refused, and when, `open_episodes.OpenEpisodes` says.
        """
        if labels is not None and where:
            remedy = "leave `where` out, or choose a set by these tags"
            raise UsageError("an action set says itself which tags its episodes have", found=dict(where), remedy=remedy)
        store = EpisodeStore(Path(root))
        self._entries = _acting(store, split, where or {}) if labels is None else labels.of_side(split)
        self._frame_stride = frame_stride
        every_view = sorted(self._entries[0].frames_sha256) if views is None else views
        self._episodes = OpenEpisodes(
            store,
            self._entries,
            latent_keys=latent_keys or {},
            frame_views=every_view if with_frames else (),
            has_action=np.ones(len(self._entries), np.bool_),
            labels=labels,
        )
        episode, runs = self._episodes.valid_runs()
        starts = windows.pair_windows(runs, frame_stride=frame_stride)
        if labels is not None:
            episode, starts = windows.repeated(episode, starts, labels.repeats())
        self._index = windows.WindowIndex.of(episode, starts)
        if not len(self._index):
            longest = max(entry.n_steps for entry in self._entries)
            raise StoreError(
                "no pair fits any episode",
                where=store.root,
                found=f"frame_stride {frame_stride}, {len(self._entries)} episodes with actions of at most {longest} steps",
                remedy="lower frame_stride in the task's [window]",
            )

    @property
    def episode_ids(self) -> list[str]:
        """What `PairTensors.episode` counts through: the episodes with actions."""
        return [entry.id for entry in self._entries]

    @property
    def samples_per_episode(self) -> I64:
        """int64 [E]: how many numbers each of `episode_ids` has."""
        return self._index.per_episode(len(self._entries))

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, number: int) -> PairTensors:
        return self.read([number])

    def __getitems__(self, numbers: Sequence[int]) -> PairTensors:
        return self.read(numbers)

    def read(self, numbers: Sequence[int] | I64, *, pin_memory: bool = False) -> PairTensors:
        """Pairs `numbers`, in that order, in memory of their own; `pin_memory` makes it page-locked.

        Raises IndexError outside 0 … len - 1, and StoreError for files that are missing, cut off, stale or foreign."""
        episode, step = self._index.locate(np.asarray(numbers, np.int64))
        goal, acted = windows.pair_steps(step, frame_stride=self._frame_stride)
        batch = self._empty_batch(len(step), pin_memory=pin_memory)
        batch.episode.numpy()[:] = episode
        batch.step.numpy()[:] = step
        frames = {view: tensor.numpy() for view, tensor in batch.frames.items()}
        latents = {view: tensor.numpy() for view, tensor in batch.latents.items()}
        low_dim, action = batch.low_dim.numpy(), batch.action.numpy()
        both = np.stack([step, goal], axis=1)
        for row, number in enumerate(episode.tolist()):
            opened = self._episodes[number]
            low_dim[row] = opened.low_dim[step[row]]
            # mode="clip" lets take() write in place; it hides no error, as in `dataset.WindowDataset`
            if opened.action is not None:
                opened.action.take(acted[row], axis=0, out=action[row], mode="clip")
            for arrays, out in ((opened.frames, frames), (opened.latents, latents)):
                for view, stored in arrays.items():
                    stored.take(opened.source_index[view][both[row]], axis=0, out=out[view][row], mode="clip")
        return batch

    def _empty_batch(self, size: int, *, pin_memory: bool) -> PairTensors:
        shapes = self._episodes.shapes
        layout: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "low_dim": ((size, *shapes.low_dim), torch.float32),
            "action": ((size, self._frame_stride, *(shapes.action or ())), torch.float32),
            "episode": ((size,), torch.int64),
            "step": ((size,), torch.int64),
        }
        layout |= {f"frames/{view}": ((size, 2, *shape), torch.uint8) for view, shape in shapes.frames.items()}
        layout |= {f"latents/{view}": ((size, 2, *shape), torch.float16) for view, shape in shapes.latents.items()}
        tensors = allocated(layout, pin_memory=pin_memory)
        return PairTensors(
            frames={view: tensors[f"frames/{view}"] for view in shapes.frames},
            latents={view: tensors[f"latents/{view}"] for view in shapes.latents},
            low_dim=tensors["low_dim"],
            action=tensors["action"],
            episode=tensors["episode"],
            step=tensors["step"],
        )


def _acting(store: EpisodeStore, split: Literal["train", "val", "all"], where: Mapping[str, str]) -> list[EpisodeEntry]:
    entries = store.index() if split == "all" else side_episodes(store, split)
    acting = [entry for entry in entries if entry.has_action and where.items() <= entry.tags.items()]
    if not acting:
        among = f"none among {len(entries)}" + ("" if split == "all" else f" on the {split} side of the split")
        raise StoreError(
            "no episode has actions" + "".join(f", and {tag} = {value}" for tag, value in where.items()),
            where=store.root,
            found=among,
            remedy=(
                "ask for other tags, or none" if where else "ingest logs that hold the topics of the task's [action]"
            )
            + ("" if split == "all" else ", or draw the split again with `vilp-data split --redraw`"),
        )
    return acting
