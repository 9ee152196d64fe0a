"""Encoding a dataset's frames against the bare forward loop of the same encoder on the same thread.

    python benchmarks/bench_encode.py

The encoder is the Hanoi task's `cpu` network with untrained weights: its arithmetic is the same. Ours also reads and verifies the stored
frames, checks the latents, and writes shards with fsync. Both take turns; the ratio is of medians.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from vilp_data import latents
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.latents import LatentJob, encode_batches, encode_one
from vilp_data.task_toml import load_task
from vilp_data.types import U8, Episode
from vilp_models.recipe import vqgan_recipe
from vilp_models.vqgan import VqganEncoder, build_vqgan

EPISODES, FRAMES, REPEATS, HEIGHT, WIDTH = 4, 150, 5, 96, 160


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    encoder = VqganEncoder(
        build_vqgan(vqgan_recipe(load_task("hanoi", preset="cpu").models, preset="cpu", where="hanoi")), device="cpu"
    )
    latents.load_encoder = lambda name, run_dir, view: encoder  # type: ignore[assignment]
    folder = Path(tempfile.mkdtemp(prefix="vilp-bench-"))
    try:
        store = EpisodeStore(folder)
        frames = [write_episode(store, f"episode{i}", seed=i) for i in range(EPISODES)]
        jobs = [LatentJob(folder, "bench", folder, "front", encoder.key, f"episode{i}") for i in range(EPISODES)]
        encode_one(jobs[0])
        bare, ours = [], []
        for _ in range(REPEATS):
            start = time.perf_counter()
            for clip in frames:
                for _latents in encode_batches(encoder, clip):
                    pass
            bare.append(time.perf_counter() - start)
            start = time.perf_counter()
            for job in jobs:
                encode_one(job)
            ours.append(time.perf_counter() - start)
    finally:
        shutil.rmtree(folder)
    fast, slow = (EPISODES * FRAMES / statistics.median(times) for times in (bare, ours))
    print(f"encode, {EPISODES} x {FRAMES} frames {WIDTH}x{HEIGHT}, width 16, float32, one thread")
    print(f"  bare forward loop    {fast:8.0f} frames/s")
    print(f"  vilp-data latents    {slow:8.0f} frames/s   {slow / fast:.0%} of bare (aim: 90 %)")


def write_episode(store: EpisodeStore, episode_id: str, *, seed: int) -> U8:
    """An episode of random frames in the store; the frames as they lie in memory."""
    frames = np.random.default_rng(seed).integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    episode = Episode(
        id=episode_id,
        frames={"front": frames},
        source_index={"front": np.arange(FRAMES, dtype=np.int32)},
        log_time_ns=np.arange(FRAMES, dtype=np.int64) * 100_000_000,
        low_dim=np.zeros((FRAMES, 0), np.float32),
        action=None,
        state=None,
        valid=np.ones(FRAMES, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="unknown",
    )
    store.write(episode, Origin("bench", "", episode_id, "bench", {}))
    return frames


if __name__ == "__main__":
    main()
