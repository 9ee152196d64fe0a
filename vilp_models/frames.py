"""Training frames: every stored frame of the training episodes as one sequence, drawn at random by a counter.

Batch `step` is a function of (seed, step) alone, so a resumed run sees exactly what an uninterrupted one would have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vilp_data.episode_files import open_frames
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.types import U8, Bool
from vilp_models.metrics import moving_mask, temporal_median

MEDIAN_FRAMES = 64
"""The loss weighs pixels by a median over at most this many frames of an episode, spread evenly; reports use all."""


@dataclass
class Clip:
    """Mapped frames uint8 [n,H,W,C] of one view of one episode, and their temporal median [H,W,C] once asked for."""

    frames: U8
    median: U8 | None = None

    def background(self) -> U8:
        if self.median is None:
            stride = -(-len(self.frames) // MEDIAN_FRAMES)
            self.median = temporal_median(self.frames[::stride])
        return self.median


class TrainingFrames:
    """Random access to the frames of many clips, as whole images or as square crops."""

    def __init__(self, clips: Sequence[Clip], *, crop: int | None = None, crop_moving: float = 0.0) -> None:
        sizes = {clip.frames.shape[1:3] for clip in clips}
        if crop is None and len(sizes) > 1:
            raise UsageError(
                "views of different sizes cannot share whole-frame batches",
                found=", ".join(f"{h}x{w}" for h, w in sorted(sizes)),
                remedy="set models.vqgan.crop, or models.vqgan.share_views = false",
            )
        if crop is not None and any(crop > min(size) for size in sizes):
            raise UsageError(
                f"models.vqgan.crop = {crop} is larger than a frame", remedy=f"use at most {min(map(min, sizes))}"
            )
        if len(channels := {clip.frames.shape[3] for clip in clips}) > 1:
            found = f"frames of {' and '.join(map(str, sorted(channels)))} channels"
            remedy = "ingest again: the view's `depth` was changed for some of its episodes only"
            raise UsageError("pictures and depth cannot share batches", found=found, remedy=remedy)
        self.clips = [clip for clip in clips if len(clip.frames)]
        self.ends = np.cumsum([len(clip.frames) for clip in self.clips])
        self.crop, self.crop_moving = crop, crop_moving
        if not self.clips:
            raise UsageError("there is no training frame", remedy="ingest more episodes, or change the split's ratio")

    def sizes(self) -> set[tuple[int, int]]:
        """(height, width) of the images in batches; frames of every such size are encoded later, cropped or not."""
        sizes = {(int(clip.frames.shape[1]), int(clip.frames.shape[2])) for clip in self.clips}
        return sizes | ({(self.crop, self.crop)} if self.crop is not None else set())

    @property
    def channels(self) -> int:
        """Of every image: 3 for RGB, 1 for depth."""
        return int(self.clips[0].frames.shape[3])

    def __len__(self) -> int:
        return int(self.ends[-1])

    def batch(self, *, seed: int, step: int, size: int) -> tuple[U8, Bool]:
        """Images uint8 [B,h,w,C], drawn uniformly with replacement, and which of their pixels move, bool [B,h,w]."""
        random = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, step]))
        pairs = [self._draw(int(index), random) for index in random.integers(len(self), size=size)]
        return np.stack([frame for frame, _ in pairs]), np.stack([moving for _, moving in pairs])

    def _draw(self, index: int, random: np.random.Generator) -> tuple[U8, Bool]:
        number = int(np.searchsorted(self.ends, index, side="right"))
        clip = self.clips[number]
        frame = clip.frames[index - int(self.ends[number])]
        moving = moving_mask(frame, clip.background())
        if self.crop is None:
            return frame, moving
        rows, columns = self._place(moving, random)
        return frame[rows, columns], moving[rows, columns]

    def _place(self, moving: Bool, random: np.random.Generator) -> tuple[slice, slice]:
        """Where to cut: centred near a random moving pixel in `crop_moving` of the cases, else anywhere."""
        assert self.crop is not None
        height, width = moving.shape
        row, column = random.integers(height - self.crop + 1), random.integers(width - self.crop + 1)
        centred, pick = random.random() < self.crop_moving, random.random()
        where = np.flatnonzero(moving) if centred else np.empty(0, np.int64)
        if len(where):
            y, x = divmod(int(where[int(pick * len(where))]), width)
            row, column = y - self.crop // 2, x - self.crop // 2
        row, column = int(np.clip(row, 0, height - self.crop)), int(np.clip(column, 0, width - self.crop))
        return slice(row, row + self.crop), slice(column, column + self.crop)


def open_clips(store: EpisodeStore, episodes: Sequence[EpisodeEntry], views: Sequence[str]) -> list[Clip]:
    """Map the frames of these episodes and views. Raises StoreError where a file is missing, or is of other frames than the
    episode's (see `vilp_data.episode_files`)."""
    return [Clip(open_frames(store, episode, view)) for episode in episodes for view in views]
