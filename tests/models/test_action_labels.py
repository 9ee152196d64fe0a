"""Models that learn by an action set: from its episodes alone, by its weights and statistics; the same set when they are used."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.models.trained_cards import N_ACTION_STEPS, PRESET, TrainedCards
from vilp_data import shards
from vilp_data.action_set_lock import DIGITS, ActionSetLock
from vilp_data.action_sets import recipe_from_dict
from vilp_data.dataset_action_sets import lock_action_set, read_action_set, set_path
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import ActionSetError, StoreError, UsageError
from vilp_data.shards import read_shard, write_shard
from vilp_data.surgery.operations import relabel_episodes, remove_episodes
from vilp_models.action_labels import set_text
from vilp_models.checkpoint import FILE, checkpoint_digest, model_tensors, read_recipe, read_state
from vilp_models.evaluate import evaluate_policy
from vilp_models.policies.load import PolicyRequest, load_policy
from vilp_models.recipe import BcRecipe, PolicyRecipe
from vilp_models.runs import default_run, find_model_run
from vilp_models.starts import episode_starts
from vilp_models.train import train_bc, train_policy
from vilp_models.trained import load_bc, load_low_level

MODELS = ("policy", "bc")
VIEWS = "front+side"


@pytest.fixture
def cards(trained_cards: TrainedCards, tmp_path: Path) -> TrainedCards:
    """A copy to work on; two of its training episodes are gray."""
    shutil.copytree(trained_cards.root, tmp_path / "cards")
    cards = TrainedCards(tmp_path / "cards", trained_cards.spec)
    gray = read_split(cards.root).ids("train")[:2]
    relabel_episodes(cards.root, list("abcdef"), labels={"object": "purple"})
    relabel_episodes(cards.root, gray, labels={"object": "gray"})
    return cards


def lock(cards: TrainedCards, name: str = "small", **source: Any) -> ActionSetLock:
    sources = {"gray": {"where": {"object": "gray"}, **source}}
    if name != "small":
        sources["purple"] = {"where": {"object": "purple"}}
    return lock_action_set(cards.root, name, recipe_from_dict({"source": sources}, where="x"), given=name, redraw=True)


def train(
    cards: TrainedCards, model: str, action_set: str | None = "small", *, run: Path | None = None, **options: Any
) -> Path:
    """The folder of the run, trained to its end."""
    folder = run or default_run(cards.root, model, PRESET, action_set)
    table = read_recipe(cards.run(model) / VIEWS)
    settings = {"action_set": action_set, "show": False, "device": "cpu", **options}
    if model == "policy":
        recipe = PolicyRecipe.model_validate(table)
        train_policy(cards.root, cards.spec, recipe, folder, vqgan=cards.run("vqgan"), **settings)
    else:
        train_bc(
            cards.root, cards.spec, BcRecipe.model_validate(table), folder, n_action_steps=N_ACTION_STEPS, **settings
        )
    return folder / VIEWS


def tensors(run: Path) -> Mapping[str, np.ndarray]:
    return model_tensors(run)


def assert_same(one: Path, other: Path) -> None:
    a, b = tensors(one), tensors(other)
    assert a.keys() == b.keys()
    for name, tensor in a.items():
        np.testing.assert_array_equal(tensor, b[name], err_msg=name)


def differs(one: Path, other: Path) -> bool:
    return any(not np.array_equal(tensor, tensors(other)[name]) for name, tensor in tensors(one).items())


# --- what the others do cannot be learnt


POISONS = {"not a number": np.nan, "huge": 1e30, "other values": 7.0}


@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("model", MODELS)
def test_actions_of_other_episodes_change_no_weight(cards: TrainedCards, model: str, poison: str) -> None:
    """Not those of video-only episodes, nor those of validation; nor what they measured."""
    inside = lock(cards).episodes
    before = train(cards, model, run=cards.root / "runs" / "before")
    store = EpisodeStore(cards.root)
    for entry in store.index():
        if entry.id not in inside:
            path = store.steps_path(entry.id)
            steps = read_shard(path)
            arrays = {name: np.array(array) for name, array in steps.arrays.items()}
            arrays["action"][:], arrays["low_dim"][:] = POISONS[poison], POISONS[poison]
            write_shard(path, arrays, {name: value for name, value in steps.metadata.items() if name != "sha256"})
            assert not np.array_equal(store.read(entry.id).action, steps.arrays["action"])  # type: ignore[arg-type]
    assert_same(before, train(cards, model, run=cards.root / "runs" / "after"))


def test_the_poison_reaches_a_model_without_a_set(cards: TrainedCards) -> None:
    """So that the test above can fail."""
    store, (victim, *_) = EpisodeStore(cards.root), read_split(cards.root).ids("train")[2:]
    before = train(cards, "bc", None, run=cards.root / "runs" / "before")
    steps = read_shard(store.steps_path(victim))
    arrays = {**steps.arrays, "action": np.full_like(steps.arrays["action"], 7.0)}
    write_shard(store.steps_path(victim), arrays, {k: v for k, v in steps.metadata.items() if k != "sha256"})
    assert differs(before, train(cards, "bc", None, run=cards.root / "runs" / "after"))


@pytest.mark.parametrize("model", MODELS)
def test_no_steps_of_another_episode_are_even_opened(
    cards: TrainedCards, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside, opened = lock(cards).episodes, set()
    plain = shards.open_shard

    def watch(path: Path) -> Any:
        if path.parent.name == "steps":
            opened.add(path.name.removesuffix(".safetensors"))
        return plain(path)

    monkeypatch.setattr(shards, "open_shard", watch)
    train(cards, model)
    store, spec, run = EpisodeStore(cards.root), cards.spec, default_run(cards.root, model, PRESET, "small")
    if model == "bc":
        load_bc(store, spec, run, n_action_steps=N_ACTION_STEPS, action_set="small")
    else:
        encoders = PolicyRequest(cards.root, spec, PRESET, N_ACTION_STEPS).encoders()
        load_low_level(store, spec, run, encoders, action_set="small")
    assert opened == set(inside)


# --- what is learnt from


@pytest.mark.parametrize("model", MODELS)
def test_a_model_normalises_by_the_statistics_of_its_set(cards: TrainedCards, model: str) -> None:
    locked = lock(cards)
    run = train(cards, model)
    state = read_state(run)
    assert state is not None
    assert set(state.train_episodes) == set(locked.episodes)
    assert state.action_set == {"name": "small", "key": locked.key}
    np.testing.assert_array_equal(tensors(run)["action.mean"], locked.action.mean.astype(np.float32))
    np.testing.assert_array_equal(tensors(run)["action.std"], locked.action.std.astype(np.float32))
    without = tensors(cards.run(model) / VIEWS)["action.mean"]
    assert not np.array_equal(tensors(run)["action.mean"], without)


@pytest.mark.parametrize("model", MODELS)
def test_a_set_of_every_training_episode_gives_the_weights_of_no_set(cards: TrainedCards, model: str) -> None:
    everything = recipe_from_dict({"source": {"all": {}}}, where="x")
    lock_action_set(cards.root, "all", everything, given="x")
    run = train(cards, model, "all")
    assert_same(cards.run(model) / VIEWS, run)
    assert checkpoint_digest(run) != checkpoint_digest(cards.run(model) / VIEWS)


def test_weights_decide_what_is_learnt(cards: TrainedCards) -> None:
    lock(cards, "even")
    lock(cards, "uneven", weight=5)
    assert differs(train(cards, "bc", "even"), train(cards, "bc", "uneven"))


def test_how_often_training_goes_over_each_source_is_said(
    cards: TrainedCards, capsys: pytest.CaptureFixture[str]
) -> None:
    locked = lock(cards, "hybrid", weight=3)
    train(cards, "policy", "hybrid", show=True)
    said = capsys.readouterr().out
    recipe = PolicyRecipe.model_validate(read_recipe(cards.run("policy") / VIEWS))
    n_gray, n_purple = (10 * len(source.episodes) for source in locked.sources)  # pairs of 12 steps
    over = recipe.steps * recipe.batch_size / (3 * n_gray + n_purple)
    assert (
        f"policy hybrid {locked.key[:DIGITS]}: gray 2 episodes, {n_gray} samples, {3 * over:.3g} epochs; purple" in said
    )


# --- no set


@pytest.mark.parametrize("model", MODELS)
def test_without_a_set_a_checkpoint_says_nothing_of_one(cards: TrainedCards, model: str) -> None:
    header = shards.read_header(cards.run(model) / VIEWS / FILE).metadata
    assert "action_set" not in json.loads(header["state"])
    before = (cards.run(model) / VIEWS / FILE).read_bytes()
    lock(cards)
    train(cards, model, None)  # is trained already
    assert (cards.run(model) / VIEWS / FILE).read_bytes() == before


# --- the same set in use


def uses(cards: TrainedCards, model: str, run: Path, action_set: str | None) -> Any:
    """Load the model from a run's folder by the set of this name."""
    store = EpisodeStore(cards.root)
    if model == "bc":
        return load_bc(store, cards.spec, run, n_action_steps=N_ACTION_STEPS, action_set=action_set)
    encoders = PolicyRequest(cards.root, cards.spec, PRESET, N_ACTION_STEPS).encoders()
    return load_low_level(store, cards.spec, run, encoders, action_set=action_set)


