"""All latents of a dataset under one trained encoder: which are missing, made, and summed up in statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy.typing as npt

from vilp_data import shards
from vilp_data.dataset_split import find_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.keys import digest
from vilp_data.latents import encode_episodes, latents_path, load_encoder, missing_latents
from vilp_data.spec import TaskSpec
from vilp_data.stats import ChannelStats


@dataclass
class EncodedDataset:
    """What `encode_dataset` found and did.

    keys       view -> the encoder's key, the name of the folder under latents/<view>/
    shards     view -> how many there are now; written: how many of them are new
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


def find_run(root: Path, given: Path | None, encoder_name: str) -> Path:
    """The folder of the trained encoder: the one given, else the only `runs/<encoder_name>*` of the dataset."""
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
            remedy=f"name one with --run, or train one with `vilp-models train {encoder_name}`",
        )
    return runs[0]


def encode_dataset(
    root: Path,
    spec: TaskSpec,
    encoder_name: str,
    run_dir: Path,
    *,
    workers: int,
    progress: Callable[[int, int, float], None] | None = None,
) -> EncodedDataset:
    """Make every latent shard that is missing or stale under the encoder of `run_dir`, then the training statistics.

    `progress(frames done, frames in all, bare frames/s)`. Raises what the encoder's loading and the stores raise."""
    store = EpisodeStore(root)
    encoders = {view: load_encoder(encoder_name, run_dir, view) for view in sorted(spec.views)}
    for view, view_spec in spec.views.items():
        encoders[view].latent_shape(view_spec.height, view_spec.width)
    done = EncodedDataset({view: encoder.key for view, encoder in encoders.items()})
    with shards.writer_lock(root):
        entries = {entry.id: entry for entry in store.index()}
        jobs = missing_latents(store, encoder_name, run_dir, done.keys)
        total = sum(entries[job.episode_id].n_frames[job.view] for job in jobs)
        workers = max(1, min(workers, len(jobs)))
        seconds, bare = 0.0, 0.0
        done.written = dict.fromkeys(done.keys, 0)
        for job, shard in encode_episodes(jobs, workers=workers):
            done.frames += shard.frames
            done.written[job.view] += 1
            seconds += shard.seconds
            bare += shard.frames / shard.bare_frames_per_s
            if progress is not None:
                progress(done.frames, total, workers * done.frames / bare)
        if seconds:
            done.frames_per_s = workers * done.frames / seconds
            done.bare_frames_per_s = workers * done.frames / bare
        done.shards = dict.fromkeys(done.keys, len(entries))
        train = training_episodes(store)
        done.unseen = tuple(
            id for id in train if any(entries[id].key not in encoder.trained_on for encoder in encoders.values())
        )
        if train:
            write_stats(root, done.keys, {id: entries[id].key for id in train})
    return done


def training_episodes(store: EpisodeStore) -> list[str]:
    """Stored episodes on the training side; none without a split."""
    split = find_split(store.root)
    present = {entry.id for entry in store.index()}
    return [episode for episode in split.ids("train") if episode in present] if split else []


def stats_path(root: Path, view: str, key: str, train: Mapping[str, str]) -> Path:
    """Where the statistics over these training episodes (id -> episode key) lie."""
    return root / "latents" / view / key / f"stats-{digest(dict(train))[:16]}.json"


def write_stats(root: Path, keys: Mapping[str, str], train: Mapping[str, str]) -> None:
    """Per-channel statistics of the training episodes' latents, one file a view, once for each training set."""
    for view, key in keys.items():
        path = stats_path(root, view, key, train)
        if not path.is_file():
            stats = ChannelStats.over(_latents(root, view, key, list(train)), channel_axis=1)
            shards.write_atomic(path, stats.to_json(view=view, key=key))


def _latents(root: Path, view: str, key: str, episodes: list[str]) -> Iterator[npt.NDArray[Any]]:
    for episode in episodes:
        yield shards.open_shard(latents_path(root, view, key, episode)).arrays["latents"]
