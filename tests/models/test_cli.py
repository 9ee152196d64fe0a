"""What `vilp-models` passes on: presets, sides of the split, how many episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vilp_data.dataset_split import read_split, update_split
from vilp_data.episodes import EpisodeStore
from vilp_models import train
from vilp_models.cli import app


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
    (call,) = trained
    assert (call["recipe"].width, call["recipe"].steps) == (16, 4000)
    assert call["run"] == split_store.root / "runs" / "vqgan-cpu"
    assert call["train_episodes"] == read_split(split_store.root).ids("train")


@pytest.mark.parametrize("episodes", ["0", "-1"])
def test_rollout_wants_at_least_one_episode(store: EpisodeStore, episodes: str) -> None:
    ended = CliRunner().invoke(app, ["rollout", "--data", str(store.root), "--episodes", episodes])
    assert ended.exit_code == 2
    assert "--episodes" in ended.output
