"""Windows over a dataset folder as a torch Dataset: mapped files in, uint8 and float16 batches out.

Opening reads the index alone. An episode's files are mapped when a window first needs them, and pages are read as they
are touched, so memory does not grow with the dataset; values are handed out as stored, and models normalise inside.
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
from vilp_data.errors import NoWindowError
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.open_episodes import OpenEpisodes
from vilp_data.spec import WindowSpec
from vilp_data.types import I64


@dataclass(frozen=True)
class WindowTensors(TensorBatch):
    """B windows as torch tensors, as stored.

    frames        view -> uint8 [B,H,W,3]: the observation's image at the window's first step t; empty without frames
    latents       view -> float16 [B,N,c,h,w]: planned frames t+Δt … t+NΔt, before quantisation
    present_latents
                  view -> float16 [B,c,h,w]: the frame at t, before quantisation
    latent_mask   bool [B,N]: False where the planned frame lies past the end and repeats the last one
    low_dim       float32 [B,L] at t
    action        float32 [B,NΔt,A] at t … t+NΔt-1, zero where masked; None when no episode at hand has actions
    action_mask   bool [B,NΔt]: False past the end, and for episodes without actions
    episode       int64 [B], index into the dataset's `episode_ids`; step int64 [B]: where each window begins
    """

    frames: dict[str, torch.Tensor]
    latents: dict[str, torch.Tensor]
    present_latents: dict[str, torch.Tensor]
    latent_mask: torch.Tensor
    low_dim: torch.Tensor
    action: torch.Tensor | None
    action_mask: torch.Tensor
    episode: torch.Tensor


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
        views: Sequence[str] | None = None,
        with_frames: bool = True,
        with_actions: bool = True,
        acting: bool = False,
        labels: LabelledEpisodes | None = None,
    ) -> None:
        """Open the dataset at `root`. `latent_keys` names the encoder key of each view whose latents are read, `views` those
        whose images are: the same ones for None. `acting` leaves out the episodes without actions. `labels` are as of
        `pairs.PairDataset`.

        Raises SplitError without a split that covers the episodes, and NoWindowError where no window fits. What else is refused,
        and when, `open_episodes.OpenEpisodes` says.
        """
        store = EpisodeStore(Path(root))
        self._window = window
        entries = _side(store, split) if labels is None else labels.of_side(split)
        self._entries = [entry for entry in entries if entry.has_action or not acting]
        self._n_steps = np.array([entry.n_steps for entry in self._entries], np.int64)
        self._has_action = np.array([entry.has_action and with_actions for entry in self._entries], np.bool_)
        frame_views = tuple(latent_keys) if views is None else tuple(views)
        self._episodes = OpenEpisodes(
            store,
            self._entries,
            latent_keys=latent_keys,
            frame_views=frame_views if with_frames else (),
            has_action=self._has_action,
            labels=labels,
        )
        episode, runs = self._episodes.valid_runs()
        starts = windows.plan_windows(
            runs,
            self._n_steps[episode],
            n_plan_frames=window.n_plan_frames,
            frame_stride=window.frame_stride,
            max_goal_frames=window.max_goal_frames,
        )
        if labels is not None:
            episode, starts = windows.repeated(episode, starts, labels.repeats())
        self._index = windows.WindowIndex.of(episode, starts)
        if not len(self._index):
            raise NoWindowError(
                "no window fits any episode",
                where=store.root,
                found=f"{len(self._entries)} episodes of at most {self._n_steps.max(initial=0)} steps",
                remedy="lower n_plan_frames or frame_stride, or raise max_goal_frames, in the task's [window]",
            )

    @property
    def episode_ids(self) -> list[str]:
        """What `WindowTensors.episode` counts through."""
        return [entry.id for entry in self._entries]

    @property
    def samples_per_episode(self) -> I64:
        """int64 [E]: how many numbers each of `episode_ids` has."""
        return self._index.per_episode(len(self._entries))

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
        latents = {view: tensor.numpy() for view, tensor in batch.latents.items()}
        present = {view: tensor.numpy() for view, tensor in batch.present_latents.items()}
        frames = {view: tensor.numpy() for view, tensor in batch.frames.items()}
        low_dim = batch.low_dim.numpy()
        action = None if batch.action is None else batch.action.numpy()
        for row, (number, first) in enumerate(zip(batch.episode.tolist(), batch.step.tolist(), strict=True)):
            opened = self._episodes[number]
            low_dim[row] = opened.low_dim[first]
            # mode="clip" lets take() write in place. It hides no error: opening the episode checked that the steps cover it and
            # that valid steps point at stored frames, and windows hold valid steps alone.
            if action is not None and opened.action is not None:
                opened.action.take(acted[row], axis=0, out=action[row], mode="clip")
            for view, stored in opened.latents.items():
                source_index = opened.source_index[view]
                stored.take(source_index[planned[row]], axis=0, out=latents[view][row], mode="clip")
                present[view][row] = stored[source_index[first]]
            for view, images in opened.frames.items():
                frames[view][row] = images[opened.source_index[view][first]]
        if action is not None:
            action[~batch.action_mask.numpy()] = 0

    def _empty_batch(self, size: int, *, pin_memory: bool) -> WindowTensors:
        n_plan_frames, shapes = self._window.n_plan_frames, self._episodes.shapes
        n_actions = n_plan_frames * self._window.frame_stride
        layout: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "latent_mask": ((size, n_plan_frames), torch.bool),
            "low_dim": ((size, *shapes.low_dim), torch.float32),
            "action_mask": ((size, n_actions), torch.bool),
            "episode": ((size,), torch.int64),
            "step": ((size,), torch.int64),
        }
        if shapes.action is not None:
            layout["action"] = ((size, n_actions, *shapes.action), torch.float32)
        layout |= {f"frames/{view}": ((size, *shape), torch.uint8) for view, shape in shapes.frames.items()}
        for view, shape in shapes.latents.items():
            layout[f"latents/{view}"] = ((size, n_plan_frames, *shape), torch.float16)
            layout[f"present_latents/{view}"] = ((size, *shape), torch.float16)
        tensors = allocated(layout, pin_memory=pin_memory)
        return WindowTensors(
            frames={view: tensors[f"frames/{view}"] for view in shapes.frames},
            latents={view: tensors[f"latents/{view}"] for view in shapes.latents},
            present_latents={view: tensors[f"present_latents/{view}"] for view in shapes.latents},
            latent_mask=tensors["latent_mask"],
            low_dim=tensors["low_dim"],
            action=tensors.get("action"),
            action_mask=tensors["action_mask"],
            episode=tensors["episode"],
            step=tensors["step"],
        )


def _side(store: EpisodeStore, split: Literal["train", "val", "all"]) -> list[EpisodeEntry]:
    return store.index() if split == "all" else side_episodes(store, split)
