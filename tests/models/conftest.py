"""A small episode store and a network that trains in a second, for every test of the models."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from tests.synthetic import card_frame
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import parse_task
from vilp_data.types import Episode
from vilp_models.frames import Clip, TrainingFrames
from vilp_models.recipe import VqganRecipe

if TYPE_CHECKING:
    from tests.models.trained_cards import TrainedCards

HEIGHT, WIDTH, STEPS = 32, 48, 12
VIEWS = ("front", "side")


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Sums in the same order every time: what bitwise comparisons need."""
    torch.set_num_threads(1)


def tiny_recipe(**changes: Any) -> VqganRecipe:
    """Trains in a second; no LPIPS, no discriminator unless asked for."""
    table: dict[str, Any] = {
        "width": 8, "multipliers": (1, 1, 2), "blocks": 1, "groups": 4, "codes": 32, "perceptual": "none",
        "discriminator_weight": 0.0, "steps": 6, "batch_size": 4, "learning_rate": 2e-3, "restart_every": 2,
    }  # fmt: skip
    return VqganRecipe(**{**table, **changes})


def card_frames(count: int = STEPS) -> TrainingFrames:
    """One clip of the colour card with its moving marker."""
    return TrainingFrames([Clip(np.stack([card_frame(i, HEIGHT, WIDTH) for i in range(count)]))])


@pytest.fixture
def spec() -> TaskSpec:
    views = "".join(f'[views.{v}]\ntopic = "/{v}"\nheight = {HEIGHT}\nwidth = {WIDTH}\n' for v in VIEWS)
    return parse_task('name = "card"\n' + views, where="test")


@pytest.fixture
def store(tmp_path: Path, spec: TaskSpec) -> EpisodeStore:
    """Four episodes a, b, c, d of two views; the card's marker starts elsewhere in each."""
    store = EpisodeStore(tmp_path / "dataset")
    store.write_spec(spec)
    for number, episode_id in enumerate("abcd"):
        store.write(_episode(episode_id, number), Origin(f"{episode_id}.mcap", "0" * 64, "0", f"key-{episode_id}", {}))
    return store


def _episode(episode_id: str, number: int) -> Episode:
    front = np.stack([card_frame(i + 3 * number, HEIGHT, WIDTH) for i in range(STEPS)])
    index = np.arange(STEPS, dtype=np.int32)
    return Episode(
        id=episode_id,
        frames={"front": front, "side": 255 - front},
        source_index=dict.fromkeys(VIEWS, index),
        log_time_ns=np.arange(STEPS, dtype=np.int64) * 100_000_000,
        low_dim=np.zeros((STEPS, 1), np.float32),
        action=None,
        state=None,
        valid=np.ones(STEPS, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="success",
    )


@pytest.fixture(scope="session")
def trained_cards(tmp_path_factory: pytest.TempPathFactory) -> TrainedCards:
    """Trained once for all tests: leave dataset and checkpoints as they are, or work on a copy of the folder."""
    from tests.models.trained_cards import train_cards

    torch.set_num_threads(1)
    return train_cards(tmp_path_factory.mktemp("cards"))


@pytest.fixture
def recipe() -> Callable[..., VqganRecipe]:
    return tiny_recipe
