"""A small dataset with every model trained on it, for a few steps: they know nothing, and load as any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.models.conftest import HEIGHT, STEPS, VIEWS, WIDTH, tiny_recipe
from tests.stored_episodes import add_episodes, write_split
from tests.stored_episodes import episode as random_episode
from tests.synthetic import card_frame
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.latent_runs import encode_dataset
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import parse_task
from vilp_data.types import Episode
from vilp_models.recipe import BcRecipe, PlannerRecipe, PolicyRecipe, load_recipe
from vilp_models.runs import default_run
from vilp_models.train import train_bc, train_planner, train_policy, train_vqgan

PRESET = "tiny"
N_ACTION_STEPS = 4
SPEC = "".join(f'[views.{view}]\ntopic = "/{view}"\nheight = {HEIGHT}\nwidth = {WIDTH}\n' for view in VIEWS)
SPEC = f"""name = "cards"
{SPEC}
[low_dim.arm]
topic = "/arm"
fields = ["position"]
[action.move]
topic = "/act"
fields = ["x", "y"]
[window]
n_plan_frames = 2
frame_stride = 2
[models.planner]
low_dim = false
width = 8
groups = 8
head_size = 8
steps = 2
warmup_steps = 0
[models.policy]
reconstructed_share = 0.5
steps = 2
warmup_steps = 0
[models.bc]
steps = 2
warmup_steps = 0
[models.vilp]
n_action_steps = {N_ACTION_STEPS}
"""


class TrainedCards(NamedTuple):
    """The dataset and its task; its runs are those of `PRESET`. Planners see no low_dim; the low-level policy sees reconstructions."""

    root: Path
    spec: TaskSpec

    def run(self, model: str) -> Path:
        return default_run(self.root, model, PRESET)


def card_episode(name: str, number: int) -> Episode:
    """The colour card, its marker starting elsewhere in each; low_dim and actions are random, the simulator's state counts."""
    front = np.stack([card_frame(i + 3 * number, HEIGHT, WIDTH) for i in range(STEPS)])
    index = dict.fromkeys(VIEWS, np.arange(STEPS, dtype=np.int32))
    frames, state = {"front": front, "side": 255 - front}, np.arange(2.0 * STEPS).reshape(STEPS, 2)
    return replace(random_episode(name, STEPS), frames=frames, source_index=index, state=state)


def train_cards(root: Path) -> TrainedCards:
    """Six episodes, a VQGAN for both views, a planner each, a low-level policy and behaviour cloning."""
    cards = TrainedCards(root, parse_task(SPEC, where="test"))
    EpisodeStore(root).write_spec(cards.spec)
    add_episodes(root, *(card_episode(name, number) for number, name in enumerate("abcdef")))
    write_split(root, ratio=0.6)
    train_card_vqgan(cards, cards.run("vqgan"))
    encode_dataset(root, cards.spec, "vqgan", cards.run("vqgan"), workers=1)
    planner = load_recipe(PlannerRecipe, "planner", cards.spec.models, preset=PRESET, where="test")
    policy = load_recipe(PolicyRecipe, "policy", cards.spec.models, preset=PRESET, where="test")
    bc = load_recipe(BcRecipe, "bc", cards.spec.models, preset=PRESET, where="test")
    train_planner(root, cards.spec, planner, cards.run("planner"), vqgan=cards.run("vqgan"), show=False)
    train_policy(root, cards.spec, policy, cards.run("policy"), vqgan=cards.run("vqgan"), show=False)
    train_bc(root, cards.spec, bc, cards.run("bc"), n_action_steps=N_ACTION_STEPS, show=False)
    return cards


def train_card_vqgan(cards: TrainedCards, run: Path, *, seed: int = 0) -> None:
    recipe, ids = tiny_recipe(share_views=True, seed=seed), read_split(cards.root).ids("train")
    train_vqgan(cards.root, cards.spec, recipe, run, train_episodes=ids, split_hash="", show=False)
