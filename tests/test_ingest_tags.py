"""Tags that ingest gives: by the task's [tags] and `--set`; what a log or a person says comes first."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.json_log import image, joints, write_json_log
from tests.synthetic import write_zarr
from tests.test_cli import ZARR_TASK
from vilp_data import history
from vilp_data.cli import app
from vilp_data.episodes import EpisodeStore
from vilp_data.surgery.operations import relabel_episodes
from vilp_data.task_toml import parse_task

TASK = ZARR_TASK + '[tags."demo*.zarr"]\ngoal = "here"\n[tags."demo2.zarr"]\nobject = "T"\n'


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A task whose [tags] speak of two stores, which say nothing of themselves."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task.toml").write_text(TASK)
    write_zarr(tmp_path / "demo1.zarr")
    return tmp_path


def ingested(*words: str, ends: int = 0) -> str:
    result = CliRunner().invoke(app, ["ingest", *words, "--task", "task.toml", "--into", "data", "--workers", "1"])
    assert result.exit_code == ends, result.output
    return result.output


def tags(root: Path = Path("data")) -> list[dict[str, str]]:
    return [dict(entry.tags) for entry in EpisodeStore(root).index()]


def test_the_task_tags_what_its_logs_do_not_say(work: Path) -> None:
    ingested("demo1.zarr")
    assert tags()
    assert all(one == {"goal": "here"} for one in tags())
    before = history.numbers(Path("data"))
    assert "told otherwise" not in ingested("demo1.zarr")
    assert history.numbers(Path("data")) == before


def test_what_was_ingested_before_the_task_had_tags_gets_them(work: Path) -> None:
    (work / "task.toml").write_text(ZARR_TASK)
    ingested("demo1.zarr")
    assert not any(tags())
    (work / "task.toml").write_text(TASK)
    assert "told otherwise by their log or the task now" in ingested("demo1.zarr")
    assert all(one == {"goal": "here"} for one in tags())
    assert "told otherwise" not in ingested("demo1.zarr")


def test_who_ingests_has_the_last_word(work: Path) -> None:
    ingested("demo1.zarr", "--set", "goal=there", "--set", "who=anna")
    assert all(one == {"goal": "there", "who": "anna"} for one in tags())
    ingested("demo1.zarr")
    assert all(one == {"goal": "there", "who": "anna"} for one in tags())


def test_what_a_person_took_away_stays_away(work: Path) -> None:
    ingested("demo1.zarr")
    ids = [entry.id for entry in EpisodeStore(Path("data")).index()]
    relabel_episodes(Path("data"), ids, unset=["goal"])
    ingested("demo1.zarr")
    assert tags() == [{}] * len(ids)


def test_episodes_of_other_logs_are_left_alone(work: Path) -> None:
    write_zarr(work / "demo2.zarr", episode_lengths=(8, 7))
    ingested("demo1.zarr", "demo2.zarr")
    ingested("demo2.zarr", "--set", "day=monday")
    both = {"goal": "here", "object": "T", "day": "monday"}
    assert {entry.source: dict(entry.tags) for entry in EpisodeStore(Path("data")).index()} == {
        "demo1.zarr": {"goal": "here"},
        "demo2.zarr": both,
    }


def test_a_label_that_is_none_is_refused_before_anything_is_read(work: Path) -> None:
    assert "not a label" in str(
        CliRunner().invoke(app, ["ingest", "demo1.zarr", "--task", "task.toml", "--set", "goal"]).exception
    )
    assert not Path("data").exists()


def test_several_patterns_add_up(work: Path) -> None:
    task = parse_task(TASK, where="test")
    assert task.tags_of("demo2.zarr") == {"goal": "here", "object": "T"}
    assert task.tags_of("demo1.zarr") == {"goal": "here"}
    assert "tags" not in parse_task(ZARR_TASK, where="test").model_dump()


COPIES = """
name = "leg"
rate_hz = 10
views.front = { topic = "/camera/front/image", height = 48, width = 64 }
low_dim.leg = { topic = "/joint_states" }
tags."a.mcap" = { who = "anna", day = "monday" }
tags."b.mcap" = { who = "ben" }
"""


@pytest.mark.parametrize("cuts", ["", "episodes = { by = 'gap', gap_s = 1.0 }\n"])
def test_a_copy_of_which_something_else_is_said_overwrites_no_tag_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cuts: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task.toml").write_text(COPIES + cuts)
    said = [image(k / 10, index=k) for k in range(12)] + [joints(k / 10, ["hip"], [k]) for k in range(12)]
    for name in ("a.mcap", "b.mcap"):
        write_json_log(tmp_path / name, said)

    def stored() -> list[dict[str, str]]:
        return [{tag: value for tag, value in one.items() if tag in ("who", "day")} for one in tags()]

    ingested("a.mcap")
    assert stored() == [{"who": "anna", "day": "monday"}]
    told = ingested("b.mcap")
    assert stored() == [{"who": "anna", "day": "monday"}]
    assert "day = monday (there nothing), who = anna (there ben); `vilp-data relabel" in told
    assert "told otherwise" not in told
    together = ingested("a.mcap", "b.mcap")
    assert stored() == [{"who": "anna", "day": "monday"}]
    assert "taken once, with the labels of that log: day = monday (there nothing), who = anna (there ben)" in together
    (tmp_path / "task.toml").write_text((COPIES + cuts).replace("anna", "eve"))
    ingested("a.mcap")  # its own log may say something else
    assert stored() == [{"who": "eve", "day": "monday"}]
