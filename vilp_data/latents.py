"""Stored frames + an injected FrameEncoder -> latent shards: one file per (view, encoder key, episode), encoded once."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from vilp_data import shards
from vilp_data.engine import map_unordered
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.keys import FORMAT_VERSION
from vilp_data.types import F16, U8

BATCH = 16
"""Frames encoded at a time. Batches never cross episodes, so an episode's bytes do not depend on its neighbours."""


class FrameEncoder(Protocol):
    """What turns frames into latents and back. vilp_models has one; others join through the entry-point group."""

    @property
    def key(self) -> str:
        """Digest of everything that decides the latents' bytes: weights, scaling, compute and storage dtype."""
        ...

    def encode(self, frames: U8) -> F16:
        """uint8 [B,H,W,3] -> float16 [B,c,h,w], before quantisation."""
        ...

    def decode(self, latents: F16) -> U8:
        """float16 [B,c,h,w] -> quantised -> uint8 [B,H,W,3]."""
        ...

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """(c, h, w) for frames of height x width; UsageError where the encoder cannot halve them."""
        ...


@dataclass(frozen=True)
class LatentJob:
    """One latent shard to make."""

    root: Path
    encoder_name: str
    run_dir: Path
    view: str
    key: str
    episode_id: str


def load_encoder(encoder_name: str, run_dir: Path, view: str) -> FrameEncoder:
    """The FrameEncoder that the entry-point group `vilp.frame_encoders` knows as `encoder_name`, for one view of a run."""
    found = {point.name: point for point in importlib.metadata.entry_points(group="vilp.frame_encoders")}
    if encoder_name not in found:
        raise UsageError(f"no frame encoder called {encoder_name!r} is installed", remedy=nearest(encoder_name, found))
    return cast(FrameEncoder, found[encoder_name].load()(run_dir, view))


def latents_path(root: Path, view: str, key: str, episode_id: str) -> Path:
    return root / "latents" / view / key / f"{episode_id}.safetensors"


def stale_reason(root: Path, entry: EpisodeEntry, view: str, key: str) -> str | None:
    """Why the latents of one episode and view must be made (again); None where they fit."""
    path = latents_path(root, view, key, entry.id)
    if not path.is_file():
        return "not encoded yet"
    metadata = shards.read_header(path).metadata
    if metadata.get("format") != str(FORMAT_VERSION):
        return f"format {metadata.get('format')} instead of {FORMAT_VERSION}"
    if metadata.get("source_frames_sha256") != entry.frames_sha256[view]:
        return "the episode's frames changed (source_frames_sha256)"
    return None


def missing_latents(store: EpisodeStore, encoder_name: str, run_dir: Path, keys: dict[str, str]) -> list[LatentJob]:
    """The shards that are not there or are stale, by episode, then view."""
    return [
        LatentJob(store.root, encoder_name, run_dir, view, key, entry.id)
        for entry in store.index()
        for view, key in keys.items()
        if stale_reason(store.root, entry, view, key) is not None
    ]


def encode_episodes(
    jobs: Sequence[LatentJob], *, workers: int, progress: Callable[[LatentJob, int, float], None] | None = None
) -> int:
    """Make the shards; returns the number of frames encoded. Each worker computes on one thread, so bytes do not depend on how
    many there are. `progress(job, frames, seconds)` is told each shard and the seconds its worker spent on it.

    Call inside `shards.writer_lock`. Killed at any moment, the next call makes what is missing."""
    total = 0
    for job, (frames, seconds) in map_unordered(encode_one, jobs, workers=workers, initializer=_one_thread):
        total += frames
        if progress is not None:
            progress(job, frames, seconds)
    return total


def encode_one(job: LatentJob) -> tuple[int, float]:
    """Encode one episode's frames of one view and write the shard: (frames, seconds)."""
    import time

    encoder = _encoder_of(job)
    store = EpisodeStore(job.root)
    entry = store.entry_from_header(store.steps_path(job.episode_id))
    started = time.perf_counter()
    frames = store.read_frames(job.view, entry)
    latents = np.concatenate(list(encode_batches(encoder, frames)))
    if not np.isfinite(latents).all():
        raise StoreError(
            "latents that are not finite in float16", where=latents_path(job.root, job.view, job.key, job.episode_id),
            found=f"{np.count_nonzero(~np.isfinite(latents))} values", remedy="the encoder's training has diverged: train it again",
        )  # fmt: skip
    header = {"format": str(FORMAT_VERSION), "key": job.key, "source_frames_sha256": entry.frames_sha256[job.view], "source_key": entry.key}
    shards.write_shard(latents_path(job.root, job.view, job.key, job.episode_id), {"latents": latents}, header)
    return len(frames), time.perf_counter() - started


def encode_batches(encoder: FrameEncoder, frames: U8) -> Iterator[F16]:
    """float16 [b,c,h,w] for each BATCH of uint8 [n,H,W,3]."""
    for start in range(0, len(frames), BATCH):
        yield encoder.encode(frames[start : start + BATCH])


_encoders: dict[tuple[str, Path, str], FrameEncoder] = {}


def _encoder_of(job: LatentJob) -> FrameEncoder:
    """One encoder per worker process, run and view."""
    name = (job.encoder_name, job.run_dir, job.view)
    if name not in _encoders:
        _encoders[name] = load_encoder(*name)
    if _encoders[name].key != job.key:
        raise StoreError("the encoder changed while its latents were made", where=job.run_dir, remedy="run `vilp-data latents` again")
    return _encoders[name]


def _one_thread() -> None:
    """Sums in another order give other bits: workers compute on one thread each, and there are as many workers as cores."""
    import torch

    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
