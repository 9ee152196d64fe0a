"""A log that was written anew: the same demonstration in other bytes, perhaps with other tags. The table in `known_content`, row by row;
each row the same wherever the ingest was killed, and whatever order logs are given in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.faults import kill_after, tree
from tests.synthetic import task_spec, write_mcap
from tests.test_known_episodes import ids, ingest, two_runs, write_anew
from vilp_data.episodes import EpisodeStore
from vilp_data.ingest import ingest_logs
from vilp_data.removed import read_removed
from vilp_data.spec import TaskSpec
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path, TaskSpec]:
    return two_runs(tmp_path)


def tagged(path: Path, **tags: str) -> Path:
    """The same messages each time, in other bytes by their tags alone."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_mcap(path, height=16, width=24, n_frames=6, tags=tags).path


@pytest.fixture
def spec(tmp_path: Path) -> TaskSpec:
    return task_spec(write_mcap(tmp_path / "spec.mcap", height=16, width=24, n_frames=6))


def ingest_killed(
    logs: Sequence[Path], root: Path, spec: TaskSpec, patch: pytest.MonkeyPatch, *, after: int, again: bool = False
) -> None:
    with patch.context() as context:
        kill_after(after, context)
        with pytest.raises(KeyboardInterrupt):
            ingest_logs(logs, root, spec, workers=1, again=again)


# --- of a stored episode ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("include_failures", [False, True])
def test_corrected_tags_of_a_log_that_was_written_anew_reach_its_episode(
    tmp_path: Path, spec: TaskSpec, include_failures: bool
) -> None:
    root, log = tmp_path / "data", tagged(tmp_path / "run.mcap", success="true", operator="anna", cup="red")
    ingest(log, root, spec)
    relabel_episodes(root, ["run"], labels={"cup": "blue"})
    before = tree(root)
    tagged(log, success="false", operator="kim", cup="green")
    report = ingest(log, root, spec, include_failures=include_failures)
    assert (report.written, report.fresh, report.restated, report.left_out) == ([], ["run"], ["run"], [])
    entry = EpisodeStore(root).entry("run")
    assert (entry.outcome, dict(entry.tags)) == ("failure", {"success": "false", "operator": "kim", "cup": "blue"})
    assert any("run: a failure now" in note for note in report.notes)
    assert not any("both are kept" in note for note in report.notes)
    done = tree(root)
    again = ingest(log, root, spec, include_failures=include_failures)
    assert (again.fresh, again.restated, again.notes) == (["run"], [], [])
    assert tree(root) == done
    undo(root)
    assert tree(root) == before


def test_an_outcome_that_people_set_outranks_that_of_a_log_written_anew(tmp_path: Path, spec: TaskSpec) -> None:
    root, log = tmp_path / "data", tagged(tmp_path / "run.mcap", success="true")
    ingest(log, root, spec)
    relabel_episodes(root, ["run"], labels={"success": "false"})
    tagged(log, success="true", operator="kim")
    ingest(log, root, spec)
    entry = EpisodeStore(root).entry("run")
    assert (entry.outcome, entry.tags["operator"]) == ("failure", "kim")
    relabel_episodes(root, ["run"], labels={"success": "true"})
    assert EpisodeStore(root).entry("run").edits == {}


