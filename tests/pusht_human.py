"""Human Push-T demonstrations as episodes, read straight from their zarr store: what ingest should make of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import zarr

from tests.real_data import real_data
from vilp_data.types import Episode

N_EPISODES = 206


def simulator() -> Any:
    """A fresh Push-T, as a task's `sim.env` makes it; skips where the simulators are not installed."""
    pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")
    from vilp_data.spec import load_task
    from vilp_models.rollout import make_env

    return make_env(load_task("pusht"))


@cache
def human_episode(number: int) -> Episode:
    """Demonstration `number` of 0…205; skips where the data set is absent."""
    store = zarr.open(real_data("pusht/pusht_cchi_v7_replay.zarr"), mode="r")
    ends = np.asarray(store["meta/episode_ends"])
    rows = slice(int(ends[number - 1]) if number else 0, int(ends[number]))
    frames = np.asarray(store["data/img"][rows])
    state = np.asarray(store["data/state"][rows])
    steps = len(state)
    return Episode(
        id=f"episode_{number:03d}",
        frames={"top": frames.astype(np.uint8)},
        source_index={"top": np.arange(steps, dtype=np.int32)},
        log_time_ns=np.arange(steps, dtype=np.int64) * 100_000_000,
        low_dim=state[:, :2],
        action=np.asarray(store["data/action"][rows]),
        state=state.astype(np.float64),
        valid=np.ones(steps, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="unknown",
    )