@pytest.mark.parametrize("model", MODELS)
def test_a_model_of_another_set_is_refused_with_both_keys_and_the_command(cards: TrainedCards, model: str) -> None:
    then, now = lock(cards), lock(cards, "hybrid")
    run = train(cards, model).parent
    assert uses(cards, model, run, "small").action_set == {"name": "small", "key": then.key}
    assert uses(cards, model, run, None).action_set == {"name": "small", "key": then.key}
    command = f"vilp-models train {model} --set hybrid --restart"
    said = rf"found: small {then.key[:DIGITS]} in the model, hybrid {now.key[:DIGITS]} now(.|\n)*--set small(.|\n)*{command}"
    with pytest.raises(UsageError, match=said):
        uses(cards, model, run, "hybrid")
    with pytest.raises(UsageError, match=said):
        train(cards, model, "hybrid", run=run)
    with pytest.raises(UsageError, match=r"found: small \w+ in the model, no action set now"):
        train(cards, model, None, run=run)
    with pytest.raises(UsageError, match=r"found: no action set in the model, small \w+ now"):
        uses(cards, model, cards.run(model), "small")
    again = lock(cards, count=1)
    said = (
        rf"small {then.key[:DIGITS]} in the model, small {again.key[:DIGITS]} now(.|\n)*{model} --set small --restart"
    )
    for action_set in ("small", None):
        with pytest.raises(UsageError, match=said):
            uses(cards, model, run, action_set)
    with pytest.raises(UsageError, match=said):
        train(cards, model)
    train(cards, model, restart=True)
    assert uses(cards, model, run, "small")


