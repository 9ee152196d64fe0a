"""What `vilp-models` passes on: presets, runs, sides of the split, how many episodes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.models.trained_cards import SPEC, TrainedCards
from vilp_data.dataset_split import read_split, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import VilpDataError
from vilp_models import train
from vilp_models.checkpoint import FILE, read_state
from vilp_models.cli import app
from vilp_models.cli.options import dataset_of


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Calls of `train_vqgan`, which trains nothing here."""
    calls: list[dict[str, Any]] = []

    def record(root: Path, spec: object, recipe: object, run: Path, **options: Any) -> None:
        calls.append({"recipe": recipe, "run": run, **options})

    monkeypatch.setattr(train, "train_vqgan", record)
    return calls


@pytest.fixture
def split_store(store: EpisodeStore, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> EpisodeStore:
    monkeypatch.chdir(tmp_path)  # where the last dataset is remembered
    update_split(store.root, ratio=0.5, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    return store


def test_the_preset_decides_the_recipe_of_any_dataset_and_the_split_its_episodes(
    split_store: EpisodeStore, trained: list[dict[str, Any]]
) -> None:
    ended = CliRunner().invoke(app, ["train", "vqgan", "--data", str(split_store.root), "--preset", "cpu"])
    assert ended.exit_code == 0, ended.output
    assert "the run: " in ended.output
    (call,) = trained
    assert (call["recipe"].width, call["recipe"].steps) == (16, 4000)
    assert call["run"] == split_store.root / "runs" / "vqgan-cpu"
    assert call["train_episodes"] == read_split(split_store.root).ids("train")


@pytest.mark.parametrize("episodes", ["0", "-1"])
def test_rollout_wants_at_least_one_episode(store: EpisodeStore, episodes: str) -> None:
    ended = CliRunner().invoke(app, ["rollout", "--data", str(store.root), "--episodes", episodes])
    assert ended.exit_code == 2
    assert "--episodes" in ended.output


# --- training ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """Runs `vilp-models` to its end and gives what it said; elsewhere than where the last dataset is remembered."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str | Path, code: int = 0) -> str:
        ended = CliRunner().invoke(app, [str(word) for word in words])
        if isinstance(ended.exception, VilpDataError):
            assert ended.exception.exit_code == code
            return str(ended.exception)
        assert ended.exit_code == code, ended.output
        return ended.output

    return run


@pytest.mark.parametrize(
    ("model", "views"), [("planner", ("front", "side")), ("policy", ("front+side",)), ("bc", ("front+side",))]
)
def test_a_model_is_trained_once(
    trained_cards: TrainedCards, said: Callable[..., str], tmp_path: Path, model: str, views: tuple[str, ...]
) -> None:
    words = ["train", model, "--data", trained_cards.root, "--preset", "tiny", "--run", tmp_path / "run"]
    assert "trained already" not in said(*words)
    made = {view: (tmp_path / "run" / view / FILE).read_bytes() for view in views}
    state = read_state(tmp_path / "run" / views[0])
    assert state is not None
    assert (state.model, state.step, state.finished) == (model, 2, True)
    assert state.train_episodes.keys() == set(read_split(trained_cards.root).ids("train"))
    again = said(*words)
    assert [line for line in again.splitlines() if "trained already" in line] == [
        f"{model} {view}: trained already, 2 steps" for view in views
    ]
    assert {view: (tmp_path / "run" / view / FILE).read_bytes() for view in views} == made


@pytest.fixture
def two_vqgans(trained_cards: TrainedCards, tmp_path: Path) -> Path:
    """A copy of the dataset, with folders of a second preset."""
    shutil.copytree(trained_cards.root, tmp_path / "two")
    for model in ("vqgan", "planner", "policy"):
        (tmp_path / "two" / "runs" / f"{model}-cpu").mkdir()
    return tmp_path / "two"


@pytest.mark.parametrize(
    ("words", "called"),
    [
        (["train", "planner"], "train.train_planner"),
        (["train", "policy"], "train.train_policy"),
        (["evaluate", "planner"], "evaluate.evaluate_planner"),
        (["evaluate", "policy"], "evaluate.evaluate_policy"),
        (["generate"], "evaluate.generate_videos"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else "",
)
def test_the_vqgan_is_that_of_the_preset_and_else_the_only_one(
    two_vqgans: Path, said: Callable[..., str], monkeypatch: pytest.MonkeyPatch, words: list[str], called: str
) -> None:
    runs: list[list[Path]] = []

    class CalledError(Exception):
        pass

    def record(*given: Any, **options: Any) -> None:
        runs.append([value for value in [*given, *options.values()] if isinstance(value, Path)])
        raise CalledError

    monkeypatch.setattr(f"vilp_models.{called}", record)
    model = "policy" if "policy" in words else "planner"
    common = [*words, "--data", str(two_vqgans)]
    for options, vqgan in (
        (["--preset", "tiny"], "vqgan-tiny"),
        (["--preset", "cpu"], "vqgan-cpu"),
        (["--preset", "cpu", "--vqgan", str(two_vqgans / "runs" / "vqgan-tiny")], "vqgan-tiny"),
    ):
        with pytest.raises(CalledError):
            CliRunner().invoke(app, [*common, *options], catch_exceptions=False)
        assert {two_vqgans / "runs" / vqgan, two_vqgans / "runs" / f"{model}-{options[1]}"} <= set(runs[-1])
    own = ["--run", str(two_vqgans / "runs" / f"{model}-tiny")]
    refused = said(*common, *own, code=2)
    assert "which vqgan run?" in refused
    assert "vqgan-cpu" in refused
    assert "--vqgan" in refused
    assert "no vqgan run of preset 'paper'" in said(*common, *own, "--preset", "paper", code=2)
    (two_vqgans / "runs" / "vqgan-cpu").rmdir()
    with pytest.raises(CalledError):
        CliRunner().invoke(app, [*common, *own], catch_exceptions=False)
    assert two_vqgans / "runs" / "vqgan-tiny" in runs[-1]


def test_a_task_that_is_named_gives_recipes_window_and_simulator_but_not_what_was_ingested(
    trained_cards: TrainedCards, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    today = SPEC.replace('topic = "/act"', 'topic = "/other"').replace("frame_stride = 2", "frame_stride = 3")
    (tmp_path / "cards.toml").write_text(today + '[sim]\nenv = "test/Dot-v0"\nmax_steps = 77\n')
    _, spec = dataset_of(trained_cards.root, str(tmp_path / "cards.toml"), None)
    assert spec.sim is not None
    assert (spec.sim.max_steps, spec.window.frame_stride) == (77, 3)
    assert spec.action == trained_cards.spec.action
    assert dataset_of(trained_cards.root, None, None)[1] == trained_cards.spec


# --- rollouts ------------------------------------------------------------------------------------------------------------


def test_a_policy_that_follows_recordings_is_refused_with_seeds(
    trained_cards: TrainedCards, said: Callable[..., str]
) -> None:
    words = ["rollout", "--data", trained_cards.root, "--preset", "tiny", "--max-steps", "4"]
    assert "--from-episodes val" in said(*words, "--policy", "oracle", "--seeds", "0:2", code=2)
    assert "did you mean 'vilp'" in said(*words, "--policy", "vlp", "--seeds", "0:2", code=2)