def test_logs_of_two_names_that_show_the_same_give_twins_in_any_order_and_wherever_killed(
    tmp_path: Path, spec: TaskSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = tagged(tmp_path / "a.mcap", operator="anna"), tagged(tmp_path / "b.mcap", success="true")
    report = ingest_logs([a, b], tmp_path / "together", spec, workers=1)
    assert report.written == ["a", "b"]
    assert ["a, b: show the same" in note for note in report.notes] == [True]
    for name, order in (("a first", (a, b)), ("b first", (b, a))):
        for log in order:
            ingest(log, tmp_path / name, spec)
    ingest_killed([b, a], tmp_path / "killed", spec, monkeypatch, after=1)
    last = ingest_logs([b, a], tmp_path / "killed", spec, workers=1)
    assert (last.fresh, last.written) == (["a"], ["b"])
    for name in ("a first", "b first", "killed"):
        assert tree(tmp_path / name) == tree(tmp_path / "together"), name
    assert EpisodeStore(tmp_path / "killed").entry("b").outcome == "success"


@pytest.mark.parametrize("after", [0, 1])
def test_a_log_beside_its_copy_in_other_bytes_gives_twins_wherever_killed(
    tmp_path: Path, spec: TaskSpec, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    logs = [tagged(tmp_path / day / "run.mcap", day=day) for day in ("friday", "monday")]
    first, second = ingest_logs(logs, tmp_path / "whole", spec, workers=1).written
    assert (first, second.startswith("run-")) == ("run", True)
    ingest_killed(logs, tmp_path / "killed", spec, monkeypatch, after=after)
    ingest_logs(logs[::-1], tmp_path / "killed", spec, workers=1)
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")
    assert ingest_logs(logs, tmp_path / "killed", spec, workers=1).fresh == [first, second]


def test_of_two_new_logs_of_a_stored_one_s_name_neither_is_taken_for_it(
    tmp_path: Path, spec: TaskSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("whole", "killed"):
        ingest(tagged(tmp_path / "run.mcap", day="sunday"), tmp_path / name, spec)
    logs = [tagged(tmp_path / day / "run.mcap", day=day) for day in ("friday", "monday")]
    assert len(ingest_logs(logs, tmp_path / "whole", spec, workers=1).written) == 2
    ingest_killed(logs, tmp_path / "killed", spec, monkeypatch, after=1)
    ingest_logs(logs, tmp_path / "killed", spec, workers=1)
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")
    assert EpisodeStore(tmp_path / "killed").entry("run").tags["day"] == "sunday"


def test_an_episode_whose_bytes_are_still_there_under_another_name_is_not_taken(tmp_path: Path, spec: TaskSpec) -> None:
    root, log = tmp_path / "data", tagged(tmp_path / "run.mcap", operator="anna")
    ingest(log, root, spec)
    log.rename(tmp_path / "copy.mcap")
    report = ingest_logs([tagged(log, operator="kim"), tmp_path / "copy.mcap"], root, spec, workers=1)
    assert (report.fresh, len(report.written)) == (["run"], 1)
    assert EpisodeStore(root).entry("run").tags["operator"] == "anna"


def test_a_failure_under_a_known_name_that_shows_something_else_is_left_out_and_not_said_to_be_kept(
    tmp_path: Path, spec: TaskSpec
) -> None:
    root, log = tmp_path / "data", tagged(tmp_path / "run.mcap")
    ingest(log, root, spec)
    write_mcap(log, height=16, width=24, n_frames=7, tags={"success": "false"})
    before = tree(root)
    report = ingest(log, root, spec)
    assert (len(report.left_out), report.written, report.fresh, report.notes) == (1, [], [], [])
    assert tree(root) == before
    report = ingest(log, root, spec, include_failures=True)
    assert f"both are kept, this one as {report.written[0]}" in report.notes[0]


# --- of a removed episode -------------------------------------------------------------------------------------------------------------


def one_removed(folder: Path, name: str, spec: TaskSpec) -> Path:
    """A dataset from which `a` was removed, with a label; another episode is left."""
    other = write_mcap(folder / "other.mcap", height=16, width=24, n_frames=7).path
    ingest_logs([tagged(folder / "a.mcap"), other], folder / name, spec, workers=1)
    relabel_episodes(folder / name, ["a"], labels={"operator": "anna"})
    remove_episodes(folder / name, ["a"])
    return folder / name


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_two_logs_that_show_a_removed_episode_neither_comes_back(
    tmp_path: Path, spec: TaskSpec, order: tuple[int, int]
) -> None:
    logs = [tagged(tmp_path / f"{'cd'[i]}.mcap", name="cd"[i]) for i in order]
    root = one_removed(tmp_path, "data", spec)
    report = ingest_logs(logs, root, spec, workers=1)
    assert (report.written, report.removed) == ([], ["a"])
    done = tree(root)
    assert ingest_logs(logs[::-1], root, spec, workers=1).removed == ["a"]
    assert tree(root) == done


@pytest.mark.parametrize("after", [1, 3], ids=["before any was back", "when one was back"])
def test_of_two_logs_that_show_a_removed_episode_that_is_wanted_one_brings_it_back_as_it_was(
    tmp_path: Path, spec: TaskSpec, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    logs = [tagged(tmp_path / f"{name}.mcap", name=name) for name in "cd"]
    whole, killed = one_removed(tmp_path, "whole", spec), one_removed(tmp_path, "killed", spec)
    ingest_killed(logs, killed, spec, monkeypatch, after=after, again=True)
    for root, order in ((whole, logs), (killed, logs[::-1])):
        ingest_logs(order, root, spec, workers=1, again=True)
        assert (len(ids(root)), read_removed(root)) == (3, {})
        assert EpisodeStore(root).entry("a").tags["operator"] == "anna"
    assert tree(killed) == tree(whole)


def test_a_removed_episode_that_is_wanted_comes_back_from_its_own_log_and_what_shows_the_same_is_a_twin(
    tmp_path: Path, spec: TaskSpec
) -> None:
    root, twin = one_removed(tmp_path, "data", spec), tagged(tmp_path / "c.mcap", name="c")
    report = ingest_logs([twin, tmp_path / "a.mcap"], root, spec, workers=1, again=True)
    assert (report.written, ids(root)) == (["a", "c"], ["a", "c", "other"])
    assert EpisodeStore(root).entry("a").source == "a.mcap"


def test_what_a_killed_ingest_had_brought_back_is_not_removed_any_more(
    tmp_path: Path, spec: TaskSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, twins = one_removed(tmp_path, "data", spec), [tagged(tmp_path / f"{name}.mcap", name=name) for name in "cd"]
    ingest_killed([tmp_path / "a.mcap", *twins], root, spec, monkeypatch, after=1, again=True)
    before = EpisodeStore(root).entry("a")
    assert ingest(twins[1], root, spec, again=True).written == ["d"]
    assert EpisodeStore(root).entry("a") == before


def test_a_removed_episode_does_not_come_back_in_other_bytes(runs: tuple[Path, Path, TaskSpec], tmp_path: Path) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, ["a"], steps=(3, 15)))
    remove_episodes(root, ["a"], reason="dropped")
    anew = write_anew(log, tmp_path / "anew" / "salvaged.mcap")
    report = ingest(anew, root, spec)
    assert (report.written, report.removed, ids(root)) == ([], ["a"], ["b"])
    assert read_removed(root)["a"].source == "salvaged.mcap"
    assert ingest(anew, root, spec).removed == ["a"]  # known by its bytes now
    assert ingest(anew, root, spec, again=True).written == ["a"]
    entry = EpisodeStore(root).entry("a")
    assert (entry.n_steps, entry.tags["operator"]) == (12, "anna")


def test_what_was_removed_comes_back_as_it_was_when_its_log_in_other_bytes_is_wanted_again(
    runs: tuple[Path, Path, TaskSpec], tmp_path: Path
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    remove_episodes(root, ["a"])
    report = ingest(write_anew(log, tmp_path / "anew" / "a.mcap"), root, spec, again=True)
    assert (report.written, read_removed(root)) == (["a"], {})
    assert EpisodeStore(root).entry("a").tags["operator"] == "anna"


def test_labels_and_trim_of_a_removed_episode_are_there_when_it_is_wanted_again(
    runs: tuple[Path, Path, TaskSpec],
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, ["a"], steps=(3, 15)))
    steps = EpisodeStore(root).steps_path("a").read_bytes()
    remove_episodes(root, ["a"])
    assert ingest(log, root, spec, again=True).written == ["a"]
    assert EpisodeStore(root).steps_path("a").read_bytes() == steps


def test_a_stored_episode_in_other_bytes_is_known_and_not_stored_twice(
    runs: tuple[Path, Path, TaskSpec], tmp_path: Path
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    key, before = EpisodeStore(root).entry("a").key, tree(root)
    anew = write_anew(log, tmp_path / "anew" / "a.mcap")
    report = ingest(anew, root, spec)
    assert (report.written, report.fresh, len(ids(root))) == ([], ["a"], 2)
    entry = EpisodeStore(root).entry("a")
    assert (entry.key, entry.tags["operator"]) == (key, "anna")  # a model that learnt from it still knows it
    done = tree(root)
    assert ingest(anew, root, spec).notes == []
    assert tree(root) == done
    undo(root)
    assert tree(root) == before