@pytest.mark.parametrize("model", MODELS)
def test_a_set_that_does_not_hold_any_more_stops_training_and_use(cards: TrainedCards, model: str) -> None:
    run = train_small_and_lose_one(cards, model)
    with pytest.raises(ActionSetError, match=r"episodes of it are gone(.|\n)*vilp-data undo"):
        train(cards, model, restart=True)
    for action_set in ("small", None):
        with pytest.raises(ActionSetError, match="episodes of it are gone"):
            uses(cards, model, run, action_set)
    set_path(cards.root, "small").unlink()
    with pytest.raises(UsageError, match=r"no action set called 'small'(.|\n)*vilp-data actions \S+ --recipe small"):
        uses(cards, model, run, None)


def train_small_and_lose_one(cards: TrainedCards, model: str) -> Path:
    locked = lock(cards)
    run = train(cards, model).parent
    remove_episodes(cards.root, [min(locked.episodes)])
    return run


def test_policies_are_loaded_from_the_runs_of_their_set_and_say_so(cards: TrainedCards) -> None:
    locked = lock(cards)
    runs = {model: train(cards, model) for model in MODELS}
    _, recordings = episode_starts(EpisodeStore(cards.root), "val")
    for name, model in (("vilp", "policy"), ("oracle", "policy"), ("bc", "bc")):
        request = PolicyRequest(
            cards.root, cards.spec, PRESET, N_ACTION_STEPS, recordings=recordings, action_set="small"
        )
        tags = load_policy(name, request).tags
        assert tags["action_set"] == f"small {locked.key[:DIGITS]}" == set_text({"name": "small", "key": locked.key})
        assert checkpoint_digest(runs[model]).startswith(tags[f"{model}_checkpoint"])
        without = PolicyRequest(cards.root, cards.spec, PRESET, N_ACTION_STEPS, recordings=recordings)
        assert "action_set" not in load_policy(name, without).tags


