"""Latents by the real encoder, in processes of their own: how many there are, and when they die, changes no byte."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.faults import run_until_killed, tree
from tests.models.conftest import VIEWS, tiny_recipe
from vilp_data import latents
from vilp_data.episodes import EpisodeStore
from vilp_data.latent_runs import encode_dataset
from vilp_models.checkpoint import Checkpoint, RunState, run_folder, save_checkpoint
from vilp_models.vqgan import build_vqgan


@pytest.fixture
def run_dir(store: EpisodeStore) -> Path:
    """A run with random weights."""
    recipe = tiny_recipe()
    torch.manual_seed(0)
    model = {name: tensor.numpy() for name, tensor in build_vqgan(recipe).state_dict().items()}
    run_dir = store.root / "runs" / "vqgan-random"
    state = RunState(recipe.steps, recipe.steps, VIEWS, "s", {})
    save_checkpoint(run_folder(run_dir, VIEWS), Checkpoint(model, {}, recipe.model_dump(mode="json"), state))
    return run_dir


def _encoded(store: EpisodeStore, run_dir: Path, *, workers: int) -> dict[str, bytes]:
    for path in (store.root / "latents").rglob("*.safetensors"):
        path.unlink()
    latents._encoders.clear()
    encode_dataset(store.root, store.spec(), "vqgan", run_dir, workers=workers)
    return tree(store.root / "latents")


def test_one_worker_and_two_write_the_same_bytes_and_this_process_keeps_its_threads(
    store: EpisodeStore, run_dir: Path
) -> None:
    torch.set_num_threads(2)
    one = _encoded(store, run_dir, workers=1)
    assert len(one) == 2 * len(store.index())
    assert torch.get_num_threads() == 2
    assert _encoded(store, run_dir, workers=2) == one
    assert torch.get_num_threads() == 2


KILLED_AFTER_THE_FIRST_SHARD = """
import os, signal, sys
from pathlib import Path
from vilp_data.episodes import EpisodeStore
from vilp_data.latent_runs import encode_dataset

if __name__ == "__main__":
    store = EpisodeStore(Path(sys.argv[1]))
    die = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    encode_dataset(store.root, store.spec(), "vqgan", Path(sys.argv[2]), workers=2, progress=die)
"""


def test_two_workers_die_with_their_parent_and_the_next_call_makes_what_is_missing(
    store: EpisodeStore, run_dir: Path
) -> None:
    assert run_until_killed(KILLED_AFTER_THE_FIRST_SHARD, [str(store.root), str(run_dir)], nth=10**9)
    assert 1 <= len(list((store.root / "latents").rglob("[!.]*.safetensors"))) < 2 * len(store.index())
    latents._encoders.clear()
    encode_dataset(store.root, store.spec(), "vqgan", run_dir, workers=2)
    after_the_kill = tree(store.root / "latents")
    assert after_the_kill == _encoded(store, run_dir, workers=1)
