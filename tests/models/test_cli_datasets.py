"""Which dataset, task and preset a command of `vilp-models` means; the examples of its help among them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer
from typer.testing import CliRunner

from tests.stored_episodes import add_episodes, episode, write_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task
from vilp_models.cli import app
from vilp_models.cli.options import dataset_of
from vilp_models.compare_sets import SetsComparison
from vilp_models.policies.load import PolicyRequest

MODELS = ("vqgan", "planner", "policy", "bc")


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with data/hanoi and data/pusht, as ingested without a preset, and folders for their runs of preset cpu."""
    monkeypatch.chdir(tmp_path)
    for task in ("hanoi", "pusht"):
        root = Path("data") / task
        EpisodeStore(root).write_spec(load_task(task))
        add_episodes(root, episode("a", 6), episode("b", 6))
        write_split(root)
        for model in MODELS:
            (root / "runs" / f"{model}-cpu").mkdir(parents=True)
    return Path("data")


def test_a_preset_alone_is_that_of_the_built_in_task_that_was_ingested(data: Path) -> None:
    _, spec = dataset_of(data / "pusht", None, "cpu")
    today = load_task("pusht", preset="cpu")
    assert (spec.window, spec.models, spec.sim) == (today.window, today.models, today.sim)
    assert spec.window.n_plan_frames == 4
    assert spec.models["vqgan"]["steps"] == 7000
    assert dataset_of(data / "pusht", None, None)[1].window.n_plan_frames == 12


def test_a_dataset_of_another_task_than_named_is_refused(data: Path) -> None:
    with pytest.raises(UsageError, match=r"another task(.|\n)*ingested as pusht, --task is hanoi(.|\n)*--data"):
        dataset_of(data / "pusht", "hanoi", "cpu")
    assert dataset_of(data / "pusht", "pusht", "cpu")[1].name == "pusht"


def _examples(command: click.Command) -> Iterator[str]:
    yield from re.findall(r"Example: vilp-models (.+)", command.help or "")
    for below in getattr(command, "commands", {}).values():
        yield from _examples(below)


EXAMPLES = sorted(_examples(typer.main.get_command(app)))

CALLED = (
    "train.train_vqgan", "train.train_planner", "train.train_policy", "train.train_bc", "fidelity.report_inputs",
    "evaluate.evaluate_planner", "evaluate.evaluate_policy", "evaluate.generate_videos", "policies.load.load_policy",
    "compare_sets.compare_sets",
)  # fmt: skip


def test_every_command_has_an_example() -> None:
    assert len(EXAMPLES) == len(CALLED)


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_examples_of_the_help_find_dataset_preset_and_runs(
    data: Path, monkeypatch: pytest.MonkeyPatch, example: str
) -> None:
    class CalledError(Exception):
        pass

    def called(*given: Any, **_: Any) -> None:
        raise CalledError(*given)

    for name in CALLED:
        monkeypatch.setattr(f"vilp_models.{name}", called)
    with pytest.raises(CalledError) as reached:
        CliRunner().invoke(app, example.split(), catch_exceptions=False)
    given: list[Any] = []
    for value in reached.value.args:
        given += [value.root, value.spec] if isinstance(value, PolicyRequest | SetsComparison) else [value]
    task = "hanoi" if "hanoi" in example else "pusht"
    assert data / task in [value.root if isinstance(value, EpisodeStore) else value for value in given]
    today = load_task(task, preset="cpu")
    for spec in [value for value in given if isinstance(value, TaskSpec)]:
        assert (spec.name, spec.window, spec.models) == (task, today.window, today.models)
