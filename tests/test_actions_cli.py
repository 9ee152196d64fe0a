"""`vilp-data actions`: what it prints and how it ends."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.test_dataset_action_sets import root, split  # noqa: F401  (the fixture)
from vilp_data.check.dataset import check_dataset
from vilp_data.cli import app
from vilp_data.dataset_action_sets import read_action_set, set_path
from vilp_data.errors import ActionSetError, SpecError, UsageError
from vilp_data.surgery.operations import remove_episodes

RECIPE = """
video = 610
[source.gray]
where = { object = "gray" }
count = 2
weight = 3
[source.purple]
where = { object = "purple" }
count = 1
"""


@pytest.fixture
def recipe(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:  # noqa: F811
    monkeypatch.chdir(root)
    Path("mine.toml").write_text(RECIPE)
    return "mine.toml"


def said(*words: str, ends: int = 0) -> str:
    result = CliRunner().invoke(app, ["actions", "--data", ".", *words])
    assert result.exit_code == ends, result.output
    return result.output


def test_a_set_is_called_after_its_file_and_described_in_words(recipe: str) -> None:
    text = said("--recipe", recipe)
    labels = read_action_set(Path(), "mine")
    gray, purple = labels.lock.sources
    share = 3 * gray.n_steps / (3 * gray.n_steps + purple.n_steps)
    assert f"3 episodes give labels, {len(labels.lock.video_only)} video only" in text
    assert f"gray (object = gray): 2 episodes, {gray.n_steps} steps, {share:.0%} of the samples drawn" in text
    assert "purple (object = purple): 1 episode, " in text
    assert f"the paper's video is 610 episodes; here {3 + len(labels.lock.video_only)} train" in text


def test_json_is_the_lock(recipe: str) -> None:
    table = json.loads(said("--recipe", recipe, "--json"))
    assert table == json.loads(set_path(Path(), "mine").read_text())
    assert list(table["recipe"]["source"]) == ["gray", "purple"]
    assert sorted(table["episodes"]) == sorted(id for source in table["sources"] for id in source["episodes"])


def test_the_list_proves_every_set_again_and_ends_with_1_where_one_does_not_hold(recipe: str) -> None:
    assert "no action set yet" in said()
    said("--recipe", recipe)
    assert said().startswith("mine: 3 episodes give labels")
    remove_episodes(Path(), [read_action_set(Path(), "mine").entries[0].id])
    assert "episodes of it are gone" in said(ends=1)
    table = json.loads(said("--json", ends=1))
    assert "are gone" in table["mine"]["wrong"][0]
    result = CliRunner().invoke(app, ["actions", "--data", ".", "--recipe", recipe])
    assert isinstance(result.exception, ActionSetError)
    assert "--recipe mine.toml --redraw" in str(result.exception)
    said("--recipe", recipe, "--redraw")
    said()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"{", "not JSON: "),
        (b'{"format": 1, "action": {"mean": [NaN]}}', "NaN, which is no number"),
        (b"\xff", "not JSON: "),
        (b"[]", "a list, not a table"),
        (b'{"format": 1}', "it lacks 'name'"),
        (b'{"format": 9}', "format 9, this is 1"),
    ],
)
def test_a_lock_that_cannot_be_read_hides_no_other(recipe: str, content: bytes, words: str) -> None:
    said("--recipe", recipe)
    set_path(Path(), "broken").write_bytes(content)
    text = said(ends=1)
    assert "mine: 3 episodes give labels" in text
    assert f"broken: cannot be read\n  {set_path(Path(), 'broken')}: not the lock of an action set" in text
    assert f"found: {words}" in text
    assert "Error(" not in text
    assert "`vilp-data actions . --recipe broken --redraw`" in text
    table = json.loads(said("--json", ends=1))
    assert table["mine"]["wrong"] == []
    assert (table["broken"]["key"], len(table["broken"]["wrong"])) == (None, 1)


def test_what_is_no_file_is_no_set_and_a_split_that_is_gone_hides_none(recipe: str) -> None:
    said("--recipe", recipe)
    set_path(Path(), "folder").mkdir()
    assert "folder" not in said()
    with pytest.raises(UsageError, match="a folder where the lock belongs"):
        CliRunner().invoke(
            app, ["actions", "--data", ".", "--recipe", str(shutil.copy(recipe, "folder.toml"))], catch_exceptions=False
        )
    Path("split.lock.json").unlink()
    assert "mine: 3 episodes give labels" in (text := said(ends=1))
    assert "this dataset has no split yet" in text


def test_check_tells_the_sets_that_do_not_hold(recipe: str) -> None:
    said("--recipe", recipe)
    shutil.copy(set_path(Path(), "mine"), set_path(Path(), "other"))
    assert [finding for finding in check_dataset(Path()).findings if finding.kind == "action-set"] == []
    set_path(Path(), "other").write_text("{")
    remove_episodes(Path(), [read_action_set(Path(), "mine").entries[0].id])
    first, second = (finding for finding in check_dataset(Path()).findings if finding.kind == "action-set")
    assert (first.severity, first.what) == ("warning", "action set 'mine': episodes of it are gone")
    assert first.remedy is not None
    assert "`vilp-data actions . --recipe mine.toml --redraw`" in first.remedy
    assert second.evidence["file"] == str(set_path(Path(), "other"))


def test_a_name_means_a_recipe_of_the_datasets_task_or_of_the_one_named(recipe: str) -> None:
    result = CliRunner().invoke(app, ["actions", "--data", ".", "--recipe", "small"])
    assert isinstance(result.exception, SpecError)
    assert "the task 'test' has no recipe called 'small'" in str(result.exception)
    result = CliRunner().invoke(app, ["actions", "--data", ".", "--recipe", "small", "--task", "pusht"])
    assert isinstance(result.exception, ActionSetError)
    assert "no training episode has the tag 'goal'\n   found: tags object" in str(result.exception)
    assert isinstance(CliRunner().invoke(app, ["actions", "--data", "nowhere"]).exception, UsageError)
