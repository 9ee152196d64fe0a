"""Comparing action sets: everything is trained and rolled out once, kept while it is of today, and set side by side by start."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the simulators are not installed: make setup")

import gymnasium
from gymnasium.spaces import Box, Dict

from tests.models.conftest import HEIGHT, VIEWS, WIDTH
from tests.models.trained_cards import PRESET, TrainedCards
from vilp_data.action_sets import recipe_from_dict
from vilp_data.dataset_action_sets import lock_action_set
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.spec import SimSpec
from vilp_data.surgery.operations import relabel_episodes
from vilp_models.compare_sets import SetsComparison, compare_sets
from vilp_models.compare_sets_report import SetsReport

MAX_STEPS = 8


class CardTable(gymnasium.Env):
    """Two numbers, which actions add to; views show them as brightness. Reward: the first one."""

    def __init__(self, n_low_dim: int, *, cameras: bool = True) -> None:
        self.n_low_dim = n_low_dim
        views = {view: Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8) for view in VIEWS}
        self.observation_space = Dict({**views, "low_dim": Box(-np.inf, np.inf, (n_low_dim,), np.float32)})
        self.action_space = Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        given = (options or {}).get("state")
        self.state = self.np_random.uniform(0, 1, 2) if given is None else np.array(given, np.float64)
        return self._observed(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = self.state + np.asarray(action, np.float64)
        return self._observed(), float(self.state[0]), False, False, self._info()

    def _observed(self) -> dict[str, Any]:
        shade = np.uint8(np.clip(self.state[0] * 100, 0, 255))
        views = {view: np.full((HEIGHT, WIDTH, 3), shade, np.uint8) for view in VIEWS}
        return {**views, "low_dim": np.zeros(self.n_low_dim, np.float32)}

    def _info(self) -> dict[str, Any]:
        return {"state": self.state.copy(), "is_success": False, "hold_action": np.zeros(2, np.float32)}


@pytest.fixture
def comparison(trained_cards: TrainedCards, tmp_path: Path) -> SetsComparison:
    shutil.copytree(trained_cards.root, tmp_path / "cards")
    root = tmp_path / "cards"
    gray = read_split(root).ids("train")[:2]
    relabel_episodes(root, list("abcdef"), labels={"object": "purple"})
    relabel_episodes(root, gray, labels={"object": "gray"})
    for name, objects in {"small": ["gray"], "hybrid": ["gray", "purple"]}.items():
        sources = {colour: {"where": {"object": colour}} for colour in objects}
        lock_action_set(root, name, recipe_from_dict({"source": sources}, where="x"), given=name)
    if "test/Cards-v0" not in gymnasium.registry:
        gymnasium.register("test/Cards-v0", entry_point=CardTable, disable_env_checker=True)
    entry = EpisodeStore(root).index()[0]
    n_low_dim = EpisodeStore(root).read(entry.id).low_dim.shape[1]
    sim = SimSpec(env="test/Cards-v0", options={"n_low_dim": n_low_dim}, max_steps=MAX_STEPS)
    spec = trained_cards.spec.model_copy(update={"sim": sim})
    return SetsComparison(root, spec, PRESET, ("small", "hybrid"), n_seeds=2, seeds="0:3", environments=3)


def test_a_comparison_trains_and_rolls_out_each_model_once_and_reports_them_side_by_side(
    comparison: SetsComparison,
) -> None:
    told: list[str] = []
    table, report = compare_sets(comparison, told.append)
    assert [line for line in told if line.startswith("bc")] == [
        "bc, small, seed 0", "bc, hybrid, seed 0", "bc, small, seed 1", "bc, hybrid, seed 1"
    ]  # fmt: skip
    rolled = {path.name for path in comparison.folder.iterdir() if path.is_dir()}
    assert rolled == {f"{p}-{s}-seed{k}" for p in ("vilp", "oracle", "bc") for s in ("small", "hybrid") for k in (0, 1)}
    assert json.loads((comparison.folder / "report.json").read_text()) == table
    assert table["policies"]["vilp"]["n_starts"] == 3
    assert table["policies"]["oracle"]["starts"] == "val"
    tags = [run["tags"] for run in table["policies"]["vilp"]["sets"]["hybrid"]["by_seed"]]
    assert tags[0]["policy_checkpoint"] != tags[1]["policy_checkpoint"]  # seeds are models of their own
    assert all(tag["action_set"].startswith("hybrid") for tag in tags)
    assert tags[0]["planner_checkpoint_front"] == tags[1]["planner_checkpoint_front"]
    assert len(table["low_level_mae"]["move"]["true"]["small"]) == 2
    words = (comparison.folder / "report.md").read_text()
    assert "| vilp, success rate |" in words
    assert "hybrid - small" in words
    assert any(line.startswith("bc, mean of max reward: small ") for line in report.lines())

    told.clear()
    again, _ = compare_sets(comparison, told.append)
    assert again == table
    assert not [line for line in told if line.startswith("rolling out")]


def test_a_rollout_of_other_starts_is_made_again(comparison: SetsComparison) -> None:
    bc = replace(comparison, policies=("bc",), n_seeds=1)
    compare_sets(bc, lambda _: None)
    told: list[str] = []
    table, _ = compare_sets(replace(bc, seeds="5:9"), told.append)
    assert [line for line in told if line.startswith("rolling out")] == [
        "rolling out bc, small, seed 0", "rolling out bc, hybrid, seed 0"
    ]  # fmt: skip
    assert table["policies"]["bc"]["n_starts"] == 4
    assert table["low_level_mae"] == {}


def rollout(rewards: list[float]) -> Mapping[str, Any]:
    episodes = [{"name": str(k), "max_reward": reward, "success": reward > 0.9} for k, reward in enumerate(rewards)]
    return {"episodes": episodes, "starts": "0:2", "hardware": "x", "tags": {}} | {
        measure: {"value": 0.0} for measure in ("max_reward", "success")
    }


def test_differences_are_paired_by_start_after_seeds_are_averaged() -> None:
    rollouts = {
        ("bc", "small", 0): rollout([0.1, 0.5]), ("bc", "small", 1): rollout([0.3, 0.7]),
        ("bc", "hybrid", 0): rollout([0.3, 0.7]), ("bc", "hybrid", 1): rollout([0.5, 1.0]),
    }  # fmt: skip
    report = SetsReport("x", ("small", "hybrid"), 2, {}, rollouts)
    np.testing.assert_allclose(report.by_start("bc", "hybrid", "max_reward"), [0.4, 0.85])
    gain = report.gain("bc", "hybrid", "max_reward")
    assert gain.value == pytest.approx(0.225)
    assert (gain.low, gain.high) == pytest.approx((0.2, 0.25))
    assert report.value("bc", "hybrid", "success").value == 0.25


@pytest.mark.parametrize(("sets", "policies"), [(("small",), ("bc",)), (("small", "hybrid"), ("stay",))])
def test_nothing_to_compare_is_refused(tmp_path: Path, sets: tuple[str, ...], policies: tuple[str, ...]) -> None:
    with pytest.raises(UsageError):
        SetsComparison(tmp_path, None, None, sets, policies)  # type: ignore[arg-type]
