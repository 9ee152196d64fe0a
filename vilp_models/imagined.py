"""The imagined beside the real: windows of recorded episodes, their reconstruction, and what planners make of their first frame.

Axes: B windows, S samples, N planned frames (t+Δt … t+NΔt), H W pixels, c h w latents, L low_dim.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from vilp_data import windows
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.latents import BATCH, open_latents
from vilp_data.spec import WindowSpec
from vilp_data.types import F16, F32, I64, U8
from vilp_models.metrics import temporal_median


class Decoder(Protocol):
    """What is used of a view's VQGAN (`vqgan.VqganEncoder`)."""

    @property
    def key(self) -> str: ...
    def encode(self, frames: U8) -> F16: ...
    def decode(self, latents: F16 | F32) -> U8: ...


class VideoPlanner(Protocol):
    """What is used of a view's planner (`planner.Planner`)."""

    sees_low_dim: bool

    def condition(
        self, frames: Mapping[str, Tensor], present_latents: Mapping[str, Tensor], low_dim: Tensor
    ) -> Any: ...
    def sample(self, condition: Any, noise: Tensor, *, steps: int | None = None, sampler: Any = None) -> Tensor: ...


@dataclass(frozen=True)
class Recorded:
    """B windows of one episode, recorded to their last planned frame.

    episode, step    its id; int64 [B]: where each window begins
    frame_stride     (paper Δt) steps between planned frames
    present, future  view -> uint8 [B,H,W,3] at t; [B,N,H,W,3] at t+Δt … t+NΔt
    present_latents, latents
                     view -> float16 [B,c,h,w]; [B,N,c,h,w]
    low_dim          float32 [B,L] at t
    background       view -> uint8 [H,W,3]: temporal median of the whole episode
    """

    episode: str
    step: I64
    frame_stride: int
    present: Mapping[str, U8]
    future: Mapping[str, U8]
    present_latents: Mapping[str, F16]
    latents: Mapping[str, F16]
    low_dim: F32
    background: Mapping[str, U8]

    def __len__(self) -> int:
        return len(self.step)


def recorded_starts(
    store: EpisodeStore, entries: Sequence[EpisodeEntry], window: WindowSpec
) -> list[tuple[EpisodeEntry, I64]]:
    """First steps of the windows whose planned frames were all recorded, int64 [B] of each episode that has any.

    Windows that end in the held last frame are left out: what is compared there is a still image. Raises UsageError where no
    window is left."""
    starts = []
    for entry in entries:
        runs = windows.valid_runs(open_steps(store, entry)["valid"])
        spans = windows.plan_windows(
            runs,
            entry.n_steps,
            n_plan_frames=window.n_plan_frames,
            frame_stride=window.frame_stride,
            max_goal_frames=0,
        )
        starts.append((entry, np.concatenate([np.arange(*span) for span in spans.tolist()] or [np.empty(0, np.int64)])))
    if not any(len(steps) for _, steps in starts):
        raise UsageError(
            "no validation episode is long enough for the planner's horizon",
            where=store.root,
            found=f"{len(entries)} episodes, {window.n_plan_frames} frames of {window.frame_stride} steps each",
            remedy="record longer ones, or train with a smaller n_plan_frames in the task's [window]",
        )
    return [(entry, steps) for entry, steps in starts if len(steps)]


def spread(starts: Sequence[tuple[EpisodeEntry, I64]], wanted: int) -> list[tuple[EpisodeEntry, I64]]:
    """At most `wanted` of the starts, evenly spread over all of them, by episode."""
    total = sum(len(steps) for _, steps in starts)
    chosen = np.unique(np.linspace(0, total - 1, min(wanted, total)).round().astype(np.int64))
    ends = np.cumsum([len(steps) for _, steps in starts])
    parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
    begins = ends - [len(steps) for _, steps in starts]
    return [
        (entry, steps[part - begin])
        for (entry, steps), part, begin in zip(starts, parts, begins, strict=True)
        if len(part)
    ]


