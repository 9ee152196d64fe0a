"""A model meets another dataset than it was made of: which of them, both values, and the command that makes it right."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.models.trained_cards import N_ACTION_STEPS, TrainedCards, card_episode, train_card_vqgan
from vilp_data.dataset_split import read_split, update_split
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import VilpDataError
from vilp_data.latent_runs import encode_dataset
from vilp_data.spec import TaskSpec
from vilp_data.surgery.operations import plan_trim, remove_episodes, trim_episodes
from vilp_data.task_toml import task_from_dict
from vilp_models.trained import load_bc, load_low_level, load_planners
from vilp_models.vqgan import load_frame_encoder

MODELS = ("planner", "policy", "bc")


@dataclass(frozen=True)
class Today:
    """The dataset that a model meets: its folder and task, where its runs are, which VQGAN decodes, how many actions are executed."""

    cards: TrainedCards
    spec: TaskSpec
    vqgan: Path
    n_action_steps: int = N_ACTION_STEPS

    def load(self, model: str) -> object:
        store, run = EpisodeStore(self.cards.root), self.cards.run(model)
        if model == "planner":
            return load_planners(store, self.spec, run, self.vqgan)
        if model == "bc":
            return load_bc(store, self.spec, run, n_action_steps=self.n_action_steps)
        encoders = {view: load_frame_encoder(self.vqgan, view) for view in ("front", "side")}
        return load_low_level(store, self.spec, run, encoders)

    def key(self, vqgan: Path) -> str:
        return load_frame_encoder(vqgan, "front").key


def task(**tables: Any) -> Callable[[Today, Path], Today]:
    """These tables of the task are others today; a table of None is gone."""

    def change(today: Today, _: Path) -> Today:
        table = today.spec.model_dump(mode="json", by_alias=True)
        for name, value in tables.items():
            table[name] = {**table[name], **value} if isinstance(value, dict) else value
        table["views"] = {name: view for name, view in table["views"].items() if view is not None}
        return replace(today, spec=task_from_dict(table, where="test"))

    return change


def chunks_of_two(today: Today, _: Path) -> Today:
    return replace(today, n_action_steps=2)


def another_vqgan(today: Today, folder: Path) -> Today:
    """It has encoded nothing yet."""
    train_card_vqgan(today.cards, folder / "other", seed=1)
    return replace(today, vqgan=folder / "other")


def other_values(today: Today, folder: Path) -> Today:
    """A training episode was replaced by one with other frames, low_dim and actions, and encoded."""
    copied = _copied(today, folder)
    root = copied.cards.root
    name = read_split(root).ids("train")[0]
    episode = card_episode(name, 2)
    assert episode.action is not None
    frames = {view: images // 3 for view, images in episode.frames.items()}
    changed = replace(episode, frames=frames, low_dim=episode.low_dim + 9, action=7 * episode.action)
    store = EpisodeStore(root)
    store.write(changed, Origin("test", "", name, "another key", {}))
    store.write_index()
    encode_dataset(root, today.spec, "vqgan", copied.vqgan, workers=1)
    return copied


def another_split(today: Today, folder: Path) -> Today:
    """Drawn anew: some of the episodes that were learnt are for validation now."""
    copied = _copied(today, folder)
    root = copied.cards.root
    before = set(read_split(root).ids("train"))
    update_split(root, ratio=0.6, ratio_from="task", seed=7, group_by=None, strata=(), redraw=True)
    assert set(read_split(root).ids("val")) & before
    return copied


def _copied(today: Today, folder: Path) -> Today:
    shutil.copytree(today.cards.root, folder / "copy")
    cards = TrainedCards(folder / "copy", today.spec)
    return replace(today, cards=cards, vqgan=cards.run("vqgan"))


BACK = {"topic": "/back", "height": 32, "width": 48}
WRIST = {"topic": "/wrist", "height": 32, "width": 48}

Change = Callable[[Today, Path], Today]
REFUSED: list[tuple[str, Change, str, tuple[str, ...]]] = [
    # what differs, the change, what of both is said, which models depend on it
    ("another task", task(name="dice"), "task cards in the model, dice in the dataset", MODELS),
    ("other views", task(views={"side": None}), "views front, side in the model, front in the dataset", MODELS),
    ("other views", task(views={"wrist": WRIST}), "front, side in the model, front, side, wrist in the", MODELS),
    ("other views", task(views={"back": BACK}), "front, side in the model, back, front, side in the", MODELS),
    (
        "another image geometry",
        task(views={"front": {"topic": "/front", "height": 64, "width": 48}}),
        "geometry front: 32, 48,  in the model, front: 64, 48,  in the dataset",
        MODELS,
    ),
    ("another control rate", task(rate_hz=5.0), "rate_hz 10.0 in the model, 5.0 in the dataset", MODELS),
    ("another frame stride", task(window={"frame_stride": 1}), "frame_stride 2 in the model, 1 in the dataset", MODELS),
    (
        "another number of planned frames",
        task(window={"n_plan_frames": 3}),
        "n_plan_frames 2 in the model, 3 in the dataset",
        ("planner",),
    ),
    (
        "another number of repeated last frames",
        task(window={"max_goal_frames": 0}),
        "max_goal_frames 6 in the model, 0 in the dataset",
        ("planner",),
    ),
    ("latents of another VQGAN", another_vqgan, "front: {old}; side: {old} in the model, front: {new}", ("planner", "policy")),
    ("another low_dim", task(low_dim={"arm": {"topic": "/leg"}}), "topic: /arm", ("bc",)),
    ("other actions", task(action={"move": {"topic": "/go", "fields": ["x", "y"]}}), "topic: /act", ("policy", "bc")),
    ("another normaliser", other_values, "±", MODELS),
    ("chunks of another length", chunks_of_two, "n_action_steps 4 in the model, 2 in [models.vilp]", ("bc",)),
    ("was trained on", another_split, "found: ", MODELS),
]  # fmt: skip


@pytest.fixture
def today(trained_cards: TrainedCards) -> Today:
    return Today(trained_cards, trained_cards.spec, trained_cards.run("vqgan"))


@pytest.mark.parametrize("model", MODELS)
def test_a_model_loads_where_nothing_changed(today: Today, model: str) -> None:
    assert today.load(model)


def test_a_model_loads_where_episodes_it_learnt_from_were_removed_or_trimmed(today: Today, tmp_path: Path) -> None:
    """It keeps its own statistics; what is left of the training episodes has others."""
    copied = _copied(today, tmp_path)
    root = copied.cards.root
    gone, cut, *_ = read_split(root).ids("train")
    remove_episodes(root, [gone])
    trim_episodes(root, plan_trim(root, [cut], steps=(3, None)))
    for model in MODELS:
        assert copied.load(model)
    another_split_of = another_split(copied, tmp_path / "split")
    with pytest.raises(VilpDataError, match="was trained on"):
        another_split_of.load("planner")


@pytest.mark.parametrize(
    ("title", "change", "found", "models"), REFUSED, ids=[row[0].replace(" ", "_") for row in REFUSED]
)
def test_another_dataset_is_refused_with_both_values_and_the_command(
    today: Today, tmp_path: Path, title: str, change: Change, found: str, models: tuple[str, ...]
) -> None:
    other = change(today, tmp_path)
    keys = {"old": today.key(today.vqgan), "new": other.key(other.vqgan)} if other.vqgan != today.vqgan else {}
    for model in models:
        with pytest.raises(VilpDataError) as refused:
            other.load(model)
        message = str(refused.value)
        assert title in message
        assert (found.format(**keys) if "{old}" in found else found) in message
        assert f"vilp-models train {model} --restart" in message
    for model in set(MODELS) - set(models):
        other.load(model)


def test_values_and_episodes_that_differ_are_named(today: Today, tmp_path: Path) -> None:
    with pytest.raises(VilpDataError) as refused:
        other_values(today, tmp_path / "values").load("bc")
    words = re.search(
        r"normaliser (action: .* ± .*) in the model, (action: .* ± .*) in the dataset", str(refused.value)
    )
    assert words is not None
    assert words[1] != words[2]
    other = another_split(today, tmp_path / "split")
    learnt = set(read_split(today.cards.root).ids("train"))
    leaked = sorted(set(read_split(other.cards.root).ids("val")) & learnt)
    with pytest.raises(VilpDataError) as refused:
        other.load("planner")
    assert f"trained on {len(leaked)} of" in str(refused.value)
    assert f"found: {', '.join(leaked)}" in str(refused.value)


def test_models_are_refused_beside_a_vqgan_that_lacks_a_view(today: Today, tmp_path: Path) -> None:
    run = today.vqgan / "front+side"
    shutil.copytree(run, tmp_path / "one" / "front")
    with pytest.raises(VilpDataError, match=r"view 'side'(.|\n)*known: front(.|\n)*vilp-models train vqgan"):
        replace(today, vqgan=tmp_path / "one").load("planner")
