"""Stored frames + an injected FrameEncoder -> latent shards: one file per (view, encoder key, episode), encoded once."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from vilp_data import shards
from vilp_data.engine import map_unordered
from vilp_data.episode_files import open_frames
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError, nearest
from vilp_data.keys import FORMAT_VERSION
from vilp_data.types import F16, U8

BATCH = 16
"""Frames encoded at a time. Batches never cross episodes, so an episode's bytes do not depend on its neighbours. Another
number may give other bits: raise `keys.FORMAT_VERSION` with it."""

BARE_BATCHES = 5
"""Batches that the bare forward loop is timed on."""


class FrameEncoder(Protocol):
    """What turns frames into latents and back. vilp_models has one; others join through the entry-point group."""

    @property
    def key(self) -> str:
        """Digest of `key_fields`: everything that decides the latents' bytes, and nothing else."""
        ...

    @property
    def key_fields(self) -> dict[str, str]:
        """What goes into the key, by name, so that a stale latent can say why: weights, architecture, scaling, compute and
        storage dtype, kind of device."""
        ...

    @property
    def parallel(self) -> bool:
        """Whether several processes may each hold one and encode at a time; False where they would share one accelerator."""
        ...

    @property
    def trained_on(self) -> frozenset[str]:
        """Keys of the episodes whose frames it was trained on."""
        ...

    def encode(self, frames: U8) -> F16:
        """uint8 [B,H,W,C] -> float16 [B,c,h,w], before quantisation; C is 3, or 1 for a depth view."""
        ...

    def decode(self, latents: F16) -> U8:
        """float16 [B,c,h,w] -> quantised -> uint8 [B,H,W,C]."""
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
    found = _installed_encoders()
    if encoder_name not in found:
        raise UsageError(f"no frame encoder called {encoder_name!r} is installed", remedy=nearest(encoder_name, found))
    return cast(FrameEncoder, found[encoder_name].load()(run_dir, view))


def encoder_names() -> list[str]:
    """The kinds of frame encoder that are installed."""
    return sorted(_installed_encoders())


def _installed_encoders() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group="vilp.frame_encoders")}


def latents_path(root: Path, view: str, key: str, episode_id: str) -> Path:
    return root / "latents" / view / key / f"{episode_id}.safetensors"


def stale_reason(root: Path, entry: EpisodeEntry, view: str, key: str) -> str | None:
    """Why the latents of one episode and view must be made (again); None where they fit."""
    path = latents_path(root, view, key, entry.id)
    if not path.is_file():
        return "not encoded yet"
    header = shards.read_header(path)
    if header.metadata.get("format") != str(FORMAT_VERSION):
        return f"format {header.metadata.get('format')} instead of {FORMAT_VERSION}"
    return _other_frames(header.metadata, header.tensors["latents"].shape[0], entry, view)


def open_latents(root: Path, entry: EpisodeEntry, view: str, key: str) -> F16:
    """The mapped latents float16 [n,c,h,w] of one episode and view: by their header, those of the frames it has today. Row i belongs to
    frame i of `episode_files.open_frames`.

    Raises StoreError where they are missing or of other frames. Bytes are not checksummed: see `episode_files`."""
    return _of_today(latents_path(root, view, key, entry.id), shards.open_shard, entry, view)


def read_latents(root: Path, entry: EpisodeEntry, view: str, key: str) -> F16:
    """As `open_latents`, read into memory with the checksum verified."""
    return _of_today(latents_path(root, view, key, entry.id), shards.read_shard, entry, view)


def _of_today(path: Path, read: Callable[[Path], shards.Shard], entry: EpisodeEntry, view: str) -> F16:
    shard = read(path)
    latents = shard.arrays["latents"]
    why = _other_frames(shard.metadata, len(latents), entry, view)
    if why is not None:
        remedy = "run `vilp-data latents`"
        raise StoreError("latents of other frames than the episode has today", where=path, found=why, remedy=remedy)
    first = entry.first_frame(view)  # a trimmed episode keeps the latents of its whole frames file
    return cast(F16, latents[first : first + entry.n_frames[view]])


def _other_frames(metadata: Mapping[str, str], n_latents: int, entry: EpisodeEntry, view: str) -> str | None:
    if metadata.get("source_frames_sha256") != entry.frames_sha256[view]:
        return "the episode's frames changed (source_frames_sha256)"
    if n_latents != entry.stored_frames(view):
        return f"{n_latents} latents of {entry.stored_frames(view)} frames"
    return None


