"""Where episodes begin: never at a start that was trained on without being told, and at any recorded state whatever its tags say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the simulators are not installed: make setup")

from tests.models.toy_simulator import Dot, dot_task
from tests.stored_episodes import add_episodes, episode, write_dataset
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_models.starts import episode_starts, seed_starts, tagged_seed, unseen_starts

SEEDS = {"a": "1000", "b": "1001", "c": "1002", "d": "1003", "e": "1004", "f": "1005"}


def recorded(root: Path, seeds: Mapping[str, str], **tags: str) -> EpisodeStore:
    """Episodes with these seeds, and a split: three of each six train."""
    write_dataset(root, *(replace(episode(id, 6), tags={"seed": seed, **tags}) for id, seed in seeds.items()))
    store = EpisodeStore(root)
    store.write_spec(dot_task())
    return store


def test_starts_of_training_episodes_are_refused_by_name(tmp_path: Path) -> None:
    store = recorded(tmp_path, SEEDS)
    trained = read_split(tmp_path).ids("train")
    with pytest.raises(UsageError) as refused:
        unseen_starts(store, dot_task(), range(990, 1050))
    for id in trained:
        assert f"seed {SEEDS[id]} ({id})" in str(refused.value)
    assert "--seeds 100000:100050" in str(refused.value)
    for id in trained:
        with pytest.raises(UsageError):
            unseen_starts(store, dot_task(), [int(SEEDS[id])])


def test_other_starts_are_the_simulators(tmp_path: Path) -> None:
    store = recorded(tmp_path, SEEDS)
    validating = [int(SEEDS[id]) for id in read_split(tmp_path).ids("val")]
    for seeds in (range(1000), range(1006, 10**15, 10**14), validating):
        assert unseen_starts(store, dot_task(), seeds) == seed_starts(seeds)


def test_starts_of_another_world_were_not_trained_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dot, "tags", lambda self: {"object": "gray"}, raising=False)
    store = recorded(tmp_path / "purple", SEEDS, object="purple")
    assert len(unseen_starts(store, dot_task(), range(1000, 1006))) == 6
    store = recorded(tmp_path / "gray", SEEDS, object="gray")
    with pytest.raises(UsageError, match="training episodes were recorded from these starts"):
        unseen_starts(store, dot_task(), range(1000, 1006))


def test_without_a_split_nothing_was_trained_on(tmp_path: Path) -> None:
    store = EpisodeStore(tmp_path)
    store.write_spec(dot_task())
    add_episodes(tmp_path, replace(episode("a", 6), tags={"seed": "3"}))
    assert unseen_starts(store, dot_task(), range(5)) == seed_starts(range(5))


@pytest.mark.parametrize("text", ["blue", "", "-1", "1.5", "\u00b2", "1e3", "9" * 5000])
def test_a_recorded_state_is_begun_at_whatever_its_seed_is_said_to_be(text: str, tmp_path: Path) -> None:
    state = np.zeros((6, 2))
    add_episodes(tmp_path, replace(episode("a", 6), tags={"seed": text}, state=state))
    (start,), _ = episode_starts(EpisodeStore(tmp_path), "all")
    assert (start.reset_seed, start.state is not None) == (None, True)
    assert tagged_seed({"seed": "0001003"}) == 1003
    assert tagged_seed({}) is None
