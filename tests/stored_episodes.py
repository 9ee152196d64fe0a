"""A small dataset folder written directly: episodes of random content, latents, a split. For tests of what reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vilp_data import shards
from vilp_data.dataset_split import split_episodes
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.keys import FORMAT_VERSION
from vilp_data.latents import latents_path
from vilp_data.split import draw_split
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Episode

VIEWS = ("front", "side")
KEYS = {"front": "key-a", "side": "key-b"}


def episode(name: str, n_steps: int, *, with_action: bool = True, invalid: tuple[int, ...] = ()) -> Episode:
    """Random content; the side camera runs at half rate, so that its stored frames are not its steps."""
    rng = np.random.default_rng([n_steps, *name.encode()])
    source_index = {"front": np.arange(n_steps, dtype=np.int32), "side": (np.arange(n_steps) // 2).astype(np.int32)}
    valid = np.ones(n_steps, np.bool_)
    valid[list(invalid)] = False
    return Episode(
        id=name,
        frames={
            view: rng.integers(0, 256, (index[-1] + 1, 8, 16, 3), dtype=np.uint8)
            for view, index in source_index.items()
        },
        source_index=source_index,
        log_time_ns=np.arange(n_steps, dtype=np.int64),
        low_dim=rng.standard_normal((n_steps, 4)).astype(np.float32),
        action=rng.standard_normal((n_steps, 2)).astype(np.float32) if with_action else None,
        state=None,
        valid=valid,
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="success",
    )


def write_latents(root: Path, name: str, *, views: tuple[str, ...] = VIEWS) -> None:
    entry = EpisodeStore(root).entry(name)
    for view in views:
        latents = np.random.default_rng(len(name)).standard_normal((entry.n_frames[view], 3, 2, 4)).astype(np.float16)
        header = {"format": str(FORMAT_VERSION), "source_frames_sha256": entry.frames_sha256[view]}
        shards.write_shard(latents_path(root, view, KEYS[view], name), {"latents": latents}, header)


def write_split(root: Path, *, ratio: float = 0.5) -> None:
    known = split_episodes(EpisodeStore(root), None, ())
    episodes = [replace(episode, thumbnails=None) for episode in known]  # of random frames: nothing looks alike
    shards.write_atomic(root / "split.lock.json", draw_split(episodes, ratio=ratio, seed=0).to_json())


def add_episodes(root: Path, *episodes: Episode) -> None:
    store = EpisodeStore(root)
    for one in episodes:
        store.write(one, Origin("test", "", one.id, f"key of {one.id}", {}))
    store.write_index()


def write_dataset(root: Path, *episodes: Episode) -> None:
    """The spec, these episodes, their latents, and a split."""
    views = {view: {"topic": f"/{view}", "height": 8, "width": 16} for view in VIEWS}
    EpisodeStore(root).write_spec(task_from_dict({"name": "test", "views": views}, where="test"))
    add_episodes(root, *episodes)
    for one in episodes:
        write_latents(root, one.id)
    write_split(root)