def missing_latents(store: EpisodeStore, encoder_name: str, run_dir: Path, keys: dict[str, str]) -> list[LatentJob]:
    """The shards that are not there or are stale, by episode, then view."""
    return [
        LatentJob(store.root, encoder_name, run_dir, view, key, entry.id)
        for entry in store.index()
        for view, key in keys.items()
        if stale_reason(store.root, entry, view, key) is not None
    ]


@dataclass(frozen=True)
class EncodedShard:
    """What making one shard took: the worker's seconds on its `frames`, and the frames/s of its bare forward loop."""

    frames: int
    seconds: float
    bare_frames_per_s: float


def encode_episodes(
    jobs: Sequence[LatentJob], *, workers: int
) -> Generator[tuple[LatentJob, EncodedShard], None, None]:
    """Make the shards, yielding each as it is done. Workers compute on one thread each, this process included while it is the
    only one, so bytes do not depend on how many there are. Call inside `writer_lock`, and close the generator before
    letting go of it. Killed at any moment, the next call makes what is missing."""
    made = map_unordered(encode_one, jobs, workers=workers, initializer=_compute_on_one_thread)
    with _threads_restored(), contextlib.closing(made):
        yield from made


def encode_one(job: LatentJob) -> EncodedShard:
    """Encode one episode's frames of one view and write the shard."""
    encoder = _encoder_of(job)
    store = EpisodeStore(job.root)
    entry = store.entry_from_header(store.steps_path(job.episode_id))
    bare = _bare_frames_per_s(job, store, entry)
    started = time.perf_counter()
    frames = store.read_stored_frames(job.view, entry)
    latents = np.concatenate(list(encode_batches(encoder, frames)))
    path = latents_path(job.root, job.view, job.key, job.episode_id)
    if not np.isfinite(latents).all():
        found = f"{np.count_nonzero(~np.isfinite(latents))} values beyond float16"
        raise StoreError(
            "latents that cannot be stored",
            where=path,
            found=found,
            remedy="the encoder's training diverged: train it again",
        )
    header = {"format": str(FORMAT_VERSION), "key": job.key, "encoder": json.dumps(encoder.key_fields, sort_keys=True)}
    header |= {"source_frames_sha256": entry.frames_sha256[job.view], "source_key": entry.key}
    shards.write_shard(path, {"latents": latents}, header)
    return EncodedShard(len(frames), time.perf_counter() - started, bare)


def encode_batches(encoder: FrameEncoder, frames: U8) -> Iterator[F16]:
    """float16 [b,c,h,w] for each BATCH of uint8 [n,H,W,C]."""
    for start in range(0, len(frames), BATCH):
        yield encoder.encode(frames[start : start + BATCH])


# --- in a worker process -------------------------------------------------------------------------------------------------

_encoders: dict[tuple[str, Path, str], FrameEncoder] = {}
_bare_rates: dict[tuple[str, Path, str], float] = {}


def _bare_frames_per_s(job: LatentJob, store: EpisodeStore, entry: EpisodeEntry) -> float:
    """Frames/s of encoding one batch that lies in memory: what reading and writing are measured against. The best of a few,
    since other workers may still be starting; once for each worker process, run and view."""
    name = (job.encoder_name, job.run_dir, job.view)
    if name not in _bare_rates:
        frames = np.array(open_frames(store, entry, job.view)[:BATCH])
        _encoder_of(job).encode(frames)
        seconds = []
        for _ in range(BARE_BATCHES):
            started = time.perf_counter()
            _encoder_of(job).encode(frames)
            seconds.append(time.perf_counter() - started)
        _bare_rates[name] = len(frames) / min(seconds)
    return _bare_rates[name]


def _encoder_of(job: LatentJob) -> FrameEncoder:
    """One encoder per worker process, run and view; loaded again where the run was trained on since."""
    name = (job.encoder_name, job.run_dir, job.view)
    if name not in _encoders or _encoders[name].key != job.key:
        _encoders[name] = load_encoder(*name)
    if _encoders[name].key != job.key:
        raise StoreError(
            "the encoder changed while its latents were made", where=job.run_dir, remedy="run `vilp-data latents` again"
        )
    return _encoders[name]


def _compute_on_one_thread() -> None:
    """Sums in another order give other bits: workers compute on one thread each, and there are as many workers as cores."""
    import torch

    torch.set_num_threads(1)


@contextlib.contextmanager
def _threads_restored() -> Iterator[None]:
    """Give this process its thread count back: without workers of their own, `_compute_on_one_thread` runs in it."""
    import torch

    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
