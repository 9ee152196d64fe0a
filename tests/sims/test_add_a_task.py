"""What docs/add_a_task.md tells a stranger, done literally: its own code and TOML, on a path of their own."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the simulators are not installed (make setup)")

from vilp_data import sims
from vilp_data.assemble import assemble_episode
from vilp_data.errors import UsageError
from vilp_data.sims import record
from vilp_data.sims.record import record_task
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task
from vilp_models.replay import render_match, replay
from vilp_models.simulator import make_env

PAGE = Path(__file__).parents[2] / "docs" / "add_a_task.md"

pytestmark = [
    pytest.mark.sim,
    pytest.mark.skipif(not PAGE.exists(), reason="the docs are not beside the tests"),
]


@pytest.fixture
def task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TaskSpec:
    """The page's task, outside the package."""
    page = PAGE.read_text(encoding="utf-8")
    python = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    toml, names = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "reach_dot.py").write_text("\n".join(python))
    built_in = 'env = "vilp/ReachDot-v0"\n'
    assert built_in in toml
    (tmp_path / "reach_dot.toml").write_text(toml.replace(built_in, names))
    return load_task(str(tmp_path / "reach_dot.toml"), preset="tiny")


def test_the_page_makes_a_task_that_records_and_plays_back(task: TaskSpec, tmp_path: Path) -> None:
    assert task.record is not None
    episodes = record_task(task, tmp_path / "logs", episodes=task.record.episodes, first_seed=1000, workers=1)
    assert [episode.success for episode in episodes] == [True] * 3
    with open_log(episodes[0].path) as log:
        episode = assemble_episode(log, log.episodes()[0], task, episode_id="e")
    assert episode.tags["goal"] == "dot"
    assert "style_ahead" in episode.tags
    assert episode.valid.all()
    env = make_env(task)
    assert replay(episode, env).proves(env.unwrapped.metadata["replay_tolerance"])
    assert render_match(episode, env).proves()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"env": "reach_dot:mine/Other-v0"}, "the simulator cannot be made"),
        ({"env": "no_such_module:mine/ReachDot-v0"}, "the simulator cannot be made"),
        ({"expert": "reach_dot:Nobody"}, "the expert cannot be loaded"),
        ({"expert": "no_such_module:Expert"}, "the expert cannot be loaded"),
        ({"options": {"colour": "red"}}, "does not take these options"),
        ({"expert": None}, "no scripted expert for this task"),
    ],
)
def test_a_simulator_or_expert_that_is_not_there_is_said_to_be_missing(
    task: TaskSpec, tmp_path: Path, changed: dict[str, object], said: str
) -> None:
    assert task.sim is not None
    other = task.model_copy(update={"sim": task.sim.model_copy(update=changed)})
    with pytest.raises(UsageError, match=said):
        record_task(other, tmp_path / "logs", episodes=1, first_seed=0, workers=1)
    assert not list(tmp_path.glob("logs/*.mcap"))


def test_the_page_makes_a_task_that_is_built_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = PAGE.read_text(encoding="utf-8")
    environment, expert, _ = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    toml, _ = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "reach_dot.py").write_text(environment)
    (tmp_path / "reach_dot_expert.py").write_text(expert)
    (tmp_path / "reach_dot.toml").write_text(toml)
    monkeypatch.setattr(sims, "__path__", [*sims.__path__, str(tmp_path)])
    [entry_point] = re.findall(r'`"(vilp/ReachDot-v0)": "(.*?)",`', page)
    [(name, *parts)] = re.findall(r'`"(vilp/ReachDot-v0)": _Recordable\("(.*?)", (\(.*?\)), (\(.*?\))\),`', page)
    monkeypatch.setitem(sims.ENVIRONMENTS, *entry_point)
    recordable = record._Recordable(parts[0], *map(ast.literal_eval, parts[1:]))
    monkeypatch.setitem(record.RECORDABLE, name, recordable)
    task = load_task(str(tmp_path / "reach_dot.toml"))
    episodes = record_task(task, tmp_path / "logs", episodes=2, first_seed=1000, workers=1)
    assert [episode.success for episode in episodes] == [True] * 2


def test_no_start_of_the_pages_task_is_a_success_or_a_step_away_from_one(task: TaskSpec) -> None:
    env = make_env(task, cameras=False).unwrapped
    for seed in range(200):
        env.reset(seed=seed)
        assert np.hypot(*(env.disc - env.dot)) > 8


def unfit(change: Callable[[str], str], folder: Path, module: str) -> None:
    """The page's module under another name, with a mistake in it."""
    text = (folder / "reach_dot.py").read_text()
    wrong = change(text.replace("mine/ReachDot-v0", f"{module}/ReachDot-v0").replace("reach_dot:", f"{module}:"))
    assert wrong != text
    (folder / f"{module}.py").write_text(wrong)


@pytest.mark.parametrize(
    ("module", "right", "wrong", "said"),
    [
        (
            "typo_in_expert",
            "gap = self.env.dot",
            "gap = self.env.dto",
            r"AttributeError: .*dto.*typo_in_expert\.py:\d+",
        ),
        ("typo_in_env", "near = bool(np.", "near = bool(npp.", r"NameError: .*npp.*typo_in_env\.py:\d+"),
        ("no_hold", '"hold_action": self.disc.astype(np.float32),', "", "info lacks 'hold_action'"),
        ("no_success", '"is_success": near,', "", "info lacks 'is_success'"),
        ("no_view", 'seen["top"] = image', "pass", "observation lacks 'top'"),
        ("no_low_dim", 'seen = {"low_dim": self.disc.astype(np.float32)}', "seen = {}", "observation lacks 'low_dim'"),
    ],
)
def test_a_mistake_in_ones_own_simulator_is_told_with_its_seed_and_place(
    task: TaskSpec, tmp_path: Path, module: str, right: str, wrong: str, said: str
) -> None:
    unfit(
        lambda text: text.replace(right, wrong).replace('info["is_success"], False', "False, False"), tmp_path, module
    )
    assert task.sim is not None
    own = {"env": f"{module}:{module}/ReachDot-v0", "expert": f"{module}:ReachDotExpert"}
    other = task.model_copy(update={"sim": task.sim.model_copy(update=own)})
    with pytest.raises(UsageError, match=rf"seed 1000(.|\n)*{said}"):
        record_task(other, tmp_path / "logs", episodes=1, first_seed=1000, workers=1)
    assert not list(tmp_path.glob("logs/*.mcap"))
