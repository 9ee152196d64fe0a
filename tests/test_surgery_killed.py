"""kill -9 at any moment of an operation: the old state or the new, and the same command again goes on."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.faults import call_until_killed, tree
from tests.stored_episodes import episode, write_dataset
from tests.surgery_operations import ingest_all, operate, other_dataset
from tests.synthetic import write_zarr, zarr_task_spec
from vilp_data import journal
from vilp_data.dataset_state import read_state
from vilp_data.episodes import EpisodeStore
from vilp_data.history import read_history
from vilp_data.ingest import ingest_logs
from vilp_data.surgery.undo import undo


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes a, b, c, d with latents and a split, written by no verb."""
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


# What is done, and what before it. Of each one's 29 to 61 changes to the disk the commit is between the 16th and the 33rd.
KILLED: dict[str, tuple[str, ...]] = dict.fromkeys(("remove", "trim", "relabel", "merge", "split"), ()) | {
    "undo": ("relabel", "trim"), "undo the last": ("relabel", "trim"), "redo": ("relabel", "trim", "undo"),
}  # fmt: skip
BY_DEFAULT = {("remove", 16), ("trim", 24), ("merge", 33), ("undo the last", 22), ("undo the last", 40), ("redo", 17)}
KILLS = [
    pytest.param(what, nth, marks=() if (what, nth) in BY_DEFAULT else pytest.mark.slow)
    for what in KILLED
    for nth in range(1, 63)
]


@pytest.mark.parametrize(("what", "nth"), KILLS)
def test_an_operation_killed_at_any_moment_leaves_the_old_state_or_the_new(
    tmp_path: Path, root: Path, what: str, nth: int
) -> None:
    other_dataset(tmp_path / "other")
    for done in KILLED[what]:
        operate(root, done)
    before, whole = read_state(root).digest, tmp_path / "whole"
    shutil.copytree(root, whole)
    operate(whole, what)
    killed = call_until_killed(operate, root, what, nth=nth)
    entries = EpisodeStore(root).index()  # reading finishes what was committed
    after = read_state(root).digest
    assert after in (before, read_state(whole).digest)
    assert entries == sorted(entries, key=lambda entry: entry.id)
    at_its_end = after != before and EpisodeStore(root).index_path.is_file()
    if what != "undo the last" or not at_its_end:  # which would rightly take back one more
        operate(root, what)
    assert not journal.is_pending(root)
    assert tree(root) == tree(whole)
    assert [entry.what for entry in read_history(root)] == [entry.what for entry in read_history(whole)]
    assert killed or nth > 29


@pytest.mark.parametrize("nth", [n if n in (9, 31) else pytest.param(n, marks=pytest.mark.slow) for n in range(1, 46)])
def test_an_ingest_killed_and_run_again_is_one_operation_that_can_be_taken_back(tmp_path: Path, nth: int) -> None:
    log, root = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9, 5)), tmp_path / "data"
    ingest_logs([log.path], root, zarr_task_spec(), workers=1)
    before = tree(root)
    shutil.rmtree(log.path)
    write_zarr(log.path, episode_lengths=(12, 9, 5, 8, 7))
    call_until_killed(ingest_all, log.path, root, nth=nth)
    ingest_logs([log.path], root, zarr_task_spec(), workers=1)
    assert [(entry.what, entry.n_episodes) for entry in read_history(root)] == [("ingest", 3), ("ingest", 5)]
    undo(root)
    assert tree(root) == before
