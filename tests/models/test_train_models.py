"""What planner, low-level policy and behaviour cloning are trained on: today's training episodes, and none but those that serve."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.conftest import STEPS
from tests.models.trained_cards import N_ACTION_STEPS, PRESET, TrainedCards, card_episode
from tests.stored_episodes import add_episodes
from vilp_data.dataset import WindowDataset
from vilp_data.dataset_split import read_split, side_episodes, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import NoWindowError, SplitError, StoreError
from vilp_data.shards import read_shard, write_shard
from vilp_models import train
from vilp_models.checkpoint import FILE, read_recipe, read_state
from vilp_models.evaluate import evaluate_policy
from vilp_models.policies.load import PolicyRequest, load_policy
from vilp_models.recipe import BcRecipe, PlannerRecipe, PolicyRecipe
from vilp_models.train import train_bc, train_planner, train_policy
from vilp_models.trained import load_bc, load_planners


@pytest.fixture
def cards(trained_cards: TrainedCards, tmp_path: Path) -> TrainedCards:
    """A copy to work on."""
    shutil.copytree(trained_cards.root, tmp_path / "cards")
    return TrainedCards(tmp_path / "cards", trained_cards.spec)


def _planner(cards: TrainedCards, run: Path, **options: Any) -> None:
    recipe = PlannerRecipe.model_validate(read_recipe(cards.run("planner") / "front"))
    train_planner(cards.root, cards.spec, recipe, run, vqgan=cards.run("vqgan"), **options)


def _policy(cards: TrainedCards, run: Path) -> None:
    recipe = PolicyRecipe.model_validate(read_recipe(cards.run("policy") / "front+side"))
    train_policy(cards.root, cards.spec, recipe, run, vqgan=cards.run("vqgan"), show=False)


def _bc(cards: TrainedCards, run: Path) -> None:
    recipe = BcRecipe.model_validate(read_recipe(cards.run("bc") / "front+side"))
    train_bc(cards.root, cards.spec, recipe, run, n_action_steps=N_ACTION_STEPS, show=False)


def _rewrite_state(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    shard = read_shard(run / FILE)
    state = json.loads(shard.metadata["state"])
    change(state)
    header = {name: shard.metadata[name] for name in ("format", "recipe")} | {"state": json.dumps(state)}
    write_shard(run / FILE, dict(shard.arrays), header)


# --- the VQGAN


USES: Mapping[str, Callable[[TrainedCards], object]] = {
    "train planner": lambda cards: _planner(cards, cards.root / "new"),
    "train policy": lambda cards: _policy(cards, cards.root / "new"),
    "load planners": lambda cards: load_planners(
        EpisodeStore(cards.root), cards.spec, cards.run("planner"), cards.run("vqgan")
    ),
    "evaluate policy": lambda cards: evaluate_policy(cards.root, cards.spec, cards.run("policy"), cards.run("vqgan")),
    "roll out vilp": lambda cards: load_policy("vilp", PolicyRequest(cards.root, cards.spec, PRESET, N_ACTION_STEPS)),
    "roll out oracle": lambda cards: PolicyRequest(cards.root, cards.spec, PRESET, N_ACTION_STEPS).encoders(),
}


@pytest.mark.parametrize("use", USES)
def test_a_vqgan_that_knows_validation_episodes_is_refused(cards: TrainedCards, use: str) -> None:
    seen = side_episodes(EpisodeStore(cards.root), "val")[0]
    _rewrite_state(
        cards.run("vqgan") / "front+side",
        lambda state: state["train_episodes"].update({"same by another name": seen.key}),
    )
    with pytest.raises(SplitError, match=rf"vqgan was trained on 1 of(.|\n)*found: {seen.id}\n(.|\n)*train vqgan"):
        USES[use](cards)
    assert not (cards.root / "new").exists()


def test_reconstructions_in_training_are_those_of_use(cards: TrainedCards, monkeypatch: pytest.MonkeyPatch) -> None:
    """In bf16 too, whose autocast would round what the decoder computes."""
    built: list[Any] = []
    training = train.ModelTraining

    def record(recipe: Any, build: Any, *rest: Any, **options: Any) -> Any:
        built.append(build())
        return training(recipe, build, *rest, **options)

    monkeypatch.setattr(train, "ModelTraining", record)
    _policy(cards, cards.root / "new")
    encoder = PolicyRequest(cards.root, cards.spec, PRESET, N_ACTION_STEPS).encoders()["front"]
    latents = torch.randn(2, 3, 8, 12, generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", torch.bfloat16):
        reconstructed = built[0]._reconstruct("front", latents)
    assert torch.equal(reconstructed, encoder.decode_tensor(latents))


# --- planners


def test_latents_of_validation_that_are_missing_are_not_passed_over(cards: TrainedCards) -> None:
    seen = side_episodes(EpisodeStore(cards.root), "val")[0]
    for path in (cards.root / "latents").glob(f"*/*/{seen.id}.safetensors"):
        path.unlink()
    with pytest.raises(StoreError, match="latents are missing"):
        _planner(cards, cards.root / "new", show=False)


def test_validation_too_short_for_a_window_costs_the_pictures_alone(
    cards: TrainedCards, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def windows(root: Path, *, split: str, **options: Any) -> WindowDataset:
        if split == "val":
            raise NoWindowError("no window fits any episode")
        return WindowDataset(root, split=split, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(train, "WindowDataset", windows)
    _planner(cards, cards.root / "new")
    said = capsys.readouterr().out
    for view in ("front", "side"):
        assert (read_state(cards.root / "new" / view) or pytest.fail("not trained")).finished
        assert f"planner {view}: no window fits the validation episodes" in said


# --- behaviour cloning


def _windows_of_bc(cards: TrainedCards, monkeypatch: pytest.MonkeyPatch) -> WindowDataset:
    """What it would be trained on."""
    seen: list[WindowDataset] = []

    class ReadError(Exception):
        pass

    def record(_recipe: object, _build: object, dataset: WindowDataset, *_: object) -> None:
        seen.append(dataset)
        raise ReadError

    with monkeypatch.context() as patch:
        patch.setattr(train, "ModelTraining", record)
        with pytest.raises(ReadError):
            _bc(cards, cards.root / "new")
    return seen[0]


def test_behaviour_cloning_reads_every_recorded_action_and_no_episode_without(
    cards: TrainedCards, monkeypatch: pytest.MonkeyPatch
) -> None:
    mute = [replace(card_episode(name, 3), action=None) for name in ("x", "y", "z", "w")]
    add_episodes(cards.root, *mute)
    update_split(cards.root, ratio=0.6, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    learnt = set(read_split(cards.root).ids("train"))
    assert learnt & {"x", "y", "z", "w"}
    windows = _windows_of_bc(cards, monkeypatch)
    assert windows.episode_ids == sorted(learnt & set("abcdef"))
    assert len(windows) == STEPS * len(windows.episode_ids)
    batch = windows.read(range(STEPS))
    assert batch.action is not None
    assert batch.action.shape[1] == N_ACTION_STEPS
    assert batch.action_mask.sum(dim=1).tolist() == [min(N_ACTION_STEPS, STEPS - t) for t in range(STEPS)]


def test_behaviour_cloning_does_not_depend_on_the_planners_windows(
    cards: TrainedCards, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = cards.spec.window.model_copy(update={"n_plan_frames": 5, "max_goal_frames": 0})
    other = TrainedCards(cards.root, cards.spec.model_copy(update={"window": longer}))
    assert len(_windows_of_bc(other, monkeypatch)) == len(_windows_of_bc(cards, monkeypatch))
    _bc(other, cards.run("bc"))  # is trained already
    assert load_bc(EpisodeStore(cards.root), other.spec, cards.run("bc"), n_action_steps=N_ACTION_STEPS)


def test_behaviour_cloning_of_before_that_still_loads_and_is_trained_already(cards: TrainedCards) -> None:
    run = cards.run("bc") / "front+side"
    _rewrite_state(
        run, lambda state: state["contract"].update(n_plan_frames=2) or state["contract"].pop("max_goal_frames")
    )
    before = (run / FILE).read_bytes()
    _bc(cards, cards.run("bc"))
    assert (run / FILE).read_bytes() == before
    assert load_bc(EpisodeStore(cards.root), cards.spec, cards.run("bc"), n_action_steps=N_ACTION_STEPS)
