"""What a model says of its dataset, and how another dataset is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stored_episodes import KEYS, episode, write_dataset
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SplitError, StoreError, UsageError
from vilp_data.spec import TaskSpec
from vilp_data.stats import ChannelStats
from vilp_data.task_toml import task_from_dict
from vilp_models.checkpoint import (
    Checkpoint,
    RunState,
    load_run,
    read_state,
    refuse_trained_on_validation,
    save_checkpoint,
)
from vilp_models.contract import DataContract, moments


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, episode("a", 12, invalid=(3,)), episode("b", 9), episode("c", 10, with_action=False))
    return tmp_path


def _spec(**changes: Any) -> TaskSpec:
    views = {view: {"topic": f"/{view}", "height": 8, "width": 16} for view in ("side", "front")}
    vectors = {"low_dim": {"arm": {"topic": "/arm"}}, "action": {"target": {"topic": "/target", "unit": "m"}}}
    return task_from_dict({"name": "test", "views": views, **vectors, **changes}, where="test")


def _contract(root: Path, episodes: str = "ab", **options: Any) -> DataContract:
    train = [entry for entry in EpisodeStore(root).index() if entry.id in episodes]
    return DataContract.of(root, _spec(), train=train, latent_keys=KEYS, **options)


def test_it_says_what_the_dataset_is_and_survives_json(root: Path) -> None:
    contract = _contract(root, "abc")
    assert (contract.views, contract.rate_hz, contract.n_plan_frames) == (("front", "side"), 10.0, 6)
    assert contract.geometry["front"] == (8, 16, "")
    assert contract.latent_shapes == {"front": (3, 2, 4), "side": (3, 2, 4)}
    assert (contract.low_dim_size, contract.action_size) == (4, 2)
    assert contract.action[0]["part"] == "target"
    assert DataContract.from_json(json.loads(json.dumps(contract.to_json()))) == contract
    with pytest.raises(StoreError, match="views"):
        DataContract.from_json({})


def test_statistics_count_valid_steps_of_training_episodes_alone(root: Path) -> None:
    store, contract = EpisodeStore(root), _contract(root, "ac")
    a, c = store.read("a"), store.read("c")
    low_dim = np.concatenate([a.low_dim[a.valid], c.low_dim]).astype(np.float64)
    np.testing.assert_allclose(contract.normaliser["low_dim"]["mean"], low_dim.mean(axis=0))
    np.testing.assert_allclose(contract.normaliser["low_dim"]["std"], low_dim.std(axis=0))
    assert a.action is not None
    np.testing.assert_allclose(contract.normaliser["action"]["mean"], a.action[a.valid].mean(axis=0), rtol=1e-6)
    assert set(contract.normaliser) == {"latents/front", "latents/side", "low_dim", "action"}


def test_what_a_model_does_not_use_decides_nothing(root: Path) -> None:
    contract = _contract(root, plans=False, low_dim=False, action=False)
    assert (contract.n_plan_frames, contract.max_goal_frames) == (0, None)
    assert (contract.low_dim, contract.action_size) == ((), 0)
    assert set(contract.normaliser) == {"latents/front", "latents/side"}
    other = _spec(window={"n_plan_frames": 9, "max_goal_frames": 1})
    train = [entry for entry in EpisodeStore(root).index() if entry.id in "ab"]
    contract.require_same(contract.now(root, other, train), where="run")


def test_what_an_older_checkpoint_did_not_record_is_not_compared(root: Path) -> None:
    table = _contract(root).to_json()
    del table["max_goal_frames"]
    older, now = DataContract.from_json(table), _contract(root)
    older.require_same(now, where="run")
    older.require_same(older.as_said_by(_spec(window={"max_goal_frames": 1})), where="run")
    with pytest.raises(UsageError, match="max_goal_frames 6 in the model, 1"):
        now.require_same(now.as_said_by(_spec(window={"max_goal_frames": 1})), where="run")


def test_a_channel_that_never_changes_stays_in_its_unit() -> None:
    table = moments(ChannelStats.of(np.array([[5.0, 1.0, 1e6], [5.0, 3.0, 1e6 + 1e-3]])))
    assert table["std"] == [1.0, 1.0, 1.0]
    assert table["mean"][:2] == [5.0, 2.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": "other"}, r"another task(.|\n)*task test in the model, other in the dataset"),
        ({"geometry": {"front": (8, 32, "")}}, r"geometry(.|\n)*front: 8, 16.*8, 32"),
        ({"rate_hz": 20.0}, r"control rate(.|\n)*10.0 in the model, 20.0"),
        ({"frame_stride": 4}, r"frame_stride 2 in the model, 4(.|\n)*set frame_stride = 2"),
        ({"n_plan_frames": 7}, r"n_plan_frames 6(.|\n)*set n_plan_frames = 6"),
        ({"max_goal_frames": 2}, r"max_goal_frames 6 in the model, 2(.|\n)*set max_goal_frames = 6"),
        (
            {"latent_keys": {"front": "key-x", "side": "key-b"}},
            r"another VQGAN(.|\n)*front: key-a in the model, front: key-x(.|\n)*vilp-data latents --run(.|\n)*train planner --restart",
        ),
        ({"views": ("front",)}, r"other views(.|\n)*front, side in the model, front in"),
        ({"action_size": 3}, "another size of actions"),
    ],
)
def test_another_dataset_is_refused_in_words(root: Path, change: dict[str, Any], words: str) -> None:
    contract = _contract(root)
    contract.require_same(_contract(root), where="run")
    with pytest.raises(UsageError, match=words):
        contract.require_same(replace(contract, **change), where="run", model="planner")


def test_another_normaliser_is_refused_and_rounding_is_not(root: Path) -> None:
    contract = _contract(root)
    row = contract.normaliser["low_dim"]
    near = {"mean": [value + 1e-9 for value in row["mean"]], "std": row["std"]}
    contract.require_same(replace(contract, normaliser={**contract.normaliser, "low_dim": near}), where="run")
    with pytest.raises(UsageError, match=r"another normaliser(.|\n)*±"):
        contract.require_same(_contract(root, "b"), where="run")


def test_missing_latents_and_missing_actions_are_named(root: Path) -> None:
    train = EpisodeStore(root).index()
    with pytest.raises(StoreError, match=r"latents are missing(.|\n)*vilp-data latents"):
        DataContract.of(root, _spec(), train=train, latent_keys={"front": "key-none"})
    with pytest.raises(UsageError, match="no training episode has actions"):
        _contract(root, "c")


def _run(folder: Path, contract: DataContract | None, *, model: str = "policy", step: int = 3) -> Path:
    table = None if contract is None else contract.to_json()
    state = RunState(step, 3, ("front", "side"), "s", {"a": "key-a"}, model, table)
    save_checkpoint(folder, Checkpoint({"w": np.ones(2, np.float32)}, {}, {"seed": 1}, state))
    return folder


def test_a_run_is_loaded_by_its_kind(root: Path, tmp_path: Path) -> None:
    contract = _contract(root)
    trained = load_run(_run(tmp_path / "run", contract), "policy")
    assert (trained.recipe, trained.contract, trained.state.step) == ({"seed": 1}, contract, 3)
    assert trained.arrays["w"].tolist() == [1.0, 1.0]
    with pytest.raises(UsageError, match=r"not a planner(.|\n)*policy"):
        load_run(tmp_path / "run", "planner")
    with pytest.raises(UsageError, match="vilp-models train policy"):
        load_run(tmp_path / "nothing", "policy")
    unfinished = _run(tmp_path / "half", contract, step=2)
    with pytest.raises(UsageError, match="step 2 of 3"):
        load_run(unfinished, "policy")
    assert load_run(unfinished, "policy", unfinished=True).state.step == 2


def test_a_model_is_not_judged_by_what_it_was_trained_on(root: Path, tmp_path: Path) -> None:
    state = read_state(_run(tmp_path / "run", _contract(root)))
    assert state is not None
    entries = EpisodeStore(root).index()
    refuse_trained_on_validation(state, [entry for entry in entries if entry.id != "a"], where=tmp_path)
    with pytest.raises(SplitError, match=r"policy was trained on 1 of(.|\n)*found: a(.|\n)*train policy --restart"):
        refuse_trained_on_validation(state, entries, where=tmp_path)
    other_name = [replace(entry, id="z", key="key-a") for entry in entries if entry.id == "b"]
    with pytest.raises(SplitError, match="found: z"):
        refuse_trained_on_validation(state, other_name, where=tmp_path)
