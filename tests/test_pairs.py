"""PairDataset over a small store, against the episodes it was written from."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.stored_episodes import KEYS, VIEWS, add_episodes, episode, write_dataset
from vilp_data import shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SplitError, StoreError, UsageError
from vilp_data.latents import latents_path
from vilp_data.loader import Loader
from vilp_data.pairs import PairDataset, PairTensors

EPISODES = (
    episode("a", 12),
    episode("b", 9, with_action=False),
    episode("c", 20, invalid=(7, 8, 15)),
    episode("d", 3),
    episode("e", 2),
)
ACTING = tuple(one for one in EPISODES if one.action is not None)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, *EPISODES)
    return tmp_path


def opened(root: Path, split: str = "all", **options: object) -> PairDataset:
    settings = {"latent_keys": KEYS, "frame_stride": 2} | options
    return PairDataset(root, split=split, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("stride", [1, 2, 5])
def test_every_pair_holds_what_the_episode_holds(root: Path, stride: int) -> None:
    dataset = opened(root, frame_stride=stride)
    assert dataset.episode_ids == [one.id for one in ACTING]
    expected = [
        (number, k)
        for number, one in enumerate(ACTING)
        for k in range(one.n_steps)
        if k + stride < one.n_steps and one.valid[k : k + stride + 1].all()
    ]
    batch = dataset.read(range(len(dataset)))
    assert list(zip(batch.episode.tolist(), batch.step.tolist(), strict=True)) == expected
    for row, (number, k) in enumerate(expected):
        one = EpisodeStore(root).read(ACTING[number].id)
        assert one.action is not None
        np.testing.assert_array_equal(batch.low_dim[row], one.low_dim[k])
        np.testing.assert_array_equal(batch.action[row], one.action[k : k + stride])
        for view in VIEWS:
            stored = shards.read_shard(latents_path(root, view, KEYS[view], one.id)).arrays["latents"]
            for place, step in enumerate((k, k + stride)):
                frame = one.source_index[view][step]
                np.testing.assert_array_equal(batch.frames[view][row, place], one.frames[view][frame])
                np.testing.assert_array_equal(batch.latents[view][row, place], stored[frame])


def test_values_are_handed_out_as_stored(root: Path) -> None:
    batch = opened(root).read([0, 3, 1])
    for view in VIEWS:
        assert (batch.frames[view].dtype, tuple(batch.frames[view].shape)) == (torch.uint8, (3, 2, 8, 16, 3))
        assert (batch.latents[view].dtype, tuple(batch.latents[view].shape)) == (torch.float16, (3, 2, 3, 2, 4))
    assert (batch.low_dim.dtype, tuple(batch.low_dim.shape)) == (torch.float32, (3, 4))
    assert (batch.action.dtype, tuple(batch.action.shape)) == (torch.float32, (3, 2, 2))


def test_all_views_and_no_latents_unless_told_otherwise(root: Path) -> None:
    batch = PairDataset(root, split="all", frame_stride=2).read([0])
    assert list(batch.frames) == sorted(VIEWS)
    assert batch.latents == {}
    assert opened(root, with_frames=False).read([0]).frames == {}
    assert list(opened(root, views=("side",), latent_keys={"front": "key-a"}).read([0]).frames) == ["side"]


def test_a_batch_keeps_the_order_it_was_asked_in(root: Path) -> None:
    dataset = opened(root)
    numbers = [5, 0, 11, 5, 2]
    batch = dataset.read(numbers)
    for row, number in enumerate(numbers):
        assert_equal(batch.map(lambda tensor, row=row: tensor[row : row + 1]), dataset[number])


def test_the_two_sides_share_no_episode_and_cover_those_with_actions(root: Path) -> None:
    train, val = opened(root, "train"), opened(root, "val")
    assert sorted(train.episode_ids + val.episode_ids) == [one.id for one in ACTING]
    assert len(train) + len(val) == len(opened(root))


def test_a_loader_reads_every_pair_once_an_epoch(root: Path) -> None:
    dataset = opened(root)
    seen = [
        pair
        for batch in Loader(dataset, batch_size=5, seed=3, drop_last=False)
        for pair in zip(batch.episode.tolist(), batch.step.tolist(), strict=True)
    ]
    batch = dataset.read(range(len(dataset)))
    assert sorted(seen) == list(zip(batch.episode.tolist(), batch.step.tolist(), strict=True))
    assert seen != sorted(seen)


def test_a_worker_process_gets_a_dataset_that_works(root: Path) -> None:
    dataset = opened(root)
    before = dataset.read([0, 7])
    assert_equal(pickle.loads(pickle.dumps(dataset)).read([0, 7]), before)


def test_no_episode_with_actions_says_so(tmp_path: Path) -> None:
    write_dataset(tmp_path, episode("silent", 9, with_action=False), episode("mute", 7, with_action=False))
    with pytest.raises(StoreError, match=r"no episode has actions(.|\n)*none among 2(.|\n)*\[action\]"):
        opened(tmp_path)
    with pytest.raises(StoreError, match=r"none among 1 on the val side"):
        opened(tmp_path, "val")


def test_tags_that_no_episode_with_actions_has_are_not_blamed_on_the_logs(root: Path) -> None:
    with pytest.raises(StoreError, match=r"and goal = moon(.|\n)*-> ask for other tags, or none$"):
        opened(root, where={"goal": "moon"})
    with pytest.raises(StoreError, match=r"-> ask for other tags, or none, or draw .*`vilp-data split --redraw`$"):
        opened(root, "val", where={"goal": "moon"})


def test_a_stride_longer_than_every_episode_is_refused(root: Path) -> None:
    with pytest.raises(StoreError, match=r"at most 20 steps(.|\n)*frame_stride"):
        opened(root, frame_stride=20)


def test_an_unknown_view_or_key_is_refused(root: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'front'"):
        opened(root, views=("frnt",))
    with pytest.raises(StoreError, match="vilp-data latents"):
        opened(root, latent_keys={"front": "no-such-key"})


def test_an_episode_without_a_side_names_the_command(root: Path) -> None:
    add_episodes(root, episode("new", 9))
    with pytest.raises(SplitError, match=r"such as new(.|\n)*vilp-data split"):
        opened(root, "train")


@pytest.mark.parametrize("number", [-1, 10_000])
def test_a_pair_that_does_not_exist_is_an_index_error(root: Path, number: int) -> None:
    with pytest.raises(IndexError):
        opened(root)[number]


def assert_equal(a: PairTensors, b: PairTensors) -> None:
    for name in ("frames", "latents"):
        assert getattr(a, name).keys() == getattr(b, name).keys()
        for view, tensor in getattr(a, name).items():
            assert torch.equal(tensor, getattr(b, name)[view])
    for name in ("low_dim", "action", "episode", "step"):
        assert torch.equal(getattr(a, name), getattr(b, name))
