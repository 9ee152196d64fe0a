"""Comparing action sets: everything is trained and rolled out once, kept while it is of today, and set side by side by start."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the simulators are not installed: make setup")

import gymnasium
from gymnasium.spaces import Box, Dict

from tests.models.conftest import HEIGHT, STEPS, VIEWS, WIDTH
from tests.models.trained_cards import PRESET, TrainedCards
from vilp_data.action_sets import recipe_from_dict
from vilp_data.dataset_action_sets import lock_action_set, read_action_set
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
    learnt = {f"{p}-{s}-seed{k}" for p in ("vilp", "oracle", "bc") for s in ("small", "hybrid") for k in (0, 1)}
    assert rolled == learnt | {"stay", "stay-val"}
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
    lock = read_action_set(comparison.root, "hybrid").lock
    assert table["labels"]["hybrid"] == {"episodes": 4, "steps": 4 * STEPS, "key": lock.key}
    assert f"- hybrid: 4 labelled episodes, {4 * STEPS} steps, `{lock.key[:12]}`" in words
    assert f"Dataset `{comparison.root}`, preset {PRESET}." in words
    assert set(table["stay"]) == {"0:3", "val"}
    assert table["stay"]["0:3"]["success"] == {"value": 0.0, "low": 0.0, "high": 0.5615}  # Wilson's, of none of three
    assert "| staying (0:3), success rate | 0.000 (0.000 to 0.561) | 0.000 (0.000 to 0.561) | – |" in words
    assert "to be compared with staying there, not with each other" in words
    by_seed = words.split("## By training seed")[1]
    assert re.search(r"\| bc, mean of max reward \| \d\.\d{3}, \d\.\d{3} \| \d\.\d{3}, \d\.\d{3} \|", by_seed)

    told.clear()
    again, _ = compare_sets(comparison, told.append)
    assert again == table
    assert not [line for line in told if line.startswith("rolling out")]

    told.clear()
    of_one_policy, _ = compare_sets(replace(comparison, policies=("bc",)), told.append)
    assert of_one_policy == table  # what was rolled out before is reported too
    assert not [line for line in told if not line.startswith("bc, ")]

    redraw(comparison, "hybrid")
    told.clear()
    after, _ = compare_sets(replace(comparison, policies=("bc",)), told.append)
    assert list(after["policies"]) == ["bc"]  # the others' models are of the set as it was
    assert [line.split(" (")[0] for line in told if "another version" in line] == [
        f"bc-{PRESET}-hybrid-seed{seed} learnt from another version of hybrid" for seed in (0, 1)
    ]
    assert [line for line in told if line.startswith("rolling out")] == [
        f"rolling out bc, hybrid, seed {seed}" for seed in (0, 1)
    ]
    assert any(line.startswith("vilp is left out of the report") for line in told)


def redraw(comparison: SetsComparison, name: str) -> None:
    recipe = recipe_from_dict({"source": {"purple": {"where": {"object": "purple"}, "count": 1}}}, where="x")
    lock_action_set(comparison.root, name, recipe, given=name, redraw=True)


def test_a_comparison_from_other_starts_leaves_the_earlier_one_alone(comparison: SetsComparison) -> None:
    bc = replace(comparison, policies=("bc",), n_seeds=1)
    first, _ = compare_sets(bc, lambda _: None)
    told: list[str] = []
    other = replace(bc, seeds="5:9")
    table, _ = compare_sets(other, told.append)
    assert [line for line in told if line.startswith("rolling out")] == [
        "rolling out bc, small, seed 0", "rolling out bc, hybrid, seed 0", "rolling out stay"
    ]  # fmt: skip
    assert table["policies"]["bc"]["n_starts"] == 4
    assert table["low_level_mae"] == {}
    assert (bc.folder.name, other.folder.name) == (
        f"{PRESET}-small+hybrid-0-3-x1",
        f"{PRESET}-small+hybrid-5-9-x1",
    )
    assert json.loads((bc.folder / "report.json").read_text()) == first


def test_runs_of_another_recipe_are_refused_until_they_may_go(comparison: SetsComparison) -> None:
    bc = replace(comparison, policies=("bc",), n_seeds=1)
    compare_sets(bc, lambda _: None)
    models = {**bc.spec.models, "bc": {**bc.spec.models.get("bc", {}), "steps": 3}}
    longer = replace(bc, spec=bc.spec.model_copy(update={"models": models}))
    with pytest.raises(UsageError, match=r"another recipe(.|\n)*--restart"):
        compare_sets(longer, lambda _: None)
    told: list[str] = []
    compare_sets(replace(longer, restart=True), told.append)
    assert [line for line in told if "anew" in line or line.startswith("rolling out bc")] == [
        *(f"bc-{PRESET}-{s}-seed0 is trained anew: this run was trained with another recipe" for s in longer.sets),
        *(f"rolling out bc, {s}, seed 0" for s in longer.sets),
    ]
    told.clear()
    compare_sets(replace(longer, restart=True), told.append)
    assert not [line for line in told if "anew" in line or line.startswith("rolling out")]


def test_the_oracle_of_fewer_episodes_takes_nothing_from_that_of_all(comparison: SetsComparison) -> None:
    every = replace(comparison, policies=("oracle",), n_seeds=1)
    compare_sets(every, lambda _: None)
    compare_sets(replace(every, n_oracle=1), lambda _: None)
    folders = {path.name for path in every.folder.iterdir() if path.is_dir()}
    of_sets = {f"oracle{few}-{s}-seed0" for few in ("", "-first1") for s in every.sets}
    assert folders == of_sets | {"stay-val", "stay-val-first1"}
    told: list[str] = []
    compare_sets(every, told.append)
    assert not [line for line in told if line.startswith("rolling out")]


def test_every_rollout_tells_its_steps(comparison: SetsComparison) -> None:
    done: dict[str, tuple[int, int]] = {}

    @contextmanager
    def bar(label: str, total: int) -> Iterator[Any]:
        yield lambda step, steps: done.update({label: (step, steps)})
        assert done[label] == (total, total)

    compare_sets(replace(comparison, policies=("bc",), n_seeds=1), lambda _: None, bar)
    assert done == dict.fromkeys(("bc, small, seed 0", "bc, hybrid, seed 0", "stay"), (3 * MAX_STEPS, 3 * MAX_STEPS))


def test_what_a_comparison_needs_is_proved_before_the_first_training(comparison: SetsComparison) -> None:
    told: list[str] = []
    shutil.rmtree(comparison.root / "runs" / f"planner-{PRESET}")
    for change in ({"sets": ("small", "hybrd")}, {"seeds": "9:3"}, {"policies": ("bc", "vilp")}):
        with pytest.raises(UsageError):
            compare_sets(replace(comparison, **change), told.append)
    assert told == []


def rollout(rewards: list[float]) -> Mapping[str, Any]:
    episodes = [{"name": str(k), "max_reward": reward, "success": reward > 0.9} for k, reward in enumerate(rewards)]
    return {"episodes": episodes, "starts": "0:2", "hardware": "x", "tags": {}} | {
        measure: {"value": 0.0} for measure in ("max_reward", "success")
    }


REWARDS = np.array([0.1, 0.3, 0.5, 0.2, 0.8, 0.4])


def of_seeds(*more: float) -> dict[int, Mapping[str, Any]]:
    return {seed: rollout((REWARDS + one).tolist()) for seed, one in enumerate(more)}


def report_on(small: Mapping[int, Any], hybrid: Mapping[int, Any]) -> SetsReport:
    rollouts = {("bc", name, k): t for name, of in (("small", small), ("hybrid", hybrid)) for k, t in of.items()}
    return SetsReport("x", ("small", "hybrid"), len(small), {}, rollouts)


def test_a_difference_is_paired_by_start() -> None:
    """Starts that differ much do not hide what every one of them gains."""
    better = {0: rollout([reward + 0.1 + 0.01 * k for k, reward in enumerate(REWARDS)])}
    gain = report_on(of_seeds(0.0), better).gain("bc", "hybrid", "max_reward")
    assert gain.value == pytest.approx(0.125)
    assert 0.1 < gain.low < 0.125 < gain.high < 0.15


def test_training_seeds_that_come_out_differently_widen_the_interval() -> None:
    """Three models of one set against three of another: what one lucky seed brings is not claimed for the set."""
    lucky = report_on(of_seeds(0.0, 0.01, 0.02), of_seeds(0.0, 0.01, 0.32)).gain("bc", "hybrid", "max_reward")
    steady = report_on(of_seeds(0.0, 0.01, 0.02), of_seeds(0.1, 0.11, 0.12)).gain("bc", "hybrid", "max_reward")
    assert lucky.value == pytest.approx(steady.value)
    assert lucky.low < 0 < lucky.high
    assert steady.low > 0


def test_a_rate_of_several_training_seeds_counts_every_start_once() -> None:
    report = report_on(
        {0: rollout([0.1] * 10), 1: rollout([1.0] + [0.1] * 9)}, {0: rollout([0.1] * 10), 1: rollout([0.1] * 10)}
    )
    once, never = (report.value("bc", name, "success") for name in ("small", "hybrid"))
    assert (once.value, never.value) == (0.05, 0.0)
    assert never.high == pytest.approx(0.2775, abs=1e-4)  # Wilson's of none of ten, not of twenty
    assert once.high > never.high


def test_where_nothing_differs_no_interval_is_claimed_and_the_report_says_so() -> None:
    report = report_on(of_seeds(0.0, 0.0), of_seeds(0.2, 0.2))
    gain = report.gain("bc", "hybrid", "max_reward")
    assert gain.value == pytest.approx(0.2)
    assert math.isnan(gain.low)
    assert math.isnan(gain.high)
    assert "hybrid - small +0.200" in report.lines()[0]
    assert "nothing differed" in report.lines()[-1]
    assert "nothing differed" in report.to_markdown()


@pytest.mark.parametrize(
    ("sets", "policies"),
    [
        (("small",), ("bc",)),
        (("small", "small", "hybrid"), ("bc",)),
        (("small", "hybrid"), ("stay",)),
        (("small", "hybrid"), ()),
    ],
)
def test_nothing_to_compare_is_refused(tmp_path: Path, sets: tuple[str, ...], policies: tuple[str, ...]) -> None:
    with pytest.raises(UsageError):
        SetsComparison(tmp_path, None, None, sets, policies)  # type: ignore[arg-type]
