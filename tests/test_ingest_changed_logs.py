"""Logs that grow, change or take another's name between two ingests: what is replaced, added, kept, and read again."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py
import pytest
import zarr

from tests.faults import kill_after, tree
from tests.sources.test_hdf5_log import write_hdf5
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from tests.test_ingest import ingest
from vilp_data.episodes import EpisodeStore
from vilp_data.sources.mcap_log import McapLog
from vilp_data.spec import TaskSpec


def write_grown_zarr(path: Path, lengths: list[int], *, edit_row: int | None = None) -> None:
    shutil.rmtree(path, ignore_errors=True)
    write_zarr(path, episode_lengths=lengths)
    if edit_row is not None:
        zarr.open_group(path)["data/action"][edit_row] = 77.0


def stored_files(root: Path) -> dict[str, bytes]:
    return {name: data for name, data in tree(root).items() if name.endswith(".safetensors")}


def test_one_more_demonstration_in_a_store_adds_one_episode_and_touches_no_other(tmp_path: Path) -> None:
    log, root = tmp_path / "replay.zarr", tmp_path / "data"
    write_grown_zarr(log, [12, 9, 5])
    ingest([log], root, zarr_task_spec())
    before = stored_files(root)
    write_grown_zarr(log, [12, 9, 5, 8])
    report = ingest([log], root, zarr_task_spec())
    assert report.written == ["replay-episode_003"]
    assert report.fresh == [f"replay-episode_00{i}" for i in range(3)]
    assert (report.replaced, report.notes) == ([], [])
    assert stored_files(root).items() >= before.items()
    assert len(EpisodeStore(root).index()) == 4


def test_a_changed_demonstration_replaces_its_episode_and_is_named(tmp_path: Path) -> None:
    log, root = tmp_path / "replay.zarr", tmp_path / "data"
    write_grown_zarr(log, [12, 9, 5])
    ingest([log], root, zarr_task_spec())
    write_grown_zarr(log, [12, 9, 5], edit_row=15)
    report = ingest([log], root, zarr_task_spec())
    assert report.written == report.replaced == ["replay-episode_001"]
    action = EpisodeStore(root).read("replay-episode_001").action
    assert action is not None
    assert action[3].tolist() == [77.0, 77.0]
    write_grown_zarr(tmp_path / "whole" / "replay.zarr", [12, 9, 5], edit_row=15)
    ingest([tmp_path / "whole" / "replay.zarr"], tmp_path / "fresh", zarr_task_spec())
    assert tree(root) == tree(tmp_path / "fresh")


def test_a_store_of_which_most_changed_is_kept_beside_the_first_wherever_an_ingest_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "replay.zarr"
    for root in ("whole", "killed"):
        write_grown_zarr(log, [6, 5, 5, 5])
        ingest([log], tmp_path / root, zarr_task_spec())
        write_grown_zarr(log, [6, 4, 5, 5])  # rows move: of four demonstrations one is unchanged
        if root == "killed":
            with monkeypatch.context() as patch:
                kill_after(2, patch)
                with pytest.raises(KeyboardInterrupt):
                    ingest([log], tmp_path / root, zarr_task_spec())
        assert ingest([log], tmp_path / root, zarr_task_spec()).replaced == []
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


def test_an_attribute_that_was_corrected_reaches_its_episode_without_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, root = write_hdf5(tmp_path / "demos.hdf5"), tmp_path / "data"
    table = zarr_task_spec().model_dump(by_alias=True) | {"state": None}
    table["views"]["top"]["topic"], table["low_dim"]["agent"]["topic"] = "obs/top_image", "obs/eef"
    table["action"]["target"]["topic"] = "actions"
    spec = TaskSpec.model_validate(table)
    written = ingest([log], root, spec).written
    with h5py.File(log, "r+") as file:
        file["data/demo_1"].attrs["success"] = "false"
    monkeypatch.setattr("vilp_data.ingest.assemble_episode", lambda *_, **__: pytest.fail("decoded again"))
    report = ingest([log], root, spec)
    assert (report.fresh, report.restated) == (written, [written[1]])
    assert EpisodeStore(root).entry(written[1]).outcome == "failure"


def test_another_store_of_the_same_name_overwrites_nothing(tmp_path: Path) -> None:
    write_grown_zarr(tmp_path / "monday" / "replay.zarr", [12, 9, 5])
    write_grown_zarr(tmp_path / "tuesday" / "replay.zarr", [7, 8])
    root = tmp_path / "data"
    ingest([tmp_path / "monday"], root, zarr_task_spec())
    before = stored_files(root)
    report = ingest([tmp_path / "tuesday"], root, zarr_task_spec())
    assert len(report.written) == 2
    assert not report.replaced
    assert "both are kept" in report.notes[0]
    assert stored_files(root).items() >= before.items()


def test_two_stores_of_one_name_given_together_keep_their_episodes(tmp_path: Path) -> None:
    write_grown_zarr(tmp_path / "a" / "replay.zarr", [12, 9, 5])
    write_grown_zarr(tmp_path / "b" / "replay.zarr", [12, 9, 5], edit_row=15)
    root = tmp_path / "data"
    assert len(ingest([tmp_path / "a", tmp_path / "b"], root, zarr_task_spec()).written) == 4
    again = ingest([tmp_path / "b", tmp_path / "a"], root, zarr_task_spec())
    assert (again.written, len(again.fresh)) == ([], 4)


def test_a_later_log_of_the_same_name_is_kept_beside_the_first_and_said(tmp_path: Path) -> None:
    for day, seed in (("monday", 1), ("tuesday", 2)):
        (tmp_path / day).mkdir()
        log = write_mcap(tmp_path / day / "run.mcap", jitter_s=0.001, seed=seed)
    root = tmp_path / "data"
    ingest([tmp_path / "monday"], root, task_spec(log))
    before = stored_files(root)
    report = ingest([tmp_path / "tuesday"], root, task_spec(log))
    (new,) = report.written
    assert new.startswith("run-")
    assert new in report.notes[0]
    assert stored_files(root).items() >= before.items()
    assert ingest([tmp_path], root, task_spec(log)).fresh == ["run", new]


def test_a_log_that_looks_untouched_is_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    os.utime(log.path, (1e9, 1e9))
    ingest([log.path], tmp_path / "data", task_spec(log))
    monkeypatch.setattr(McapLog, "sha256", lambda self: pytest.fail("read again"))
    assert ingest([log.path], tmp_path / "data", task_spec(log)).fresh == ["run"]
    monkeypatch.undo()
    changed = write_mcap(log.path, jitter_s=0.001, seed=3)
    os.utime(log.path, (1e9, 1e9))
    assert ingest([log.path], tmp_path / "data", task_spec(changed)).written != []
