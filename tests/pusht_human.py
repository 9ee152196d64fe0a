"""Human Push-T demonstrations, assembled from their zarr store as ingest does it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import pytest

from tests.real_data import real_data
from vilp_data.assemble import assemble_episode
from vilp_data.sources import open_log
from vilp_data.task_toml import load_task
from vilp_data.types import Episode

N_EPISODES = 206


def simulator() -> Any:
    """A fresh Push-T, as the task's `sim.env` makes it; skips where the simulators are not installed."""
    pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")
    from vilp_models.simulator import make_env

    return make_env(load_task("pusht"))


@lru_cache(maxsize=4)
def human_episode(number: int) -> Episode:
    """Demonstration `number` of 0…205; skips where the data set is absent."""
    with open_log(real_data("pusht/pusht_cchi_v7_replay.zarr"), array_rate_hz=10.0) as log:
        demonstration = log.episodes()[number]
        return assemble_episode(log, demonstration, load_task("pusht"), episode_id=demonstration.name)
