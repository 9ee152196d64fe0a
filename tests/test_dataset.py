"""WindowDataset over a small store, against the episodes it was written from."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.stored_episodes import KEYS, VIEWS, add_episodes, episode, write_dataset, write_latents
from vilp_data import shards
from vilp_data.dataset import WindowDataset, WindowTensors
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import NoWindowError, SplitError, StoreError, UsageError
from vilp_data.latents import latents_path
from vilp_data.spec import WindowSpec
from vilp_data.split_lock import Side, SplitLock, assignment_hash
from vilp_data.types import Episode

WINDOW = WindowSpec(n_plan_frames=3, frame_stride=2, max_goal_frames=2)

EPISODES = (
    episode("a", 12),
    episode("b", 9, with_action=False),
    episode("c", 20, invalid=(7,)),
    episode("d", 3),
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, *EPISODES)
    return tmp_path


def opened(root: Path, split: str = "all", **options: object) -> WindowDataset:
    settings = {"latent_keys": KEYS, "window": WINDOW} | options
    return WindowDataset(root, split=split, **settings)  # type: ignore[arg-type]


def windows_of(one: Episode) -> list[int]:
    """First steps, by the rule: 3 frames 2 steps apart, 2 of them may repeat the last, no invalid step in between."""
    last = one.n_steps - 1
    return [
        t
        for t in range(one.n_steps)
        if sum(t + 2 * i > last for i in (1, 2, 3)) <= 2 and one.valid[t : min(t + 6, last) + 1].all()
    ]


def test_every_window_holds_what_the_episode_holds(root: Path) -> None:
    dataset = opened(root)
    expected = [(number, step) for number, one in enumerate(EPISODES) for step in windows_of(one)]
    assert len(dataset) == len(expected)
    batch = dataset.read(range(len(dataset)))
    for row, (number, t) in enumerate(expected):
        one, last = EPISODES[number], EPISODES[number].n_steps - 1
        assert (int(batch.episode[row]), int(batch.step[row])) == (number, t)
        assert dataset.episode_ids[number] == one.id
        planned = [min(t + 2 * i, last) for i in (1, 2, 3)]
        assert batch.latent_mask[row].tolist() == [t + 2 * i <= last for i in (1, 2, 3)]
        for view in VIEWS:
            stored = shards.read_shard(latents_path(root, view, KEYS[view], one.id)).arrays["latents"]
            np.testing.assert_array_equal(batch.latents[view][row], stored[one.source_index[view][planned]])
            np.testing.assert_array_equal(batch.present_latents[view][row], stored[one.source_index[view][t]])
            np.testing.assert_array_equal(batch.frames[view][row], one.frames[view][one.source_index[view][t]])
        np.testing.assert_array_equal(batch.low_dim[row], one.low_dim[t])
        recorded = [one.action is not None and k <= last for k in range(t, t + 6)]
        assert batch.action_mask[row].tolist() == recorded
        assert batch.action is not None
        rest = 6 - sum(recorded)
        if one.action is not None:
            np.testing.assert_array_equal(batch.action[row, : sum(recorded)], one.action[t : t + sum(recorded)])
        assert (batch.action[row, 6 - rest :] == 0).all()


def test_values_are_handed_out_as_stored(root: Path) -> None:
    batch = opened(root).read([0, 3])
    assert {view: (t.dtype, tuple(t.shape)) for view, t in batch.frames.items()} == dict.fromkeys(
        VIEWS, (torch.uint8, (2, 8, 16, 3))
    )
    assert {view: (t.dtype, tuple(t.shape)) for view, t in batch.latents.items()} == dict.fromkeys(
        VIEWS, (torch.float16, (2, 3, 3, 2, 4))
    )
    assert {view: (t.dtype, tuple(t.shape)) for view, t in batch.present_latents.items()} == dict.fromkeys(
        VIEWS, (torch.float16, (2, 3, 2, 4))
    )
    assert batch.low_dim.dtype == torch.float32
    assert batch.action is not None
    assert batch.action.shape == (2, 6, 2)


def test_a_batch_keeps_the_order_it_was_asked_in(root: Path) -> None:
    dataset = opened(root)
    numbers = [5, 0, 11, 5, 2]
    batch = dataset.read(numbers)
    for row, number in enumerate(numbers):
        assert_equal(rows(batch, slice(row, row + 1)), dataset[number])


def test_batches_do_not_share_memory(root: Path) -> None:
    dataset = opened(root)
    first = dataset.read([0, 1])
    kept = first.frames["front"].clone()
    second = dataset.read([4, 5])
    second.frames["front"].zero_()
    assert torch.equal(first.frames["front"], kept)
    assert torch.equal(dataset.read([4]).frames["front"], dataset[4].frames["front"])


def test_the_two_sides_share_no_episode_and_cover_all(root: Path) -> None:
    train, val = opened(root, "train"), opened(root, "val")
    assert sorted(train.episode_ids + val.episode_ids) == [one.id for one in EPISODES]
    assert len(train) + len(val) == len(opened(root))


def test_frames_and_actions_can_be_left_out(root: Path) -> None:
    batch = opened(root, with_frames=False, with_actions=False).read([0, 1])
    assert batch.frames == {}
    assert batch.action is None
    assert not batch.action_mask.any()
    assert batch.latents.keys() == batch.present_latents.keys() == KEYS.keys()


def test_frames_need_no_latents(root: Path) -> None:
    with_latents = opened(root).read([0, 5])
    batch = opened(root, latent_keys={}, views=("side",)).read([0, 5])
    assert batch.latents == batch.present_latents == {}
    assert list(batch.frames) == ["side"]
    assert torch.equal(batch.frames["side"], with_latents.frames["side"])
    assert opened(root, latent_keys={"front": "key-a"}, views=VIEWS).read([0]).frames.keys() == set(VIEWS)


def test_one_view_reads_one_view(root: Path) -> None:
    batch = opened(root, latent_keys={"side": "key-b"}).read([0])
    assert list(batch.latents) == list(batch.frames) == ["side"]


def test_action_is_none_where_no_episode_has_any(root: Path) -> None:
    path = root / "split.lock.json"
    assignment: dict[str, Side] = {one.id: "val" if one.id == "b" else "train" for one in EPISODES}
    lock = replace(SplitLock.from_json(path.read_bytes()), assignment=assignment, hash=assignment_hash(assignment))
    shards.write_atomic(path, lock.to_json())
    dataset = opened(root, "val")
    assert dataset.episode_ids == ["b"]
    assert dataset.read([0]).action is None


def test_a_worker_process_gets_a_dataset_that_works(root: Path) -> None:
    dataset = opened(root)
    before = dataset.read([0, 7])
    assert_equal(pickle.loads(pickle.dumps(dataset)).read([0, 7]), before)


def test_a_torch_data_loader_takes_whole_batches(root: Path) -> None:
    dataset = opened(root)
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, collate_fn=lambda batch: batch)
    for start, batch in zip(range(0, len(dataset), 4), loader, strict=True):
        assert_equal(batch, dataset.read(range(start, min(start + 4, len(dataset)))))


@pytest.mark.gpu
def test_pinned_batches_hold_the_same_in_page_locked_memory(root: Path) -> None:
    dataset = opened(root)
    pinned = dataset.read([0, 7], pin_memory=True)
    assert pinned.frames["front"].is_pinned()
    assert pinned.low_dim.is_pinned()
    assert_equal(pinned.to("cuda").to("cpu"), dataset.read([0, 7]))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts descriptors in /proc")
def test_open_episodes_hold_no_file_descriptors(root: Path) -> None:
    dataset = opened(root)
    dataset.read([0])
    before = len(list(Path("/proc/self/fd").iterdir()))
    dataset.read(range(len(dataset)))
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_reading_leaves_the_maps_read_only(root: Path) -> None:
    dataset = opened(root)
    files = sorted((root / "episodes").rglob("*.safetensors"))
    before = [path.read_bytes() for path in files]
    dataset.read(range(len(dataset))).frames["front"].fill_(7)
    assert [path.read_bytes() for path in files] == before


@pytest.mark.parametrize("number", [-1, 10_000])
def test_a_window_that_does_not_exist_is_an_index_error(root: Path, number: int) -> None:
    with pytest.raises(IndexError):
        opened(root)[number]


def test_missing_latents_name_the_command(root: Path) -> None:
    latents_path(root, "side", "key-b", "c").unlink()
    with pytest.raises(StoreError, match=r"1 of 4 episodes are not encoded, such as c(.|\n)*vilp-data latents"):
        opened(root)


def test_stale_latents_name_the_command(root: Path) -> None:
    add_episodes(root, episode("a", 14))
    write_latents(root, "a", views=("front",))
    with pytest.raises(StoreError, match=r"key-b/a.safetensors: latents of other frames(.|\n)*vilp-data latents"):
        opened(root).read([0])


def test_latents_of_another_length_than_the_frames_are_refused(root: Path) -> None:
    path = latents_path(root, "side", "key-b", "a")
    shard = shards.read_shard(path)
    header = {"source_frames_sha256": shard.metadata["source_frames_sha256"]}
    shards.write_shard(path, {"latents": shard.arrays["latents"][:-1]}, header)
    with pytest.raises(StoreError, match=r"found: 5 latents of 6 frames(.|\n)*vilp-data latents"):
        opened(root).read([0])


def test_frames_of_another_episode_are_refused_and_name_the_command(root: Path) -> None:
    store = EpisodeStore(root)
    store.frames_path("front", "a").write_bytes(store.frames_path("front", "c").read_bytes())
    with pytest.raises(StoreError, match=r"front/a.safetensors: not the frames(.|\n)*vilp-data ingest"):
        opened(root).read([0])
    assert opened(root, with_frames=False).read([0]).frames == {}


def test_an_episode_ingested_anew_after_opening_is_not_read_as_the_old_one(root: Path) -> None:
    dataset = opened(root)
    add_episodes(root, replace(EPISODES[0], low_dim=EPISODES[0].low_dim + 1))
    with pytest.raises(StoreError, match=r"not the episode that the index knows(.|\n)*open the dataset again"):
        dataset.read([0])


@pytest.mark.parametrize(
    ("source_index", "says"),
    [
        (np.zeros(11, np.int32), "11 of source_index/front, 12 steps"),
        (np.full(12, 12, np.int32), "frames 12 to 12 of 12"),
    ],
)
def test_steps_that_do_not_fit_their_frames_are_refused(root: Path, source_index: np.ndarray, says: str) -> None:
    path = EpisodeStore(root).steps_path("a")
    shard = shards.read_shard(path)
    header = {name: value for name, value in shard.metadata.items() if name != "sha256"}
    shards.write_shard(path, {**shard.arrays, "source_index/front": source_index}, header)
    with pytest.raises(StoreError, match=rf"{says}(.|\n)*vilp-data ingest"):
        opened(root).read([0])


def test_an_unknown_key_or_view_is_refused(root: Path) -> None:
    with pytest.raises(StoreError, match="vilp-data latents"):
        opened(root, latent_keys={"front": "no-such-key"})
    with pytest.raises(UsageError, match="did you mean 'front'"):
        opened(root, latent_keys={"frnt": "key-a"})
    with pytest.raises(UsageError, match="did you mean 'side'"):
        opened(root, views=("sid",))


def test_no_split_names_the_command(root: Path) -> None:
    (root / "split.lock.json").unlink()
    with pytest.raises(SplitError, match="vilp-data split"):
        opened(root, "train")
    assert len(opened(root, "all")) > 0


def test_an_episode_without_a_side_names_the_command(root: Path) -> None:
    add_episodes(root, episode("new", 9))
    write_latents(root, "new")
    with pytest.raises(SplitError, match=r"such as new(.|\n)*vilp-data split"):
        opened(root, "train")


def test_a_split_changed_by_hand_is_refused(root: Path) -> None:
    path = root / "split.lock.json"
    path.write_bytes(path.read_bytes().replace(b'"val"', b'"train"'))
    with pytest.raises(SplitError, match="changed by hand"):
        opened(root, "train")


def test_a_window_longer_than_every_episode_is_refused(root: Path) -> None:
    with pytest.raises(StoreError, match=r"at most 20 steps(.|\n)*frame_stride"):
        opened(root, window=WindowSpec(n_plan_frames=30, frame_stride=2, max_goal_frames=0))


def test_an_episode_of_another_image_size_is_refused(root: Path) -> None:
    odd = episode("odd", 12)
    add_episodes(root, replace(odd, frames={view: frames[:, :4] for view, frames in odd.frames.items()}))
    write_latents(root, "odd")
    dataset = opened(root)
    with pytest.raises(StoreError, match="odd: an episode of other shapes"):
        dataset.read(range(len(dataset)))


def rows(batch: WindowTensors, part: slice) -> WindowTensors:
    return batch.map(lambda tensor: tensor[part])


def assert_equal(a: WindowTensors, b: WindowTensors) -> None:
    for name in ("frames", "latents", "present_latents"):
        assert getattr(a, name).keys() == getattr(b, name).keys()
        for view, tensor in getattr(a, name).items():
            assert torch.equal(tensor, getattr(b, name)[view])
    for name in ("latent_mask", "low_dim", "action", "action_mask", "episode", "step"):
        assert torch.equal(getattr(a, name), getattr(b, name))


def test_only_episodes_with_actions_where_a_model_learns_actions(root: Path) -> None:
    assert opened(root).episode_ids == ["a", "b", "c", "d"]
    dataset = opened(root, acting=True)
    assert dataset.episode_ids == ["a", "c", "d"]
    batch = dataset.read(range(len(dataset)))
    assert set(batch.episode.tolist()) == {0, 1, 2}
    assert batch.action_mask[:, 0].all()
    write_dataset(root / "mute", *(episode(name, 9, with_action=False) for name in "bc"))
    with pytest.raises(NoWindowError, match="no window fits"):
        opened(root / "mute", acting=True)