def test_a_policy_of_a_set_is_judged_on_all_validation_episodes(cards: TrainedCards) -> None:
    lock(cards)
    run = train(cards, "policy").parent
    table, folder = evaluate_policy(cards.root, cards.spec, run, cards.run("vqgan"), action_set="small")
    assert table["episodes"] == read_split(cards.root).ids("val")
    assert folder.is_relative_to(run)


def test_a_policy_is_judged_on_episodes_of_a_tag_alone(cards: TrainedCards) -> None:
    val = read_split(cards.root).ids("val")
    relabel_episodes(cards.root, val[:1], labels={"object": "gray"})
    table, folder = evaluate_policy(
        cards.root, cards.spec, cards.run("policy"), cards.run("vqgan"), where={"object": "gray"}
    )
    assert (table["episodes"], folder.name) == (val[:1], "evaluation-object_gray")
    with pytest.raises(
        StoreError, match=r"no episode has actions, and object = green(.|\n)*none among 2 on the val side"
    ):
        evaluate_policy(cards.root, cards.spec, cards.run("policy"), cards.run("vqgan"), where={"object": "green"})


def test_a_run_that_is_not_there_says_how_it_is_trained(cards: TrainedCards) -> None:
    assert find_model_run(cards.root, "policy", preset=PRESET) == cards.run("policy")
    said = r"no policy run of preset 'tiny' and action set 'hybrid'(.|\n)*train policy --preset tiny --set hybrid"
    with pytest.raises(UsageError, match=said):
        find_model_run(cards.root, "policy", preset=PRESET, action_set="hybrid")


def test_training_by_a_set_goes_on_where_it_stopped(cards: TrainedCards, monkeypatch: pytest.MonkeyPatch) -> None:
    from vilp_models import training_loop

    lock(cards, "hybrid", weight=2)
    whole = train(cards, "bc", "hybrid", run=cards.root / "runs" / "whole")
    monkeypatch.setattr(training_loop._Loop, "stops", lambda *_: True)
    with pytest.raises(KeyboardInterrupt):
        train(cards, "bc", "hybrid", run=cards.root / "runs" / "halted")
    monkeypatch.undo()
    torch.manual_seed(5)
    assert_same(whole, train(cards, "bc", "hybrid", run=cards.root / "runs" / "halted"))


def test_a_set_is_read_back_as_it_was_locked(cards: TrainedCards) -> None:
    locked = lock(cards, "hybrid", weight=4)
    labels = read_action_set(cards.root, "hybrid")
    assert (labels.key, labels.name) == (locked.key, "hybrid")
    times = dict(zip((entry.id for entry in labels.entries), labels.repeats().tolist(), strict=True))
    assert times == locked.weights
