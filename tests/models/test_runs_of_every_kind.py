"""Verbs that look for frame encoders among the runs of a dataset: those of other models are passed over, whatever they are called."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from vilp_data.cli import main
from vilp_data.errors import StoreError, UsageError
from vilp_data.latents import load_encoder
from vilp_models.checkpoint import FILE, load_checkpoint, run_for_view, save_checkpoint
from vilp_models.runs import find_model_run

if TYPE_CHECKING:
    from tests.models.trained_cards import TrainedCards

MODELS = ("vqgan", "planner", "policy", "bc")

Said = Callable[..., str]


@pytest.fixture
def cards(trained_cards: TrainedCards, tmp_path: Path) -> TrainedCards:
    """A copy that may be changed, with a run of all four kinds."""
    shutil.copytree(trained_cards.root, tmp_path / "cards")
    copy = trained_cards._replace(root=tmp_path / "cards")
    assert all(copy.run(model).is_dir() for model in MODELS)
    return copy


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs `vilp-data WORDS…` in this process; what it printed, JSON where it says so."""

    def run(*words: str | Path) -> str:
        monkeypatch.setattr(sys, "argv", ["vilp-data", *map(str, words)])
        try:
            main()
        except SystemExit as end:
            assert end.code in (None, 0, 1)
        return capsys.readouterr().out

    return run


def test_why_stale_judges_the_latents_of_the_vqgan_among_runs_of_every_kind(cards: TrainedCards, said: Said) -> None:
    def reasons() -> dict[str, str]:
        stale: dict[str, str] = json.loads(said("why-stale", cards.root, "--json"))
        return {what: why for what, why in stale.items() if "runs" in what or "latents" in what}

    assert reasons() == {}
    shutil.rmtree(cards.root / "latents" / "side")
    (reason,) = reasons().values()
    assert f"not encoded yet; run `vilp-data latents --run {cards.run('vqgan')}`" in reason


def test_gc_keeps_the_latents_of_the_vqgan_among_runs_of_every_kind(cards: TrainedCards, said: Said) -> None:
    latents = sorted((cards.root / "latents").rglob("*.safetensors"))
    report = json.loads(said("gc", cards.root, "--json"))
    assert report["found"] == report["notes"] == []
    assert sorted((cards.root / "latents").rglob("*.safetensors")) == latents != []


def test_gc_judges_no_latents_while_a_run_is_damaged_whatever_it_is_called(cards: TrainedCards, said: Said) -> None:
    shutil.copytree(cards.run("vqgan"), cards.root / "runs" / "vqgan-other")
    mine = cards.root / "runs" / "mine"
    cards.run("vqgan").rename(mine)
    (run,) = {run_for_view(mine, view) for view in cards.spec.views}
    (run / FILE).write_bytes((run / FILE).read_bytes()[:2000])
    report = json.loads(said("gc", cards.root, "--json"))
    assert report["found"] == []
    assert all("mine could not be read" in note for note in report["notes"])
    assert len(report["notes"]) == len(cards.spec.views)


def test_where_only_runs_of_action_sets_are_there_the_option_that_names_them_is_told(tmp_path: Path) -> None:
    for run in ("policy-tiny-small", "policy-tiny-hybrid", "policy-cpu"):
        (tmp_path / "runs" / run).mkdir(parents=True)
    with pytest.raises(UsageError, match=r"train policy --preset tiny`, or take .*with --set hybrid or small$"):
        find_model_run(tmp_path, "policy", preset="tiny", option="--preset")
    with pytest.raises(UsageError, match="--set other`$"):
        find_model_run(tmp_path, "policy", preset="tiny", action_set="other", option="--preset")


@pytest.mark.parametrize("model", MODELS[1:])
def test_the_run_of_another_model_is_not_loaded_as_an_encoder(trained_cards: TrainedCards, model: str) -> None:
    with pytest.raises(UsageError, match=rf"not a vqgan\n   found: {model}\n"):
        load_encoder("vqgan", trained_cards.run(model), "front")


def test_a_vqgan_of_recipe_keys_that_are_none_today_is_named(cards: TrainedCards) -> None:
    run = run_for_view(cards.run("vqgan"), "front")
    old = load_checkpoint(run)
    save_checkpoint(run, type(old)(old.model, old.trainer, {**old.recipe, "colour": "loud"}, old.state))
    with pytest.raises(StoreError, match=r"recipe(.|\n)*colour(.|\n)*train vqgan --restart"):
        load_encoder("vqgan", cards.run("vqgan"), "front")
