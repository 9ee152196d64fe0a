"""Labels: set, taken away, kept over ingests, and refused where the split could not be kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.faults import tree
from tests.stored_episodes import episode, write_dataset
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from vilp_data.dataset_split import check_dataset_split, find_split, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SplitError, UsageError
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.spec import TaskSpec
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo


def split(root: Path, *, redraw: bool = False) -> None:
    update_split(root, ratio=0.5, ratio_from="task", seed=0, group_by=None, strata=(), redraw=redraw)


def ingest(logs: list[Path], root: Path, spec: TaskSpec, **options: bool) -> IngestReport:
    return ingest_logs(logs, root, spec, workers=1, **options)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes a, b, c, d with latents and a split."""
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


def ids(root: Path) -> list[str]:
    return [entry.id for entry in EpisodeStore(root).index()]


def test_labels_are_set_taken_away_and_said(root: Path) -> None:
    frames = {name: data for name, data in tree(root).items() if "/frames/" in name}
    relabel_episodes(root, ["a", "b"], labels={"operator": "anna", "success": "false"})
    entry = EpisodeStore(root).entry("a")
    assert (entry.tags, entry.outcome) == ({"operator": "anna", "success": "false"}, "failure")
    assert entry.key == "key of a"
    relabel_episodes(root, ["a"], unset=["success", "operator"])
    entry = EpisodeStore(root).entry("a")
    assert (entry.tags, entry.outcome, entry.edits) == ({}, "success", {})  # as ingest left it
    assert {name: data for name, data in tree(root).items() if "/frames/" in name} == frames
    assert relabel_episodes(root, ["b"], labels={"operator": "anna"}).operation is None


def test_labels_that_say_nothing_or_two_things_are_refused(root: Path) -> None:
    for labels, unset, message in (
        ({}, [], "no label"),
        ({"a": "1"}, ["a"], "set and taken away"),
        ({"source": "rollout"}, [], "not a label"),
        ({"success": "maybe"}, [], "succeeded or failed"),
        ({"success": ""}, [], "succeeded or failed"),
        ({" ": "x"}, [], "without a name"),
    ):
        with pytest.raises(UsageError, match=message):
            relabel_episodes(root, ["a"], labels=labels, unset=unset)


def split_by_operator(root: Path) -> None:
    """a and b of anna, c and d of ben."""
    relabel_episodes(root, ["a", "b"], labels={"operator": "anna"})
    relabel_episodes(root, ["c", "d"], labels={"operator": "ben"})
    update_split(root, ratio=0.5, ratio_from="task", seed=0, group_by="operator", strata=(), redraw=True)


def test_labels_that_would_bring_a_group_to_both_sides_are_refused_until_forced(root: Path) -> None:
    split_by_operator(root)
    before = tree(root)
    with pytest.raises(UsageError, match=r"would break the split(.|\n)*'ben' on both sides(.|\n)*--force"):
        relabel_episodes(root, ["a"], labels={"operator": "ben"})
    with pytest.raises(UsageError, match=r"a would have no 'operator'"):
        relabel_episodes(root, ["a"], unset=["operator"])
    assert tree(root) == before
    relabel_episodes(root, ["a", "b"], labels={"operator": "berta"})  # the whole group: still on one side
    assert check_dataset_split(root) == []
    relabel_episodes(root, ["a"], labels={"operator": "ben"}, force=True)
    assert any("both sides" in finding for finding in check_dataset_split(root))


def test_a_split_names_the_verb_that_gives_an_episode_the_tag_it_lacks(root: Path) -> None:
    relabel_episodes(root, ["a", "b", "c"], labels={"operator": "anna"})
    with pytest.raises(SplitError, match="relabel d --set operator="):
        update_split(root, ratio=0.5, ratio_from="task", seed=0, group_by="operator", strata=(), redraw=True)


def test_a_damaged_lock_is_drawn_anew_and_hinders_no_remove(root: Path) -> None:
    split(root, redraw=True)
    lock = root / "split.lock.json"
    lock.write_text("{")
    assert "not a split lock" in remove_episodes(root, ["a"]).notes[0]
    with pytest.raises(SplitError, match="--redraw"):
        split(root)
    split(root, redraw=True)
    assert set(ids(root)) == set((find_split(root) or pytest.fail("no split")).assignment)
    undo(root)
    assert lock.read_text() == "{"


def test_labels_and_trims_survive_another_ingest_of_the_same_log(tmp_path: Path) -> None:
    log, root = write_mcap(tmp_path / "run.mcap", tags={"operator": "ben", "success": "false"}), tmp_path / "data"
    other = write_mcap(tmp_path / "other.mcap", jitter_s=0.001, seed=3)
    spec, logs = task_spec(log), [log.path, other.path]
    ingest(logs, root, spec, include_failures=True)
    relabel_episodes(root, ["run"], labels={"operator": "anna", "success": "true"})
    trim_episodes(root, plan_trim(root, ["run"], steps=(4, 16)))
    steps = EpisodeStore(root).steps_path("run").read_bytes()
    assert sorted(ingest(logs, root, spec).fresh) == ["other", "run"]
    EpisodeStore(root).frames_path("front", "run").unlink()  # damaged: it is ingested anew
    assert ingest(logs, root, spec).written == ["run"]
    assert EpisodeStore(root).steps_path("run").read_bytes() == steps
    table = spec.model_dump(by_alias=True)
    table["views"]["front"] |= {"height": 24, "width": 32}
    table["rate_hz"] = 5.0
    assert ingest(logs, root, TaskSpec.model_validate(table)).written == ["other", "run"]
    entry = EpisodeStore(root).entry("run")
    assert (entry.tags["operator"], entry.outcome) == ("anna", "success")
    assert entry.n_steps == 6  # the same stretch of time at half the rate
    np.testing.assert_allclose(EpisodeStore(root).read("run").low_dim[0, 0], 0.4, atol=1e-5)


def test_labels_of_a_demonstration_that_changed_are_said_to_be_lost(tmp_path: Path) -> None:
    import zarr

    log, root = write_zarr(tmp_path / "replay.zarr"), tmp_path / "data"
    ingest([log.path], root, zarr_task_spec())
    relabel_episodes(root, ["replay-episode_001"], labels={"operator": "anna"})
    before = tree(root)
    zarr.open_group(log.path)["data/action"][15] = 77.0
    report = ingest([log.path], root, zarr_task_spec())
    assert report.replaced == ["replay-episode_001"]
    assert "its labels no longer hold" in report.notes[0]
    undo(root)
    assert tree(root) == before
