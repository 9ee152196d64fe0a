"""All latents of a dataset under one trained encoder: which are missing, made, and summed up in statistics."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vilp_data import shards
from vilp_data.dataset_split import find_split, side_episodes
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.keys import digest, ingest_key
from vilp_data.latents import LatentJob, encode_episodes, load_encoder, missing_latents, open_latents
from vilp_data.spec import TaskSpec
from vilp_data.stats import ChannelStats
from vilp_data.writer_lock import remove_leftovers, writer_lock

EncodingProgress = Callable[[int, int, float], None]
"""Told (frames done, frames in all, frames/s that bare forward passes of the same workers would reach)."""


@dataclass
class EncodedDataset:
    """What `encode_dataset` found and did.

    keys       view -> the encoder's key, the name of the folder under latents/<view>/
    shards     view -> how many fit today's episodes: one each, as the call ends only when none is missing
    written    view -> how many of them are new
    frames     frames encoded now, and their rate over all workers beside the rate of bare forward passes
    unseen     training episodes that the encoder was not trained on, having come later
    """

    keys: dict[str, str]
    shards: dict[str, int] = field(default_factory=dict)
    written: dict[str, int] = field(default_factory=dict)
    frames: int = 0
    frames_per_s: float = 0.0
    bare_frames_per_s: float = 0.0
    unseen: tuple[str, ...] = ()

    @property
    def ratio(self) -> float:
        """Encoding, reading and writing included, over the bare forward loop of the same workers."""
        return self.frames_per_s / self.bare_frames_per_s if self.bare_frames_per_s else 0.0


def find_run(
    root: Path, given: Path | None, encoder_name: str, *, preset: str | None = None, option: str = "--run"
) -> Path:
    """The folder of the trained encoder: the one given, else `runs/<encoder_name>-<preset>`, else the only `runs/<encoder_name>*` of
    the dataset.

    `option` is how a user names one. Raises UsageError where there is no such folder, or it is not clear which."""
    if given is None and preset is not None:
        given = root / "runs" / f"{encoder_name}-{preset}"
    if given is not None:
        if not given.is_dir():
            raise UsageError(
                "no such run folder", where=given, remedy=f"train one with `vilp-models train {encoder_name}`"
            )
        return given
    runs = sorted(path for path in (root / "runs").glob(f"{encoder_name}*") if path.is_dir())
    if len(runs) != 1:
        there = ", ".join(map(str, runs)) or "none"
        raise UsageError(
            f"which {encoder_name} run?",
            where=root / "runs",
            found=there,
            remedy=f"name one with {option}, or train one with `vilp-models train {encoder_name}`",
        )
    return runs[0]


def encode_dataset(
    root: Path,
    spec: TaskSpec,
    encoder_name: str,
    run_dir: Path,
    *,
    workers: int,
    progress: EncodingProgress | None = None,
) -> EncodedDataset:
    """Make every latent shard that is missing or stale under the encoder of `run_dir`, then the training statistics.

    An encoder that is not `parallel` gets one worker. Without a split there are no statistics. Raises what the encoder's
    loading, the split's reading and the stores raise, before anything is encoded where that can be known."""
    store = EpisodeStore(root)
    encoders = {view: load_encoder(encoder_name, run_dir, view) for view in sorted(spec.views)}
    for view, view_spec in spec.views.items():
        encoders[view].latent_shape(view_spec.height, view_spec.width)
    if not all(encoder.parallel for encoder in encoders.values()):
        workers = 1
    done = EncodedDataset({view: encoder.key for view, encoder in encoders.items()})
    with writer_lock(root):
        remove_leftovers(root)
        train = side_episodes(store, "train") if find_split(root) is not None else []
        jobs = missing_latents(store, encoder_name, run_dir, done.keys)
        _encode(store, jobs, done, workers=max(1, min(workers, len(jobs))), progress=progress)
        done.shards = dict.fromkeys(done.keys, len(store.index()))
        trained_on = [{ingest_key(key) for key in encoder.trained_on} for encoder in encoders.values()]
        done.unseen = tuple(entry.id for entry in train if any(entry.ingest_key not in seen for seen in trained_on))
        if train:
            write_stats(root, done.keys, train)
    return done


def _encode(
    store: EpisodeStore,
    jobs: Sequence[LatentJob],
    done: EncodedDataset,
    *,
    workers: int,
    progress: EncodingProgress | None,
) -> None:
    """Make the shards and enter into `done` how many and how fast."""
    entries = {entry.id: entry for entry in store.index()}
    total = sum(entries[job.episode_id].stored_frames(job.view) for job in jobs)
    seconds, bare = 0.0, 0.0
    done.written = dict.fromkeys(done.keys, 0)
    with contextlib.closing(encode_episodes(jobs, workers=workers)) as made:
        for job, shard in made:
            done.frames += shard.frames
            done.written[job.view] += 1
            seconds += shard.seconds
            bare += shard.frames / shard.bare_frames_per_s
            done.frames_per_s = workers * done.frames / seconds
            done.bare_frames_per_s = workers * done.frames / bare
            if progress is not None:
                progress(done.frames, total, done.bare_frames_per_s)


def stats_path(root: Path, view: str, key: str, train: Mapping[str, str]) -> Path:
    """Where the statistics over these training episodes (id -> episode key) lie."""
    return root / "latents" / view / key / f"stats-{digest(dict(train))[:16]}.json"


def write_stats(root: Path, keys: Mapping[str, str], train: Sequence[EpisodeEntry]) -> None:
    """Per-channel statistics of the training episodes' latents, one file a view, once for each training set."""
    for view, key in keys.items():
        path = stats_path(root, view, key, {entry.id: entry.key for entry in train})
        if not path.is_file():
            stats = ChannelStats.over((open_latents(root, entry, view, key) for entry in train), channel_axis=1)
            shards.write_atomic(path, stats.to_json(view=view, key=key))
