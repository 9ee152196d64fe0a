"""The verbs that show a log before it is ingested: `inspect --suggest-spec`, `inspect --task`, `ingest --preview`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from tests.faults import tree
from tests.json_log import image, joints, number, write_json_log
from tests.synthetic import write_mcap
from vilp_data.cli import app
from vilp_data.errors import LogError, UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.task_toml import load_task, parse_task


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_mcap(tmp_path / "run.mcap")
    return tmp_path


def run(*words: str) -> Result:
    return CliRunner().invoke(app, words)


def test_a_suggestion_is_written_once_and_ingested(work: Path) -> None:
    written = run("inspect", "run.mcap", "--suggest-spec", "-o", "mine.toml")
    assert (written.exit_code, written.stdout.split(":")[0]) == (0, "mine.toml")
    assert load_task("mine.toml").name == "mine"
    assert isinstance(run("inspect", "run.mcap", "--suggest-spec", "-o", "mine.toml").exception, UsageError)
    ingested = run("ingest", "run.mcap", "--task", "mine.toml", "--workers", "1")
    assert (ingested.exit_code, "data/mine: 1 episode ingested" in ingested.stdout) == (0, True)


def test_a_suggestion_goes_to_stdout_by_itself(work: Path) -> None:
    text = run("inspect", "run.mcap", "--suggest-spec").stdout
    assert parse_task(text, where="stdout").name == "run"


def test_wrong_use_and_damaged_logs_write_nothing(work: Path) -> None:
    assert isinstance(run("inspect", "nowhere.mcap", "--suggest-spec", "-o", "a.toml").exception, UsageError)
    assert isinstance(run("inspect", "run.mcap", "-o", "a.toml").exception, UsageError)
    whole = (work / "run.mcap").read_bytes()
    (work / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    assert isinstance(run("inspect", "cut.mcap", "--suggest-spec", "-o", "a.toml").exception, LogError)
    assert isinstance(run("inspect", "run.mcap", "--suggest-spec", "-o", "no/such/a.toml").exception, UsageError)
    assert not (work / "a.toml").exists()


def test_the_preview_prints_every_cut_and_writes_nothing(work: Path) -> None:
    run("inspect", "run.mcap", "--suggest-spec", "-o", "mine.toml")
    (work / "ranges.csv").write_text("start,end,name,object\n0,0.8,first,cup\n1,1.5,,\n")
    text = (work / "mine.toml").read_text()
    (work / "mine.toml").write_text(text.replace("[views.front]", '[episodes]\nby = "ranges.csv"\n[views.front]'))
    before = tree(work)
    shown = run("ingest", "run.mcap", "--task", "mine.toml", "--preview")
    assert shown.exit_code == 0
    assert "2 demonstrations, 1.3 s in all; nothing was written" in shown.stdout
    assert "object=cup" in shown.stdout
    assert shown.stdout in run("inspect", "run.mcap", "--task", "mine.toml").stdout
    told = json.loads(run("ingest", "run.mcap", "--task", "mine.toml", "--preview", "--json").stdout)
    assert [cut["name"] for cut in told["demonstrations"]] == ["first", "at-00001.000s"]
    assert tree(work) == before


def test_a_log_that_cannot_be_shown_ends_with_one(work: Path) -> None:
    run("inspect", "run.mcap", "--suggest-spec", "-o", "mine.toml")
    (work / "broken.mcap").write_bytes((work / "run.mcap").read_bytes()[:3000])
    shown = run("ingest", ".", "--task", "mine.toml", "--preview")
    assert shown.exit_code == 1
    assert "1 demonstration, " in shown.stdout
    assert "broken.mcap" in shown.stderr


def test_a_dataset_without_cameras_can_be_split(work: Path) -> None:
    root = work / "data"
    spec = parse_task('name = "x"\nrate_hz = 10\nlow_dim.joints = { topic = "/joint_states" }\n', where="x")
    for name, offset in (("a", 0.0), ("b", 1.0)):
        write_json_log(work / f"{name}.mcap", [joints(k / 10, ["j"], [offset + k / 10]) for k in range(20)])
    assert len(ingest_logs([work / "a.mcap", work / "b.mcap"], root, spec, workers=1).written) == 2
    split = run("split", str(root), "--json")
    assert sorted(json.loads(split.stdout)["assignment"].values()) == ["train", "val"]


def test_inspect_as_json_holds_one_document(work: Path) -> None:
    write_json_log(work / "small.mcap", [image(0.0), image(0.1), number(0.0, 1.0, "/x")])
    run("inspect", "small.mcap", "--suggest-spec", "-o", "small.toml")
    told = json.loads(run("inspect", "small.mcap", "--task", "small.toml", "--json").stdout)
    assert (told["format"], len(told["demonstrations"])) == ("mcap", 1)