def read_recorded(
    store: EpisodeStore,
    entry: EpisodeEntry,
    steps: I64,
    latent_keys: Mapping[str, str],
    window: WindowSpec,
    *,
    batch_size: int,
) -> Iterator[Recorded]:
    """The windows at `steps` of one episode, `batch_size` at a time. Raises StoreError for missing or stale files."""
    arrays = open_steps(store, entry, latent_keys)
    frames = {view: open_frames(store, entry, view) for view in latent_keys}
    latents = {view: open_latents(store.root, entry, view, key) for view, key in latent_keys.items()}
    background = {view: temporal_median(np.array(frames[view])) for view in latent_keys}
    for first in range(0, len(steps), batch_size):
        step = steps[first : first + batch_size]
        planned = step[:, None] + np.arange(1, window.n_plan_frames + 1) * window.frame_stride
        index = {view: arrays[f"source_index/{view}"] for view in latent_keys}
        yield Recorded(
            episode=entry.id,
            step=step,
            frame_stride=window.frame_stride,
            present={view: frames[view][index[view][step]] for view in latent_keys},
            future={view: frames[view][index[view][planned]] for view in latent_keys},
            present_latents={view: latents[view][index[view][step]] for view in latent_keys},
            latents={view: latents[view][index[view][planned]] for view in latent_keys},
            low_dim=arrays["low_dim"][step],
            background=background,
        )


@dataclass(frozen=True)
class Imagination:
    """Planners, one a view and each conditioned on all views, and how they sample.

    Noise is a function of (seed, episode, step, sample) alone: the same start gives the same samples whatever else is
    evaluated. Views whose latents have one shape share it.
    """

    planners: Mapping[str, VideoPlanner]
    n_plan_frames: int
    seed: int = 0
    denoising_steps: int | None = None
    sampler: str | None = None
    device: torch.device | str = "cpu"

    @torch.inference_mode()
    def samples(
        self,
        present: Mapping[str, U8],
        present_latents: Mapping[str, F16],
        low_dim: F32,
        *,
        names: Sequence[tuple[str, int]],
        n_samples: int,
    ) -> dict[str, F32]:
        """What follows B observations, view -> float32 [B,S,N,c,h,w] latents before quantisation.

        `names` [B] are (episode, step) of each, which its noise is drawn from."""
        frames, latents = self._tensors(present), self._tensors(present_latents)
        condition_low_dim = torch.from_numpy(np.ascontiguousarray(low_dim)).to(self.device)
        out = {}
        for view, planner in self.planners.items():
            condition = planner.condition(frames, latents, condition_low_dim)
            shape = (self.n_plan_frames, *present_latents[view].shape[1:])
            noise = [
                np.stack([start_noise(self.seed, *name, sample, shape) for name in names])
                for sample in range(n_samples)
            ]
            sampled = [
                planner.sample(
                    condition, torch.from_numpy(z).to(self.device), steps=self.denoising_steps, sampler=self.sampler
                )
                for z in noise
            ]
            out[view] = torch.stack(sampled, dim=1).float().cpu().numpy()
        return out

    def of(self, recorded: Recorded, *, n_samples: int) -> dict[str, F32]:
        """`samples` of recorded windows."""
        names = [(recorded.episode, step) for step in recorded.step.tolist()]
        return self.samples(
            recorded.present, recorded.present_latents, recorded.low_dim, names=names, n_samples=n_samples
        )

    def _tensors(self, values: Mapping[str, Any]) -> dict[str, Tensor]:
        return {view: torch.from_numpy(np.ascontiguousarray(array)).to(self.device) for view, array in values.items()}


def start_noise(seed: int, episode: str, step: int, sample: int, shape: Sequence[int]) -> F32:
    """Unit noise of one sample of one start: float32 `shape`, the same on every machine."""
    counter = [seed, zlib.crc32(episode.encode()), step, sample]
    return np.random.default_rng(counter).standard_normal(tuple(shape), np.float32)


def decode_frames(decoder: Decoder, latents: F16 | F32) -> U8:
    """Latents [...,c,h,w] of any leading axes to frames uint8 [...,H,W,3], a few at a time."""
    flat = latents.reshape(-1, *latents.shape[-3:])
    frames = np.concatenate([decoder.decode(flat[i : i + BATCH]) for i in range(0, len(flat), BATCH)])
    return frames.reshape(*latents.shape[:-3], *frames.shape[1:])
